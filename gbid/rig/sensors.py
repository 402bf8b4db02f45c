"""Sensors of the rig (run-out, offsets, noise, encoder counts) and sampled controllers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Exact, Finite, NotNegative, Positive, check_options

TURN = 2 * np.pi

Orders = tuple[Finite, ...]
OneOrTwo = Annotated[
    NotNegative | tuple[NotNegative, NotNegative],
    Allowed("a finite number of at least zero, or two of them for x and y"),
]

# Both sensors measure the same surface of the disc, a quarter turn apart. So y has the run-out of x, later.
_AMPLITUDE = (3.0e-6, 1.5e-6, 0.8e-6, 0.4e-6, 0.2e-6)
_PHASE = (0.4, 2.1, -1.3, 0.9, -2.6)
_PHASE_OF_Y = tuple(phase - order * np.pi / 2 for order, phase in enumerate(_PHASE, start=1))


@dataclass(frozen=True, eq=False)
class SensorChain(Brief):
    """Sensors of the rig: eddy-current probes (p), piezo strain gauges (u) and a shaft encoder (phi).

    Run-out is the signal of the probes when the disc turns without moving. It comes from the roundness of the disc and
    from electrical inhomogeneity. Channel j shows the sum over the orders n = 1, 2, ... of a_jn cos(n phi + theta_jn).

    Parameters
    ----------
    noise_p_m : float or (2,) tuple
        Standard deviation of the white noise of the disc position [m]; one value for both axes, or x and y.
    noise_u_m : float or (2,) tuple
        Standard deviation of the white noise of the piezo position difference [m].
    runout_amplitude_m : (2, n_orders) tuple or array
        a [m]; rows are the axes x and y, columns the orders 1, 2, .... A few micrometres by default.
    runout_phase_rad : (2, n_orders) tuple or array
        theta [rad].
    offset_p_m : (2,) tuple
        Reading of the probes for a centred disc [m].
    offset_u_m : (2,) tuple
        Reading of the gauges for equal piezo positions [m].
    encoder_counts : int or None
        Counts per turn; the angle is rounded down to a count. None is an ideal encoder.
    resolution_p_m, resolution_u_m : float
        Steps of the analogue-to-digital converters of probes and gauges [m]; 0 means no rounding.
    noise_f_n : float
        Standard deviation of the white noise of the measured impact force [N].

    Raises
    ------
    UsageError
        When noise is negative, rows differ in length, or there are fewer than 2 counts.
    """

    noise_p_m: OneOrTwo = 30e-9
    noise_u_m: OneOrTwo = 10e-9
    runout_amplitude_m: tuple[Orders, Orders] = (_AMPLITUDE, _AMPLITUDE)
    runout_phase_rad: tuple[Orders, Orders] = (_PHASE, _PHASE_OF_Y)
    offset_p_m: tuple[Finite, Finite] = (2.0e-6, -3.0e-6)
    offset_u_m: tuple[Finite, Finite] = (0.5e-6, -0.3e-6)
    encoder_counts: Annotated[int, Exact(), Ge(2)] | None = 4096
    resolution_p_m: NotNegative = 0.0
    resolution_u_m: NotNegative = 0.0
    noise_f_n: NotNegative = 0.05

    def __post_init__(self) -> None:
        check_options(self, "sensors")
        lengths = {len(row) for row in (*self.runout_amplitude_m, *self.runout_phase_rad)}
        if len(lengths) > 1:
            raise UsageError(
                f"sensors: runout_amplitude_m and runout_phase_rad have rows of {lengths} orders; give as many in each"
            )


def quantised(values: FloatArray, resolution: float) -> FloatArray:
    """Return values rounded to the steps of a converter; a resolution of 0 leaves them as they are."""
    return np.rint(values / resolution) * resolution if resolution > 0 else values


def runout(sensors: SensorChain, angle: FloatArray) -> FloatArray:
    """Return the run-out at given shaft angles.

    Parameters
    ----------
    sensors : SensorChain
        The sensors.
    angle : (n,) array
        True shaft angle [rad], wrapped or not.

    Returns
    -------
    (n, 2) array
        Run-out that is added to x and y [m].
    """
    phasors = np.array(sensors.runout_amplitude_m) * np.exp(1j * np.array(sensors.runout_phase_rad))
    turned = np.exp(1j * np.outer(angle, np.arange(1, phasors.shape[1] + 1)))
    return np.asarray((turned @ phasors.T).real)


def encoder_angle(sensors: SensorChain, angle: FloatArray) -> FloatArray:
    """Return the angle that the encoder reads, within [0, 2 pi) [rad], shape of `angle`."""
    turns = np.mod(angle / TURN, 1.0)
    if sensors.encoder_counts is None:
        return np.where(turns < 1.0, turns, 0.0) * TURN  # mod rounds tiny negative angles up to 1
    counts = np.floor(turns * sensors.encoder_counts) % sensors.encoder_counts
    return np.asarray(counts * (TURN / sensors.encoder_counts))


# ---- Sampled feedback controllers of the rig: state-space matrices, or a program.


@dataclass(frozen=True, eq=False)
class SampledController(Brief):
    r"""Discrete-time controller from the measured disc position to the references.

    .. math:: x_{k+1} = A x_k + B e_k, \quad w_k = C x_k + D e_k, \quad
              e_k = p_k - \mathcal F_r(\phi_k) - p_0

    The output w_k is added to the excitation one sample later, because the computation takes one sample. The sum is
    limited to the travel of the stacks. Positive gains mean positive feedback, as in the paper (Sec. 5).

    Parameters
    ----------
    A, B, C, D : (n, n), (n, 2), (2, n), (2, 2) array
        State-space matrices; n may be zero.
    sample_time : float
        Time between samples [s]; it must be that of the logger.
    runout : (n_bins, 2) array, optional
        F_r [m] at the shaft angles 2 pi i/n_bins of the encoder, with linear interpolation in between.
    offset : (2,) array
        p_0 [m].
    name : str
        Name of the controller.

    Raises
    ------
    UsageError
        When shapes do not fit, values are not finite, or the sample time is not positive.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    sample_time: Positive
    runout: FloatArray | None = None
    offset: FloatArray | tuple[float, float] = (0.0, 0.0)
    name: str = "controller"

    def __post_init__(self) -> None:
        check_options(self, "SampledController")
        n = np.shape(self.A)[0] if np.ndim(self.A) == 2 else -1
        shapes = {"A": (n, n), "B": (n, 2), "C": (2, n), "D": (2, 2), "offset": (2,)}
        if self.runout is not None:
            shapes["runout"] = (max(np.shape(self.runout)[0] if np.ndim(self.runout) else 0, 1), 2)
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=float)
            if n < 0 or value.shape != shape or not np.isfinite(value).all():
                raise UsageError(
                    f"sampled controller: {name} has shape {value.shape}; give finite numbers, A (n, n), B (n, 2), "
                    "C (2, n), D (2, 2), offset (2,), runout (n_bins, 2)"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def subtracted(self, angle: FloatArray) -> FloatArray:
        """Return the correction subtracted from the measured position before feedback, shape (n, 2) [m].

        Parameters
        ----------
        angle : (n,) array
            Shaft angle that the encoder shows [rad].
        """
        if self.runout is None:
            return np.tile(np.asarray(self.offset), (len(angle), 1))
        nodes = np.arange(len(self.runout) + 1) * (TURN / len(self.runout))
        closed = np.vstack([self.runout, self.runout[:1]])
        wrapped = np.mod(angle, TURN)
        return np.column_stack([np.interp(wrapped, nodes, closed[:, j]) for j in range(2)]) + self.offset


@runtime_checkable
class LoopProgram(Protocol):
    """Protocol of programs that compute references from samples, such as the compiled control chain."""

    def references(self, position: FloatArray, angle: float, pressure_bar: float, speed_rpm: float) -> FloatArray:
        """Return r_x, r_y [m] for one sample of measured p_x, p_y [m], shaft angle [rad] and operating point."""
        ...


@dataclass(frozen=True, eq=False)
class ProgramController:
    """Feedback by a program that receives each sample in turn: software in the loop.

    The references act one sample later and are limited to the travel of the stacks, as with `SampledController`.

    Parameters
    ----------
    program : LoopProgram
        The program.
    sample_time : float
        Time between samples [s]; it must be that of the logger.
    name : str
        Name of the controller.
    """

    program: LoopProgram
    sample_time: float
    name: str = "program"
