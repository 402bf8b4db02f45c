"""Problem of a fit: data and start values gathered, the shooting problem posed and solved."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gbid.core.arrays import FloatArray, one_blas_thread
from gbid.core.errors import DataError, UsageError
from gbid.core.notes import FitNote
from gbid.discretise import Hold
from gbid.identify.data import Dependence, FitData, channels_of, dependent_outputs, gather
from gbid.identify.disturbances import UNDISTURBED, Disturbances, disturbances_of
from gbid.identify.frequency_data import FrequencyData
from gbid.identify.frequency_fit import check_linear, refuse_other_options, response_start
from gbid.identify.kernel.gaps import with_kalman_gains
from gbid.identify.kernel.sample import NonlinearPredictor
from gbid.identify.options import FitArguments
from gbid.identify.predictor import Predictor
from gbid.identify.problem.assemble import (
    Assembly,
    assemble,
    bounded,
    build_problem,
    counted_samples,
    full_start,
    group_name,
    with_extra_terms,
)
from gbid.identify.problem.generalised_least_squares import WeightedErrors, WeightedProblem, weighted_solution
from gbid.identify.problem.hessian import in_one_window, in_windows, neighbours, passed_on, simulated, starts_from
from gbid.identify.problem.integration import REFINING, Refinement, integrated_finely, refinement
from gbid.identify.problem.nlp import RecordGroup, Shooting
from gbid.identify.problem.solve import Solution, gauss_newton_step, in_standard_deviations, solve
from gbid.identify.problem.states import (
    InitialStates,
    check_inputs_suffice,
    disturbance_starts,
    initial_states,
    without_disturbances,
)
from gbid.identify.result import FitStatus
from gbid.identify.robust import Reweighted, RobustLoss, reweighted_solution, robust_loss
from gbid.identify.start.scheduled_start import Courses, read_courses, scheduled_start, tied_equations
from gbid.identify.start.start import Begin, begin_values
from gbid.recording import Recording
from gbid.structure import Parameter
from gbid.structure.kinds import AnyStructure, equations_of, kind_of
from gbid.structure.linear import as_names
from gbid.structure.parameter import known_names

Recordings = Recording | Sequence[Recording]
Measured = Recordings | FrequencyData | Sequence[Recording | FrequencyData]


@dataclass(frozen=True, eq=False)
class FitTask:
    """Structure, data and options of a fit, shared by all attempts.

    Attributes
    ----------
    structure : Structure or NonlinearStructure
        The structure, without inputs for a free decay.
    parameters : tuple of Parameter
        Its parameters, with the starts, fixed values and bounds of the caller.
    data, undisturbed : FitData
        Data, and the same with trends and hum subtracted, at even times.
    options : FitArguments
        Options, with the names of inputs and outputs.
    hold : {"zoh", "foh"} or sequence of these
        Hold of the inputs.
    states : InitialStates
        Initial states: estimated, fixed, or functions of the parameters.
    disturbances : Disturbances
        Trends and hum.
    begin : Begin
        Start values, and where they come from.
    courses : Courses or None
        Scheduling variables of a scheduled structure.
    responses : tuple of FrequencyData
        Frequency responses that are fitted together with the recordings.
    dependent : tuple of Dependence
        Outputs that are combinations of others. The task leaves them out where no parameter acts on them alone.
    """

    structure: AnyStructure
    parameters: tuple[Parameter, ...]
    data: FitData
    undisturbed: FitData
    options: FitArguments
    hold: Hold | Sequence[Hold]
    states: InitialStates
    disturbances: Disturbances
    begin: Begin
    courses: Courses | None
    responses: tuple[FrequencyData, ...] = ()
    dependent: tuple[Dependence, ...] = ()

    @property
    def loss(self) -> RobustLoss | None:
        """Robust loss function; None for squared errors."""
        options = self.options
        return robust_loss(options, len(self.data.output_names)) if options.robust else None

    def problem(self, start: Mapping[str, float], window: int | None, *, gain_held: bool = False) -> PosedProblem:
        """Return the shooting problem for start values by structure names, in windows of a given number of samples.

        `gain_held` fixes the parameters on which only the disturbance gain depends.
        """
        parameters = self.parameters
        if gain_held:
            gains = kind_of(self.structure).anatomy().gain_only
            parameters = tuple(
                replace(q, fixed=True) if q.name in gains and q.start is not None else q for q in parameters
            )
        structure, begin, assembly = self.assembled(start, parameters, window)
        full = full_start(
            assembly, start, disturbance_starts(self.disturbances, structure, begin, self.data, self.hold)
        )
        shooting, unknowns = build_problem(assembly, self.data, self.options, full, self.states)
        shooting = self._with_extra_terms(assembly, parameters, shooting, unknowns)
        return PosedProblem(self, start, window, parameters, assembly, full, shooting, unknowns)

    def cut_anew(self, problem: PosedProblem, unknowns: FloatArray) -> PosedProblem:
        """Return a problem of another task with this task's scheduling signals, at the same point and scales.

        Windows begin where the model passes at the given `unknowns`.
        """
        _, _, assembly = self.assembled(problem.start, problem.parameters, problem.window)
        shooting = replace(problem.shooting, parts=assembly.parts, links=assembly.links, extra=None)
        theta, starts = problem.shooting.unpack(unknowns)
        unknowns = shooting.pack(theta, starts_from(problem.shooting, theta, starts, shooting))
        shooting = bounded(shooting, assembly, self.states)
        shooting = self._with_extra_terms(assembly, problem.parameters, shooting, unknowns)
        return replace(problem, task=self, assembly=assembly, shooting=shooting, unknowns=unknowns)

    def assembled(
        self, start: Mapping[str, float], parameters: tuple[Parameter, ...], window: int | None
    ) -> tuple[AnyStructure, Mapping[str, float], Assembly]:
        """Return the equations with constant parameters, their start values, and the assembled data."""
        structure, begin, ties, stated = self.structure, start, None, parameters
        if self.courses is not None and (scheduled := kind_of(structure).scheduled):
            structure, stated, begin, ties = tied_equations(scheduled, parameters, start, self.courses)
        assembly = assemble(
            structure,
            stated,
            begin,
            self.data,
            replace(self.options, intersample=self.hold, window=window),
            disturbances=self.disturbances,
            released=self.states.released,
            ties=ties,
            responses=self.responses,
        )
        return structure, begin, assembly

    def _with_extra_terms(
        self, assembly: Assembly, parameters: tuple[Parameter, ...], shooting: Shooting, unknowns: FloatArray
    ) -> Shooting:
        return with_extra_terms(shooting, assembly, self.data, self.states, parameters, unknowns, self.options)


@dataclass(frozen=True, eq=False)
class PosedProblem:
    """Shooting problem posed from one start, with windows of one length.

    Attributes
    ----------
    task : FitTask
        The fit.
    start : dict of str to float
        Start values by the structure's names.
    window : int or None
        Samples in a shooting window; None for one window.
    parameters : tuple of Parameter
        Parameters of the structure, with those fixed that are.
    assembly : Assembly
        Parts, links and shared parameters.
    begin : dict of str to float
        Start values by full name.
    shooting : Shooting
        The problem.
    unknowns : (n_unknowns,) array
        Start, scaled.
    """

    task: FitTask
    start: Mapping[str, float]
    window: int | None
    parameters: tuple[Parameter, ...]
    assembly: Assembly
    begin: dict[str, float]
    shooting: Shooting
    unknowns: FloatArray


def apart(measured: Measured) -> tuple[list[Recording], list[FrequencyData]]:
    """Return the recordings, and the frequency responses, among the data given to a fit."""
    several = [measured] if isinstance(measured, Recording | FrequencyData) else list(measured)
    responses = [each for each in several if isinstance(each, FrequencyData)]
    return [each for each in several if not isinstance(each, FrequencyData)], responses


def pose(structure: AnyStructure, recordings: Measured, options: FitArguments, *, all_outputs: bool = False) -> FitTask:
    """Return the task of a fit: names and data checked, start values determined.

    Outputs that are combinations of others are left out, but with `all_outputs`.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    recordings, responses = apart(recordings)
    inputs = as_names(structure.inputs if options.inputs is None else options.inputs)
    outputs = as_names(structure.outputs if options.outputs is None else options.outputs)
    hold = structure.intersample if options.intersample is None else options.intersample
    from_data = options.start == "data"
    parameters = with_options(structure.parameters, options)
    options = replace(options, inputs=inputs, outputs=outputs)
    given = {*({} if from_data else options.start or {}), *(options.fixed or {})}
    if responses:
        check_linear(structure)
        responses = [each.channels(inputs, outputs) for each in responses]
    if responses and not recordings:
        return _of_responses(structure, parameters, responses, options, given)
    data = gather(recordings, inputs, outputs, minimum=2, gaps=True, irregular=True)
    stated, structure = structure, equations_of(structure)
    dependent = () if all_outputs or responses else dependent_outputs(data)
    if dependent and (reduced := _reduced(structure, parameters, data, options, dependent, recordings[0])):
        structure, parameters, data, options = reduced
        stated = structure
    scheduled = kind_of(structure).scheduled
    courses = read_courses(scheduled, recordings) if scheduled else None
    if courses is not None and not inputs:
        raise UsageError(f"{structure.name}: scheduled parameters need inputs; leave inputs=() out")
    if not responses:  # which may show what recordings at rest do not
        check_inputs_suffice(structure, data, parameters, no_inputs=not inputs)
    names = [record.name for record in data.records]
    states = initial_states(structure, parameters, options.initial_state, names)
    disturbances = disturbances_of(options, data.output_names, data.sample_time)
    _check_numbers(structure, parameters, data, options, states, disturbances, responses)
    with one_blas_thread():
        undisturbed = without_disturbances(disturbances, data).at_even_times()
        if scheduled and courses:
            begin = scheduled_start(scheduled, parameters, undisturbed, courses, hold, options.focus, given)
        else:
            begin = begin_values(stated, parameters, undisturbed, hold, given, from_data=from_data)
    structure = structure if inputs else kind_of(structure).without_inputs()
    return FitTask(
        structure,
        parameters,
        data,
        undisturbed,
        options,
        hold,
        states,
        disturbances,
        begin,
        courses,
        tuple(responses),
        dependent,
    )


def _reduced(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    data: FitData,
    options: FitArguments,
    dependent: Sequence[Dependence],
    recording: Recording,
) -> tuple[AnyStructure, tuple[Parameter, ...], FitData, FitArguments] | None:
    """Return structure, parameters, data and options without dependent outputs.

    The disturbance gains of these outputs are zero. None where another parameter acts on them alone.
    """
    lost = {each.name for each in dependent}
    kept = [i for i, name in enumerate(data.output_names) if name not in lost]
    channels = channels_of(recording, options.outputs or ())
    kind = kind_of(structure)
    part = kind.with_outputs(kept, tuple(channels[i] for i in kept))
    if part is None:
        return None
    whole, now = kind.anatomy(), kind_of(part).anatomy()
    idle = whole.in_equations.union(*whole.in_x0) - now.in_equations.union(*now.in_x0)
    if idle - whole.gain_only:
        return None
    parameters = tuple(Parameter(q.name, 0.0, fixed=True, unit=q.unit) if q.name in idle else q for q in parameters)
    trend, weights = options.trend, options.output_weights
    changed = replace(
        options,
        outputs=part.outputs,
        trend={name: each for name, each in trend.items() if name not in lost} if isinstance(trend, Mapping) else trend,
        output_weights=weights and [weights[i] for i in kept],
    )
    return part, parameters, data.with_outputs(kept), changed


def _check_numbers(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    data: FitData,
    options: FitArguments,
    states: InitialStates,
    disturbances: Disturbances,
    responses: Sequence[FrequencyData],
) -> None:
    """Refuse data with no more measured values than unknowns, over all recordings."""
    left_out, local, records = options.left_out or {}, options.local or {}, data.records
    numbers = len(options.prior or {}) + sum(2 * each.response.size for each in responses)
    for record in records:
        present = np.ones_like(record.outputs, bool) if record.missing is None else ~record.missing
        numbers += int(present[counted_samples(record, left_out.get(record.name, ()))].sum())
    idle = kind_of(structure).anatomy().gain_only if options.focus == "simulation" else frozenset()
    free = [q.name for q in parameters if not q.fixed and q.name not in idle]
    sought = sum(len({group_name(r, local[name]) for r in records}) if name in local else 1 for name in free)
    n_walks = len(disturbances.walking)
    of_records = int((~states.known).sum()) + len(records) * (len(disturbances.terms) + n_walks)
    if numbers <= sought + n_walks + of_records:
        raise DataError(
            f"the recordings have {numbers} measured values, and this fit has {sought + n_walks} parameters and "
            f"{of_records} initial states and trends to estimate; fix some (fixed=..., initial_state=...), or record "
            "more"
        )


def _of_responses(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    responses: Sequence[FrequencyData],
    options: FitArguments,
    given: Set[str],
) -> FitTask:
    """Return the task of a fit to frequency responses alone: no samples, windows or initial states."""
    refuse_other_options(options)
    names = responses[0].input_names, responses[0].output_names
    data = FitData((), np.nan, *names, ("",) * len(names[1]))
    states = InitialStates(np.zeros((0, 0)), np.zeros((0, 0), bool), "zero")
    with one_blas_thread():
        begin = response_start(structure, parameters, responses[0], given, from_data=options.start == "data")
    options = replace(options, focus="simulation", intersample="zoh", criterion="trace", window=None)
    return FitTask(
        structure, parameters, data, data, options, "zoh", states, UNDISTURBED, begin, None, tuple(responses)
    )


def with_options(parameters: tuple[Parameter, ...], options: FitArguments) -> tuple[Parameter, ...]:
    """Return the parameters with start values, fixed values and bounds of the caller."""
    start = {} if isinstance(options.start, str) else options.start or {}
    fixed, bounds = options.fixed or {}, options.bounds or {}
    profiled = () if options.profile == "all" else options.profile
    for what, given in (("start", start), ("fixed", fixed), ("bounds", bounds), ("profile", profiled)):
        known_names(parameters, given, what)
    changed = []
    for q in parameters:
        if q.name in fixed:
            changed.append(Parameter(q.name, float(fixed[q.name]), fixed=True, unit=q.unit))
            continue
        lower, upper = bounds.get(q.name, (q.lower, q.upper))
        stated = start.get(q.name, q.start)
        if options.start == "data" and stated is not None and not lower <= stated <= upper:
            stated = None  # it would be one of many starts of a match, and lies outside of the bounds of the caller
        changed.append(replace(q, start=stated, lower=lower, upper=upper))
    return tuple(changed)


# ---- Solution of a posed problem, with refinements: robust weights, missing outputs, shorter pieces, other minima.


@dataclass(frozen=True, eq=False)
class Optimum:
    """Solution of a posed problem.

    Attributes
    ----------
    problem : PosedProblem
        The problem.
    shooting : Shooting
        Its shooting problem, with as many steps of the integrator as the estimates need.
    solution : Solution
        Last iterate of the solver, with its status.
    integration_shift : (n_theta,) array or None
        How far the estimates move when the step of the integrator of a nonlinear structure, or the pieces of a
        scheduled one, are halved; None for any other structure.
    reweighted : Reweighted or None
        Weights of a robust loss; None for squared errors.
    weighted : WeightedErrors or None
        Filters of the errors; None without a model of the errors.
    notes : tuple of str
        Notes on other minima.
    """

    problem: PosedProblem
    shooting: Shooting
    solution: Solution
    integration_shift: FloatArray | None
    reweighted: Reweighted | None
    weighted: WeightedErrors | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """Limits of the refinements after a first solution: other minima, shorter pieces, missing outputs, gaps.

    Attributes
    ----------
    wide : float
        Part of a response that counts as its error at first: far from a resonance its slopes lead nowhere.
    gain_rounds : int
        Rounds of gains and variances after missing outputs.
    settled : float
        Relative change of the covariance of the innovations that is rest: that of its own estimate is far larger.
    most_slopes : int
        Pieces times parameters of one, which set the time of a pass; `piece_s` may ask for more.
    most_cuts : int
        Parts of a piece at once: the error of long pieces is of no order yet.
    piece_order : int
        Order of the error in the length of a piece: the mean of a straight course is exact to first order.
    same_loss : float
        Relative difference of losses below which the windows do not matter.
    no_gap : float
        Gap, of the states' size, that is none: the solver's tolerance.
    same_cost : float
        Difference of costs that is rounding, where a fit begins at its solution.
    strongly : float
        Correlation of neighbouring errors at which a minimum may not be the lowest.
    most_gains : int
        Gains of the grid: 16 combinations of signs.
    gain_starts : int
        Starts from another gain.
    """

    wide: float = 0.3
    gain_rounds: int = 60
    settled: float = 1e-3
    most_slopes: int = 1000
    most_cuts: int = 8
    piece_order: int = 2
    same_loss: float = 1e-3
    no_gap: float = 1e-6
    same_cost: float = 1e-9
    strongly: float = 0.5
    most_gains: int = 4
    gain_starts: int = 3


SEARCH = Search()


def minimise(problem: PosedProblem) -> Optimum:
    """Return the optimum of a posed problem.

    The disturbance gain begins anew where that leads lower; a nonlinear structure is integrated, and a course cut, as
    finely as the estimates need; last come the weights of a robust loss, or a model of the
    errors.
    """
    task = problem.task

    def run(start: FloatArray, shooting: Shooting = problem.shooting) -> Solution:
        return solve(shooting, start, task.options)

    def is_coarse(unknowns: FloatArray) -> bool:
        ahead.append(refinement(problem.shooting, unknowns))
        return ahead[0].off > REFINING.tolerated

    predictor, ahead = problem.shooting.groups[0].predictor, list[Refinement]()
    adapts = isinstance(predictor, NonlinearPredictor) and predictor.adapts and task.courses is None
    notes, start = tuple[str, ...](), problem.unknowns
    if not problem.shooting.parts:
        start = _nearer(problem.shooting, start)
    solution = solve(problem.shooting, start, task.options, is_coarse if adapts else None)
    first = solution.history[0].cost if solution.history else np.nan
    for _ in range(SEARCH.gain_starts):
        better = lower_elsewhere(problem.shooting, solution.unknowns) if solution.status.success else None
        if better is None:
            break
        other, iterations = run(better), solution.iterations
        ahead.clear()
        costs = [problem.shooting.at(each.unknowns).cost for each in (other, solution)]
        lower = other.status.success and costs[0] < costs[1]
        notes = (FOUND,) if lower else (*notes, SUSPECTED)
        solution = replace(other if lower else solution, iterations=iterations + other.iterations)
        if not lower:
            break
    if task.courses is not None:
        problem, solution, shift = _cut_finely(problem, solution, task.courses)
        shooting = problem.shooting
    else:
        shooting, solution, shift = integrated_finely(problem.shooting, solution, run, ahead)
    start = np.clip(problem.unknowns, *shooting.box)
    if kind_of(task.structure).nonlinear:
        solution = _without_gaps(shooting, start, solution, first)
    if solution.status.success:
        shooting, solution = _with_kalman_gains(shooting, solution, run)
    reweighted = weighted = None
    if task.loss is not None and solution.status.success:
        reweighted, solution = reweighted_solution(shooting, solution, task.loss, run)
    if task.options.errors == "ar" and solution.status.success:
        windows, known = problem.assembly.record_window, task.states.in_shooting(shooting.n_states)
        names = tuple(q.name for q in problem.assembly.free)
        weighting = WeightedProblem(shooting, windows, known, task.options, names)
        weighted, solution = weighted_solution(weighting, solution, start)
        notes = (*notes, *weighted.notes)
    return Optimum(problem, shooting, solution, shift, reweighted, weighted, notes)


def _nearer(shooting: Shooting, start: FloatArray) -> FloatArray:
    """Return the better start of a fit to responses: the given one, or a solution with large standard deviations."""
    wide = replace(shooting, responses=tuple(replace(each, relative=SEARCH.wide) for each in shooting.responses))
    points = start, solve(wide, start).unknowns
    return min(points, key=lambda unknowns: shooting.at(unknowns).cost)


def _with_kalman_gains(
    shooting: Shooting, solution: Solution, run: Callable[[FloatArray, Shooting], Solution]
) -> tuple[Shooting, Solution]:
    """Return problem and solution with Kalman gains after each gap, computed for the estimates.

    Each round takes gains and variances of the estimates before. At rest the predictions are those of the model, so the
    estimates are consistent; what the gains after gaps would tell of the noise in addition is not used.
    """
    det = shooting.criterion == "det"

    def changes(part: RecordGroup) -> bool:
        simple = isinstance(part.predictor, Predictor) and part.predictor.feedback is None
        gaps = any(segment.missing is not None for segment in part.blocks.segments)
        return bool(part.blocks.gains) and gaps and simple and (det or part.predictor.feeds_back)

    if not any(map(changes, shooting.parts)):
        return shooting, solution
    innovation = np.full((len(shooting.output_weights),) * 2, np.inf)
    for _ in range(SEARCH.gain_rounds):
        theta, starts = shooting.unpack(solution.unknowns)
        values = shooting.values(theta)
        before = innovation
        innovation = shooting.error_products(values, starts) / shooting.n_samples + np.diag(shooting.floors)
        if not np.isfinite(innovation).all():
            break
        parts = tuple(
            replace(part, blocks=with_kalman_gains(v, part.blocks, innovation, mixes=det)) if changes(part) else part
            for part, v in zip(shooting.parts, values, strict=True)
        )
        shooting = replace(shooting, parts=parts)
        following = run(solution.unknowns, shooting)
        solution, at_rest = following.after(solution, shooting)
        settled = np.abs(innovation - before).max() <= SEARCH.settled * np.abs(innovation).max()
        if (at_rest and settled) or not following.status.success:
            return shooting, solution
    return shooting, replace(solution, status=FitStatus.ITERATION_LIMIT)


# Scheduling signals are constant in pieces. The pieces act as the steps of an integrator, and they are shortened by the
# criterion of `gbid.identify.problem.integration`.


def _cut_finely(
    problem: PosedProblem, solution: Solution, courses: Courses
) -> tuple[PosedProblem, Solution, FloatArray | None]:
    """Return problem and solution with pieces so short that shorter pieces do not shift the estimates.

    Returns
    -------
    PosedProblem, Solution
        The last that converged.
    (n_theta,) array or None
        How far the estimates move when pieces are halved; None where no course changes.
    """
    shift = None
    for remaining in reversed(range(REFINING.rounds + 1)):
        largest = max(max(changes) for changes in courses.changes)
        if not (largest > 0 and solution.status.success):
            break
        shift, off = _shift_with(problem, solution, courses.cut(largest / 2, shortest=1))
        most = min(
            SEARCH.most_cuts,
            SEARCH.most_slopes / (courses.schedule.pieces * len(problem.shooting.parts[0].predictor.free)),
        )
        finer = courses.cut(largest / max(1.0, min((off / REFINING.aim) ** (1 / SEARCH.piece_order), most)))
        if not (remaining and off > REFINING.tolerated and finer.schedule.pieces > courses.schedule.pieces):
            break
        posed = replace(problem.task, courses=finer).cut_anew(problem, solution.unknowns)
        refined = solve(posed.shooting, posed.unknowns, problem.task.options)
        if not refined.status.success:
            break
        courses, problem = finer, posed
        solution = replace(refined, iterations=solution.iterations + refined.iterations)
    return problem, solution, shift


def _shift_with(problem: PosedProblem, solution: Solution, courses: Courses) -> tuple[FloatArray, float]:
    """Return the change of the estimates with shorter pieces, (n_theta,), and its size in standard deviations."""
    here, at = problem.shooting, solution.unknowns
    other = replace(problem.task, courses=courses).cut_anew(problem, at)
    shooting, start, (lower, upper) = other.shooting, other.unknowns, other.shooting.box
    iterate, estimates = shooting.at(start), np.arange(len(start)) < here.n_theta
    held = np.where(estimates, start, lower), np.where(estimates, start, upper)
    try:
        before = gauss_newton_step(here, here.at(at), at)
        after = gauss_newton_step(shooting, iterate, start)
        # Beside the motion of the estimates, the states close the gaps that the other pieces open.
        closing = gauss_newton_step(shooting, iterate, start, held)
    except (RuntimeError, ValueError):
        return np.full(here.n_theta, np.inf), np.inf
    # What is left of the way to the solution itself is no matter of the pieces.
    off = in_standard_deviations(shooting, iterate, after - closing) - solution.rest
    return (after[estimates] - before[: here.n_theta]) * here.theta_scale, max(off, 0.0)


def _without_gaps(shooting: Shooting, start: FloatArray, solution: Solution, first: float) -> Solution:
    """Return a solution with a status checked on whole records: small gaps grow in a sensitive motion.

    What did not converge has closed gaps, so that its loss is that of a simulation. It is no worse than the start,
    whose cost in windows is `first`: simulated it costs no less.
    """
    cost, slack = max(shooting.at(solution.unknowns).cost, shooting.exact_cost), 0.5 * float(np.log1p(SEARCH.same_loss))
    if (
        solution.status.success
        and cost <= first
        and passed_on(shooting, *shooting.unpack(solution.unknowns))[1] < SEARCH.no_gap
    ):
        return solution
    begun, at_start = simulated(shooting, start)
    if shooting.extra is not None:  # the start need not meet the constraints of the caller
        at_start = np.inf
    whole, simulated_cost = simulated(shooting, solution.unknowns)
    if solution.status.success and cost <= max(at_start, shooting.exact_cost) + SEARCH.same_cost:
        sensitive = not simulated_cost <= cost + slack
        return replace(solution, status=FitStatus.CONVERGED_IN_WINDOWS) if sensitive else solution
    status = FitStatus.WORSE_THAN_START if solution.status.success else solution.status
    return replace(solution, unknowns=whole if simulated_cost <= at_start else begun, status=status)


# With errors that the structure cannot whiten (a stiffening film, process noise) the criterion has several minima, far
# apart along the disturbance gain. At such a minimum a coarse grid of gains is looked over, all else held. Where the
# criterion is lower already, the fit begins again.

FOUND = FitNote.OTHER_MINIMUM(
    "the criterion has several minima along the disturbance gain: this result is the lowest one found"
)
SUSPECTED = FitNote.OTHER_MINIMUM(
    "the criterion has several minima along the disturbance gain: another start did not converge to a lower one, but "
    "there may be one; try fit_multistart"
)


def strongly_coloured(problem: Shooting, unknowns: FloatArray) -> bool:
    """Return whether neighbouring errors are strongly correlated, a sign of a local minimum."""
    return not neighbours(problem, unknowns) < SEARCH.strongly


def lower_elsewhere(problem: Shooting, unknowns: FloatArray) -> FloatArray | None:
    """Search the disturbance gain on a coarse grid with all other unknowns fixed; return a lower point, or None.

    Each gain is plus or minus the largest of them: sixteen points for the four gains of a bearing.

    Returns
    -------
    (n_unknowns,) array or None
        None where errors are not strongly coloured, or no point of the grid is lower.
    """
    lower, upper = (edge[: problem.n_theta] * problem.theta_scale for edge in problem.box)
    gains = [i for i in problem.noise if lower[i] < upper[i] and problem.prior.information[i] == 0]
    if not (0 < len(gains) <= SEARCH.most_gains and strongly_coloured(problem, unknowns)):
        return None
    joined, kept = in_one_window(problem)
    theta, starts = joined.unpack(unknowns[kept])
    least, best = joined.cost_alone(theta, starts), None
    size = np.abs(theta[gains]).max()
    for signs in product((-1.0, 1.0), repeat=len(gains)):
        candidate = theta.copy()
        candidate[gains] = np.clip(size * np.array(signs), lower[gains], upper[gains])
        cost = joined.cost_alone(candidate, starts)
        if cost < least:
            least, best = cost, candidate
    return None if best is None else in_windows(problem, joined, joined.pack(best, starts))
