"""Universal files of modal analysis (UFF), by pyuff: sets 58, functions at nodes, and 55, data at nodes."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import DataError, nearest
from gbid.core.extras import extra_package
from gbid.recording.readers import OpenFile, StoredArray

UNIVERSAL_ENDINGS = (".uff", ".unv", ".uf")
SPREAD = "standard deviation of the real part, and of the imaginary part"
"""First line of a function with the standard deviations of a frequency response: the format has no type for them."""

_TIME, _RESPONSES, _COHERENCE = 1, (4, 5), 6  # types of functions: of time; FRF and transmissibility; coherence
_OVER_TIME = 17  # what the abscissa is
_AXES = ("", "x", "y", "z", "rx", "ry", "rz")


class PairResponse(NamedTuple):
    """Frequency response from one input to one output.

    Attributes
    ----------
    frequency_hz : (n,) array
        Frequencies [Hz].
    values : (n,) complex array
        The response.
    quality : (n,) array or None
        Standard deviation or coherence.
    """

    frequency_hz: FloatArray
    values: ComplexArray
    quality: FloatArray | None


def read_sets(path: Path, kinds: Sequence[int] = (58,)) -> list[dict[str, Any]]:
    """Return the sets of these kinds, each with the fields of pyuff.

    Raises
    ------
    DataError
        When the file is truncated, damaged, or no universal file.
    UsageError
        When pyuff is not installed.
    """
    pyuff = extra_package("pyuff", "uff", f"{path}: a universal file")
    with path.open("rb") as handle:
        handle.seek(max(0, path.stat().st_size - 200))
        if handle.read().rstrip()[-2:] != b"-1":
            raise DataError(f"{path}: truncated, or no universal file: its last line is not -1; copy it again")
    try:
        file = pyuff.UFF(str(path))
        sets = [file.read_sets(i) for i, kind in enumerate(file.get_set_types().tolist()) if kind in kinds]
    except Exception as error:  # a damaged file can raise any kind of error
        raise DataError(f"{path}: not a readable universal file (damaged or of another format): {error}") from None
    for k, each in enumerate(sets, start=1):
        if each["type"] == 58 and (count := len(each["data"])) < each["num_pts"]:
            raise DataError(f"{path}: function {k} has {count} of {each['num_pts']} points; copy or record it again")
    return sets


def _points(sets: Sequence[Mapping[str, Any]], role: str) -> list[str]:
    """Return the name of the point of each function (`role` rsp) or of its input (ref).

    It is the name of the entity where this has one point only, else node and direction: ``12z``, ``3-x``.
    """
    keys = [f"{role}_ent_name", f"{role}_node", f"{role}_dir"]
    points = [(str(each[keys[0]]).strip(), each[keys[1]], each[keys[2]]) for each in sets]
    of_entity: dict[str, set[tuple[int, int]]] = defaultdict(set)
    for entity, node, direction in points:
        of_entity[entity].add((node, direction))
    names = []
    for entity, node, direction in points:
        axis = _AXES[abs(direction)] if abs(direction) < len(_AXES) else str(abs(direction))
        alone = entity not in ("", "NONE") and len(of_entity[entity]) == 1
        names.append(entity if alone else f"{node}{'-' if direction < 0 else ''}{axis}")
    return names


@contextmanager
def open_universal(path: Path, _names: Sequence[str] | None) -> Iterator[OpenFile]:
    """Return a context with the functions of a universal file over time; `time` where they share their times."""
    sets = read_sets(path)
    for each in sets:
        count = each["num_pts"]
        each["data"], each["x"] = each["data"][:count], each["x"][:count]
    is_time = [each["func_type"] == _TIME or each["abscissa_spec_data_type"] == _OVER_TIME for each in sets]
    points = zip(_points(sets, "rsp"), _points(sets, "ref"), is_time, strict=True)
    names = [output if timed else f"{output} / {source}" for output, source, timed in points]
    count, seen = Counter(names), Counter[str]()
    arrays: dict[str, StoredArray] = {}
    starts: dict[float | None, float] = {}
    for name, each, timed in zip(names, sets, is_time, strict=True):
        seen[name] += 1
        unit = str(each["ordinate_axis_units_lab"]).strip()
        fault = remark = "" if timed else "no function of time; frequency responses are for a fit's responses"
        step = float(each["abscissa_inc"]) if each["abscissa_spacing"] and timed else None
        begin = float(each["x"][0]) if len(each["x"]) else 0.0
        if step is not None and abs(begin - starts.setdefault(step, begin)) > 0.01 * step:
            fault = f"begins at {begin:g} s, another one at {starts[step]:g} s; import them from files of their own"
        key = name if count[name] == 1 else f"{name} #{seen[name]}"
        arrays[key] = StoredArray(each["data"], None if unit in ("", "NONE") else unit, step, fault, remark)
    times = [each["x"] for each, timed in zip(sets, is_time, strict=True) if timed]
    if times and all(np.array_equal(x, times[0]) for x in times):
        arrays.setdefault("time", StoredArray(times[0], "s"))

    def get(name: str) -> StoredArray:
        if name not in arrays:
            raise DataError(f"{path}: no function {name!r}; {nearest(name, arrays)}")
        return arrays[name]

    yield OpenFile(get, lambda: iter(arrays.items()))


def read_responses(path: Path) -> tuple[dict[tuple[str, str], PairResponse], bool]:
    """Return the frequency responses of a universal file by output and input, and whether they come with coherence.

    Raises
    ------
    DataError
        When the file is damaged, or has no frequency responses, or has one twice.
    UsageError
        When pyuff is not installed.
    """
    sets = read_sets(path, (55, 58))
    functions = [each for each in sets if each["type"] == 58]
    pairs = list(zip(_points(functions, "rsp"), _points(functions, "ref"), strict=True))
    responses: dict[tuple[str, str], PairResponse] = {}
    spreads: dict[tuple[str, str], FloatArray] = {}
    coherences: dict[tuple[str, str], FloatArray] = {}
    for pair, each in zip(pairs, functions, strict=True):
        data = np.asarray(each["data"])[: each["num_pts"]]
        if each["func_type"] in _RESPONSES:
            if pair in responses:
                raise DataError(f"{path}: has the response of {pair[0]} to {pair[1]} twice; keep one of the two")
            responses[pair] = PairResponse(np.asarray(each["x"])[: len(data)], data.astype(complex), None)
        elif each["func_type"] == _COHERENCE:
            coherences[pair] = data.real
        elif each["id1"] == SPREAD:
            spreads[pair] = data.real
    responses |= _at_nodes([each for each in sets if each["type"] == 55 and "freq" in each])
    if not responses:
        raise DataError(f"{path}: holds no frequency responses (functions 4 of sets 58, or sets 55 over frequency)")
    quality = spreads if spreads.keys() >= responses.keys() else coherences
    if not all(pair in quality and len(quality[pair]) == len(each.values) for pair, each in responses.items()):
        return responses, False
    whole = {pair: each._replace(quality=quality[pair]) for pair, each in responses.items()}
    return whole, quality is coherences


def _at_nodes(sets: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], PairResponse]:
    """Return the responses in sets 55, each of which has all nodes at one frequency; the input is the load case."""
    points: dict[tuple[str, str], list[tuple[float, complex]]] = defaultdict(list)
    for each in sets:
        if each["analysis_type"] != 5:
            continue
        for k, axis in enumerate(_AXES[1:], start=1):
            for node, value in zip(each["node_nums"], each.get(f"r{k}", ()), strict=False):
                points[f"{int(node)}{axis}", f"load{each['load_case']}"].append((each["freq"], value))
    measured = {pair: np.array(sorted(values, key=lambda p: p[0])) for pair, values in points.items()}
    return {pair: PairResponse(t[:, 0].real, t[:, 1], None) for pair, t in measured.items() if t[:, 1].any()}
