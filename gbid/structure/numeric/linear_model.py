"""Linear model with numeric matrices: the result of a fit and the plant of a control loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief, Description, brief
from gbid.discretise import discretise, propagate
from gbid.errors import UsageError
from gbid.extras import Pictured
from gbid.hdf5 import Stored
from gbid.poles import oscillatory_modes
from gbid.structure.numeric.checked_fields import checked_fields
from gbid.structure.numeric.frequency_domain import continuous_poles, frequency_response, static_gain
from gbid.structure.numeric.interchange import control_state_space, from_state_space, scipy_state_space
from gbid.structure.numeric.sampled_run import channels, check_sample_time, sampled_run


@dataclass(frozen=True, eq=False)
class LinearModel(Brief, Pictured):
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

    def __post_init__(self) -> None:
        for field, value in checked_fields(self).items():
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
        return continuous_poles(self)

    def is_stable(self) -> bool:
        """Return whether the model is asymptotically stable."""
        eigenvalues = np.linalg.eigvals(self.A)
        return bool((eigenvalues.real < 0).all() if self.dt is None else (np.abs(eigenvalues) < 1).all())

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
        return static_gain(self)

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
        return frequency_response(self, frequency_hz)

    def discretise(self, sample_time: float) -> LinearModel:
        """Return the discrete-time model for zero-order hold of inputs and disturbance.

        Parameters
        ----------
        sample_time : float
            Sample time [s].

        Raises
        ------
        UsageError
            When the model is discrete already, or when it has exact delays (see `with_pade`).
        """
        self._require_continuous()
        if self.delay is not None:
            raise UsageError(
                f"model {self.name!r} has exact delays; "
                "replace them by Pade approximations first: with_pade(model, order)"
            )
        check_sample_time(self.name, sample_time)
        B = self.B if self.K is None else np.hstack([self.B, self.K])
        F, G, _ = discretise(np.array(self.A), B, sample_time, "zoh")
        n_u = self.B.shape[1]
        return replace(self, A=F, B=G[:, :n_u], K=None if self.K is None else G[:, n_u:], dt=sample_time)

    def simulate(
        self,
        inputs: npt.ArrayLike,
        sample_time: float | None = None,
        *,
        initial_state: npt.ArrayLike | None = None,
        intersample: str | Sequence[str] = "zoh",
    ) -> FloatArray:
        """Return the response to sampled inputs.

        Parameters
        ----------
        inputs : (n_samples, n_inputs) array
            Input signals.
        sample_time : float, optional
            Time between samples [s]; a discrete model has its own.
        initial_state : (n,) array, optional
            State at the first sample; zero when not given.
        intersample : {"zoh", "foh"} or sequence of these
            Inter-sample behaviour of the inputs; for a discrete model it was fixed by its discretisation.

        Returns
        -------
        (n_samples, n_outputs) array
            Output signals.

        Raises
        ------
        UsageError
            When shapes do not fit, when an input is not finite, when the sample time is missing or differs, or when
            `intersample` is given for a discrete model.
        """
        F, forcing, u, x0 = sampled_run(self, inputs, sample_time, initial_state, intersample)
        return np.asarray(propagate(F, forcing, x0) @ self.C.T + u @ self.D.T)

    def predict(
        self,
        inputs: npt.ArrayLike,
        outputs: npt.ArrayLike,
        sample_time: float | None = None,
        *,
        initial_state: npt.ArrayLike | None = None,
        intersample: str | Sequence[str] = "zoh",
    ) -> FloatArray:
        """Return one-step-ahead predictions of the outputs from measured inputs and outputs (paper, Eq. 10).

        Without a disturbance gain this is the simulation.

        Parameters
        ----------
        inputs : (n_samples, n_inputs) array
            Input signals.
        outputs : (n_samples, n_outputs) array
            Measured outputs.
        sample_time : float, optional
            Time between samples [s]; a discrete model has its own.
        initial_state : (n,) array, optional
            State at the first sample; zero when not given.
        intersample : {"zoh", "foh"} or sequence of these
            Inter-sample behaviour of the inputs.

        Returns
        -------
        (n_samples, n_outputs) array
            Predicted outputs.

        Raises
        ------
        UsageError
            As for `simulate`, or when the outputs do not fit.
        """
        F, forcing, u, x0 = sampled_run(self, inputs, sample_time, initial_state, intersample)
        y = channels(self.name, "outputs", outputs, len(self.C), len(u))
        if self.K is not None:
            gain = np.array(self.K)
            if self.dt is None and sample_time is not None:
                gain = discretise(np.array(self.A), gain, sample_time, "zoh").G_now
            F, forcing = F - gain @ self.C, forcing + (y - u @ self.D.T) @ gain.T
        return np.asarray(propagate(F, forcing, x0) @ self.C.T + u @ self.D.T)

    def to_scipy(self) -> Any:
        """Return the model as ``scipy.signal.StateSpace``, without names and disturbance gain.

        Raises
        ------
        UsageError
            When the model has exact delays; replace them first with `with_pade`.
        """
        return scipy_state_space(self)

    def to_control(self) -> Any:
        """Return the model as ``control.StateSpace`` with its names, without the disturbance gain.

        Dots in names become underscores, because python-control reserves the dot.

        Raises
        ------
        UsageError
            When the model has exact delays (replace them first with `with_pade`), or when python-control is not
            installed: install the extra ``gbid[control]``.
        """
        return control_state_space(self)

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
        return cls(**from_state_space(system, name))

    def _require_continuous(self) -> None:
        if self.dt is not None:
            raise UsageError(f"model {self.name!r} is discrete already (sample time {self.dt} s)")
