"""Compiled kernels: the C compiler of this machine, shared libraries, and their cache folder.

A library runs with the rights of the user. It is therefore taken only from folders in which nobody else can write,
which is the rule of ssh for its keys.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
import logging
import os
import platform
import shlex
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from platformdirs import user_cache_path

from gbid.core.errors import DataError
from gbid.core.files import atomic_path, has_valid_checksum, remove_stale_parts, scratch_folder, with_checksum

_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_folder() -> Path:
    """Return the cache folder of the compiled kernels.

    It is the folder named by the environment variable ``GBID_CACHE_DIR``, otherwise the cache folder of the user.
    """
    named = os.environ.get("GBID_CACHE_DIR")
    return Path(named) if named else user_cache_path("gbid", appauthor=False) / "kernels"


@cache
def private_folder() -> Path:
    """Return a new folder of this process, which is removed when the process ends."""
    with contextlib.suppress(OSError):  # those of processes that were killed
        remove_stale_parts(Path(tempfile.gettempdir()), ".scratch.*")
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(scratch_folder(Path(tempfile.gettempdir()) / "kernels"))


def why_not_trusted(path: Path) -> str:
    """Return why another user could have written a file or folder; empty text when nobody else could.

    Parameters
    ----------
    path : pathlib.Path
        An existing file or folder. The folders above it are examined as well: who may write there may replace it.
    """
    if not hasattr(os, "getuid"):  # no owners of this kind
        return ""
    trusted_owners = (os.getuid(), 0)
    real = path.resolve()
    for place in (real, *real.parents):
        status = place.stat()
        if status.st_uid not in trusted_owners:
            return f"{place} belongs to another user"
        shared_safely = place != real and status.st_mode & stat.S_ISVTX  # as /tmp: entries are their owners'
        if status.st_mode & _OTHERS_MAY_WRITE and not shared_safely:
            return f"other users may write to {place}"
    return ""


_LIMIT_S = 120.0  # a kernel takes 2 to 6 s, several times as much on a busy machine


class CompilerMissingError(Exception):
    """Error raised when no C compiler is found or when the compiler fails; the text gives the reason."""


class Compiler(NamedTuple):
    """C compiler: its command, and the text of its version."""

    command: tuple[str, ...]
    version: str


@cache
def find_compiler() -> Compiler:
    """Return the compiler: the environment variable ``CC``, else cc, gcc, clang, or the package ``ziglang``.

    The Python package ``ziglang`` brings a C compiler (clang); ``pip install gbid[compiler]`` installs it.

    Raises
    ------
    CompilerMissingError
        When there is none.
    """
    named = os.environ.get("CC", "")
    try:
        candidates = [shlex.split(named)] if named else [["cc"], ["gcc"], ["clang"], *_packaged()]
    except ValueError as error:  # an open quotation mark
        raise CompilerMissingError(f"no C compiler found (CC = {named!r}: {error})") from None
    for command in candidates:
        if command and shutil.which(command[0]):
            ended = _run([*command, "--version"])
            if ended.returncode == 0:
                return Compiler(tuple(command), ended.stdout)
    raise CompilerMissingError(f"no C compiler found ({named or 'cc, gcc, clang, ziglang'})")


def _packaged() -> list[list[str]]:
    return [[sys.executable, "-P", "-m", "ziglang", "cc"]] if find_spec("ziglang") else []


def compile_source(compiler: Compiler, flags: Sequence[str], source: str, library: Path) -> None:
    """Compile a C source, given to the compiler by a pipe, to a shared library.

    Raises
    ------
    CompilerMissingError
        When the compiler fails, or takes longer than its time limit.
    """
    _compile(compiler, [*flags, "-x", "c", "-", "-o", str(library)], library, "the kernel", source)


def compile_shared(source: Path, library: Path, flags: Sequence[str]) -> None:
    """Compile a C file with given flags to a shared library that other processes load.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, or when the compiler fails; the text has its first error.
    """
    _compile(find_compiler(), [*flags, str(source), "-o", str(library), "-lm"], library, source.name)


def _compile(compiler: Compiler, arguments: Sequence[str], library: Path, what: str, given: str = "") -> None:
    """Run the compiler; if it fails, raise an error with the first line of output that names an error.

    Its temporary files are beside the library: when all is killed, the next build removes them.
    """
    with scratch_folder(library) as scratch:
        ended = _run([*compiler.command, *arguments], given, scratch)
    if ended.returncode != 0:
        messages = (ended.stderr.strip() or ended.stdout.strip() or str(ended.returncode)).splitlines()
        first = next((line for line in messages if "error" in line), messages[0])
        raise CompilerMissingError(f"{compiler.command[0]} failed on {what}: {first}")


def _run(command: Sequence[str], given: str = "", scratch: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command with a time limit; all its child processes end with it, also after Ctrl-C."""
    try:
        begun = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
            env=None if scratch is None else {**os.environ, "TMPDIR": str(scratch)},
        )
    except OSError as error:
        raise CompilerMissingError(f"{command[0]} cannot be started: {error.strerror or error}") from None
    with begun:
        try:
            out, err = begun.communicate(given, timeout=_LIMIT_S)
        except subprocess.TimeoutExpired:
            raise CompilerMissingError(f"{command[0]} did not end within {_LIMIT_S:g} s and was stopped") from None
        finally:
            _end(begun)
    return subprocess.CompletedProcess(command, begun.returncode, out, err)


def _end(begun: subprocess.Popen[str]) -> None:
    """End a process and its child processes."""
    if begun.returncode is not None:
        return
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(begun.pid, signal.SIGKILL)
    else:
        begun.kill()
    begun.wait()


@cache
def c_source(package: str, name: str) -> str:
    """Return a C file of a package, with vectors.c in place of ``@VECTORS@`` (vectors of the target processor)."""
    text = files(package).joinpath(name).read_text(encoding="utf-8")
    return text if "@VECTORS@" not in text else text.replace("@VECTORS@", c_source("gbid.core", "vectors.c").rstrip())


# Sums may be reordered, but not -ffast-math: a library linked with it makes the whole process flush small numbers
# to zero.
FLAGS = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-ffp-contract=fast",
    "-fPIC",
    "-shared",
    "-w",
)
"""Flags of the compiler for the kernels of fits and of the rig."""

_PATIENCE_S = 150.0  # longest wait for another process that compiles the same source


class Library(ctypes.CDLL):
    """Shared library that this process has loaded.

    Attributes
    ----------
    note : str
        Reason why it does not come from the cache folder; else empty.
    """

    note = ""


@cache
def load_library(source: str, flags: tuple[str, ...] = FLAGS) -> Library:
    """Return the shared library of a C source, from the cache or compiled now.

    The key of the cache is made of the source, the compiler, the flags and the processor. Processes that need the
    same library at the same time wait for one another. A file gets its final name only when it is complete, and ends
    with a checksum: a library that is damaged is compiled again, and is not loaded. When other users may write to the
    cache folder, or another process holds the library for long, it is compiled into a folder of this process.

    The flags in the environment variable ``GBID_CFLAGS`` follow the others: with ``-O1`` kernels are compiled in a
    third of the time, and fits take up to a quarter longer.

    Parameters
    ----------
    source : str
        C source.
    flags : tuple of str
        Flags of the compiler.

    Returns
    -------
    Library
        The loaded library.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, when the compiler fails, or when the cache folder cannot be written.
    """
    from filelock import FileLock, Timeout

    compiler, flags = find_compiler(), (*flags, *os.environ.get("GBID_CFLAGS", "").split())
    key = hashlib.sha256("\0".join([source, compiler.version, *flags, _processor()]).encode()).hexdigest()[:32]
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if reason := why_not_trusted(folder):
            return _built_apart(compiler, flags, source, key, f"{reason}: chmod go-w it, or set GBID_CACHE_DIR")
        holder = folder / f"{key}.holder"
        try:
            with FileLock(folder / f"{key}.lock", timeout=_PATIENCE_S):
                holder.write_text(f"process {os.getpid()} on {socket.gethostname()}")
                try:
                    return _current(compiler, flags, source, folder / f"{key}.so")
                finally:
                    holder.unlink(missing_ok=True)
        except Timeout:
            who = holder.read_text(errors="replace") if holder.is_file() else "another process"
            reason = f"{who} has held {folder / key}.lock for more than {_PATIENCE_S:g} s"
            return _built_apart(compiler, flags, source, key, reason)
    except (OSError, DataError) as error:
        raise CompilerMissingError(
            f"the cache of compiled kernels cannot be used: {error}; set GBID_CACHE_DIR to a folder that can be written"
        ) from None


def run_compiled(
    function: Any,
    sizes: Sequence[int],
    arrays: Sequence[npt.NDArray[Any]],
    results: Sequence[npt.NDArray[Any] | None],
) -> None:
    """Call a compiled function with sizes (long), input arrays, and contiguous output arrays or NULL."""
    given = [np.ascontiguousarray(array) for array in arrays]  # kept until the call has ended
    function.restype = None
    pointers = [  # by the interface: half the time of array.ctypes
        None if array is None else ctypes.c_void_p(array.__array_interface__["data"][0]) for array in [*given, *results]
    ]
    function(*map(ctypes.c_long, sizes), *pointers)


def _current(compiler: Compiler, flags: tuple[str, ...], source: str, library: Path) -> Library:
    """Return the library from the cache, or compiled if the cached file is damaged or belongs to another user."""
    try:
        if library.is_file() and not why_not_trusted(library) and has_valid_checksum(library):
            return Library(str(library))
    except (OSError, DataError):  # damaged, or of another architecture
        pass
    remove_stale_parts(library.parent)
    return _built(compiler, flags, source, library)


_LONG = 10_000  # characters of a source whose compilation takes seconds, of which a verb tells


def _built(compiler: Compiler, flags: tuple[str, ...], source: str, library: Path) -> Library:
    if len(source) > _LONG:
        logging.getLogger("gbid.core.compiled").info(
            "compiling, once for this model and machine (%d kB of C, some seconds)", len(source) // 1000
        )
    with atomic_path(library, overwrite=True) as part:
        compile_source(compiler, flags, source, part)
        part.write_bytes(with_checksum(part.read_bytes()))  # what follows the end of a library is ignored
    library.chmod(0o700)
    return Library(str(library))


def _built_apart(compiler: Compiler, flags: tuple[str, ...], source: str, key: str, reason: str) -> Library:
    """Return the library, compiled into a private folder because the cache cannot be used."""
    library = _built(compiler, flags, source, private_folder() / f"{key}.so")
    library.note = f"the cache of compiled kernels was not used: {reason}"
    return library


@cache
def _processor() -> str:
    """Return a description of the processor, so that machines that share a cache do not share libraries."""
    info = Path("/proc/cpuinfo")
    flags = ""
    if info.is_file():
        lines = info.read_text().splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.system()} {platform.machine()} {platform.processor()} {flags}"
