"""Another package adds a file format, an export target and a structure by entry points, without a change here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from experiment_files import json_of, printed_by

import gbid
from gbid.core.errors import UsageError

PACKAGE = """
import numpy as np
from gbid import LinearStructure, Parameter
from gbid.export.targets import ExportTarget
from gbid.recording.columns import FileColumn
from gbid.recording.readers import FileChannel, FileFormat

def read(path, references):
    table = np.loadtxt(path, delimiter="|", ndmin=2)
    return {name: FileColumn(table[:, "ab".index(name)]) for name in references}

def write(item, request):
    path = request.folder / f"{item.name}.txt"
    path.write_text(item.kind)
    return [path]

def matrices(p):
    return {"A": [[-p.a]], "B": [[p.a]], "C": [[1]]}

def channels(path):
    return [FileChannel(name, len(np.loadtxt(path, delimiter="|"))) for name in "ab"]

bars = FileFormat((".bars",), read, channels)
names = ExportTarget(write, ("LPVModel",))
lag = LinearStructure("lag", [Parameter("a", 10.0)], matrices, inputs="u", outputs="y")
"""
ENTRY_POINTS = """\
[gbid.formats]
bars = others_rig:bars
wrong = others_rig:lag

[gbid.targets]
names = others_rig:names
wrong = others_rig:lag
broken = no_such_module:target

[gbid.structures]
lag = others_rig:lag
"""
EXPERIMENT = """\
format: 1
name: own
import:
  data_folder: data
  recordings:
    - name: one
      file: one.bars
      sample_time_s: 1.0e-2
      signals: {u: {columns: [a], unit: V, stored_unit: V}, y: {columns: [b], unit: V, stored_unit: V}}
fits:
  lag: {structure: lag, focus: simulation}
"""


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package as pip installs it."""
    info = tmp_path / "site" / "others_rig-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others-rig\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "site" / "others_rig.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path / "site")


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    path = tmp_path / "data" / "one.bars"
    path.parent.mkdir()
    u = np.random.default_rng(1).choice([-1.0, 1.0], 400)
    y = np.zeros(400)
    for k in range(399):
        y[k + 1] = np.exp(-0.05) * y[k] + (1 - np.exp(-0.05)) * u[k]
    np.savetxt(path, np.column_stack([u, y]), delimiter="|")
    return path


def test_its_format_is_imported_and_listed(measured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapping = {"sample_time_s": 1e-2, "signals": {"u": {"columns": ["a"], "unit": "V", "stored_unit": "V"}}}
    assert gbid.import_recording(measured, mapping).n_samples == 400
    assert [row["channel"] for row in json_of(capsys, "peek", str(measured))["channels"]] == ["a", "b"]


def test_its_target_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (path,) = json_of(capsys, "export", "theisen2016", "--to", "names", "--output", tmp_path / "out")["files"]
    assert Path(path).read_text() == "LPVModel"
    assert "names" not in printed_by(capsys, "export", "theisen2016", "--to", "name", code=2).err  # not gbid's own


def test_its_structure_is_fitted_in_an_experiment(measured: Path, tmp_path: Path, capsys) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(EXPERIMENT, encoding="utf-8")
    json_of(capsys, "run", str(path))
    fit = gbid.load(next(tmp_path.rglob("lag/**/*.h5")))
    assert fit.parameters["a"] == pytest.approx(5.0, rel=1e-6)


def test_what_it_offers_wrongly_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, words in (("wrong", "others-rig 1.0 offers a LinearStructure"), ("broken", "others-rig 1.0 fails on")):
        assert words in printed_by(capsys, "export", "theisen2016", "--to", name, code=2).err
    (tmp_path / "two.wrong").write_bytes(b"\x00\x01")
    with pytest.raises(UsageError, match=r"'\.wrong' \(gbid\.formats\): others-rig 1\.0 offers a LinearStructure"):
        gbid.import_recording(tmp_path / "two.wrong", {"sample_time_s": 1.0, "signals": {"u": {"columns": ["a"]}}})
