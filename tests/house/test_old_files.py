"""Files that gbid 0.1.0 wrote are read, or refused in one line that says what to do."""

import zipfile
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
import stored_values

import gbid
from gbid.characterise import PiezoCurve, StaticMap, load_static
from gbid.control import load_impacts
from gbid.control.assess import load_tuned
from gbid.core.errors import DataError
from gbid.prefilter import load_prefilter
from gbid.prefilter.prefilter import read_report
from gbid.validate import load_validation_summary

FILES = Path(__file__).parents[1] / "data" / "gbid_0_1_0.zip"


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    folder = tmp_path_factory.mktemp("old")
    with zipfile.ZipFile(FILES) as archive:
        archive.extractall(folder)
    return folder


def assert_same(a, b, where="value"):
    assert type(a) is type(b) or (isinstance(a, dict) or hasattr(a, "items")), where
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, where)
        assert a.dtype.kind == b.dtype.kind, where
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_same(*pair, f"{where}[{i}]")
    elif hasattr(a, "items"):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]")
    else:
        np.testing.assert_equal(a, b, where)


@pytest.mark.parametrize(
    ("file", "load", "expected"),
    [
        ("recording.h5", gbid.load_recording, stored_values.recording),
        ("recording.h5", read_report, stored_values.report),
        ("static_map.h5", lambda path: load_static(path, StaticMap), stored_values.static_map),
        ("piezo_curve.h5", lambda path: load_static(path, PiezoCurve), stored_values.piezo_curve),
        ("prefilter.h5", load_prefilter, lambda: (stored_values.runout_map(), (stored_values.report(),))),
        ("impact.h5", load_impacts, stored_values.impact_study),
        ("validation_summary.h5", load_validation_summary, stored_values.validation_summary),
        ("table.h5", gbid.load_table, stored_values.fit_table),
    ],
)
def test_old_files_hold_what_was_stored(old, file, load, expected):
    before = (old / file).read_bytes()
    assert_same(load(old / file), expected())
    assert (old / file).read_bytes() == before


def test_old_surfaces_hold_what_was_stored(old):
    found, expected = gbid.load_lpv_fit(old / "lpv_fit.yaml"), stored_values.lpv_fit()
    for name in ("covariance", "scatter", "estimates", "outliers", "orders", "lack_of_fit", "options", "notes"):
        assert_same(getattr(found, name), getattr(expected, name), name)
    assert_same(found.coefficients, expected.coefficients)


def test_old_fits_are_refused_with_what_to_do(old):
    with pytest.raises(DataError, match=r"older gbid \(schema_version 1\); remove it and make the fit anew"):
        gbid.load_fit(old / "fit.h5")


def test_old_designs_are_refused_with_what_to_do(old):
    with pytest.raises(DataError) as caught:
        load_tuned(old / "tuning.h5")
    words = "written by an older gbid (schema_version 1); remove it and make it again with `gbid tune`"
    assert str(caught.value) == f"{old / 'tuning.h5'}: {words}"
