"""Control chain from a controller design and run-out maps, with checks that it can run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbid.arrays import FloatArray
from gbid.control import ControllerDesign, Scheduled
from gbid.control.controllers.design import Point
from gbid.errors import UsageError
from gbid.notes.control_notes import ControlNote
from gbid.operating_point import point_label
from gbid.prefilter import RunoutMap
from gbid.prefilter.align import refuse_lost_index
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.target.anti_windup import anti_windup_gain
from gbid.target.chain import Chain, Kind, SumTerm
from gbid.target.chain_options import ChainOptions
from gbid.target.grid_table import TOLERANCE, GridTable, table_of_points, table_over_domain
from gbid.target.identifiers import c_name

_CHANNELS = 2
_ON_THE_CIRCLE = 1.0 + 1e-9
"""Largest magnitude of a pole of a controller that does not run away; an integrator has one of 1."""


def chain_of(
    design: ControllerDesign,
    *,
    name: str | None = None,
    runout_maps: Sequence[RunoutMap] = (),
    still: Sequence[Recording] = (),
    options: ChainOptions | None = None,
) -> Chain:
    """Return the control chain of a design.

    Parameters
    ----------
    design : ControllerDesign
        The controller; any fixed structure with two inputs and two outputs, scheduled or not.
    name : str, optional
        Prefix of all names in C; by default that of the design.
    runout_maps : sequence of RunoutMap
        Maps of run-out and unbalance: none, one, or maps of harmonics at the points of a full grid of pressure and
        speed, between which they are interpolated. Maps of a shaft at rest count only when there is no other.
    still : sequence of Recording
        Recordings with the encoder of the target. A map whose zero of the angle is another one is refused.
    options : ChainOptions, optional
        Limits, ramps, guards and watchdog.

    Returns
    -------
    Chain

    Raises
    ------
    UsageError
        When the controller is unstable by itself or faster than its sample rate, when the name is no C identifier, or
        when maps do not fit.
    DataError
        When the zero of the angle of a recording is not that of the map.
    """
    name = c_name(name or design.name)
    options = options or ChainOptions()
    models, table = _controller_table(design)
    for point, model in models:
        _check(design, model, point)
    pattern = np.any(table.rows != 0, axis=0)
    n = models[0][1].n_states
    outputs, states = _sums(pattern, n)
    entries = GridTable(table.pressure_bar, table.speed_rpm, table.rows[:, pattern], table.error)
    maps = _used_maps(runout_maps)
    for recording in still:
        for each in maps:
            if each.needs_angle:
                refuse_lost_index(each, recording)
    notes: tuple[str, ...] = ()
    if table.error > TOLERANCE:
        text = f"schedule: interpolation is off by up to {100 * table.error:.2g} % of an entry between nodes"
        notes = (ControlNote.INTERPOLATED(text),)
    plant = f", designed for {design.plant}" if design.plant else ""
    return Chain(
        name,
        f"{design.name}: {models[0][1].name or 'controller'}{plant}",
        design.sample_time,
        entries,
        outputs,
        states,
        maps,
        _harmonics_table(maps),
        options,
        notes,
    )


def _controller_table(design: ControllerDesign) -> tuple[list[tuple[Point | None, LinearModel]], GridTable]:
    """Return the sampled controllers at the nodes with their operating points, and the table of all their entries."""
    found: dict[Point | None, LinearModel] = {}

    def row_at(pressure_bar: float, speed_rpm: float) -> FloatArray:
        model = design.sampled_at(pressure_bar, speed_rpm)
        found[pressure_bar, speed_rpm] = model
        return _row(design, model)

    if isinstance(design.structure, Scheduled):
        table = table_over_domain(row_at, design.structure.domain)
    elif design.structure is None and None not in design.models:
        points = [point for point in design.models if point is not None]
        table = table_of_points({point: row_at(*point) for point in points}, f"controller {design.name!r}")
    else:
        model = design.sampled_at()
        return [(None, model)], GridTable((), (), _row(design, model)[None])
    return list(found.items()), table


def _row(design: ControllerDesign, model: LinearModel) -> FloatArray:
    if model.D.shape != (_CHANNELS, _CHANNELS):
        raise UsageError(
            f"controller {design.name!r} has {model.D.shape[1]} inputs and {model.D.shape[0]} outputs; the chain needs "
            "p_x, p_y and r_x, r_y"
        )
    runs_away = _largest_pole(model) > _ON_THE_CIRCLE  # refused by _check
    L = np.zeros((model.n_states, _CHANNELS)) if runs_away else anti_windup_gain(model)
    return np.concatenate([np.hstack([model.C, model.D]).ravel(), np.hstack([model.A, model.B, L]).ravel()])


def _largest_pole(sampled: LinearModel) -> float:
    return float(np.abs(np.linalg.eigvals(sampled.A)).max(initial=0.0)) if sampled.n_states else 0.0


def _check(design: ControllerDesign, sampled: LinearModel, point: Point | None) -> None:
    """Refuse a controller that is unstable by itself, or that moves between its samples."""
    where = "" if point is None else f" at {point_label(*point)}"
    worst = _largest_pole(sampled)
    if worst > _ON_THE_CIRCLE:
        raise UsageError(
            f"controller {design.name!r}{where} is unstable by itself (a pole of magnitude {worst:.6g} in the z "
            "plane); a chain that fades in would run away: tune it with bounds that keep the controller stable"
        )
    continuous = design.at() if point is None else design.at(*point)
    fastest = float(np.abs(np.linalg.eigvals(continuous.A)).max(initial=0.0)) / (2 * np.pi)
    if fastest >= 0.5 / design.sample_time:
        raise UsageError(
            f"controller {design.name!r}{where}: sample_time = {design.sample_time:g} s is too slow for its pole at "
            f"{fastest:.4g} Hz; at most {0.5 / fastest:.3g} s, better a tenth of that"
        )


def _sums(pattern: FloatArray, n: int) -> tuple[tuple[tuple[SumTerm, ...], ...], tuple[tuple[SumTerm, ...], ...]]:
    """Return the sums of outputs and next states over the entries that are not zero, states first."""
    place = np.cumsum(pattern) - 1
    at = 0
    sums: list[tuple[SumTerm, ...]] = []
    outputs: list[tuple[Kind, int]] = [("x", n), ("e", _CHANNELS)]
    states: list[tuple[Kind, int]] = [*outputs, ("d", _CHANNELS)]
    for kinds in [outputs] * _CHANNELS + [states] * n:
        terms = []
        for kind, size in kinds:
            for index in range(size):
                if pattern[at]:
                    terms.append(SumTerm(int(place[at]), kind, index))
                at += 1
        sums.append(tuple(terms))
    return tuple(sums[:_CHANNELS]), tuple(sums[_CHANNELS:])


def _used_maps(maps: Sequence[RunoutMap]) -> tuple[RunoutMap, ...]:
    """Return the maps that the chain uses, after checks."""
    for each in maps:
        if len(each.channels) != _CHANNELS:
            raise UsageError(
                f"run-out map of {', '.join(each.sources)} has {len(each.channels)} channels, the controller p_x "
                "and p_y; it is of other sensors"
            )
        numbers = (each.mean, each.cosine, each.sine, each.table)
        if not all(np.isfinite(part).all() for part in numbers):
            raise UsageError(
                f"run-out map of {', '.join(each.sources)} holds values that are not finite; make it again"
            )
    turning = tuple(each for each in maps if each.needs_angle)
    used = turning or tuple(maps)
    if len(used) > 1 and any(each.method == "bins" for each in used):
        raise UsageError(
            "several run-out maps are tables over the angle, which are not interpolated over pressure and speed; "
            "choose one operating point (--at BAR RPM), or prefilter: method: harmonics"
        )
    return used


def _harmonics_table(maps: tuple[RunoutMap, ...]) -> GridTable | None:
    """Return mean and harmonics of the maps as rows; None without maps or for a table over the angle."""
    if not maps or maps[0].method == "bins":
        return None
    n_orders = max((int(each.orders.max(initial=0)) for each in maps), default=0)
    rows = {}
    for each in maps:
        waves = np.zeros((n_orders, 2, _CHANNELS))
        for order, a, b in zip(each.orders, each.cosine, each.sine, strict=True):
            waves[int(order) - 1] = a, b
        point = (each.conditions.get("pressure_bar", 0.0), each.conditions.get("speed_rpm", 0.0))
        if point in rows:
            raise UsageError(
                f"there are two run-out maps at {point[0]:g} bar, {point[1]:g} rpm; give the maps of one encoder only"
            )
        rows[point] = np.concatenate([each.mean, waves.ravel()])
    return table_of_points(rows, "run-out maps")
