"""The cache of compiled libraries: whose it is, whether it is whole, and compilers that fail or hang."""

import json
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import fit_cases
import pytest
from compilers import NEEDS_COMPILER, SOURCE, forget_libraries, value_of
from filelock import FileLock
from fit_cases import MODE, MODE_AT, levels, simulated

import gbid
from gbid.core import compiled as compiler
from gbid.core import compiled as library
from gbid.core.compiled import CompilerMissingError, load_library

needs_owners = pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners on this system")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache folder that nothing was loaded from."""
    forget_libraries()
    monkeypatch.setenv("GBID_CACHE_DIR", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    monkeypatch.undo()
    forget_libraries()


@NEEDS_COMPILER
@needs_owners
def test_a_folder_that_others_may_write_to_is_not_used(folder):
    source = SOURCE.format(name="shared", value=2.5)
    assert load_library(source).note == ""
    (built,) = folder.glob("*.so")
    # What another user could have put there: a library of that name with another value, and its checksum.
    compiler.compile_source(compiler.find_compiler(), library.FLAGS, SOURCE.format(name="shared", value=666.0), built)
    built.write_bytes(library.with_checksum(built.read_bytes()))
    folder.chmod(0o777)
    load_library.cache_clear()
    loaded = load_library(source)
    assert value_of(loaded, "shared") == 2.5
    assert "other users may write to" in loaded.note
    assert "chmod go-w" in loaded.note


@NEEDS_COMPILER
@needs_owners
def test_a_library_that_others_may_write_to_is_built_anew(folder):
    source = SOURCE.format(name="open", value=2.5)
    load_library(source)
    (built,) = folder.glob("*.so")
    compiler.compile_source(compiler.find_compiler(), library.FLAGS, SOURCE.format(name="open", value=666.0), built)
    built.write_bytes(library.with_checksum(built.read_bytes()))
    built.chmod(0o777)
    load_library.cache_clear()
    assert value_of(load_library(source), "open") == 2.5
    assert not built.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH)


@NEEDS_COMPILER
def test_any_flipped_bit_of_a_library_is_noticed_before_it_is_loaded(folder, tmp_path):
    source = SOURCE.format(name="flip", value=4.5)
    load_library(source)
    (built,) = folder.glob("*.so")
    complete = built.read_bytes()
    for place in range(40, len(complete), len(complete) // 7):
        changed = bytearray(complete)
        changed[place] ^= 16
        other = tmp_path / f"at{place}"
        other.mkdir(mode=0o700)
        (other / built.name).write_bytes(changed)
        os.environ["GBID_CACHE_DIR"] = str(other)
        load_library.cache_clear()
        assert value_of(load_library(source), "flip") == 4.5
        assert (other / built.name).read_bytes()[40:2000] == complete[40:2000]


@NEEDS_COMPILER
def test_a_lock_that_is_held_is_told_and_gone_round(folder, monkeypatch):
    source = SOURCE.format(name="held", value=1.5)
    load_library(source)
    (lock,) = folder.glob("*.lock")
    (folder / f"{lock.stem}.holder").write_text("process 12345 on elsewhere")
    load_library.cache_clear()
    monkeypatch.setattr(library, "_PATIENCE_S", 0.1)
    with FileLock(lock):
        loaded = load_library(source)
    assert value_of(loaded, "held") == 1.5
    assert "process 12345 on elsewhere has held" in loaded.note


def script(tmp_path, lines):
    made = tmp_path / "my-cc"
    made.write_text(f'#!/bin/sh\n[ "$1" = --version ] && echo mine 1.0 && exit 0\n{lines}\n')
    made.chmod(0o755)
    return str(made)


def test_a_compiler_that_hangs_is_stopped_with_all_its_processes(folder, tmp_path, monkeypatch):
    marker = f"sleep 31.{os.getpid()}"
    monkeypatch.setenv("CC", script(tmp_path, f"{marker} & {marker}"))
    monkeypatch.setattr(compiler, "_LIMIT_S", 0.5)
    with pytest.raises(CompilerMissingError, match=r"my-cc did not end within 0\.5 s and was stopped"):
        load_library(SOURCE.format(name="hang", value=1.0))
    time.sleep(0.2)
    running = subprocess.run(["ps", "-eo", "stat,args"], capture_output=True, text=True, check=True).stdout
    assert not [line for line in running.splitlines() if marker in line and not line.startswith("Z")]
    assert [p.name for p in folder.iterdir() if not p.name.endswith(".lock")] == []


def test_a_compiler_that_writes_no_utf_8_is_quoted(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", script(tmp_path, r"printf '\377 no luck\n' >&2; exit 1"))
    with pytest.raises(CompilerMissingError, match="failed on the kernel: \ufffd no luck"):
        load_library(SOURCE.format(name="latin", value=1.0))


def test_an_open_quotation_mark_in_the_name_of_the_compiler_is_told(folder, monkeypatch):
    monkeypatch.setenv("CC", "gcc 'x")
    with pytest.raises(CompilerMissingError, match=r"CC = .*No closing quotation"):
        load_library(SOURCE.format(name="quote", value=1.0))


@NEEDS_COMPILER
def test_interrupting_the_compiler_leaves_nothing_behind(folder, tmp_path):
    """Ctrl-C while it compiles: the compiler ends with the process, and the cache has no file of it."""
    marker = f"sleep 32.{os.getpid()}"
    code = (
        "import os, signal, threading, gbid.core.compiled as c\n"
        "threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
        "try:\n    c.load_library('int x;')\nexcept KeyboardInterrupt:\n    print('interrupted')\n"
    )
    environment = {**os.environ, "CC": script(tmp_path, marker)}
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=25, env=environment, check=True
    )
    assert ended.stdout == "interrupted\n"
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert marker not in running
    assert [p.name for p in folder.iterdir() if not p.name.endswith(".lock")] == []


def test_the_compiler_of_ziglang_serves_where_there_is_no_other(folder, tmp_path):
    """A fit with the compiler that ``pip install gbid[compiler]`` brings has the figures of any other."""
    pytest.importorskip("ziglang", reason="the extra gbid[compiler] is not installed")
    recording = simulated(MODE, MODE_AT, levels(400), noise=0.01)
    usual = gbid.fit(MODE, recording, focus="simulation")
    gbid.save(recording, tmp_path / "recording.h5")
    code = (
        "import json, gbid, gbid.core.compiled as c; from fit_cases import MODE\n"
        f"result = gbid.fit(MODE, gbid.load({str(tmp_path / 'recording.h5')!r}), focus='simulation')\n"
        "print(json.dumps([c.find_compiler().command[1:], result.parameters]))\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "CC"}
    environment |= {
        "PATH": str(tmp_path),
        "PYTHONPATH": str(Path(fit_cases.__file__).parent),
        "GBID_CACHE_DIR": str(tmp_path / "without"),
        "ZIG_GLOBAL_CACHE_DIR": str(tmp_path / "zig"),
    }
    ended = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", code], capture_output=True, text=True, env=environment
    )
    assert ended.returncode == 0, ended.stderr
    command, parameters = json.loads(ended.stdout)
    assert command == ["-P", "-m", "ziglang", "cc"]
    assert list((tmp_path / "without").glob("*.so"))
    for name in usual.free:
        assert abs(parameters[name] - usual.parameters[name]) <= 1e-6 * usual.std[name], name
