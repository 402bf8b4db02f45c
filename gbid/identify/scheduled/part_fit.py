"""Fit of a structure with constant parameters to a part of a recording, for start values: estimates and variances."""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold
from gbid.identify.data import FitData
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.solver import solve
from gbid.identify.predictor import Focus
from gbid.identify.problem.assembly import assemble, automatic_window, full_start
from gbid.identify.problem.scaling import build_problem, unknown_bounds
from gbid.identify.start.begin import begin_values
from gbid.structure import Parameter, Structure

_ITERATIONS = 30


class PartFit(NamedTuple):
    """Estimates of the parameters by name, and their variances; zero for fixed ones."""

    values: dict[str, float]
    variances: dict[str, float]


def fit_part(
    structure: Structure,
    parameters: tuple[Parameter, ...],
    part: FitData,
    intersample: Hold | Sequence[Hold],
    focus: Focus,
    engine: EngineName,
    asked: Set[str],
) -> PartFit | None:
    """Return the estimates from a part of a recording; None when the solver does not converge.

    The arguments are those of `gbid.fit`. The variances are those of white errors with known initial states: they only
    weight the estimates of several parts.
    """
    begin = begin_values(structure, parameters, part, intersample, asked, from_data=False).values
    assembly = assemble(
        structure,
        parameters,
        begin,
        part,
        intersample=intersample,
        focus=focus,
        horizon=1,
        local={},
        left_out={},
        window=automatic_window(part, focus),
        engine=engine,
    )
    problem, unknowns = build_problem(assembly, part, "det", None, full_start(assembly, begin), {}, scaling=True)
    lower, upper = unknown_bounds(problem, assembly)
    solution = solve(problem, np.clip(unknowns, lower, upper), lower, upper, stop="paper", max_iterations=_ITERATIONS)
    theta, starts = problem.unpack(solution.unknowns)
    values = problem.values(theta)
    products = problem.error_products(values, starts)
    if not (solution.status.success and np.isfinite(products).all()):
        return None
    weight = np.asarray(problem.n_samples * np.linalg.inv(products), np.float64)
    hessian = np.zeros((len(theta), len(theta)))
    for own, sums in zip(problem.parts, problem.sweeps(values, starts, weight), strict=True):
        hessian[np.ix_(own.index, own.index)] += sums.hessian
    known = dict(zip((q.name for q in assembly.free), theta.tolist(), strict=True))
    spread = dict(zip(known, _inverse_diagonal(hessian).tolist(), strict=True))
    return PartFit({**begin, **known}, {**dict.fromkeys(begin, 0.0), **spread})


def _inverse_diagonal(hessian: FloatArray) -> FloatArray:
    """Return the diagonal of the inverse of an information matrix; large where it is almost singular."""
    size = 1 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian * np.outer(size, size))
    return np.asarray((vectors**2 / np.maximum(values, 1e-12 * values[-1])).sum(axis=1) * size**2)
