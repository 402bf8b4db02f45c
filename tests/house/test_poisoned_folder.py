"""Python files beside the data are never executed: a folder full of them, with the name of every module."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import bad_readers
import pytest
from campaign_files import poison

from gbid.core.apart import ReaderProcess, limits_for
from gbid.core.compiled import _packaged
from gbid.experiment.engines import READY, ProcessPool


@pytest.fixture
def executed(tmp_path, monkeypatch):
    """The note of what was executed; the current folder is the one with the files. `test_campaign_dask` has Dask's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    return poison(tmp_path)


@pytest.mark.parametrize(
    "command",
    [
        [str(Path(sys.executable).with_name("gbid")), "--version"],
        [sys.executable, "-P", "-m", "gbid", "--version"],
        [*(_packaged() or [["true"]])[0], "--version"],
    ],
    ids=["command", "module", "packaged compiler"],
)
def test_python_files_beside_the_data_are_not_executed(executed, command):
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert executed.read_text() == ""
    assert ended.returncode == 0, ended.stderr


def test_without_its_option_p_python_itself_loads_importlib_before_it_comes_to_gbid(executed):
    subprocess.run([sys.executable, "-m", "gbid", "--version"], capture_output=True, timeout=120, check=False)
    assert set(executed.read_text().split()) <= {"importlib"}  # unless a .pth file of an installed package loaded it


def test_nor_by_the_reader_of_foreign_files(executed):
    path = executed.parent / "csv.py"
    with closing(ReaderProcess()) as reader:
        assert reader.ask(limits_for(path), bad_readers.good, path, (1,), (), ()) == len(path.read_bytes())
    assert executed.read_text() == ""


def test_nor_by_the_workers_of_a_pool(executed):
    with closing(ProcessPool(1)) as pool:
        pool._start(1, b"")
        assert pool._workers[0].connection.recv() == READY
    assert executed.read_text() == ""
