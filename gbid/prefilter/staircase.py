"""Staircase recordings: plateaus, steady means, hysteresis, and the static map (paper, Sec. 3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import h5py
import numpy as np
import scipy

from gbid.core import hdf5
from gbid.core.arrays import FloatArray, IntArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.figures import Pictured
from gbid.core.hdf5 import Stored
from gbid.core.notes import DataNote
from gbid.core.option_types import Share
from gbid.core.tables import Column, Entry, Row, Table, finite_or_none, shown_unit
from gbid.recording import Recording

MIN_SAMPLES = 40
"""Smallest number of samples in a steady part from which a standard error can be estimated."""
_BATCHES = 10
_HARMONICS = 6


@dataclass(frozen=True, eq=False)
class Plateaus:
    """Stretches of a recording in which all channels of a command are constant.

    Attributes
    ----------
    start, stop : (n_plateaus,) array of int
        First sample and the one after the last.
    level : (n_plateaus, n_channels) array
        Command on each plateau.
    """

    start: FloatArray
    stop: FloatArray
    level: FloatArray

    def __len__(self) -> int:
        return len(self.start)


def find_plateaus(rec: Recording, command: str) -> Plateaus:
    """Return the plateaus of a staircase, from the steps of its command.

    The command must be without noise. A step is a change by more than 0.1 % of the whole travel from one sample to the
    next. Stretches of less than 80 samples are transitions between plateaus.

    Parameters
    ----------
    rec : Recording
        The staircase.
    command : str
        Name of the commanded signal, e.g. r.

    Returns
    -------
    Plateaus
        At least three, in the order of time.

    Raises
    ------
    DataError
        When there is no such signal, when it does not move, or when it has fewer than three plateaus.
    """
    values = rec.signal(command)
    travel = float(np.ptp(values, axis=0).max())
    if travel == 0:
        raise DataError(f"recording {rec.name!r}: {command} is constant; a staircase needs steps up and down")
    changes = np.abs(np.diff(values, axis=0)).max(axis=1) > 1e-3 * travel
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(values)]])
    start, stop = edges[:-1], edges[1:]
    long = stop - start >= 2 * MIN_SAMPLES
    start, stop = start[long], stop[long]
    if len(start) < 3:
        raise DataError(
            f"recording {rec.name!r}: {command} has {len(start)} plateaus of at least {2 * MIN_SAMPLES} samples; "
            f"a staircase has three or more, and {command} must be the command itself, not a noisy measurement of it"
        )
    level = np.array([np.median(values[a:b], axis=0) for a, b in zip(start, stop, strict=True)])
    return Plateaus(start, stop, level)


@dataclass(frozen=True, eq=False)
class SteadyMeans:
    """Means of a signal over the steady parts of plateaus.

    Attributes
    ----------
    mean : (n_plateaus, n_channels) array
        Means, in the unit of the signal.
    std_error : (n_plateaus, n_channels) array
        Standard errors of the means; they include correlation between samples and drift.
    drift : (n_plateaus, n_channels) array
        Change over the steady part, from a straight line.
    """

    mean: FloatArray
    std_error: FloatArray
    drift: FloatArray


def steady_parts(rec: Recording, plateaus: Plateaus, keep: float) -> list[tuple[int, int]]:
    """Return the steady part of each plateau: first sample, and sample after the last.

    Parameters
    ----------
    rec : Recording
        The staircase.
    plateaus : Plateaus
        Its plateaus.
    keep : float
        Share of each plateau that is kept, from its end; above 0 and at most 1.

    Raises
    ------
    DataError
        When too few samples remain.
    """
    parts = []
    for a, b in zip(plateaus.start.astype(int), plateaus.stop.astype(int), strict=True):
        first = b - round(keep * (b - a))
        if b - first < MIN_SAMPLES:
            raise DataError(
                f"recording {rec.name!r}: {b - first} steady samples on the plateau from sample {a}, at least "
                f"{MIN_SAMPLES} are needed; hold each step longer or keep more of it"
            )
        parts.append((first, b))
    return parts


def steady_means(values: FloatArray, parts: list[tuple[int, int]], angle: FloatArray | None = None) -> SteadyMeans:
    r"""Return means over the steady parts, with standard errors for correlated noise and drift.

    Each part is cut into ten batches. The scatter s of the batch means contains noise of any colour on that time
    scale, and :math:`s / \sqrt{10}` is the standard error of the mean. When the slope of a straight line is more than
    four times its standard error, the signal is not yet at rest. Then half its rise over the part is added in square.

    Parameters
    ----------
    values : (n_samples, n_channels) array
        The signal.
    parts : list of (first, stop)
        Steady parts, as from `steady_parts`.
    angle : (n_samples,) array, optional
        Shaft angle [rad]. In a part with two turns or more, the first six harmonics are removed by least squares. So
        run-out and unbalance do not change the mean, even when the part is not a whole number of turns.

    Returns
    -------
    SteadyMeans
    """
    means, errors, drifts = [], [], []
    for first, stop in parts:
        part = values[first:stop]
        if angle is not None:
            part = _without_harmonics(part, angle[first:stop])
        size = len(part) // _BATCHES
        batch = part[len(part) - size * _BATCHES :].reshape(_BATCHES, size, -1).mean(axis=1)
        place = np.arange(_BATCHES) - (_BATCHES - 1) / 2
        slope = place @ batch / (place @ place)
        scatter = batch - batch.mean(axis=0) - np.outer(place, slope)
        slope_error = np.sqrt((scatter**2).sum(axis=0) / (_BATCHES - 2) / (place @ place))
        drift = slope * _BATCHES
        unsettled = np.where(np.abs(slope) > 4 * slope_error, drift / 2, 0.0)
        means.append(part.mean(axis=0))
        errors.append(np.sqrt(batch.var(axis=0, ddof=1) / _BATCHES + unsettled**2))
        drifts.append(drift)
    return SteadyMeans(np.array(means), np.array(errors), np.array(drifts))


def _without_harmonics(part: FloatArray, angle: FloatArray) -> FloatArray:
    """Remove the harmonics of the shaft angle, and keep the mean."""
    turns = abs(float(np.unwrap(angle)[-1] - angle[0])) / (2 * np.pi)
    if turns < 2:
        return part
    orders = np.arange(1.0, min(_HARMONICS, len(part) / turns / 3) + 1)
    phase = np.outer(angle, orders)
    basis = np.hstack([np.ones((len(part), 1)), np.cos(phase), np.sin(phase)])
    solution = np.linalg.lstsq(basis, part, rcond=None)[0]
    return np.asarray(part - basis[:, 1:] @ solution[1:])


_WIDEST = 2.5  # largest distance of neighbours, in median steps


def monotone_runs(level: FloatArray) -> list[tuple[int, list[int]]]:
    """Return the runs of rising or falling levels.

    Parameters
    ----------
    level : (n,) array
        Levels in the order of time.

    Returns
    -------
    list of (direction, indices)
        Direction is +1 or -1. A turning point belongs to the run before it and to the run after it.
    """
    runs: list[tuple[int, list[int]]] = []
    for i in range(1, len(level)):
        step = int(np.sign(level[i] - level[i - 1]))
        if step == 0:
            continue
        if runs and runs[-1][0] == step:
            runs[-1][1].append(i)
        else:
            runs.append((step, [i - 1, i]))
    return runs


def branch_difference(at: FloatArray, value: FloatArray, error: FloatArray) -> tuple[float, float, float]:
    """Return the largest difference between rising and falling branch at equal input (hysteresis).

    Each point of one branch is compared with the straight line between its neighbours on the other branch, where the
    branches overlap. The neighbours must not be farther apart than 2.5 median steps: across a wider gap, curvature
    would look like hysteresis.

    Parameters
    ----------
    at : (n,) array
        Input, in the order of time.
    value : (n,) array
        Output.
    error : (n,) array
        Standard error of the output.

    Returns
    -------
    difference : float
        Absolute difference; NaN when there is no pair of branches.
    std_error : float
        Its standard error.
    place : float
        Input at which it occurs.
    """
    runs = monotone_runs(at)
    steps = np.abs(np.diff(at))
    widest = _WIDEST * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    best = (float("nan"), float("nan"), float("nan"))
    for i, (one_way, branch) in enumerate(runs):
        for other_way, other in runs[:i]:
            if one_way == other_way:
                continue
            for points, levels in ((branch, other), (other, branch)):
                for candidate in _differences(points, levels, at, value, error, widest):
                    if not candidate[0] <= best[0]:
                        best = candidate
    return best


def _differences(
    points: list[int], levels: list[int], at: FloatArray, value: FloatArray, error: FloatArray, widest: float
) -> list[tuple[float, float, float]]:
    order = sorted(levels, key=lambda j: float(at[j]))
    nodes = at[order]
    differences = []
    for k in points:
        if k in levels or not nodes[0] <= at[k] <= nodes[-1]:
            continue
        right = min(max(int(np.searchsorted(nodes, at[k])), 1), len(nodes) - 1)
        a, b = order[right - 1], order[right]
        if at[b] - at[a] > widest:
            continue
        share = (at[k] - at[a]) / (at[b] - at[a])
        line = (1 - share) * value[a] + share * value[b]
        std = np.sqrt(error[k] ** 2 + ((1 - share) * error[a]) ** 2 + (share * error[b]) ** 2)
        differences.append((abs(float(value[k] - line)), float(std), float(at[k])))
    return differences


# ---- Static map of the rotor on its bearing (paper, Sec. 3.1 and Fig. 5).

REMEDY = "make it again with `gbid static`"
"""Advice for a file that cannot be read."""


def stored_units(units: tuple[str, str]) -> dict[str, str]:
    """Return the units of stored fields by keyword ("in", "out", "gain"), from the units of input and output."""
    source, output = units
    return {"in": source, "out": output, "gain": f"{output}/{source}", "gain^2": f"({output}/{source})^2"}


@dataclass(frozen=True, eq=False)
class StaticMap(Brief, Pictured, hdf5.InFile):
    r"""Static map: steady positions over steady inputs, with fitted straight lines.

    .. math:: \bar p_{i,k} = \sum_j g_{ij} \bar u_{j,k} + c_{i,m(k)} + e_{i,k}

    for plateau k of recording m. It is made by `characterise_staircase`. Inputs and outputs are in `units`.

    Attributes
    ----------
    gain : (n_outputs, n_inputs) array
        Static gain g; NaN for an input that no recording moves.
    covariance : (n_outputs * n_inputs, n_outputs * n_inputs) array
        Covariance of the gains, row by row (g_xx, g_xy, g_yx, g_yy); NaN where the gain is NaN.
    offset : (n_recordings, n_outputs) array
        c, the equilibrium without input, of each recording.
    dof : int
        Degrees of freedom: plateaus minus unknowns per output.
    rms, largest : (n_outputs, n_inputs) array
        Root mean square and largest deviation e of output i from a straight line on the staircase of input j (Sec.
        3.1).
    hysteresis, hysteresis_std : (n_outputs, n_inputs) array
        Largest difference of e between the up and the down branch at the same input, and its standard error. It is the
        largest of many values, so noise alone gives up to about three standard errors.
    recording : (n_plateaus,) array
        Number of the recording of each plateau.
    axis : (n_plateaus,) array
        Input whose staircase contains the plateau. -1 is rest, which counts for every input. -2 means that several
        inputs are away from rest; such a plateau counts for the gain, but not for the deviations.
    direction : (n_plateaus,) array
        1 when the last step was up, -1 when it was down, 0 before the first step.
    command : (n_plateaus, n_inputs) array
        Level of the reference.
    input_mean, input_std : (n_plateaus, n_inputs) array
        Steady mean of the input and its standard error.
    output_mean, output_std, residual : (n_plateaus, n_outputs) array
        Steady mean of the output, its standard error, and e.
    drift : (n_plateaus, n_outputs) array
        Change of the output over the steady part.
    time : (n_plateaus, 2) array
        Start and end of the steady part [s].
    input_names, output_names : tuple of str
        Names of the channels, ``"u_x"`` and so on.
    units : tuple of str
        Units of input and output.
    conditions : dict of str to float
        Operating point.
    sources : tuple of str
        Names of the recordings.
    notes : tuple of str
        Remarks for the reader of the result.
    """

    gain: Annotated[FloatArray, Stored("gain", "static gains", "outputs inputs")]
    covariance: Annotated[FloatArray, Stored("gain^2", "covariance of the gains, row by row", "gains gains")]
    offset: Annotated[FloatArray, Stored("out", "equilibrium without input, for each recording", "recordings outputs")]
    dof: int
    rms: Annotated[FloatArray, Stored("out", "rms deviation from linear", "outputs inputs")]
    largest: Annotated[FloatArray, Stored("out", "largest deviation from linear", "outputs inputs")]
    hysteresis: Annotated[FloatArray, Stored("out", "largest difference between up and down branch", "outputs inputs")]
    hysteresis_std: Annotated[FloatArray, Stored("out", "standard error of the hysteresis", "outputs inputs")]
    recording: Annotated[IntArray, Stored("1", "number of the recording", "plateaus")]
    axis: Annotated[IntArray, Stored("1", "input whose staircase it belongs to; -1 rest, -2 several", "plateaus")]
    direction: Annotated[IntArray, Stored("1", "way of the last step", "plateaus")]
    command: Annotated[FloatArray, Stored("in", "level of the command", "plateaus inputs")]
    input_mean: Annotated[FloatArray, Stored("in", "steady input", "plateaus inputs")]
    input_std: Annotated[FloatArray, Stored("in", "standard error of the steady input", "plateaus inputs")]
    output_mean: Annotated[FloatArray, Stored("out", "steady output", "plateaus outputs")]
    output_std: Annotated[FloatArray, Stored("out", "standard error of the steady output", "plateaus outputs")]
    residual: Annotated[FloatArray, Stored("out", "deviation from linear", "plateaus outputs")]
    drift: Annotated[FloatArray, Stored("out", "change over the steady part", "plateaus outputs")]
    time: Annotated[FloatArray, Stored("s", "begin and end of the steady part", "plateaus 2")]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    units: tuple[str, str]
    conditions: Mapping[str, float] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("static_map", REMEDY)

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write this map to a `group`, in the units of its signals."""
        hdf5.write_fields(group, self, stored_units(self.units))

    def _brief(self) -> Description:
        return brief(
            self,
            f"{len(self.sources)} recordings, {len(self.axis)} plateaus",
            input_names=self.input_names,
            output_names=self.output_names,
            gain=self.gain,
            rms=self.rms,
            largest=self.largest,
            hysteresis=self.hysteresis,
            notes=self.notes,
        )

    drawn_by = "plot_static_map"

    def document(self) -> Row:
        """Return gains with confidence intervals, and deviations from straight lines, as plain values for JSON."""
        interval = self.interval()
        figures = {
            **{"gain": self.gain, "std": self.gain_std, "lower_95": interval[..., 0], "upper_95": interval[..., 1]},
            **{key: getattr(self, key) for key in ("rms", "largest", "hysteresis", "hysteresis_std")},
        }
        return {
            "kind": "bearing",
            "recordings": list(self.sources),
            "conditions": dict(self.conditions),
            "units": list(self.units),
            "plateaus": len(self.command),
            "dof": self.dof,
            "gains": [
                {"output": output, "input": source, **{key: finite_or_none(q[i, j]) for key, q in figures.items()}}
                for i, output in enumerate(self.output_names)
                for j, source in enumerate(self.input_names)
            ],
            "offset": self.offset.tolist(),
            "notes": list(self.notes),
        }

    def tables(self) -> list[Table]:
        """Return the table of gains and of deviations from straight lines."""
        factor, unit = shown_unit(self.units[1])
        names = {"rms": "rms off\nlinear\n", "largest": "largest\n", "hysteresis": "hysteresis\n"}
        names["hysteresis_std"] = "its std\n"
        rows: list[list[Entry]] = [
            [f"{source} to {output}", self.gain[i, j], self.gain_std[i, j]]
            + [factor * getattr(self, name)[i, j] for name in names]
            for i, output in enumerate(self.output_names)
            for j, source in enumerate(self.input_names)
        ]
        columns = [Column("static gain"), Column("value", format=5), Column("std", format=2)]
        columns += [Column(name, unit, 3) for name in names.values()]
        return [Table(", ".join(self.sources), columns, rows, self.notes)]

    @property
    def gain_std(self) -> FloatArray:
        """Standard deviations of the gains, (n_outputs, n_inputs)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)).reshape(self.gain.shape))

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return confidence intervals of the gains, from Student's t distribution.

        Parameters
        ----------
        level : float
            Confidence level between 0 and 1.

        Returns
        -------
        (n_outputs, n_inputs, 2) array
            Lower and upper ends.

        Raises
        ------
        UsageError
            When `level` is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise UsageError(f"level = {level}; give a share between 0 and 1")
        half = scipy.special.stdtrit(self.dof, 0.5 + level / 2) * self.gain_std
        return np.stack([self.gain - half, self.gain + half], axis=-1)

    def panel(self, output: int, source: int) -> dict[str, FloatArray]:
        """Return the arrays for one panel of Fig. 5: output i over input j.

        Parameters
        ----------
        output, source : int
            i and j.

        Returns
        -------
        dict of str to array
            ``input``, ``output`` (without the offset and without the effect of the other inputs), ``std`` and
            ``direction`` of the plateaus of that staircase in the order of time, and ``line_input`` and
            ``line_output`` (two points).
        """
        with_stairs = np.isin(self.recording, self.recording[self.axis == source])
        chosen = with_stairs & ((self.axis == source) | (self.axis == -1))
        u = self.input_mean[chosen, source]
        ends = np.array([u.min(), u.max()]) if u.size else np.zeros(2)
        return {
            "input": u,
            "output": self.gain[output, source] * u + self.residual[chosen, output],
            "std": self.output_std[chosen, output],
            "direction": self.direction[chosen],
            "line_input": ends,
            "line_output": self.gain[output, source] * ends,
        }

    def rows(self) -> list[dict[str, Any]]:
        """Return rows for CSV, one for each plateau; units are in brackets behind the names."""
        source, output = self.units
        return [
            {
                "recording": self.sources[int(self.recording[k])],
                "begin [s]": float(self.time[k, 0]),
                "direction": int(self.direction[k]),
                **_columns(self.input_names, source, self.input_mean[k], self.input_std[k]),
                **_columns(self.output_names, output, self.output_mean[k], self.output_std[k]),
                **{
                    f"{name}_residual [{output}]": float(value)
                    for name, value in zip(self.output_names, self.residual[k], strict=True)
                },
            }
            for k in range(len(self.command))
        ]


def _columns(names: Sequence[str], unit: str, values: Sequence[float], errors: Sequence[float]) -> dict[str, float]:
    columns = {}
    for name, value, error in zip(names, values, errors, strict=True):
        columns[f"{name} [{unit}]"], columns[f"{name}_std [{unit}]"] = float(value), float(error)
    return columns


_AT_REST = 0.01  # of the whole travel of the command


def characterise_staircase(
    recordings: Recording | Sequence[Recording],
    *,
    command: str = "r",
    source: str = "u",
    position: str = "p",
    keep: Share = 0.5,
) -> StaticMap:
    """Return the static map from inputs to positions, by least squares on rising and falling staircases.

    The plateaus are found from the command. The last part of each plateau counts as steady. Least squares on the
    steady means give the gains, and one offset for each recording, so that a staircase in x and one in y can be
    fitted together. The covariance of the gains is scaled by the covariance of the residuals. When the standard
    errors of the means are larger than the residuals (for example with a common drift), the standard errors are used
    in their place.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Raw recordings with command, input and position, all at one operating point. Run-out is removed here with the
        angle (phi). Do not prefilter them: no means may be removed, and no median is needed.
    command : str
        Signal that shows where the plateaus are.
    source : str
        Input of the map: the measured piezo position difference u, or the command when u was not recorded.
    position : str
        Output of the map.
    keep : float
        Share of each plateau, from its end, that counts as steady.

    Returns
    -------
    StaticMap

    Raises
    ------
    UsageError
        When `keep` is not above 0 and at most 1, or when no recording is given.
    DataError
        When signals are missing, when the recordings differ in channels or conditions, when plateaus are missing or too
        short, or when there are fewer plateaus than unknowns.
    """
    group = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not group:
        raise UsageError("no staircase recording given; the static map needs at least one")
    _check_alike(group, (command, source, position))
    notes: list[str] = []
    rows = [_of_one(rec, number, command, source, position, keep) for number, rec in enumerate(group)]
    table: dict[str, Any] = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    u, p, number = table["input_mean"], table["output_mean"], table["recording"].astype(int)
    commanded = np.ptp(table["command"], axis=0) > _AT_REST * np.ptp(table["command"], axis=0).max()
    if command != source and commanded.size != u.shape[1]:
        raise DataError(
            f"recording {group[0].name!r}: {command} has {commanded.size} channels, {source} has {u.shape[1]}; "
            "they must match"
        )
    for name in (f"{source}_{c}" for c, m in zip(group[0].channels[source], commanded, strict=True) if not m):
        notes.append(DataNote.NOT_MOVED(f"no recording moves {name}, so its gains are not known"))
    basis = np.hstack([u[:, commanded], np.eye(len(group))[number]])
    dof = len(basis) - basis.shape[1]
    if dof < 1 or np.linalg.matrix_rank(basis / np.abs(basis).max(axis=0)) < basis.shape[1]:
        raise DataError(
            f"{len(basis)} plateaus of {', '.join(rec.name for rec in group)} do not determine the gains of "
            f"{commanded.sum()} inputs and the offsets; record more steps, and inputs that do not move together"
        )
    solution = np.linalg.lstsq(basis, p, rcond=None)[0]
    residual = p - basis @ solution
    gain = np.full((p.shape[1], u.shape[1]), np.nan)
    gain[:, commanded] = solution[: commanded.sum()].T
    per_panel: dict[str, Any] = _deviations(table, residual, u.shape[1], p.shape[1])
    return StaticMap(
        gain=gain,
        covariance=_covariance(basis, residual, table["output_std"], commanded, dof),
        offset=solution[commanded.sum() :],
        dof=dof,
        **per_panel,
        residual=residual,
        **table,
        input_names=tuple(f"{source}_{c}" for c in group[0].channels[source]),
        output_names=tuple(f"{position}_{c}" for c in group[0].channels[position]),
        units=(group[0].units[source], group[0].units[position]),
        conditions=dict(group[0].conditions),
        sources=tuple(rec.name for rec in group),
        notes=tuple(notes),
    )


def _check_alike(group: list[Recording], signals: tuple[str, ...]) -> None:
    first = group[0]
    for rec in group:
        for name in signals:
            if name not in rec.signals:
                raise DataError(
                    f"recording {rec.name!r} has no signal {name!r}, only {', '.join(rec.signals)}; name the signals "
                    "of the staircase (command, source, position)"
                )
            if rec.channels[name] != first.channels[name] or rec.units[name] != first.units[name]:
                raise DataError(f"recordings {first.name!r} and {rec.name!r} differ in channels or unit of {name}")
        if dict(rec.conditions) != dict(first.conditions):
            raise DataError(
                f"recordings {first.name!r} and {rec.name!r} are of different conditions; make one map for each point"
            )


def _of_one(
    rec: Recording, number: int, command: str, source: str, position: str, keep: float
) -> dict[str, FloatArray]:
    """Return the plateaus of one recording as table columns."""
    plateaus = find_plateaus(rec, command)
    parts = steady_parts(rec, plateaus, keep)
    angle = rec.signal("phi")[:, 0] if "phi" in rec.signals else None
    u, p = steady_means(rec.signal(source), parts), steady_means(rec.signal(position), parts, angle)
    level = plateaus.level
    away = np.abs(level - level[0]) > _AT_REST * np.ptp(level, axis=0).max()
    axis = np.where(away.sum(axis=1) == 1, away.argmax(axis=1), np.where(away.any(axis=1), -2, -1))
    change = np.diff(level, axis=0, prepend=level[:1])
    largest = np.abs(change).argmax(axis=1)
    direction = np.sign(change[np.arange(len(level)), largest])
    return {
        "recording": np.full(len(level), number),
        "axis": axis,
        "direction": direction.astype(int),
        "command": level,
        "input_mean": u.mean,
        "input_std": u.std_error,
        "output_mean": p.mean,
        "output_std": p.std_error,
        "drift": p.drift,
        "time": np.array(parts) * rec.sample_time,
    }


def _covariance(
    basis: FloatArray, residual: FloatArray, std_error: FloatArray, shifted: FloatArray, dof: int
) -> FloatArray:
    """Return the covariance of the gains, taken row by row."""
    n_inputs, n_outputs = len(shifted), residual.shape[1]
    inverse = np.linalg.inv(basis.T @ basis)[: shifted.sum(), : shifted.sum()]
    noise = residual.T @ residual / dof
    least = np.mean(std_error**2, axis=0)
    raise_by = np.sqrt(np.maximum(least / np.maximum(np.diag(noise), 1e-300), 1.0))
    noise = noise * np.outer(raise_by, raise_by) + np.diag(np.where(np.diag(noise) == 0, least, 0.0))
    full = np.full((n_outputs, n_inputs, n_outputs, n_inputs), np.nan)
    block = np.einsum("ik,jl->ijkl", noise, inverse)
    index = np.flatnonzero(shifted)
    every = np.arange(n_outputs)
    full[np.ix_(every, index, every, index)] = block
    return full.reshape(n_outputs * n_inputs, -1)


def _deviations(
    table: dict[str, FloatArray], residual: FloatArray, n_inputs: int, n_outputs: int
) -> dict[str, FloatArray]:
    """Return rms, maximum and branch difference of the deviations, on the staircase of each input."""
    deviations = {
        name: np.full((n_outputs, n_inputs), np.nan) for name in ("rms", "largest", "hysteresis", "hysteresis_std")
    }
    for j in range(n_inputs):
        if not (table["axis"] == j).any():
            continue
        with_stairs = np.unique(table["recording"][table["axis"] == j])
        chosen = np.isin(table["axis"], (j, -1)) & np.isin(table["recording"], with_stairs)
        for i in range(n_outputs):
            e = residual[chosen, i]
            deviations["rms"][i, j], deviations["largest"][i, j] = np.sqrt(np.mean(e**2)), np.abs(e).max()
            widest = (np.nan, np.nan, np.nan)
            for number in with_stairs:
                local = chosen & (table["recording"] == number)
                difference = branch_difference(
                    table["input_mean"][local, j], residual[local, i], table["output_std"][local, i]
                )
                widest = widest if difference[0] <= widest[0] else difference
            deviations["hysteresis"][i, j], deviations["hysteresis_std"][i, j] = widest[:2]
    return deviations
