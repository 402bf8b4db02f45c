"""Fuzz targets of recordings of other programs: loggers, units, mappings with calibrations, links of HDF5 files.

What an accepted input must give is computed here again; where it differs, the read raises a `WrongError`, which counts
as a traceback.
"""

from __future__ import annotations

import io
import re
import tempfile
import wave
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np

import gbid
from fuzzing.byte_mutations import mutate_bytes
from fuzzing.hdf5_mutations import mutate_hdf5
from fuzzing.text_mutations import mutate_text, mutate_tree
from gbid.core.errors import DataError, GbidError
from gbid.core.yaml_file import read_yaml
from gbid.experiment.draft import DraftOptions, draft_experiment
from gbid.export.data_files import save_data
from gbid.recording.importing import list_channels

_N = 60
_COLUMNS = {
    "t": 1e-3 * np.arange(_N),
    "a": np.random.default_rng(1).normal(size=_N),
    "b": np.random.default_rng(2).normal(size=_N),
}
_SECRET = 1e3 + np.arange(40.0)


class WrongError(Exception):
    """Numbers that an input does not contain."""


def _same(path: Path, found: Any, expected: Any) -> None:
    if not np.allclose(found, expected, rtol=1e-6, atol=0, equal_nan=True):
        raise WrongError(f"{path}: read {found}, expected {expected}")


# ---- Units in headings: those of length that are accepted must be on this list.

_LENGTHS = {
    "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "cm": 1e-2, "km": 1e3, "Mm": 1e6, "mil": 25.4e-6,
    "mils": 25.4e-6, "thou": 25.4e-6, "in": 0.0254, "inch": 0.0254, "micron": 1e-6, "Zoll": 0.0254, "ft": 0.3048,
    "metre": 1.0,
}  # fmt: skip
_ODD_UNITS = (
    *("grad", "m**9**9**9**9", "mil pp", "1/s", "m/s/s", "m^-1", "m^0", "m^1", "m*1", "(m)", "m m/m", "m/", "/m", "Mm"),
    *(
        "mM",
        "MIL",
        "Mils",
        "M",
        "S",
        "m²/m",
        "kgm",
        "m" * 70,
        "m^99",
        "°",
        "%",
        "µ",
        "u",
        "um pp",
        "um RMS",
        "V",
    ),
)


def _unit_csv(random: Random | None, _content: bytes) -> bytes:
    unit = random.choice((*_LENGTHS, *_ODD_UNITS)) if random else "um"
    for _ in range(random.choice((0, 0, 0, 1, 2)) if random else 0):
        assert random is not None
        sign = random.choice(("", " ", "*", "/", "^", "**", "·", "-", ".", "(", ")", "²"))
        unit = sign.join(random.sample((unit, random.choice((*_LENGTHS, "s", "1", "2", "9", "Hz"))), 2))
    rows = "\n".join(f"{k * 1e-3:.3f},{k % 7 + 1}" for k in range(_N))
    return f"t,a [{unit}]\n{rows}\n".encode()


def _read_units(path: Path) -> tuple[Any, tuple[str, ...]]:
    mapping = {"time": "t", "signals": {"p": {"columns": ["a"]}}}
    rec = gbid.import_recording(path, mapping)
    unit = path.read_text(encoding="utf-8").partition("[")[2].partition("]\n")[0].strip()
    word = unit.removesuffix("^1").removesuffix("*1").strip("() ")
    ratio = rec.signals["p"][0, 0] / float(path.read_text(encoding="utf-8").split("\n")[1].split(",")[1])
    known = _LENGTHS.get(word, _LENGTHS.get(word.lower() if len(word) > 2 else ""))
    if known is None:
        known = _product(word)
    if known is None:
        raise WrongError(f"{path}: {unit!r} is no unit of length, and was read as {ratio} m")
    _same(path, ratio, known)
    return rec, ()


_ITEM = re.compile(r"([^\W\d_²]+|1|%)(?:(?:\^|\*\*)?(-?\d)|(²))?")


def _product(text: str) -> float | None:
    """Return the factor of a product of lengths, seconds and their powers that is a length; None for anything else."""
    above, slash, below = text.partition("/")
    factor, lengths, seconds = 1.0, 0, 0
    for part, sign in ((above, 1), (below, -1)) if slash else ((above, 1),):
        for item in re.split(r"[\s*·]+", part.replace("**", "^").strip(" ()")):
            match = _ITEM.fullmatch(item)
            if match is None or (match[1] not in _LENGTHS and match[1] not in ("s", "Hz", "1", "%")):
                return None
            power = sign * int(match[2] or (2 if match[3] else 1))
            factor *= {**_LENGTHS, "%": 0.01}.get(match[1], 1.0) ** power
            lengths += power * (match[1] in _LENGTHS)
            seconds += power * {"s": 1, "Hz": -1}.get(match[1], 0)
    return factor if (lengths, seconds) == (1, 0) else None


# ---- Mappings with calibrations, applied to one file.

_MAPPING = b"""\
time: t
signals:
  y: {columns: [a, b], unit: m, scale: 2.5, offset: [0.5, -1.0]}
  z: {columns: [a], unit: um, stored_unit: m, calibration: {points: [[-3, -1], [0, 0], [3, 2]]}}
  v: {columns: b, unit: V, scale: -0.1}
  w: {columns: [a, b], unit: mm, stored_unit: m}
"""


def _read_mapping(path: Path) -> tuple[Any, tuple[str, ...]]:
    data = read_yaml(path).data
    try:
        rec = gbid.import_recording(path.with_suffix(".csv"), data)
    except GbidError as error:  # about the mapping of another file
        raise type(error)(f"{path}: {error}") from None
    if {"samples", "from_s", "to_s", "piece"} & set(data) or not isinstance(rec.sample_time, float):
        return rec, ()
    for name, signal in data["signals"].items():
        columns = [signal["columns"]] if isinstance(signal["columns"], str) else signal["columns"]
        factor = {"um": 1e-6, "mm": 1e-3}.get(signal.get("unit"), 1.0) if rec.units[name] == "m" else None
        if (
            factor is None
            or rec.units[name] != signal.get("stored_unit", "m")
            or signal.get("unit") not in ("m", "um", "mm")
        ):
            continue
        for k, column in enumerate(columns):
            raw = _COLUMNS[column]
            given = signal.get("calibration")
            each = given[k] if isinstance(given, list) else given
            if each:
                x, y = np.array(sorted(map(tuple, each["points"])), float).T
                inside = (raw >= x[0]) & (raw <= x[-1])
                _same(path, rec.signals[name][inside, k], factor * np.interp(raw[inside], x, y))
            else:
                a, b = (_each(signal.get(key), k, neutral) for key, neutral in (("scale", 1.0), ("offset", 0.0)))
                found, expected = rec.signals[name][:, k], factor * (a * raw + b)
                if not np.allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max()):
                    raise WrongError(f"{path}: {name}, {column}: {found[:2]}, expected {expected[:2]}")
    return rec, ()


def _each(value: Any, k: int, neutral: float) -> float:
    return neutral if value is None else float(value[k] if isinstance(value, list) else value)


# ---- Links of HDF5 files: the numbers of a private file must not come back.


@cache
def _private() -> Path:
    """Return a folder with a private HDF5 file and its bytes; it is there until the process ends."""
    folder = tempfile.TemporaryDirectory(prefix="gbid-private-")
    _private_folders.append(folder)
    with h5py.File(Path(folder.name) / "s.h5", "w") as file:
        file["a"] = _SECRET
        file["g/b"] = _SECRET
    (Path(folder.name) / "s.bin").write_bytes(_SECRET.tobytes())
    return Path(folder.name)


_private_folders: list[tempfile.TemporaryDirectory[str]] = []


def _linked(random: Random, _content: bytes) -> bytes:
    """Return an HDF5 file whose columns are found by links to files beside it, elsewhere and nowhere."""
    memory = io.BytesIO()
    elsewhere, temporary = _private(), Path(tempfile.gettempdir())
    folders = (elsewhere, f"../{elsewhere.name}", f"./..//{elsewhere.name}/.", f"{elsewhere}/../{elsewhere.name}")
    ways = (
        *(f"{folder}/s.{{}}" for folder in (*folders, temporary / elsewhere.name)),
        *("a.other", "./a.other", ".", "", "none.{}", "/etc/passwd", "/dev/zero", "%b.{}", "../a.{}", "\\", "a.h5"),
    )
    with h5py.File(memory, "w") as file:
        file["t"] = _COLUMNS["t"][:40]
        for name in ("a", "b"):
            way = random.choice(ways).format(random.choice(("h5", "bin")))
            inner = random.choice(("a", "/a", "g/b", "/", "t", ".", "../a"))
            kind = random.randrange(5)
            if kind in (2, 3) and (not way or "%" in way):  # h5py writes no such names
                kind = 0
            if kind == 0:
                file[name] = h5py.ExternalLink(way or ".", inner)
            elif kind == 1:
                file[f"{name}_"] = h5py.ExternalLink(way or ".", random.choice(("/", "g")))
                file[name] = h5py.SoftLink(f"{name}_/{inner}")
            elif kind == 2:
                size = random.choice((320, 1 << 40, h5py.h5f.UNLIMITED))
                file.create_dataset(name, (40,), "f8", external=[(way, random.choice((0, 8, 1 << 50)), size)])
            elif kind == 3:
                layout = h5py.VirtualLayout((40,), "f8")
                layout[:] = h5py.VirtualSource(way, inner, (40,))
                file.create_virtual_dataset(name, layout)
            else:
                file[name] = h5py.SoftLink(random.choice(("/t", "/a", "/b", "a/b", "t/a", "/none")))
    content = memory.getvalue()
    return content if random.randrange(3) else mutate_bytes(random, content)


def _read_linked(path: Path) -> tuple[Any, tuple[str, ...]]:
    for channel in _listed(path):
        if set(channel.first) & set(_SECRET):
            raise WrongError(f"{path}: {channel.name} has numbers of a private file")
    rec = gbid.import_recording(path, {"sample_time": 1e-3, "signals": {"y": {"columns": ["a", "b"], "unit": "m"}}})
    if set(rec.signals["y"].flat) & set(_SECRET):
        raise WrongError(f"{path}: has numbers of a private file")
    return rec, ()


def _listed(path: Path) -> list[Any]:
    try:
        return list_channels(path)
    except GbidError as error:
        if path.name not in str(error):
            raise WrongError(f"{path}: the error does not name the file: {error}") from None
        if "time-out" in str(error):  # an import takes as long again
            raise
        return []


# ---- Files of loggers, of the libraries that are installed.


def _tdms() -> bytes:
    from nptdms import ChannelObject, TdmsWriter

    memory = io.BytesIO()
    properties = {"wf_increment": 1e-3, "wf_start_offset": 0.0, "unit_string": "m"}
    scale = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Slope": 2.0}
    scale |= {"NI_Scale[0]_Linear_Y_Intercept": 0.5, "NI_Scaling_Status": "unscaled"}
    with TdmsWriter(memory) as writer:
        writer.write_segment([ChannelObject("g", name, _COLUMNS[name], properties | scale) for name in ("a", "b")])
    return memory.getvalue()


def _mf4() -> bytes:
    from asammdf import MDF, Signal

    with tempfile.TemporaryDirectory() as folder, MDF(version="4.10") as file:
        file.append([Signal(_COLUMNS[name], _COLUMNS["t"], name=name, unit="m") for name in ("a", "b")])
        return Path(file.save(Path(folder) / "a.mf4")).read_bytes()


def _uff() -> bytes:
    rec = gbid.Recording({name: _COLUMNS[name] for name in ("a", "b")}, 1e-3, units={"a": "m", "b": "m"})
    with tempfile.TemporaryDirectory() as folder:
        save_data(rec, Path(folder) / "a.uff")
        return (Path(folder) / "a.uff").read_bytes()


def _wav() -> bytes:
    memory = io.BytesIO()
    with wave.open(memory, "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(2)
        file.setframerate(1000)
        file.writeframes((1000 * np.column_stack([_COLUMNS["a"], _COLUMNS["b"]])).astype("<i2").tobytes())
    return memory.getvalue()


_RESPONSES = "frequency_hz,magnitude,phase_deg,magnitude_std\n" + "".join(
    f"{f},{1 / f:.6g},{-f:.4g},0.01\n" for f in range(1, 40)
)


def _mat73() -> bytes:
    """Return a MATLAB file of version 7.3: an HDF5 file behind 512 bytes of text."""
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=512) as file:
        for name, column in _COLUMNS.items():
            file[name] = column[None]
            file[name].attrs["MATLAB_class"] = np.bytes_(b"double")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM"
    return head.ljust(512, b"\0") + memory.getvalue()[512:]


# ---- Large files, folders, and the doors of Python.


def _oversized_text(random: Random, content: bytes) -> bytes:
    """Return a text of many columns, rows, signs or headers."""
    many = random.choice((3_000, 9_000, 200_000))
    row = ",".join(["1.5"] * many)
    return random.choice((
        lambda: f"{','.join(f'c{i}' for i in range(many))}\n{row}\n{row}\n".encode(),
        lambda: content * (many // 1000),
        lambda: content + b"9" * 10 * many + b"," + b"1" * many,
        lambda: content + b'"' * many + b"\n",
        lambda: b"# note\n" * many + content,
        lambda: b"name,value\n" * many + content,
        lambda: content.replace(b"\n", b"," * (many // 1000) + b"\n"),
        lambda: b"a;b\tc, d\n" * many,
        lambda: b"t,a,b\n" + b"0.001,nan,\n" * many,
    ))()  # fmt: skip


def _oversized_hdf5(random: Random, _content: bytes) -> bytes:
    """Return an HDF5 file of many or nested entries, or with sizes that are only stated."""
    memory, many = io.BytesIO(), random.choice((300, 3000, 6000))
    with h5py.File(memory, "w") as file:
        file["t"] = _COLUMNS["t"]
        kind = random.randrange(5)
        if kind == 0:
            for i in range(many):
                file[f"d{i}"] = float(i)
        elif kind == 1:
            file["/".join(["g"] * min(many, 3000)) + "/a"] = _COLUMNS["a"]
        elif kind == 2:
            file.create_dataset("a", (1 << random.choice((30, 36, 40)),), "f8", chunks=(1 << 16,), compression="gzip")
        elif kind == 3:
            file["a"] = _COLUMNS["a"]
            for i in range(min(many, 800)):
                file["a"].attrs[f"n{i}"] = "x" * 50
        else:
            file["a"], file["b"] = np.zeros(many * 300), np.zeros((many, 30))
    return memory.getvalue()


def _moving(seed: int) -> bytes:
    """Return a csv file of r, u and p that move, and where u follows r."""
    random = np.random.default_rng(seed)
    r = 4 * np.repeat(random.choice([-1.0, 1.0], (60, 2)), 10, axis=0)
    noise = random.normal(size=(600, 4))
    columns = np.column_stack([1e-3 * np.arange(600), r, 0.9 * r + 0.01 * noise[:, :2], 0.5 * r + 0.1 * noise[:, 2:]])
    heads = ",".join(f"{signal}_{axis} [um]" for signal in "rup" for axis in "xy")
    text = io.StringIO()
    np.savetxt(text, columns, "%.6g", ",", comments="", header=f"t [s],{heads}")
    return text.getvalue().encode()


def _read_folder(path: Path) -> tuple[Any, tuple[str, ...]]:
    """Draft an experiment from a folder with the file and two good ones."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed in (1, 2):
            (folder / f"good{seed}.csv").write_bytes(_moving(seed))
        (folder / path.name).write_bytes(path.read_bytes())
        options = DraftOptions(folder, pressure_bar=6.0, speed_rpm=0.0, skip_broken=len(path.read_bytes()) % 2 == 0)
        try:
            return len(draft_experiment(options, folder / "new").text), ()
        except GbidError as error:
            raise DataError(f"{path}: {error}") from None


def _odd_values(random: Random) -> Any:
    """Return a value that a caller may hand over by mistake, or to do harm."""
    circle: dict[str, Any] = {}
    circle["a"], ring, deep = circle, [1.0], []
    ring.append(ring)
    for _ in range(3000):
        deep = [deep]
    table = {"columns": ["a"], "unit": "m"}
    values = (
        *(None, True, 0, -1, 10**400, np.nan, np.inf, "", "a" * 10**6, "\x1b[31m", b"a", object(), len),
        *(circle, ring, deep, np.zeros(0), np.zeros((2, 2, 2)), np.array(["a"]), np.arange(5) + 1j, np.float32(1)),
        *([], {}, (), {"": 1}, [None]),
        *({1: 2}, table, {"y": table}, [table], {"columns": "a", "scale": ring}, range(10**9), Path(), {"a": circle}),
    )  # fmt: skip
    return random.choice(values)


def _read_python(path: Path) -> tuple[Any, tuple[str, ...]]:
    """Call a door of Python with odd values that follow from the file."""
    import pandas as pd

    random, table = Random(path.read_bytes()), path.with_suffix(".csv")
    mapping: dict[str, Any] = {"time": "t", "signals": {"y": {"columns": ["a", "b"], "unit": "m"}}}
    keys = (
        "time",
        "signals",
        "sample_time",
        "conditions",
        "samples",
        "axis",
        "from_s",
        "piece",
        "gaps",
        "decimal",
        "name",
    )
    frame = pd.DataFrame(_COLUMNS)
    if path.read_bytes() == b"good":
        return gbid.import_recording(table, mapping), ()
    try:
        match random.randrange(5 if find_spec("xarray") else 4):
            case 0:
                mapping[random.choice((*keys, "x"))] = _odd_values(random)
            case 1:
                key = random.choice(
                    ("columns", "unit", "stored_unit", "scale", "offset", "calibration", "channels", "hold")
                )
                mapping["signals"]["y"][key] = _odd_values(random)
            case 2:
                given = {
                    "sample_time": 1e-3,
                    random.choice(("signals", "time", "units", "conditions", "name")): _odd_values(random),
                }
                return gbid.Recording.from_frame(frame, **given), ()
            case 3:
                given = {"signals": {"y": _COLUMNS["a"]}, "sample_time": 1e-3}
                given[random.choice(("signals", "sample_time", "conditions", "units", "channels", "provenance"))] = (
                    _odd_values(random)
                )
                return gbid.Recording(**given), ()
            case _:
                dataset = gbid.Recording({"y": _COLUMNS["a"]}, 1e-3, units={"y": "m"}).to_xarray()
                dataset.attrs[random.choice(("sample_time", "conditions", "provenance", "name", "x"))] = _odd_values(
                    random
                )
                if random.randrange(2):
                    dataset["y"].attrs["units"] = _odd_values(random)
                return gbid.Recording.from_xarray(dataset), ()
        return gbid.import_recording(table, mapping), ()
    except GbidError as error:
        raise type(error)(f"{path}: {error}") from None


def _number(random: Random, _content: bytes) -> bytes:
    return str(random.random()).encode()


def _import(*columns: str, unit: str = "m", time: str | None = None) -> Callable[[Path], tuple[Any, tuple[str, ...]]]:
    mapping: Mapping[str, Any] = {"time": time, "signals": {"y": {"columns": list(columns), "unit": unit}}}
    return lambda path: ((list_channels(path), gbid.import_recording(path, mapping)), ())


def door_targets() -> Iterator[
    tuple[str, str, bytes, Callable[[Path], Any], Callable[[Random, bytes], bytes], int, Any]
]:
    """Yield name, ending, a good file, how it is read, its mutations, its weight, and further files beside it."""
    table = "t,a,b\n" + "".join(f"{t:.3f},{a:.9g},{b:.9g}\n" for t, a, b in zip(*_COLUMNS.values(), strict=True))
    good, other = io.BytesIO(), io.BytesIO()
    with h5py.File(good, "w") as file:
        for name in ("t", "a", "b"):
            file[name] = _COLUMNS[name][:40]
    with h5py.File(other, "w") as file:
        file["a"], file["g/b"] = _COLUMNS["a"][:40], _COLUMNS["b"][:40]
    yield "units", ".csv", _unit_csv(None, b""), _read_units, _unit_csv, 12, {}
    yield "mapping, applied", ".yaml", _MAPPING, _read_mapping, mutate_tree, 20, {".csv": table.encode()}
    yield "HDF5 links", ".h5", good.getvalue(), _read_linked, _linked, 20, {".other": other.getvalue()}
    responses = lambda path: (gbid.FrequencyData.read(path), ())  # noqa: E731
    yield "responses", ".csv", _RESPONSES.encode(), responses, mutate_text, 6, {}
    yield "wav", ".wav", _wav(), _import("data[0]", "data[1]", unit="1"), mutate_bytes, 4, {}
    yield "mat 7.3, entries", ".mat", _mat73(), _import("a", "b", time="t"), mutate_hdf5, 3, {}
    yield "oversized text", ".csv", table.encode(), _import("a", "b", time="t"), _oversized_text, 2, {}
    yield "oversized HDF5", ".h5", good.getvalue(), _import("a", "b", time="t"), _oversized_hdf5, 2, {}
    yield "folder", ".csv", _moving(0), _read_folder, mutate_text, 2, {}
    yield "Python", ".txt", b"good", _read_python, _number, 12, {".csv": table.encode()}
    for name, ending, made, columns in (
        ("tdms", ".tdms", _tdms, ("a", "b")),
        ("mdf", ".mf4", _mf4, ("a", "b")),
        ("universal", ".uff", _uff, ("a", "b")),
        ("mat 7.3", ".mat", _mat73, ("a", "b")),
    ):
        try:
            content = made()
        except ImportError:
            continue
        read = _import(*columns, time="t" if ending == ".mat" else None)
        yield name, ending, content, read, mutate_text if name == "universal" else mutate_bytes, 6, {}
