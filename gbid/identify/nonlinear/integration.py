"""Error of the integration of a nonlinear fit, measured at the optimum by halving the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import ceil

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.nlp.optimality import gauss_newton_step, in_standard_deviations
from gbid.identify.nlp.shooting import Shooting
from gbid.identify.nlp.solver import Solution
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearPredictor
from gbid.identify.result import FitResult
from gbid.notes.fit_notes import FitNote
from gbid.structure.nonlinear.nonlinear_structure import MOST_STEPS

_TOLERATED = 0.1  # standard deviations
_AIM = 0.05  # of a finer integration
_ORDER = 3  # of the less accurate integrator
_ROUNDS = 3

Box = tuple[FloatArray, FloatArray]


def integrated_finely(
    problem: Shooting, solution: Solution, box: Box, run: Callable[[FloatArray, Shooting], Solution]
) -> tuple[Shooting, Solution, FloatArray | None]:
    """Return problem and solution with as many steps of the integrator as the estimates need.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit, linear or not.
    solution : Solution
        Its solution.
    box : (n_unknowns,) array, (n_unknowns,) array
        Bounds of the unknowns, scaled.
    run : callable
        Solves, from a start, a problem.

    Returns
    -------
    Shooting
        The problem with more steps, where those of a structure with ``steps="auto"`` were not enough.
    Solution
        Its solution, with the iterations of all.
    (n_theta,) array or None
        How far the estimates move when the step of the integrator is halved; None if linear.
    """
    own = problem.parts[0].predictor
    if not isinstance(own, NonlinearPredictor):
        return problem, solution, None
    steps, moved = own.steps, _moved(problem, solution.unknowns, box)
    for _ in range(_ROUNDS):
        if not (own.adapts and solution.status.success):
            break
        off = in_standard_deviations(problem, problem.at(solution.unknowns), moved)
        if off <= _TOLERATED:
            break
        steps = steps * 4 if not np.isfinite(off) else ceil(steps * min(8.0, (off / _AIM) ** (1 / _ORDER)))
        if steps > MOST_STEPS:
            break
        problem = with_steps(problem, steps)
        found = run(solution.unknowns, problem)
        solution = replace(found, iterations=solution.iterations + found.iterations)
        moved = _moved(problem, solution.unknowns, box)
    return problem, solution, moved[: problem.n_theta] * problem.theta_scale


def with_integration_error(result: FitResult, shift: FloatArray | None) -> FitResult:
    """Return a result with the shift of its estimates in standard deviations, and a note where it matters."""
    if shift is None:
        return result
    std = np.array([result.std[name] for name in result.free])
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(std > 0, shift / std, np.nan)
    notes = result.notes
    large = [
        f"{name} by {abs(off):.2g}" for name, off in zip(result.free, relative, strict=True) if abs(off) > _TOLERATED
    ]
    if large and result.success:
        notes = (
            *notes,
            FitNote.INTEGRATION(
                f"the error of the integration moves estimates, in standard deviations: {', '.join(large)}; take more "
                "steps in a sample (steps=...), or integrator='implicit'"
            ),
        )
    return replace(result, integration_shift=relative, notes=notes)


def with_steps(problem: Shooting, steps: int) -> Shooting:
    """Return the problem with so many steps of the integrator in a sample."""
    parts = []
    for part in problem.parts:
        assert isinstance(part.predictor, NonlinearPredictor)
        parts.append(replace(part, predictor=replace(part.predictor, steps=steps)))
    return replace(problem, parts=tuple(parts), _last={}, _met={})


def _moved(problem: Shooting, unknowns: FloatArray, box: Box) -> FloatArray:
    """Return the step from the solution to that with half the step; infinite where it cannot be computed."""
    own = problem.parts[0].predictor
    assert isinstance(own, NonlinearPredictor)
    finer = with_steps(problem, 2 * own.steps)
    try:
        here = gauss_newton_step(problem, problem.at(unknowns), unknowns, box)
        return gauss_newton_step(finer, finer.at(unknowns), unknowns, box) - here
    except (RuntimeError, ValueError):
        return np.full(len(unknowns), np.inf)
