"""Reader process for libraries that may crash, never return or fill the memory on a damaged file.

One process serves all files that are read one after the other. It has limits of processor time and memory for each,
absolute ones and in proportion to its size. When a library crashes or exceeds a limit, the process ends and the next
file gets a new one. It ends with the process that asks, whatever it does.
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
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

from gbid.core.errors import DataError, GbidError
from gbid.core.files import library_errors

T = TypeVar("T")

_SECONDS = 10.0  # most processor time for a small file; the import of a library is in it, 1 s here
_BYTES_PER_SECOND = 5e6  # larger files have more: a tenth of the rate of the slowest reader, that of compressed .mat
_MOST_SECONDS = 600.0  # for any file
_WAIT = 600.0  # longest time for a small file, on a busy machine or by a drive that answers late
_BYTES_PER_WAIT = 1e6  # of a slow network drive
_MEMORY = 1 << 30  # most memory for a small file, in bytes
_MEMORY_PER_BYTE = 10
_LOOK = 1.0  # time between two looks at whether the parent is there, where the system does not tell its end
_START = """\
import sys
sys.path += [folder for folder in {!r} if folder not in sys.path]
from gbid.core.apart import serve
serve({})
"""


def read_apart(read: Callable[..., T], path: Path, *arguments: Any) -> T:
    """Return ``read(path, *arguments)``, computed in the reader process.

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
    """Limits of memory and time for reading one file.

    Attributes
    ----------
    seconds : float
        Processor time [s].
    memory : int
        Memory beside that of the process itself [bytes].
    wait : float
        Time [s].
    """

    seconds: float
    memory: int
    wait: float


def limits_for(path: Path) -> ReaderLimits:
    """Return the limits for reading a file, from its size.

    Raises
    ------
    OSError
        When there is no such file.
    """
    size = path.stat().st_size
    seconds = min(_SECONDS + size / _BYTES_PER_SECOND, _MOST_SECONDS)
    memory = min(_MEMORY + _MEMORY_PER_BYTE * size, usable_memory())
    return ReaderLimits(seconds, memory, _WAIT + size / _BYTES_PER_WAIT)


def usable_memory() -> int:
    """Return the memory that this process can use [bytes]: the machine's, or less where a limit is set."""
    sizes = [sys.maxsize]
    with contextlib.suppress(AttributeError, ValueError, OSError):  # not on Windows
        sizes.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with contextlib.suppress(ValueError, OSError):  # of the container; "max" without limit
        sizes.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    sizes.append(_session_limit("RLIMIT_AS"))
    return min(sizes)


def _session_limit(name: str) -> int:
    """Return a limit of this process (``ulimit``): the smaller of its soft and hard value."""
    try:
        import resource
    except ImportError:  # Windows
        return sys.maxsize
    return min(each for each in (*resource.getrlimit(getattr(resource, name)), sys.maxsize) if each >= 0)


class ReaderProcess:
    """Reader process, started at its first request."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._used = 0.0  # processor time [s] when it answered last

    def ask(self, limits: ReaderLimits, read: Callable[..., Any], path: Path, arguments: tuple[Any, ...]) -> Any:
        """Return the answer to a request; see `read_apart`."""
        with self._lock:
            allowed = _session_limit("RLIMIT_CPU")
            if self._used + limits.seconds > allowed:  # of what a process may use in all, a new one has used nothing
                self._end()
            child = self._ready_child()
            timer = threading.Timer(limits.wait, child.kill)
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
            raise DataError(f"{path}: {_reason(child.returncode, limits, allowed, in_time)}")
        value, error, self._used = answer
        if error is not None:
            raise error
        return value

    def _ready_child(self) -> subprocess.Popen[bytes]:
        if self._child is None or self._child.poll() is not None:
            self._end()
            self._child = _started()
        return self._child

    def close(self) -> None:
        """End the reader process."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        child, self._child, self._used = self._child, None, 0.0
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
    """Return a new process, started by a thread that lives as long as the process.

    The system ends the process when the thread ends that started it, and not only at the end of this process.
    """
    began: SimpleQueue[subprocess.Popen[bytes] | BaseException] = SimpleQueue()

    def hold() -> None:
        try:
            child = _popen()
        except BaseException as error:
            began.put(error)
            return
        began.put(child)
        if hasattr(os, "waitid"):
            with contextlib.suppress(ChildProcessError):
                os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)

    threading.Thread(target=hold, daemon=True, name="gbid reader").start()
    child = began.get()
    if isinstance(child, BaseException):
        raise child
    if child.stdout is not None:
        child.stdout.readline()  # it is ready: its start does not count
    return child


def _popen() -> subprocess.Popen[bytes]:
    # Arrow would reserve a gigabyte of addresses, which counts as memory.
    added = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _START.format(_import_folders(), os.getpid())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**{key: value for key, value in os.environ.items() if key not in _PREFIXES}, **added},
        start_new_session=True,  # Ctrl-C is for the process that waits
    )


_PREFIXES = ("HDF5_EXT_PREFIX", "HDF5_VDS_PREFIX", "HDF5_EXTFILE_PREFIX")  # folders where HDF5 looks for other files


def _import_folders() -> list[str]:
    """Return the folders that a reader process adds to its import path, from this process's path.

    The current folder and that of a script are none of them: the data may lie there.
    """
    script = str(Path(sys.argv[0]).absolute().parent) if sys.argv else ""
    package = str(Path(__file__).resolve().parents[2])
    return [*(folder for folder in sys.path if folder not in ("", str(Path.cwd()), script)), package]


_Answer = tuple[Any, BaseException | None, float]
"""Value, error, and the processor time of the process so far [s]."""


def _answer(child: subprocess.Popen[bytes], request: tuple[Any, ...]) -> _Answer | None:
    """Send a request and return the answer of the reader process; None if that process ended."""
    if child.stdin is None or child.stdout is None:
        return None
    try:
        pickle.dump(request, child.stdin)
        child.stdin.flush()
        answer: _Answer = pickle.load(child.stdout)  # from our own process
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
    return answer


def _reason(code: int, limits: ReaderLimits, allowed: int, in_time: bool) -> str:
    """Return why the reader process ended without an answer, and what to do."""
    if not in_time:
        return (
            f"time-out: not read within {limits.wait:.0f} s; the drive answers late, or the machine is too busy: try "
            "again, or copy the file to a drive of this machine"
        )
    if -code == getattr(signal, "SIGXCPU", None):
        if allowed < limits.seconds:
            return (
                f"time-out: its reader computed for more than the {allowed} s of processor time that this session "
                "allows (ulimit -t); allow more"
            )
        return (
            f"time-out: its reader computed for more than {limits.seconds:.0f} s; a file of this size needs far less: "
            "it may be damaged, or have far too many entries; save what is needed again"
        )
    if -code == getattr(signal, "SIGKILL", None):
        return "its reader was killed from outside (SIGKILL), as by a machine without memory left; make room, try again"
    with contextlib.suppress(ValueError):
        return f"its reader crashed ({signal.Signals(-code).name}); the file is damaged: save it again"
    return f"its reader ended (exit code {code}); the file is damaged: save it again"


def serve(parent: int) -> None:
    """Answer requests from standard input until it is closed, or until the parent process ends."""
    _end_with(parent)
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not come between the answers
    answers.write(b"ready\n")
    answers.flush()
    session = {name: _session_limit(name) for name in ("RLIMIT_CPU", "RLIMIT_AS")}
    while True:
        try:
            limits, folder, read, path, *arguments = pickle.load(requests)  # from the process that started this one
        except EOFError:
            return
        _set(limits, session)
        if folder is not None:
            os.chdir(folder)
        pickle.dump((*_outcome(read, path, arguments), time.process_time()), answers)
        answers.flush()


def _end_with(parent: int) -> None:
    """End this process when its parent ends: by a signal of the system (Linux) and by a watching thread."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_WHEN_PARENT_ENDS, signal.SIGKILL)

    def look() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=look, daemon=True).start()


_WHEN_PARENT_ENDS = 1  # PR_SET_PDEATHSIG of prctl


def _outcome(read: Callable[..., Any], path: Path, arguments: list[Any]) -> tuple[Any, BaseException | None]:
    try:
        with library_errors(path):
            return read(path, *arguments), None
    except (GbidError, OSError) as error:
        return None, error


def _set(limits: ReaderLimits, session: dict[str, int]) -> None:
    """Set the limits of this process for the next file, never above the limits of the session."""
    try:
        import resource
    except ImportError:
        return
    # Where both limits were equal, the process would be killed without a reason.
    seconds = min(int(time.process_time() + limits.seconds) + 1, max(1, session["RLIMIT_CPU"] - 1))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    sizes = Path("/proc/self/statm")
    if sizes.is_file():
        now = int(sizes.read_text().split()[0]) * resource.getpagesize()
        memory = min(now + limits.memory, session["RLIMIT_AS"])
        resource.setrlimit(resource.RLIMIT_AS, (memory, resource.getrlimit(resource.RLIMIT_AS)[1]))
