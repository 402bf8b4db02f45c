"""A new importer is one constant in formats.py: import, check, folder patterns and messages find it there."""

from pathlib import Path

import numpy as np
import pytest
from experiment_files import json_of

import gbid
from gbid.core.errors import DataError
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import load_experiment
from gbid.recording import formats
from gbid.recording.columns import FileColumn
from gbid.recording.formats import file_formats
from gbid.recording.readers import FileChannel, FileFormat


def read_dat(path, references):
    names = path.read_text(encoding="utf-8").splitlines()[0].split()
    values = np.loadtxt(path, skiprows=1, ndmin=2)
    for name in references:
        if name not in names:
            raise DataError(f"{path}: no column {name!r}; choose from {', '.join(names)}")
    return {name: FileColumn(values[:, names.index(name)]) for name in references}


def dat_channels(path):
    names, *rows = path.read_text(encoding="utf-8").splitlines()
    return [FileChannel(name, len(rows)) for name in names.split()]


FIXED_WIDTH = FileFormat((".dat", ".prn"), read_dat, dat_channels)
MAPPING = {"sample_time_s": 1e-3, "signals": {"force": {"columns": ["f"], "unit": "N"}}}
IMPORT = """\
format: 1
name: own
import:
  data_folder: data
  recordings:
    - {name: one, file: one.dat, sample_time_s: 1.0e-3, signals: {force: {columns: [f], unit: N}}}
"""


@pytest.fixture
def dat(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(formats, "FIXED_WIDTH", FIXED_WIDTH, raising=False)
    file_formats.cache_clear()
    yield
    file_formats.cache_clear()


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    path = tmp_path / "data" / "one.dat"
    path.parent.mkdir()
    path.write_text("t   f\n" + "".join(f"{k}   {0.5 * k}\n" for k in range(200)), encoding="utf-8")
    return path


def test_it_is_imported(dat, measured: Path) -> None:
    recording = gbid.import_recording(measured, MAPPING)
    np.testing.assert_array_equal(recording.signal("force")[:, 0], 0.5 * np.arange(200))
    wrong = {**MAPPING, "signals": {"force": {"columns": ["g"], "unit": "N"}}}
    with pytest.raises(DataError, match=r"one\.dat: no column 'g'; choose from t, f"):
        gbid.import_recording(measured, wrong)


def test_an_experiment_reads_it(dat, measured: Path, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(IMPORT, encoding="utf-8")
    assert [planned.name for planned in load_experiment(path).recordings.values()] == ["one"]


def test_without_the_constant_it_is_unknown(measured: Path, tmp_path: Path) -> None:
    measured.write_bytes(b"\x00\x01" * 200)
    with pytest.raises(
        DataError,
        match=r"unknown file ending '\.dat', and no text; expected text or one of \.parquet, .*\.csv, .*\.npz",
    ):
        gbid.import_recording(measured, MAPPING)
    path = tmp_path / "own.yaml"
    path.write_text(IMPORT, encoding="utf-8")
    with pytest.raises(ExperimentError, match=r"unknown ending '\.dat'"):
        load_experiment(path)
    assert ".dat" not in file_formats()


def test_its_channels_are_listed(dat, measured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed = json_of(capsys, "peek", str(measured))["channels"]
    assert [(row["channel"], row["samples"]) for row in listed] == [("t", 200), ("f", 200)]
