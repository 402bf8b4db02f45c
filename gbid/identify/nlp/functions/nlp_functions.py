"""Cost, constraints and their derivatives as functions of CasADi, for the solver and for users of CasADi."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.functions.casadi_callback import Oracle, Trouble
from gbid.identify.nlp.hessian import Curvature
from gbid.identify.nlp.patterns import Pattern
from gbid.identify.nlp.record_group import Iterate
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
    limits = ca.sparsify(ca.DM(np.pad(problem.limits[0], ((0, 0), (0, n - problem.n_theta)))))
    n_extra = 0 if extra is None else len(extra.lower)
    order = np.zeros(0, int) if placed is None else np.argsort(placed.places)
    columns = np.zeros(0, int) if placed is None else placed.places[order]
    rows = np.tile(np.arange(n_extra), len(columns))
    further = ca.Sparsity.triplet(n_extra, n, rows.tolist(), columns.repeat(n_extra).tolist())
    constraints = ca.Sparsity.dense(m + limits.rows() + n_extra, 1)
    gaps, hessian = _sparsity(problem.jacobian_pattern), _sparsity(problem.hessian_pattern)
    jacobian = ca.vertcat(gaps, limits.sparsity(), further)
    point = [("x", vector), ("p", empty)]
    multipliers = [("lam_f", scalar), ("lam_g", constraints)]

    def at(x: ca.DM) -> Iterate:
        return problem.at(_flat(x))

    def held(x: ca.DM) -> ca.DM:
        here = at(x)
        return ca.vertcat(ca.DM(here.gaps), limits @ x, ca.DM(here.extra_rows))

    def slopes(x: ca.DM) -> ca.DM:
        here = at(x)
        return ca.vertcat(ca.DM(gaps, here.jacobian), limits, ca.DM(further, here.extra_slopes[:, order].T.ravel()))

    def cost(x: ca.DM) -> list[Any]:
        found = np.nan
        try:
            found = at(x).cost
            return [found, held(x)]
        finally:
            trouble.points += not np.isfinite(found)

    def second(x: ca.DM, lam_f: ca.DM, lam_g: ca.DM) -> ca.DM:
        lam = _flat(lam_g)
        entries = curvature(_flat(x), float(lam_f), lam[:m])
        if placed is not None and n_extra:
            bent = placed.curvature(*problem.unpack(_flat(x)), lam[len(lam) - n_extra :], problem.hessian_pattern)
            entries = entries + bent
        return ca.DM(hessian, entries)

    value = Oracle("nlp", [("x", vector)], [("f", scalar), ("g", constraints)], cost, trouble)
    gradient = Oracle(
        "grad_f", point, [("f", scalar), ("grad_f_x", vector)], lambda x, _p: [at(x).cost, at(x).gradient], trouble
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


def _flat(values: ca.DM) -> FloatArray:
    return np.asarray(values, float).ravel()


def _sparsity(pattern: Pattern) -> ca.Sparsity:
    """Return the pattern as CasADi keeps it: columns with rows in order."""
    counts = np.bincount(pattern.columns, minlength=pattern.shape[1])
    return ca.Sparsity(*pattern.shape, [0, *np.cumsum(counts).tolist()], pattern.rows.tolist())
