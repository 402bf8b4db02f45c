"""Simulation of models on recordings, from an estimated initial state; validation data and fit percent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, ComplexArray, FloatArray, recursion
from gbid.core.errors import DataError, UsageError
from gbid.discretise.exact import discretise
from gbid.identify import FitResult
from gbid.identify.data import select
from gbid.identify.disturbances import UNDISTURBED, Disturbances
from gbid.recording import Recording
from gbid.recording.recording import without_gaps
from gbid.structure import LinearModel, NonlinearModel

_WELL_APART = 1e5  # largest condition number of the eigenvectors at which the modes are simulated one by one
_NOTHING = 1e-17  # smaller entries of a basis vector of length one are taken as zero


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of ``x[k+1] = F x[k] + G u[k] + G_next u[k+1]``; of each conjugate pair one mode.

    Attributes
    ----------
    poles : (n_modes,) complex array
        Poles in discrete time.
    to_modes : (n_modes, n_states) complex array
        Modes of a state.
    drive, lead : (n_modes, n_inputs) complex array
        Effect of ``u[k]`` and ``u[k+1]`` on the modes.
    weights : (n_outputs, n_modes) complex array
        Effect of the modes on the outputs, doubled for a mode that stands for a conjugate pair.
    """

    poles: ComplexArray
    to_modes: ComplexArray
    drive: ComplexArray
    lead: ComplexArray
    weights: ComplexArray


class FreeResponses(NamedTuple):
    """Orthonormal basis of the free responses of a model.

    Attributes
    ----------
    basis : (n_outputs, n_leading, rank) array
        Basis vectors; later samples are zero.
    states : (n_states, rank) array
        Initial state of each basis vector.
    """

    basis: FloatArray
    states: FloatArray


class Explained(NamedTuple):
    """Estimated initial state of a simulation, and the residuals.

    Attributes
    ----------
    initial_state : (n_states,) array
        Least-squares solution of smallest norm.
    residuals : (n_outputs, n_counted) array
        Measured less simulated outputs, at the samples that count.
    """

    initial_state: FloatArray
    residuals: FloatArray


@dataclass(frozen=True, eq=False)
class Simulator:
    """Base of simulators: a model prepared for simulation on many recordings.

    Attributes
    ----------
    model : LinearModel or NonlinearModel
        The model.
    sample_time : float or (n_samples,) array
        Time between samples [s], or their irregular times.
    intersample : {"zoh", "foh"} or sequence of these, optional
        Inter-sample behaviour of the inputs; by default that of the model.
    disturbances : Disturbances
        Trends and hum of the outputs, estimated together with the initial state. A random walk counts as an offset.
    name : str
        Recordings to which the model was fitted, for messages.
    """

    model: Any
    sample_time: float | FloatArray
    intersample: str | Sequence[str] | None = None
    disturbances: Disturbances = UNDISTURBED
    name: str = "model"

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return the initial state whose simulation is closest to the measured outputs, and the residuals.

        Parameters
        ----------
        inputs : (n_inputs, n_samples) array
            Input signals.
        outputs : (n_outputs, n_samples) array
            Measured outputs.
        counted : (n_samples,) array of bool, optional
            Samples whose outputs count; all by default.

        Returns
        -------
        Explained
            Not finite when the simulation overflows.
        """
        raise NotImplementedError

    @property
    def rate(self) -> float:
        """Growth rate of the fastest growing free response [1/s]; negative for stable and nonlinear models."""
        return -np.inf

    def run(self, inputs: FloatArray, initial_state: FloatArray | None = None) -> FloatArray:
        """Return the simulated outputs without trend and hum, (n_outputs, n_samples).

        Parameters
        ----------
        inputs : (n_inputs, n_samples) array
            Input signals.
        initial_state : (n_states,) array, optional
            State at the first sample; zero by default.
        """
        between = self.intersample
        with np.errstate(over="ignore", invalid="ignore"):
            outputs = self.model.simulate(inputs.T, self.sample_time, initial_state=initial_state, intersample=between)
        return np.asarray(outputs.T)

    def disturbed(self, error: FloatArray, counted: BoolArray | None = None) -> FloatArray:
        """Return the trend and hum closest to a simulation error, at all samples.

        Parameters
        ----------
        error : (n_outputs, n_samples) array
            Measured less simulated outputs.
        counted : (n_samples,) array of bool, optional
            Samples that count; all by default.
        """
        rest = error if counted is None else error[:, counted]
        return self._course(rest, error.shape[1], counted, everywhere=True)

    def _course(self, rest: FloatArray, n: int, counted: BoolArray | None, *, everywhere: bool = False) -> FloatArray:
        """Return the trend and hum closest to `rest` at the samples that count, at these or at all n samples."""
        known = self.disturbances.instead_of_walks(1)
        if not known.n_columns:
            return np.zeros((len(rest), 1))
        clock = self.sample_time
        columns = known.regressors(clock[:n] if isinstance(clock, np.ndarray) else np.linspace(0.0, clock * (n - 1), n))
        chosen = columns if counted is None else columns[counted]
        return known.closest(rest.T, chosen) @ (columns if everywhere else chosen).T


@dataclass(frozen=True, eq=False)
class LinearSimulator(Simulator):
    """Linear model prepared for simulation on many recordings; see `Simulator`.

    The modes are simulated one by one as filters of first order. The free responses from all initial states have an
    orthonormal basis, which is stored. So the best initial state is found by a projection.
    """

    _modes: Modes | None = field(init=False, repr=False)
    _free: dict[tuple[int, bytes], FreeResponses] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_modes", _modes(self.model, self.sample_time, self.intersample))

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return initial state and residuals by a projection; see `Simulator.explain`."""
        with np.errstate(over="ignore", invalid="ignore"):
            rest = outputs - self.run(inputs)
            rest = rest if counted is None else rest[:, counted]
            if not np.isfinite(rest).all():
                return Explained(np.full(self.model.n_states, np.nan), rest)
            rest = rest - self._course(rest, inputs.shape[1], counted)  # they drop out of the problem
            free = self._free_responses(inputs.shape, counted)
            head = rest[:, : free.basis.shape[1]]
            shares = np.tensordot(free.basis, head, axes=((0, 1), (0, 1)))
            head -= np.tensordot(free.basis, shares, axes=(2, 0))
            return Explained(free.states @ shares, rest)

    @property
    def rate(self) -> float:
        """Largest real part of the poles, in continuous time; see `Simulator.rate`."""
        poles = np.linalg.eigvals(self.model.A)
        if self.model.dt is not None:
            return float(np.log(np.abs(poles).max(initial=np.finfo(float).tiny)) / self.model.dt)
        return float(poles.real.max(initial=-np.inf))

    def run(self, inputs: FloatArray, initial_state: FloatArray | None = None) -> FloatArray:
        """Return the outputs, mode by mode where the eigenvectors allow it; see `Simulator.run`."""
        modes = self._modes
        if modes is None:
            return super().run(inputs, initial_state)
        simulated = self.model.D @ inputs
        begin = np.zeros(len(modes.poles)) if initial_state is None else modes.to_modes @ initial_state
        columns = zip(modes.poles, modes.drive, modes.lead, modes.weights.T, begin, strict=True)
        for pole, drive, lead, weights, first in columns:
            simple = pole.imag == 0
            now, following = (drive.real, lead.real) if simple else (drive, lead)
            forcing = now @ inputs
            if following.any():
                forcing[:-1] += following @ inputs[:, 1:]
            begun = np.concatenate([[first.real if simple else first], forcing[:-1]])
            mode = recursion(pole.real if simple else pole, begun)
            simulated += np.outer(weights.real, mode.real)
            if not simple:
                simulated -= np.outer(weights.imag, mode.imag)
        return np.asarray(simulated)

    def _free_responses(self, shape: tuple[int, ...], counted: BoolArray | None) -> FreeResponses:
        n_inputs, n = shape
        key = (n, b"" if counted is None else counted.tobytes())
        if key not in self._free:
            silent = np.zeros((n, n_inputs))
            runs = [
                self.model.simulate(silent, self.sample_time, initial_state=x, intersample=self.intersample).T
                for x in np.eye(self.model.n_states)
            ]
            free = np.stack(runs, axis=2)
            free = free if counted is None else free[:, counted]
            for state in range(self.model.n_states):
                free[:, :, state] -= self._course(free[:, :, state], n, counted)
            self._free[key] = _orthonormal(free)
        return self._free[key]


def _modes(
    model: LinearModel, sample_time: float | FloatArray, intersample: str | Sequence[str] | None
) -> Modes | None:
    """Return the modes of a model; None for delays, sampled models, irregular times or ill-conditioned eigenvectors."""
    if model.delay is not None or model.dt is not None or isinstance(sample_time, np.ndarray):
        return None
    F, now, following = discretise(np.array(model.A), np.array(model.B), sample_time, model.holds(intersample))
    if not np.isfinite(F).all():
        return None
    poles, vectors = np.linalg.eig(F)
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    if not np.linalg.cond(vectors) < _WELL_APART:
        return None
    inverse = np.linalg.inv(vectors)
    keep = poles.imag >= 0
    weights = (model.C @ vectors) * np.where(poles.imag > 0, 2.0, 1.0)
    parts = (poles[keep], inverse[keep], (inverse @ now)[keep], (inverse @ following)[keep], weights[:, keep])
    return Modes(*(part.astype(complex) for part in parts))


def _orthonormal(free: FloatArray) -> FreeResponses:
    n_y, n, n_x = free.shape
    if not np.isfinite(free).all():
        return FreeResponses(np.full((n_y, n, 1), np.inf), np.full((n_x, 1), np.inf))
    columns = free.reshape(n_y * n, n_x)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    left, weight, right = np.linalg.svd(columns / size, full_matrices=False)
    rank = int((weight > np.finfo(float).eps * max(columns.shape) * weight.max(initial=0.0)).sum())
    basis = left[:, :rank].reshape(n_y, n, rank)
    used = np.flatnonzero((np.abs(basis) > _NOTHING).any(axis=(0, 2)))
    leading = np.ascontiguousarray(basis[:, : used[-1] + 1 if used.size else 1])
    return FreeResponses(leading, (right[:rank].T / weight[:rank]) / size[:, None])


_ROUNDS = 30  # evaluations of a search
_SETTLED = 1e-10  # relative step, and fall of the squares, at which it ends
_FADED = 1e-4  # part of the influence of the initial state that is left in the second half of a stretch
_FIRST, _GROWTH = 16, 4  # samples of the first stretch, for each state, and by how much the next one is longer


@dataclass(frozen=True, eq=False)
class NonlinearSimulator(Simulator):
    """Nonlinear model prepared for simulation on recordings; see `Simulator`.

    The initial state is found by least squares, first on the first samples, and then on more and more: over a whole
    recording the squares have many minima. This ends where its influence has faded.

    Attributes
    ----------
    predicts : bool
        Whether the initial state is that of the one-step predictor: a simulation of an unstable model overflows.
    """

    predicts: bool = False

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return initial state and residuals by least squares; see `Simulator.explain`."""
        size, every = np.maximum(np.abs(self.model.working_state), self.model.state_size), inputs.shape[1]
        used = np.ones(every, bool) if counted is None else counted

        def rest(scaled: FloatArray, n: int) -> FloatArray:
            left = outputs[:, :n] - self._output(inputs[:, :n], outputs[:, :n], scaled * size)
            left = left if counted is None else left[:, counted[:n]]
            return left - self._course(left, n, None if counted is None else counted[:n])

        z = self.model.working_state / size
        for n in [*_lengths(used, len(z)), every]:
            if not np.isfinite(rest(z, n)).all():
                if n < every:
                    continue
                return Explained(np.full(len(z), np.nan), rest(z, n))
            unit = float(np.abs(rest(z, n)).max()) or 1.0
            tolerances = {"xtol": _SETTLED, "ftol": _SETTLED, "gtol": None}
            optimum = scipy.optimize.least_squares(
                lambda at, n=n, unit=unit: rest(at, n).ravel() / unit, z, max_nfev=_ROUNDS, **tolerances
            )
            z, slopes = optimum.x, optimum.jac.reshape(len(outputs), -1, len(z))
            second_half = slopes[:, slopes.shape[1] // 2 :]
            last, largest = (np.linalg.norm(s, axis=(0, 1)).max() for s in (second_half, slopes))
            if not self.disturbances.terms and last <= _FADED * largest:
                break  # more samples tell nothing more of the initial state
        return Explained(z * size, rest(z, every))

    def _output(self, inputs: FloatArray, outputs: FloatArray, state: FloatArray) -> FloatArray:
        if not self.predicts:
            return self.run(inputs, state)
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = self.model.predict(
                inputs.T, outputs.T, self.sample_time, initial_state=state, intersample=self.intersample
            )
        return np.asarray(predicted.T)


def _lengths(counted: BoolArray, n_states: int) -> list[int]:
    """Return increasing lengths of the first stretch of a recording, each with enough counted samples."""
    lengths, n = [], _FIRST * n_states
    while n < len(counted):
        if counted[:n].sum() >= 2 * n_states:
            lengths.append(n)
        n *= _GROWTH
    return lengths


@singledispatch
def simulator_of(
    model: Any,
    sample_time: float | FloatArray,
    intersample: str | Sequence[str] | None = None,
    disturbances: Disturbances = UNDISTURBED,
    name: str = "model",
) -> Simulator:
    """Return the simulator of a model, linear or nonlinear."""
    return LinearSimulator(model, sample_time, intersample, disturbances, name)


simulator_of.register(NonlinearModel, NonlinearSimulator)


def refuse_scheduled(result: FitResult) -> None:
    """Refuse the fit of a scheduled structure: its model is valid in the middle of the range only."""
    if result.schedule is not None:
        raise UsageError(
            f"the parameters of {result.structure!r} follow {', '.join(result.schedule.variables)}; its model "
            "is that of the middle of their range. Take gbid.lpv.lpv_of(result).model.at(...) at an operating point"
        )


def simulator(result: FitResult) -> Simulator:
    """Return the simulator of a fitted model."""
    refuse_scheduled(result)
    return simulator_of(result.model, result.sample_time, None, result.disturbances, ", ".join(result.recordings))


def at_clock_of(fitted: Simulator, clock: float | FloatArray) -> Simulator:
    """Return the simulator of a fit for the sample time or the irregular times of a recording.

    That of a fit to irregular times, or to frequency responses alone, has no sample time of its own.
    """
    sample_time = fitted.sample_time
    return (
        replace(fitted, sample_time=clock) if isinstance(clock, np.ndarray) or np.isnan(sample_time).any() else fitted
    )


def clock_of(recording: Recording) -> float | FloatArray:
    """Return the sample time of a recording [s], or its irregular times."""
    return recording.sample_time if recording.stamps is None else recording.stamps


# ---- Validation data of a recording, and fit percent.

Ranges = Sequence[tuple[int, int]]
"""Ranges of samples (start, stop); the stop sample is not part of the range."""


@dataclass(frozen=True, eq=False)
class ValidationData:
    """Inputs and outputs of one recording, arranged for the simulation of many models.

    Attributes
    ----------
    name : str
        Name of the recording.
    conditions : dict of str to float
        Operating point of the recording.
    sample_time : float
        Time between samples [s].
    clock : float or (n_samples,) array
        The same, or their irregular times.
    inputs : (n_inputs, n_samples) array
        Input signals.
    outputs : (n_outputs, n_samples) array
        Measured outputs.
    counted : (n_samples,) array of bool or None
        Samples that count; None when all count.
    input_names, output_names, input_units, output_units : tuple of str
        Names and units of the channels.
    spread : (n_outputs,) array
        Norm of each output about its mean.
    """

    name: str
    conditions: dict[str, float]
    sample_time: float
    clock: float | FloatArray
    inputs: FloatArray
    outputs: FloatArray
    counted: BoolArray | None
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    spread: FloatArray


def validation_data(result: FitResult, recording: Recording, left_out: Ranges = ()) -> ValidationData:
    """Return the signals of a recording on which the models of a fit are validated.

    Parameters
    ----------
    result : FitResult
        Any fit of these models; it names the signals.
    recording : Recording
        Validation recording.
    left_out : sequence of (start, stop)
        Ranges of samples that do not count.

    Raises
    ------
    DataError
        When the recording lacks a signal, or has no sample that counts.
    """
    u, input_names, input_units = select(recording, result.options.inputs, irregular=True)
    y, output_names, output_units = select(recording, result.options.outputs, gaps=True, irregular=True)
    counted = counted_samples(recording, left_out)
    y, missing = without_gaps(y)
    if missing is not None:
        whole = np.asarray(~missing.any(axis=1), bool)
        counted = whole if counted is None else whole & counted
        if not counted.any():
            raise DataError(f"recording {recording.name!r}: no sample has all outputs; validate on one at their rate")
    kept = y if counted is None else y[counted]
    return ValidationData(
        recording.name,
        dict(recording.conditions),
        recording.sample_time,
        clock_of(recording),
        np.ascontiguousarray(u.T),
        np.ascontiguousarray(y.T),
        counted,
        tuple(input_names),
        tuple(output_names),
        tuple(input_units),
        tuple(output_units),
        np.linalg.norm(kept - kept.mean(axis=0), axis=0),
    )


def counted_samples(recording: Recording, left_out: Ranges) -> BoolArray | None:
    """Return which samples count when some time ranges are left out; None when all count.

    Raises
    ------
    DataError
        When a range lies outside the recording, or when no sample remains.
    """
    counted = np.ones(recording.n_samples, dtype=bool)
    for start, stop in left_out:
        if not 0 <= start < stop <= recording.n_samples:
            raise DataError(
                f"recording {recording.name!r}: samples {start} to {stop} of left_out are not within its "
                f"{recording.n_samples}; correct them"
            )
        counted[start:stop] = False
    if not counted.any():
        raise DataError(f"recording {recording.name!r}: all samples are left out; keep some")
    return None if counted.all() else counted


def fit_percent(measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """Return the fit in percent, ``100 (1 - |y - yhat| / |y - mean y|)``, per output.

    Parameters
    ----------
    measured, simulated : (n_samples, n_outputs) array
        Measured and simulated outputs.

    Returns
    -------
    (n_outputs,) array
        100 for a perfect model, 0 for a model that is as good as the mean.
    """
    measured = np.asarray(measured, float)
    error = np.linalg.norm(measured - np.asarray(simulated, float), axis=0)
    return np.asarray(100 * (1 - error / np.linalg.norm(measured - measured.mean(axis=0), axis=0)))
