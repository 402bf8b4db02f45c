"""Predictor of a linear structure in discrete time, with derivatives with respect to its parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Never

import casadi as ca
import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.compiled import run_compiled
from gbid.core.errors import UsageError
from gbid.discretise.dual import Dual, at_points, constant, side_by_side
from gbid.discretise.exact import (
    LARGEST,
    NUMBER,
    Hold,
    check_holds,
    compiled,
    delayed_taps,
    discretise,
    each,
    over_sample,
    squarings_for,
    step_numbers,
    whole_samples,
)
from gbid.identify.disturbances import UNDISTURBED, Disturbances
from gbid.identify.options import Focus
from gbid.structure import Parameter, Structure
from gbid.structure.kinds import kind_of
from gbid.structure.linear import ControlLaw, HeldFeedback, LoopParts, Matrices, symbolic_matrices
from gbid.structure.parameter import once


@dataclass(frozen=True, eq=False)
class GeneralPredictor(ABC):
    """Base of predictors: a structure with given free parameters, sample time, hold and focus.

    Attributes
    ----------
    free : tuple of Parameter
        Parameters to estimate, in order.
    noise : tuple of int
        Positions of the free parameters on which only the disturbance gain depends.
    unused : tuple of str
        Parameters without effect for this focus (the disturbance gain in simulation focus).
    n_states, n_inputs, n_outputs : int
        Numbers of states (with those of random walks), inputs and outputs.
    holds : tuple of {"zoh", "foh"}
        Behaviour of each input between samples.
    prompt, delayed : tuple of int
        Inputs without delay, and inputs with an exact delay.
    feeds_back : bool
        Whether measured outputs are regressors.
    disturbances : Disturbances
        Disturbances of the outputs. Their coefficients are the last free parameters.
    walks : tuple of int
        Positions of the free parameters that are gains of random walks. The last states are their offsets.
    sample_time : float
        Time between samples [s].
    released : bool
        Whether initial states are functions of the parameters. They act like an impulse at the first sample.
    intervals : (n_steps,) array or None
        Different intervals between irregular times [s]; None where all are `sample_time`.
    """

    free: tuple[Parameter, ...]
    noise: tuple[int, ...]
    unused: tuple[str, ...]
    n_states: int
    n_inputs: int
    n_outputs: int
    holds: tuple[Hold, ...]
    prompt: tuple[int, ...]
    delayed: tuple[int, ...]
    feeds_back: bool
    disturbances: Disturbances
    walks: tuple[int, ...]
    sample_time: float
    released: bool
    intervals: FloatArray | None = field(default=None, kw_only=True)

    @property
    def _lead(self) -> list[int]:
        """Inputs with first-order hold, whose next sample is also a regressor."""
        return [i for i in self.prompt if self.holds[i] == "foh"]

    @property
    def _has_impulse(self) -> bool:
        """Whether an impulse at the first sample is a regressor: for initial states that depend on parameters."""
        driven = self.prompt or self.delayed or self.feeds_back or self.disturbances.terms
        return self.released or not driven

    def regressors(
        self, inputs: FloatArray, outputs: FloatArray, shift: tuple[int, ...], time: FloatArray | None = None
    ) -> FloatArray:
        """Return the regressors ``z`` of one record, shape (n_samples, n_z).

        Row k contains, in this order: the next interval of a record with irregular times `time` [s]; prompt inputs
        ``u[k]``; ``u[k+1]`` of those under first-order hold; for each delayed input its samples around ``k - shift``;
        those of trends and hum; an impulse at the first sample; ``y[k]`` if the disturbance gain is used. Before the
        record an input is constant at its first sample. After it the input is constant at its last sample, without
        effect.
        """
        return next(self.regressor_rows(inputs, outputs, shift, [(0, len(inputs))], time))

    def regressor_rows(
        self,
        inputs: FloatArray,
        outputs: FloatArray,
        shift: tuple[int, ...],
        edges: Iterable[tuple[int, int]],
        time: FloatArray | None = None,
    ) -> Iterator[FloatArray]:
        """Yield rows of `regressors`, for each pair of a first row and the row after the last."""
        n, before = len(inputs), max(shift, default=-1) + 1
        lagged = [*((i, 0) for i in self.prompt), *((i, -1) for i in self._lead)]
        for i, d in zip(self.delayed, shift, strict=True):
            lagged += [(i, lag) for lag in range(d - 1 if self.holds[i] == "foh" else d, d + 2)]
        interval, others = [] if time is None else [self._interval_column(time)], []
        if self.disturbances.terms:
            even = np.asarray(self.sample_time * np.arange(n), np.float64)
            others.append(self.disturbances.regressors(even if time is None else time))
        if self._has_impulse:
            others.append(np.eye(n, 1))
        if self.feeds_back:
            others.append(outputs)
        for first, stop in edges:
            near = inputs[np.clip(np.arange(first - before, stop + 1), 0, n - 1)]
            columns = [near[before - lag :, i : i + 1][: stop - first] for i, lag in lagged]
            yield np.hstack([*(e[first:stop] for e in interval), *columns, *(e[first:stop] for e in others)])

    @abstractmethod
    def _interval_column(self, time: FloatArray) -> FloatArray:
        """Return the interval after each time in the form that the kernel needs, (n_samples, 1)."""

    @abstractmethod
    def at(self, theta: FloatArray) -> Any:
        """Return the predictor at given values of the free parameters, (n_free,), for its kernel."""

    def at_each(self, points: FloatArray) -> list[Any]:
        """Return the predictors at several neighbouring points, shape (n_points, n_free).

        Those of a linear structure have the regressors of the first point: the same whole samples in their delays.
        """
        return [self.at(point) for point in points]

    @abstractmethod
    def released_state(self, theta: FloatArray) -> FloatArray:
        """Return the initial state given by parameters, (n_states,); zero for other states."""


class IntervalMatrices(NamedTuple):
    """Matrices of a predictor for each distinct interval of irregular times.

    Attributes
    ----------
    F, G : (n_steps, n, n), (n_steps, n, n_z) array
        As in `PredictorValues`.
    slopes : (n_steps, n, n_p, n + n_z) array
        Derivatives of ``[F G]``.
    """

    F: FloatArray
    G: FloatArray
    slopes: FloatArray


class PredictorValues(NamedTuple):
    """Matrices of a predictor at given parameter values.

    ``x[k+1] = F x[k] + G z[k]``, ``yhat[k] = C x[k] + H z[k]`` with the regressors of
    `Predictor.regressors`, and the derivatives with respect to the free parameters.

    Attributes
    ----------
    F : (n, n)
        State matrix.
    G : (n, n_z)
        Matrix from the regressors to the state.
    C : (n_y, n)
        Output matrix.
    H : (n_y, n_z)
        Matrix from the regressors to the outputs.
    dF : (n_p, n, n)
        Derivatives of F.
    dG : (n_p, n, n_z)
        Derivatives of G.
    dC : (n_p, n_y, n)
        Derivatives of C.
    dH : (n_p, n_y, n_z)
        Derivatives of H.
    shift : tuple of int
        Whole samples in the delay of each delayed input; these determine the regressors.
    by_interval : IntervalMatrices or None
        Those of irregular times; F and G are then those of the mean interval.
    """

    F: FloatArray
    G: FloatArray
    C: FloatArray
    H: FloatArray
    dF: FloatArray
    dG: FloatArray
    dC: FloatArray
    dH: FloatArray
    shift: tuple[int, ...]
    by_interval: IntervalMatrices | None = None

    @property
    def n_parameters(self) -> int:
        """Number of free parameters."""
        return len(self.dF)


@dataclass(frozen=True, eq=False)
class Predictor(GeneralPredictor):
    """Predictor of a linear structure; see `GeneralPredictor`.

    Attributes
    ----------
    feedback : HeldFeedback or None
        Sampled controller of a loop.
    """

    _function: ca.Function
    _shapes: tuple[tuple[int, int], ...]
    feedback: HeldFeedback | None = None

    def at(self, theta: FloatArray) -> PredictorValues:
        """Return the matrices at given values of the free parameters, shape (n_free,).

        Raises
        ------
        UsageError
            When an exact delay is negative.
        """
        values = self._values(*self._parts(theta))
        if self.intervals is None:
            return values
        (F, G, _, _), _ = self._parts(theta, self.intervals)
        slopes = np.concatenate([F.slope, G.slope], axis=3).transpose(1, 2, 0, 3)
        return values._replace(by_interval=IntervalMatrices(F.value, G.value, np.ascontiguousarray(slopes)))

    def _interval_column(self, time: FloatArray) -> FloatArray:
        """Return the number of each interval; see `GeneralPredictor`."""
        assert self.intervals is not None
        return step_numbers(time, self.intervals)[:, None].astype(float)

    def at_each(self, points: FloatArray) -> list[PredictorValues]:
        """Return the matrices at several points; see `GeneralPredictor`."""
        if self.intervals is not None:
            return [self.at(point) for point in points]
        parts, shift = self._parts(points)
        each_point = ([Dual(part.value[i], part.slope[:, i]) for part in parts] for i in range(len(points)))
        return [self._values(each, shift) for each in each_point]

    def _parts(self, theta: FloatArray, steps: FloatArray | None = None) -> tuple[tuple[Dual, ...], list[int]]:
        """Return F, G, C and H, and whole-sample delays; with an axis of intervals for irregular times."""
        simple = steps is None and self.feedback is None and self.n_states <= LARGEST
        if simple and (function := compiled("gbid_predictor")):
            return self._compiled_parts(function, theta)
        (F, drive, C, feed, Kd), x0, shift = self._without_errors(theta, steps)
        n_y = self.n_outputs
        if self._has_impulse:
            drive, feed = side_by_side([drive, F @ x0]), side_by_side([feed, C @ x0])
        if not self.feeds_back:
            return (F, drive, C, feed), shift
        none = constant(np.zeros((n_y, n_y)), len(self.free))
        return (F - Kd @ C, side_by_side([drive - Kd @ feed, Kd]), C, side_by_side([feed, none])), shift

    def _compiled_parts(self, function: Any, theta: FloatArray) -> tuple[tuple[Dual, ...], list[int]]:
        """Return the result of `_parts`, without sampled controller, by one call of a compiled function."""
        flat, jacobian = self._numbers(theta)
        A, acting, delayed, delay, x0, C, feed = self._split(flat, jacobian, np.ndim(theta))
        n, n_p, n_y = A.shape[0], len(self.free), self.n_outputs
        n_prompt, n_late, n_feed, impulse = len(self.prompt), delayed.shape[1], feed.shape[1], self._has_impulse
        n_error = acting.shape[1] - n_prompt
        columns = n + n_feed + impulse + n_error
        doublings = squarings_for([each(A)[0] * self.sample_time])
        shift = [whole_samples(seconds, self.sample_time) for seconds in each(delay)[0, :, 0].tolist()]
        straight = np.array([self.holds[i] == "foh" for i in (*self.prompt, *self.delayed)], np.int64)
        values, slopes = np.empty((len(flat), n, columns)), np.zeros((n_p, len(flat), n, columns))
        sizes = (n, n_prompt, n_error, n_late, n_feed, columns, impulse, n_p, flat.shape[1], doublings)
        room = 10 * n * n + n * (2 * (n_prompt + n_error + n_late) + 3 + columns) + flat.shape[1]
        given = [np.array([self.sample_time, *shift]), straight, flat, jacobian]
        run_compiled(function, (len(flat), *sizes), given, [np.empty(NUMBER * room), values, slopes])
        dual = Dual(values, slopes) if np.ndim(theta) > 1 else Dual(values[0], slopes[:, 0])
        more = [C @ x0] if impulse else []
        H = side_by_side([feed, *more, constant(np.zeros((n_y, n_error)), n_p)])
        return (dual.columns(slice(0, n)), dual.columns(slice(n, None)), C, H), shift

    def _values(self, parts: Sequence[Dual], shift: list[int]) -> PredictorValues:
        F, G, C, H = parts
        return PredictorValues(F.value, G.value, C.value, H.value, F.slope, G.slope, C.slope, H.slope, tuple(shift))

    def _without_errors(self, theta: FloatArray, steps: FloatArray | None = None) -> tuple[LoopParts, Dual, list[int]]:
        """Return the discrete-time structure without error feedback, its initial state, and whole-sample delays.

        It is that of a loop with its controller closed. B and D are the effects of the regressors on state and output,
        without impulse and measured outputs.
        """
        step: Any = self.sample_time
        evaluated = self._evaluate(theta)
        doublings = squarings_for([each(evaluated[0])[0] * (step if steps is None else steps[-1])])
        if steps is not None:
            evaluated, step = [at_points(part, steps.shape) for part in evaluated], steps[:, None, None]
        A, acting, delayed, delay, x0, C, feed, *law = evaluated
        n_p, n_y, n, n_prompt, lead = len(self.free), self.n_outputs, A.shape[0], len(self.prompt), self._lead
        prompt, whole = slice(0, n_prompt), over_sample(A, step, doublings)
        holds = [*(self.holds[i] for i in self.prompt), *["zoh"] * (acting.shape[1] - n_prompt)]
        F, now, following = discretise(A, acting, step, holds, whole=whole)
        # Effect of the inputs without feedback on the state, in the order of the regressors.
        drives, shift = [now.columns(prompt)], []
        if lead:
            drives.append(following.columns([self.prompt.index(i) for i in lead]))
        for k, i in enumerate(self.delayed):
            tau, b = delay.rows(slice(k, k + 1)), delayed.columns(slice(k, k + 1))
            near = float(tau.value.flat[0]), doublings
            taps = delayed_taps(A, b, tau, step, self.holds[i], near=near, whole=whole)
            drives += taps.columns if self.holds[i] == "foh" else taps.columns[1:]
            shift.append(taps.shift)
        if self.disturbances.n_columns:
            drives.append(constant(np.zeros((n, self.disturbances.n_columns)), n_p))
        held = now.columns(slice(n_prompt, None))
        plant = LoopParts(F, side_by_side(drives), C, feed, held)
        if self.feedback is None:
            return plant, x0, shift
        n_r = law[4].shape[1]
        gain = (
            held.columns(slice(n_r, None)) if self.feeds_back else constant(np.zeros((*F.value.shape[:-1], n_y)), n_p)
        )
        known = ControlLaw(*law)._replace(drive=held.columns(slice(0, n_r)))
        F, drive, C, feed, Kd = self.feedback.close(plant._replace(K=gain), known, A, self.n_inputs, whole)
        before = n - len(self.disturbances.walking)  # the states of random walks are the last
        order = [*range(before), *range(n, F.shape[0]), *range(before, n)]
        ordered = F.rows(order).columns(order), drive.rows(order), C.columns(order), feed, Kd.rows(order)
        return LoopParts(*ordered), x0, shift

    def matrices(self, theta: FloatArray) -> list[Dual]:
        """Return the matrices of the structure with derivatives; fields as in `Matrices`.

        They are those of continuous time. Of a loop with a sampled controller they are those of the loop from sample to
        sample.
        """
        A, acting, delayed, delay, _, C, feed, *_ = self._evaluate(theta)
        by_input, n_prompt = np.eye(self.n_inputs), len(self.prompt)
        B, D = (part.columns(slice(0, n_prompt)) @ by_input[list(self.prompt)] for part in (acting, feed))
        B_delayed = delayed @ by_input[list(self.delayed)]
        none = constant(np.zeros((A.shape[0], self.n_outputs)), len(self.free))
        K = acting.columns(slice(-self.n_outputs, None)) if self.feeds_back else none
        states = slice(self.n_states - len(self.disturbances.walking))  # those of random walks are the last
        if self.feedback is not None:
            (A, B, C, D, K), _, _ = self._without_errors(theta)
            B, D = (part.columns(slice(0, self.n_inputs)) for part in (B, D))
            B_delayed = constant(np.zeros(B.shape), len(self.free))
        return [
            A.rows(states).columns(states),
            B.rows(states),
            C.columns(states),
            D,
            K.rows(states),
            B_delayed.rows(states),
            delay,
        ]

    def released_state(self, theta: FloatArray) -> FloatArray:
        """Return the initial state given by parameters, (n_states,); zero for other states."""
        return self._evaluate(theta)[4].value[:, 0]

    def _evaluate(self, theta: FloatArray) -> list[Dual]:
        return self._split(*self._numbers(theta), np.ndim(theta))

    def _numbers(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the entries of all matrices, (n_points, n), and derivatives, (n_points, n_p, n)."""
        points = np.ascontiguousarray(theta, float).reshape(-1, len(self.free))
        flat = np.empty((len(points), self._function.nnz_out(0)))
        jacobian = np.empty((len(points), len(self.free), flat.shape[1]))
        buffer: Any
        buffer, call = self._function.buffer()  # a tenth of the time that a call with matrices of CasADi takes
        for point, values, slopes in zip(points, flat, jacobian, strict=True):
            buffer.set_arg(0, point.data)
            buffer.set_res(0, values.data)
            buffer.set_res(1, slopes.reshape(-1).data)
            call()
        return flat, jacobian

    def _split(self, flat: FloatArray, jacobian: FloatArray, n_axes: int) -> list[Dual]:
        """Return the matrices from their entries; without an axis of points for a single point."""
        flat, jacobian = (flat[0], jacobian[0]) if n_axes == 1 else (flat, jacobian.swapaxes(0, 1))
        result, start = [], 0
        for shape in self._shapes:
            entries = slice(start, start + shape[0] * shape[1])
            value, slope = (rows[..., entries].reshape(*rows.shape[:-1], *shape) for rows in (flat, jacobian))
            result.append(Dual(value, slope))
            start = entries.stop
        return result


def matrices_with_slopes(predictor: Predictor, theta: FloatArray) -> tuple[list[Dual], list[FloatArray], float | None]:
    """Return the matrices of a structure, their derivatives (`ModelSlopes`), and a loop's sample time.

    Parameters
    ----------
    predictor : Predictor
        The structure.
    theta : (n_free,) array
        Values of its free parameters.
    """
    matrices = predictor.matrices(theta)
    A, B, C, D, K, B_delayed, delays = matrices
    delay = np.zeros((len(theta), predictor.n_inputs))
    delay[:, list(predictor.delayed)] = delays.slope[:, :, 0]
    slopes = [A.slope, B.slope, C.slope, D.slope, B_delayed.slope, delay, K.slope]
    return matrices, slopes, predictor.feedback.sample_time if predictor.feedback else None


def build_predictor(
    structure: Structure,
    fixed: Mapping[str, float],
    sample_time: float,
    intersample: str | Sequence[str],
    focus: Focus,
    *,
    disturbances: Disturbances = UNDISTURBED,
    released: Sequence[bool] = (),
    intervals: FloatArray | None = None,
) -> Predictor:
    """Return the predictor of a structure for a fit.

    Parameters
    ----------
    structure : Structure
        The structure.
    fixed : dict of str to float
        Parameters with fixed values.
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or sequence of these
        Behaviour of the inputs between samples.
    focus : {"prediction", "simulation"}
        Whether the disturbance gain feeds measured outputs back (Eqs. 10, 15), or the model is simulated without them.
    disturbances : Disturbances
        Trends and hum of the outputs, estimated along.
    released : sequence of bool
        States of the structure that begin at its ``x0``; empty when this is so for no state of any record.
    intervals : (n_steps,) array, optional
        Different intervals between irregular times [s].

    Returns
    -------
    Predictor
        The predictor.

    Raises
    ------
    UsageError
        When no free parameter remains, or for irregular times with an exact delay or a sampled controller.

    Notes
    -----
    The continuous model with input u and disturbance e is discretised exactly, with the given hold of u and e constant
    between samples. With ``e[k] = y[k] - C x[k] - D u[k]`` the predictor is
    ``x[k+1] = (Ad - Kd C) x[k] + (Bd - Kd D) u[k] + Kd y[k]``.
    A trend or hum adds to the outputs like a known input whose entries of D are unknown. The offset of a random walk is
    a further state that only the error drives. An initial state x0 acts like an impulse at the first sample, with the
    column ``Ad x0`` onto the state and ``C x0`` onto the outputs.
    """
    more = disturbances, tuple(released), None if intervals is None else tuple(intervals.tolist())
    hold = intersample if isinstance(intersample, str) else tuple(intersample)
    return _built(structure, tuple(fixed.items()), sample_time, hold, focus, *more)


@once
def _built(
    structure: Structure,
    held: tuple[tuple[str, float], ...],
    sample_time: float,
    intersample: str | Sequence[str],
    focus: Focus,
    disturbances: Disturbances,
    released: tuple[bool, ...],
    steps: tuple[float, ...] | None,
) -> Predictor:
    """Return the predictor of a structure (cached); see `build_predictor`."""
    fixed, intervals = dict(held), None if steps is None else np.array(steps)
    p, stated = symbolic_matrices(structure)
    gains = disturbances.walk_gains(sample_time) if focus == "prediction" else ()
    gain_symbols = ca.vertcat(*(ca.SX.sym(q.name) for q in gains)) if gains else ca.SX(0, 1)
    m = _with_random_walks(stated, disturbances.walking, gain_symbols)
    holds = check_holds(intersample, m.B.shape[1])
    if m.feedback is not None and intervals is not None:
        refuse_irregular(structure.name, "a sampled controller")
    if m.feedback is not None:
        m.feedback.refuse_other_data(structure.name, holds, sample_time)
    n, n_u, n_y, n_all = m.A.shape[0], m.B.shape[1], m.C.shape[0], m.n_states
    K = m.K if focus == "prediction" else ca.SX(n, n_y)
    x0 = m.x0 if released else ca.SX(n_all, 1)
    law = list(m.feedback.law) if m.feedback else []
    prompt = list(range(n_u)) if law else sorted({*_driven(m.B), *_driven(m.D)})
    delayed = _driven(m.B_delayed) if m.has_delay else []
    if intervals is not None and delayed:
        refuse_irregular(structure.name, "exact delays")
    feeds_back = K.nnz() > 0 or (bool(law) and focus == "prediction")
    coefficients = [ca.SX.sym(term.name) for term in disturbances.terms]
    # what acts at once: columns of prompt inputs, of a sampled controller, of errors; what no input drives is zero
    acting = ca.horzcat(m.B[:, prompt], *law[4:5], *[K] * feeds_back)
    n_driven = sum(holds[i] == "foh" for i in prompt) + sum(3 if holds[i] == "foh" else 2 for i in delayed)
    feed = ca.horzcat(m.D[:, prompt], ca.SX(n_y, n_driven), disturbances.matrix(coefficients, n_y))
    matrices = [m.A, acting, m.B_delayed[:, delayed], m.delay, x0, m.C, feed, *law]
    seen = {symbol.name() for symbol in ca.symvar(ca.veccat(*matrices))} - {q.name for q in gains}
    unused = tuple(q.name for q in structure.parameters if q.name not in seen and q.name not in fixed)
    free = tuple(q for q in structure.parameters if q.name not in fixed and q.name in seen)
    if not free:
        raise UsageError(f"structure {structure.name!r}: no free parameter to estimate")
    known_values = {**dict.fromkeys(unused, 0.0), **fixed}
    constants = [(p[i], known_values[q.name]) for i, q in enumerate(structure.parameters) if q not in free]
    if constants:
        known, numbers = zip(*constants, strict=True)
        matrices = ca.substitute(matrices, [ca.vertcat(*known)], [ca.vertcat(*numbers)])
    matrices[3] = matrices[3][delayed] if delayed else ca.SX(0, 1)
    matrices[4] = ca.diag(ca.DM([float(each) for each in released] + [0.0] * (n_all - len(released)))) @ matrices[4]
    symbols = [p[i] for i, q in enumerate(structure.parameters) if q in free]
    theta = ca.vertcat(*symbols, gain_symbols, *coefficients)
    flat = ca.vertcat(*(ca.vec(ca.densify(matrix.T)) for matrix in matrices))  # row by row, as numpy has them
    function = ca.Function("matrices", [theta], [flat, ca.densify(ca.jacobian(flat, theta))])
    noise, walks = kind_of(structure).anatomy().gain_only, tuple(range(len(free), len(free) + len(gains)))
    return Predictor(
        free=(*free, *gains, *(Parameter("coefficient", 0.0).renamed(term.name) for term in disturbances.terms)),
        noise=(*(i for i, q in enumerate(free) if q.name in noise), *walks),
        unused=unused,
        n_states=n_all,
        n_inputs=n_u,
        n_outputs=n_y,
        holds=holds,
        prompt=tuple(prompt),
        delayed=tuple(delayed),
        feeds_back=feeds_back,
        disturbances=disturbances,
        walks=walks,
        sample_time=sample_time,
        released=any(released),
        _function=function,
        _shapes=tuple(matrix.shape for matrix in matrices),
        feedback=m.feedback,
        intervals=intervals,
    )


def refuse_irregular(structure: str, what: str) -> Never:
    """Raise the error for irregular times, with the part of the structure that acts between samples."""
    raise UsageError(
        f"structure {structure!r}: {what} with samples at irregular times: the motion between two samples is not "
        "computed. Take rational delays (pade_order=2), or, where all times are multiples of a resolution of the "
        "clock, import the samples onto this grid (gaps: missing, and the resolution as sample_time_s)"
    )


def _driven(matrix: ca.SX) -> list[int]:
    """Return the indices of columns with entries."""
    return sorted(set(matrix.sparsity().get_triplet()[1]))


def _with_random_walks(m: Matrices, outputs: Sequence[int], gains: ca.SX) -> Matrices:
    """Return the matrices with an additional state (random-walk offset) for each of some outputs.

    Parameters
    ----------
    m : Matrices
        Matrices of a structure.
    outputs : sequence of int
        Outputs whose offset is a random walk.
    gains : casadi.SX
        Gain of each of them from the error of its output [1/s]; empty when the offsets stay as they are.

    Returns
    -------
    Matrices
        ``db/dt = gain e`` for each offset b, and ``y = C x + D u + b + e``.
    """
    if not outputs:
        return m
    n_u, n_y, added = m.B.shape[1], m.C.shape[0], len(outputs)
    walk_feed = ca.SX(n_y, added)
    for column, output in enumerate(outputs):
        walk_feed[output, column] = 1
    no_input = ca.SX(added, n_u)
    feedback = m.feedback
    if feedback is not None:
        law, none = feedback.law, ca.SX(added, feedback.law.drive.shape[1])
        drive, delayed = (ca.vertcat(each, none) for each in (law.drive, law.late))
        feedback = feedback._replace(law=law._replace(drive=drive, late=delayed))
    return m._replace(
        A=ca.diagcat(m.A, ca.SX(added, added)),
        B=ca.vertcat(m.B, no_input),
        C=ca.horzcat(m.C, walk_feed),
        K=ca.vertcat(m.K, ca.diag(gains) @ walk_feed.T if gains.numel() else ca.SX(added, n_y)),
        B_delayed=ca.vertcat(m.B_delayed, no_input),
        x0=ca.vertcat(m.x0, ca.SX(added, 1)) if m.x0.numel() else m.x0,
        feedback=feedback,
    )
