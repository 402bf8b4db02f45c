"""The C compiler of this machine: it is found once, and has a time limit."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from gbid.atomic import scratch_folder

_LIMIT_S = 120.0  # a kernel takes 2 to 6 s, several times as much on a busy machine


class CompilerMissingError(Exception):
    """Error raised when no C compiler is found or when the compiler fails; the text gives the reason."""


class Compiler(NamedTuple):
    """Compiler with the text of its version."""

    command: tuple[str, ...]
    version: str


@cache
def find_compiler() -> Compiler:
    """Return the compiler named by the environment variable ``CC``, otherwise cc, gcc or clang.

    Raises
    ------
    CompilerMissingError
        When there is none.
    """
    named = os.environ.get("CC", "")
    try:
        candidates = [shlex.split(named)] if named else [["cc"], ["gcc"], ["clang"]]
    except ValueError as error:  # an open quotation mark
        raise CompilerMissingError(f"no C compiler found (CC = {named!r}: {error})") from None
    for command in candidates:
        if command and shutil.which(command[0]):
            ended = _run([*command, "--version"])
            if ended.returncode == 0:
                return Compiler(tuple(command), ended.stdout)
    raise CompilerMissingError(f"no C compiler found ({named or 'cc, gcc, clang'})")


def compile_source(compiler: Compiler, flags: Sequence[str], source: str, library: Path) -> None:
    """Compile a C source, which the compiler reads from a pipe, to a shared library.

    Raises
    ------
    CompilerMissingError
        When the compiler fails, or takes longer than its time limit.
    """
    _compile(compiler, [*flags, "-x", "c", "-", "-o", str(library)], library, "the kernel", source)


def compile_shared(source: Path, library: Path, flags: Sequence[str]) -> None:
    """Compile a C file to a shared library for others than this process, with flags of its own.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, or when the compiler fails; the text has its first error.
    """
    _compile(find_compiler(), [*flags, str(source), "-o", str(library), "-lm"], library, source.name)


def _compile(compiler: Compiler, arguments: Sequence[str], library: Path, what: str, given: str = "") -> None:
    """Run the compiler; its first line that names an error is the reason when it fails.

    Its temporary files are beside the library: when all is killed, the next build removes them.
    """
    with scratch_folder(library) as scratch:
        ended = _run([*compiler.command, *arguments], given, scratch)
    if ended.returncode != 0:
        said = (ended.stderr.strip() or ended.stdout.strip() or str(ended.returncode)).splitlines()
        first = next((line for line in said if "error" in line), said[0])
        raise CompilerMissingError(f"{compiler.command[0]} failed on {what}: {first}")


def _run(command: Sequence[str], given: str = "", scratch: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command with a time limit; all its processes end with it, also after Ctrl-C."""
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
    """End a process and those that it begun."""
    if begun.returncode is not None:
        return
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(begun.pid, signal.SIGKILL)
    else:
        begun.kill()
    begun.wait()
