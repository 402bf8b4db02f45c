"""A target of the export is a function in one file: command line and messages find it; controllers leave by it too."""

from __future__ import annotations

from pathlib import Path

import pytest
from experiment_files import gbid as run
from experiment_files import json_of, printed_by
from scipy.io import loadmat

import gbid
from gbid.control import controller_structure, scheduled
from gbid.export import targets


def write_names(item, request):
    path = request.folder / f"{item.name}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(", ".join(each.name for each in request.beside))
    return [path]


def test_a_new_target_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setitem(targets.TARGETS, "names", targets.ExportTarget(write_names, ("LPVModel",)))
    assert run("export", "theisen2016", "--to", "names", "--output", tmp_path / "out") == 0
    assert Path(capsys.readouterr().out.strip()).read_text() == "theisen2016"
    assert ", names, " in printed_by(capsys, "export", "theisen2016", "--to", "name", code=2).err


@pytest.mark.parametrize("to", ["c", "csv", "matlab", "yaml"])
def test_a_controller_file_is_exported(to: str, tmp_path: Path, capsys) -> None:
    gains = {"kappa_x": 0.9, "kappa_y": 0.8}
    path = tmp_path / "damper.yaml"
    design = gbid.save_controller(path, "P", gains, name="damper", sample_time=2e-4, plant="theisen2016")
    files = [Path(name) for name in json_of(capsys, "export", path, "--to", to, "--output", tmp_path / to)["files"]]
    assert all(file.is_file() and file.name.startswith("controller_damper") for file in files)
    if to == "matlab":
        data = loadmat(tmp_path / to / "controller_damper.mat")
        assert data["Ts"].item() == 2e-4
        assert (data["A"] == design.sampled_at().A).all()


def test_a_scheduled_controller_is_exported_at_its_points_or_at_one(tmp_path: Path, capsys) -> None:
    structure = scheduled(controller_structure("P"))
    gains = {p.name: 0.5 if p.name.endswith("_1") else 0.1 for p in structure.parameters}
    path = tmp_path / "damper.yaml"
    gbid.save_controller(path, structure, gains, name="damper", points=[(4, 0), (6.5, 3000)], sample_time=2e-4)
    names = {Path(line).name for line in printed_by(capsys, "export", path, "--output", tmp_path / "all").out.split()}
    assert {"controller_damper_p4_n0.mat", "controller_damper_p6_5_n3000.mat"} <= names
    assert run("export", path, "--at", 5, 1000, "--output", tmp_path / "one") == 0
    assert {Path(line).stem for line in capsys.readouterr().out.split()} == {"controller_damper_p5_n1000"}
    assert "outside" in printed_by(capsys, "export", path, "--at", 9, 1000, "--output", tmp_path / "two", code=2).err
