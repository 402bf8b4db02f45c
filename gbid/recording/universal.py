"""Universal files of modal analysis (UFF), by pyuff: dataset 58 (functions) and dataset 55 (data at nodes)."""

from __future__ import annotations

import mmap
import re
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, nearest
from gbid.core.extras import extra_package
from gbid.recording.columns import numbered_twins
from gbid.recording.mapping import FilePart
from gbid.recording.readers import ALL, SPREAD, OpenFile, PairResponse, StoredArray, StoredReader, rows_of

_TIME, _RESPONSES, _COHERENCE = 1, (4, 5), 6  # types of functions: of time; FRF and transmissibility; coherence
_OVER_TIME = 17  # what the abscissa is
_AXES = ("", "x", "y", "z", "rx", "ry", "rz")


_MARK = re.compile(rb"    -1 *(?=\r?\n|\r?\Z)")  # before and after each set
_PER_LINE = {(2, 1): 6, (2, 0): 3, (4, 1): 4, (4, 0): 2, (5, 1): 3, (5, 0): 2, (6, 1): 2, (6, 0): 1}
"""Points in a line of text, by type of the ordinate (single, double, both complex) and even spacing."""


class _FunctionSet(NamedTuple):
    """Dataset 58 in a file: header lines, position of the numbers, and their format (binary or lines)."""

    head: bytes
    begin: int
    end: int
    point_bytes: int
    per_line: int

    def cut(self, data: Any, rows: slice) -> tuple[bytes, int]:
        """Return the dataset with selected points, and how many earlier points its first line contains."""
        first, stop = rows.start or 0, rows.stop
        begin, end, skipped = self.begin, self.end, first
        if self.point_bytes:
            end = end if stop is None else min(end, begin + stop * self.point_bytes)
            begin, skipped = begin + first * self.point_bytes, 0
        elif (length := data.find(b"\n", begin) + 1 - begin) > 0:
            line = first // self.per_line
            at = begin + line * length
            if at == begin or (at < end and data[at - 1 : at] == b"\n"):  # else lines have several lengths
                last = end if stop is None else begin + -(-stop // self.per_line) * length
                begin, end, skipped = at, min(end, last), first - line * self.per_line
        numbers = data[begin:end]
        at_end = b"" if self.point_bytes or numbers.endswith(b"\n") else b"\n"
        return self.head + numbers + at_end + b"    -1\n", skipped


def _blocks(path: Path, data: Any) -> Iterator[_FunctionSet]:
    """Yield the datasets 58 of a file mapped into memory."""
    mark, k = _MARK.search(data), 0
    while mark:
        lines, at = list[bytes](), mark.start()
        while len(lines) < 13 and not (len(lines) == 2 and lines[1][:6].strip() != b"58"):
            stop = data.find(b"\n", at) + 1 or len(data)
            lines, at = [*lines, data[at:stop]], stop
        begin, point_bytes, per_line = at, 0, 0
        if len(lines) == 13:
            order, points, even = (int(lines[8][k : k + 10]) for k in (0, 10, 20))
            numbers, per_line = 1 + (order > 4) + (not even), _PER_LINE[order, int(even == 1)]
            point_bytes = (4 if order in (2, 5) else 8) * numbers * (lines[1][6:7].lower() == b"b")
            at += points * point_bytes
        end = _MARK.search(data, min(at, len(data)))
        if end is None:
            raise DataError(f"{path}: truncated, or no universal file: a set has no end; copy it again")
        if len(lines) == 13:
            k += 1
            length = data.find(b"\n", begin) + 1 - begin
            if not point_bytes and (count := -(-(end.start() - begin) // length) * per_line) < points:
                raise DataError(f"{path}: function {k} has {count} of {points} points; copy or record it again")
            yield _FunctionSet(b"".join(lines), begin, end.start(), point_bytes, per_line)
        mark = _MARK.search(data, end.end())


def read_rows(path: Path, rows: slice, chosen: Sequence[int] | None = None) -> list[dict[str, Any]]:
    """Return functions (datasets 58: all, or selected ones) with selected points; see `read_sets`.

    The values of a function are in ``data``, its times in ``x``; ``num_pts`` counts all of its points.
    """
    pyuff = extra_package("pyuff", "uff", f"{path}: a universal file")
    _check_end(path)
    with path.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
        blocks = [block for k, block in enumerate(_blocks(path, data)) if chosen is None or k in chosen]
        parts = [block.cut(data, rows) for block in blocks]
    with tempfile.TemporaryDirectory() as folder:
        short = Path(folder) / "rows.uff"
        short.write_bytes(b"".join(part for part, _ in parts))
        sets = _sets(pyuff, short, path)
    for each, (_, skipped) in zip(sets, parts, strict=True):
        first = rows.start or 0
        count = max(min(each["num_pts"] if rows.stop is None else rows.stop, each["num_pts"]) - first, 0)
        each["data"], each["x"] = (each[key][skipped : skipped + count] for key in ("data", "x"))
        if len(each["data"]) < count:
            found = first + len(each["data"])
            raise DataError(f"{path}: a function has {found} of {each['num_pts']} points; copy or record it again")
        if each["abscissa_spacing"]:
            each["x"] = each["abscissa_min"] + each["abscissa_inc"] * np.arange(first, first + count)
    return sets


def read_sets(path: Path, kinds: Sequence[int]) -> list[dict[str, Any]]:
    """Return the datasets of given kinds, with the fields of pyuff.

    Raises
    ------
    DataError
        When the file is truncated, damaged, or no universal file.
    UsageError
        When pyuff is not installed.
    """
    pyuff = extra_package("pyuff", "uff", f"{path}: a universal file")
    _check_end(path)
    sets = [each for each in _sets(pyuff, path, path) if each["type"] in kinds]
    for k, each in enumerate(sets, start=1):
        if each["type"] == 58 and (count := len(each["data"])) < each["num_pts"]:
            raise DataError(f"{path}: function {k} has {count} of {each['num_pts']} points; copy or record it again")
    return sets


def _sets(pyuff: Any, file: Path, path: Path) -> list[dict[str, Any]]:
    """Return the datasets in a file or a part of it; `path` is for messages."""
    try:
        opened = pyuff.UFF(str(file))
        return [opened.read_sets(i) for i, kind in enumerate(opened.get_set_types().tolist()) if kind in (55, 58)]
    except Exception as error:  # a damaged file can raise any kind of error
        raise DataError(f"{path}: not a readable universal file (damaged or of another format): {error}") from None


def _check_end(path: Path) -> None:
    with path.open("rb") as handle:
        handle.seek(max(0, path.stat().st_size - 200))
        if handle.read().rstrip()[-2:] != b"-1":
            raise DataError(f"{path}: truncated, or no universal file: its last line is not -1; copy it again")


def _points(sets: Sequence[Mapping[str, Any]], role: str) -> list[str]:
    """Return the point name of each function's output (`role` rsp) or input (ref).

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
    """Return a context with the time functions of a universal file, and their common `time` if equal."""
    sets = read_rows(path, slice(0, 1))
    is_time = [each["func_type"] == _TIME or each["abscissa_spec_data_type"] == _OVER_TIME for each in sets]
    points = zip(_points(sets, "rsp"), _points(sets, "ref"), is_time, strict=True)
    names = numbered_twins([output if timed else f"{output} / {source}" for output, source, timed in points])
    known = {name: k for k, name in enumerate(names)}
    over_time = [k for k, timed in enumerate(is_time) if timed]

    def get(name: str, part: FilePart = ALL) -> StoredArray:
        rows, first = rows_of(part)
        if name == "time" and name not in known and (shared := times(rows)) is not None:
            return StoredArray(shared, "s", first=first, total=sets[over_time[0]]["num_pts"])
        if name not in known:
            raise DataError(f"{path}: no function {name!r}; {nearest(name, known)}")
        each = sets[known[name]]
        unit: str | None = str(each["ordinate_axis_units_lab"]).strip()
        timed = is_time[known[name]]
        fault = remark = "" if timed else "no function of time; frequency responses are for a fit's responses"
        step = float(each["abscissa_inc"]) if each["abscissa_spacing"] and timed else None
        start = None if step is None else round(1e9 * float(each["abscissa_min"]))
        (read,) = read_rows(path, rows, [known[name]])
        unit = None if unit in ("", "NONE") else unit
        return StoredArray(read["data"], unit, step, fault, remark, first, each["num_pts"], start_ns=start)

    def times(rows: slice) -> FloatArray | None:
        """Return the times common to all functions; None if they differ."""
        keys = ("num_pts", "abscissa_spacing", "abscissa_min", "abscissa_inc")
        if len({tuple(sets[k][key] for key in keys) for k in over_time}) != 1:
            return None
        head = sets[over_time[0]]
        if head["abscissa_spacing"]:
            return np.asarray(head["abscissa_min"] + head["abscissa_inc"] * np.arange(head["num_pts"])[rows], float)
        first, *others = [each["x"] for each in read_rows(path, rows, over_time)]
        return first if all(np.array_equal(first, x) for x in others) else None

    def every() -> Iterator[tuple[str, StoredReader]]:
        yield from ((name, partial(get, name)) for name in known)
        if "time" not in known and (shared := times(slice(None))) is not None:
            yield "time", lambda: StoredArray(shared, "s")

    yield OpenFile(get, every)


def read_responses(path: Path) -> tuple[dict[tuple[str, str], PairResponse], bool]:
    """Return the frequency responses in a universal file by output and input, and whether they have coherence.

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
    """Return the responses in datasets 55 (all nodes at one frequency each); the load case is the input."""
    points: dict[tuple[str, str], list[tuple[float, complex]]] = defaultdict(list)
    for each in sets:
        if each["analysis_type"] != 5:
            continue
        for k, axis in enumerate(_AXES[1:], start=1):
            for node, value in zip(each["node_nums"], each.get(f"r{k}", ()), strict=False):
                points[f"{int(node)}{axis}", f"load{each['load_case']}"].append((each["freq"], value))
    measured = {pair: np.array(sorted(values, key=lambda p: p[0])) for pair, values in points.items()}
    return {pair: PairResponse(t[:, 0].real, t[:, 1], None) for pair, t in measured.items() if t[:, 1].any()}
