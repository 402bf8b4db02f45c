"""What a fit was asked for: options checked, data gathered, start values found; and the problem posed from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypedDict, Unpack

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray, one_blas_thread
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.discretise import Hold
from gbid.identify.data import FitData, gather
from gbid.identify.disturbances import Disturbances, TrendName, asked_disturbances
from gbid.identify.predictor import Focus
from gbid.identify.problem.asked import Constraints, ExtraCost, with_extra_terms
from gbid.identify.problem.assemble import (
    Assembly,
    Scope,
    assemble,
    automatic_window,
    build_problem,
    full_start,
    unknown_bounds,
)
from gbid.identify.problem.hessian import GaussNewton
from gbid.identify.problem.nlp import Criterion, Shooting
from gbid.identify.problem.solve import NlpFunctions, Trouble, nlp_functions
from gbid.identify.problem.states import (
    InitialState,
    InitialStates,
    check_inputs_suffice,
    disturbance_starts,
    initial_states,
    without_disturbances,
)
from gbid.identify.start.scheduled_start import Courses, read_courses, scheduled_start, tied_equations
from gbid.identify.start.start import Begin, begin_values
from gbid.recording import Recording
from gbid.structure import (
    AnyStructure,
    Parameter,
    as_names,
    equations_of,
    kind_of,
    known_names,
)


class RequestOptions(TypedDict, total=False):
    """Options of `gbid.fit` that settle its problem."""

    inputs: str | Sequence[str] | None
    outputs: str | Sequence[str] | None
    focus: Focus
    intersample: Hold | Sequence[Hold] | None
    criterion: Criterion | Literal["auto"]
    output_weights: Sequence[float] | None
    start: Mapping[str, float] | Literal["data"] | None
    fixed: Mapping[str, float] | None
    bounds: Mapping[str, tuple[float, float]] | None
    prior: Mapping[str, tuple[float, float]] | None
    extra_cost: ExtraCost | None
    constraints: Constraints | None
    local: Mapping[str, Scope] | None
    trend: TrendName | Mapping[str, TrendName]
    hum: float | Sequence[float]
    initial_state: InitialState
    left_out: Mapping[str, Sequence[tuple[int, int]]] | None


class Posed(NamedTuple):
    """A problem posed for the solver.

    Attributes
    ----------
    parameters : tuple of Parameter
        Parameters of the structure, with those fixed that are.
    assembly : Assembly
        Parts, links and shared parameters.
    begin : dict of str to float
        Start values by full name.
    problem : Shooting
        The problem.
    unknowns, lower, upper : (n_unknowns,) array
        Start and bounds, scaled.
    """

    parameters: tuple[Parameter, ...]
    assembly: Assembly
    begin: dict[str, float]
    problem: Shooting
    unknowns: FloatArray
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True, eq=False)
class Request:
    """A request for a fit.

    Attributes
    ----------
    structure : Structure or NonlinearStructure
        The structure, without inputs for a free decay.
    parameters : tuple of Parameter
        Its parameters, with the starts, fixed values and bounds of the caller.
    data, undisturbed : FitData
        Data, and the same with trends and hum subtracted.
    inputs, outputs : tuple of str
        Signals or channels, as the caller named them.
    intersample : {"zoh", "foh"} or sequence of these
        Hold of the inputs.
    focus, criterion : str
        Focus and criterion.
    states : InitialStates
        Initial states.
    disturbances : Disturbances
        Trends and hum.
    first : Begin
        Start values, and where they come from.
    options : RequestOptions
        Options as they were given.
    courses : Courses or None
        Scheduling variables of a scheduled structure.
    """

    structure: AnyStructure
    parameters: tuple[Parameter, ...]
    data: FitData
    undisturbed: FitData
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    intersample: Hold | Sequence[Hold]
    focus: Focus
    criterion: Criterion
    states: InitialStates
    disturbances: Disturbances
    first: Begin
    options: RequestOptions
    courses: Courses | None = None

    def posed(self, own: Mapping[str, float], window: int | None, *, gain_held: bool = False) -> Posed:
        """Return the problem at start values by the structure's names, in windows of this many samples.

        `gain_held` fixes the parameters on which only the disturbance gain depends.
        """
        asked = self.options
        used = _with_gain_held(self.structure, self.parameters) if gain_held else self.parameters
        stated = tied_equations(self.structure, used, own, self.courses)
        assembly = assemble(
            stated.structure,
            stated.parameters,
            stated.begin,
            self.data,
            intersample=self.intersample,
            focus=self.focus,
            disturbances=self.disturbances,
            released=self.states.released,
            local=asked.get("local") or {},
            left_out=asked.get("left_out") or {},
            window=window,
            ties=stated.ties,
        )
        model = stated.structure, stated.begin
        per_record = disturbance_starts(self.disturbances, *model, self.data, self.intersample)
        begin = full_start(assembly, own, per_record)
        weights, prior = asked.get("output_weights"), asked.get("prior") or {}
        problem, unknowns = build_problem(assembly, self.data, self.criterion, weights, begin, prior)
        extra = asked.get("extra_cost"), asked.get("constraints")
        problem = with_extra_terms(problem, assembly, self.data, self.states, used, unknowns, *extra)
        return Posed(used, assembly, begin, problem, unknowns, *unknown_bounds(problem, assembly, self.states))


def request(structure: AnyStructure, recordings: Recording | Sequence[Recording], options: RequestOptions) -> Request:
    """Return a request for a fit, checked; see `gbid.fit`.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    focus, start = options.get("focus", "prediction"), options.get("start")
    wanted, fixed = options.get("criterion", "auto"), options.get("fixed") or {}
    _check(focus, wanted)
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    inputs, outputs, hold = options.get("inputs"), options.get("outputs"), options.get("intersample")
    in_names = as_names(structure.inputs if inputs is None else inputs)
    out_names = as_names(structure.outputs if outputs is None else outputs)
    hold = structure.intersample if hold is None else hold
    given = _given_starts(start)
    from_data = isinstance(start, str)
    parameters = _with_options(structure.parameters, given, fixed, options.get("bounds") or {}, from_data=from_data)
    data = gather(recordings, in_names, out_names, minimum=len(parameters) + 10)
    stated, structure = structure, equations_of(structure)
    scheduled = kind_of(structure).scheduled
    courses = read_courses(scheduled, recordings) if scheduled else None
    if courses is not None and not in_names:
        raise UsageError(f"{structure.name}: inputs=() is for structures with constant parameters")
    check_inputs_suffice(structure, data, parameters, no_inputs=not in_names)
    names = [record.name for record in data.records]
    states = initial_states(structure, parameters, options.get("initial_state", "auto"), names)
    if wanted == "auto":
        wanted = "det" if len(data.output_names) > 1 and options.get("output_weights") is None else "trace"
    trend, hum = options.get("trend", "none"), options.get("hum", ())
    disturbances = asked_disturbances(trend, hum, data.output_names, data.sample_time, focus)
    with one_blas_thread():
        undisturbed = without_disturbances(disturbances, data)
        if scheduled and courses:
            how = hold, focus, {*given, *fixed}
            first = scheduled_start(scheduled, parameters, undisturbed, courses, *how)
        else:
            first = begin_values(stated, parameters, undisturbed, hold, {*given, *fixed}, from_data=from_data)
    structure = structure if in_names else kind_of(structure).without_inputs()
    return Request(
        structure,
        parameters,
        data,
        undisturbed,
        in_names,
        out_names,
        hold,
        focus,
        wanted,
        states,
        disturbances,
        first,
        options,
        courses,
    )


def check_choices(choices: Mapping[str, tuple[str, tuple[str, ...]]]) -> None:
    """Refuse values of options that are none of their words."""
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            *others, last = map(repr, allowed)
            raise UsageError(f"{name} = {value!r}; choose {', '.join(others)} or {last}")


def _check(focus: str, criterion: str) -> None:
    check_choices(
        {
            "focus": (focus, ("prediction", "simulation")),
            "criterion": (criterion, ("auto", "trace", "det")),
        }
    )


def _with_gain_held(structure: AnyStructure, parameters: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    """Return the parameters with those fixed on which only the disturbance gain depends."""
    names = kind_of(structure).anatomy().gain_only
    return tuple(replace(q, fixed=True) if q.name in names and q.start is not None else q for q in parameters)


def _with_options(
    parameters: tuple[Parameter, ...],
    start: Mapping[str, float],
    fixed: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    *,
    from_data: bool,
) -> tuple[Parameter, ...]:
    """Return the parameters with the start values, fixed values and bounds of the caller."""
    for what, given in (("start", start), ("fixed", fixed), ("bounds", bounds)):
        known_names(parameters, given, what)
    changed = []
    for q in parameters:
        if q.name in fixed:
            changed.append(Parameter(q.name, float(fixed[q.name]), fixed=True, unit=q.unit))
            continue
        lower, upper = bounds.get(q.name, (q.lower, q.upper))
        stated = start.get(q.name, q.start)
        if from_data and stated is not None and not lower <= stated <= upper:
            stated = None  # it would be one of many starts of a match, and lies outside of the bounds of the caller
        changed.append(replace(q, start=stated, lower=lower, upper=upper))
    return tuple(changed)


def _given_starts(start: Mapping[str, float] | str | None) -> dict[str, float]:
    """Return the start values of the caller; none when they are to be found in the data."""
    if isinstance(start, str):
        if start != "data":
            raise UsageError(f"start = {start!r}; give values by name, or 'data' to find all of them in the recordings")
        return {}
    return dict(start or {})


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
    _posed: Posed = field(repr=False)

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


def fit_problem(
    structure: AnyStructure,
    recordings: Recording | Sequence[Recording],
    *,
    window: int | Literal["auto"] | None = "auto",
    **options: Unpack[RequestOptions],
) -> FitProblem:
    """Return the nonlinear programme that `gbid.fit` would solve, as functions of CasADi.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        The structure.
    recordings : Recording or sequence of Recording
        The recordings.
    window : int, None or "auto"
        Number of samples in a shooting window, as for `gbid.fit`.
    **options
        Options of `gbid.fit` that settle the problem: inputs, outputs, focus, intersample, criterion, output_weights,
        start, fixed, bounds, prior, extra_cost, constraints, local, trend, hum, initial_state,
        left_out.

    Returns
    -------
    FitProblem
        The problem at the start values.

    Raises
    ------
    UsageError, DataError
        As for `gbid.fit`.
    """
    asked = request(structure, recordings, options)
    samples = automatic_window(asked.data, asked.focus) if window == "auto" else window
    with one_blas_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        posed = asked.posed(asked.first.values, samples)
    problem = posed.problem
    states = kind_of(asked.structure).state_names
    starts = _names_of_starts(posed, [record.name for record in asked.data.records], states)
    return FitProblem(
        (*(q.name for q in posed.assembly.free), *starts),
        np.clip(posed.unknowns, posed.lower, posed.upper),
        posed.lower,
        posed.upper,
        problem.pack(np.ones(problem.n_theta), np.ones((problem.n_windows, problem.n_states))) ** -1,
        problem.n_gaps,
        nlp_functions(problem, GaussNewton(problem), Trouble()),
        posed,
    )


def _names_of_starts(posed: Posed, records: Sequence[str], states: Sequence[str]) -> list[str]:
    """Return the names of the states at the starts of all windows, in the order of the windows."""
    problem = posed.problem
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
