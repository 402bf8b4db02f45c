"""Assembly of the shooting problem: parts with kernels, links between windows, scales and starts."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from math import inf
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, IntArray, point_label
from gbid.core.compiled import CompilerMissingError
from gbid.core.errors import DataError, UsageError
from gbid.core.notes import FitNote
from gbid.discretise.exact import distinct_steps
from gbid.identify.data import FitData, Record, column_variances
from gbid.identify.disturbances import UNDISTURBED, Disturbances
from gbid.identify.frequency_data import FrequencyData
from gbid.identify.kernel.blocks import LANES, LONGEST_BLOCK, Segment, cut
from gbid.identify.kernel.gaps import GapKernel, with_constant_gain
from gbid.identify.kernel.lanes import LanesKernel
from gbid.identify.kernel.linear import (
    LONGEST_SOURCE,
    CompiledLinearKernel,
    CompiledPasses,
    KernelPattern,
    PortableLinearKernel,
    kernel_source,
)
from gbid.identify.kernel.nonlinear import MappedKernel, NonlinearKernel
from gbid.identify.kernel.response import ResponseGroup
from gbid.identify.kernel.sample import NonlinearPredictor, build_nonlinear_predictor
from gbid.identify.kernel.sums import Kernel, Sweep, tied
from gbid.identify.options import FitArguments, Focus, RunEngine, Scope
from gbid.identify.predictor import GeneralPredictor, Predictor, build_predictor
from gbid.identify.problem.nlp import ExtraTerms, Prior, RecordGroup, Shooting
from gbid.identify.problem.states import InitialStates
from gbid.structure import Parameter, Values
from gbid.structure.kinds import AnyStructure, kind_of
from gbid.structure.linear import in_one_line


@dataclass(frozen=True, eq=False)
class Ties:
    """Linear map from shared unknowns to parameters of each piece i: ``maps[i] @ shared``.

    Attributes
    ----------
    names : tuple of str
        Parameters of the structure.
    shared : tuple of Parameter
        The unknowns in their place.
    maps : (n_pieces, n_names, n_shared) array
    edges : tuple of tuple of int
        For each record the first samples of its pieces after the first one.
    """

    names: tuple[str, ...]
    shared: tuple[Parameter, ...]
    maps: FloatArray
    edges: tuple[tuple[int, ...], ...]

    def pieces(self, record: int) -> tuple[int, tuple[int, ...]]:
        """Return the number of a record's first piece, and the first samples of its other pieces."""
        return sum(len(record_edges) + 1 for record_edges in self.edges[:record]), self.edges[record]


def tie_of(
    predictor: GeneralPredictor, names: Mapping[str, str], position: Mapping[str, int], ties: Ties, piece: int
) -> tuple[tuple[int, ...], FloatArray]:
    """Unknowns that affect one piece of a record, and the matrix from them to the predictor's parameters.

    Parameters
    ----------
    predictor : GeneralPredictor
    names : dict of str to str
        Full names of its parameters that are not tied.
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
    columns = [i for i, q in enumerate(predictor.free) if q.name in names]
    others = [i for i, q in enumerate(predictor.free) if q.name not in names]
    rows, n_shared = [ties.names.index(predictor.free[i].name) for i in others], len(ties.shared)
    seen = [q.name for q in ties.shared] + [names[predictor.free[i].name] for i in columns]
    tie = np.zeros((len(predictor.free), len(seen)))
    tie[columns, n_shared + np.arange(len(columns))] = 1.0
    tie[others, :n_shared] = ties.maps[piece][rows]
    return tuple(position[name] for name in seen), tie


MOST_INSTRUCTIONS = 60_000
"""Largest number of operations of all functions of a sample that are compiled: 10 000 take about 3 s."""


def choose_kernel(predictor: GeneralPredictor, begin: Mapping[str, float]) -> tuple[Kernel, list[str]]:
    """Return the kernel of a predictor, and notes on the choice.

    It is compiled if there is a C compiler and the predictor is not too large to be compiled in seconds. Otherwise it
    is the portable one, and a note says why.

    Parameters
    ----------
    predictor : Predictor or NonlinearPredictor
        The predictor.
    begin : dict of str to float
        Start values, which show the entries of a linear predictor that are always zero.
    """
    notes: list[str] = []
    compiled: Callable[[], CompiledPasses]
    portable: Callable[[], Kernel]
    if isinstance(predictor, NonlinearPredictor):
        compiled, portable = partial(LanesKernel, predictor.functions), partial(MappedKernel, predictor.functions)
        count = sum(f.n_instructions() for f in predictor.functions if isinstance(f, ca.Function))
        large = f"{count} operations" if count > MOST_INSTRUCTIONS else ""
        if predictor.jumps:
            text = (
                f"the equations have jumps or kinks ({', '.join(predictor.jumps)}): the derivatives describe "
                "only the smooth pieces, so estimates of the jumps, and their standard deviations, are rough"
            )
            notes.append(FitNote.JUMPS(text))
    else:
        theta = np.array([begin.get(q.name, 0.0) for q in predictor.free])
        nudged = np.where(theta == 0, 1e-3, theta * 1.001)  # a point where nothing is zero by chance
        nudged = np.clip(nudged, [q.lower for q in predictor.free], [q.upper for q in predictor.free])
        pattern = KernelPattern.of(predictor.at(nudged))
        compiled, portable = partial(CompiledLinearKernel, pattern), PortableLinearKernel
        large = f"{len(pattern.F)} states" if len(kernel_source(pattern)) > LONGEST_SOURCE else ""
    reason = f"a compiled pass of {large} would take minutes to build: the slower portable pass was used"
    if not large:
        try:
            kernel = compiled()
        except (CompilerMissingError, NotImplementedError) as missing:
            reason = f"{missing}: the slower portable pass was used; install gcc, clang or gbid[compiler], or set CC"
        else:
            return kernel, [FitNote.SLOW_ENGINE(kernel.note), *notes] if kernel.note else notes
    return portable(), [FitNote.SLOW_ENGINE(reason), *notes]


def counted_samples(record: Record, left_out: Sequence[tuple[int, int]]) -> BoolArray:
    """Return which samples of a recording are not left out, (n_samples,).

    Raises
    ------
    DataError
        When a stretch lies outside the recording, or all samples are left out.
    """
    n = record.n_samples
    counts = np.ones(n, bool)
    for start, stop in left_out:
        if not 0 <= start < stop <= n:
            raise DataError(f"recording {record.name!r}: samples {start} to {stop} of left_out are not within its {n}")
        counts[start:stop] = False
    if not counts.any():
        raise DataError(f"recording {record.name!r}: all samples are left out")
    return counts


def segments_of(
    record: Record, left_out: Sequence[tuple[int, int]], edges: Sequence[int], *, feeds_back: bool
) -> list[tuple[Segment, int]]:
    """Return the segments of a record with their piece numbers; pieces begin at 0 and at the `edges`.

    Without feedback of the outputs the model runs through what is left out, and those samples just do not count. With
    feedback it runs through them on its own: a segment of simulation between two of prediction.
    """
    n = record.n_samples
    counts, cuts = counted_samples(record, left_out), {0, n, *edges}
    if feeds_back:
        cuts |= set((np.flatnonzero(np.diff(counts)) + 1).tolist())
    if record.missing is not None:
        counts &= ~record.missing.all(axis=1)
        if not counts.any():
            raise DataError(f"recording {record.name!r}: all samples are left out or missing")
    counts_or_none = None if counts.all() else counts.astype(float)
    whole = Segment(record.inputs, record.outputs, counts_or_none, missing=record.missing, time=record.time)
    return [(replace(whole, start=a, stop=b), bisect_right(edges, a)) for a, b in pairwise(sorted(cuts))]


class Member(NamedTuple):
    """Segment of a record with its predictor; for `columns` and `tie` see `index` and `tie` of `RecordGroup`."""

    record: int
    segment: Segment
    predictor: GeneralPredictor
    columns: tuple[int, ...]
    tie: FloatArray | None


def grouped(
    members: Sequence[Member], window: int | None, begin: Mapping[str, float]
) -> tuple[tuple[RecordGroup, ...], IntArray, IntArray, tuple[str, ...]]:
    """Return parts, links between windows, first windows of the records, and notes; see `Assembly`.

    A part has the segments with the same predictor and parameters, cut into windows of so many samples. `begin` are
    start values, at which the entries of a predictor are found that are zero for good.
    """
    groups: dict[tuple[int, tuple[int, ...], bytes], list[int]] = {}
    for i, (_, _, predictor, index, tie) in enumerate(members):
        groups.setdefault((id(predictor), index, b"" if tie is None else tie.tobytes()), []).append(i)
    kernels: dict[int, Kernel] = {}
    notes = dict[str, None]()
    parts, windows, base = [], [(0, 0)] * len(members), 0  # first and last window of each segment
    for (key, _, _), places in groups.items():
        _, _, predictor, index, tie = members[places[0]]
        segments = [members[i].segment for i in places]
        gaps = _needs_gap_kernel(predictor, segments)
        if gaps:
            segments = [
                with_constant_gain(each, predictor.n_states, feeds_back=predictor.feeds_back) for each in segments
            ]
        if not gaps and key not in kernels:
            kernels[key], on_choice = choose_kernel(predictor, begin)
            notes |= dict.fromkeys(on_choice)
        # A lone short segment fills all lanes with blocks of itself.
        longest = max(len(s.part(s.outputs)) for s in segments)
        size = -(-longest // LANES) if len(segments) == 1 and tie is not None else LONGEST_BLOCK
        blocks = cut(segments, predictor, window, longest_block=min(size, LONGEST_BLOCK))
        kernel = GapKernel() if gaps else kernels[key]
        parts.append(RecordGroup(predictor, blocks, np.array(index), kernel, tie))
        edges = pairwise([*blocks.segment_first.tolist(), blocks.n_windows])
        for i, (first, stop) in zip(places, edges, strict=True):
            windows[i] = base + first, base + stop - 1
        base += blocks.n_windows
    links, firsts, before = list[tuple[int, int]](), dict[int, int](), 0
    for member, (first, last) in zip(members, windows, strict=True):
        links += [(before, first)] if member.record in firsts else []
        firsts.setdefault(member.record, first)
        links += pairwise(range(first, last + 1))
        before = last
    pairs, begins = np.array(links, np.int64).reshape(-1, 2), np.array([*firsts.values()], np.int64)
    return tuple(parts), pairs, begins, tuple(notes)


def _needs_gap_kernel(predictor: GeneralPredictor, segments: Sequence[Segment]) -> bool:
    """Return whether a segment needs a `GapKernel`: irregular times, or outputs missing in part.

    Raises
    ------
    UsageError
        When that is so for a structure that is not linear, or predictions correct a loop with a sampled controller.
    """
    if predictor.intervals is not None and isinstance(predictor, Predictor):
        return True
    gaps = [~s.present for s in segments if s.missing is not None]
    if not any(gap.any() if predictor.feeds_back else (gap.any(1) != gap.all(1)).any() for gap in gaps):
        return False
    if not isinstance(predictor, Predictor):
        raise UsageError(
            "a nonlinear structure takes missing outputs (NaN) only without a disturbance gain (focus='simulation'), "
            "and only where all outputs of a sample are missing together"
        )
    if predictor.feeds_back and predictor.feedback is not None:
        raise UsageError(
            "a loop with a sampled controller takes missing outputs (NaN) only without a disturbance gain "
            "(focus='simulation'): the gain of its Kalman filter after a gap is not computed"
        )
    return True


_WINDOWS = {"prediction": (256, 64), "simulation": (128, 192)}
"""Samples in a window, and most windows: more samples make longer windows, as the solver's own work grows with these.

Measured outputs stabilise a prediction, so its windows are longer.
"""
_MOST_STATES = 1536
"""Most states at the starts of all windows: with more, the factorisations of the solver take most of the time."""
_WITH_GAPS = 64
"""Samples in a window where outputs are missing or times irregular: numpy runs all windows side by side."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """Data of a fit, assembled for the shooting problem.

    Attributes
    ----------
    parts : tuple of RecordGroup
        Groups of records.
    responses : tuple of ResponseGroup
        Frequency responses.
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
    notes : tuple of str
        Notes for the user.
    """

    parts: tuple[RecordGroup, ...]
    responses: tuple[ResponseGroup, ...]
    links: IntArray
    free: tuple[Parameter, ...]
    unused: tuple[str, ...]
    record_window: IntArray
    record_names: tuple[Mapping[str, str], ...]
    notes: tuple[str, ...]

    @property
    def n_states(self) -> int:
        """Number of states of the structure, not counting random-walk offsets."""
        predictor = (self.parts or self.responses)[0].predictor
        return predictor.n_states - len(predictor.disturbances.walking)

    @property
    def engine(self) -> RunEngine:
        """Engine of the passes over the samples: compiled or numpy."""
        return self.parts[-1].kernel.engine if self.parts else "numpy"

    @property
    def own_names(self) -> dict[str, str]:
        """Names in the structure of the free parameters, by full name."""
        return {full: own for names in self.record_names for own, full in names.items()}


def assemble(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    begin: Mapping[str, float],
    data: FitData,
    options: FitArguments,
    *,
    disturbances: Disturbances = UNDISTURBED,
    released: BoolArray | None = None,
    ties: Ties | None = None,
    responses: Sequence[FrequencyData] = (),
) -> Assembly:
    """Return the assembly of a fit from recordings and options.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
    parameters : tuple of Parameter
        Its parameters, with the starts, bounds and fixed values of the caller.
    begin : dict of str to float
        Start values.
    data : FitData
        Recordings.
    options : FitArguments
        Options of the fit: `focus`, `intersample`, `local`, `left_out` and `window`.
    disturbances : Disturbances
        Trends and hum.
    released : (n_records, n) boolean array, optional
        Initial states that are functions of the parameters.
    ties : Ties, optional
        Parameters of the structure that are linear in further, shared unknowns. These are then the first of `free`.
    responses : sequence of FrequencyData
        Frequency responses, in place of recordings or beside them.

    Raises
    ------
    UsageError, DataError
        For options that do not fit the structure or the recordings.
    """
    held = {q.name: begin[q.name] for q in parameters if q.fixed}
    known = {q.name: q for q in parameters}
    focus, local, left_out = options.focus, options.local or {}, options.left_out or {}
    hold = structure.intersample if options.intersample is None else options.intersample
    intervals = distinct_steps(*(r.time for r in data.records if r.time is not None)) if data.is_irregular else None

    @cache
    def predictor_for(kind: Focus, released: tuple[bool, ...]) -> GeneralPredictor:
        more: dict[str, Any] = {"disturbances": disturbances, "released": released, "intervals": intervals}
        build: Callable[..., GeneralPredictor] = build_predictor
        if kind_of(structure).nonlinear:
            build = partial(build_nonlinear_predictor, begin=begin)
        built = build(structure, held, sample_time=data.sample_time, intersample=hold, focus=kind, **more)
        return replace(built, free=tuple(known.get(q.name, q) for q in built.free))

    own_released = [()] * len(data.records) if released is None or not released.any() else [*map(tuple, released)]
    first = predictor_for(focus, next(iter(own_released), ()))
    if data.records:
        _check_channels(structure, first, data)
    scopes: dict[str, Scope] = {**local, **dict.fromkeys((term.name for term in disturbances.terms), "recording")}
    if unknown := [name for name in scopes if name not in [q.name for q in first.free]]:
        raise UsageError(f"local names parameters that are not estimated: {', '.join(unknown)}")
    if unknown_records := [name for name in left_out if name not in [record.name for record in data.records]]:
        raise UsageError(f"left_out names recordings that are not fitted: {', '.join(unknown_records)}")
    if scopes or left_out or ties is not None:
        _check_names(data)
    untied = [q for q in first.free if ties is None or q.name not in ties.names]
    record_names: tuple[Mapping[str, str], ...] = tuple(
        {
            q.name: f"{q.name}[{group_name(record, scopes[q.name])}]"
            if q.name in scopes and len(data.records) > 1
            else q.name
            for q in untied
        }
        for record in data.records
    )
    free = _all_free(untied, record_names) if record_names else tuple(untied)
    if ties is not None:
        free = (*ties.shared, *free)
    position = {q.name: i for i, q in enumerate(free)}
    members = []
    for i, (record, names) in enumerate(zip(data.records, record_names, strict=True)):
        first_piece, edges = (i, ()) if ties is None else ties.pieces(i)
        feeds_back = first.feeds_back
        for segment, piece in segments_of(record, left_out.get(record.name, ()), edges, feeds_back=feeds_back):
            kind: Focus = "simulation" if feeds_back and segment.is_left_out else focus
            chosen = predictor_for(kind, own_released[i])
            if ties is None:
                index, tie = tuple(position[names[q.name]] for q in chosen.free), None
            else:
                index, tie = tie_of(chosen, names, position, ties, first_piece + piece)
            members.append(Member(i, segment, chosen, index, tie))
    window = automatic_window(data, focus, first.n_states) if options.window == "auto" else options.window
    parts, links, record_window, notes = grouped(members, window, begin)
    groups = tuple[ResponseGroup, ...]()
    if responses:
        if len(parts) > 1 or local or not isinstance(first, Predictor):
            raise UsageError("frequency responses are fitted together with recordings that share all parameters")
        groups = tuple(ResponseGroup(each, first, np.arange(len(free))) for each in responses)
    return Assembly(parts, groups, links, free, first.unused, record_window, record_names, notes)


def _check_channels(structure: AnyStructure, predictor: GeneralPredictor, data: FitData) -> None:
    n_inputs, n_outputs = data.records[0].inputs.shape[1], data.records[0].outputs.shape[1]
    if (predictor.n_inputs, predictor.n_outputs) != (n_inputs, n_outputs):
        names = f" ({', '.join(data.input_names)})" if n_inputs == len(data.input_names) else ""
        raise UsageError(
            f"structure {structure.name!r} has {predictor.n_inputs} inputs and {predictor.n_outputs} outputs; "
            f"the recordings give {n_inputs}{names} and {n_outputs} ({', '.join(data.output_names)})"
        )


def _check_names(data: FitData) -> None:
    """Refuse recordings with equal names: options identify recordings by name."""
    names = [record.name for record in data.records]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UsageError(
            f"several recordings are named {twice[0]!r}; local parameters, trends, hum and left_out identify "
            "recordings by name, so give each recording a different name"
        )


def group_name(record: Record, scope: Scope) -> str:
    """Return the name of the group of records that share a value of a local parameter."""
    if scope == "recording":
        return record.name
    pressure, speed = (record.conditions.get(key) for key in ("pressure_bar", "speed_rpm"))
    if pressure is None or speed is None:
        raise DataError(
            f"recording {record.name!r} states no pressure_bar and speed_rpm, which parameters local to an "
            "operating point need"
        )
    return point_label(pressure, speed)


def _all_free(parameters: Sequence[Parameter], record_names: Sequence[Mapping[str, str]]) -> tuple[Parameter, ...]:
    """Return the free parameters: shared ones once, local ones once for each group, in the structure's order."""
    free: dict[str, Parameter] = {}
    for q in parameters:
        for names in record_names:
            if full := names.get(q.name):
                free.setdefault(full, q if full == q.name else q.renamed(full))
    return tuple(free.values())


def automatic_window(data: FitData, focus: Focus, n_states: int) -> int:
    """Return a window length (samples) for a structure with a given number of states.

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
    usual, most = _WINDOWS[focus]
    if any(
        r.time is not None
        or (r.missing is not None and (focus == "prediction" or (r.missing.any(1) != r.missing.all(1)).any()))
        for r in data.records
    ):
        usual, most = _WITH_GAPS, n
    most = min(most, max(1, _MOST_STATES // (LANES * max(n_states, 1))) * LANES)
    return max(2, -(-n // min(LANES * -(-n // (usual * LANES)), most)))


def full_start(
    assembly: Assembly, begin: Mapping[str, float], own: Sequence[Mapping[str, float]] = ()
) -> dict[str, float]:
    """Return start values by full name; `own` are values of each record that replace common ones."""
    full = dict(begin)
    for i, names in enumerate(assembly.record_names):
        known = {**begin, **(own[i] if own else {})}
        full |= {long: known.get(short, 0.0) for short, long in names.items()}
    return full


# ---- Shooting problem of an assembled fit: scales, starts of windows, bounds, priors.


def build_problem(
    assembly: Assembly,
    data: FitData,
    options: FitArguments,
    begin: Mapping[str, float],
    states: InitialStates | None = None,
) -> tuple[Shooting, FloatArray]:
    """Return the shooting problem: scaled unknowns, and window starts for the start values.

    Parameters
    ----------
    assembly : Assembly
    data : FitData
    options : FitArguments
        Options of the fit: `criterion`, `output_weights` and `prior`.
    begin : dict of str to float
        Start values by full name.
    states : InitialStates, optional
        Initial states of the records; by default all are estimated.

    Returns
    -------
    Shooting
    (n_unknowns,) array
        Where to start, scaled: each window's own least-squares start for the start values.
    """
    weights, criterion = _checked_weights(options.output_weights, data), options.criterion
    if criterion == "auto":
        criterion = "det" if len(weights) > 1 and options.output_weights is None else "trace"
    if criterion == "det" and options.output_weights is None:  # outputs count equally at the start, in any units
        variance = np.average([column_variances(r.outputs) for r in data.records], axis=0)
        weights = 1 / np.where(variance > 0, variance, 1.0)
    theta = np.array([begin[q.name] for q in assembly.free])
    n = assembly.parts[0].predictor.n_states if assembly.parts else 0
    power = sum(float(column_variances(r.outputs) @ weights) * r.n_samples for r in data.records)
    known = _prior(assembly, options.prior or {})
    scale = float(np.sqrt(power / max(1, data.n_samples)))
    problem = Shooting(
        assembly.parts,
        assembly.responses,
        assembly.links,
        criterion,
        weights,
        scale,
        np.ones(len(theta)),
        np.ones(n),
        known,
    )
    curvature = np.diag(problem.known(theta).hessian) / problem.likelihood_size
    if not assembly.parts:
        problem = replace(problem, theta_scale=_scales(theta, curvature))
        return bounded(problem, assembly, states), problem.pack(theta, np.zeros((0, 0)))
    values, weight = problem.values(theta), np.diag(weights) / power
    starts = np.zeros((problem.n_windows, n))
    size, sweeps = _sizes_of_states(problem, values, starts), problem.sweeps(values, starts, weight)
    hessian = np.concatenate([s.hessian_start for s in sweeps])
    seen = np.sqrt(hessian.sum(axis=0).diagonal())  # of the outputs' own size, over states at the starts of windows
    alone = np.where(np.isfinite(seen) & (seen > 0), 1 / np.maximum(seen, np.finfo(float).tiny), 1.0)
    state_scale = np.where(np.isfinite(size) & (size > 0), size, alone)
    starts = -_ridge_solve(hessian, np.concatenate([s.gradient_start for s in sweeps]), state_scale)
    if any(isinstance(part.kernel, NonlinearKernel) for part in problem.parts):
        starts, sweeps = _nonlinear_starts(problem, values, weight, starts)
        size = _sizes_of_states(problem, values, starts)
        state_scale = np.where(np.isfinite(size) & (size > 0), size, state_scale)
    products = problem.error_products(values, starts)
    if np.isfinite(products).all():  # the pass above, in units of the errors at these starts
        unit = power / (float(weights @ np.diag(products)) + 1e-13 * power)
        for s, part in zip(sweeps, problem.parts, strict=True):
            curvature[part.index] += unit * np.diag(s.hessian)
    problem = replace(problem, theta_scale=_scales(theta, curvature), state_scale=state_scale)
    problem = replace(problem, stable_only=problem.growth(values, sweeps) <= 1)
    return bounded(problem, assembly, states), problem.pack(theta, starts)


def _scales(theta: FloatArray, curvature: FloatArray) -> FloatArray:
    """Return the scale of each parameter: from the curvature of the cost, else from its size."""
    size = np.where(theta != 0, np.abs(theta), 1.0)
    return np.where(curvature > 0, 1 / np.sqrt(np.maximum(curvature, 1e-300)), size)


def _sizes_of_states(problem: Shooting, values: list[Any], starts: FloatArray) -> FloatArray:
    """Return the rms of each state in a simulation from window starts: the largest of all parts."""
    states = [part.kernel.predict(v, part.blocks, begin).states for v, part, begin in problem.each(values, starts)]
    squares = [np.einsum("gknl,gknl->n", x, x) / (x.size // x.shape[2]) for x in states]
    return np.asarray(np.sqrt(np.max(squares, axis=0)))


_AS_WELL = 4.0  # squares of the trajectory over those of windows: with twice their errors it has not lost the phase


def _nonlinear_starts(
    problem: Shooting, values: list[Any], weight: FloatArray, first: FloatArray
) -> tuple[FloatArray, list[Sweep]]:
    """Return the window starts of nonlinear parts, and the passes from these starts.

    They are those of least squares in each window (`NonlinearKernel.window_starts`), or lie on the trajectory from the
    first window, which has no gaps, where that explains the data about as well.
    """
    starts, sweeps = [], []
    for v, part, guess in problem.each(values, first):
        assert isinstance(part.kernel, NonlinearKernel)
        begin, blocks = part.kernel.window_starts(v, part.blocks, weight, guess), part.blocks
        if blocks.n_windows > len(blocks.segment_first):
            passed = part.kernel.begin(v, blocks.by_whole_segments(), begin[blocks.segment_first])
            on_course = np.ascontiguousarray(passed[:, blocks.window_first].T)
            apart, whole = (
                float(np.sum(part.kernel.products(v, blocks, each)[: blocks.n_blocks] * weight))
                for each in (begin, on_course)
            )
            begin = on_course if whole <= _AS_WELL * apart else begin
        sweep = part.kernel.sweep(v, blocks, begin, weight)
        starts.append(begin)
        sweeps.append(tied(sweep, part.tie))
    return np.concatenate(starts), sweeps


def bounded(problem: Shooting, assembly: Assembly, states: InitialStates | None) -> Shooting:
    """Return a problem with bounds of its unknowns; given initial states are fixed."""
    fixed = np.full((problem.n_windows, problem.n_states), np.nan)
    if states is not None:
        fixed[assembly.record_window, : assembly.n_states] = states.shooting
    lowest, highest = (np.where(np.isnan(fixed), free, fixed) for free in (-inf, inf))
    lower = problem.pack(np.array([q.lower for q in assembly.free]), lowest)
    upper = problem.pack(np.array([q.upper for q in assembly.free]), highest)
    return replace(problem, box=(lower, upper))


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
    """Return the prior of the free parameters; a name without recording applies to all groups."""
    full = {q.name: i for i, q in enumerate(assembly.free)}
    mean, information = np.zeros(len(full)), np.zeros(len(full))
    for name, (value, std) in prior.items():
        positions = [i for long, i in full.items() if name in (long, assembly.own_names.get(long))]
        if not positions:
            raise UsageError(f"prior names a parameter that is not estimated: {name}")
        if not (np.isfinite(value) and np.isfinite(std) and std > 0):
            raise UsageError(f"prior of {name} = ({value}, {std}); give a value and a positive standard deviation")
        mean[positions], information[positions] = value, 1 / std**2
    return Prior(mean, information)


def _ridge_solve(hessian: FloatArray, gradient: FloatArray, scale: FloatArray) -> FloatArray:
    """Solve for each window start; a ridge keeps undetermined states near zero."""
    scaled = hessian * np.outer(scale, scale)
    n = len(scale)
    ridge = 1e-6 * np.trace(scaled, axis1=1, axis2=2)[:, None, None] / n + 1e-300
    matrix = scaled + ridge * np.eye(n)
    if not np.isfinite(matrix).all():
        return np.zeros_like(gradient)
    return np.asarray(np.linalg.solve(matrix, (gradient * scale)[:, :, None])[:, :, 0] * scale)


# ---- Extra cost and constraints of the caller, written with CasADi.


def with_extra_terms(
    problem: Shooting,
    assembly: Assembly,
    data: FitData,
    states: InitialStates,
    parameters: Sequence[Parameter],
    start: FloatArray,
    options: FitArguments,
) -> Shooting:
    """Return a problem with the caller's extra cost and constraints.

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    assembly, data, states
        Its assembly, recordings and initial states.
    parameters : sequence of Parameter
        Parameters of the structure; fixed ones are numbers in the expressions.
    start : (n_unknowns,) array
        Start, scaled; there the size of each constraint is taken.
    options : FitArguments
        Options with the extra cost and the constraints.

    Raises
    ------
    UsageError
        When a function fails, or returns what is no expression in the parameters and initial states.
    """
    if options.extra_cost is None and options.constraints is None:
        return problem
    theta = [ca.SX.sym(q.name) for q in assembly.free]
    columns = {r.name: ca.SX.sym(f"x0[{r.name}]", problem.n_states) for r in data.records}
    p = Values({q.name: ca.SX(q.start) for q in parameters if q.fixed and q.start is not None})
    p |= {q.name: symbol for q, symbol in zip(assembly.free, theta, strict=True)}
    x0 = {}
    for (name, column), known, released in zip(columns.items(), states.shooting, states.released, strict=True):
        x0[name] = ca.SX(column)[: assembly.n_states]
        for i in map(int, np.flatnonzero(~np.isnan(known))):
            x0[name][i] = ca.SX.sym(f"x0 of the structure in {name}") if released[i] else ca.SX(known[i])
    symbols = ca.vertcat(*theta, *columns.values())
    names = {symbol.name() for symbol in ca.symvar(symbols)}
    cost, limits = ca.SX(0.0), list[tuple[float, ca.SX, float]]()
    if options.extra_cost is not None:
        cost = _expression("extra_cost", _called("extra_cost", options.extra_cost, p, x0), names)
    if options.constraints is not None:
        limits = _limits(_called("constraints", options.constraints, p, x0), names)
    rows = ca.vertcat(*(each for _, each, _ in limits)) if limits else ca.SX(0, 1)
    used = np.flatnonzero(np.array(ca.DM(ca.jacobian_sparsity(ca.vertcat(cost, rows), symbols), 1.0)).any(axis=0))
    v, lam = symbols[used.tolist()] if len(used) else ca.SX(0, 1), ca.SX.sym("lam", rows.numel())
    H, g = ca.hessian(cost, v)
    bent = ca.hessian(ca.dot(lam, rows), v)[0] if limits else ca.SX(len(used), len(used))

    def function(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
        return ca.Function(name, arguments, [ca.densify(each) for each in results], {"cse": True})

    terms = ExtraTerms(
        function("cost", [v], [cost, g, H]),
        function("rows", [v], [rows, ca.jacobian(rows, v)]),
        function("curvature", [v, lam], [bent]),
        used,
        assembly.record_window,
        np.ones(len(limits)),
        np.array([lower for lower, _, _ in limits], float),
        np.array([upper for _, _, upper in limits], float),
        tuple(str(each) for _, each, _ in limits),
    )
    problem = replace(problem, extra=terms)
    size = np.linalg.norm(terms.at(*problem.unpack(start)).slopes * problem.extra_places[1], axis=1)
    size = np.where(np.isfinite(size) & (size > 0), size, 1.0)
    return replace(problem, extra=replace(terms, size=size, lower=terms.lower / size, upper=terms.upper / size))


def _called(what: str, function: Any, p: Values, x0: Mapping[str, ca.SX]) -> Any:
    try:
        return function(p, x0)
    except Exception as error:
        raise UsageError(
            f"{what}(p, x0) failed: {in_one_line(error)}; parameters are p.name or p['name'], the initial state of a "
            f"recording is x0['name'][i]; recordings: {', '.join(x0)}"
        ) from error


def _limits(given: Any, names: set[str]) -> list[tuple[float, ca.SX, float]]:
    """Return the caller's constraints as lower bound, expression and upper bound."""
    limits = []
    for i, row in enumerate(list(given) if isinstance(given, list | tuple) else [given]):
        if not (isinstance(row, tuple | list) and len(row) == 3):
            raise UsageError(f"constraints(p, x0)[{i}] = {row!r}; give (lower, expression, upper)")
        lower, expression, upper = row
        try:
            low, high = float(lower), float(upper)
        except (TypeError, ValueError, RuntimeError, NotImplementedError):
            raise UsageError(f"constraints(p, x0)[{i}]: the bounds {lower}, {upper} must be numbers") from None
        if not low <= high:
            raise UsageError(f"constraints(p, x0)[{i}]: the lower bound {low:g} is above the upper bound {high:g}")
        limits.append((low, _expression(f"constraints(p, x0)[{i}]", expression, names), high))
    return limits


def _expression(what: str, given: Any, names: set[str]) -> ca.SX:
    """Return the caller's terms as one CasADi expression in named unknowns."""
    try:
        expression = ca.SX(given)
    except Exception:
        raise UsageError(f"{what} is {type(given).__name__}, which is no CasADi expression (casadi.SX)") from None
    if expression.shape != (1, 1):
        raise UsageError(f"{what} has shape {expression.shape}; it must be one number")
    if foreign := sorted({symbol.name() for symbol in ca.symvar(expression)} - names):
        raise UsageError(
            f"{what} contains symbols that are no unknowns of the fit: {', '.join(foreign)}; use p and x0 only (the "
            "parameters in place of an initial state that depends on them)"
        )
    return ca.densify(expression)
