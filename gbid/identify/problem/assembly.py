"""Assembly of a fit from recordings and options: parts, links, and shared parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, NamedTuple

from gbid.arrays import BoolArray, IntArray
from gbid.discretise import Hold
from gbid.errors import DataError, UsageError
from gbid.identify.data import FitData, Record
from gbid.identify.disturbances.disturbances import UNDISTURBED, Disturbances
from gbid.identify.kernel.blocks import LANES
from gbid.identify.kernel.engine import EngineName, RunEngine
from gbid.identify.kernel.general_predictor import GeneralPredictor
from gbid.identify.nlp.record_group import RecordGroup
from gbid.identify.predictor import Focus, Predictor, with_spare_states
from gbid.identify.problem.either_kind import any_predictor
from gbid.identify.problem.segments import GroupBuilder, Stretch, in_pieces, links_of, record_windows, stretches
from gbid.identify.problem.ties import Ties, tie_of
from gbid.operating_point import point_label
from gbid.structure import AnyStructure, Parameter

Scope = Literal["recording", "operating_point"]
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
    horizon: int,
    local: Mapping[str, Scope],
    left_out: Mapping[str, Sequence[tuple[int, int]]],
    window: int | None,
    engine: EngineName,
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
        built = any_predictor(
            models[model].structure,
            held,
            begin,
            data.sample_time,
            models[model].intersample,
            kind,
            disturbances=disturbances,
            horizon=horizon,
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
    builder = GroupBuilder(window, begin, engine)
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
