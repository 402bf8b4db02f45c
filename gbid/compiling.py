"""Compilation of C sources, once per machine, with a cache of the libraries."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from filelock import FileLock
from platformdirs import user_cache_path

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


class CompilerMissingError(Exception):
    """Error raised when no C compiler is found or when the compiler fails; the text gives the reason."""


def cache_folder() -> Path:
    """Return the folder of the compiled kernels.

    It is the folder named by the environment variable ``GBID_CACHE_DIR``, otherwise the cache folder of the user.
    """
    named = os.environ.get("GBID_CACHE_DIR")
    return Path(named) if named else user_cache_path("gbid", appauthor=False) / "kernels"


@cache
def load_library(source: str) -> ctypes.CDLL:
    """Return the shared library of a C source, compiled now or taken from the cache.

    The key of the cache is made of the source, the compiler, the flags and the processor. Processes that need the
    same library at the same time wait for one another. A file gets its final name only when it is complete.

    Parameters
    ----------
    source : str
        C source.

    Returns
    -------
    ctypes.CDLL
        The loaded library.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, when the compiler fails, or when the cache folder cannot be written.
    """
    command, identity = _compiler()
    key = hashlib.sha256("\0".join([source, identity, *FLAGS, _processor()]).encode()).hexdigest()[:32]
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        library = folder / f"{key}.so"
        with FileLock(folder / f"{key}.lock"):
            if not library.is_file():
                _compile(command, source, library)
            try:
                return ctypes.CDLL(str(library))
            except OSError:  # the file is damaged: compile it again
                _compile(command, source, library)
                return ctypes.CDLL(str(library))
    except OSError as error:
        raise CompilerMissingError(
            f"the cache of compiled kernels cannot be used: {error}; set GBID_CACHE_DIR to a folder that can be written"
        ) from None


def compile_shared(source: Path, library: Path, flags: Sequence[str]) -> None:
    """Compile a C file to a shared library for others than this process, with flags of its own.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, or when the compiler fails; the text has its first error.
    """
    command, _ = _compiler()
    _run(command, [*flags, str(source), "-o", str(library), "-lm"], source.name)


@cache
def _compiler() -> tuple[list[str], str]:
    """Return the command of the C compiler and the text of its version."""
    named = os.environ.get("CC", "")
    for candidate in [shlex.split(named)] if named else [["cc"], ["gcc"], ["clang"]]:
        if candidate and shutil.which(candidate[0]):
            version = subprocess.run([*candidate, "--version"], capture_output=True, text=True, check=False)
            if version.returncode == 0:
                return candidate, version.stdout
    raise CompilerMissingError(f"no C compiler found ({named or 'cc, gcc, clang'})")


@cache
def _processor() -> str:
    """Return a description of the processor, so that machines that share a cache do not share libraries."""
    info = Path("/proc/cpuinfo")
    flags = ""
    if info.is_file():
        lines = info.read_text().splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.system()} {platform.machine()} {platform.processor()} {flags}"


def _compile(command: list[str], source: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        text, built = Path(folder) / "kernel.c", Path(folder) / "kernel.so"
        text.write_text(source)
        _run(command, [*FLAGS, str(text), "-o", str(built)], "the kernel")
        built.replace(library)


def _run(command: list[str], arguments: list[str], what: str) -> None:
    """Run the compiler; its first line that names an error is the reason when it fails."""
    result = subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)
    if result.returncode != 0:
        said = (result.stderr.strip() or result.stdout.strip() or str(result.returncode)).splitlines()
        first = next((line for line in said if "error" in line), said[0])
        raise CompilerMissingError(f"{command[0]} failed on {what}: {first}")
