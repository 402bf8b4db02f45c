"""Results can be looked at where nothing can be written: on a disk for reading only, beside a run, without a home."""

import os
import subprocess
import sys

import pytest
from experiment_files import gbid, write_spring
from places import ROOT

from gbid.experiment.campaign import locked


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    path = write_spring(tmp_path_factory.mktemp("spring"))
    assert gbid("import", path) == 0
    assert gbid("fit", path) == 0
    return path


def stamps(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_verbs_that_look_need_no_lock_and_write_elsewhere(spring, tmp_path, capsys):
    results = spring.parent / "results/spring"
    with locked(results):
        before = stamps(spring.parent)
        assert gbid("run", spring) == 2
        assert "another gbid is working in this folder" in capsys.readouterr().err
        assert gbid("check", spring) == 0
        assert gbid("report", spring, "--output", tmp_path / "report.html") == 0
        assert gbid("export", spring, "--to", "csv", "--output", tmp_path / "tables") == 0
        assert stamps(spring.parent) == before
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert len(list((tmp_path / "tables").iterdir())) == 6


def test_without_a_home_folder_there_are_no_lines_of_other_libraries(spring, tmp_path):
    words = ["report", spring, "--output", tmp_path / "report.html"]
    home = dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"), str(spring))  # a file
    run = subprocess.run(
        [sys.executable, "-m", "gbid.cli.main", *words],
        env={**os.environ, **home, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0
    said = [line.partition(" (")[0] for line in run.stderr.splitlines()]
    assert said == ["report report.html: made", f"next: gbid export {spring} --to matlab"]
