"""What is fuzzed: files that gbid writes and files of other programs, how each is read, and its mutations."""

from __future__ import annotations

import io
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import casadi as ca
import h5py
import numpy as np
import stored_values
from fit_cases import MODE, MODE_AT, levels, simulated
from gain_problems import oscillator
from scipy.io import savemat

import gbid
from fuzzing.byte_mutations import flip_bits, mutate_bytes, overwrite
from fuzzing.hdf5_mutations import mutate_hdf5
from fuzzing.logger_targets import door_targets
from fuzzing.text_mutations import mutate_text, mutate_tree
from fuzzing.zip_mutations import mutate_npz
from gbid import load, save
from gbid.control import HalfSine
from gbid.control.assessment import TunedDesign
from gbid.core.errors import ChangedFileWarning, GbidError
from gbid.core.files import is_changed, share_folder, with_checksum, with_text_checksum
from gbid.core.tables import csv_text, plain_table
from gbid.core.yaml_file import read_yaml, write_yaml
from gbid.experiment.load import load_experiment
from gbid.lpv import load_model, save_model
from gbid.recording import ImportMapping
from gbid.recording.importing import list_channels, peek
from gbid.validate import load_actuators
from gbid.validate.central import ACTUATORS_KIND

_MAPPING = {"sample_time": 1e-3, "signals": {"y": {"columns": ["a", "b"], "unit": "m"}}}


class FileOrigin(Enum):
    """Who wrote a file: it decides what a changed value means."""

    OWN = "gbid"  # has a checksum: a change must be noticed
    CRAFTED = "gbid, entries changed and checksum made anew"
    SEALED = "other programs, with checksums"
    FOREIGN = "other programs"


class FuzzTarget(NamedTuple):
    """One kind of file.

    Attributes
    ----------
    name, ending : str
    origin : FileOrigin
    content : bytes
        A good file.
    read : callable
        Function from the path to the value and the notes about it.
    mutate : callable
        Function from a random generator and bytes to other bytes.
    weight : int
        Share of the inputs.
    beside : dict of str to bytes
        Further files in the folder, by ending.
    """

    name: str
    ending: str
    origin: FileOrigin
    content: bytes
    read: Callable[[Path], tuple[Any, tuple[str, ...]]]
    mutate: Callable[[Random, bytes], bytes]
    weight: int = 1
    beside: Mapping[str, bytes] = {}


def fuzz_targets() -> list[FuzzTarget]:
    """Return all kinds of files."""
    doors = [
        FuzzTarget(name, ending, FileOrigin.FOREIGN, content, read, mutate, weight, beside)
        for name, ending, content, read, mutate, weight, beside in door_targets()
    ]
    return [*_texts(), *_own_hdf5(), *_foreign(), *doors]


def flat(value: Any) -> Any:
    """Return a value as nested tuples of plain values, which can be compared bit for bit."""
    if is_dataclass(value) and not isinstance(value, type):
        return tuple((f.name, flat(getattr(value, f.name))) for f in fields(value) if f.name not in ("notes", "_tree"))
    if isinstance(value, Mapping):
        return tuple((key, flat(item)) for key, item in value.items())
    if isinstance(value, np.ndarray):
        return (value.shape, value.dtype.kind, value.tobytes() if value.dtype.kind != "O" else tuple(value.flat))
    if isinstance(value, list | tuple):
        return tuple(map(flat, value))
    if isinstance(value, str | bytes | int | float | complex | bool | None):
        return repr(value)
    return type(value).__name__


def _texts() -> list[FuzzTarget]:
    with tempfile.TemporaryDirectory() as folder:
        places = {name: Path(folder) / f"{name}.yaml" for name in ("p", "biquad", "model", "actuators")}
        gbid.save_controller(
            places["p"], "P", {"kappa_x": 1.125, "kappa_y": 0.99}, plant="theisen2016", sample_time=2e-4
        )
        structure = gbid.controller_structure("biquad")
        gains = {p.name: 0.1 + 0.07 * i for i, p in enumerate(structure.parameters)}
        gbid.save_controller(places["biquad"], structure, gains, sample_time=2e-4)
        save_model(load_model("theisen2016"), places["model"])
        actuators = dict(load_model("theisen2016").actuators)
        write_yaml({"kind": ACTUATORS_KIND, "schema_version": 1, "actuators": actuators}, places["actuators"])
        results = {name: path.read_bytes() for name, path in places.items()}
    table = with_text_checksum(
        csv_text(plain_table(("a", "b"), [(1.5, 2.5), (3.0, -1e-9)], ("note",))), ".csv"
    ).encode()
    experiment = (share_folder("experiments") / "quickstart.yaml").read_bytes()
    origin = FileOrigin.OWN
    return [
        FuzzTarget("controller", ".yaml", origin, results["p"], _telling(gbid.load_controller), mutate_tree, 10),
        FuzzTarget(
            "controller, biquad", ".yaml", origin, results["biquad"], _telling(gbid.load_controller), mutate_text, 2
        ),
        FuzzTarget("LPV model", ".yaml", origin, results["model"], _telling(load_model), mutate_tree, 5),
        FuzzTarget(
            "nominal actuators", ".yaml", origin, results["actuators"], _telling(load_actuators), mutate_tree, 10
        ),
        FuzzTarget("table of results", ".csv", origin, table, _read_text, mutate_text, 40),
        FuzzTarget("experiment", ".yaml", FileOrigin.FOREIGN, experiment, _plainly(_read_experiment), mutate_tree, 4),
        FuzzTarget(
            "experiment, files", ".yaml", FileOrigin.FOREIGN, _OF_FILES, _plainly(_read_experiment), mutate_tree, 6
        ),
        FuzzTarget("mapping", ".yaml", FileOrigin.FOREIGN, _OF_ONE, _plainly(_read_mapping), mutate_tree, 12),
    ]


_OF_ONE = b"""\
time: t
time_unit: ms
from_s: 0.01
to_s: 0.5
piece: 1
decimal: "."
conditions: {pressure_bar: 5.0, speed_rpm: 6000}
signals:
  y: {columns: [a, b], unit: um, stored_unit: m, channels: [x, y]}
  z: {columns: "c[0]"}
"""
_OF_FILES = b"""\
format: 1
name: files
import:
  recordings:
    - name: one
      file: a.csv
      time: t
      conditions: {pressure_bar: 5.0, speed_rpm: 6000}
      signals: {u: {columns: [a, b], unit: um}, p: {columns: [c, d], unit: um}}
fits:
  bearing:
    structure: rotor_bearing
    options: {pade_order: 1}
    start: {k_xx: 1.0e6, tau_x: 1.0e-4}
    bounds: {tau_x: [0, 1.0e-3]}
    prior: {tau_y: {value: 1.0e-4, std: 1.0e-5}}
    trend: {p_x: offset}
    window: 128
    left_out: {one: [[0.1, 0.2]]}
    initial_state: auto
controller:
  main:
    structure: biquad
    model: theisen2016
    operating_points: [{pressure_bar: 6.0, speed_rpm: 0.0}]
    goals:
      - {goal: MaxDamping}
      - {goal: PeakSensitivity, limit: [[10, 2.0], [100, 3.0]]}
      - {goal: MinDiskMargin, alpha: 0.5, soft: true, weight: 2.0}
"""


def _own_hdf5() -> list[FuzzTarget]:
    values = {
        "recording": stored_values.recording(),
        "static map": stored_values.static_map(),
        "piezo curve": stored_values.piezo_curve(),
        "prefilter": stored_values.prefilter_file(),
        "impacts": stored_values.impact_study(),
        "validation": stored_values.validation_summary(),
        "table of fits": stored_values.fit_table(),
        "surfaces": stored_values.lpv_fit(),
        "fit": gbid.fit(MODE, simulated(MODE, MODE_AT, levels(300), noise=0.3)),
        "tuned design": _design(),
    }
    targets = []
    for name, value in values.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.h5"
            save(value, path)
            content = path.read_bytes()
            beside = {p.suffix: p.read_bytes() for p in Path(folder).iterdir() if p != path}
        read = _plainly(load)
        share = 4 if beside else 40  # a file beside it takes its time
        targets += [
            FuzzTarget(name, ".h5", FileOrigin.OWN, content, read, mutate_bytes, share, beside),
            FuzzTarget(f"{name}, entries", ".h5", FileOrigin.CRAFTED, content, read, _seal_mutated, share // 4, beside),
        ]
    return targets


_ROWS = 60


def _foreign() -> list[FuzzTarget]:
    random = np.random.default_rng(1)
    columns = {"t": 1e-3 * np.arange(_ROWS), "a": random.normal(size=_ROWS), "b": random.normal(size=_ROWS)}
    csv = (
        "t,a,b [m]\n"
        + "\n".join(",".join(f"{v:.9g}" for v in row) for row in zip(*columns.values(), strict=True))
        + "\n"
    )
    npz, mat, packed, h5 = io.BytesIO(), io.BytesIO(), io.BytesIO(), io.BytesIO()
    np.savez(npz, **columns)
    nested = {**columns, "s": {"x": columns["a"], "name": "run"}, "c": np.array(["a", "bc"], dtype=object)}
    savemat(mat, nested)
    savemat(packed, nested, do_compression=True)
    with h5py.File(h5, "w") as file:
        for name, column in columns.items():
            file.create_dataset(name, data=column, chunks=(20,), compression="gzip" if name == "a" else None)
        file.create_dataset("run/table", data=np.zeros(5, dtype=[("p", "f8"), ("q", "i4")]))
    logger = "Messung;1\nt;a;b\ns;m;m\n" + csv.partition("\n")[2].replace(",", ";").replace(".", ",")
    foreign = FileOrigin.FOREIGN
    return [
        *_arrow(columns),
        FuzzTarget("csv, looked at", ".csv", foreign, csv.encode(), _plainly(_look), mutate_text, 12),
        FuzzTarget("csv, of a logger", ".csv", foreign, logger.encode(), _import, mutate_text, 12),
        FuzzTarget("csv", ".csv", foreign, csv.encode(), _import, mutate_text, 20),
        FuzzTarget("npz", ".npz", foreign, npz.getvalue(), _import, mutate_npz, 12),
        FuzzTarget("mat", ".mat", foreign, mat.getvalue(), _import, mutate_bytes, 6),
        FuzzTarget("mat, compressed", ".mat", foreign, packed.getvalue(), _import, mutate_bytes, 3),
        FuzzTarget("HDF5 of others", ".h5", foreign, h5.getvalue(), _import, mutate_bytes, 6),
        FuzzTarget("HDF5 of others, entries", ".h5", foreign, h5.getvalue(), _import, mutate_hdf5, 2),
        FuzzTarget("csv, listed", ".csv", foreign, csv.encode(), _plainly(list_channels), mutate_text, 6),
        FuzzTarget("npz, listed", ".npz", foreign, npz.getvalue(), _plainly(list_channels), mutate_npz, 3),
        FuzzTarget("mat, listed", ".mat", foreign, mat.getvalue(), _plainly(list_channels), mutate_bytes, 2),
    ]


def _arrow(columns: Mapping[str, Any]) -> list[FuzzTarget]:
    """Return files of pyarrow; none where it is not installed. Checksums are those of the pages of Parquet."""
    try:
        from pyarrow import feather, parquet, table
    except ImportError:
        return []
    sealed, plain, arrow = io.BytesIO(), io.BytesIO(), io.BytesIO()
    parquet.write_table(
        table(columns), sealed, write_page_checksum=True, compression="none", use_dictionary=False, store_schema=False
    )
    parquet.write_table(table(columns), plain)
    feather.write_feather(table(columns), arrow)
    return [
        FuzzTarget("Parquet, pages", ".parquet", FileOrigin.SEALED, sealed.getvalue(), _import, _mutate_pages, 6),
        FuzzTarget("Parquet", ".parquet", FileOrigin.FOREIGN, plain.getvalue(), _import, mutate_bytes, 6),
        FuzzTarget(
            "Parquet, listed", ".pq", FileOrigin.FOREIGN, plain.getvalue(), _plainly(list_channels), mutate_bytes, 2
        ),
        FuzzTarget("Feather", ".feather", FileOrigin.FOREIGN, arrow.getvalue(), _import, mutate_bytes, 3),
    ]


def _mutate_pages(random: Random, content: bytes) -> bytes:
    """Change the numbers in the pages. Headers of pages and the footer have no checksum."""
    start = content.index(np.random.default_rng(1).normal(size=4).tobytes())
    pages = content[start : start + 8 * _ROWS]
    changed = random.choice((flip_bits, overwrite))(random, pages)[: len(pages)]
    return content[:start] + changed + content[start + len(changed) :]


def _plainly(load: Callable[[Path], Any]) -> Callable[[Path], tuple[Any, tuple[str, ...]]]:
    return lambda path: (load(path), ())


def _telling(load: Callable[[Path], Any]) -> Callable[[Path], tuple[Any, tuple[str, ...]]]:
    """Read with the notes of the value and the warnings about its file."""

    def read(path: Path) -> tuple[Any, tuple[str, ...]]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", ChangedFileWarning)
            value = load(path)
        return value, (*getattr(value, "notes", ()), *(str(each.message) for each in caught))

    return read


def _read_text(path: Path) -> tuple[Any, tuple[str, ...]]:
    content = path.read_bytes()
    lines = content.decode("utf-8-sig", "replace").replace("\r\n", "\n").rstrip().split("\n")
    rows = [line for line in lines if not line.startswith("#")]
    return rows, ("changed",) if is_changed(content) else ()


def _read_experiment(path: Path) -> Any:
    return load_experiment(path).recordings


def _read_mapping(path: Path) -> Any:
    data = read_yaml(path).data
    try:
        return ImportMapping.from_dict(data)
    except GbidError as error:  # it does not know its file
        raise type(error)(f"{path}: {error}") from None


def _look(path: Path) -> Any:
    return peek(path, ImportMapping.from_dict(_MAPPING)), list_channels(path)


def _import(path: Path) -> tuple[Any, tuple[str, ...]]:
    return gbid.import_recording(path, _MAPPING), ()


def _design() -> TunedDesign:
    gain = ca.SX.sym("g")
    design = gbid.maximise_damping(ca.Function("A", [gain], [oscillator(gain)]), ["g"], 0.0, 0.5, "decay")
    return TunedDesign("design", "model", design, (), (), HalfSine(), 2e-4)


def _seal_mutated(random: Random, content: bytes) -> bytes:
    """Change entries or bytes, and make the checksum anew, as somebody would who attacks the reader."""
    return with_checksum(random.choice((mutate_hdf5, mutate_bytes))(random, content))
