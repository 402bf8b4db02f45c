"""Four piezo stacks with hysteresis, creep, saturation and PD controllers (paper, Sec. 2 and Appendix A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import scipy

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.files import share_folder
from gbid.core.option_types import NotNegative, Positive, check_options

N_PLAYS = 10
"""Number of play operators of one stack; each branch of the hysteresis loop is a polygon with this many corners."""

ALLOCATION = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
"""Factors of r_x and r_y in the references of the stacks 1 to 4, added to r_0 (Eq. 1)."""
ALLOCATION.setflags(write=False)


@dataclass(frozen=True)
class PiezoStack:
    r"""Nonlinear piezo stack with its amplifier and its PD controller.

    .. math::

        v &= \mathrm{sat}\!\left(c P \frac{s + z}{s + p_p} (g r - y)\right), \quad
        \dot a = \omega_s (v - a), \\
        \dot y &= \omega_f (\mathrm{sat}(H[a] + \textstyle\sum_k c_k) - y), \quad
        T_k \dot c_k = \gamma_k H[a] - c_k

    H is a Prandtl-Ishlinskii operator: a spring and `N_PLAYS` one-sided plays of equal weight. The thresholds of the
    plays are spaced evenly over the voltage. For loops inside the range this is Rayleigh's law: a small loop has a
    smaller slope than a large one, and its width grows with the square of its size.

    Parameters
    ----------
    pd_gain, pd_zero, pd_pole : float
        P, z, p_p of Eq. A.1 [1, rad/s, rad/s]; Table A.5.
    pd_scale : float
        c, voltage per unit of the output of the controller [V/m]. Table A.5 gives P in m/m and does not give c.
    slow_pole, fast_pole : float
        omega_s of the amplifier with the capacitance of the stack, and omega_f of pin and stack [rad/s]. The zeros
        of Table A.5 differ from stack to stack; each is assumed to cancel the slow pole of its stack.
    reference_gain : float
        g, gain of the electronics on the commanded position [m/m].
    stroke : float
        Largest expansion [m]; 45 um in Sec. 2.
    voltage_limit : float
        Largest voltage [V]; 10 V in Sec. 2. The smallest voltage is zero.
    hysteresis : float
        Largest difference between the branches of the fast loop over the whole voltage range [m]. Creep adds to
        it: with steps of one second the default gives the 8.4 um of Fig. A.28.
    creep : float
        Slow expansion over fast expansion; "a few percent over minutes" (Appendix A).
    creep_times : tuple of float
        Time constants T_k [s]. The creep is shared equally among them, so that it grows about as the logarithm of
        time.

    Raises
    ------
    UsageError
        When values are not finite or have the wrong sign, or when the hysteresis is too large for the stroke.
    """

    pd_gain: Positive
    pd_zero: Positive
    pd_pole: Positive
    pd_scale: Positive
    slow_pole: Positive
    fast_pole: Positive
    reference_gain: Positive = 1.0
    stroke: Positive = 45e-6
    voltage_limit: Positive = 10.0
    hysteresis: NotNegative = 8.1e-6
    creep: NotNegative = 0.03
    creep_times: tuple[Positive, ...] = (1.0, 10.0, 100.0)

    def __post_init__(self) -> None:
        check_options(self, "piezo stack")
        if self.spring <= 0:
            raise UsageError(
                f"piezo stack: hysteresis = {self.hysteresis * 1e6:g} um is too large for a stroke of "
                f"{self.stroke * 1e6:g} um; it must stay below half of it"
            )

    @property
    def thresholds(self) -> FloatArray:
        """Threshold of each play operator (N_PLAYS,) [V]: the voltage by which its output lags."""
        return np.asarray((np.arange(N_PLAYS) + 0.5) * (self.voltage_limit / N_PLAYS), np.float64)

    @property
    def play_weight(self) -> float:
        """Expansion per volt of each play operator [m/V], chosen so that mid-range branches differ by `hysteresis`."""
        rho = self.thresholds
        return self.hysteresis / float(np.minimum(rho, self.voltage_limit - rho).sum())

    @property
    def spring(self) -> float:
        """Expansion per volt without hysteresis [m/V], chosen so that the full voltage range gives the stroke."""
        return self.stroke / self.voltage_limit - self.play_weight * float(
            (1.0 - self.thresholds / self.voltage_limit).sum()
        )

    def expansion(self, voltage: float, plays: FloatArray) -> float:
        """Return the fast expansion H for given states of the play operators [m].

        Parameters
        ----------
        voltage : float
            Voltage of the stack [V].
        plays : (n_plays,) array
            States of the plays at this voltage [V].
        """
        return self.spring * voltage + self.play_weight * float(np.sum(plays))

    def rest(self, reference: float, voltage: float | None = None) -> StackRest:
        """Return the state of rest of the stack after a rise from zero volts and after all creep.

        Parameters
        ----------
        reference : float
            Commanded position [m].
        voltage : float, optional
            Applied voltage [V]. When it is given, the controller is off and `reference` is ignored.
        """
        dc = self.pd_gain * self.pd_scale * self.pd_zero / self.pd_pole

        def position(volts: float) -> float:
            h = self.expansion(volts, np.maximum(volts - self.thresholds, 0.0))
            return min((1.0 + self.creep) * h, self.stroke)

        def excess(volts: float) -> float:
            return volts - dc * (self.reference_gain * reference - position(volts))

        if voltage is None:
            low, high = excess(0.0), excess(self.voltage_limit)
            inside = low < 0 < high
            voltage = float(scipy.optimize.brentq(excess, 0, self.voltage_limit, xtol=1e-14)) if inside else 0.0
            if high <= 0:
                voltage = self.voltage_limit
        plays = np.maximum(voltage - self.thresholds, 0.0)
        return StackRest(voltage, position(voltage), plays, self.expansion(voltage, plays))


@dataclass(frozen=True, eq=False)
class StackRest:
    """State of rest of a stack: voltage [V], position [m], play operators (N_PLAYS,) [V], fast expansion H [m]."""

    voltage: float
    position: float
    plays: FloatArray
    expansion: float


_AXIS = ("y", "x", "y", "x")


@cache
def _published_tables() -> tuple[tuple[dict[str, float], ...], dict[str, float]]:
    """Return Table A.5 (gain, zero and pole of each controller) and Table 2 from the model file of the machine."""
    from gbid.core.yaml_file import read_yaml  # not at every import of the rig

    machine = read_yaml(share_folder("models") / "theisen2016.yaml").data
    return tuple(machine["piezo_controllers"]["piezos"]), machine["actuators"]


def _published_stack(number: int) -> PiezoStack:
    """Return stack 1 to 4, such that the closed pair has the dynamics of Table 2 for references of about 1 V.

    The zero cancels the slow pole, so the loop has two poles, that of the controller p_p and omega_f. Table 2 gives
    p_1, p_2 and kappa of the axis that the stack moves. They require omega_f = p_1 + p_2 - p_p and the loop gain
    p_1 p_2/omega_f - p_p.
    """
    controllers, actuators = _published_tables()
    gain, zero, pole = (float(controllers[number - 1][key]) for key in ("gain", "zero", "pole"))
    p1, p2, kappa = (float(actuators[f"{name}_{_AXIS[number - 1]}"]) for name in ("p1", "p2", "kappa"))
    fast = p1 + p2 - pole
    loop = p1 * p2 / fast - pole  # P c slope z
    slope = _LOOP_SLOPE * 4.5e-6
    return PiezoStack(
        gain,
        zero,
        pole,
        loop / (gain * zero * slope),
        zero,
        _FAST * fast,
        reference_gain=kappa / 2 * (1 + pole / loop),
    )


_LOOP_SLOPE, _FAST = 0.72, 1.26
"""Corrections for the hysteresis, found by fits to PRBS of 4.5 um. The first is the slope of such a loop over the slope
of the whole range. The second is the factor on the fast pole of a linear loop. The slope is smaller after each
reversal, so the pole must be faster."""


def _published_stacks() -> tuple[PiezoStack, ...]:
    return tuple(_published_stack(i) for i in (1, 2, 3, 4))


@dataclass(frozen=True)
class PiezoStacks(Brief):
    """Four piezo stacks, controlled in pairs by the differential principle (Eqs. 1 and 2).

    ``r_p = r_0 + [r_y, r_x, -r_y, -r_x]`` and ``u = [y_2 - y_4, y_1 - y_3]``.

    Parameters
    ----------
    stacks : tuple of 4 PiezoStack
        Stacks 1 to 4. The default is Table A.5, scaled so that the closed pairs are close to Table 2.
    offset : float
        r_0 [m]; by default the middle of the stroke.

    Raises
    ------
    UsageError
        When there are not four stacks, or the offset lies outside the stroke.
    """

    stacks: tuple[PiezoStack, ...] = field(default_factory=_published_stacks)
    offset: float = 22.5e-6

    def __post_init__(self) -> None:
        object.__setattr__(self, "stacks", tuple(self.stacks))
        if len(self.stacks) != 4:
            raise UsageError(f"piezo stacks: {len(self.stacks)} stacks; give four")
        if len({len(stack.creep_times) for stack in self.stacks}) > 1:
            raise UsageError("piezo stacks: creep_times differ in number; give as many to each stack")
        if not self.travel > 0:
            raise UsageError(f"piezo stacks: offset = {self.offset:g} m; it must lie inside the stroke of every stack")

    @property
    def travel(self) -> float:
        """Largest ``|r|`` at which no stack reaches an end of its stroke [m]."""
        return min(self.offset, min(stack.stroke for stack in self.stacks) - self.offset)

    @classmethod
    def unequal(cls, spread: float, seed: int = 0, stacks: Sequence[PiezoStack] | None = None) -> PiezoStacks:
        """Return stacks with random differences in poles and hysteresis.

        Parameters
        ----------
        spread : float
            Relative standard deviation of the slow pole, the fast pole and the hysteresis of each stack. Deviations
            are limited to three standard deviations. The controllers keep their parameters, so that zero and slow
            pole no longer cancel.
        seed : int
            The same seed gives the same stacks.
        stacks : sequence of 4 PiezoStack, optional
            The stacks to vary; by default the published ones.

        Raises
        ------
        UsageError
            When `spread` lies outside [0, 0.3).
        """
        if not 0 <= spread < 0.3:
            raise UsageError(f"piezo stacks: spread = {spread}; give a number from 0 to below 0.3")
        base = _published_stacks() if stacks is None else tuple(stacks)
        factors = 1.0 + spread * np.clip(np.random.default_rng(seed).standard_normal((len(base), 3)), -3.0, 3.0)
        return cls(
            tuple(
                replace(
                    stack,
                    slow_pole=stack.slow_pole * float(f[0]),
                    fast_pole=stack.fast_pole * float(f[1]),
                    hysteresis=stack.hysteresis * float(f[2]),
                )
                for stack, f in zip(base, factors, strict=True)
            )
        )


def pair_difference(positions: FloatArray) -> FloatArray:
    """Return u from the positions of the four stacks (Eq. 2), shape (..., 4) to (..., 2)."""
    return np.stack([positions[..., 1] - positions[..., 3], positions[..., 0] - positions[..., 2]], axis=-1)
