"""Dataclasses by their types in HDF5: anything comes back as it was, and a file that was tampered with is refused."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum, IntEnum
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar

import h5py
import numpy as np
import pytest
import stored_values
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from typing_extensions import TypeAliasType

from gbid import load, save
from gbid.core import hdf5
from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.errors import DataError
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.structure import LinearModel


class Colour(Enum):
    RED = "red"
    GREEN = "green"


class Level(IntEnum):
    LOW = 1
    HIGH = 2


class Named(NamedTuple):
    cap: float
    word: str


@dataclass(frozen=True)
class Row:
    name: str
    count: int
    good: bool
    size: Annotated[float, Stored("m", "size")]
    colour: Colour
    pair: Annotated[FloatArray, Stored("m", "pair", "2")]


@dataclass(frozen=True)
class Inner:
    word: str
    either: int | Literal["auto"]
    choice: Literal["a", "b"] | None
    number: float | None
    gains: Annotated[Mapping[str, float], Stored("1", "gains")]


@dataclass(frozen=True)
class Everything(hdf5.InFile):
    number: float
    measured: Annotated[float, Stored("s", "a number in a dataset")]
    count: int
    flag: bool
    word: str
    colour: Colour
    level: Level
    choice: Literal["a", "b"]
    words: tuple[str, ...]
    lines: Annotated[tuple[tuple[str, ...], ...], Stored("", "lines")]
    spikes: tuple[int, ...]
    colours: tuple[Colour, ...]
    limits: tuple[float, float]
    corners: Annotated[tuple[tuple[float, float], ...], Stored("m", "corners")]
    window: Annotated[tuple[int, int] | None, Stored("1", "window")]
    matrix: Annotated[FloatArray, Stored("m", "matrix", "n k")]
    across: Annotated[FloatArray, Stored("m", "across", "k")]
    whole: Annotated[IntArray, Stored("1", "whole", "n")]
    mask: Annotated[BoolArray, Stored("1", "mask", "n")]
    free: Annotated[FloatArray, Stored("m", "of any shape")]
    estimate: Annotated[
        Mapping[str, float], Stored("SI", "estimates", at="parameters/estimate", keys="parameters@names")
    ]
    origin: Annotated[Mapping[str, str], Stored(at="parameters@origin", keys="parameters@names")]
    conditions: Mapping[str, float]
    provenance: Mapping[str, str]
    nested: Mapping[str, Mapping[str, str]]
    arrays: Annotated[Mapping[str, FloatArray], Stored("m", "by name", "2 1")]
    parts: Mapping[str, Inner]
    inner: Inner
    rows: tuple[Row, ...]
    several: tuple[Inner, ...]
    front: tuple[Named, ...]
    capped: Annotated[tuple[Named, ...], Stored(at="elsewhere")]
    model: LinearModel | None
    kept_out: Annotated[Any, NOT_STORED] = None
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("everything", "make it again")


MODEL = LinearModel(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)
KEY = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=6)
NUMBER = st.floats()
WHOLE = st.integers(-(2**63), 2**63 - 1)


def tuples(strategy, size=3):
    return st.lists(strategy, max_size=size).map(tuple)


def arrays(*shape, dtype=float):
    return hnp.arrays(dtype, shape)


INNER = st.builds(
    Inner,
    TEXT,
    st.one_of(WHOLE, st.just("auto")),
    st.sampled_from(["a", "b", None]),
    st.none() | NUMBER,
    st.dictionaries(KEY, NUMBER, max_size=3),
)
ROW = st.builds(Row, TEXT, WHOLE, st.booleans(), NUMBER, st.sampled_from(Colour), arrays(2))
NAMED = st.builds(Named, NUMBER, TEXT)


@st.composite
def everything(draw):
    n, k = draw(st.integers(0, 3)), draw(st.integers(0, 3))
    names = draw(st.lists(KEY, unique=True, max_size=3))
    return Everything(
        number=draw(NUMBER),
        measured=draw(NUMBER),
        count=draw(WHOLE),
        flag=draw(st.booleans()),
        word=draw(TEXT),
        colour=draw(st.sampled_from(Colour)),
        level=draw(st.sampled_from(Level)),
        choice=draw(st.sampled_from("ab")),
        words=draw(tuples(TEXT)),
        lines=draw(tuples(tuples(TEXT.filter(bool)))),
        spikes=draw(tuples(WHOLE)),
        colours=draw(tuples(st.sampled_from(Colour))),
        limits=draw(st.tuples(NUMBER, NUMBER)),
        corners=draw(tuples(st.tuples(NUMBER, NUMBER))),
        window=draw(st.none() | st.tuples(WHOLE, WHOLE)),
        matrix=draw(arrays(n, k)),
        across=draw(arrays(k)),
        whole=draw(arrays(n, dtype=np.int64)),
        mask=draw(arrays(n, dtype=bool)),
        free=draw(hnp.arrays(float, hnp.array_shapes(min_dims=0, max_dims=3))),
        estimate={name: draw(NUMBER) for name in names},
        origin={name: draw(TEXT) for name in names},
        conditions=draw(st.dictionaries(KEY, NUMBER, max_size=12)),
        provenance=draw(st.dictionaries(TEXT, TEXT, max_size=3)),
        nested=draw(st.dictionaries(TEXT, st.dictionaries(TEXT, TEXT, max_size=2), max_size=2)),
        arrays=draw(st.dictionaries(TEXT, arrays(2, 1), max_size=3)),
        parts=draw(st.dictionaries(TEXT, INNER, max_size=2)),
        inner=draw(INNER),
        rows=draw(tuples(ROW)),
        several=draw(tuples(INNER, 12)),
        front=draw(tuples(NAMED)),
        capped=draw(tuples(NAMED)),
        model=draw(st.sampled_from([None, MODEL])),
    )


def assert_same(a, b):
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
    elif hasattr(a, "__dataclass_fields__"):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif isinstance(a, dict):
        assert set(a) == set(b)
        for key in a:
            assert_same(a[key], b[key])
    else:
        assert a == b or (a != a and b != b)


slow = settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))


@slow
@given(value=everything())
def test_anything_comes_back_as_it_was(value, tmp_path):
    hdf5.save(value, tmp_path / "a.h5", overwrite=True, key="k")
    assert_same(value, hdf5.load(tmp_path / "a.h5", Everything))
    with h5py.File(tmp_path / "a.h5") as file:
        assert file.attrs["key"] == "k"
        assert list(file["parameters"].attrs["names"]) == list(value.estimate)
        assert file["measured"].attrs["units"] == "s"
        assert ("model" in file) is (value.model is not None)

        def annotated(name, item):
            if isinstance(item, h5py.Dataset):
                assert "units" in item.attrs, name
                assert item.attrs["long_name"], name

        file.visititems(annotated)


def test_what_does_not_fit_is_not_written(tmp_path):
    @dataclass(frozen=True)
    class Pair(hdf5.InFile):
        FILE = Everything.FILE
        x: Annotated[FloatArray, Stored("m", "x", "n")]
        y: Annotated[FloatArray, Stored("m", "y", "n")]

    with pytest.raises(ValueError, match=r"/y has shape \(3,\), expected \(2\)"):
        hdf5.save(Pair(np.zeros(2), np.zeros(3)), tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_types_that_cannot_be_stored_are_named(tmp_path):
    @dataclass(frozen=True)
    class Odd(hdf5.InFile):
        FILE = Everything.FILE
        what: object

    with pytest.raises(TypeError, match=r"Odd\.what: .*object.* cannot be stored"):
        hdf5.save(Odd(1), tmp_path / "a.h5")


# ---- files that were tampered with ----


VALUES = {
    "everything": lambda: stored_values.small(Everything, origin={"pressure_bar": "data"}, model=MODEL, kept_out=None),
    "recording": stored_values.recording,
    "static_map": stored_values.static_map,
    "piezo_curve": stored_values.piezo_curve,
    "prefilter": stored_values.prefilter_file,
    "impact": stored_values.impact_study,
    "summary": stored_values.validation_summary,
    "table": stored_values.fit_table,
}
# Written for other programs only, or of fields that may be absent.
UNREAD = {
    *(
        "units",
        "long_name",
        "creator",
        "created",
        "made_with",
        "default",
        "NX_class",
        "signal",
        "axes",
        "auxiliary_signals",
    ),
    *("amplitudes", "either", "choice", "number", "window", "model", "K", "dt", "pressure_bar", "speed_rpm", "c"),
    *("source_file", "free", "lag_rates", "gain_names", "checksum"),
}
# A recording has the signals that it has, a prefilter file the reports, and a map or none.
NOT_COUNTED = ("/signals", "/reports")


def places(path):
    """Every entry of a file: attributes as (item, name), datasets and groups as (parent, name)."""
    results = []
    with h5py.File(path) as file:

        def visit(name, item):
            parent, _, name_in_group = f"/{name}".rpartition("/")
            results.append((parent or "/", name_in_group, False))
            results.extend((f"/{name}", key, True) for key in item.attrs)

        file.visititems(visit)
        results.extend(("/", key, True) for key in file.attrs)
    return [place for place in results if not UNREAD & {*place[0].split("/"), place[1]}]


def tamper(file, where, name, is_attribute, how):
    """Change one entry; say whether there was anything to change."""
    holder = file[where].attrs if is_attribute else file[where]
    old = holder[name]
    if how == "delete":
        del holder[name]
        return True
    if isinstance(old, h5py.Group):
        if how != "kind":
            return False
        del holder[name]
        holder[name] = 1.0
        return True
    values = np.asarray(old if is_attribute else old[()])
    text = values.dtype.kind in "OSU"
    if how == "shape":
        new = values.reshape((1, *values.shape))
        new = np.concatenate([new, new]) if values.ndim == 0 else new
        new = new.astype(h5py.string_dtype()) if text else new
    elif how == "type":
        new = np.ones(values.shape) if text else np.full(values.shape, "w", dtype=object)
        new = new if text else new.astype(h5py.string_dtype())
    elif is_attribute:
        return False
    if is_attribute:
        file[where].attrs[name] = new
        return True
    attributes = dict(old.attrs)
    del holder[name]
    item = holder.create_group(name) if how == "kind" else holder.create_dataset(name, data=new)
    item.attrs.update(attributes)
    return True


@pytest.mark.parametrize("store", VALUES)
def test_a_file_that_was_tampered_with_is_refused_in_one_line(store, tmp_path):
    value, path = VALUES[store](), tmp_path / "a.h5"
    save(value, path)
    assert type(load(path, type(value))) is type(value)
    complete = path.read_bytes()
    tried = 0
    for where, name, is_attribute in places(path):
        for how in ("delete", "shape", "type", "kind"):
            if how == "delete" and (where in NOT_COUNTED or name == "runout_map") and name != "time":
                continue
            path.write_bytes(complete)
            with hdf5.changing(path) as file:
                if not tamper(file, where, name, is_attribute, how):
                    continue
            with pytest.raises(DataError) as caught:  # noqa: PT012
                load(path, type(value))
                pytest.fail(f"{store}: {how} {where} {name} passed unseen")
            text = str(caught.value)
            assert text.startswith(f"{path}: "), (how, where, name)
            assert "\n" not in text, text
            tried += 1
    assert tried > 20


def test_flipped_bits_truncation_and_foreign_changes_are_noticed_before_the_library_reads(tmp_path):
    value, path = stored_values.fit_table(), tmp_path / "a.h5"
    save(value, path)
    complete = path.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(complete), 100):
        changed = bytearray(complete)
        changed[place] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        with pytest.raises(DataError, match=r"changed by another program|checksum at its end is missing"):
            load(path, type(value))
    path.write_bytes(complete[:-1])
    with pytest.raises(DataError, match="the checksum at its end is missing"):
        load(path, type(value))
    path.write_bytes(complete)
    with h5py.File(path, "r+") as file:
        file.attrs["mine"] = 1.0
    with pytest.raises(DataError, match="changed by another program"):
        load(path, type(value))


Scalar = TypeVar("Scalar", bound=np.generic)
Aliased = TypeAliasType("Aliased", np.ndarray[Any, np.dtype[Scalar]], type_params=(Scalar,))
"""As numpy 2.5 has ``NDArray``; a pip user could not save a fit with it."""


@dataclass(frozen=True)
class WithAliases(hdf5.InFile):
    values: Annotated[Aliased[np.float64], Stored("m", "values", "n")]
    names: Annotated[Aliased[np.str_] | None, Stored("", "names", "k")]
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("aliases", "make it again")


def test_fields_of_aliased_types_are_stored(tmp_path):
    save(WithAliases(np.array([1.0, 2.0]), np.array(["a"])), tmp_path / "aliases.h5")
    read = load(tmp_path / "aliases.h5", WithAliases)
    assert (read.values.tolist(), read.names.tolist()) == ([1.0, 2.0], ["a"])
