"""Readers in a process of their own: crashes, hangs, memory, and files that make libraries do that."""

import subprocess
import sys
import time
import zipfile
from pathlib import Path

import bad_readers
import h5py
import numpy as np
import pytest
from campaign_files import alive

import gbid
from gbid.core import apart as reader_process
from gbid.core.apart import read_apart
from gbid.core.errors import DataError

MAPPING = {"sample_time": 1e-3, "signals": {"y": {"columns": ["y"], "unit": "m"}}}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(1000))
    return path


def test_answers_come_back_whatever_a_library_prints(file):
    assert [read_apart(bad_readers.good, file, k) for k in (1, 2)] == [1000, 2000]


def test_a_relative_path_counts_from_the_folder_of_the_request(file, monkeypatch):
    read_apart(bad_readers.good, file, 1)  # the process is there, in another folder
    monkeypatch.chdir(file.parent)
    assert read_apart(bad_readers.good, Path(file.name), 1) == 1000


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        (bad_readers.crashing, r"its reader crashed \(SIGABRT\); the file is damaged"),
        (bad_readers.endless, "did not end within 1 s|computed for more than 1 s"),
        (bad_readers.sleeping, "did not end within 1 s"),
        (bad_readers.hungry, "needs more memory than the file can contain"),
        (bad_readers.raising, r"cannot be read, .*\(NotImplementedError: compression type 9\); save it again"),
        (bad_readers.ending, r"its reader ended \(exit code 7\)"),
    ],
)
def test_what_a_library_does_is_an_error_of_the_file(file, reader, words, monkeypatch):
    monkeypatch.setattr(reader_process, "_SECONDS", 1.0 if "1 s" in words else 10.0)
    with pytest.raises(DataError, match=words) as caught:
        read_apart(reader, file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)
    assert read_apart(bad_readers.good, file, 3) == 3000  # the next file is read


def test_a_file_that_is_gone_and_its_own_errors_are_raised_as_they_are(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_apart(bad_readers.good, tmp_path / "none", 1)
    path = tmp_path / "a.npz"
    np.savez(path, y=np.arange(200.0))
    with pytest.raises(DataError, match=r"no .*'z'"):
        gbid.import_recording(path, {**MAPPING, "signals": {"y": {"columns": ["z"], "unit": "m"}}})


def test_the_process_ends_with_the_one_that_asked(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, y=np.sin(np.arange(200.0)))
    code = (
        "import gbid, os, signal, sys\n"
        "from gbid.core import apart as r\n"
        f"gbid.import_recording({str(path)!r}, {MAPPING!r})\n"
        "print(r._process(os.getpid())._child.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    number = int(ended.stdout)
    for _ in range(100):
        if not alive(number):
            return
        time.sleep(0.05)
    pytest.fail(f"process {number} is still there")


def bomb_h5(path):
    with h5py.File(path, "w") as made:
        made.create_dataset("y", shape=(1 << 40,), dtype="f8", chunks=(1 << 16,), compression="gzip")


def bomb_npz(path):
    """Header of an array of 8 TiB in a small file."""
    np.savez(path, y=np.arange(200.0))
    with zipfile.ZipFile(path) as archive:
        content = archive.read("y.npy")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("y.npy", content.replace(b"(200,)", b"(1099511627776,)".ljust(6))[: len(content) + 10])


def zeros_npz(path):
    """A quarter of a gigabyte of zeros, compressed to a quarter of a megabyte."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("y.npy", "w", force_zip64=True) as y:
        np.lib.format.write_array_header_1_0(y, {"descr": "<f8", "fortran_order": False, "shape": (1 << 25,)})
        for _ in range(1 << 5):
            y.write(bytes(1 << 23))


@pytest.mark.parametrize(("make", "name"), [(bomb_h5, "a.h5"), (bomb_npz, "a.npz"), (zeros_npz, "a.npz")])
def test_files_that_declare_more_than_they_contain_are_refused(tmp_path, make, name, monkeypatch):
    monkeypatch.setattr(reader_process, "_MEMORY", 1 << 27)
    path = tmp_path / name
    make(path)
    with pytest.raises(DataError, match=f"{name}: (cannot be read|its reader needs more memory|not a readable)"):
        gbid.import_recording(path, MAPPING)
