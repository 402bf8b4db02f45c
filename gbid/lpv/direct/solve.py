"""Nonlinear programme of the direct LPV fit, for a given scatter between recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.discretise import Hold
from gbid.identify.data import FitData
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.solver import Solution, solve
from gbid.identify.nlp.watch import Progress
from gbid.identify.predictor import Focus
from gbid.identify.problem.assembly import OwnStructure, Scope, assemble, full_start
from gbid.identify.problem.scaling import build_problem, unknown_bounds
from gbid.identify.status import FitStatus
from gbid.identify.uncertainty.information import RecordInformation, profiled, record_information
from gbid.lpv.direct.gains import Gains
from gbid.lpv.direct.setting import Setting
from gbid.notes.model_notes import SurfaceNote


@dataclass(frozen=True, eq=False)
class How:
    """Options of the programme and its solver; see `gbid.fit_lpv_direct`."""

    focus: Focus
    hold: Hold | Sequence[Hold] | None
    engine: EngineName
    max_iterations: int
    progress: Callable[[Progress], None] | None


@dataclass(frozen=True, eq=False)
class DirectSolution:
    """Solution of the programme.

    Attributes
    ----------
    shared : (n_shared,) array
        Coefficients in orthogonal terms, then actuators.
    values : (n, n_names) array
        Parameters of each recording.
    information : list of RecordInformation
        Information of each recording on these parameters, with its gain and initial state eliminated.
    gains : Gains
        Disturbance gains of each recording.
    solution : Solution
        Last iterate of the solver, with its status.
    engine : str
        Engine of the pass over the samples.
    """

    shared: FloatArray
    values: FloatArray
    information: list[RecordInformation]
    gains: Gains
    solution: Solution
    engine: str


def solve_for(
    setting: Setting, data: FitData, shared: FloatArray, scatter: FloatArray, gains: Gains, how: How
) -> DirectSolution:
    """Return the minimum of the prediction errors of all recordings over shared and own unknowns.

    A recording in which the free gain makes the predictor almost unstable does not determine this gain. It is fixed
    at zero there, and the problem is solved again. When the problem is not solved for another reason, all gains are
    fixed at their start values, and at zero where these make a predictor unstable. Notes report each.
    """
    ties = setting.ties(scatter)
    at_first = dict(zip(setting.names, (setting.X[0] @ shared).tolist(), strict=True))
    parameters = tuple(q if q.fixed else replace(q, start=at_first.get(q.name, 0.0)) for q in setting.parameters)
    begin = {q.name: float(q.start or 0.0) for q in parameters}
    local: dict[str, Scope] = dict.fromkeys(setting.gains if how.focus == "prediction" else (), "recording")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        each = [OwnStructure(one, how.hold or one.intersample) for one in setting.structures]
        assembly = assemble(
            each[0].structure,
            parameters,
            begin,
            data,
            intersample=each[0].intersample,
            focus=how.focus,
            horizon=1,
            local=local,
            left_out={},
            window=None,  # the start is near the solution: windows within a recording are not needed
            engine=how.engine,
            ties=ties,
            own=each,
        )
        full = full_start(assembly, begin, gains.values)
        full |= dict(zip((q.name for q in ties.shared), shared.tolist(), strict=True))
        prior = {q.name: (0.0, 1.0) for q in ties.own}
        problem, unknowns = build_problem(assembly, data, "trace", None, full, prior, scaling=True)
        lower, upper = unknown_bounds(problem, assembly)
        position = {q.name: i for i, q in enumerate(assembly.free)}
        places = [[position[names[key]] for key in local if key in names] for names in assembly.record_names]
        part_of = np.searchsorted(problem.first_window, assembly.record_window, side="right") - 1

        def unstable(at: FloatArray) -> BoolArray:
            """Return whether the gain of each recording makes its predictor almost unstable."""
            return np.array(list(problem.parts_at_edge(problem.unpack(at)[0])), dtype=bool)[part_of]

        def fix(chosen: BoolArray, value: float | None = None) -> None:
            """Fix the gains of the chosen recordings, at a value or at their start values."""
            still = [place for own, stays in zip(places, chosen, strict=True) if stays for place in own]
            unknowns[still] = unknowns[still] if value is None else value
            lower[still] = upper[still] = unknowns[still]

        def run() -> Solution:
            first = np.clip(unknowns, lower, upper)
            return solve(problem, first, lower, upper, max_iterations=how.max_iterations, progress=how.progress)

        fix(gains.held)
        edge = unstable(unknowns) & ~gains.held
        held, given_up, at_rest = gains.held | edge, False, False
        fix(edge, 0.0)
        solution = run()
        while local and not (solution.status.success or given_up or held.all()):
            edge = unstable(solution.unknowns) & ~held
            given_up = not edge.any()
            fix(edge, 0.0)
            fix(given_up & ~held)
            held = held | edge | given_up
            solution = run()
        if given_up and solution.status is FitStatus.UNSTABLE_PREDICTOR:  # of the surfaces that moved meanwhile
            at_rest = True
            fix(held, 0.0)
            solution = run()
        theta, starts = problem.unpack(solution.unknowns)
        own = [[q.name for q in problem.parts[part].predictor.free] for part in part_of]
        kept = [np.array([names.index(name) for name in setting.names]) for names in own]
        whole = record_information(problem, theta, starts, assembly.record_window, np.diag(problem.output_weights))
    notes = list(gains.notes)
    if near := [r.name for r, now, before in zip(data.records, held, gains.held, strict=True) if now and not before]:
        if given_up:
            where = "zero" if at_rest else "their start values"
            text = f"free disturbance gains did not converge: all are fixed at {where}"
        else:
            text = f"disturbance gain fixed at zero where it made the predictor unstable: {', '.join(near)}"
        notes.append(SurfaceNote.GAIN_HELD(text))
    if given_up and solution.status.success:
        solution = replace(solution, status=FitStatus.CONVERGED_GAIN_HELD)
    ended = [
        {**values, **{key: float(theta[position[names[key]]]) for key in local if key in names}}
        for names, values in zip(assembly.record_names, gains.values, strict=True)
    ]
    off = np.array([[theta[position[names[q.name]]] for q in ties.own] for names in assembly.record_names])
    return DirectSolution(
        theta[: len(ties.shared)],
        setting.X @ theta[: len(ties.shared)] + off.reshape(len(setting.X), -1) @ ties.lift.T,
        [profiled(one, columns) for one, columns in zip(whole, kept, strict=True)],
        Gains(ended, held, tuple(notes)),
        solution,
        assembly.engine,
    )
