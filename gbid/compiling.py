"""C sources compiled once per machine and kept in a cache."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
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
    """No C compiler, or one that cannot build the kernel; the text says which."""


def cache_folder() -> Path:
    """Folder of compiled kernels: ``GBID_CACHE_DIR`` or the user's cache."""
    named = os.environ.get("GBID_CACHE_DIR")
    return Path(named) if named else user_cache_path("gbid", appauthor=False) / "kernels"


@cache
def load_library(source: str) -> ctypes.CDLL:
    """Compile a source, or take it from the cache, and load it.

    The cache is keyed by source, compiler, flags and processor. Processes that want the same kernel at the
    same time wait for one another; a file appears under its name only when complete.

    Parameters
    ----------
    source : str
        C source.

    Returns
    -------
    ctypes.CDLL

    Raises
    ------
    CompilerMissingError
        When there is no compiler, it fails, or no folder can be written.
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
            except OSError:  # damaged on disk: make it anew
                _compile(command, source, library)
                return ctypes.CDLL(str(library))
    except OSError as error:
        raise CompilerMissingError(f"the cache of compiled kernels cannot be used: {error}") from None


@cache
def _compiler() -> tuple[list[str], str]:
    """Command of the C compiler and the version it states."""
    named = os.environ.get("CC", "")
    for candidate in [shlex.split(named)] if named else [["cc"], ["gcc"], ["clang"]]:
        if candidate and shutil.which(candidate[0]):
            answer = subprocess.run([*candidate, "--version"], capture_output=True, text=True, check=False)
            if answer.returncode == 0:
                return candidate, answer.stdout
    raise CompilerMissingError(f"no C compiler found ({named or 'cc, gcc, clang'})")


@cache
def _processor() -> str:
    """Describe the processor, so that a cache shared by several machines serves each its own."""
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
        answer = subprocess.run(
            [*command, *FLAGS, str(text), "-o", str(built)], capture_output=True, text=True, check=False
        )
        if answer.returncode != 0:
            first = (answer.stderr.strip() or answer.stdout.strip()).splitlines()[:1]
            raise CompilerMissingError(f"{command[0]} failed on the kernel: {first[0] if first else answer.returncode}")
        built.replace(library)
