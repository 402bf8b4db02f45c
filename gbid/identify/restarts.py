"""Attempts of a fit: other window lengths, and other start values after an unstable or wrong result.

===  ===============================  ===============================  =====  ==========================================
no   start values                     windows                          gain   tried
===  ===============================  ===============================  =====  ==========================================
1    stated, or from the data         usual, half, four times as long  free   always, each where the last fails
1a   as 1                             as 1                             held   where its predictor is almost unstable
1b   solution of 1                    tenfold growth at most           free   where it runs away within its windows
1c   from the data                    as 1, 1a, 1b                     free   where 1 is doubtful
1d   as 1, gain of a steady observer  as 1, 1a, 1b                     free   in place of 1, where a mode of that lasts
1e   as 1, with initial states held   as 1                             free   where any ends at the edge of stability
2    of a fit with a steady observer  as 1, 1a, 1b                     free   where 1, 1c or 1d fails
2a   as 2                             tenfold growth at most           free   where the plant itself is unstable
3    as 1                             tenfold growth at most           free   where 1 is unstable and 2 is not good
4    of a fit in windows of 16        16                               free   nonlinear: where 1 fails or is doubtful
     samples with open gaps
4a   the same with 8, then 64         8, then 64                       free   where 4 neither is good nor agrees with 1
5    as 1                             one                              free   nonlinear: where 4a neither is nor agrees
===  ===============================  ===============================  =====  ==========================================

A structure is linear in 1c, 1d, 2 and 3. A nonlinear one with stated start values has only the usual length in 1. Of
its attempts the one of lowest loss is the result; where that is doubtful, another must have ended there, too.

Each attempt looks for other minima along the disturbance gain as well (`gbid.identify.pose.minimise`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Any

import casadi as ca
import numpy as np
import scipy

from gbid.core.arrays import FloatArray
from gbid.core.errors import GbidError
from gbid.core.notes import FitNote
from gbid.discretise.exact import discretise
from gbid.identify.data import moves
from gbid.identify.disturbances import UNDISTURBED
from gbid.identify.judge import judge
from gbid.identify.options import FitArguments
from gbid.identify.pose import FitTask, Optimum, PosedProblem, minimise, strongly_coloured
from gbid.identify.problem.assemble import automatic_window
from gbid.identify.problem.solve import solve, solve_apart
from gbid.identify.problem.states import initial_states
from gbid.identify.result import FitResult, FitStatus
from gbid.identify.start.start import begin_values, plant_data
from gbid.identify.uncertainty.omitted import omitted_effect
from gbid.structure import LinearModel, LinearStructure, Parameter, Structure
from gbid.structure.kinds import kind_of
from gbid.structure.linear import evaluate, symbolic_matrices


@dataclass(frozen=True)
class Policy:
    """Limits that decide on further attempts of a fit.

    Attributes
    ----------
    growth : float
        Largest growth of a model that counts as stable over a record, and that a shooting window may contain: with
        more, the end of a window says nothing about its start.
    runaway : float
        Growth of a solution within its windows at which it is solved again in shorter ones.
    shortest : int
        Samples in the shortest window.
    most_windows : int
        Largest number of windows for an unstable start: each has its own states, and more take minutes.
    apart : tuple of int
        Samples in the windows with open gaps. Short ones have no other minimum nearby: 16 are a third of a period of
        what is sampled well, 8 of what is sampled badly, and 64 are for noise that hides what happens in 16.
    most_states : int
        Largest number of states at the starts of these windows, which are longer in long recordings: with ten thousand
        the steps that judge the solution take a minute.
    lower : float
        Relative difference of losses that a note tells.
    enough_iterations : int
        With fewer, what the caller wants is the way from the start, not another start.
    """

    growth: float = 10.0
    runaway: float = 1e3
    shortest: int = 4
    most_windows: int = 3000
    apart: tuple[int, ...] = (16, 8, 64)
    most_states: int = 1500
    lower: float = 1e-3
    enough_iterations: int = 50


POLICY = Policy()


@dataclass(frozen=True)
class Attempt:
    """One attempt of a fit.

    Attributes
    ----------
    result : FitResult
        The result.
    rate : float
        Largest growth of the predictor in a sample, at the solution.
    doubtful : bool
        Whether the residuals are so strongly correlated that this may be another minimum.
    optimum : Optimum
        Solved problem of the result.
    """

    result: FitResult
    rate: float
    doubtful: bool
    optimum: Optimum

    @property
    def loss(self) -> float:
        """Loss of the result; infinite without a loss."""
        return self.result.loss if np.isfinite(self.result.loss) else np.inf

    @property
    def held(self) -> bool:
        """Whether the free disturbance gain was fixed because the predictor was nearly unstable."""
        return any(FitNote.GAIN_HELD.value in note for note in self.result.notes)

    @property
    def good(self) -> bool:
        """Whether the fit converged to a reliable minimum, with a free disturbance gain estimated."""
        return self.result.success and not (self.doubtful or self.held)

    @property
    def questionable(self) -> bool:
        """Whether the residuals leave room for another minimum: strongly correlated, or following an input."""
        return self.doubtful or self.result.trusted == "none"

    def agrees(self, others: Sequence[Attempt]) -> bool:
        """Return whether the fit converged, and another attempt reached an equal loss."""
        losses = [other.loss for other in others if other.result.success]
        return self.result.success and any(abs(loss - self.loss) <= POLICY.lower * self.loss for loss in losses)

    def noted(self, note: str) -> Attempt:
        """Return the attempt with an additional note."""
        return replace(self, result=self.result.noted(note))


def solved(problem: PosedProblem) -> Attempt:
    """Return the attempt that solves a posed problem."""
    optimum = minimise(problem)
    result, shooting, unknowns = judge(optimum), optimum.shooting, optimum.solution.unknowns
    decays = not any(moves(record.inputs).any() for record in problem.task.data.records)
    doubtful = (
        result.trusted != "white"
        and optimum.weighted is None
        and (decays or strongly_coloured(shooting, unknowns))  # a decay has no input that residuals would follow
    )
    return Attempt(result, shooting.rate(*shooting.unpack(unknowns)), doubtful, optimum)


def windows_of(task: FitTask, rate: float = 1.0) -> tuple[int | None, ...]:
    """Return the window lengths to try in turn, until one converges.

    They are shortened so that a model that grows at this rate in a sample grows tenfold at most in one; those of the
    caller stay.
    """
    options = task.options
    if options.window != "auto":
        return (options.window,)
    usual = automatic_window(task.data, options.focus, kind_of(task.structure).anatomy().n_states)
    windows = usual, max(16, usual // 2), 4 * usual
    if not rate > 1:
        return windows
    longest = max(POLICY.shortest, int(log(POLICY.growth) / log(rate))) if np.isfinite(rate) else POLICY.shortest
    return tuple(dict.fromkeys(min(samples, longest) for samples in windows))


_MISSING = (FitNote.LEFT_OUT, FitNote.FEEDBACK)  # notes on residuals that follow something


def best_attempt(task: FitTask) -> FitResult:
    """Return the first converged result, else the one of smallest loss; notes mention other attempts.

    Where its residuals follow an input, a note names effect that may be missing.
    """
    attempt = with_other_delays(task, _best_attempt(task))
    result = attempt.result
    if not any(kind.value in note for kind in _MISSING for note in result.notes):
        return result
    effect = omitted_effect(attempt.optimum)
    return result.noted(FitNote.MISSING(effect)) if effect else result


def _best_attempt(task: FitTask) -> Attempt:
    ladder, stated, windows = Ladder(task), task.begin.values, windows_of(task)
    enough = task.data.records and task.options.max_iterations >= POLICY.enough_iterations
    may_restart = bool(enough) and ("data" not in task.begin.origin.values() or bool(task.begin.notes))
    nonlinear = kind_of(task.structure).nonlinear and may_restart
    attempts = list[Attempt]()
    steady = None if nonlinear else gain_start(ladder, ladder.lasts if may_restart else ladder.grows)
    if steady and (other := ladder.in_turn(steady, windows)):
        text = "a mode of the start values lasts: the fit began with the gain of a steady observer (Kalman filter)"
        attempts.append(other.noted(FitNote.BEGUN_ELSEWHERE(text)))
        if other.good:
            return attempts[0]
    first = ladder.in_turn(stated, windows[:1] if nonlinear else windows)
    attempts += [first] if first else []
    if first:
        # a local minimum leaves something out as well
        good = first.good and (nonlinear or not first.questionable)
        final = good or not (may_restart or first.held) or first.result.status is FitStatus.NOT_DETERMINED
        if final:
            return first
    if nonlinear:
        return _confirmed(ladder.in_other_windows(attempts))
    if first and first.result.success and not first.held:
        start = data_start(task)
        other = ladder.in_turn(start, windows) if start else None
        if other and other.result.success:
            text = "the fit began at values from the data, which led to a lower loss than the given ones"
            return _lowest([first, other.noted(FitNote.BEGUN_ELSEWHERE(text))])
    if (start := observer_start(task)) is not None:
        other, unstable = ladder.in_turn(start, windows), ""
        if other is None:  # the plant itself is unstable
            other = ladder.in_turn(start, windows_of(task, ladder.rate(start)), unstable=True)
        if other and ladder.grows(other.rate):
            unstable = ", and the plant is unstable as well"
        why = "" if first else f"the start values are unstable{unstable}: "
        text = f"{why}the fit began at values of a fit with a steady observer (Kalman filter)"
        attempts += [other.noted(FitNote.BEGUN_ELSEWHERE(text))] if other else []
    if first is None and not any(attempt.good for attempt in attempts):
        shortened = windows_of(task, ladder.rate(stated))
        if shortened[0] is None or task.data.n_samples / shortened[0] < POLICY.most_windows:
            text = "the start values are unstable: shooting windows were bounded by their growth"
            other = ladder.in_turn(stated, shortened, unstable=True)
            attempts += [other.noted(FitNote.WINDOWS_CHANGED(text))] if other else []
    if not attempts:  # no observer, too many windows for the start itself
        attempts.append(solved(task.problem(stated, windows[0])))
    return _lowest(attempts)


@dataclass(frozen=True, eq=False)
class Ladder:
    """Attempts of a fit, in sequence."""

    task: FitTask

    @property
    def longest(self) -> int:
        """Number of samples in the longest record."""
        return max((record.n_samples for record in self.task.data.records), default=0)

    def grows(self, rate: float, most: float = POLICY.growth, samples: int | None = None) -> bool:
        """Return whether a growth rate per sample means instability over a record, or over `samples`."""
        return not log(max(rate, 1e-300)) * (self.longest if samples is None else samples) <= log(most)

    def lasts(self, rate: float) -> bool:
        """Return whether a rate per sample means growth, or a decay of less than tenfold over a record."""
        return not -log(max(rate, 1e-300)) * self.longest >= log(POLICY.growth)

    def rate(self, start: Mapping[str, float]) -> float:
        """Return the predictor's largest growth per sample, at given start values."""
        return _rate(self.task.problem(start, windows_of(self.task)[0]))

    def in_turn(
        self, start: Mapping[str, float], windows: Sequence[int | None], *, unstable: bool = False
    ) -> Attempt | None:
        """Return the first converged attempt over the window lengths, else the one of smallest loss.

        A solution that runs away is solved again in windows that bound its growth. None for an unstable start, but with
        `unstable`, where its windows are so short already.
        """
        tried = list[Attempt]()
        for window in windows:
            problem = self.task.problem(start, window)
            if not unstable and self.grows(_rate(problem)):
                return None
            tried.append(solved(problem))
            status = tried[-1].result.status
            if status.success or status is FitStatus.SHAFT_AS_MODE:
                break
            held = [other] if (other := self._with_states_held(problem, tried[-1])) else []
            if status is FitStatus.UNSTABLE_PREDICTOR and len(windows) > 1:
                held.append(self._bounded(self._with_gain_held(start, window), unstable=unstable))
            if held:
                return min(held, key=lambda attempt: (not attempt.result.success, attempt.loss))
        best = tried[-1] if tried[-1].result.success else min(tried, key=lambda attempt: attempt.loss)
        others = ", ".join(str(each.result.options.window) for each in tried if each is not best)
        text = f"windows of {others} samples did not converge; this is the result with {best.result.options.window}"
        return self._bounded(best.noted(FitNote.WINDOWS_CHANGED(text)) if others else best, unstable=unstable)

    def _with_states_held(self, problem: PosedProblem, attempt: Attempt) -> Attempt | None:
        """Return a converged attempt with a stable predictor where a solution stopped at the edge of stability.

        There the response to an estimated initial state lasts for a whole record, and takes the place of errors. The
        initial states are fixed at their start values, then estimated from the solution. None where they are known.
        """
        states = self.task.states
        if states.known.all() or not (problem.shooting.noise and self.lasts(attempt.rate)):
            return None
        begins = problem.shooting.unpack(problem.unknowns)[1][problem.assembly.record_window, : states.values.shape[1]]
        fixed = replace(self.task, states=replace(states, values=np.where(states.known, states.values, begins)))
        held = solved(fixed.problem(problem.start, problem.window))
        if not held.result.success or self.lasts(held.rate):
            return None
        if held.loss < attempt.loss:
            estimates = {name: v for name, v in held.result.parameters.items() if "[" not in name}
            free = solved(self.task.problem({**problem.start, **estimates}, problem.window))
            if free.result.success:
                return free
        text = (
            "with estimated initial states the predictor becomes almost unstable: they are held at their start values"
        )
        return held.noted(FitNote.STATES_HELD(text))

    def _with_gain_held(self, start: Mapping[str, float], window: int | None) -> Attempt:
        """Return an attempt with the disturbance gain fixed at its start value.

        With another gain its estimates would be others, unless the recordings show that disturbances do not move a
        mode: then it is no success.
        """
        held = solved(self.task.problem(start, window, gain_held=True))
        if held.result.success:
            may_cover_less = any(FitNote.MAY_COVER_LESS.value in note for note in held.result.notes)
            status = FitStatus.GAIN_NOT_DETERMINED if may_cover_less else FitStatus.CONVERGED_GAIN_HELD
            held = replace(held, result=held.result.changed(status=status))
        note = "a free disturbance gain led to an almost unstable predictor: it is fixed at its start value"
        return held.noted(FitNote.GAIN_HELD(note))

    def _bounded(self, attempt: Attempt, *, unstable: bool) -> Attempt:
        """Return a new fit of a diverging solution, in windows that bound its growth; else the given attempt.

        The plant is unstable then, or a part of it went astray.
        """
        result, rate = attempt.result, attempt.rate
        if unstable or self.task.options.window != "auto" or not np.isfinite(rate):
            return attempt
        if not (self.grows(rate) and self.grows(rate, POLICY.runaway, result.options.window)):
            return attempt
        estimates = {name: v for name, v in result.parameters.items() if "[" not in name}
        again = solved(self.task.problem({**result.start, **estimates}, windows_of(self.task, rate)[0]))
        if not (again.result.success or again.result.loss < result.loss):
            return attempt
        text = "the model is unstable: shooting windows were bounded by its growth"
        return again.noted(FitNote.WINDOWS_CHANGED(text))

    def in_other_windows(self, attempts: list[Attempt]) -> list[Attempt]:
        """Return fits of a nonlinear structure in windows of other lengths, until one is good or two agree."""
        task, chosen = self.task, self.task.options.window
        states = kind_of(task.structure).anatomy().n_states
        for length in POLICY.apart:
            window = max(length, task.data.n_samples * states // POLICY.most_states)
            try:
                start = start_in_windows(task, window)
                other = solved(task.problem(start, window if chosen == "auto" else chosen))
            except GbidError:  # the equations may have no value there, or be stiff
                continue
            text = f"the fit began at values of a fit in windows of {window} samples with open gaps"
            attempts = [*attempts, other.noted(FitNote.BEGUN_ELSEWHERE(text))]
            if other.good or other.agrees(attempts[:-1]):
                return attempts
        if chosen == "auto":
            text = "windows of other lengths did not converge to a successful fit; this is the result with one"
            return [*attempts, solved(task.problem(task.begin.values, None)).noted(FitNote.WINDOWS_CHANGED(text))]
        return attempts or [solved(task.problem(task.begin.values, chosen))]


def _rate(problem: PosedProblem) -> float:
    """Return the predictor's largest growth per sample, at the start values of a problem."""
    return problem.shooting.rate(*problem.shooting.unpack(problem.unknowns))


def _confirmed(attempts: Sequence[Attempt]) -> Attempt:
    """Return the nonlinear attempt of lowest loss; a success if it is good or another attempt agrees."""
    least = min(attempt.loss for attempt in attempts)
    low = [each for each in attempts if not each.result.loss > least * (1 + POLICY.lower)]
    converged = [each for each in low if each.result.success]
    best = min(converged or low, key=lambda each: round(each.result.loss / least, 6))  # of equals the first
    if not best.result.success or best.good or best.agrees([each for each in attempts if each is not best]):
        return best
    return replace(best, result=best.result.changed(status=FitStatus.WINDOWS_DISAGREE))


_DOUBTFUL = (
    "neighbouring residuals are strongly correlated: this may be a minimum that is not the lowest; try other start "
    "values (fit_multistart)"
)


def _lowest(attempts: Sequence[Attempt]) -> Attempt:
    """Return the converged attempt of lowest loss, else the lowest; notes mention a lower unconverged one."""
    finite = [each for each in attempts if np.isfinite(each.loss)] or attempts
    lowest = min(finite, key=lambda each: each.loss)
    best = min((each for each in finite if each.result.success), key=lambda each: each.loss, default=lowest)
    notes = list[str]()
    if best.loss > lowest.loss + POLICY.lower * abs(lowest.loss):
        text = f"another attempt ended lower, at a loss of {lowest.loss:.6g}, but did not converge"
        notes.append(FitNote.OTHER_MINIMUM(text))
    if best.result.success and any(each.result.status is FitStatus.SHAFT_AS_MODE for each in attempts):
        text = "from other start values a mode becomes the rotation of the shaft: remove run-out and unbalance"
        notes.append(FitNote.SHAFT(text))
    others = [each for each in attempts if each is not best]
    if best.result.success and (best.doubtful or (others and best.questionable)) and not best.agrees(others):
        notes.append(FitNote.OTHER_MINIMUM(_DOUBTFUL))
    return replace(best, result=best.result.noted(*notes))


# ---- Delays behind inputs that nearly repeat: whole and half periods away the fit has other minima.

_REPEATS = 0.5  # least magnitude of an input's correlation with itself at a lag that counts as (half) a period
_ROUNDS = 8
_CHANCE = 3.0  # difference of log-likelihoods within which noise decides between two delays


def with_other_delays(task: FitTask, attempt: Attempt) -> Attempt:
    """Return the attempt of lowest loss after moves of single delays by half and whole periods of their inputs.

    Only delays behind inputs that nearly repeat have other minima so far away; other inputs cost one spectrum. A note
    names moves that lead to nearly the same loss.
    """
    lags = delay_lags(task) if attempt.result.success and attempt.loss > 0 else {}
    first, close = attempt, set[str]()
    for _ in range(_ROUNDS if lags else 0):
        best, close = attempt, set[str]()
        for q in attempt.optimum.problem.parameters:
            for lag in lags.get(q.name, ()):
                values = {name: v for name, v in attempt.result.parameters.items() if "[" not in name}
                delay = values[q.name] + lag
                if not q.lower <= delay <= q.upper:
                    continue
                other = solved(
                    task.problem({**attempt.result.start, **values, q.name: delay}, attempt.optimum.problem.window)
                )
                size, here = other.optimum.shooting.likelihood_size, attempt.result.parameters[q.name]
                if not other.result.success or abs(other.result.parameters[q.name] - here) < abs(lag) / 4:
                    continue
                if other.loss < best.loss:
                    best = other
                elif 0.5 * log(other.loss / attempt.loss) * size < _CHANCE:
                    close.add(f"{q.name} = {other.result.parameters[q.name]:.4g}")
        if best is attempt:
            break
        attempt = best
    if attempt is not first:
        text = "the fit began with a delay moved by a period of its input, which led to a lower loss"
        attempt = _lowest([attempt.noted(FitNote.BEGUN_ELSEWHERE(text)), first])
    if close:
        text = f"inputs that nearly repeat do not tell delays apart: {', '.join(sorted(close))} fits as well"
        attempt = attempt.noted(FitNote.OTHER_MINIMUM(text))
    return attempt


def delay_lags(task: FitTask) -> dict[str, tuple[float, ...]]:
    """Return the moves [s] of each delay parameter at which its input nearly repeats, to both sides."""
    linear = kind_of(task.structure).linear
    if linear is None or not task.data.records or task.data.is_irregular:
        return {}
    p, m = symbolic_matrices(linear)
    if not m.has_delay:
        return {}
    record = max(task.data.records, key=lambda each: each.n_samples)
    rows = np.array(ca.DM(ca.jacobian(m.delay, p).sparsity(), 1)) != 0
    lags: dict[str, tuple[float, ...]] = {}
    for j, q in enumerate(linear.parameters):
        for i in np.flatnonzero(rows[:, j]):
            away = [k * task.data.sample_time for k in _repeats(record.inputs[:, i])]
            lags[q.name] = (*lags.get(q.name, ()), *away, *(-lag for lag in away))
    return {name: values for name, values in lags.items() if values}


def _repeats(u: FloatArray) -> list[int]:
    """Return the first two lags [samples] at which a signal nearly repeats, or repeats with the other sign."""
    n, u = len(u), u - u.mean()
    spectrum = np.fft.rfft(u, 2 * n)
    r = np.fft.irfft(spectrum * spectrum.conj())[: n // 2] / np.arange(n, n - n // 2, -1)
    size = np.abs(r) / max(r[0], 1e-300) if n > 3 else np.zeros(1)
    first = int(np.argmax(size < _REPEATS))  # the main lobe
    peaks = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:]) & (size[1:-1] > _REPEATS)) + 1
    return [int(k) for k in peaks[peaks > first][:2]] if first else []


_ROUGHLY = 50  # iterations: start values need not be exact


def start_in_windows(task: FitTask, window: int) -> dict[str, float]:
    """Return start values from a fit with separate windows of a given number of samples.

    A parameter with local values begins at their mean.
    """
    problem = task.problem(task.begin.values, window)
    theta, _ = problem.shooting.unpack(solve_apart(problem.shooting, problem.unknowns, _ROUGHLY))
    every: dict[str, list[float]] = {}
    for q, value in zip(problem.assembly.free, theta.tolist(), strict=True):
        every.setdefault(problem.assembly.own_names.get(q.name, q.name), []).append(value)
    return {name: float(np.mean(every.get(name, [value]))) for name, value in task.begin.values.items()}


def data_start(task: FitTask) -> dict[str, float] | None:
    """Return start values from the data alone; None if the search fails, the fit began there, or it is nonlinear."""
    if kind_of(task.structure).linear is None or set(task.begin.origin.values()) == {"data"}:
        return None
    try:
        begin = begin_values(task.structure, task.parameters, task.undisturbed, task.hold, set(), from_data=True)
    except GbidError:
        return None
    return begin.values


# ---- Steady observer (Kalman filter for assumed noise), whose gain starts a fit.
#
# A predictor with this gain is stable for any detectable model, also for an unstable plant. Its errors depend smoothly
# on the parameters, so that a fit with it converges from far away.

_LONGEST = 256  # samples of the observer's memory
_FLAT = 1e-12  # smallest information on a state, as a part of the largest
_REACHES = (0.3, 1.0, 3.0)  # memory of the observers, in time constants: the first one trusts the start values little
_NOISE = 0.1  # assumed standard deviation of the noise, as a part of that of the output


def observer_start(task: FitTask) -> dict[str, float] | None:
    """Return start values from fits with a steady Kalman observer instead of the disturbance gain.

    The observer is a steady Kalman filter for assumed noise. With it the predictor is stable, whatever the start. It
    is computed anew, with a longer memory, at the estimates of each fit. Free parameters of the structure's own
    disturbance gain come near to that of the observer. That of a loop observes its plant, whose inputs are known.

    Returns
    -------
    dict of str to float or None
        Start values of all parameters; None when the outputs do not observe an unstable state, and for a structure that
        is not linear, in continuous time and with constant parameters.
    """
    if kind_of(task.structure).plant is not task.structure:
        start = observer_start(_plant_alone(task.structure, task))
        return start and {**task.begin.values, **start}
    linear, data, values = kind_of(task.structure).linear, task.undisturbed, dict(task.begin.values)
    if linear is None:
        return None
    spread = np.sqrt(np.mean([np.var(record.outputs, axis=0) for record in data.records], axis=0))
    known = task.states.known
    observed = replace(
        task,
        data=data,
        options=FitArguments(
            output_weights=(1 / spread**2).tolist(), left_out=task.options.left_out, max_iterations=_ROUGHLY
        ),
        states=replace(task.states, values=np.full(known.shape, np.nan), released=np.zeros(known.shape, bool)),
        disturbances=UNDISTURBED,
    )
    for reach in _REACHES:
        gain = observer_gain(evaluate(linear, values), data.sample_time, _NOISE * spread, reach)
        if gain is None:
            return None
        problem = replace(observed, structure=with_gain(linear, gain)).problem(
            values, automatic_window(data, "prediction", kind_of(linear).anatomy().n_states)
        )
        solution = solve(problem.shooting, problem.unknowns, observed.options)
        theta, _ = problem.shooting.unpack(solution.unknowns)
        if np.isfinite(theta).all():
            values |= {q.name: float(v) for q, v in zip(problem.assembly.free, theta, strict=True)}
    gain = observer_gain(evaluate(linear, values), data.sample_time, _NOISE * spread, _REACHES[-1])
    values |= {} if gain is None else gain_parameters(linear, task.parameters, values, gain)
    return {q.name: float(np.clip(values[q.name], q.lower, q.upper)) for q in task.parameters}


def _plant_alone(loop: Any, task: FitTask) -> FitTask:
    """Return the fit of the plant within a loop, with inputs computed from the controller's start values."""
    gains = {gain.name: task.begin.values[gain.name] for gain in loop.gains}
    data = plant_data(loop, task.undisturbed, gains)
    parameters = tuple(q for q in task.parameters if q.name not in gains)
    states = initial_states(loop.structure, parameters, "estimated", [record.name for record in data.records])
    return replace(
        task, structure=loop.structure, parameters=parameters, data=data, undisturbed=data, states=states, courses=None
    )


def gain_start(ladder: Ladder, tells: Callable[[float], bool]) -> dict[str, float] | None:
    """Return the start values with the disturbance gain of a steady observer: the best of several memories.

    Values that are near are kept, where a fit with an observer of short memory may lose them. None for a structure
    without a free gain, or that is not linear, and where the stated gain is better, or `tells` is false of the rate of
    its predictor.
    """
    task = ladder.task
    linear, values = kind_of(kind_of(task.structure).plant).linear, task.begin.values
    if linear is None or task.options.focus != "prediction" or not kind_of(linear).anatomy().gain_only:
        return None
    if not tells(ladder.rate(values)):
        return None
    noise = _NOISE * np.sqrt(np.mean([np.var(record.outputs, axis=0) for record in task.undisturbed.records], axis=0))
    known = {q.name for q in linear.parameters}
    parameters = tuple(q for q in task.parameters if q.name in known)
    model = evaluate(linear, {name: values[name] for name in known})
    if len(model.C) != len(noise):
        return None
    costs: list[tuple[float, dict[str, float] | None]] = [(_cost(task, values), None)]
    for reach in _REACHES[1:]:
        gain = observer_gain(model, task.undisturbed.sample_time, noise, reach)
        if gain is not None and (found := gain_parameters(linear, parameters, values, gain)):
            costs.append((_cost(task, {**values, **found}), {**values, **found}))
    return min(costs, key=lambda each: each[0])[1]


def _cost(task: FitTask, start: Mapping[str, float]) -> float:
    """Return the cost at start values; infinite where it has no value or the predictor is unstable."""
    problem = task.problem(start, windows_of(task)[0])
    cost = problem.shooting.at(problem.unknowns).cost
    return cost if np.isfinite(cost) and not Ladder(task).grows(_rate(problem)) else np.inf


def observer_gain(model: LinearModel, sample_time: float, noise: FloatArray, reach: float) -> FloatArray | None:
    """Return the disturbance gain K of the steady Kalman filter for assumed noise.

    The measurement noise is as given. The process noise of a sample is what makes the filter's memory about as long as
    `reach` over the model's fastest rate: the covariance of a state that is known from so many samples alone, over
    their number.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time; its own disturbance gain is not used.
    sample_time : float
        Time between samples [s].
    noise : (n_outputs,) array
        Assumed standard deviations of the measurement noise.
    reach : float
        Memory, in units of the time constant of the fastest mode.

    Returns
    -------
    (n, n_outputs) array or None
        Gain in continuous time; with a hold of one sample it is the filter's gain. None when the outputs do not observe
        an unstable state.
    """
    n = len(model.A)
    fastest = float(np.abs(np.linalg.eigvals(model.A)).max()) * sample_time
    memory = int(np.clip(reach / max(fastest, 1e-12), 2 * n, _LONGEST))
    held = discretise(model.A, np.eye(n), sample_time, ["zoh"] * n)
    F = held.F
    seen, rows = np.zeros((n, n)), model.C / noise[:, None]
    for _ in range(memory):
        seen += rows.T @ rows
        rows = rows @ F
    if not np.isfinite(seen).all():
        return None
    scale = np.sqrt(np.maximum(np.diag(seen), np.finfo(float).tiny))
    size, axes = np.linalg.eigh(seen / np.outer(scale, scale))
    Q = axes / np.maximum(size, _FLAT * size[-1]) @ axes.T / memory  # of states in units of 1 / scale
    step, out = F * scale[:, None] / scale, model.C / noise[:, None] / scale
    try:
        P = scipy.linalg.solve_discrete_are(step.T, out.T, Q, np.eye(len(noise)))
        filtered = np.linalg.solve(out @ P @ out.T + np.eye(len(noise)), out @ P @ step.T).T
        return np.asarray(np.linalg.solve(held.G_now, filtered / scale[:, None] / noise))
    except (np.linalg.LinAlgError, ValueError):  # scipy's error for eigenvalues that cannot be told apart
        return None


def with_gain(structure: Structure, gain: FloatArray) -> LinearStructure:
    """Return a structure with a given disturbance gain, (n, n_outputs), in place of its gain parameters."""
    return LinearStructure(
        structure.name,
        structure.parameters,
        lambda p: {**structure.matrices(p), "K": gain},
        structure.inputs,
        structure.outputs,
        intersample=structure.intersample,
    )


def gain_parameters(
    structure: Structure, parameters: tuple[Parameter, ...], values: Mapping[str, float], gain: FloatArray
) -> dict[str, float]:
    """Return the values of gain parameters closest to a given disturbance gain, within their bounds.

    Parameters
    ----------
    structure : Structure
    parameters : tuple of Parameter
        Parameters with the fixed values and bounds of the fit.
    values : dict of str to float
        Values of the other parameters.
    gain : (n, n_outputs) array
        Gain to come near to, by least squares relative to its entries.

    Returns
    -------
    dict of str to float
        Empty for a structure without parameters of its own for the gain.
    """
    p, m = symbolic_matrices(structure)
    names = kind_of(structure).anatomy().gain_only
    gains = [i for i, q in enumerate(parameters) if not q.fixed and q.name in names]
    if not gains:
        return {}
    at = np.array([values[q.name] for q in parameters], float)
    entries = ca.vec(ca.densify(m.K))
    function = ca.Function("gain", [p], [entries, ca.densify(ca.jacobian(entries, p))])
    wanted = gain.T.ravel()  # CasADi stacks columns
    weight = 1 / (np.abs(wanted) + 1e-3 * np.abs(wanted).max() + np.finfo(float).tiny)
    for _ in range(3):  # one is enough where the gain is linear in its parameters
        values_at, slopes = (np.asarray(v, float) for v in function(at))
        step = np.linalg.lstsq(slopes[:, gains] * weight[:, None], (wanted - values_at[:, 0]) * weight, rcond=None)[0]
        at[gains] = np.clip(
            at[gains] + step, [parameters[i].lower for i in gains], [parameters[i].upper for i in gains]
        )
    return {parameters[i].name: float(at[i]) for i in gains}
