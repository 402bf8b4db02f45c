"""Cost, constraints and their derivatives as functions of CasADi, for the solver and for users of CasADi."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.identify.nlp.functions.casadi_callback import Oracle, Trouble
from gbid.identify.nlp.hessian import Curvature
from gbid.identify.nlp.patterns import Pattern
from gbid.identify.nlp.shooting import Shooting


class NlpFunctions(NamedTuple):
    """Functions of the scaled unknowns, with the names that ``casadi.nlpsol`` wants. They must outlive the solver.

    Attributes
    ----------
    value : casadi.Function
        ``(x) -> (f, g)``: cost and constraints. The constraints are the gaps, the bounds of tied parameters, and those
        of the caller.
    gradient : casadi.Function
        ``(x, p) -> (f, grad_f_x)``.
    jacobian : casadi.Function
        ``(x, p) -> (g, jac_g_x)``.
    hessian : casadi.Function
        ``(x, p, lam_f, lam_g) -> triu_hess_gamma_x_x``: upper triangle of the Hessian.
    lower, upper : (n_constraints,) array
        Bounds of the constraints.
    """

    value: ca.Function
    gradient: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    lower: FloatArray
    upper: FloatArray

    @property
    def derivatives(self) -> dict[str, Any]:
        """Options of ``casadi.nlpsol`` for these derivatives instead of its own."""
        return {"no_nlp_grad": True, "grad_f": self.gradient, "jac_g": self.jacobian, "hess_lag": self.hessian}


def nlp_functions(problem: Shooting, curvature: Curvature, trouble: Trouble) -> NlpFunctions:
    """Return the functions of a problem.

    Parameters
    ----------
    problem : Shooting
        The problem.
    curvature : Curvature
        Hessian of cost and gaps.
    trouble : Trouble
        Notes the points without a value, and defects.
    """
    n, m, extra, placed = problem.n_unknowns, problem.n_gaps, problem.extra, problem.placed
    vector, scalar, empty = ca.Sparsity.dense(n, 1), ca.Sparsity.dense(1, 1), ca.Sparsity(0, 0)
    limits = problem.limits[0]
    n_extra = 0 if extra is None else len(extra.lower)
    columns = np.zeros(0, int) if placed is None else placed.places
    jacobian, order = _stacked(problem.jacobian_pattern, limits, n_extra, columns)
    bounds = limits[limits != 0]
    constraints, hessian = ca.Sparsity.dense(m + len(limits) + n_extra, 1), _sparsity(problem.hessian_pattern)
    point = [("x", vector), ("p", empty)]
    multipliers = [("lam_f", scalar), ("lam_g", constraints)]

    def held(x: FloatArray) -> FloatArray:
        here = problem.at(x)
        return np.concatenate([here.gaps, limits @ x[: problem.n_theta], here.extra_rows])

    def slopes(x: FloatArray) -> FloatArray:
        here = problem.at(x)
        return np.concatenate([here.jacobian, bounds, here.extra_slopes.ravel()])[order]

    def cost(x: FloatArray) -> list[FloatArray | float]:
        found = np.nan
        try:
            here = problem.at(x)
            found = np.nan if trouble.too_far(float(np.abs(here.gaps).max(initial=0.0))) else here.cost
            return [found, held(x)]
        finally:
            trouble.points += not np.isfinite(found)

    def second(x: FloatArray, lam_f: FloatArray, lam_g: FloatArray) -> FloatArray:
        entries = curvature(x, float(lam_f[0]), lam_g[:m])
        if placed is not None and n_extra:
            last = lam_g[len(lam_g) - n_extra :]
            entries = entries + placed.curvature(*problem.unpack(x), last, problem.hessian_pattern)
        return entries

    value = Oracle("nlp", [("x", vector)], [("f", scalar), ("g", constraints)], cost, trouble)
    gradient = Oracle(
        "grad_f",
        point,
        [("f", scalar), ("grad_f_x", vector)],
        lambda x, _p: [problem.at(x).cost, problem.at(x).gradient],
        trouble,
    )
    jac = Oracle(
        "jac_g",
        point,
        [("g", constraints), ("jac_g_x", jacobian)],
        lambda x, _p: [held(x), slopes(x)],
        trouble,
    )
    hess = Oracle(
        "hess_lag",
        point + multipliers,
        [("triu_hess_gamma_x_x", hessian)],
        lambda x, _p, lam_f, lam_g: [second(x, lam_f, lam_g)],
        trouble,
    )
    _, lowest, highest = problem.limits
    closed = np.zeros(m)
    ends = [(lowest, highest)] if extra is None else [(lowest, highest), (extra.lower, extra.upper)]
    lower, upper = (np.concatenate([closed, *(pair[side] for pair in ends)]) for side in (0, 1))
    return NlpFunctions(value, gradient, jac, hess, lower, upper)


def _stacked(gaps: Pattern, limits: FloatArray, n_extra: int, used: IntArray) -> tuple[ca.Sparsity, IntArray]:
    """Return the sparsity of gaps over limits over further constraints, and the order of their entries in it.

    The entries are those of the gaps in the order of their pattern, the nonzeros of the limits row by row, and the
    slopes of the further constraints by the `used` unknowns row by row.
    """
    own, of = np.nonzero(limits)
    further = np.arange(n_extra).repeat(len(used))
    rows = np.concatenate([gaps.rows, gaps.shape[0] + own, gaps.shape[0] + len(limits) + further])
    columns = np.concatenate([gaps.columns, of, np.tile(used, n_extra)])
    order = np.lexsort((rows, columns))
    shape = gaps.shape[0] + len(limits) + n_extra, gaps.shape[1]
    return _sparsity(Pattern(shape, rows[order], columns[order], order)), order


def _sparsity(pattern: Pattern) -> ca.Sparsity:
    """Return the pattern as CasADi keeps it: columns with rows in order."""
    counts = np.bincount(pattern.columns, minlength=pattern.shape[1])
    return ca.Sparsity(*pattern.shape, [0, *np.cumsum(counts).tolist()], pattern.rows.tolist())
