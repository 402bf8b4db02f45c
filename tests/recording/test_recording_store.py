"""Recordings in HDF5: round trip, tree, refusals."""

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gbid.core import hdf5
from gbid.core.errors import DataError
from gbid.recording import Recording, load_recording, save_recording

N = 150
WORD = st.text(st.characters(codec="utf-8", exclude_characters="/\0"), min_size=1, max_size=8).filter(
    lambda w: w not in (".", "time")
)
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


@pytest.fixture
def rec():
    rng = np.random.default_rng(1)
    return Recording(
        {"u": rng.standard_normal((N, 2)), "p": rng.standard_normal((N, 2)), "aux": rng.standard_normal((N, 3))},
        sample_time=2e-4,
        conditions={"speed_rpm": 6000, "pressure_bar": 5, "gain": 0.5},
        name="prbs 1",
        units={"u": "m", "p": "m", "aux": "V"},
        channels={"aux": ("a", "b", "c")},
        provenance={"source_file": "x.mat"},
    )


def assert_same(a, b):
    assert list(a.signals) == list(b.signals)
    for name, values in a.signals.items():
        assert values.shape == b.signals[name].shape
        assert values.tobytes() == b.signals[name].tobytes()  # also the sign of zero
    assert a.sample_time == b.sample_time
    assert list(a.conditions.items()) == list(b.conditions.items())
    assert a.provenance == b.provenance
    assert (a.name, a.units, a.channels) == (b.name, b.units, b.channels)


@st.composite
def recordings(draw):
    n = draw(st.integers(4, 12))
    widths = draw(st.dictionaries(WORD, st.integers(1, 4), min_size=1, max_size=4))
    known = {"r": 2, "u": 2, "p": 2, "phi": 1, "force": 1}
    widths = {name: known.get(name, k) for name, k in widths.items()}
    return Recording(
        {name: draw(hnp.arrays(float, (n, k), elements=FINITE)) for name, k in widths.items()},
        sample_time=draw(st.floats(1e-9, 1e3)),
        conditions=draw(st.dictionaries(WORD, FINITE, max_size=3)),
        name=draw(TEXT),
        units={name: draw(TEXT) for name in widths},
        channels={name: tuple(draw(st.lists(TEXT, min_size=k, max_size=k))) for name, k in widths.items()},
        provenance=draw(st.dictionaries(WORD, TEXT, max_size=12)),
    )


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rec=recordings())
def test_round_trip_of_anything_is_bit_exact(rec, tmp_path):
    path = tmp_path / "any.h5"
    save_recording(rec, path, overwrite=True)
    assert_same(rec, load_recording(path))


def test_the_tree_is_the_documented_one(rec, tmp_path):
    path = tmp_path / "a.h5"
    save_recording(rec, path)
    with h5py.File(path) as file:
        assert file.attrs["gbid_kind"] == "recording"
        assert file.attrs["schema_version"] == 1
        assert file.attrs["name"] == "prbs 1"
        assert file.attrs["default"] == "signals"
        assert set(file) == {"signals", "conditions", "provenance", "sample_time"}
        assert file["sample_time"][()] == 2e-4
        group = file["signals"]
        assert group.attrs["NX_class"] == "NXdata"
        assert group.attrs["signal"] == "u"
        assert list(group.attrs["auxiliary_signals"]) == ["p", "aux"]
        assert list(group.attrs["axes"]) == ["time", "."]
        assert group["time"].shape == (N,)
        assert group["p"].shape == (N, 2)
        assert group["p"].attrs["long_name"] == "lateral disc position"
        assert list(group["aux"].attrs["channels"]) == ["a", "b", "c"]
        units = {name: item.attrs["units"] for name, item in group.items()}
        assert units == {"time": "s", "u": "m", "p": "m", "aux": "V"}
        units = {name: item.attrs["units"] for name, item in file["conditions"].items()}
        assert units == {"speed_rpm": "rpm", "pressure_bar": "bar", "gain": ""}
        assert dict(file["provenance"].attrs) == {"source_file": "x.mat"}

        def annotated(name, item):
            if isinstance(item, h5py.Dataset):
                assert item.attrs["long_name"], name
                assert "units" in item.attrs, name

        file.visititems(annotated)


def change(item, name, value):
    attributes = dict(item[name].attrs)
    del item[name]
    item[name] = value
    item[name].attrs.update(attributes)


OVERFLOWN = np.ones((N, 2))
OVERFLOWN[3, 1] = np.inf
DAMAGES = [
    (lambda f: [f["signals"].pop(k) for k in ("u", "p", "aux")], "no signals"),
    (lambda f: change(f["signals"], "p", OVERFLOWN), "the first inf at sample 3, channel 1"),
    (lambda f: change(f["signals"], "p", np.ones((2, N))), "more channels than samples"),
    (lambda f: change(f["signals"], "p", np.ones(N)), "1 channels, expected 2 (x, y)"),
    (lambda f: change(f["signals"], "p", np.ones((N - 1, 2))), "different numbers of samples"),
    (lambda f: change(f["signals"], "p", np.ones((N, 3))), "3 channels, expected 2 (x, y)"),
    (lambda f: f["signals"].create_group("deeper"), "is a group, not a dataset"),
    (lambda f: change(f, "sample_time", [1.0, 2.0]), "expected one number"),
    (lambda f: change(f, "sample_time", -1.0), "sample_time = -1.0 s"),
    (lambda f: change(f, "sample_time", 1.0), "sample_time = 1.0 s gives 1.0 s"),
    (lambda f: change(f["signals"], "time", np.arange(3.0)), "time has shape (3,)"),
    (lambda f: change(f["conditions"], "gain", np.nan), "condition gain = nan"),
]


@pytest.mark.parametrize(("damage", "words"), DAMAGES, ids=[words for _, words in DAMAGES])
def test_damaged_files_are_refused_in_one_line(rec, tmp_path, damage, words):
    path = tmp_path / "a.h5"
    save_recording(rec, path)
    with hdf5.changing(path) as file:
        damage(file)
    with pytest.raises(DataError) as caught:
        load_recording(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert words in text
    assert "\n" not in text
