"""Integration error of a nonlinear fit, measured by halving the step; linearisation with derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.discretise.dual import Dual
from gbid.identify.data import FitData
from gbid.identify.kernel.sample import NonlinearPredictor
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import Solution, gauss_newton_step, in_standard_deviations
from gbid.identify.result import FitStatus
from gbid.structure import NonlinearModel
from gbid.structure.nonlinear import MOST_STEPS


@dataclass(frozen=True)
class Refining:
    """Options of the choice of integrator steps; errors are in standard deviations of the estimates.

    Attributes
    ----------
    tolerated : float
        Error that matters to no interval.
    aim : float
        Error that a finer integration is to have.
    order : int
        Order of the less accurate integrator.
    rounds : int
        Largest number of refinements.
    """

    tolerated: float = 0.1
    aim: float = 0.05
    order: int = 3
    rounds: int = 3


REFINING = Refining()


def integrated_finely(
    problem: Shooting,
    solution: Solution,
    run: Callable[[FloatArray, Shooting], Solution],
    known: Sequence[Refinement] = (),
) -> tuple[Shooting, Solution, FloatArray | None]:
    """Return problem and solution with as many integrator steps as the estimates need.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit, linear or not.
    solution : Solution
        Its solution; one that is converged acceptably is solved on at the end.
    run : callable
        Solves, from a start, a problem.
    known : sequence of Refinement
        That near the solution, if it is known.

    Returns
    -------
    Shooting
        The problem with more steps, where those of a structure with ``steps="auto"`` were not enough.
    Solution
        Its solution, with the iterations of all.
    (n_theta,) array or None
        How far the estimates move when the step of the integrator is halved; None if linear.
    """
    predictor = problem.groups[0].predictor
    if not isinstance(predictor, NonlinearPredictor):
        return problem, solution, None
    steps, ahead = predictor.steps, known[0] if known else refinement(problem, solution.unknowns)
    for _ in range(REFINING.rounds if predictor.adapts else 0):
        if not solution.status.success:
            break
        start, is_finite = solution.unknowns, np.isfinite(ahead.off)
        if ahead.off > REFINING.tolerated:
            factor = min(8.0, (ahead.off / REFINING.aim) ** (1 / REFINING.order)) if is_finite else 4.0
            steps = ceil(steps * factor)
        is_finer = ahead.off > REFINING.tolerated and steps <= MOST_STEPS
        if is_finer:
            problem, start = with_steps(problem, steps), start + (ahead.step if is_finite else 0.0)
        elif solution.status is not FitStatus.CONVERGED_ACCEPTABLY:
            break
        refined = run(start, problem)
        solution = replace(refined, iterations=solution.iterations + refined.iterations)
        if is_finer:
            ahead = refinement(problem, solution.unknowns)
    return problem, solution, ahead.shift[: problem.n_theta] * problem.theta_scale


def with_steps(problem: Shooting, steps: int) -> Shooting:
    """Return the problem with a given number of integrator steps per sample."""
    parts = []
    for part in problem.parts:
        assert isinstance(part.predictor, NonlinearPredictor)
        parts.append(replace(part, predictor=replace(part.predictor, steps=steps)))
    return replace(problem, parts=tuple(parts))


class Refinement(NamedTuple):
    """Gauss-Newton step from a point to the solution with half the integrator step.

    Attributes
    ----------
    step : (n_unknowns,) array
        The Gauss-Newton step, scaled; infinite where it cannot be computed.
    shift : (n_unknowns,) array
        Its difference from that with the present step.
    off : float
        The shift in standard deviations.
    """

    step: FloatArray
    shift: FloatArray
    off: float


def refinement(problem: Shooting, unknowns: FloatArray) -> Refinement:
    """Return the step from a nonlinear problem's point (n_unknowns,) to the solution with half the integrator step."""
    predictor, iterate = problem.parts[0].predictor, problem.at(unknowns)
    assert isinstance(predictor, NonlinearPredictor)
    finer = with_steps(problem, 2 * predictor.steps)
    try:
        step_here = gauss_newton_step(problem, iterate, unknowns)
        step = gauss_newton_step(finer, finer.at(unknowns), unknowns)
    except (RuntimeError, ValueError):
        step_here, step = np.zeros(len(unknowns)), np.full(len(unknowns), np.inf)
    return Refinement(step, step - step_here, in_standard_deviations(problem, iterate, step - step_here))


# ---- Linear model at the working point of a nonlinear fit, with derivatives with respect to the parameters.


def at_working_point(model: Any, problem: Shooting, theta: FloatArray, starts: FloatArray, data: FitData) -> Any:
    """Return the model with the means over the recordings as working point, and the integrator steps of the fit.

    Parameters
    ----------
    model : NonlinearModel
        Model at the estimates.
    problem : Shooting
        Problem of the fit.
    theta, starts : (n_p,) and (n_windows, n) array
        Its solution.
    data : FitData
        Data of the fit.
    """
    n, values = model.n_states, problem.values(theta)
    predictions = [(part.blocks, part.kernel.predict(v, part.blocks, s)) for v, part, s in problem.each(values, starts)]
    every = np.concatenate([x[:, :n] for blocks, made in predictions for x in blocks.by_segment(made.states)])
    inputs = np.concatenate([record.inputs for record in data.records])
    model = replace(model, steps=values[0].steps)
    if not np.isfinite(every).all():
        return model
    size = np.sqrt(np.mean(every**2, axis=0))
    size, mean = np.where(size > 0, size, 1.0), every.mean(axis=0)
    return replace(model, working_state=mean, working_input=inputs.mean(axis=0), state_size=size)


def linearised(model: NonlinearModel, names: Sequence[str], free: Sequence[str]) -> list[Dual]:
    """Return A, B, C and D with derivatives at a fixed working point.

    Parameters
    ----------
    model : NonlinearModel
        The model.
    names : sequence of str
        Names of the parameters of its structure.
    free : sequence of str
        Parameters of the derivatives; zero for those that are none of the structure.
    """
    x, u, p = (ca.SX.sym("s", size) for size in (model.n_states, len(model.input_names), len(names)))
    matrices, known = [], [i for i, name in enumerate(free) if name in names]
    for output in model.function(x, u, p):
        for at in (x, u):
            slopes = ca.densify(ca.jacobian(output, at))
            function = ca.Function("m", [x, u, p], [slopes, ca.densify(ca.jacobian(slopes, p))])
            value, by = (
                np.asarray(m, float) for m in function(model.working_state, model.working_input, model.parameters)
            )
            value = value.reshape(slopes.shape)
            every = by.T.reshape(len(names), *value.shape[::-1]).transpose(0, 2, 1)  # CasADi stacks columns
            by_free = np.zeros((len(free), *value.shape))
            by_free[known] = every[[names.index(free[i]) for i in known]]
            matrices.append(Dual(value, by_free))
    return matrices
