"""Readers in a process of their own: crashes, hangs, memory, and files that make libraries do that."""

import math
import os
import pickle
import signal
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
from places import ROOT, SUPPORT

import gbid
from gbid.core import apart as reader_process
from gbid.core.apart import read_apart
from gbid.core.errors import DataError
from gbid.recording.readers import PairResponse

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
        (bad_readers.endless, "time-out: its reader computed for more than 1 s; a file of this size needs far less"),
        (bad_readers.sleeping, "time-out: not read within 2 s; the drive answers late, or the machine is too busy"),
        (bad_readers.hungry, "needs more memory than the file can contain"),
        (bad_readers.raising, r"cannot be read, .*\(NotImplementedError: compression type 9\); save it again"),
        (bad_readers.attacking, "cannot be read"),
        (bad_readers.ending, r"its reader ended \(exit code 7\)"),
    ],
)
def test_what_a_library_does_is_an_error_of_the_file(file, reader, words, monkeypatch):
    monkeypatch.setattr(reader_process, "_SECONDS", 1.0 if reader is bad_readers.endless else 10.0)
    monkeypatch.setattr(reader_process, "_WAIT", 2.0 if reader is bad_readers.sleeping else 60.0)
    with pytest.raises(DataError, match=words) as caught:
        read_apart(reader, file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)
    monkeypatch.undo()
    assert read_apart(bad_readers.good, file, 3) == 3000  # the next file is read


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux confines the reader process")
@pytest.mark.parametrize("packages", [(), ("wave",)])
def test_a_library_can_only_read(file, packages):
    """Where it names packages, it has a folder for temporary files."""
    assert read_apart(bad_readers.unlocked, file, bool(packages), packages=packages) == []
    assert file.read_bytes() == bytes(1000)


@pytest.mark.parametrize(
    "answer",
    [
        pickle.dumps([bad_readers.Attack()]) + b"\n",
        b'[{"Attack": []}, null, 0, []]\n',
        b'[{"array": 0}, null, 0, [["|O8", [1]]]]\n' + bytes(8),
        b'[{"array": 0}, null, 0, [["<f8", [9e99]]]]\n',
        b'[{"array": 0}, null, 0, [["<f8", [1099511627776]]]]\n',
        b"[" * 100_000 + b"\n",
        b"[]\n",
    ],
)
def test_what_a_library_forges_is_an_error_of_the_file(file, answer):
    with pytest.raises(DataError, match=r"its reader answered with something else than data .*do not use it"):
        read_apart(bad_readers.forging, file, answer)


def test_values_come_back_as_they_were(file):
    sent = {"a": (1, None, True, "ä\n", -math.inf), ("b", 2): [np.array(3.5), np.zeros((0, 2), "<c8"), np.eye(3).T[:2]]}
    value = read_apart(
        bad_readers.returning, file, {**sent, "c": PairResponse(sent["a"], file, None)}, types=(PairResponse,)
    )
    assert value.pop("c") == PairResponse(sent["a"], file, None)
    assert repr(value) == repr(sent)
    assert [each.dtype for each in value["b", 2]] == [each.dtype for each in sent["b", 2]]


def test_only_processor_time_counts(file, monkeypatch):
    """On a busy machine, or by a slow drive, a good file takes long."""
    monkeypatch.setattr(reader_process, "_SECONDS", 0.5)
    assert read_apart(bad_readers.waiting, file, 1.2) == 1000


def test_limits_of_a_huge_file_are_those_of_the_machine(tmp_path):
    path = tmp_path / "a.mat"
    with path.open("wb") as made:
        made.truncate(1 << 42)
    limits = reader_process.limits_for(path)
    assert limits.seconds == 600
    assert limits.memory == reader_process.usable_memory() < 1 << 42


def test_a_file_that_is_gone_and_its_own_errors_are_raised_as_they_are(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_apart(bad_readers.good, tmp_path / "none", 1)
    path = tmp_path / "a.npz"
    np.savez(path, y=np.arange(200.0))
    with pytest.raises(DataError, match=r"no .*'z'"):
        gbid.import_recording(path, {**MAPPING, "signals": {"y": {"columns": ["z"], "unit": "m"}}})


CALLER = """\
import os, resource, signal, sys, threading, time
from pathlib import Path
resource.setrlimit(resource.RLIMIT_CPU, (9, 9))
import bad_readers
from gbid.core import apart
path = Path(sys.argv[1])
assert apart.read_apart(bad_readers.good, path, 1) == 1000
print(apart._process(os.getpid())._child.pid, flush=True)
if sys.argv[2] != "good":
    threading.Thread(target=apart.read_apart, args=(getattr(bad_readers, sys.argv[2]), path)).start()
    time.sleep(0.5)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("state", ["good", "sleeping", "holding"])
def test_the_process_ends_with_the_one_that_asked_in_every_state(file, state):
    """Idle, waiting, and within a library that lets no other thread run; within a hard limit of processor time, too."""
    ended = subprocess.run(
        [sys.executable, "-c", CALLER, file, state],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{SUPPORT}"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.stdout, ended.stderr
    number = int(ended.stdout)
    for _ in range(60):
        if not alive(number):
            return
        time.sleep(0.05)
    os.kill(number, signal.SIGKILL)
    pytest.fail(f"process {number} is still there")


def test_a_session_with_little_processor_time_says_so(file):
    code = CALLER[: CALLER.index("assert")].replace("9, 9", "2, 2") + "apart.read_apart(bad_readers.endless, path)"
    ended = subprocess.run(
        [sys.executable, "-c", code, file],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{SUPPORT}"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "time-out: its reader computed for more than the 2 s of processor time that this session" in ended.stderr


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
