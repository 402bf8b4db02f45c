"""Export of models to MATLAB: a mat file with the numbers, and a function that builds the objects."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from gbid._version import __version__
from gbid.atomic import atomic_path
from gbid.errors import UsageError
from gbid.files.text_checksum import with_text_checksum
from gbid.identify import FitResult
from gbid.interchange.m_file import linear_function, lpv_function
from gbid.lpv import LPVModel
from gbid.lpv.basis import TERMS
from gbid.lpv.model_file import SI_UNITS
from gbid.naming.paths import given_path
from gbid.structure import KEY_PARAMETERS, LinearModel

Exportable = LinearModel | FitResult | LPVModel
"""Types that can be exported to other programs."""

_IN_METRES = ("rotor_bearing", "piezo_pair", "plant")
_MATLAB_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


def save_mat(
    what: Exportable, path: str | Path, *, units: Mapping[str, str] | None = None, overwrite: bool = False
) -> list[Path]:
    """Write a model for MATLAB, and return the paths of the files.

    The numbers are in a .mat file. A function of the same name beside it builds the model. In MATLAB ``sys = NAME()``
    returns an ``ss`` with names, units, sample time and exact delays. For a fit with disturbance gain
    ``[sys, fitted] = NAME()`` also returns an ``idss`` with K. For an LPV model
    ``[bearing, plant] = NAME(pressure_bar, speed_rpm)`` returns the models at one operating point.

    Parameters
    ----------
    what : LinearModel, FitResult or LPVModel
        The model to export.
    path : path
        The mat file. Its name must be a valid name of a MATLAB function, as ``bearing_6bar.mat``.
    units : dict of str to str, optional
        Unit of each channel by its name. LPV models and fits of the structures of gbid are in metres.
    overwrite : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of pathlib.Path
        The mat file and the m file.

    Raises
    ------
    UsageError
        When one of the files exists and `overwrite` is not set, or when the name is not valid in MATLAB.
    DataError
        When the files cannot be written.
    """
    path = given_path(path)
    if path.suffix != ".mat":
        raise UsageError(f"{path}: a MATLAB data file ends in .mat")
    name, function = path.stem, path.with_suffix(".m")
    if not _MATLAB_NAME.fullmatch(name):
        raise UsageError(
            f"{path}: {name!r} is not a valid name of a MATLAB function; use letters, digits and '_' only, "
            "and begin with a letter"
        )
    for file in (path, function):
        if file.exists() and not overwrite:
            raise UsageError(f"{file} exists already; choose another name or ask for overwriting")
    if isinstance(what, LPVModel):
        contents, text = lpv_contents(what), lpv_function(name, what)
    else:
        contents, text = linear_contents(what, units), linear_function(name, what)
    with atomic_path(path, overwrite) as part, part.open("wb") as handle:
        savemat(handle, contents, oned_as="column", long_field_names=True)
    with atomic_path(function, overwrite) as part:
        part.write_bytes(with_text_checksum(text, function.suffix).encode())
    return [path, function]


def linear_contents(what: LinearModel | FitResult, units: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the variables of the mat file of a model or fit; missing matrices are empty."""
    model = what.linear_model if isinstance(what, FitResult) else what
    own = isinstance(what, FitResult) and what.structure in _IN_METRES
    known = {name: "m" for name in (*model.input_names, *model.output_names) if own} | dict(units or {})
    unknown = sorted(set(known) - {*model.input_names, *model.output_names})
    if unknown:
        there = ", ".join((*model.input_names, *model.output_names))
        raise UsageError(f"model {model.name!r} has no channel {unknown[0]!r} to give a unit; there is {there}")
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
    out = np.empty((len(texts), 1), dtype=object)
    for i, text in enumerate(texts):
        out[i, 0] = text
    return out
