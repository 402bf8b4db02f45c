"""Ties: parameters of a structure that are linear in unknowns shared by all recordings, as those of surfaces."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import inf
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, IntArray, point_label
from gbid.core.errors import DataError, UsageError
from gbid.discretise import Hold
from gbid.identify.data import FitData, Record
from gbid.identify.disturbances import UNDISTURBED, Disturbances
from gbid.identify.kernel.blocks import LANES, LONGEST_BLOCK, Segment, cut
from gbid.identify.kernel.choice import RunEngine, choose_kernel
from gbid.identify.kernel.nonlinear import NonlinearKernel
from gbid.identify.kernel.sample import NonlinearPredictor
from gbid.identify.kernel.sums import Kernel, Sweep, tied
from gbid.identify.kernel.window_starts import window_starts
from gbid.identify.options import Criterion, Focus, Scope
from gbid.identify.predictor import GeneralPredictor, Predictor, predictor_of, with_spare_states
from gbid.identify.problem.nlp import Prior, RecordGroup, Shooting
from gbid.identify.problem.states import InitialStates
from gbid.structure import AnyStructure, Parameter


@dataclass(frozen=True, eq=False)
class Ties:
    """In piece i the parameters `names` have the values ``maps[i] @ shared + lift @ own``; a record has some pieces.

    Attributes
    ----------
    names : tuple of str
        Parameters of the structure.
    shared : tuple of Parameter
        The unknowns in their place.
    maps : (n_pieces, n_names, n_shared) array
    own : tuple of Parameter
        Further unknowns, which each record has for itself; there may be none.
    lift : (n_names, n_own) array
    edges : tuple of tuple of int
        For each record the first samples of its pieces after the first one; empty when every record is one piece.
    """

    names: tuple[str, ...]
    shared: tuple[Parameter, ...]
    maps: FloatArray
    own: tuple[Parameter, ...]
    lift: FloatArray
    edges: tuple[tuple[int, ...], ...] = ()

    def pieces(self, record: int) -> tuple[int, tuple[int, ...]]:
        """Return the number of the first piece of a record, and the first samples of its other pieces."""
        if not self.edges:
            return record, ()
        return sum(len(own) + 1 for own in self.edges[:record]), self.edges[record]

    def own_names(self, record: str) -> dict[str, str]:
        """Return the full names of the own unknowns of a record."""
        return {q.name: f"{q.name}[{record}]" for q in self.own}


def tie_of(
    predictor: GeneralPredictor, names: Mapping[str, str], position: Mapping[str, int], ties: Ties, piece: int
) -> tuple[tuple[int, ...], FloatArray]:
    """Unknowns that one piece of a record sees, and the matrix from them to its predictor's parameters.

    Parameters
    ----------
    predictor : GeneralPredictor
    names : dict of str to str
        Full names of its parameters that are not tied, and of what it has for itself.
    position : dict of str to int
        Place of each unknown by full name.
    ties : Ties
    piece : int
        Its number, over all records.

    Returns
    -------
    tuple of int
    (n_own, n_unknowns) array
    """
    own = [q.name for q in predictor.free if q.name in names]
    index = [position[q.name] for q in ties.shared] + [position[names[name]] for name in own]
    index += [position[names[q.name]] for q in ties.own]
    tie = np.zeros((len(predictor.free), len(index)))
    n_shared, n_lift = len(ties.shared), len(ties.own)
    for row, q in enumerate(predictor.free):
        if q.name in names:
            tie[row, n_shared + own.index(q.name)] = 1.0
        else:
            at = ties.names.index(q.name)
            tie[row, :n_shared] = ties.maps[piece][at]
            tie[row, len(index) - n_lift :] = ties.lift[at]
    return tuple(index), tie


# ---- Segments of records: cut at left-out samples, grouped by predictor, and the links between windows.


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive samples of a record that all count, or a gap between such."""

    segment: Segment
    is_gap: bool


def stretches(record: Record, ranges: Sequence[tuple[int, int]], predictor: GeneralPredictor) -> list[Stretch]:
    """Cut a record at what is left out.

    Without feedback of the outputs the model runs through and those samples just do not count. With feedback
    the model runs through them on its own: a stretch of simulation between two of prediction.
    """
    n = record.n_samples
    counts = np.ones(n)
    for start, stop in ranges:
        if not 0 <= start < stop <= n:
            raise DataError(f"recording {record.name!r}: left out samples {start} to {stop} are not within its {n}")
        counts[start:stop] = 0.0
    if counts.all():
        return [Stretch(Segment(record.inputs, record.outputs), False)]
    if not counts.any():
        raise DataError(f"recording {record.name!r}: all samples are left out")
    if not predictor.feeds_back:
        return [Stretch(Segment(record.inputs, record.outputs, counts), False)]
    edges = [0, *(np.flatnonzero(np.diff(counts)) + 1).tolist(), n]
    return [
        Stretch(Segment(record.inputs, record.outputs, counts, start=a, stop=b), counts[a] == 0)
        for a, b in itertools.pairwise(edges)
    ]


_Key = tuple[int, tuple[int, ...], bytes]  # of a predictor, its parameters, and how they are tied


def in_pieces(stretches: Sequence[Stretch], edges: Sequence[int]) -> list[tuple[Stretch, int]]:
    """Cut stretches of a record at further samples; return each with the number of its piece, from 0."""
    found = []
    for stretch in stretches:
        own = stretch.segment
        stop = len(own.outputs) if own.stop is None else own.stop
        inside = [own.start, *(e for e in edges if own.start < e < stop), stop]
        for a, b in itertools.pairwise(inside):
            piece = sum(e <= a for e in edges)
            found.append((Stretch(replace(own, start=a, stop=b), stretch.is_gap), piece))
    return found


class GroupBuilder:
    """Collects segments of the same predictor and parameters, and cuts them together.

    Parameters
    ----------
    window : int or None
        Samples in a shooting window; None for one window for each segment.
    begin : dict of str to float
        Start values, at which the engine looks which entries of the predictor are zero for good.
    """

    def __init__(self, window: int | None, begin: Mapping[str, float]) -> None:
        self._window, self._begin = window, begin
        self._groups: dict[_Key, tuple[GeneralPredictor, FloatArray | None, list[Segment]]] = {}
        self._order: list[tuple[_Key, int]] = []
        self.engine_name: RunEngine = "numpy"
        self.notes: list[str] = []

    def add(
        self, predictor: GeneralPredictor, index: tuple[int, ...], segment: Segment, tie: FloatArray | None = None
    ) -> None:
        """Add a segment; `index` and `tie` as in `RecordGroup`."""
        key = (id(predictor), index, b"" if tie is None else tie.tobytes())
        _, _, segments = self._groups.setdefault(key, (predictor, tie, []))
        self._order.append((key, len(segments)))
        segments.append(segment)

    def build(self) -> tuple[tuple[RecordGroup, ...], list[tuple[int, int]]]:
        """Return the parts, and first and last window (over all parts) of each segment in the order of adding."""
        parts, windows_of = [], {}
        kernels: dict[int, Kernel] = {}
        base = 0
        for key, (predictor, tie, segments) in self._groups.items():
            predictor_id, index, _ = key
            if predictor_id not in kernels:
                chosen = choose_kernel(predictor, self._begin)
                kernels[predictor_id] = chosen.kernel
                self.engine_name = chosen.name
                self.notes += chosen.notes
            # A lone short segment fills all lanes with blocks of itself.
            longest = max(len(s.part(s.outputs)) for s in segments)
            size = -(-longest // LANES) if len(segments) == 1 and tie is not None else LONGEST_BLOCK
            blocks = cut(segments, predictor, self._window, longest_block=min(size, LONGEST_BLOCK))
            part = RecordGroup(predictor, blocks, np.array(index), kernels[predictor_id], tie)
            parts.append(part)
            ends = np.append(blocks.segment_first[1:], blocks.n_windows) - 1
            for i, (a, b) in enumerate(zip(blocks.segment_first, ends, strict=True)):
                windows_of[key, i] = (base + int(a), base + int(b))
            base += blocks.n_windows
        return tuple(parts), [windows_of[item] for item in self._order]


def links_of(windows: list[tuple[int, int]], counts: list[int]) -> IntArray:
    """Return the links: neighbouring windows within each segment, and across the segments of one record."""
    links, i = [], 0
    for count in counts:
        for j in range(count):
            first, last = windows[i + j]
            links += [(w, w + 1) for w in range(first, last)]
            if j + 1 < count:
                links.append((last, windows[i + j + 1][0]))
        i += count
    return np.array(links, dtype=np.int64).reshape(-1, 2)


def record_windows(windows: list[tuple[int, int]], counts: list[int]) -> IntArray:
    """Return the first window of each record, from the windows and numbers of segments."""
    firsts = np.cumsum([0, *counts[:-1]])
    return np.array([windows[i][0] for i in firsts])


# ---- Assembly of a fit from recordings and options: parts, links, and shared parameters.

_WINDOW = {"prediction": 256, "simulation": 128}  # samples; measured outputs stabilise a prediction, so it is longer
_MOST_WINDOWS = {
    "prediction": 64,
    "simulation": 192,
}  # more samples make longer windows, because the solver's own work grows with the number of windows


class OwnStructure(NamedTuple):
    """Structure of one record, with the behaviour of its inputs between samples."""

    structure: AnyStructure
    intersample: Hold | Sequence[Hold]


@dataclass(frozen=True, eq=False)
class Assembly:
    """Data of a fit for the shooting problem.

    Attributes
    ----------
    parts : tuple of RecordGroup
        Groups of records.
    links : (n_links, 2) integer array
        Pairs of windows, counted over all parts. The first must end at the start state of the second.
    free : tuple of Parameter
        Estimated parameters; names of local ones end with the name of their group in brackets.
    unused : tuple of str
        Parameters of the structure without influence in this focus.
    record_window : (n_records,) integer array
        First window of each record.
    record_names : tuple of dict
        For each record, the full names of its free parameters, by the structure's names.
    engine : {"compiled", "numpy"}
        Engine of the passes over the samples.
    notes : tuple of str
        Notes for the user.
    """

    parts: tuple[RecordGroup, ...]
    links: IntArray
    free: tuple[Parameter, ...]
    unused: tuple[str, ...]
    record_window: IntArray
    record_names: tuple[Mapping[str, str], ...]
    engine: RunEngine
    notes: tuple[str, ...]

    @property
    def n_states(self) -> int:
        """Number of states of the structure, without the offsets of random walks."""
        predictor = self.parts[0].predictor
        return predictor.n_states - len(predictor.disturbances.walking)

    @property
    def own_names(self) -> dict[str, str]:
        """Names in the structure, by the full names of the free parameters."""
        return {full: own for names in self.record_names for own, full in names.items()}


def assemble(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    begin: Mapping[str, float],
    data: FitData,
    *,
    intersample: Hold | Sequence[Hold],
    focus: Focus,
    local: Mapping[str, Scope],
    left_out: Mapping[str, Sequence[tuple[int, int]]],
    window: int | None,
    disturbances: Disturbances = UNDISTURBED,
    released: BoolArray | None = None,
    ties: Ties | None = None,
    own: Sequence[OwnStructure] = (),
) -> Assembly:
    """Return the assembly of a fit from recordings and options.

    The parameters are those of `gbid.fit`. Its starts, bounds and fixed values are in `parameters` and `begin`. With
    `ties`, parameters of the structure are linear in further, shared unknowns. These are then the first of `free`.
    `released` (n_records, n) marks the initial states that are functions of the parameters. With `own`, each record has
    a linear structure of its own; `parameters` are then those of all of them, and names that they share are shared.

    Raises
    ------
    UsageError, DataError
        For options that do not fit the structure or the recordings.
    """
    held = {q.name: begin[q.name] for q in parameters if q.fixed}

    each = list(own) or [OwnStructure(structure, intersample)] * len(data.records)
    models = [chosen for i, chosen in enumerate(each) if chosen not in each[:i]]
    model_of = [models.index(chosen) for chosen in each]

    @cache
    def predictor_for(kind: Focus, released: tuple[bool, ...], model: int) -> GeneralPredictor:
        built = predictor_of(
            models[model].structure,
            held,
            begin,
            data.sample_time,
            models[model].intersample,
            kind,
            disturbances=disturbances,
            released=released,
        )
        known = {q.name: q for q in parameters}
        return replace(built, free=tuple(known.get(q.name, q) for q in built.free))

    @cache
    def filled(chosen: GeneralPredictor) -> GeneralPredictor:
        """Return the predictor with as many states as the largest."""
        if chosen.n_states == n_states:
            return chosen
        assert isinstance(chosen, Predictor)
        return with_spare_states(chosen, n_states)

    own_released = [()] * len(data.records) if released is None or not released.any() else [*map(tuple, released)]
    first = {model: predictor_for(focus, own_released[model_of.index(model)], model) for model in range(len(models))}
    for one, model in zip(data.records, model_of, strict=True):
        _check_channels(models[model].structure, first[model], one, data)
    predictor, n_states = first[0], max(built.n_states for built in first.values())
    all_free = list({q.name: q for built in first.values() for q in built.free}.values())
    always: Scope = "recording"
    scopes = {**local, **dict.fromkeys((term.name for term in disturbances.terms), always)}
    unknown = [name for name in scopes if name not in [q.name for q in all_free]]
    if unknown:
        raise UsageError(f"local names parameters that are not estimated: {', '.join(unknown)}")
    if scopes or left_out:
        _check_names(data)
    tied = frozenset(ties.names) if ties else frozenset()
    record_names = tuple(
        _full_names(first[model], record, scopes, len(data.records), tied)
        for record, model in zip(data.records, model_of, strict=True)
    )
    free = _all_free(all_free, record_names)
    if ties is not None:
        _check_names(data)
        record_names = tuple(
            {**names, **ties.own_names(record.name)} for names, record in zip(record_names, data.records, strict=True)
        )
        free = (*ties.shared, *free, *_all_free(ties.own, record_names))
    position = {q.name: i for i, q in enumerate(free)}

    segments: list[list[tuple[Stretch, int]]] = []
    for i, (record, model) in enumerate(zip(data.records, model_of, strict=True)):
        begin_piece, edges = (i, ()) if ties is None else ties.pieces(i)
        cut = stretches(record, left_out.get(record.name, ()), first[model])
        segments.append([(stretch, begin_piece + piece) for stretch, piece in in_pieces(cut, edges)])
    strangers = [name for name in left_out if name not in [record.name for record in data.records]]
    if strangers:
        raise UsageError(f"left_out names recordings that are not fitted: {', '.join(strangers)}")
    builder = GroupBuilder(window, begin)
    for i, (names, own_stretches) in enumerate(zip(record_names, segments, strict=True)):
        for segment, piece in own_stretches:
            chosen = predictor_for("simulation" if segment.is_gap else focus, own_released[i], model_of[i])
            chosen = filled(chosen)
            if ties is None:
                builder.add(chosen, tuple(position[names[q.name]] for q in chosen.free), segment.segment)
            else:
                index, tie = tie_of(chosen, names, position, ties, piece)
                builder.add(chosen, index, segment.segment, tie)
    parts, windows = builder.build()
    return Assembly(
        parts,
        links_of(windows, [len(record) for record in segments]),
        free,
        predictor.unused,
        record_windows(windows, [len(record) for record in segments]),
        record_names,
        builder.engine_name,
        tuple(dict.fromkeys(builder.notes)),
    )


def _check_channels(structure: AnyStructure, predictor: GeneralPredictor, record: Record, data: FitData) -> None:
    n_inputs, n_outputs = record.inputs.shape[1], record.outputs.shape[1]
    if (predictor.n_inputs, predictor.n_outputs) != (n_inputs, n_outputs):
        names = f" ({', '.join(data.input_names)})" if n_inputs == len(data.input_names) else ""
        raise UsageError(
            f"structure {structure.name!r} has {predictor.n_inputs} inputs and {predictor.n_outputs} outputs; "
            f"the recordings give {n_inputs}{names} and {n_outputs} ({', '.join(data.output_names)})"
        )


def _check_names(data: FitData) -> None:
    """Raise an error for recordings with equal names, because options identify recordings by name."""
    names = [record.name for record in data.records]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UsageError(
            f"several recordings are named {twice[0]!r}; local parameters, trends, hum and left_out identify "
            "recordings by name, so give each its own"
        )


def group_name(record: Record, scope: Scope) -> str:
    """Return the name of the group of records that share a local parameter."""
    if scope == "recording":
        return record.name
    if scope != "operating_point":
        raise UsageError(f"local = {scope!r}; choose 'recording' or 'operating_point'")
    pressure, speed = (record.conditions.get(key) for key in ("pressure_bar", "speed_rpm"))
    if pressure is None or speed is None:
        raise DataError(
            f"recording {record.name!r} states no pressure_bar and speed_rpm, which parameters local to an "
            "operating point need"
        )
    return point_label(pressure, speed)


def _full_names(
    predictor: GeneralPredictor, record: Record, scopes: Mapping[str, Scope], n_records: int, tied: frozenset[str]
) -> dict[str, str]:
    names = {}
    for q in predictor.free:
        if q.name in tied:
            continue
        scope = scopes.get(q.name)
        names[q.name] = q.name if scope is None or n_records == 1 else f"{q.name}[{group_name(record, scope)}]"
    return names


def _all_free(parameters: Sequence[Parameter], record_names: Sequence[Mapping[str, str]]) -> tuple[Parameter, ...]:
    """Return shared parameters once and local ones once for each group, in the order of the structure."""
    found: dict[str, Parameter] = {}
    for q in parameters:
        for names in record_names:
            full = names.get(q.name)
            if full is not None and full not in found:
                found[full] = q if full == q.name else q.renamed(full)
    return tuple(found.values())


def automatic_window(data: FitData, focus: Focus) -> int:
    """Return a length of the shooting windows.

    It is short, so that the fit converges from bad start values. The number of windows is a multiple of the lanes.

    Parameters
    ----------
    data : FitData
        Data of the fit.
    focus : {"prediction", "simulation"}
        Focus of the fit.

    Returns
    -------
    int
        Number of samples.
    """
    n = data.n_samples
    count = min(LANES * -(-n // (_WINDOW[focus] * LANES)), _MOST_WINDOWS[focus])
    return -(-n // count)


def full_start(
    assembly: Assembly, begin: Mapping[str, float], own: Sequence[Mapping[str, float]] = ()
) -> dict[str, float]:
    """Return start values by full name: one for all groups of a local parameter, and `own` for each record."""
    full = dict(begin)
    for i, names in enumerate(assembly.record_names):
        known = {**begin, **(own[i] if own else {})}
        full |= {long: known.get(short, 0.0) for short, long in names.items()}
    return full


# ---- Shooting problem of an assembled fit: scales, starts of windows, bounds, priors.


def build_problem(
    assembly: Assembly,
    data: FitData,
    criterion: Criterion,
    output_weights: Sequence[float] | None,
    begin: Mapping[str, float],
    prior: Mapping[str, tuple[float, float]],
) -> tuple[Shooting, FloatArray]:
    """Scale the unknowns, and find window starts for the start values.

    Parameters
    ----------
    assembly : Assembly
    data : FitData
    criterion, output_weights, prior
        As for `gbid.fit`.
    begin : dict of str to float
        Start values by full name.

    Returns
    -------
    Shooting
    (n_unknowns,) array
        Where to start, scaled: each window's own least-squares start for the start values.
    """
    weights = _checked_weights(output_weights, data)
    if criterion == "det" and output_weights is None:  # outputs count equally at the start, in any units
        variance = np.average([_variances(r.outputs) for r in data.records], axis=0)
        weights = 1 / np.where(variance > 0, variance, 1.0)
    theta = np.array([begin[q.name] for q in assembly.free])
    n = assembly.parts[0].predictor.n_states
    power = sum(float(_variances(r.outputs) @ weights) * r.n_samples for r in data.records)
    ones = np.ones(len(theta))
    known = _prior(assembly, prior)
    scale = float(np.sqrt(power / data.n_samples))
    problem = Shooting(assembly.parts, assembly.links, criterion, weights, scale, ones, np.ones(n), known)
    values = problem.values(theta)
    size = _sizes_of_states(problem, values, np.zeros((problem.n_windows, n)))
    sweeps = problem.sweeps(values, np.zeros((problem.n_windows, n)), np.diag(weights) / power)
    hessian = np.concatenate([s.hessian_start for s in sweeps])
    seen = np.sqrt(hessian.sum(axis=0).diagonal())  # of the outputs' own size, over states at the starts of windows
    alone = np.where(np.isfinite(seen) & (seen > 0), 1 / np.maximum(seen, np.finfo(float).tiny), 1.0)
    state_scale = np.where(np.isfinite(size) & (size > 0), size, alone)
    starts = -_ridge_solve(hessian, np.concatenate([s.gradient_start for s in sweeps]), state_scale)
    if any(isinstance(part.kernel, NonlinearKernel) for part in problem.parts):
        starts, sweeps = _nonlinear_starts(problem, values, np.diag(weights) / power, starts)
        size = _sizes_of_states(problem, values, starts)
        state_scale = np.where(np.isfinite(size) & (size > 0), size, state_scale)
    products = problem.error_products(values, starts)
    curvature = known.information / problem.likelihood_size
    if np.isfinite(products).all():  # the pass above, in units of the errors at these starts
        unit = power / (float(weights @ np.diag(products)) + 1e-13 * power)
        for s, part in zip(sweeps, problem.parts, strict=True):
            curvature[part.index] += unit * np.diag(s.hessian)
    magnitude = np.where(theta != 0, np.abs(theta), 1.0)
    theta_scale = np.where(curvature > 0, 1 / np.sqrt(np.maximum(curvature, 1e-300)), magnitude)
    problem = replace(problem, theta_scale=theta_scale, state_scale=state_scale, _last={}, _met={})
    return replace(problem, stable_only=problem.growth(values, sweeps) <= 1), problem.pack(theta, starts)


def _sizes_of_states(problem: Shooting, values: list[Any], starts: FloatArray) -> FloatArray:
    """Return the root mean square of each state in a simulation from the starts of windows, in the largest part."""
    firsts = zip(problem.first_window[:-1], problem.first_window[1:], strict=True)
    squares = [
        _mean_squares(part.kernel.predict(v, part.blocks, starts[a:b]).states)
        for v, part, (a, b) in zip(values, problem.parts, firsts, strict=True)
    ]
    return np.asarray(np.sqrt(np.max(squares, axis=0)))


def _mean_squares(states: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("gknl,gknl->n", states, states) / (states.size // states.shape[2]))


def _variances(outputs: FloatArray) -> FloatArray:
    return np.asarray(np.ascontiguousarray(outputs.T).var(axis=1))


def _nonlinear_starts(
    problem: Shooting, values: list[Any], weight: FloatArray, first: FloatArray
) -> tuple[FloatArray, list[Sweep]]:
    """Return the starts of all windows and the passes from there, see `window_starts`."""
    starts, sweeps = [], []
    firsts = zip(problem.first_window[:-1], problem.first_window[1:], strict=True)
    for v, part, (a, b) in zip(values, problem.parts, firsts, strict=True):
        assert isinstance(part.predictor, NonlinearPredictor)
        assert isinstance(part.kernel, NonlinearKernel)
        found = window_starts(part.predictor, part.kernel, v, part.blocks, weight, first[a:b])
        starts.append(found[0])
        sweeps.append(tied(found[1], part.tie))
    return np.concatenate(starts), sweeps


def unknown_bounds(
    problem: Shooting, assembly: Assembly, states: InitialStates | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the scaled bounds of all unknowns; given and spare initial states are fixed."""
    free = np.full((problem.n_windows, problem.n_states), inf)
    lowest, highest = -free, free
    for part, first, last in zip(problem.parts, problem.first_window[:-1], problem.first_window[1:], strict=True):
        spare = part.predictor.spare
        for side in (lowest, highest):
            side[first:last, problem.n_states - spare :] = 0.0
    if states is not None:
        n, fixed = assembly.n_states, ~np.isnan(states.shooting)
        for window, values, held in zip(assembly.record_window, states.shooting, fixed, strict=True):
            for side in (lowest, highest):
                side[window, :n][held] = values[held]
    lower = problem.pack(np.array([q.lower for q in assembly.free]), lowest)
    upper = problem.pack(np.array([q.upper for q in assembly.free]), highest)
    return lower, upper


def window_length(problem: Shooting) -> int:
    """Return the number of samples in a shooting window."""
    blocks = problem.parts[0].blocks
    return blocks.length * blocks.per_window


def _checked_weights(output_weights: Sequence[float] | None, data: FitData) -> FloatArray:
    n_y = len(data.output_names)
    weights = np.ones(n_y) if output_weights is None else np.asarray(output_weights, float)
    if weights.shape != (n_y,) or not (np.isfinite(weights).all() and (weights > 0).all()):
        names = ", ".join(data.output_names)
        raise UsageError(f"output_weights = {output_weights}; give one positive number for each of {names}")
    return weights


def _prior(assembly: Assembly, prior: Mapping[str, tuple[float, float]]) -> Prior:
    """Priors by full or by own names; the latter hold for every group."""
    full = {q.name: i for i, q in enumerate(assembly.free)}
    mean, information = np.zeros(len(full)), np.zeros(len(full))
    for name, (value, std) in prior.items():
        own = [i for long, i in full.items() if name in (long, assembly.own_names.get(long))]
        if not own:
            raise UsageError(f"prior names a parameter that is not estimated: {name}")
        if not (np.isfinite(value) and np.isfinite(std) and std > 0):
            raise UsageError(f"prior of {name} = ({value}, {std}); give a value and a positive standard deviation")
        mean[own], information[own] = value, 1 / std**2
    return Prior(mean, information)


def _ridge_solve(hessian: FloatArray, gradient: FloatArray, scale: FloatArray) -> FloatArray:
    """Solve for each window; a ridge keeps states near zero that the window does not determine."""
    scaled = hessian * np.outer(scale, scale)
    n = len(scale)
    ridge = 1e-6 * np.trace(scaled, axis1=1, axis2=2)[:, None, None] / n + 1e-300
    matrix = scaled + ridge * np.eye(n)
    if not np.isfinite(matrix).all():
        return np.zeros_like(gradient)
    return np.asarray(np.linalg.solve(matrix, (gradient * scale)[:, :, None])[:, :, 0] * scale)
