"""Response of the rotor to a half-sine impact, in open and closed loop (paper, Sec. 5.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, cos, inf, nan, pi, radians, sin
from typing import Annotated

import numpy as np
import scipy

from gbid.control.loop.close import force_entry
from gbid.control.loop.sensitivity import sensitivities
from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Finite, Positive, check_options
from gbid.discretise.exact import propagate
from gbid.lpv import MachineData
from gbid.structure import LinearModel

STEP_S = 2e-5
DECAYED = 0.05


@dataclass(frozen=True)
class HalfSine:
    """Half-sine impact ``f(t) = peak sin(pi t / duration)`` on the rotor.

    Parameters
    ----------
    peak_n : float
        Peak force [N].
    duration_s : float
        Duration [s].
    mass_kg : float, optional
        Moving mass [kg], to which the coefficients of the model refer; ``1 / mass_kg`` is g_f of the paper. Without it
        that of the LPV model (`gbid.lpv.MachineData`), where one is at hand.
    direction_deg : float
        Direction from x to y [degrees].

    Notes
    -----
    The default impact moves the disc of the paper's rig by about 8 of its 25 um of clearance.
    """

    peak_n: Positive = 12.0
    duration_s: Positive = 2e-3
    mass_kg: Positive | None = None
    direction_deg: Finite = 0.0

    def __post_init__(self) -> None:
        check_options(self, "impact")

    def towards(self, direction_deg: float) -> HalfSine:
        """Return this impact with another direction.

        Parameters
        ----------
        direction_deg : float
            Angle from x to y [degrees].
        """
        return replace(self, direction_deg=direction_deg)

    def on(self, machine: MachineData) -> HalfSine:
        """Return this impact with the moving mass of a machine, if the impact has no moving mass yet."""
        return self if self.mass_kg is not None else replace(self, mass_kg=machine.moving_mass_kg)

    @property
    def peak_per_mass(self) -> float:
        """Peak force per moving mass [N/kg].

        Raises
        ------
        UsageError
            When the moving mass is not known.
        """
        if self.mass_kg is None:
            raise UsageError("impact: the moving mass is not known; give mass_kg, such as HalfSine(mass_kg=2.18)")
        return self.peak_n / self.mass_kg


@dataclass(frozen=True, eq=False)
class ImpactResponse(Brief):
    """Response to an impact from rest.

    Attributes
    ----------
    time_s : (n_samples,) array
        Time [s].
    force_n : (n_samples,) array
        Force [N].
    p, r, u : (n_samples, 2) array
        Disc position, references, difference of piezo positions [m]; `u` is zero without actuators.
    peak_p_m : float
        Largest distance of the disc from its rest [m]; infinite for an unstable loop.
    peak_r_m, peak_u_m : float
        Largest entry of ``|r|`` and ``|u|`` [m].
    decay_time_s : float
        Time from the start of the impact until the distance stays below 5 % of its peak [s]; infinite when this does
        not happen within the simulated time.
    stack_travel_m : float
        Largest motion of a single stack from its middle, commanded or actual [m]: ``|r|``, or ``|u| / 2``.
    travel_limit_m : float
        Available motion of a stack to each side of its middle, half its travel [m]; nan when that is not known.
    """

    time_s: FloatArray
    force_n: FloatArray
    p: FloatArray
    r: FloatArray
    u: FloatArray
    peak_p_m: float
    peak_r_m: float
    peak_u_m: float
    decay_time_s: float
    stack_travel_m: float
    travel_limit_m: float

    @property
    def exceeds_travel(self) -> bool:
        """Whether a stack exceeds its travel; false if the travel is unknown. The response is linear, not saturated."""
        return self.stack_travel_m > self.travel_limit_m


def impact_response(
    plant: LinearModel,
    controller: LinearModel | None = None,
    impact: HalfSine | None = None,
    *,
    actuators: LinearModel | None = None,
    duration_s: float | None = None,
    piezo_travel_m: Annotated[Positive, Allowed("a positive number")] | None = None,
    entry: FloatArray | None = None,
) -> ImpactResponse:
    """Return the response to an impact on the rotor, without delay and actuators, ``p = G_b g_f f`` (Sec. 5.1).

    Parameters
    ----------
    plant : LinearModel
        G, from r to p, continuous without exact delays; or G_rb, from u to p, when there is no controller.
    controller : LinearModel, optional
        K, from p to r; open loop when not given.
    impact : HalfSine, optional
        The impact, with its moving mass.
    actuators : LinearModel, optional
        Actuators from r to u, for the motion of the piezos.
    duration_s : float, optional
        Simulated time [s]; by default until all poles have decayed, but at most 2 s.
    piezo_travel_m : float, optional
        Whole travel of one stack [m]; the stack rests in its middle and moves with r (Eq. 1). Without it nothing is
        said on whether a stack exceeds it.
    entry : (n, n_outputs) array, optional
        Input matrix of a force per mass; from `force_entry` when not given.

    Returns
    -------
    ImpactResponse
        Exact at its samples, which are 0.02 ms apart.

    Raises
    ------
    UsageError
        When the plant has exact delays or is sampled, when models do not fit together, when the plant has no positions
        and velocities as states, or when the moving mass is not given.
    """
    impact = impact or HalfSine()
    if plant.delay is not None:
        raise UsageError(f"model {plant.name!r} has exact delays; replace them first: with_pade(model, order)")
    acceleration, limit = impact.peak_per_mass, nan if piezo_travel_m is None else piezo_travel_m / 2
    E = force_entry(plant) if entry is None else np.asarray(entry, float)
    if len(E) != plant.n_states:
        raise UsageError(f"impact: entry has {len(E)} rows for the {plant.n_states} states of {plant.name!r}")
    n_p, n_r = len(plant.C), plant.B.shape[1]
    A, C = plant.A, np.vstack([plant.C, np.zeros((n_r, plant.n_states))])  # C of p and r
    if controller is not None:
        loop = sensitivities(plant, controller)
        to_p, to_r = loop.model("plant"), loop.model("input")
        A, C = to_p.A, np.vstack([to_p.C, to_r.C])
    if actuators is None:
        C = np.vstack([C, np.zeros((n_r, len(A)))])
    else:  # a copy of the actuators that follows r
        C_r, beside = C[n_p:], np.zeros((len(A), actuators.n_states))
        A = np.block([[A, beside], [actuators.B @ C_r, actuators.A]])
        C = np.block([[C, np.zeros((len(C), actuators.n_states))], [actuators.D @ C_r, actuators.C]])
    E = np.vstack([E, np.zeros((len(A) - len(E), E.shape[1]))])
    poles = np.linalg.eigvals(A)
    if poles.real.max() >= 0:
        nothing, none = np.zeros((0, n_p)), np.zeros(0)
        return ImpactResponse(none, none, nothing, nothing, nothing, inf, inf, inf, inf, inf, limit)
    if duration_s is None:
        duration_s = min(impact.duration_s + 7.0 / float(-poles.real.max()), 2.0)
    angle = radians(impact.direction_deg)
    push = E @ np.array([cos(angle), sin(angle)])[: E.shape[1]] * acceleration
    time, states = _simulate(A, push, impact.duration_s, duration_s)
    p, r, u = np.split(states @ C.T, [n_p, n_p + n_r], axis=1)
    force = np.where(time <= impact.duration_s, impact.peak_n * np.sin(pi * time / impact.duration_s), 0.0)
    distance = np.linalg.norm(p, axis=1)
    peak = _smooth_peak(distance)
    above = np.flatnonzero(distance >= DECAYED * peak)
    last = int(above[-1]) if len(above) else 0
    peak_r, peak_u = (max((_smooth_peak(np.abs(column)) for column in signal.T), default=0.0) for signal in (r, u))
    return ImpactResponse(
        time,
        force,
        p,
        r,
        u,
        peak,
        peak_r,
        peak_u,
        float(time[last + 1]) if last + 1 < len(time) else inf,
        max(peak_r, peak_u / 2),
        limit,
    )


def _simulate(A: FloatArray, push: FloatArray, length: float, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return times and states: the half sine as the output of an oscillator, then the free response."""
    n = len(A)
    w = pi / length
    during = np.zeros((n + 2, n + 2))
    during[:n, :n], during[:n, n] = A, push
    during[n, n + 1], during[n + 1, n] = w, -w
    n_during = max(8, ceil(length / STEP_S))
    n_after = max(1, ceil((duration - length) / STEP_S))
    h = length / n_during
    start = np.zeros(n + 2)
    start[n + 1] = 1.0
    first = propagate(scipy.linalg.expm(during * h), np.zeros((n_during + 1, n + 2)), start)[:, :n]
    second = propagate(scipy.linalg.expm(A * STEP_S), np.zeros((n_after + 1, n)), first[-1])
    time = np.concatenate([h * np.arange(n_during + 1), length + STEP_S * np.arange(1, n_after + 1)])
    return time, np.vstack([first, second[1:]])


def _smooth_peak(values: FloatArray) -> float:
    """Return the largest value of a sampled smooth curve, by the parabola through three samples."""
    k = int(values.argmax())
    if not 0 < k < len(values) - 1:
        return float(values[k])
    before, top, after = (float(v) for v in values[k - 1 : k + 2])
    bend = before - 2 * top + after
    return top - (after - before) ** 2 / (8 * bend) if bend < 0 else top
