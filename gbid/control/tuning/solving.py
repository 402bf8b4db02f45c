"""Solution of a design problem: search, peaks between the grid frequencies, certificate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.search.basins.climber import certificate_units
from gbid.control.tuning.search.basins.ranking import best_of, better
from gbid.control.tuning.search.global_search import Effort, Progress, SearchOutcome, refine, search
from gbid.control.tuning.search.limits import Limits
from gbid.control.tuning.search.nonsmooth.certificate import certify
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum, optimise_locally
from gbid.control.tuning.search.starts.units import gain_units
from gbid.control.tuning.search.step import SearchStep
from gbid.control.tuning.verify import exact_norms

_FAR = 1e9
"""Angular frequency that stands for infinity [rad/s]; of sampled loops, in units of 2 / T, for half the sample rate."""
_MOST_ROUNDS = 3
"""Largest number of certificates, each after a better design that the one before had found."""


def solve(
    problem: GainProblem,
    neutral: FloatArray,
    effort: Effort,
    first: Iterable[FloatArray] = (),
    progress: Progress | None = None,
    found: LocalOptimum | None = None,
    of_others: bool = False,
) -> tuple[LocalOptimum, tuple[SearchStep, ...]]:
    """Return the optimum and the history of a search, or of a local optimisation from a known design.

    With `of_others` the first designs are those of other loops, and the search goes on from them.

    Afterwards peaks between the grid frequencies are added as cuts, until exact norms exceed no limit.
    """
    if found is not None:
        near = optimise_locally(problem, found.x, max_iterations=300, radius=0.02)
        result = SearchOutcome(near, (), (near,))
    elif of_others:
        result = refine(problem, [*first], effort, progress)
    else:
        result = search(problem, neutral, effort, first, progress)
    best, history = result.best, list(result.history)
    for _ in range(10):
        if not add_cuts(problem, best.x):
            break
        best = optimise_locally(problem, best.x, max_iterations=200, radius=0.02)
        history.append(SearchStep("cut", problem.evaluations, problem.in_units(best.score.value), best.score.violation))
        if progress is not None:
            progress(history[-1])
    best = certified(problem, best)
    if problem.uses_responses and not problem.stable(best.x):
        best = _stable_instead(problem, best, neutral, effort)
    history.append(
        SearchStep("certificate", problem.evaluations, problem.in_units(best.score.value), best.score.violation)
    )
    if progress is not None:
        progress(history[-1])
    return best, tuple(history)


def _stable_instead(problem: GainProblem, found: LocalOptimum, neutral: FloatArray, effort: Effort) -> LocalOptimum:
    """Return a stable design in place of an unstable one, where there are stable ones.

    The response of an unstable loop can exceed limits that nothing keeps by less than those of the stable ones.
    """
    plain = replace(problem, limits=Limits("decay"), cuts=[], linear=())
    safe = search(plain, neutral, effort, [found.x]).best.x
    problem.evaluations = plain.evaluations
    if not problem.stable(safe):
        return found
    near = [optimise_locally(problem, safe, max_iterations=100, radius=0.02).x]
    way = [safe + share * (found.x - safe) for share in np.linspace(0.0, 1.0, 40, endpoint=False)]
    stable = [replace(found, x=x, score=problem.score(x), certificate=None) for x in [*way, *near] if problem.stable(x)]
    return best_of([one for one in stable if one.score.usable] or [found])


def certified(problem: GainProblem, found: LocalOptimum) -> LocalOptimum:
    """Return a design with its certificate; where the certificate finds a better one near it, that one."""
    unit = gain_units(problem, found.x)
    for _ in range(_MOST_ROUNDS):
        certificate, x = certify(problem, found.x, certificate_units(unit, found.x))
        if certificate.holds or x is found.x or problem.exhausted:
            break
        moved = optimise_locally(problem, x, max_iterations=60, radius=1e-3)
        if not better(moved.score, found.score) or add_cuts(problem, moved.x):
            break
        found = moved
    # a climb that ended early has no less reached an optimum where this is certified
    return replace(found, certificate=certificate, converged=found.converged or certificate.holds)


def add_cuts(problem: GainProblem, x: FloatArray) -> bool:
    """Add frequencies at which exact norms exceed a limit between the grid points; return whether there were any."""
    known = problem.score(x).violation
    added = False
    for kind, limit in (("sensitivity", problem.limits.peak_sensitivity), ("control", problem.limits.peak_control)):
        if limit is None or not problem.stable(x):
            continue
        least = limit * float(np.exp(min(max(known, 0.0), 300.0) + 1e-7))
        for f, family in enumerate(problem.families):
            for i, norm in enumerate(exact_norms(family, x, kind, least)):
                far = _FAR if family.sample_time is None else 2 * _FAR / family.sample_time
                cut = kind, f, i, min(norm.frequency, far)
                if norm.value > least and cut not in problem.cuts:
                    problem.cuts.append(cut)
                    added = True
    return added
