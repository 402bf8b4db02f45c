"""MATLAB function that builds ss and idss objects from a mat file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from gbid._version import __version__
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path, with_text_checksum
from gbid.core.names import given_path, one_line
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.lpv.model import TERMS
from gbid.lpv.model_file import SI_UNITS
from gbid.structure import KEY_PARAMETERS, LinearModel

_LOAD = "data = load(fullfile(fileparts(mfilename('fullpath')), '{name}.mat'));"


def linear_function(name: str, what: LinearModel | FitResult) -> str:
    """Return the text of the MATLAB function of a model or fit."""
    model = what.linear_model if isinstance(what, FitResult) else what
    with_idss = model.K is not None
    lines = [
        f"function {'[sys, fitted]' if with_idss else 'sys'} = {name}()",
        f"%{name.upper()}  {one_line(model.name)}",
        f"%   sys = {name}() gives the model as ss, in SI units.",
    ]
    if with_idss:
        lines.append(f"%   [sys, fitted] = {name}() also gives it as idss, with the disturbance gain K.")
    lines += [f"%   Written by gbid {__version__}. Needs the Control System Toolbox."]
    lines += ["", _LOAD.format(name=name), *_state_space(model)]
    lines += [
        "sys.InputName = data.InputName;",
        "sys.OutputName = data.OutputName;",
        "sys.StateName = data.StateName;",
        "sys.InputUnit = data.InputUnit;",
        "sys.OutputUnit = data.OutputUnit;",
        "sys.Name = data.name;",
    ]
    if with_idss:
        lines += ["", "if nargout > 1", *(f"    {line}" for line in _idss(model)), "end"]
    return "\n".join([*lines, "end", ""])


def inputs_are_only_late(model: LinearModel) -> bool:
    """Return whether no input acts both directly and with delay, so that an input delay describes the model."""
    if model.B_delayed is None:
        return True
    return not any(
        model.B_delayed[:, i].any() and (model.B[:, i].any() or model.D[:, i].any()) for i in range(model.B.shape[1])
    )


def _state_space(model: LinearModel) -> list[str]:
    if model.B_delayed is None:
        return ["sys = ss(data.A, data.B, data.C, data.D, data.Ts);"]
    if inputs_are_only_late(model):
        return [
            "sys = ss(data.A, data.B + data.B_delayed, data.C, data.D, data.Ts);",
            "sys.InputDelay = data.delay .* any(data.B_delayed, 1)';",
        ]
    return [
        "% Inputs enter at once and late: two copies of each, then fed by one; the delays become internal.",
        "n = size(data.B, 2);",
        "sys = ss(data.A, [data.B, data.B_delayed], data.C, [data.D, zeros(size(data.D))], data.Ts);",
        "sys.InputDelay = [zeros(n, 1); data.delay];",
        "sys = sys * [eye(n); eye(n)];",
    ]


def _idss(model: LinearModel) -> list[str]:
    names = [
        "fitted.InputName = data.InputName;",
        "fitted.InputUnit = data.InputUnit;",
    ]
    if model.B_delayed is None:
        build = ["fitted = idss(data.A, data.B, data.C, data.D, data.K, zeros(size(data.A, 1), 1), data.Ts);"]
    elif inputs_are_only_late(model):
        build = [
            "B = data.B + data.B_delayed;",
            "fitted = idss(data.A, B, data.C, data.D, data.K, zeros(size(data.A, 1), 1), data.Ts);",
            "fitted.InputDelay = data.delay .* any(data.B_delayed, 1)';",
        ]
    else:
        build = [
            "% idss has no internal delays: it takes each input twice, the second one late. Give it data [u, u].",
            "B = [data.B, data.B_delayed];",
            "D = [data.D, zeros(size(data.D))];",
            "fitted = idss(data.A, B, data.C, D, data.K, zeros(size(data.A, 1), 1), data.Ts);",
            "fitted.InputDelay = [zeros(n, 1); data.delay];",
        ]
        names = [
            "fitted.InputName = [data.InputName; strcat(data.InputName, '_late')];",
            "fitted.InputUnit = [data.InputUnit; data.InputUnit];",
        ]
    others = [f"fitted.{field} = data.{field};" for field in ("OutputName", "StateName", "OutputUnit")]
    return [*build, *names, *others, "fitted.Name = data.name;"]


def lpv_function(name: str, model: LPVModel) -> str:
    """Return the text of the MATLAB function of an LPV model.

    The function evaluates Eq. 16 and builds Eqs. 19 and 20 with exact delays.
    """
    known = bool(model.actuators)
    outputs = "[bearing, plant, values]" if known else "[bearing, values]"
    lines = [
        f"function {outputs} = {name}(pressure_bar, speed_rpm)",
        f"%{name.upper()}  {one_line(model.title or model.name)}",
        f"%   bearing = {name}(6, 0) gives the model at 6 bar and 0 rpm as ss, from u to p [m], with exact delays.",
    ]
    if known:
        lines.append(f"%   [bearing, plant] = {name}(6, 0) also gives it behind the actuators, from r to p.")
    lines += [
        f"%   {outputs} = {name}(6, 0) also gives the key parameters, in SI per kg.",
        f"%   Written by gbid {__version__}. Needs the Control System Toolbox.",
        "",
        _LOAD.format(name=name),
        "for check = {{'pressure_bar', pressure_bar, data.pressure_bar}, {'speed_rpm', speed_rpm, data.speed_rpm}}",
        "    [what, value, range] = check{1}{:};",
        "    if ~(value >= range(1) && value <= range(2))",
        "        error('gbid:domain', '%s = %g lies outside %g to %g', what, value, range(1), range(2));",
        "    end",
        "end",
        "P = pressure_bar;",
        "W = speed_rpm;",
        "numbers = data.coefficients * [1; P; W; W*P; P^2; W^2];",
        "values = cell2struct(num2cell(numbers), data.parameter_name, 1);",
        "v = values;",
        "if v.tau_x <= 0 || v.tau_y <= 0",
        "    error('gbid:delay', 'a delay is not positive at %g bar, %g rpm', P, W);",
        "end",
        "K = [v.k_xx, v.k_xy; v.k_yx, v.k_yy];",
        "D = [v.d_xx, v.d_xy; v.d_yx, v.d_yy];",
        "B = [v.b_xx, v.b_xy; v.b_yx, v.b_yy];",
        "bearing = ss([zeros(2), eye(2); K, D], [zeros(2); B], [eye(2), zeros(2)], zeros(2));",
        "bearing.InputDelay = [v.tau_x; v.tau_y];",
        "bearing.InputName = {'u_x'; 'u_y'};",
        "bearing.OutputName = {'p_x'; 'p_y'};",
        "bearing.InputUnit = {'m'; 'm'};",
        "bearing.OutputUnit = {'m'; 'm'};",
        "bearing.Name = sprintf('%s at %g bar, %g rpm', data.name, P, W);",
    ]
    if known:
        lines += [
            "",
            "a = data.actuators;",
            "x = zpk([], [-a.p1_x, -a.p2_x], a.kappa_x * a.p1_x * a.p2_x);",
            "y = zpk([], [-a.p1_y, -a.p2_y], a.kappa_y * a.p1_y * a.p2_y);",
            "plant = bearing * ss(append(x, y));",
            "plant.InputName = {'r_x'; 'r_y'};",
            "plant.InputUnit = {'m'; 'm'};",
            "plant.Name = bearing.Name;",
        ]
    return "\n".join([*lines, "end", ""])


# ---- Export of models to MATLAB: a mat file with the numbers, and a function that builds the objects.

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
