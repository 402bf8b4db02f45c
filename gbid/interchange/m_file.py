"""MATLAB function that builds ss and idss objects from a mat file."""

from __future__ import annotations

from gbid._version import __version__
from gbid.identify import FitResult
from gbid.lpv import LPVModel
from gbid.naming.escape import one_line
from gbid.structure import LinearModel

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
