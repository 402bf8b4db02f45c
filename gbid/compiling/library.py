"""Shared library of a C source, compiled now or taken from the cache."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import socket
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout

from gbid.atomic import atomic_path, remove_stale_parts
from gbid.compiling.cache_folder import cache_folder, private_folder, why_not_trusted
from gbid.compiling.compiler import Compiler, CompilerMissingError, compile_source, find_compiler
from gbid.errors import DataError
from gbid.files.checksum import has_valid_checksum, with_checksum

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
    """Loaded shared library.

    Attributes
    ----------
    note : str
        Reason why it does not come from the cache folder; else empty.
    """

    note = ""


@cache
def load_library(source: str, flags: tuple[str, ...] = FLAGS) -> Library:
    """Return the shared library of a C source, compiled now or taken from the cache.

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


def _current(compiler: Compiler, flags: tuple[str, ...], source: str, library: Path) -> Library:
    """Return the library from the cache if it is whole and the user's own; else compile it."""
    try:
        if library.is_file() and not why_not_trusted(library) and has_valid_checksum(library):
            return Library(str(library))
    except (OSError, DataError):  # damaged, or of another architecture
        pass
    remove_stale_parts(library.parent)
    return _built(compiler, flags, source, library)


def _built(compiler: Compiler, flags: tuple[str, ...], source: str, library: Path) -> Library:
    with atomic_path(library, overwrite=True) as part:
        compile_source(compiler, flags, source, part)
        part.write_bytes(with_checksum(part.read_bytes()))  # what follows the end of a library is ignored
    library.chmod(0o700)
    return Library(str(library))


def _built_apart(compiler: Compiler, flags: tuple[str, ...], source: str, key: str, reason: str) -> Library:
    """Return the library, compiled into a folder of this process."""
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
