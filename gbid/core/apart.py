"""Reader process for libraries that may crash, never return or fill the memory on a damaged file.

One process serves all files that are read one after the other. It has limits of time and memory for each. When a
library crashes or exceeds a limit, the process ends and the next file gets a new one.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from gbid.core.errors import DataError, GbidError
from gbid.core.files import library_errors

T = TypeVar("T")

_SECONDS = 10.0  # longest time for a small file
_BYTES_PER_SECOND = 5e6  # larger files have more
_MEMORY = 1 << 30  # most memory for a small file, in bytes
_MEMORY_PER_BYTE = 10
_START = """\
import sys
sys.path += [folder for folder in {!r} if folder not in sys.path]
from gbid.core.apart import serve
serve()
"""


def read_apart(read: Callable[..., T], path: Path, *arguments: Any) -> T:
    """Return ``read(path, *arguments)``, computed in the process for readers.

    Parameters
    ----------
    read : callable
        Function of a module; another process imports it.
    path : pathlib.Path
        The file.
    *arguments
        Further arguments, which can be pickled.

    Raises
    ------
    GbidError
        As `read` raises it.
    OSError
        When the file cannot be read.
    DataError
        When the reader fails in another way: it crashes, exceeds the limits, or raises an error of its library.
    """
    answer: T = _process(os.getpid()).ask(limits_for(path), read, path, arguments)
    return answer


class ReaderLimits(NamedTuple):
    """Limits for one file: time [s], and memory [bytes] beside that of the process itself."""

    seconds: float
    memory: int


def limits_for(path: Path) -> ReaderLimits:
    """Return the limits for a file by its size.

    Raises
    ------
    OSError
        When there is no such file.
    """
    size = path.stat().st_size
    return ReaderLimits(_SECONDS + size / _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * size)


class ReaderProcess:
    """The process, started at its first request."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None

    def ask(self, limits: ReaderLimits, read: Callable[..., Any], path: Path, arguments: tuple[Any, ...]) -> Any:
        """Return the answer to a request; see `read_apart`."""
        with self._lock:
            child = self._child = self._child if self._child and self._child.poll() is None else _started()
            timer = threading.Timer(limits.seconds, child.kill)
            answer = None
            timer.start()
            try:
                folder = None if path.is_absolute() else Path.cwd()  # that of the process may be another
                answer = _answer(child, (limits, folder, read, path, *arguments))
            finally:
                in_time = timer.is_alive()
                timer.cancel()
                if answer is None:  # crashed, killed or interrupted: the next request gets another process
                    self._end()
        if answer is None:
            raise DataError(
                f"{path}: {_reason(child.returncode, limits.seconds, in_time)}; the file is damaged: save it again"
            )
        value, error = answer
        if error is not None:
            raise error
        return value

    def close(self) -> None:
        """End the process."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        for pipe in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):  # a request that the process did not read
                if pipe is not None:
                    pipe.close()
        child.wait()


@cache
def _process(_owner: int) -> ReaderProcess:  # a forked process has another number: it starts one of its own
    process = ReaderProcess()
    atexit.register(process.close)
    return process


def _started() -> subprocess.Popen[bytes]:
    # Arrow would reserve a gigabyte of addresses, which counts as memory.
    added = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
    child = subprocess.Popen(
        [sys.executable, "-P", "-c", _START.format(_import_folders())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **added},
        start_new_session=True,  # Ctrl-C is for the process that waits
    )
    if child.stdout is not None:
        child.stdout.readline()  # it is ready: its start does not count
    return child


def _import_folders() -> list[str]:
    """Return the folders of this process from which another one may import what it finds nowhere else.

    The current folder and that of a script are none of them: the data may lie there.
    """
    script = str(Path(sys.argv[0]).absolute().parent) if sys.argv else ""
    package = str(Path(__file__).resolve().parents[2])
    return [*(folder for folder in sys.path if folder not in ("", str(Path.cwd()), script)), package]


def _answer(child: subprocess.Popen[bytes], request: tuple[Any, ...]) -> tuple[Any, BaseException | None] | None:
    """Send a request and return the pair (value, error) of the process; None if the process ended."""
    if child.stdin is None or child.stdout is None:
        return None
    try:
        pickle.dump(request, child.stdin)
        child.stdin.flush()
        answer: tuple[Any, BaseException | None] = pickle.load(child.stdout)  # from our own process
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
    return answer


def _reason(code: int, seconds: float, in_time: bool) -> str:
    if not in_time:
        return f"its reader did not end within {seconds:.0f} s"
    if -code == getattr(signal, "SIGXCPU", None):
        return f"its reader computed for more than {seconds:.0f} s"
    with contextlib.suppress(ValueError):
        return f"its reader crashed ({signal.Signals(-code).name})"
    return f"its reader ended (exit code {code})"


def serve() -> None:
    """Answer requests from the standard input until it ends."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not come between the answers
    answers.write(b"ready\n")
    answers.flush()
    while True:
        try:
            limits, folder, read, path, *arguments = pickle.load(requests)  # from the process that started this one
        except EOFError:
            return
        _set(limits)
        if folder is not None:
            os.chdir(folder)
        pickle.dump(_outcome(read, path, arguments), answers)
        answers.flush()


def _outcome(read: Callable[..., Any], path: Path, arguments: list[Any]) -> tuple[Any, BaseException | None]:
    try:
        with library_errors(path):
            return read(path, *arguments), None
    except (GbidError, OSError) as error:
        return None, error


def _set(limits: ReaderLimits) -> None:
    """Set the limits of this process for the next file, where the system has such limits."""
    try:
        import resource
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime + limits.seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    sizes = Path("/proc/self/statm")
    if sizes.is_file():
        now = int(sizes.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + limits.memory, resource.getrlimit(resource.RLIMIT_AS)[1]))
