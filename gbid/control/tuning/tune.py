"""Tuning of a controller of fixed structure over the operating points of an LPV model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.control.controllers.scheduled import Scheduled
from gbid.control.controllers.structures import controller_structure
from gbid.control.impact.half_sine import HalfSine
from gbid.control.tuning.gain_result import GainResult
from gbid.control.tuning.loops_at_points import LoopsAtPoints
from gbid.control.tuning.maximise import as_bounds, as_start, summarise, typical_rate
from gbid.control.tuning.over_points import solve_over_points
from gbid.control.tuning.search.global_search import Effort, Progress
from gbid.control.tuning.search.limits import Limits, Objective
from gbid.control.tuning.search.loop_delay import PADE_ORDER, loop_delay, smallest_sampled_damping
from gbid.control.tuning.search.loop_family import loop_equations
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.travel import travel_limit
from gbid.control.tuning.uncertainty import Uncertainty
from gbid.control.tuning.verify import distance_to_edge
from gbid.control.tuning.worst_points import add_worst_points
from gbid.errors import UsageError
from gbid.lpv import LPVModel
from gbid.operating_point import point_label
from gbid.poles import is_real
from gbid.structure.linear import Structure

Point = tuple[float, float]


def tune(
    lpv: LPVModel,
    *,
    operating_points: Sequence[Point] | Literal["domain"] | None = None,
    actuator: Mapping[str, float] | None = None,
    controller: str | Structure | Scheduled = "P",
    peak_sensitivity: float | None = 2.6,
    peak_control: float | None = None,
    static_amplification: float | None = None,
    slowest_pole: float | None = None,
    impact: HalfSine | None = None,
    piezo_travel_m: float = 45e-6,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    uncertainty: Uncertainty | None = None,
    objective: Objective = "damping",
    sample_time: float | None = None,
    computation_s: float | None = None,
    start: Mapping[str, float] | None = None,
    starts: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> GainResult:
    r"""Return the gains of a controller that maximise the damping of an LPV plant within limits.

    .. math:: \max_g \; \min_{P, \Omega} \min_j \zeta_j(g; P, \Omega) \quad\text{with}\quad
              \max_\omega \bar\sigma(S_o(j\omega; g; P, \Omega)) \le M

    over the oscillatory modes of the closed loop (Eqs. 20 to 22) at all operating points, with every pole faster than
    `slowest_pole`.

    Parameters
    ----------
    lpv : LPVModel
        Model of the plant, with actuators.
    operating_points : sequence of (pressure_bar, speed_rpm), or "domain", optional
        Operating points; by default those of the model. ``"domain"``: the whole rectangle. The worst points are then
        found and added until none is worse by more than 1e-4.
    actuator : dict of str to float, optional
        Parameters of Eq. 12 [rad/s, m/m]; by default those of the model.
    controller : {"P", "PD", "biquad"}, Structure or Scheduled
        See `gbid.controller_structure`; by default P with a first-order low-pass of 1000 Hz. To tune the corner
        frequency as well, use ``controller_structure("P", tune_corner=True)``. For gains that depend on pressure and
        speed, use `gbid.control.scheduled`.
    peak_sensitivity : float, optional
        Limit M on the peak of the output sensitivity; None maximises damping without this limit, see Notes.
    peak_control, static_amplification : float, optional
        Limits on the peak of K S_o [m/m] and on the gain of S_o at zero frequency.
    slowest_pole : float, optional
        Smallest allowed decay rate of every pole, real ones included [1/s]. By default that of the slowest oscillatory
        mode of the open loop at these points, or 0 (stability only) without a limit on the sensitivity.
    impact : HalfSine, optional
        Impact after which no piezo stack may exceed its travel, in x and in y, at any operating point.
    piezo_travel_m : float
        Whole travel of a stack [m].
    bounds : dict of str to (lower, upper), optional
        Bounds of gains in place of those of the structure.
    uncertainty : Uncertainty, optional
        Drawn plants for which the design must also hold.
    objective : {"damping", "decay"}
        Smallest damping factor of the oscillatory modes, or slowest decay ``-Re`` of all poles [1/s].
    sample_time : float, optional
        Sample time of a design for the sampled loop [s]. Holding the references adds a delay of half a sample, their
        computation adds `computation_s`. Both are modelled as one delay. This delay and those of the model are Padé
        approximations of order 3. The value and the peaks are of that loop, and the notes give the damping of the
        exactly sampled loop. Without `sample_time` the loop is continuous and has more damping than the sampled one.
    computation_s : float, optional
        Time from the sample of p to the change of r [s]; one sample when not given.
    start : dict of str to float, optional
        Gains as an additional start value.
    starts, seed
        As for `gbid.maximise_damping`.
    progress : callable, optional
        Called with a `gbid.control.SearchStep` after each stage.

    Returns
    -------
    GainResult
        Gains with exact peaks, active limits, and notes on the distance to instability.

    Raises
    ------
    UsageError
        When a point lies outside the domain of the model, when limits or bounds are not allowed, or when a gain is
        unknown.

    Notes
    -----
    Damping alone is not a suitable objective. Positive feedback reduces the stiffness, and a damping factor does not
    show the slow real pole that results. The optimum over all points without a limit on S_o is at the boundary of
    static instability. For such a design the notes of the result give the distance to it.

    Examples
    --------
    >>> import gbid
    >>> model = gbid.load_model("theisen2016")
    >>> result = gbid.tune(model, operating_points=[(6, 0)], peak_sensitivity=2.2832)
    >>> round(result.value, 3)
    0.318
    """
    structure = controller if isinstance(controller, Scheduled) else controller_structure(controller)
    over_domain = isinstance(operating_points, str)
    points = _points(lpv, operating_points)
    delay_s = loop_delay(sample_time, computation_s)
    if delay_s:
        lpv = replace(lpv, pade_order=PADE_ORDER)
    equations = loop_equations(lpv, structure, None if actuator is None else dict(actuator), delay_s=delay_s)
    plants = LoopsAtPoints(structure, equations, points, uncertainty)
    low, high, start_gains = _gain_bounds(structure, bounds)
    names = tuple(parameter.name for parameter in equations.gains)
    family = plants.family(points)
    open_loop = [_slowest_mode(lpv.at(float(P), float(Omega)).poles()) for P, Omega in points]
    if slowest_pole is None:
        slowest_pole = 0.0 if peak_sensitivity is None else max(min(open_loop), 0.0)
    limits = Limits(objective, slowest_pole, peak_sensitivity, peak_control, static_amplification)
    if impact is not None:
        model = lpv if actuator is None else replace(lpv, actuators=dict(actuator))
        plant = model.plant_at(float(points[0, 0]), float(points[0, 1]))
        limits = replace(limits, extra=(travel_limit(plant, impact, piezo_travel_m),))
    problem = GainProblem((family,), limits, low, high, typical_rate((family,), start_gains))
    problem.linear = plants.gain_limits(points)
    unknown = [name for name in start or {} if name not in names]
    if unknown:
        raise UsageError(f"start: no gain {', '.join(unknown)}; there are {', '.join(names)}")
    first = (
        [] if start is None else [as_start([start.get(n, v) for n, v in zip(names, start_gains, strict=True)], names)]
    )
    if isinstance(structure, Scheduled):
        first.append(
            _constant_gains(lpv, structure, points, limits, actuator, uncertainty, Effort(starts, seed), delay_s)
        )
    optimum, history = solve_over_points(problem, plants, points, start_gains, Effort(starts, seed), first, progress)
    verified = f"eigenvalues and exact H-infinity norms of {len(family)} loops"
    if over_domain:
        optimum, problem, more, verified = add_worst_points(problem, optimum, plants, lpv.domain, progress)
        history += more
    unstable = [point_label(P, Omega) for (P, Omega), rate in zip(points, open_loop, strict=True) if rate <= 0]
    notes: tuple[str, ...] = (f"the open loop is not stable at {'; '.join(unstable)}",) if unstable else ()
    notes += _edge_notes(problem, optimum, names, peak_sensitivity)
    used = problem.families[0].points
    assert used is not None
    if sample_time is not None:
        machine = lpv if actuator is None else replace(lpv, actuators=dict(actuator))
        gains = dict(zip(names, map(float, optimum.x), strict=True))
        where = sorted({(float(P), float(Omega)) for P, Omega in used})
        truly, (P, Omega) = smallest_sampled_damping(machine, structure, gains, where, sample_time, computation_s)
        notes += (
            f"designed for sampling at {1e3 * sample_time:g} ms with {1e3 * delay_s:g} ms more delay; the sampled loop "
            f"itself has a smallest damping factor of {truly:.3f}, at {point_label(P, Omega)}",
        )
    return summarise(
        problem,
        optimum,
        names,
        history,
        verified,
        notes,
        points=tuple(dict.fromkeys((float(P), float(Omega)) for P, Omega in used)),
        controller=structure,
        sample_time=sample_time,
    )


def _points(lpv: LPVModel, given: Sequence[Point] | str | None) -> FloatArray:
    """Return operating points (m, 2), checked against the domain; of a whole domain its corners and middles."""
    if isinstance(given, str):
        if given != "domain":
            raise UsageError(f"operating_points = {given!r}; give a list of (pressure_bar, speed_rpm) or 'domain'")
        (p0, p1), (w0, w1) = lpv.domain.pressure_bar, lpv.domain.speed_rpm
        return np.array([(p, w) for p in (p0, (p0 + p1) / 2, p1) for w in (w0, (w0 + w1) / 2, w1)])
    points = lpv.operating_points if given is None else given
    try:
        array = np.array([(float(P), float(Omega)) for P, Omega in points])
    except (TypeError, ValueError):
        raise UsageError("operating_points: give a list of (pressure_bar, speed_rpm)") from None
    if not len(array):
        raise UsageError(
            f"model {lpv.name!r} lists no operating points; give operating_points=[(pressure, speed), ...]"
        )
    lpv.domain.check(array[:, 0], array[:, 1], f"model {lpv.name!r}")
    return array


def _gain_bounds(
    structure: Structure | Scheduled, bounds: Mapping[str, tuple[float, float]] | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    names = tuple(parameter.name for parameter in structure.parameters)
    given = dict(bounds or {})
    unknown = [name for name in given if name not in names]
    if unknown:
        raise UsageError(f"bounds: no gain {', '.join(unknown)}; there are {', '.join(names)}")
    pairs = [given.get(p.name, (p.lower, p.upper)) for p in structure.parameters]
    low, high = as_bounds([pair[0] for pair in pairs], [pair[1] for pair in pairs], names)
    start = np.clip([p.start if p.start is not None else 0.0 for p in structure.parameters], low, high)
    return low, high, start


def _slowest_mode(poles: ComplexArray) -> float:
    """Return the slowest decay [1/s] of the oscillatory modes, negative when one is unstable."""
    pairs = poles[~is_real(poles)]
    return float(-pairs.real.max()) if len(pairs) else 0.0


def _constant_gains(
    lpv: LPVModel,
    structure: Scheduled,
    points: FloatArray,
    limits: Limits,
    actuator: Mapping[str, float] | None,
    uncertainty: Uncertainty | None,
    effort: Effort,
    delay_s: float,
) -> FloatArray:
    """Return the best constant gains as coefficients, a start value with which a schedule cannot become worse."""
    equations = loop_equations(lpv, structure.base, None if actuator is None else dict(actuator), delay_s=delay_s)
    low, high, start = _gain_bounds(structure.base, None)
    plants = LoopsAtPoints(structure.base, equations, points, uncertainty)
    family = plants.family(points)
    problem = GainProblem((family,), limits, low, high, typical_rate((family,), start))
    best, _ = solve_over_points(problem, plants, points, start, effort, [], None)
    values = dict(zip((p.name for p in structure.base.parameters), best.x, strict=True))
    return np.array(
        [values.get(p.name.removesuffix("_1"), 0.0) if p.name.endswith("_1") else 0.0 for p in structure.parameters]
    )


def _edge_notes(
    problem: GainProblem, found: LocalOptimum, names: tuple[str, ...], cap: float | None
) -> tuple[str, ...]:
    """Return a note on the distance to instability of a design without a limit on S_o."""
    if cap is not None or not problem.stable(found.x):
        return ()
    edge = distance_to_edge(problem, found.x, names)
    note = "damping alone was maximised: the peak of S_o is not limited"
    if np.isfinite(edge.change):
        note += f"; a change of {edge.gain} by {edge.change:+.2g} makes a loop unstable"
    return (note,)
