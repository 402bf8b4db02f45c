"""The problem of a fit: data gathered, start values found, and the shooting problem posed from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray, one_blas_thread
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.option_types import takes_options
from gbid.discretise import Hold
from gbid.identify.data import FitData, gather
from gbid.identify.disturbances import Disturbances, disturbances_of
from gbid.identify.options import Criterion, FitArguments
from gbid.identify.problem.assemble import (
    Assembly,
    assemble,
    automatic_window,
    build_problem,
    full_start,
    unknown_bounds,
    with_extra_terms,
)
from gbid.identify.problem.hessian import gauss_newton
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import NlpFunctions, Trouble, nlp_functions
from gbid.identify.problem.states import (
    InitialStates,
    check_inputs_suffice,
    disturbance_starts,
    initial_states,
    without_disturbances,
)
from gbid.identify.robust import RobustLoss, robust_loss
from gbid.identify.start.scheduled_start import Courses, read_courses, scheduled_start, tied_equations
from gbid.identify.start.start import Begin, begin_values
from gbid.identify.uncertainty.coloured import Bootstrap, bootstrap_of
from gbid.recording import Recording
from gbid.structure import (
    AnyStructure,
    Parameter,
    as_names,
    equations_of,
    kind_of,
    known_names,
)

Recordings = Recording | Sequence[Recording]


@dataclass(frozen=True, eq=False)
class FitTask:
    """Structure, data and options of a fit, which all attempts at it share.

    Attributes
    ----------
    structure : Structure or NonlinearStructure
        The structure, without inputs for a free decay.
    parameters : tuple of Parameter
        Its parameters, with the starts, fixed values and bounds of the caller.
    data, undisturbed : FitData
        Data, and the same with trends and hum subtracted.
    options : FitArguments
        Options, with the names of inputs and outputs.
    hold : {"zoh", "foh"} or sequence of these
        Hold of the inputs.
    criterion : {"trace", "det"}
        Criterion.
    states : InitialStates
        Initial states: estimated, fixed, or functions of the parameters.
    disturbances : Disturbances
        Trends and hum.
    loss : RobustLoss or None
        Robust loss; None for squared errors.
    bootstrap : Bootstrap or None
        Bootstrap of the standard deviations; None without one.
    begin : Begin
        Start values, and where they come from.
    courses : Courses or None
        Scheduling variables of a scheduled structure.
    """

    structure: AnyStructure
    parameters: tuple[Parameter, ...]
    data: FitData
    undisturbed: FitData
    options: FitArguments
    hold: Hold | Sequence[Hold]
    criterion: Criterion
    states: InitialStates
    disturbances: Disturbances
    loss: RobustLoss | None
    bootstrap: Bootstrap | None
    begin: Begin
    courses: Courses | None

    def problem(self, start: Mapping[str, float], window: int | None, *, gain_held: bool = False) -> PosedProblem:
        """Return the shooting problem for start values by the structure's names, in windows of this many samples.

        `gain_held` fixes the parameters on which only the disturbance gain depends.
        """
        options = replace(self.options, intersample=self.hold, criterion=self.criterion, window=window)
        parameters = self.parameters
        if gain_held:
            gains = kind_of(self.structure).anatomy().gain_only
            parameters = tuple(
                replace(q, fixed=True) if q.name in gains and q.start is not None else q for q in parameters
            )
        tied = tied_equations(self.structure, parameters, start, self.courses)
        assembly = assemble(
            tied.structure,
            tied.parameters,
            tied.begin,
            self.data,
            options,
            disturbances=self.disturbances,
            released=self.states.released,
            ties=tied.ties,
        )
        per_record = disturbance_starts(self.disturbances, tied.structure, tied.begin, self.data, self.hold)
        begin = full_start(assembly, start, per_record)
        shooting, unknowns = build_problem(assembly, self.data, options, begin)
        shooting = with_extra_terms(shooting, assembly, self.data, self.states, parameters, unknowns, options)
        return PosedProblem(
            self,
            start,
            window,
            parameters,
            assembly,
            begin,
            shooting,
            unknowns,
            unknown_bounds(shooting, assembly, self.states),
        )


@dataclass(frozen=True, eq=False)
class PosedProblem:
    """A problem posed for the solver, from one start and in windows of one length.

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
    box : (n_unknowns,) array, (n_unknowns,) array
        Bounds, scaled.
    """

    task: FitTask
    start: Mapping[str, float]
    window: int | None
    parameters: tuple[Parameter, ...]
    assembly: Assembly
    begin: dict[str, float]
    shooting: Shooting
    unknowns: FloatArray
    box: tuple[FloatArray, FloatArray]


def pose(structure: AnyStructure, recordings: Recordings, options: FitArguments) -> FitTask:
    """Return the task of a fit: names and data checked, start values found.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    inputs = as_names(structure.inputs if options.inputs is None else options.inputs)
    outputs = as_names(structure.outputs if options.outputs is None else options.outputs)
    hold = structure.intersample if options.intersample is None else options.intersample
    from_data = options.start == "data"
    parameters = _with_options(structure.parameters, options)
    data = gather(recordings, inputs, outputs, minimum=len(parameters) + 10)
    by_default: Criterion = "det" if len(data.output_names) > 1 and options.output_weights is None else "trace"
    criterion = by_default if options.criterion == "auto" else options.criterion
    options = replace(options, inputs=inputs, outputs=outputs)
    stated, structure = structure, equations_of(structure)
    scheduled = kind_of(structure).scheduled
    courses = read_courses(scheduled, recordings) if scheduled else None
    if courses is not None and not inputs:
        raise UsageError(f"{structure.name}: inputs=() is for structures with constant parameters")
    check_inputs_suffice(structure, data, parameters, no_inputs=not inputs)
    names = [record.name for record in data.records]
    states = initial_states(structure, parameters, options.initial_state, names)
    disturbances = disturbances_of(options, data.output_names, data.sample_time)
    loss = robust_loss(options, len(data.output_names))
    given = {*({} if from_data else options.start or {}), *(options.fixed or {})}
    with one_blas_thread():
        undisturbed = without_disturbances(disturbances, data)
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
        criterion,
        states,
        disturbances,
        loss,
        bootstrap_of(options),
        begin,
        courses,
    )


def _with_options(parameters: tuple[Parameter, ...], options: FitArguments) -> tuple[Parameter, ...]:
    """Return the parameters with the start values, fixed values and bounds of the caller."""
    start = {} if isinstance(options.start, str) else options.start or {}
    fixed, bounds = options.fixed or {}, options.bounds or {}
    for what, given in (("start", start), ("fixed", fixed), ("bounds", bounds)):
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


# ---- The nonlinear programme of a fit as functions of CasADi.


@dataclass(frozen=True, eq=False)
class FitProblem(Brief):
    """Nonlinear programme of a fit: multiple shooting in scaled unknowns.

    The unknowns are the free parameters and the states at the starts of the shooting windows. Times `scale` they are in
    their own units. The cost is half the logarithm of the criterion. The constraints are the gaps between windows, and
    the constraints of the caller.

    Attributes
    ----------
    names : tuple of str
        Names of the unknowns; ``"run 1[3].x2"`` is the second state at the start of the fourth window of a recording.
    start, lower, upper : (n,) array
        Start and bounds of the unknowns, scaled.
    scale : (n,) array
        Scales of the unknowns.
    n_gaps : int
        Number of the constraints that are gaps; they are the first.
    functions : NlpFunctions
        Functions of CasADi as ``casadi.nlpsol`` takes them, with the bounds of the constraints.
    """

    names: tuple[str, ...]
    start: FloatArray
    lower: FloatArray
    upper: FloatArray
    scale: FloatArray
    n_gaps: int
    functions: NlpFunctions
    _posed: PosedProblem = field(repr=False)

    def _brief(self) -> Description:
        about = f"{len(self.names)} unknowns, {len(self.functions.lower)} constraints, {self.n_gaps} of them gaps"
        return brief(self, about, parameters=[q.name for q in self._posed.assembly.free])

    def cost(self, x: Any) -> Any:
        """Return the cost.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.value(x)[0]

    def constraints(self, x: Any) -> Any:
        """Return the constraints: gaps, then those of the caller.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.value(x)[1]

    def gradient(self, x: Any) -> Any:
        """Return the gradient of the cost.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.gradient(x, [])[1]

    def jacobian(self, x: Any) -> Any:
        """Return the Jacobian of the constraints, sparse.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        """
        return self.functions.jacobian(x, [])[1]

    def hessian(self, x: Any, multipliers: Any = 0) -> Any:
        """Return the Hessian of the Lagrangian, sparse and symmetric.

        That of the squared errors is the one of Gauss and Newton, without second derivatives of the predictions. That
        of an extra cost and, times the `multipliers` of the constraints, of constraints of the caller is exact.

        Parameters
        ----------
        x : (n,) array or casadi.MX
            Scaled unknowns.
        multipliers : (m,) array or casadi.MX
            Multipliers of the constraints; zero by default.
        """
        return ca.triu2symm(self.functions.hessian(x, [], 1, multipliers))

    @property
    def sparsity(self) -> dict[Literal["jacobian", "hessian"], ca.Sparsity]:
        """Sparsity of the Jacobian of the constraints, and of the upper triangle of the Hessian."""
        return {"jacobian": self.functions.jacobian.sparsity_out(1), "hessian": self.functions.hessian.sparsity_out(0)}

    @property
    def nlp(self) -> dict[str, ca.MX]:
        """The programme for ``casadi.nlpsol(name, plugin, nlp, {**functions.derivatives, ...})``."""
        x = ca.MX.sym("x", len(self.names))
        f, g = self.functions.value(x)
        return {"x": x, "f": f, "g": g}

    def parameters(self, x: Any) -> dict[str, float]:
        """Return the parameters by name, in their own units.

        Parameters
        ----------
        x : (n,) array
            Scaled unknowns.
        """
        own = np.asarray(x, float).ravel() * self.scale
        return {q.name: float(v) for q, v in zip(self._posed.assembly.free, own, strict=False)}


@takes_options(FitArguments)
def fit_problem(structure: AnyStructure, recordings: Recordings, options: FitArguments) -> FitProblem:
    """Return the nonlinear programme that `gbid.fit` would solve, as functions of CasADi.

    Options of the solver and of the standard deviations have no effect.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        The structure.
    recordings : Recording or sequence of Recording
        The recordings.
    **options

    Returns
    -------
    FitProblem
        The problem at the start values.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    task = pose(structure, recordings, options)
    samples = automatic_window(task.data, options.focus) if options.window == "auto" else options.window
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        posed = task.problem(task.begin.values, samples)
    shooting = posed.shooting
    states = kind_of(task.structure).state_names
    starts = _names_of_starts(posed, [record.name for record in task.data.records], states)
    return FitProblem(
        (*(q.name for q in posed.assembly.free), *starts),
        np.clip(posed.unknowns, *posed.box),
        *posed.box,
        shooting.pack(np.ones(shooting.n_theta), np.ones((shooting.n_windows, shooting.n_states))) ** -1,
        shooting.n_gaps,
        nlp_functions(shooting, gauss_newton(shooting), Trouble()),
        posed,
    )


def _names_of_starts(posed: PosedProblem, records: Sequence[str], states: Sequence[str]) -> list[str]:
    """Return the names of the states at the starts of all windows, in the order of the windows."""
    problem = posed.shooting
    following = {int(a): int(b) for a, b in problem.links}
    named: dict[int, str] = {}
    for name, window in zip(records, posed.assembly.record_window, strict=True):
        at, count = int(window), 0
        named[at] = f"{name}[0]"
        while at in following:
            at, count = following[at], count + 1
            named[at] = f"{name}[{count}]"
    own = [*states, *(f"x{i + 1}" for i in range(len(states), problem.n_states))]
    return [f"{named[i]}.{state}" for i in range(problem.n_windows) for state in own]
