"""Types of values that gbid stores in HDF5, by kind of file, and `load` for all of them."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, overload

from gbid.core import hdf5
from gbid.core.errors import DataError
from gbid.core.hdf5 import InFile

F = TypeVar("F", bound=InFile)

TYPES = MappingProxyType(
    {
        "fit": ("gbid.identify", "FitResult"),
        "impact": ("gbid.control", "ImpactStudy"),
        "lpv_fit": ("gbid.lpv", "LPVFit"),
        "piezo_curve": ("gbid.prefilter", "PiezoCurve"),
        "prefilter": ("gbid.prefilter.filtering", "PrefilterFile"),
        "recording": ("gbid.recording", "Recording"),
        "static_map": ("gbid.prefilter", "StaticMap"),
        "table": ("gbid.identify", "FitTable"),
        "tuning": ("gbid.control.assessment", "TunedDesign"),
        "validation_summary": ("gbid.validate", "ValidationSummary"),
    }
)
"""Type of the value in a kind of file; it is imported when such a file is loaded."""


@overload
def load(path: str | Path, kind: type[F]) -> F: ...
@overload
def load(path: str | Path, kind: None = None) -> Any: ...
def load(path: str | Path, kind: type[InFile] | None = None) -> Any:
    """Return the value in an HDF5 file written by `gbid.save`.

    Parameters
    ----------
    path : path
        The file.
    kind : type, optional
        Type that the value must have, e.g. ``gbid.FitResult``; by default the type that the file names.

    Returns
    -------
    Recording, FitResult, FitTable or another value with a file of its own
        The value, bit for bit.

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete, of another kind or of another version of gbid.
    """
    apart = kind is not None
    if kind is None:
        with hdf5.reading(path, apart=True) as file:
            name = hdf5.read_text(file, "gbid_kind")
        if name not in TYPES:
            raise DataError(f"{path}: a {name} file; `gbid.load` reads {', '.join(TYPES)}")
        module, made = TYPES[name]
        kind = getattr(import_module(module), made)
    value: InFile = hdf5.load(path, kind, apart=apart)
    return value
