"""Export of models to MATLAB: a mat file with the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from gbid._version import __version__
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path
from gbid.core.names import given_path
from gbid.core.units import IN_METRES
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.lpv.model import TERMS
from gbid.lpv.model_file import SI_UNITS
from gbid.structure import KEY_PARAMETERS, LinearModel

Exportable = LinearModel | FitResult | LPVModel
"""Types that can be exported to other programs."""

_TEXT = 116  # length of the text at the beginning of a MATLAB file


def save_mat(
    what: Exportable, path: str | Path, *, units: Mapping[str, str] | None = None, overwrite: bool = False
) -> Path:
    """Write the numbers of a model for MATLAB, and return the path of the file.

    The documentation (export) lists its variables, and the lines of MATLAB that make ``ss`` and ``idss`` of them.

    Parameters
    ----------
    what : LinearModel, FitResult or LPVModel
        The model to export.
    path : path
        The mat file.
    units : dict of str to str, optional
        Unit of each channel by its name. LPV models and fits of the structures of gbid are in metres.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, when its name does not end in .mat, or when the model has no
        channel of a given unit.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    if path.suffix != ".mat":
        raise UsageError(f"{path}: a MATLAB data file ends in .mat")
    if isinstance(what, LPVModel):
        what.need_bearing()
    contents = lpv_contents(what) if isinstance(what, LPVModel) else linear_contents(what, units)
    with atomic_path(path, overwrite) as part, part.open("wb") as handle:
        scipy.io.savemat(handle, contents, oned_as="column", long_field_names=True)
        handle.seek(0)  # in place of the date: the same model gives the same bytes
        handle.write(f"MATLAB 5.0 MAT-file, written by gbid {__version__}".encode().ljust(_TEXT))
    return path


def linear_contents(what: LinearModel | FitResult, units: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the variables of the mat file of a model or fit; missing matrices are stored as empty."""
    model = what.linear_model if isinstance(what, FitResult) else what
    channels, in_metres = (*model.input_names, *model.output_names), getattr(what, "structure", "") in IN_METRES
    known = {name: "m" for name in channels if in_metres} | dict(units or {})
    unknown = sorted(set(known) - set(channels))
    if unknown:
        raise UsageError(
            f"model {model.name!r} has no channel {unknown[0]!r} to give a unit; choose from {', '.join(channels)}"
        )
    empty = np.zeros((0, 0))
    contents: dict[str, Any] = {
        "gbid_version": __version__,
        "name": model.name,
        **{letter: np.array(getattr(model, letter)) for letter in "ABCD"},
        "K": empty if model.K is None else np.array(model.K),
        "B_delayed": empty if model.B_delayed is None else np.array(model.B_delayed),
        "delay": np.zeros((0, 1)) if model.delay is None else np.array(model.delay)[:, None],
        "Ts": 0.0 if model.dt is None else model.dt,
        "InputName": cell(model.input_names),
        "OutputName": cell(model.output_names),
        "StateName": cell(model.state_names),
        "InputUnit": cell([known.get(name, "") for name in model.input_names]),
        "OutputUnit": cell([known.get(name, "") for name in model.output_names]),
        "InterSample": cell(model.holds() if model.dt is None else ()),
    }
    if isinstance(what, FitResult):
        contents |= {
            "structure": what.structure,
            "recordings": cell(what.recordings),
            "status": str(what.status),
            "success": what.success,
            "parameter_name": cell(list(what.parameters)),
            "parameter_value": np.array(list(what.parameters.values()), float),
            "parameter_std": np.array([what.std[name] for name in what.parameters], float),
            "parameter_unit": cell([what.units.get(name, "") for name in what.parameters]),
            "free": cell(what.free),
            "covariance": np.array(what.covariance),
            "initial_states": np.array(what.initial_states),
            "error_covariance": np.array(what.error_covariance),
            "fit_percent": np.array(what.fit_percent),
            "sample_time": what.sample_time,
        }
    return contents


def lpv_contents(model: LPVModel) -> dict[str, Any]:
    """Return the variables of the mat file of an LPV model."""
    return {
        "gbid_version": __version__,
        "name": model.name,
        "title": model.title,
        "source": model.source,
        "parameter_name": cell(KEY_PARAMETERS),
        "parameter_unit": cell([SI_UNITS[key.split("_")[0]] for key in KEY_PARAMETERS]),
        "terms": cell(TERMS),
        "coefficients": np.array([model.coefficients[key] for key in KEY_PARAMETERS]),
        "pressure_bar": np.array(model.domain.pressure_bar, float)[None, :],
        "speed_rpm": np.array(model.domain.speed_rpm, float)[None, :],
        "operating_points": np.array(model.operating_points, float).reshape(-1, 2),
        "actuators": dict(model.actuators) or np.zeros((0, 0)),
    }


def cell(texts: Sequence[str]) -> np.ndarray[Any, Any]:
    """Return texts as a MATLAB cell column."""
    return np.array(list(texts), dtype=object)[:, None]
