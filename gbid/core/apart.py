"""Reader process for libraries that may crash, never return or fill the memory on a damaged file.

One process serves all files that are read one after the other. It has limits of processor time and memory for each,
absolute ones and in proportion to its size. When a library crashes or exceeds a limit, the process ends and the next
file gets a new one. It ends with the process that asks, whatever it does.

A file may make a library execute code of its own. On Linux the process can therefore write to a folder of its own only,
opens no connection, and starts no program. It answers in JSON and the bytes of arrays, which execute nothing.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import errno
import json
import os
import pickle
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from math import prod
from multiprocessing.util import Finalize
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gbid.core import errors
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


def read_apart(
    read: Callable[..., T], path: Path, *arguments: Any, types: tuple[type, ...] = (), packages: tuple[str, ...] = ()
) -> T:
    """Return ``read(path, *arguments)``, computed in the reader process.

    Parameters
    ----------
    read : callable
        Function of a module; another process imports it.
    path : pathlib.Path
        The file.
    *arguments
        Further arguments, which can be pickled.
    types : tuple of type
        Named tuples and dataclasses that the value may have in it, beside plain values, paths and arrays of numbers.
    packages : tuple of str
        Packages that `read` imports. The process imports them while it can still store their compiled modules.

    Raises
    ------
    GbidError
        As `read` raises it; an error of a class outside `gbid.core.errors` becomes a DataError.
    OSError
        When the file cannot be read.
    DataError
        When the reader fails in another way: it crashes, exceeds the limits, or raises an error of its library.
    """
    answer: T = _process(os.getpid()).ask(limits_for(path), read, path, arguments, types, packages)
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
        self._packages = set[str]()  # imported when it could still write
        self._folder = ""  # for temporary files of packages; none without packages

    def ask(
        self,
        limits: ReaderLimits,
        read: Callable[..., Any],
        path: Path,
        arguments: tuple[Any, ...],
        types: tuple[type, ...],
        packages: tuple[str, ...],
    ) -> Any:
        """Return the answer to a request; see `read_apart`."""
        with self._lock:
            allowed = _session_limit("RLIMIT_CPU")
            # Of what a process may use in all, a new one has used nothing.
            if self._used + limits.seconds > allowed or not self._packages.issuperset(packages):
                self._end()
            self._packages.update(packages)
            child = self._ready_child()
            timer = threading.Timer(limits.wait, child.kill)
            answer = None
            timer.start()
            try:
                folder = None if path.is_absolute() else Path.cwd()  # that of the process may be another
                answer = _answer(child, limits.memory, types, (limits, folder, self._packages, read, path, *arguments))
            except _INVALID as fault:
                text = f"its reader answered with something else than data ({type(fault).__name__}: {fault})"
                raise DataError(
                    f"{path}: {text}; the file may attack the library that reads it: do not use it"
                ) from None
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
            self._folder = tempfile.mkdtemp(prefix="gbid-reader-") if self._packages else ""
            self._child = _started(self._folder)
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
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)
        for pipe in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):  # a request that the process did not read
                if pipe is not None:
                    pipe.close()
        child.wait()


@cache
def _process(_owner: int) -> ReaderProcess:  # a forked process has another number: it starts one of its own
    process = ReaderProcess()
    Finalize(None, process.close, exitpriority=0)  # at the end of workers, too, where atexit is not called
    return process


def _started(folder: str) -> subprocess.Popen[bytes]:
    """Return a new process, started by a thread that lives as long as the process.

    The system ends the process when the thread ends that started it, and not only at the end of this process.
    """
    began: SimpleQueue[subprocess.Popen[bytes] | BaseException] = SimpleQueue()

    def hold() -> None:
        try:
            child = _popen(folder)
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


def _popen(folder: str) -> subprocess.Popen[bytes]:
    # Arrow would reserve a gigabyte of addresses, which counts as memory.
    added = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
    if folder:
        added |= dict.fromkeys(_TEMPORARY, folder)
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _START.format(_import_folders(), os.getpid())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**{key: value for key, value in os.environ.items() if key not in _PREFIXES}, **added},
        start_new_session=True,  # Ctrl-C is for the process that waits
    )


_TEMPORARY = ("TMPDIR", "TEMP", "TMP")
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


def _answer(
    child: subprocess.Popen[bytes], most: int, types: tuple[type, ...], request: tuple[Any, ...]
) -> _Answer | None:
    """Send a request and return the answer of the reader process, of at most `most` bytes; None if that process ended.

    Raises one of the errors `_INVALID` when the answer is not written as `serve` writes it.
    """
    if child.stdin is None or child.stdout is None:
        return None
    try:
        pickle.dump(request, child.stdin)
        child.stdin.flush()
        line = child.stdout.readline(most)
        if not line.endswith(b"\n"):
            return None
        value, error, seconds, layouts = json.loads(line)
        if sum(prod(shape) * int(kind[2:]) for kind, shape in layouts) > most:
            raise ValueError("its arrays need more memory than the file can contain")
        arrays = [_empty(kind, shape) for kind, shape in layouts]
        for array in arrays:
            if len(content := child.stdout.read(array.nbytes)) != array.nbytes:
                return None
            _bytes(array)[:] = content
    except OSError:
        return None
    return _decoded(value, {each.__name__: each for each in types}, arrays), _error(error), float(seconds)


_INVALID = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError, MemoryError)
_NUMBERS = re.compile("[<>|](b1|[iu][1248]|f[248]|c8|c16)")


def _empty(kind: str, shape: list[int]) -> npt.NDArray[Any]:
    if not _NUMBERS.fullmatch(kind):
        raise ValueError(f"an array of {kind!r}")
    return np.empty(shape, kind)


def _bytes(array: npt.NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _error(about: list[Any] | None) -> BaseException | None:
    if about is None:
        return None
    name, *arguments = about
    if name == "OSError":
        return OSError(*arguments)
    classes = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, GbidError)]
    return {each.__name__: each for each in classes}.get(name, DataError)(*arguments)


def _encoded(value: Any, arrays: list[npt.NDArray[Any]]) -> Any:
    """Return a value for JSON; everything but texts, numbers and lists is a dict with its kind as the only key."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, np.ndarray):
        _empty(value.dtype.str, [0])
        arrays.append(np.asarray(value, order="C"))
        return {"array": len(arrays) - 1}
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, Mapping):
        return {"dict": [_encoded(pair, arrays) for pair in value.items()]}
    if dataclasses.is_dataclass(value):
        parts = [getattr(value, field.name) for field in dataclasses.fields(value)]
    else:
        parts = list(value)
    encoded = [_encoded(each, arrays) for each in parts]
    return encoded if isinstance(value, list) else {type(value).__name__: encoded}


def _decoded(value: Any, types: Mapping[str, type], arrays: list[npt.NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_decoded(each, types, arrays) for each in value]
    if not isinstance(value, dict):
        return value
    ((kind, parts),) = value.items()
    if kind in ("array", "path"):
        return arrays[parts] if kind == "array" else Path(parts)
    decoded = _decoded(parts, types, arrays)
    return dict(decoded) if kind == "dict" else tuple(decoded) if kind == "tuple" else types[kind](*decoded)


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
            "it may be damaged, or have far too many entries; save the needed signals to a new file"
        )
    if -code == getattr(signal, "SIGKILL", None):
        return "its reader was killed from outside (SIGKILL), as by a machine without memory left; make room, try again"
    with contextlib.suppress(ValueError):
        return f"its reader crashed ({signal.Signals(-code).name}); the file is damaged: save it again"
    return f"its reader ended (exit code {code}); the file is damaged: save it again"


def serve(parent: int) -> None:
    """Answer requests from standard input until it is closed, or until the parent process ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_WHEN_PARENT_ENDS, signal.SIGKILL)
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not come between the answers
    answers.write(b"ready\n")
    answers.flush()
    session = {name: _session_limit(name) for name in ("RLIMIT_CPU", "RLIMIT_AS")}
    is_new = True
    while True:
        try:
            limits, folder, packages, read, path, *arguments = pickle.load(requests)  # from the process above
        except EOFError:
            return
        _set(limits, session)
        if is_new:
            for name in packages:
                with contextlib.suppress(Exception):  # the reader tells it
                    import_module(name)
            confine(tempfile.gettempdir() if packages else "")
            _end_with(parent)
            is_new = False
        if folder is not None:
            os.chdir(folder)
        arrays: list[npt.NDArray[Any]] = []
        outcome = _outcome(read, path, arguments, arrays)
        layouts = [(each.dtype.str, each.shape) for each in arrays]
        answers.write(json.dumps([*outcome, time.process_time(), layouts]).encode() + b"\n")
        for each in arrays:
            answers.write(_bytes(each))
        answers.flush()


def _end_with(parent: int) -> None:
    """End this process when its parent ends, also where the system does not do it."""

    def look() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=look, daemon=True).start()


_WHEN_PARENT_ENDS = 1  # PR_SET_PDEATHSIG of prctl


def _outcome(
    read: Callable[..., Any], path: Path, arguments: list[Any], arrays: list[npt.NDArray[Any]]
) -> tuple[Any, Any]:
    """Return value and error for JSON."""
    try:
        with library_errors(path):
            return _encoded(read(path, *arguments), arrays), None
    except OSError as error:
        arrays.clear()
        name = [] if error.filename is None else [str(error.filename)]
        return None, ["OSError", *error.args, *name]
    except GbidError as error:
        arrays.clear()
        return None, [type(error).__name__, str(error)]


def _set(limits: ReaderLimits, session: dict[str, int]) -> None:
    """Set the limits of time and memory of the reader process for the next file, at most those of the user."""
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


# ---- Confinement of the process: Landlock against writing, a filter of system calls against connections and programs.


def confine(folder: str) -> None:
    """Take from this process, for good, what a reader does not need; only on Linux, as far as its version has it.

    It can then write only below `folder` (nowhere without one), signal or trace no other process, open no connection,
    and start no program. Threads that are there already keep their rights.
    """
    if sys.platform != "linux" or os.uname().machine not in _DENIED:
        return
    library = ctypes.CDLL(None)
    library.prctl(38, 1, 0, 0, 0)  # PR_SET_NO_NEW_PRIVS, without which the rest is not allowed
    if (version := library.syscall(444, None, 0, 1)) > 0:  # landlock_create_ruleset
        rights = ((1 << (13, 14, 15, 15, 16)[min(version, 5) - 1]) - 1) & ~0b1100  # all but reading
        ruled = struct.pack("QQQ", rights, 0b11, 0b11)[: 8 * (1 + (version >= 4) + (version >= 6))]
        if (rules := library.syscall(444, ruled, len(ruled), 0)) >= 0:
            if folder:
                own = os.open(folder, os.O_PATH)
                library.syscall(445, rules, 1, struct.pack("=Qi", rights, own), 0)  # landlock_add_rule
                os.close(own)
            library.syscall(446, rules, 0)  # landlock_restrict_self
            os.close(rules)
    architecture, denied = _DENIED[os.uname().machine]
    last = len(denied) + 5
    program = [
        (0x20, 0, 0, 4),  # load the architecture
        (0x15, 0, last - 2, architecture),
        (0x20, 0, 0, 0),  # load the number of the call
        (0x35, last - 4, 0, 0x40000000),  # numbers of other conventions
        *((0x15, last - i, 0, number) for i, number in enumerate(denied, start=5)),
        (0x06, 0, 0, 0x7FFF0000),  # allowed
        (0x06, 0, 0, 0x00050000 | errno.EACCES),
    ]
    steps = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in program))
    library.prctl(22, 2, struct.pack("HP", len(program), ctypes.addressof(steps)))  # PR_SET_SECCOMP


_DENIED = {
    "x86_64": (0xC000003E, (41, 59, 90, 91, 101, 268, 311, 322, 425, 452)),
    "aarch64": (0xC00000B7, (52, 53, 117, 198, 221, 271, 281, 425, 452)),
}
"""By processor: its number, and those of socket, execve, chmod, ptrace, process_vm_writev, io_uring and the like."""
