"""Linear state-space models with numbers: simulation, frequency response, modes, exact discretisation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import scipy

from gbid.core.arrays import ComplexArray, FloatArray, oscillatory_modes, poles_of_samples
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.extras import extra_package
from gbid.core.figures import Pictured
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.core.option_types import OneText, check_options
from gbid.discretise import Hold
from gbid.discretise.exact import (
    check_holds,
    delayed_taps,
    discretise,
    distinct_steps,
    propagate,
    squarings_for,
    step_numbers,
)


def channels(model: str, what: str, values: npt.ArrayLike, count: int, n_samples: int | None = None) -> FloatArray:
    """Return signals as a finite array (n_samples, count); for one channel (n_samples,) is accepted.

    Parameters
    ----------
    model, what : str
        Name of the model and word for the signals, for the text of an error.
    values : array
        The signals.
    count : int
        Number of channels.
    n_samples : int, optional
        Number of samples; any when left out.

    Raises
    ------
    UsageError
        For another shape, or values that are not finite.
    """
    signals = np.asarray(values, float)
    if signals.ndim == 1 and count == 1:
        signals = signals[:, None]
    if signals.ndim != 2 or signals.shape[1] != count or n_samples not in (None, len(signals)):
        expected = "n_samples" if n_samples is None else n_samples
        raise UsageError(f"model {model!r}: {what} have shape {signals.shape}, expected ({expected}, {count})")
    if not np.isfinite(signals).all():
        raise UsageError(f"model {model!r}: {what} hold values that are not finite")
    return signals


def check_sample_time(model: str, sample_time: float | None) -> float:
    """Return a sample time; refuse a missing or non-positive value."""
    if sample_time is None:
        raise UsageError(f"model {model!r} is continuous: give the sample time [s]")
    if not (np.isfinite(sample_time) and sample_time > 0):
        raise UsageError(f"model {model!r}: sample time {sample_time} s; it must be a positive number")
    return sample_time


def check_clock(model: str, clock: npt.ArrayLike | None, n_samples: int) -> float | FloatArray:
    """Return the sample time, also of evenly spaced times; for irregular times the times (n_samples,)."""
    if clock is None or np.ndim(clock) == 0:
        return check_sample_time(model, clock)  # type: ignore[arg-type]  # a number or None
    time = np.asarray(clock, float)
    if time.shape != (n_samples,) or not (np.diff(time) > 0).all() or not np.isfinite(time).all():
        raise UsageError(f"model {model!r}: times of the samples must be ({n_samples},) numbers that rise")
    steps = distinct_steps(time) if n_samples > 1 else np.ones(1)
    return float(steps[0]) if len(steps) == 1 else time


class SampledSignals(ABC):
    """Base of models, linear or not: simulation and prediction with sampled signals."""

    name: str
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    intersample: tuple[Hold, ...] | None

    def simulate(
        self,
        inputs: npt.ArrayLike,
        sample_time: float | npt.ArrayLike | None = None,
        *,
        initial_state: npt.ArrayLike | None = None,
        intersample: str | Sequence[str] | None = None,
    ) -> FloatArray:
        """Return the response to sampled inputs.

        Parameters
        ----------
        inputs : (n_samples, n_inputs) array
            Input signals.
        sample_time : float or (n_samples,) array, optional
            Time between samples [s], or the irregular times of the samples; a discrete model has its own.
        initial_state : (n_states,) array, optional
            State at the first sample; zero when not given.
        intersample : {"zoh", "foh"} or sequence of these, optional
            Inter-sample behaviour of the inputs; by default that of the model, `intersample`, or else zero-order hold.
            For a discrete model it was fixed by its discretisation.

        Returns
        -------
        (n_samples, n_outputs) array
            Output signals; not finite from where a nonlinear model overflows.

        Raises
        ------
        UsageError
            When shapes do not fit, when an input is not finite, when the sample time is missing, not positive or
            differs, or when `intersample` is given for a discrete model.
        """
        u = channels(self.name, "inputs", inputs, len(self.input_names))
        return self._response(u, None, sample_time, initial_state, self.holds(intersample))

    def predict(
        self,
        inputs: npt.ArrayLike,
        outputs: npt.ArrayLike,
        sample_time: float | npt.ArrayLike | None = None,
        *,
        initial_state: npt.ArrayLike | None = None,
        intersample: str | Sequence[str] | None = None,
    ) -> FloatArray:
        """Return one-step-ahead predictions of the outputs from measured inputs and outputs (paper, Eq. 10).

        Without a disturbance gain this is the simulation.

        Parameters
        ----------
        inputs : (n_samples, n_inputs) array
            Input signals.
        outputs : (n_samples, n_outputs) array
            Measured outputs.
        sample_time : float or (n_samples,) array, optional
            Time between samples [s], or the irregular times of the samples; a discrete model has its own.
        initial_state : (n_states,) array, optional
            State at the first sample; zero when not given.
        intersample : {"zoh", "foh"} or sequence of these, optional
            Inter-sample behaviour of the inputs; by default as for `simulate`.

        Returns
        -------
        (n_samples, n_outputs) array
            Predicted outputs.

        Raises
        ------
        UsageError
            As for `simulate`, or when the outputs do not fit.
        """
        u = channels(self.name, "inputs", inputs, len(self.input_names))
        y = channels(self.name, "outputs", outputs, len(self.output_names), len(u))
        return self._response(u, y, sample_time, initial_state, self.holds(intersample))

    def holds(self, intersample: str | Sequence[str] | None = None) -> tuple[Hold, ...]:
        """Return the inter-sample behaviour of each input: the argument, else the model's, else zero-order hold.

        Raises
        ------
        UsageError
            When a name is unknown, or when the sequence has the wrong length.
        """
        chosen = self.intersample if intersample is None else intersample
        return check_holds("zoh" if chosen is None else chosen, len(self.input_names))

    @abstractmethod
    def _response(
        self,
        u: FloatArray,
        y: FloatArray | None,
        sample_time: npt.ArrayLike | None,
        initial_state: Any,
        holds: tuple[Hold, ...],
    ) -> FloatArray:
        """Return simulated outputs, or one-step-ahead predictions when measured outputs are given."""


@dataclass(frozen=True, eq=False)
class LinearModel(SampledSignals, Brief, Pictured):
    """State-space model ``xd = A x + B u + K e``, ``y = C x + D u + e``, or the same in discrete time.

    Parameters
    ----------
    A : (n, n) array
        State matrix.
    B : (n, n_inputs) array
        Input matrix.
    C : (n_outputs, n) array
        Output matrix.
    D : (n_outputs, n_inputs) array
        Feedthrough.
    K : (n, n_outputs) array, optional
        Disturbance gain (paper, Eq. 6: ``B_d``).
    dt : float, optional
        Sample time [s]; None for continuous time.
    input_names, output_names, state_names : tuple of str, optional
        Names of the channels and states.
    name : str, optional
        Name of the model.
    B_delayed : (n, n_inputs) array, optional
        Input matrix of the delayed inputs: ``xd = A x + B u + B_delayed u(t - delay)``.
    delay : (n_inputs,) array, optional
        Exact input delays [s]; continuous time only.
    intersample : sequence of {"zoh", "foh"}, optional
        Inter-sample behaviour of each input that simulations and `discretise` assume unless told otherwise; continuous
        time only. The model of a fit has that of the fit.

    Raises
    ------
    UsageError
        When shapes do not fit together, when an entry is not finite, or when the sample time is not positive.
    """

    A: Annotated[FloatArray, Stored("SI", "A of the model")]
    B: Annotated[FloatArray, Stored("SI", "B of the model")]
    C: Annotated[FloatArray, Stored("SI", "C of the model")]
    D: Annotated[FloatArray, Stored("SI", "D of the model")]
    K: Annotated[FloatArray | None, Stored("SI", "K of the model")] = None
    dt: float | None = None
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()
    state_names: tuple[str, ...] = ()
    name: str = "model"
    B_delayed: Annotated[FloatArray | None, Stored("SI", "B_delayed of the model")] = None
    delay: Annotated[FloatArray | None, Stored("s", "delay of the model")] = None
    intersample: Annotated[tuple[Hold, ...] | None, NOT_STORED, OneText()] = None

    drawn_by = "plot_bode"

    def __post_init__(self) -> None:
        check_options(self, "LinearModel")
        if self.dt is not None:
            check_sample_time(self.name, self.dt)
        given = {name: getattr(self, name) for name in (*"ABCDK", "B_delayed", "delay")}
        values: dict[str, Any] = {name: np.array(m, float) for name, m in given.items() if m is not None}
        values |= {name: np.atleast_2d(matrix) for name, matrix in values.items() if name in "ABCDK"}
        n, n_u, n_y = values["A"].shape[0], values["B"].shape[1], values["C"].shape[0]
        expected: dict[str, tuple[int, ...]] = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u)}
        expected |= {"K": (n, n_y), "B_delayed": (n, n_u), "delay": (n_u,)}
        for name, array in values.items():
            if array.shape != expected[name]:
                raise UsageError(f"model {self.name!r}: {name} has shape {array.shape}, expected {expected[name]}")
            if not np.isfinite(array).all():
                raise UsageError(f"model {self.name!r}: {name} holds entries that are not finite")
            array.setflags(write=False)
        if ("delay" in values) != ("B_delayed" in values):
            raise UsageError(f"model {self.name!r}: give both delay and B_delayed, or neither")
        if "delay" in values and self.dt is not None:
            raise UsageError(f"model {self.name!r}: a sampled model has no exact delays; leave delay out")
        if self.intersample is not None:
            if self.dt is not None:
                raise UsageError(f"model {self.name!r} is discrete: intersample is for continuous time only")
            values["intersample"] = check_holds(self.intersample, n_u)
        if (values.get("delay", np.zeros(0)) < 0).any():
            raise UsageError(f"model {self.name!r}: delay = {values['delay'].tolist()} s; delays cannot be negative")
        for field, count, letter in (("input_names", n_u, "u"), ("output_names", n_y, "y"), ("state_names", n, "x")):
            names = tuple(getattr(self, field)) or tuple(f"{letter}{i + 1}" for i in range(count))
            if len(names) != count:
                raise UsageError(f"model {self.name!r}: {field} has {len(names)} names for {count}")
            values[field] = names
        for field, value in values.items():
            object.__setattr__(self, field, value)

    @property
    def summary(self) -> str:
        """Name, number of states and kind of time, on one line."""
        time = "continuous time" if self.dt is None else f"samples of {self.dt:g} s"
        return f"{self.name}, {len(self.A)} states, {time}" + (", exact delays" if self.delay is not None else "")

    def _brief(self) -> Description:
        modes = [f"{frequency:.2f} Hz, damping {damping:.4f}" for frequency, damping in self.modes()]
        delay = {} if self.delay is None else {"delay": self.delay}
        return brief(
            self, self.summary, input_names=self.input_names, output_names=self.output_names, **delay, modes=modes
        )

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    def poles(self) -> ComplexArray:
        """Return the poles in continuous time [rad/s], shape (n,), by rising magnitude."""
        poles = np.linalg.eigvals(self.A).astype(complex)
        if self.dt is not None:
            poles = poles_of_samples(poles, self.dt)
        return poles[np.lexsort((poles.imag, np.abs(poles)))]

    def is_stable(self) -> bool:
        """Return whether the model is asymptotically stable."""
        eigenvalues = np.linalg.eigvals(self.A)
        return bool((eigenvalues.real < 0).all() if self.dt is None else (np.abs(eigenvalues) < 1).all())

    def linearise(self) -> LinearModel:
        """Return this model, so that linear and nonlinear models are linearised in one way."""
        return self

    def with_integrators(self, outputs: Sequence[int], gains: Sequence[float]) -> LinearModel:
        """Return a model with an integrator at some of its outputs; `outputs` are their numbers.

        Each integrator is one more state: an offset of its output, which the prediction error drives with its gain in
        `gains`.
        """
        (n_y, n_u), added = self.D.shape, len(outputs)
        integrator_input = np.zeros((n_y, added))
        integrator_input[list(outputs), np.arange(added)] = 1.0
        K, rest = np.zeros((self.n_states, n_y)) if self.K is None else self.K, np.zeros((added, n_u))
        return replace(
            self,
            A=scipy.linalg.block_diag(self.A, np.zeros((added, added))),
            B=np.vstack([self.B, rest]),
            C=np.hstack([self.C, integrator_input]),
            K=np.vstack([K, np.asarray(gains)[:, None] * integrator_input.T]),
            B_delayed=None if self.B_delayed is None else np.vstack([self.B_delayed, rest]),
            state_names=(),
        )

    def modes(self) -> list[tuple[float, float]]:
        """Return the oscillatory modes as (natural frequency [Hz], damping factor [-]), by rising frequency.

        A complex pair ``lambda`` has the natural frequency ``|lambda| / 2 pi`` and the damping factor
        ``-Re(lambda) / |lambda|``. Real poles are not modes; `poles` returns them, too.
        """
        return [(frequency, damping) for frequency, damping in oscillatory_modes(self.poles()).tolist()]

    def static_gain(self) -> FloatArray:
        """Return the static gain, shape (n_outputs, n_inputs).

        Raises
        ------
        UsageError
            When the model has an integrator (a pole at zero) and therefore no static gain.
        """
        system = -self.A if self.dt is None else np.eye(len(self.A)) - self.A
        if len(self.A) and np.linalg.cond(system) > 1e15:
            raise UsageError(f"model {self.name!r} has an integrator, so it has no static gain")
        B = self.B if self.B_delayed is None else self.B + self.B_delayed
        return np.asarray(self.C @ np.linalg.solve(system, B) + self.D)

    def frequency_response(self, frequency_hz: npt.ArrayLike) -> ComplexArray:
        """Return the frequency response, shape (n_frequencies, n_outputs, n_inputs).

        Parameters
        ----------
        frequency_hz : (n_frequencies,) array
            Frequencies [Hz].

        Raises
        ------
        UsageError
            When a frequency is not finite, or when an undamped pole lies exactly on it.
        """
        s = 2j * np.pi * np.atleast_1d(np.asarray(frequency_hz, float))
        if not np.isfinite(s).all():
            raise UsageError(f"model {self.name!r}: frequency_hz holds values that are not finite")
        B = np.broadcast_to(self.B, (len(s), *self.B.shape)).astype(complex)
        if self.delay is not None:
            B = B + self.B_delayed * np.exp(-s[:, None] * self.delay)[:, None]
        if self.dt is not None:
            s = np.exp(s * self.dt)
        system = s[:, None, None] * np.eye(len(self.A)) - self.A
        try:
            states = np.linalg.solve(system, B)
        except np.linalg.LinAlgError:
            raise UsageError(f"model {self.name!r} has a pole at one of the given frequencies") from None
        return np.asarray(self.C @ states + self.D)

    def discretise(self, sample_time: float, *, intersample: str | Sequence[str] | None = None) -> LinearModel:
        """Return the discrete-time model, with zero-order hold of the disturbance.

        Parameters
        ----------
        sample_time : float
            Sample time [s].
        intersample : {"zoh", "foh"} or sequence of these, optional
            Inter-sample behaviour of the inputs; by default as for `simulate`. A plant behind a digital controller has
            zero-order hold.

        Notes
        -----
        With first-order hold, ``x[k+1] = F x[k] + G u[k] + H u[k+1]``, the state is ``x - H u``, and the feedthrough
        ``D + C H`` (Franklin, Powell and Workman, Digital Control of Dynamic Systems, Sec. 6.3.2).

        Raises
        ------
        UsageError
            When the model is discrete already, or when it has exact delays (see `with_pade`).
        """
        if self.dt is not None:
            raise UsageError(f"model {self.name!r} is discrete already (sample time {self.dt} s)")
        if self.delay is not None:
            raise UsageError(
                f"model {self.name!r} has exact delays; "
                "replace them by Pade approximations first: with_pade(model, order)"
            )
        check_sample_time(self.name, sample_time)
        B = self.B if self.K is None else np.hstack([self.B, self.K])
        n_u = self.B.shape[1]
        holds = [*self.holds(intersample), *["zoh"] * (B.shape[1] - n_u)]
        F, now, following = discretise(np.array(self.A), B, sample_time, holds)
        G, K, H = now[:, :n_u], now[:, n_u:], following[:, :n_u]
        gain = None if self.K is None else K
        sampled = {"A": F, "B": G + F @ H, "D": self.D + self.C @ H, "K": gain}
        return replace(self, **sampled, dt=sample_time, intersample=None)

    def _response(
        self,
        u: FloatArray,
        y: FloatArray | None,
        sample_time: npt.ArrayLike | None,
        initial_state: Any,
        holds: tuple[Hold, ...],
    ) -> FloatArray:
        """Return the outputs of the recursion ``x[k+1] = F x[k] + f[k]``; see `SampledSignals`."""
        x0 = np.zeros(len(self.A)) if initial_state is None else np.asarray(initial_state, float)
        if x0.shape != (len(self.A),):
            raise UsageError(f"model {self.name!r}: initial_state has shape {x0.shape}, expected ({len(self.A)},)")
        if self.dt is None:
            clock = check_clock(self.name, sample_time, len(u))
            if isinstance(clock, np.ndarray):
                return self._irregular_response(u, y, clock, x0, holds)
            sample_time = clock
            F, now, following = discretise(np.array(self.A), np.array(self.B), sample_time, holds)
        else:
            if sample_time is not None and (np.ndim(sample_time) or not np.isclose(sample_time, self.dt, rtol=1e-9)):
                raise UsageError(f"model {self.name!r} has sample time {self.dt} s, not {sample_time} s")
            sample_time = self.dt
            if any(hold != "zoh" for hold in holds):
                raise UsageError(f"model {self.name!r} is discrete: its inputs cannot be interpolated")
            F, now, following = self.A, self.B, np.zeros_like(self.B)
        forcing = u @ now.T
        forcing[:-1] += u[1:] @ following.T
        if self.delay is not None:
            forcing += self._delayed_forcing(u, sample_time, holds)
        if y is not None and self.K is not None:
            gain = np.array(self.K)
            if self.dt is None:
                gain = discretise(np.array(self.A), gain, sample_time, "zoh").G_now
            F, forcing = F - gain @ self.C, forcing + (y - u @ self.D.T) @ gain.T
        return np.asarray(propagate(F, forcing, x0) @ self.C.T + u @ self.D.T)

    def _irregular_response(
        self, u: FloatArray, y: FloatArray | None, time: FloatArray, x: FloatArray, holds: tuple[Hold, ...]
    ) -> FloatArray:
        """Return the outputs at irregular times from the initial state `x`, with matrices for each interval."""
        if self.delay is not None:
            raise UsageError(f"model {self.name!r} has exact delays, which irregular times do not take; see with_pade")
        steps, A = distinct_steps(time), np.array(self.A)
        numbers, doublings = step_numbers(time, steps), squarings_for([A * steps[-1]])
        F, now, following = discretise(A, np.array(self.B), steps[:, None, None], holds, doublings)
        forcing = (now[numbers] @ u[:, :, None])[:, :, 0]
        forcing[:-1] += (following[numbers[:-1]] @ u[1:, :, None])[:, :, 0]
        if y is not None and self.K is not None:
            gain = discretise(A, np.array(self.K), steps[:, None, None], "zoh", doublings).G_now
            F, forcing = F - gain @ self.C, forcing + (gain[numbers] @ (y - u @ self.D.T)[:, :, None])[:, :, 0]
        states = np.empty_like(forcing)
        for k, number in enumerate(numbers):
            states[k] = x
            x = F[number] @ x + forcing[k]
        return np.asarray(states @ self.C.T + u @ self.D.T)

    def _delayed_forcing(self, u: FloatArray, sample_time: float, holds: Sequence[Hold]) -> FloatArray:
        """Return the effect of delayed inputs on the state; before the record, inputs have their first value."""
        assert self.delay is not None
        assert self.B_delayed is not None
        forcing = np.zeros((len(u), len(self.A)))
        for i, hold in enumerate(holds):
            taps = delayed_taps(np.array(self.A), self.B_delayed[:, [i]], float(self.delay[i]), sample_time, hold)
            for j, column in enumerate(taps.columns):
                rows = np.clip(np.arange(len(u)) - taps.shift + 1 - j, 0, len(u) - 1)
                forcing += u[rows, i : i + 1] @ column.T
        return forcing

    def to_scipy(self) -> Any:
        """Return the model as ``scipy.signal.StateSpace``, without names and disturbance gain.

        Raises
        ------
        UsageError
            When the model has exact delays; replace them first with `with_pade`.
        """
        from scipy import signal

        self._refuse_delays("scipy")
        matrices = (np.array(m) for m in (self.A, self.B, self.C, self.D))
        return signal.StateSpace(*matrices, **({} if self.dt is None else {"dt": self.dt}))

    def to_control(self) -> Any:
        """Return the model as ``control.StateSpace`` with its names, without the disturbance gain.

        Dots in names become underscores, because python-control reserves the dot.

        Raises
        ------
        UsageError
            When the model has exact delays (replace them first with `with_pade`), or when python-control is not
            installed: install the extra ``gbid[control]``.
        """
        control = extra_package("control", "control", f"model {self.name!r}: conversion to python-control")
        self._refuse_delays("python-control")
        names = {"inputs": self.input_names, "outputs": self.output_names, "states": self.state_names}
        return control.StateSpace(
            *(np.array(m) for m in (self.A, self.B, self.C, self.D)),
            0 if self.dt is None else self.dt,
            **{kind: [name.replace(".", "_") for name in each] for kind, each in names.items()},
            name=self.name,
            remove_useless_states=False,
        )

    @classmethod
    def from_control(cls, system: Any, name: str | None = None) -> LinearModel:
        """Return the model of a state-space system of python-control.

        Parameters
        ----------
        system : control.StateSpace
            The system.
        name : str, optional
            Name of the model; by default that of the system.

        Returns
        -------
        LinearModel

        Raises
        ------
        UsageError
            When it is another type of system, or when its ``dt`` is None or True and the sample time is therefore
            unknown.
        """
        if not all(hasattr(system, part) for part in ("A", "B", "C", "D", "dt", "input_labels")):
            raise UsageError(
                f"a {type(system).__name__} is not a state-space system of python-control; "
                "convert it first, control.ss(system)"
            )
        if system.dt is None or isinstance(system.dt, bool):
            raise UsageError(
                f"system {system.name!r} has dt = {system.dt}, which is not a sample time; "
                "set system.dt to 0 for continuous time, or to the sample time in seconds"
            )
        matrices: dict[str, Any] = {letter: np.asarray(getattr(system, letter), float) for letter in "ABCD"}
        return cls(
            **matrices,
            dt=None if system.dt == 0 else float(system.dt),
            input_names=tuple(system.input_labels),
            output_names=tuple(system.output_labels),
            state_names=tuple(system.state_labels),
            name=system.name if name is None else name,
        )

    def _refuse_delays(self, library: str) -> None:
        if self.delay is not None:
            raise UsageError(
                f"model {self.name!r} has exact delays, which {library} does not support; "
                "replace them by Pade approximations first: with_pade(model, order)"
            )


# ---- Frequency grid with more points near the poles of a model.

_INTEGRATOR = 1e-9  # rate of a pole that is a zero with rounding, over that of the fastest one


def frequency_grid(model: LinearModel, n: int = 400) -> FloatArray:
    """Return frequencies with logarithmic spacing, and dense around each oscillatory pole.

    A pole within rounding of zero, as an integrator has, counts as zero.

    Parameters
    ----------
    model : LinearModel
        The model.
    n : int
        Number of frequencies with logarithmic spacing.

    Returns
    -------
    (n_frequencies,) array
        Frequencies from 0 [Hz], ascending, up to ten times the fastest pole or half the sampling frequency.
    """
    poles = model.poles()
    rates = np.abs(poles[np.isfinite(poles)]) / (2 * np.pi)
    rates = rates[rates > _INTEGRATOR * rates.max(initial=0.0)]
    slowest, fastest = (rates.min(), rates.max()) if len(rates) else (0.1, 10.0)
    nyquist = inf if model.dt is None else 0.5 / model.dt
    even = np.geomspace(slowest / 30, min(10 * fastest, nyquist), n)
    pairs = poles[np.isfinite(poles) & (poles.imag > 0)]
    spread = np.concatenate([-np.geomspace(0.05, 5, 8)[::-1], [0.0], np.geomspace(0.05, 5, 8)])
    around = (pairs.imag[:, None] + np.abs(pairs.real)[:, None] * spread).ravel() / (2 * np.pi)
    grid = np.unique(np.concatenate([[0.0], even, around, rates]))
    return np.asarray(grid[(grid >= 0) & (grid <= nyquist)])


_FINE, _MOST_POINTS, _CLOSEST = 0.5, 30_000, 1e-9
"""Largest step of a phase [rad] between points, most points, and smallest ratio of frequencies between them."""


def phase_in_degrees(model: LinearModel, frequency_hz: npt.ArrayLike) -> FloatArray:
    """Return the phase of a frequency response without jumps [degrees], in the response's shape.

    Toward rest the phase is -90 degrees for each integrator of a channel. A negative gain there adds 180 degrees, or
    takes them if an unstable pole makes the sign: 1/s^3 begins at -270 degrees, 1/(s - 1) at -180. From there the phase
    is followed over frequencies that are refined until its steps are small, so that the given ones may be coarse. That
    of a delayed input alone is exact.

    Parameters
    ----------
    model : LinearModel
        The model.
    frequency_hz : (n_frequencies,) array
        Frequencies from zero [Hz], in any order.

    Returns
    -------
    (n_frequencies, n_outputs, n_inputs) array
        Phase [degrees]; 0 of a channel without effect.

    Raises
    ------
    UsageError
        As for `LinearModel.frequency_response`.
    """
    f = np.atleast_1d(np.asarray(frequency_hz, float))
    input_delays, turned = np.zeros(model.D.shape[1]), model
    if model.delay is not None and model.B_delayed is not None:
        alone = ~model.B.any(axis=0) & ~model.D.any(axis=0)
        input_delays = np.where(alone, model.delay, 0.0)
        turned = replace(model, delay=np.where(alone, 0.0, model.delay))
    poles, own = model.poles(), frequency_grid(model)
    start = 1e-3 * float(min(own[own > 0].min(), f[f > 0].min(initial=np.inf)))
    delay = 0.0 if turned.delay is None else float(np.max(turned.delay, initial=0.0))
    turns = np.linspace(f.min(), f.max(), min(int(8 * delay * float(np.ptp(f))), _MOST_POINTS) + 2)
    on_axis = np.abs(poles.imag[np.abs(poles.real) <= 1e-12 * np.abs(poles)]) / (2 * np.pi)
    between = np.concatenate([own[(own > 0) & (own < f.max())], turns])
    between = between[(np.abs(between[:, None] - on_axis) > 1e-6 * between[:, None]).all(axis=1)]
    grid = np.unique(np.concatenate([[start, 2 * start], between, f[f > 0]]))
    response = turned.frequency_response(grid)
    while True:
        steps = np.angle(response[1:] * response[:-1].conj())
        ratio = grid[1:] / grid[:-1]
        wide = (np.abs(steps) > _FINE).any(axis=(1, 2)) & (ratio > 1 + _CLOSEST)
        if not wide.any() or len(grid) + wide.sum() > 2 * _MOST_POINTS:
            break
        middle = np.sqrt(grid[1:][wide] * grid[:-1][wide])
        at = np.flatnonzero(wide) + 1
        grid, response = np.insert(grid, at, middle), np.insert(response, at, turned.frequency_response(middle), axis=0)
    for k in np.flatnonzero((np.abs(steps) > 2).any(axis=(1, 2))):  # a pole or zero without damping lies between
        passed = ((on_axis >= grid[k]) & (on_axis <= grid[k + 1])).any()
        steps[k] = np.where(np.abs(steps[k]) > 2, np.abs(steps[k]) * (-1 if passed else 1), steps[k])
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.nan_to_num(np.round(np.log2(np.abs(response[1] / response[0]))))
    odd = int((poles.real > 1e-9 * np.abs(poles).max(initial=0.0)).sum()) % 2
    beyond = (np.degrees(np.angle(response[0])) - 90 * slope) % 360  # near 0 or 360, or near 180 for a negative gain
    first = 90 * slope + np.where(np.abs(beyond - 180) < 90, beyond - 360 * odd, (beyond + 180) % 360 - 180)
    phase = first + np.degrees(np.concatenate([np.zeros((1, *first.shape)), np.cumsum(steps, axis=0)]))
    return np.asarray(phase[np.searchsorted(grid, f)] - 360 * f[:, None, None] * input_delays)
