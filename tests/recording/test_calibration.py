"""Calibration of columns: scale, offset, and points of a calibration sheet."""

import numpy as np
import pytest

import gbid
from gbid.core.errors import UsageError
from gbid.experiment.recordings import mapping_of
from gbid.experiment.schema import ImportedSection

VOLTS = np.random.default_rng(3).uniform(-1, 11, (50, 2))


@pytest.fixture
def path(tmp_path):
    rows = [f"{2e-4 * k:.4f},{a!r},{b!r}" for k, (a, b) in enumerate(VOLTS.tolist())]
    (tmp_path / "a.csv").write_text("\n".join(["t [s],a [V],b [V]", *rows, ""]))
    return tmp_path / "a.csv"


def imported(path, **signal):
    return gbid.import_recording(path, {"time": "t", "signals": {"p": {"columns": ["a", "b"], **signal}}})


def test_scale_and_offset_of_each_column(path):
    recording = imported(path, unit="um", scale=[12.5, 12.0], offset=(-3.0, 0.5))
    wanted = 1e-6 * (VOLTS * [12.5, 12.0] + [-3.0, 0.5])
    np.testing.assert_allclose(recording.signal("p"), wanted, rtol=1e-12, atol=1e-18)
    assert recording.provenance["calibration"] == "p, a: 0 is -3 um, 1 is 9.5 um; p, b: 0 is 0.5 um, 1 is 12.5 um"


def test_points_of_a_sheet_are_joined_by_straight_lines(path):
    points = [[10.0, 130.0], [0.0, 0.0], [5.0, 60.0]]
    recording = imported(path, unit="um", calibration={"points": points})
    inside = np.interp(VOLTS, [0, 5, 10], [0, 60, 130])
    wanted = np.where(VOLTS < 0, 12 * VOLTS, np.where(VOLTS > 10, 130 + 14 * (VOLTS - 10), inside))
    np.testing.assert_allclose(recording.signal("p"), 1e-6 * wanted, rtol=1e-12, atol=1e-18)
    beyond = ((VOLTS < 0) | (VOLTS > 10)).sum(axis=0)
    said = [f"{name}: 0 is 0 um, ..., 10 is 130 um, {n} samples" for name, n in zip("ab", beyond, strict=True)]
    assert all(words in recording.provenance["calibration"] for words in said)


def test_yaml_has_the_same_keys(path):
    signal = {
        "columns": ["a", "b"],
        "unit": "um",
        "calibration": [{"points": [[0, 0], [1, 2]]}, {"points": [[0, 1], [1, 2]]}],
    }
    entry = ImportedSection.model_validate({"name": "a", "file": "a.csv", "time": "t", "signals": {"p": signal}})
    recording = gbid.import_recording(path, mapping_of(entry))
    np.testing.assert_allclose(recording.signal("p"), 1e-6 * (VOLTS * [2, 1] + [0, 1]), rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    ("signal", "words"),
    [
        ({"scale": 2.0}, "scale: give unit, too"),
        ({"unit": "um", "scale": [1.0, 2.0, 3.0]}, "scale: 3 for 2 columns"),
        ({"unit": "um", "scale": 0.0}, "scale = 0"),
        ({"unit": "um", "scale": "x"}, "scale = 'x'"),
        ({"unit": "um", "scale": 1.0, "calibration": {"points": [[0, 0], [1, 1]]}}, "both given"),
        ({"unit": "um", "calibration": {"points": [[0, 0]]}}, "at least two pairs"),
        ({"unit": "um", "calibration": {"points": [[0, 0], [0, 1]]}}, "different numbers"),
        ({"unit": "um", "calibration": {"point": []}}, "unknown key 'point'"),
    ],
)
def test_what_is_no_calibration_is_refused(path, signal, words):
    with pytest.raises(UsageError, match=words):
        imported(path, **signal)
