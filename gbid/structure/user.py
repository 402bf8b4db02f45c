"""Structures of users: loading from a Python file, checks, and functions of CasADi."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.errors import UsageError
from gbid.core.names import given_path
from gbid.discretise.exact import check_holds, delayed_taps, discretise, squarings_for
from gbid.structure.kinds import AnyStructure, equations_of, kind_of
from gbid.structure.linear import Structure, in_one_line, symbolic_matrices
from gbid.structure.models import LinearModel, check_sample_time
from gbid.structure.nonlinear import NonlinearStructure, first_steps, over_a_sample, symbolic_equations
from gbid.structure.parameter import as_vector, known_names
from gbid.structure.scheduling import ScheduledStructure

_REMEDY = "make it a gbid.LinearStructure or gbid.NonlinearStructure"


def load_structure(reference: str, folder: Path | None = None) -> AnyStructure:
    """Return the structure that a reference ``file.py:name`` names.

    Parameters
    ----------
    reference : str
        Python file and name in it: a structure, or a function without arguments that returns one.
    folder : pathlib.Path, optional
        Folder for a relative file name; the current folder when not given.

    Returns
    -------
    Structure
        The structure, after a check of the sizes of its equations.

    Raises
    ------
    UsageError
        When the file is missing, when its import fails, when it has no such name, or when its equations do not fit.
    """
    return not_a_model(load_structure_or_model(reference, folder), *python_file(reference, folder))


def not_a_model(loaded: AnyStructure | LinearModel, path: Path, name: str) -> AnyStructure:
    """Return a loaded structure; UsageError for a numeric model."""
    if isinstance(loaded, LinearModel):
        raise UsageError(f"{path}: {name} is not a structure; {_REMEDY}")
    return loaded


def load_structure_or_model(reference: str, folder: Path | None = None) -> AnyStructure | LinearModel:
    """Return the structure or numeric model that ``file.py:name`` names; see `load_structure`.

    Raises
    ------
    UsageError
        As `load_structure`, but for a `LinearModel`.
    """
    path, name = python_file(reference, folder)
    return structure_in(execute_file(path), path, name)


def python_file(reference: str, folder: Path | None = None) -> tuple[Path, str]:
    """Return the existing file and the name in a reference ``file.py:name``; else raise UsageError."""
    file, separator, name = reference.rpartition(":")
    if not separator or not file.endswith(".py"):
        raise UsageError(f"structure {reference!r}: write it as file.py:name")
    path = given_path((folder or Path()) / file)
    if not path.is_file():
        raise UsageError(f"structure {reference!r}: no file {path}")
    return path, name


def execute_file(path: Path) -> ModuleType:
    """Execute a Python file and return its module.

    The text of the file itself is compiled: a ``__pycache__`` beside it is neither read nor written.

    Raises
    ------
    UsageError
        When the file cannot be read, or its execution fails.
    """
    spec = importlib.util.spec_from_file_location(f"gbid_user_{path.stem}", path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        raise UsageError(f"{path}: import failed: {in_one_line(error)}") from error
    return module


def structure_in(module: ModuleType, path: Path, name: str) -> AnyStructure | LinearModel:
    """Return the named structure or model of an executed file; errors as for `load_structure_or_model`."""
    if not hasattr(module, name):
        raise UsageError(f"{path}: no name {name!r} in this file")
    loaded = getattr(module, name)
    if not isinstance(loaded, AnyStructure | LinearModel) and callable(loaded):
        loaded = called(loaded, f"{path}: {name}()")
    return loaded if isinstance(loaded, LinearModel) else checked(loaded, name, str(path))


def called(factory: Callable[..., Any], where: str, **options: Any) -> Any:
    """Return the result of a user's function; any exception becomes a UsageError."""
    try:
        return factory(**options)
    except (Exception, SystemExit) as error:
        raise UsageError(f"{where} failed: {in_one_line(error)}") from error


def checked(loaded: Any, name: str, where: str) -> AnyStructure:
    """Return a structure after a check of the sizes of its equations; refuse other objects.

    Raises
    ------
    UsageError
        When it is no structure, or when its equations do not fit; the text begins with `where`.
    """
    if not isinstance(loaded, AnyStructure):
        raise UsageError(f"{where}: {name} is not a structure; {_REMEDY}")
    try:
        kind_of(loaded).anatomy()
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error
    return loaded


# ---- CasADi functions of a structure: continuous model, discretised model, one-step predictor.

_HEADROOM = 2  # doublings of the matrix exponential beyond those at the given values: for four times faster poles


class ModelFunctions(NamedTuple):
    """CasADi functions of a structure, with named arguments ``f(x=..., u=..., p=...)``; a missing one is zero.

    Attributes
    ----------
    continuous : casadi.Function
        ``(x, u, e, p) -> (dx, y)``: derivatives of the states and outputs, with the prediction error e that the
        disturbance gain feeds back. With exact delays ``(x, u, u_delayed, e, p)``.
    discretised : casadi.Function
        ``(x, u, p) -> (x_next, y)``: the model over one sample. `u` is (n_inputs, lags + 2): its columns are the inputs
        at the samples k + 1, k, k - 1, ..., k - lags.
    predictor : casadi.Function
        ``(x, u, y, p) -> (x_next, yhat)``: the one-step predictor, with the measured outputs `y` at sample k.
    parameters : tuple of str
        Names of the entries of `p`.
    lags : int
        Number of past samples of the inputs that exact delays need; 0 without such delays.
    """

    continuous: ca.Function
    discretised: ca.Function
    predictor: ca.Function
    parameters: tuple[str, ...]
    lags: int


def casadi_functions(
    structure: AnyStructure,
    sample_time: float,
    *,
    values: Mapping[str, float] | None = None,
    intersample: str | Sequence[str] | None = None,
    steps: int | None = None,
) -> ModelFunctions:
    """Return the CasADi functions of a linear or nonlinear structure, with the parameters as an argument.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        The structure.
    sample_time : float
        Time between samples [s].
    values : dict of str to float, optional
        Values of parameters near which the discretised functions are accurate; others are the start values. The graph
        of a matrix exponential has a fixed number of doublings, and that of an exact delay a fixed number of samples.
    intersample : {"zoh", "foh"} or sequence, optional
        Inter-sample behaviour of the inputs; by default that of the structure.
    steps : int, optional
        Steps of the integrator in a sample, for nonlinear structures. By default those of the structure; for "auto" as
        many as the fastest pole at `values` needs.

    Returns
    -------
    ModelFunctions
        The functions.

    Raises
    ------
    UsageError
        When a value is missing or unknown, an exact delay is negative, or an option does not fit the structure.
    """
    check_sample_time(structure.name, sample_time)
    known_names(structure.parameters, values or {}, "values")
    known = {q.name: q.start for q in structure.parameters if q.start is not None} | dict(values or {})
    hold = structure.intersample if intersample is None else intersample
    structure = equations_of(structure)
    if isinstance(structure, ScheduledStructure):
        raise UsageError(f"{structure.name}: its matrices change on the way; give its base, structure.base")
    if isinstance(structure, NonlinearStructure):
        return _of_nonlinear(structure, sample_time, known, hold, steps)
    if steps is not None:
        raise UsageError(f"steps = {steps}: structure {structure.name!r} is linear, and discretised exactly")
    return _of_linear(structure, sample_time, known, hold)


def _of_nonlinear(
    structure: NonlinearStructure,
    sample_time: float,
    values: Mapping[str, float],
    hold: str | Sequence[str],
    steps: int | None,
) -> ModelFunctions:
    equations = symbolic_equations(structure)
    if steps is None:
        steps = first_steps(structure, as_vector(structure, values), sample_time)
    n_u, holds = equations.u.numel(), check_holds(hold, equations.u.numel())
    shifts = [0] * n_u  # samples in the delay of each input
    if equations.delayed:
        delays = ca.Function("d", [equations.p], [ca.densify(equations.delay)])(as_vector(structure, values))
        shifts = [int(shift) for shift in np.floor(np.array(delays, float).ravel() / sample_time)]
    early = [equations.delay[i] / sample_time - shifts[i] if i in equations.delayed else None for i in range(n_u)]
    lags = max((shifts[i] + 1 for i in equations.delayed), default=0)
    u, y, e = ca.SX.sym("u", n_u, lags + 2), ca.SX.sym("y", equations.y.numel()), ca.SX.sym("e", equations.y.numel())
    derivative, point = equations.dx + equations.K @ e, [equations.x, equations.u]
    if equations.delayed:
        u_delayed = ca.SX.sym("u_delayed", n_u)
        acting = ca.vertcat(*(u_delayed[i] if i in equations.delayed else equations.u[i] for i in range(n_u)))
        (derivative,) = ca.substitute([derivative], [equations.u], [acting])
        point.append(u_delayed)
    (output,) = ca.substitute([equations.y], [equations.u], [u[:, 1]])
    around = [
        u[i, shifts[i] : shifts[i] + 3] if i in equations.delayed else ca.horzcat(u[i, :2], 0) for i in range(n_u)
    ]

    def after(error: ca.SX) -> ca.SX:
        at, under = ca.SX.sym("at", equations.x.numel()), ca.SX.sym("under", n_u)  # `error` is that at the sample
        (at_error,) = ca.substitute([equations.dx], [ca.vertcat(equations.x, equations.u)], [ca.vertcat(at, under)])
        f = ca.Function("f", [at, under], [ca.densify(at_error + equations.K @ error)], {"allow_free": True})
        taps = ca.vertcat(*around) if around else ca.SX(0, 3)
        return over_a_sample(structure.integrator, f, equations.x, taps, holds, early, ca.SX(sample_time), steps)

    return _named(
        structure,
        ([*point, e, equations.p], [derivative, equations.y + e]),
        ([equations.x, u, equations.p], [after(ca.SX(equations.y.numel(), 1)), output]),
        ([equations.x, u, y, equations.p], [after(y - output), output]),
        lags,
    )


def _of_linear(
    structure: Structure, sample_time: float, values: Mapping[str, float], hold: str | Sequence[str]
) -> ModelFunctions:
    p, m = symbolic_matrices(structure)
    if m.feedback is not None:
        raise UsageError(f"structure {structure.name!r}: its controller runs in samples; give the plant alone")
    n, n_u, n_y = m.A.shape[0], m.B.shape[1], m.C.shape[0]
    holds = check_holds(hold, n_u)
    numbers = as_vector(structure, values)
    A = np.array(ca.Function("A", [p], [ca.densify(m.A)])(numbers), float)
    delays = np.array(ca.Function("d", [p], [ca.densify(m.delay)])(numbers), float).ravel()
    squarings = squarings_for([A * sample_time]) + _HEADROOM
    F, now, following = discretise(m.A, ca.horzcat(m.B, m.K), sample_time, [*holds, *["zoh"] * n_y], squarings)
    taps = [
        delayed_taps(m.A, m.B_delayed[:, i], m.delay[i], sample_time, holds[i], near=(float(delays[i]), squarings))
        for i in range(n_u * m.has_delay)
    ]
    lags = max((each.shift + 1 for each in taps), default=0)
    x, e, y = ca.SX.sym("x", n), ca.SX.sym("e", n_y), ca.SX.sym("y", n_y)
    held, u_delayed, u = ca.SX.sym("u", n_u), ca.SX.sym("u_delayed", n_u), ca.SX.sym("u", n_u, lags + 2)
    output = m.C @ x + m.D @ u[:, 1]
    plain = F @ x + now[:, :n_u] @ u[:, 1] + following[:, :n_u] @ u[:, 0]
    for i, each in enumerate(taps):
        for j, column in enumerate(each.columns):  # of the samples k - shift + 1, k - shift, k - shift - 1
            if each.shift + j or holds[i] == "foh":
                plain += column * u[i, each.shift + j]
    point, delayed = [x, held], [u_delayed] if m.has_delay else []
    derivative = m.A @ x + m.B @ held + (m.B_delayed @ u_delayed if delayed else 0) + m.K @ e
    return _named(
        structure,
        ([*point, *delayed, e, p], [derivative, m.C @ x + m.D @ held + e]),
        ([x, u, p], [plain, output]),
        ([x, u, y, p], [plain + now[:, n_u:] @ (y - output), output]),
        lags,
    )


def _named(
    structure: AnyStructure, continuous: _Graph, discretised: _Graph, predictor: _Graph, lags: int
) -> ModelFunctions:
    delayed = ["u_delayed"] if len(continuous[0]) > 4 else []
    given = {
        "continuous": (continuous, ["x", "u", *delayed, "e", "p"], ["dx", "y"]),
        "discretised": (discretised, ["x", "u", "p"], ["x_next", "y"]),
        "predictor": (predictor, ["x", "u", "y", "p"], ["x_next", "yhat"]),
    }
    continuous_f, discretised_f, predictor_f = (
        ca.Function(name, arguments, [ca.densify(each) for each in results], names_in, names_out, {"cse": True})
        for name, ((arguments, results), names_in, names_out) in given.items()
    )
    return ModelFunctions(continuous_f, discretised_f, predictor_f, tuple(q.name for q in structure.parameters), lags)


_Graph = tuple[list[ca.SX], list[ca.SX]]
