"""Fit results in HDF5: round trip and damaged files."""

from dataclasses import fields, is_dataclass

import h5py
import numpy as np
import pytest
from fit_cases import EVERY, EVERY_AT, MODE, MODE_AT, innovations, levels, simulated

from gbid import load, save
from gbid.core import hdf5
from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.recording import Recording, save_recording
from gbid.structure import LinearStructure, Parameter


@pytest.fixture(scope="module")
def data():
    return [simulated(MODE, MODE_AT, levels(300, seed=i), noise=0.3, seed=i, name=f"arm é {i}") for i in range(2)]


@pytest.fixture(scope="module")
def result(data):
    return fit(MODE, data, focus="simulation", bounds={"w": (5.5, 8.0)}, fixed={"g": 2.0})


def assert_same(a, b):
    """All stored fields of two results, and of the values in them, are equal to the bit."""
    assert type(a) is type(b)
    if is_dataclass(a):
        for field in fields(a):
            if field.name == "profiler":  # it has the samples, which are not stored
                continue
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    else:
        np.testing.assert_equal(a, b, strict=isinstance(a, np.ndarray))


def test_round_trip(result, tmp_path):
    assert np.isnan(result.std["w"])  # on its bound: the file must carry that
    assert result.notes
    path = tmp_path / "new" / "fit.h5"
    save(result, path)
    assert_same(load(path), result)
    assert_same(load(str(path)), result)


def test_round_trip_with_a_disturbance_gain_and_no_notes(tmp_path):
    rec = innovations(EVERY, EVERY_AT, levels(400, 2, hold=3), noise=[0.2, 0.1])
    with_gain = fit(EVERY, rec, start=EVERY_AT, intersample=("zoh", "foh"))
    assert with_gain.model.K is not None
    assert with_gain.notes == ()
    save(with_gain, tmp_path / "a.h5")
    assert_same(load(tmp_path / "a.h5"), with_gain)


def test_round_trip_with_exact_delays_local_parameters_and_offsets(tmp_path):
    delayed = LinearStructure(
        "late",
        [Parameter("a", 1.0), Parameter("b", 1.0), Parameter("tau", 0.2, lower=0.0, upper=1.0, unit="s")],
        lambda p: {"A": [[-p.a]], "B": [[0]], "B_delayed": [[p.b]], "delay": [p.tau], "C": [[1]]},
    )
    recs = [
        simulated(delayed, {"a": 2.0, "b": b, "tau": 0.33}, levels(200, seed=i), noise=0.05, seed=i, name=f"é {i}")
        for i, b in enumerate((1.0, 3.0))
    ]
    made = fit(delayed, recs, local={"b": "recording"}, trend="offset", start={"a": 1.5})
    assert made.model.delay is not None
    assert made.local_names["é 1"] == {"b": "b[é 1]", "offset_y": "offset_y[é 1]"}
    save(made, tmp_path / "late.h5")
    loaded = load(tmp_path / "late.h5")
    assert_same(loaded, made)
    assert loaded.parameters_of("é 1") == made.parameters_of("é 1")


def test_a_fit_that_did_not_converge_is_kept_as_such(data, tmp_path):
    bad = fit(MODE, data, max_iterations=1, start={"w": 8.0})
    save(bad, tmp_path / "bad.h5")
    loaded = load(tmp_path / "bad.h5")
    assert loaded.success is False
    assert_same(loaded, bad)


def test_every_dataset_has_unit_and_name_and_the_key_is_kept(result, tmp_path):
    save(result, tmp_path / "fit.h5", key="abc")
    with h5py.File(tmp_path / "fit.h5") as file:
        assert file.attrs["key"] == "abc"
        names = []

        def visit(name, item):
            if isinstance(item, h5py.Dataset):
                names.append(name)
                assert "units" in item.attrs, name
                assert item.attrs["long_name"], name

        file.visititems(visit)
        assert {"loss", "parameters/estimate", "parameters/std", "model/A"} <= set(names)
        assert {"parameters/covariance_white", "parameters/covariance_robust", "modes_std"} <= set(names)
        assert list(file["parameters"].attrs["units"]) == list(result.units.values())


def test_nothing_is_overwritten_unless_asked(result, tmp_path):
    path = tmp_path / "fit.h5"
    path.write_text("mine")
    with pytest.raises(UsageError, match=r"fit\.h5 exists already"):
        save(result, path)
    assert path.read_text() == "mine"
    save(result, path, overwrite=True)
    assert_same(load(path), result)
    assert [p.name for p in tmp_path.iterdir()] == ["fit.h5"]


TORN = "entries do not fit together"


def put(group, name, values):
    del group[name]
    group[name] = values


DAMAGE = {
    "no covariance": (
        lambda f: f["parameters"].__delitem__("covariance_white"),
        "parameters/covariance_white is missing",
    ),
    "no parameters": (lambda f: f.__delitem__("parameters"), "incomplete fit file|parameters"),
    "no model": (lambda f: f.__delitem__("model"), "incomplete fit file|model"),
    "no status": (lambda f: f.attrs.__delitem__("status"), "no attribute 'status'"),
    "no names": (lambda f: f["parameters"].attrs.__delitem__("names"), "no attribute 'names'"),
    "text for numbers": (lambda f: put(f, "loss", "much"), "holds object, not numbers"),
    "newer schema": (lambda f: f.attrs.__setitem__("schema_version", 99), "schema_version 99"),
    "a focus that is none": (lambda f: f.attrs.__setitem__("options", '{"focus": "none"}'), "focus = 'none'; choose"),
    "an unknown status": (lambda f: f.attrs.__setitem__("status", "fine"), TORN),
    "a window in words": (lambda f: f.attrs.__setitem__("options", '{"window": "far"}'), "window = 'far'; give"),
    "local names are no JSON": (lambda f: f.attrs.__setitem__("local_names", "{"), TORN),
    "a name too few": (lambda f: f["parameters"].attrs.__setitem__("names", ["w", "z"]), TORN),
    "matrices of wrong shape": (lambda f: put(f["model"], "A", np.eye(3)), "damaged fit file: model 'mode': B has"),
    "loss of wrong shape": (lambda f: put(f, "loss", [1.0, 2.0]), TORN),
}


@pytest.mark.parametrize(("damage", "text"), DAMAGE.values(), ids=DAMAGE)
def test_damaged_files_are_refused_in_one_line(result, tmp_path, damage, text):
    path = tmp_path / "fit.h5"
    save(result, path)
    with hdf5.changing(path) as file:
        damage(file)
    with pytest.raises(DataError, match=text) as caught:
        load(path)
    assert "fit.h5" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_files_are_refused(result, data, tmp_path):
    with pytest.raises(DataError, match="no such file"):
        load(tmp_path / "none.h5")
    save_recording(data[0], tmp_path / "rec.h5")
    assert isinstance(load(tmp_path / "rec.h5"), Recording)
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(DataError, match="not a readable HDF5 file"):
        load(tmp_path / "text.h5")
    save(result, tmp_path / "fit.h5")
    complete = (tmp_path / "fit.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(complete[: len(complete) // 2])
    with pytest.raises(DataError, match=r"cut\.h5"):
        load(tmp_path / "cut.h5")
