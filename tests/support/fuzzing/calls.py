"""Calls of all public names of gbid with wrong arguments, found by introspection: each ends in gbid's own error.

A valid call of each name of `gbid` is known; each argument in turn gets each wrong value. Functions and classes
that only the packages list are called with wrong values alone. Left out are `gbid.discretise`, whose arithmetic leaves
shapes to its callers, and arguments of packages that may be anything by their annotation.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import inspect
import io
import json
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import stored_values
from fit_cases import MODE, MODE_AT, levels, simulated
from gain_problems import oscillator
from still_rig import EXACT, FIXED, recorded

import gbid
from gbid.control.tuning.plants import TuneOptions
from gbid.core.errors import GbidError

PACKAGES = (
    "control",
    "excite",
    "export",
    "identify",
    "lpv",
    "prefilter",
    "recording",
    "report",
    "rig",
    "structure",
    "validate",
)
SAMPLE_TIME = 1e-3
_HANG = 30  # longest time [s] of a call; then the alarm ends the run


class WrongCall(NamedTuple):
    """One call: the public name, the argument that is wrong, and which of `wrong_values` it gets."""

    name: str
    argument: str
    value: str


class SilentlyAcceptedError(AssertionError):
    """A call whose argument its annotation does not allow was accepted."""


@cache
def _fit() -> Any:
    return gbid.fit(MODE, simulated(MODE, MODE_AT, levels(200), noise=0.3))


@cache
def _controller_file() -> tuple[str, ...]:
    folder = tempfile.mkdtemp()
    gbid.save_controller(f"{folder}/p.yaml", "P", {"kappa_x": 1.0, "kappa_y": 0.9}, sample_time=2e-4)
    gbid.save(_fit(), f"{folder}/fit.h5")
    gbid.save_recording(stored_values.recording(), f"{folder}/recording.h5")
    gbid.save(stored_values.fit_table(), f"{folder}/table.h5")
    gbid.save(stored_values.lpv_fit(), f"{folder}/lpv.h5")
    Path(f"{folder}/a.csv").write_text("t,a\n" + "".join(f"{k / 1000},{k % 7}\n" for k in range(60)))
    return (folder,)


@cache
def valid_calls() -> dict[str, dict[str, Any]]:
    """Return the arguments of a quick valid call of each public name; a file is written to the name ``{folder}``."""
    random = np.random.default_rng(1)
    (files,) = _controller_file()
    data, result, lpv = simulated(MODE, MODE_AT, levels(200), noise=0.3), _fit(), gbid.load_model("theisen2016")
    other = simulated(MODE, MODE_AT, levels(200, seed=3), noise=0.3, name="other")
    plant, loop = lpv.plant_at(6.0, 0.0), gbid.control.p_controller(1.0, 0.9)
    t = SAMPLE_TIME * np.arange(3000)
    angle = (2 * np.pi * 60 * t)[:, None]
    turning = gbid.Recording(
        {
            "p": 1e-6 * np.hstack([np.cos(angle), np.sin(angle)]) + 1e-8 * random.normal(size=(3000, 2)),
            "phi": angle % (2 * np.pi),
        },
        SAMPLE_TIME,
        {"pressure_bar": 5.0, "speed_rpm": 3600.0},
        "turning",
        {"p": "m", "phi": "rad"},
    )
    steps = np.repeat(1e-6 * np.array([0, -2, -1, 0, 1, 2, 1, 0, -1, -2, 0.0]), 800)
    stairs = gbid.Recording(
        {
            name: np.stack([gain * steps, 0.0 * steps], 1) + 1e-9 * random.normal(size=(8800, 2))
            for name, gain in (("r", 1.0), ("u", 0.9), ("p", 0.5))
        },
        SAMPLE_TIME,
        {},
        "stairs",
        {"r": "m", "u": "m", "p": "m"},
    )
    decay = np.exp(-20 * t) * np.sin(600 * t)
    decay[:50] = 0.0
    hit = np.where((t > 0.05) & (t < 0.053), 8.0 * np.sin((t - 0.05) / 3e-3 * np.pi), 0.0)
    struck = gbid.Recording(
        {"p": 1e-6 * np.stack([np.roll(decay, 1), 0.1 * decay], 1), "f": np.stack([hit, 0 * hit], 1)},
        2e-4,
        {"pressure_bar": 5.0, "speed_rpm": 0.0},
        "struck",
        {"p": "m", "f": "N"},
    )
    gain = ca.SX.sym("g")
    gains = {"kappa_x": 1.0, "kappa_y": 0.9}
    points = [(6.0, 0.0)]
    tuned = {f.name: f.default for f in fields(TuneOptions) if f.init and not f.name.startswith("_")}
    known = gbid.excite.KnownModel(MODE, MODE_AT, np.eye(1))
    runout = gbid.identify_runout(turning, harmonics=2, still=1e-3)
    scores = gbid.validate.cross_validate_many([result], [other])
    dynamics = (lambda x, u, p: ca.vertcat(-p.a * x[0] + u[0]), lambda x, u, p: x)
    rig_data = [recorded((5.0, 6000.0), 0, n=200)]
    objects = {
        "ExcitationLimits": gbid.excite.ExcitationLimits({"u": 1.0}),
        "KnownModel": known,
        "LPVModel": lpv,
        "LinearModel": plant,
        "Parameter": gbid.Parameter("k", 1.0, 0.0, 2.0),
        "PiezoPair": gbid.PiezoPair(),
        "Plant": gbid.Plant(),
        "Recording": data,
        "RotorBearing": gbid.RotorBearing(),
        "Uncertainty": gbid.Uncertainty(np.eye(84)),
    }
    calls: dict[str, dict[str, Any]] = {
        name: {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        if is_dataclass(value)
        else dict(value._asdict())
        for name, value in objects.items()
    }
    return calls | {
        "ClosedLoop": {
            "structure": MODE,
            "controller": gbid.LinearModel(-np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1))),
        },
        "LinearStructure": {"name": "s", "parameters": MODE.parameters, "matrices": MODE.matrices},
        "NonlinearStructure": {
            "name": "s",
            "parameters": [gbid.Parameter("a", 1.0)],
            "states": "x",
            "dynamics": dynamics[0],
            "output": dynamics[1],
        },
        "OnlinePrefilter": {"runout_map": None},
        "align_index": {"runout_map": runout, "recording": turning, "orders": 2},
        "assess": {"model": lpv, "controller": "P", "gains": gains, "points": points, "sample_time": 2e-4},
        "casadi_functions": {"structure": MODE, "sample_time": 0.1},
        "characterise_piezo": {"recording": stairs, "command_channel": "x", "channel": "x"},
        "characterise_staircase": {"recordings": stairs},
        "check_residuals": {"result": result, "recording": data},
        "close_loop": {"plant": plant, "controller": loop},
        "compare_designs": {
            "assessments": [gbid.assess(lpv, "P", gains, points, name=name, sample_time=2e-4) for name in "ab"]
        },
        "compare_runout": {"recordings": turning, "harmonics": (1, 2), "bins": (25,), "folds": 2, "still": 1e-3},
        "controller_structure": {"kind": "P", "lowpass_hz": 1000.0, "order": 1},
        "cross_validate": {"result": result, "recording": data},
        "cross_validate_many": {"results": [result], "recordings": [other]},
        "design_excitation": {
            "model": known,
            "duration": 20.0,
            "sample_time": 0.1,
            "limits": {"u": 1.0},
            "kind": "prbs",
        },
        "estimate_delay": {"recording": data},
        "fit": {"structure": MODE, "recordings": data, "max_iterations": 3},
        "fit_problem": {"structure": MODE, "recordings": data},
        "fit_lpv": {"fits": stored_values.lpv_fit().estimates, "structure": None, "order": 0},
        "fit_lpv_direct": {
            "recordings": rig_data,
            "start": lpv,
            "structure": EXACT,
            "fixed": FIXED,
            "scatter": False,
            "max_iterations": 1,
        },
        "fit_multistart": {"structure": MODE, "recordings": data, "starts": 1, "max_iterations": 2},
        "fit_ringdown": {"recordings": struck, "axis": "x", "lags": 6, "harmonics": 0},
        "from_ross": {"rotor": None, "sensors": [0], "actuators": [0]},
        "identify_runout": {"recordings": turning, "harmonics": 2, "still": 1e-3},
        "import_recording": {
            "path": f"{files}/a.csv",
            "mapping": {"sample_time": 1e-3, "signals": {"y": {"columns": ["a"], "unit": "m"}}},
        },
        "load": {"path": f"{files}/recording.h5"},
        "load_controller": {"path": f"{files}/p.yaml"},
        "load_model": {"name_or_path": "theisen2016"},
        "load_recording": {"path": f"{files}/recording.h5"},
        "lpv_of": {"result": result},
        "maximise_damping": {
            "A_of_gains": ca.Function("A", [gain], [oscillator(gain)]),
            "gains": ["g"],
            "lower": 0.0,
            "upper": 0.5,
            "objective": "decay",
            "evaluations": 50,
        },
        "measured_response": {"recordings": data, "inputs": "u", "outputs": "y", "resolution_hz": 0.5},
        "nominal_actuator": {"models": [result] * 3},
        "pareto": {"model": lpv, "caps": [2.6], "operating_points": points, "starts": 1},
        "prefilter": {"rec": turning},
        "profile": {"result": result, "names": ["g"]},
        "save": {"value": stored_values.recording(), "path": "{folder}/a.h5"},
        "save_controller": {"path": "{folder}/a.yaml", "controller": "P", "gains": gains, "sample_time": 2e-4},
        "save_csv": {"what": plant, "path": "{folder}/a.csv"},
        "save_mat": {"what": plant, "path": "{folder}/a.mat"},
        "save_recording": {"rec": data, "path": "{folder}/a.h5"},
        "scheduled": {"structure": MODE, "scheduling": "speed_rpm", "order": 1},
        "sensitivities": {"plant": plant, "controller": loop},
        "summarise": {"scores": scores},
        "tune": {"model": lpv, "controller": "P", **tuned, "operating_points": points, "starts": 1},
        "validate_impact": {"recording": struck, "plant": plant},
        "with_pade": {"model": plant, "order": 1},
        "with_unbalance": {"recording": turning},
    }


@cache
def wrong_values() -> dict[str, Any]:
    """Return values that most arguments must refuse, by a word for each."""
    lpv = gbid.load_model("theisen2016")
    return {
        "None": None,
        "text": "voltage",
        "empty text": "",
        "nan": float("nan"),
        "inf": float("inf"),
        "minus": -1.0,
        "minus one": -1,
        "zero": 0,
        "huge": 10**400,
        "half": 0.5,
        "complex": 1j,
        "flag": True,
        "dict": {},
        "named dict": {"a": 3},
        "list": [],
        "list of None": [None],
        "list of text": ["voltage"],
        "numbers": [1.0, 2.0, 3.0],
        "pairs": [(0.1, 0.2)],
        "array": np.ones((2, 3)),
        "array of nan": np.full((2, 2), np.nan),
        "cube": np.zeros((1, 2, 3)),
        "object": object(),
        "function": len,
        "class": gbid.RotorBearing,
        "bytes": b"x",
        "recording": stored_values.recording(),
        "model": lpv.plant_at(6.0, 0.0),
        "lpv": lpv,
        "structure": gbid.RotorBearing(),
        "fit": _fit(),
    }


def public_calls() -> list[WrongCall]:
    """Return all calls: every argument of every public name with every wrong value."""
    return package_calls() + [
        WrongCall(name, argument, value)
        for name, function in _public()
        if "." not in name or _arguments(name)
        for argument in dict.fromkeys([*(p.name for p in _named(function)), *_arguments(name)])
        for value in wrong_values()
    ]


def _arguments(name: str) -> dict[str, Any]:
    """Return the arguments of the valid call of a name of gbid or of a package; empty without one."""
    package, _, own = name.rpartition(".")
    return {} if package and own in gbid.__all__ else valid_calls().get(own, {})


def _named(function: Any) -> list[inspect.Parameter]:
    """Return the parameters of a function that have a name."""
    return [p for p in _parameters(function) if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]


def package_calls() -> list[WrongCall]:
    """Return the calls of names that only packages list, which need no valid call: every required argument is wrong."""
    return [
        WrongCall(name, argument.name, value)
        for name, function in _public()
        if "." in name and not _arguments(name)
        for argument in _parameters(function)
        if argument.default is argument.empty
        and argument.kind is argument.POSITIONAL_OR_KEYWORD
        and argument.annotation != "Any"
        for value in wrong_values()
    ]


def _public() -> Iterator[tuple[str, Any]]:
    """Yield the public callables: those of gbid by their names, those of packages alone with the package's."""
    modules = [("", gbid), *((f"{name}.", importlib.import_module(f"gbid.{name}")) for name in PACKAGES)]
    known = set()
    for prefix, module in modules:
        for name in module.__all__:
            value = getattr(module, name)
            plain = inspect.unwrap(value) if callable(value) else value
            is_called = inspect.isfunction(value) or (inspect.isclass(value) and _checks(value))
            if is_called and plain not in known:
                known.add(plain)
                yield prefix + name, value


def _checks(kind: type) -> bool:
    """Return whether a class checks what it is made of: options and values of the user do, results of gbid do not."""
    made = [vars(base).get(name) for base in kind.__mro__ for name in ("__init__", "__post_init__")]
    named = {name for each in made if inspect.isfunction(each) for name in each.__code__.co_names}
    return bool(named & {"check_options", "check_call"}) and not inspect.isabstract(kind)


def _parameters(function: Any) -> list[inspect.Parameter]:
    try:
        return list(inspect.signature(function).parameters.values())
    except ValueError:  # a dict that gives its keys as attributes
        return []


def try_call(call: WrongCall, folder: Path) -> str:
    """Make a call and return its end: the text of gbid's error, or "" when it was accepted.

    Raises
    ------
    SilentlyAcceptedError
        Where the annotation of the argument has no place for the value.
    Exception
        Whatever is raised that is no error of gbid.
    """
    package, _, name = call.name.rpartition(".")
    function = getattr(importlib.import_module(f"gbid.{package}" if package else "gbid"), name)
    value = wrong_values()[call.value]
    arguments = dict(_arguments(call.name)) or dict.fromkeys(
        (
            p.name
            for p in _parameters(function)
            if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
        ),
        value,
    )
    arguments[call.argument] = value
    for key, each in arguments.items():
        if type(each) is str:
            arguments[key] = each.replace("{folder}", str(folder))
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), _inside(folder):
            warnings.simplefilter("ignore")
            first = [
                p.name for p in _parameters(function) if p.kind is p.POSITIONAL_OR_KEYWORD and p.name in arguments
            ][:1]
            positional = [arguments.pop(key) for key in first]  # a singledispatch function takes it by position alone
            function(*positional, **arguments)
    except GbidError as error:
        return str(error) or "an empty text"
    except Exception:
        if callable(value) and not isinstance(value, gbid.LinearModel):  # a function of the user, called as one
            return "an error of the given function"
        raise
    if not may_be_accepted(function, call.argument, value):
        raise SilentlyAcceptedError(f"{call.name}({call.argument}={value!r})"[:300])
    return ""


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """Work in a folder, so that a text taken as a path writes there."""
    with contextlib.chdir(folder):
        yield
    for path in folder.iterdir():
        if path.is_file():
            path.unlink()


_SIMPLE: dict[str, Callable[[Any], bool]] = {
    "None": lambda value: value is None,
    "str": lambda value: isinstance(value, str),
    "Path": lambda value: isinstance(value, Path),
    "float": lambda value: isinstance(value, int | float) and not isinstance(value, bool),
    "int": lambda value: isinstance(value, int) and not isinstance(value, bool),
    "bool": lambda value: isinstance(value, bool),
    "LinearModel": lambda value: isinstance(value, gbid.LinearModel),
    "FitResult": lambda value: isinstance(value, gbid.FitResult),
    "Recording": lambda value: isinstance(value, gbid.Recording),
    "LPVModel": lambda value: isinstance(value, gbid.LPVModel),
}


def may_be_accepted(function: Any, argument: str, value: Any) -> bool:
    """Return whether the words of an annotation have a place for a value; those that are not simple have.

    Read from the text of the annotation, so that it does not rest on the check that it tries.
    """
    parameter = {p.name: p for p in _parameters(function)}.get(argument)
    words = [word.strip() for word in str(parameter.annotation if parameter else "Any").split("|")]
    is_constructor = inspect.isclass(function)  # a result may say nan for what is not known
    if isinstance(value, float) and np.isnan(value) and not is_constructor and set(words) <= {"float", "int", "None"}:
        return False
    return any(word not in _SIMPLE or _SIMPLE[word](value) for word in words)


def main() -> int:
    """Make calls drawn at random, print what came of them, and return 1 when one of them found a fault."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="begin of the name")
    given = parser.parse_args()
    calls = [call for call in public_calls() if call.name.startswith(given.only)]
    chosen = Random(given.seed).sample(calls, min(given.count, len(calls)))
    ends: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for call in chosen:
            signal.alarm(_HANG)
            try:
                end = "refused with a clear error" if try_call(call, Path(folder)) else "accepted"
            except Exception as error:
                end = "silently accepted" if isinstance(error, SilentlyAcceptedError) else "traceback"
                text = f"{'.'.join(call[:2])} = {call.value}: {type(error).__name__}: {str(error)[:200]!r}\n"
                sys.stderr.write(text)
            signal.alarm(0)
            ends[end] += 1
    names = len({call.name for call in calls})
    print(json.dumps({"names": names, "calls": len(chosen), "of": len(calls), "ends": ends}, indent=1))  # noqa: T201
    return int(bool(ends["traceback"] + ends["silently accepted"]))


if __name__ == "__main__":
    sys.exit(main())
