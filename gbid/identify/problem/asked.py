"""Extra cost and constraints that a caller writes with CasADi, as terms of the problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.identify.data import FitData
from gbid.identify.options import FitArguments
from gbid.identify.problem.assemble import Assembly
from gbid.identify.problem.nlp import ExtraTerms, PlacedTerms, Shooting, compiled_terms
from gbid.identify.problem.states import InitialStates
from gbid.structure import Parameter, Values
from gbid.structure.linear import in_one_line

_NEAR = 1e-4  # of the size of a constraint


def with_extra_terms(
    problem: Shooting,
    assembly: Assembly,
    data: FitData,
    states: InitialStates,
    parameters: Sequence[Parameter],
    start: FloatArray,
    options: FitArguments,
) -> Shooting:
    """Return a problem with the extra cost and the constraints of a caller.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    assembly, data, states
        Its assembly, recordings and initial states.
    parameters : sequence of Parameter
        Parameters of the structure; fixed ones are numbers in the expressions.
    start : (n_unknowns,) array
        Start, scaled; there the size of each constraint is taken.
    options : FitArguments
        Options with the extra cost and the constraints.

    Raises
    ------
    UsageError
        When a function fails, or returns what is no expression in the parameters and initial states.
    """
    extra_cost, constraints = options.extra_cost, options.constraints
    if extra_cost is None and constraints is None:
        return problem
    theta = [ca.SX.sym(q.name) for q in assembly.free]
    n, released = problem.n_states, states.released
    columns = {r.name: ca.SX.sym(f"x0[{r.name}]", n) for r in data.records}
    p = Values({q.name: ca.SX(q.start) for q in parameters if q.fixed and q.start is not None})
    p |= {q.name: symbol for q, symbol in zip(assembly.free, theta, strict=True)}
    x0 = dict(columns)
    for row, record in zip(states.shooting, data.records, strict=True):
        given = ca.SX(x0[record.name])
        for i in np.flatnonzero(~np.isnan(row)):
            given[int(i)] = ca.SX(row[i])
        x0[record.name] = given[: assembly.n_states]
    for name, row in zip(x0, released, strict=True):
        for i in np.flatnonzero(row):
            x0[name][int(i)] = ca.SX.sym(f"x0 of the structure in {name}")
    symbols = ca.vertcat(*theta, *columns.values())
    known = {symbol.name() for symbol in ca.symvar(symbols)}
    cost = ca.SX(0.0)
    if extra_cost is not None:
        cost = _expression("extra_cost", _called("extra_cost", extra_cost, p, x0), known)
    rows = [] if constraints is None else _rows(_called("constraints", constraints, p, x0), known)
    at = problem.unpack(start)

    def sizes(terms: ExtraTerms) -> FloatArray:
        placed = PlacedTerms.among(terms, problem.theta_scale, problem.state_scale, problem.likelihood_size)
        return terms.at(*at).slopes * placed.scale

    terms = compiled_terms(symbols, cost, rows, assembly.record_window, sizes)
    return replace(problem, extra=terms, _last={}, _met={})


def extra_notes(problem: Shooting, unknowns: FloatArray) -> tuple[str, ...]:
    """Return notes on constraints that hold an estimate, or are not met."""
    if problem.extra is None:
        return ()
    extra = problem.extra
    notes = []
    if not np.isfinite(unknowns).all():
        return ()
    rows = extra.at(*problem.unpack(unknowns)).rows
    off = extra.off_bound(rows, _NEAR)
    for name, row, distance, low, high, size in zip(
        extra.names, rows, off, extra.lower, extra.upper, extra.size, strict=True
    ):
        if row < low - _NEAR or row > high + _NEAR:
            notes.append(
                f"the constraint {name} is not met: it is {row * size:.6g}, and must lie in "
                f"[{low * size:.6g}, {high * size:.6g}]"
            )
        elif not np.isnan(distance) and low < high:
            notes.append(f"the constraint {name} is active: standard deviations hold as if it were known to be so")
    return tuple(notes)


def _called(what: str, function: Any, p: Values, x0: Mapping[str, ca.SX]) -> Any:
    if not callable(function):
        raise UsageError(f"{what} = {function!r} is no function; give one of (p, x0) that returns expressions")
    try:
        return function(p, x0)
    except Exception as error:
        raise UsageError(
            f"{what}(p, x0) failed: {in_one_line(error)}; parameters are p.name or p['name'], the initial state of a "
            f"recording is x0['name'][i]; recordings: {', '.join(x0)}"
        ) from error


def _rows(found: Any, known: set[str]) -> list[tuple[float, ca.SX, float]]:
    rows = []
    for i, row in enumerate(list(found) if isinstance(found, list | tuple) else [found]):
        if not (isinstance(row, tuple | list) and len(row) == 3):
            raise UsageError(f"constraints(p, x0)[{i}] = {row!r}; give (lower, expression, upper)")
        lower, expression, upper = row
        try:
            low, high = float(lower), float(upper)
        except (TypeError, ValueError, RuntimeError, NotImplementedError):
            raise UsageError(f"constraints(p, x0)[{i}]: the bounds {lower}, {upper} must be numbers") from None
        if not low <= high:
            raise UsageError(f"constraints(p, x0)[{i}]: the lower bound {low:g} is above the upper bound {high:g}")
        rows.append((low, _expression(f"constraints(p, x0)[{i}]", expression, known), high))
    return rows


def _expression(what: str, found: Any, known: set[str]) -> ca.SX:
    try:
        expression = ca.SX(found)
    except Exception:
        raise UsageError(f"{what} is {type(found).__name__}, which is no CasADi expression (casadi.SX)") from None
    if expression.shape != (1, 1):
        raise UsageError(f"{what} has shape {expression.shape}; it must be one number")
    if foreign := sorted({symbol.name() for symbol in ca.symvar(expression)} - known):
        raise UsageError(
            f"{what} contains symbols that are no unknowns of the fit: {', '.join(foreign)}; an initial state that "
            "is a function of the parameters is written with them"
        )
    return ca.densify(expression)
