"""Lock of a results folder: one runner at a time, or several shards of one campaign."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from gbid.errors import DataError, UsageError

NAME = ".gbid.lock"


@contextlib.contextmanager
def locked(results: Path, shared: bool = False) -> Iterator[None]:
    """Return a context that locks a results folder for one runner; the lock ends with its process.

    Parameters
    ----------
    results : pathlib.Path
        The folder; it is made when missing.
    shared : bool
        Whether other shards, each with tasks of its own, may use the folder at the same time.

    Raises
    ------
    UsageError
        When another runner has locked the folder.
    DataError
        When the folder cannot be written, or its file system has no locks.
    """
    path = results / NAME
    try:
        results.mkdir(parents=True, exist_ok=True)
        handle = _take(path, shared)
    except BlockingIOError:
        raise UsageError(
            f"{results}: another gbid is working in this folder{_owner(path)}; wait for it, or use --results to write "
            "elsewhere"
        ) from None
    except OSError as error:
        text = f"{path}: cannot be locked: {error.strerror or error}; use --results to write elsewhere"
        raise DataError(text) from None
    try:
        if not shared:
            _sign(handle)
        yield
    finally:
        with contextlib.suppress(OSError):  # shards: the last one removes the file
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)
        os.close(handle)


def _take(path: Path, shared: bool) -> int:
    """Open and lock the file; try again when its last owner has removed it meanwhile."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _sign(handle: int) -> None:
    """Write the owner of the lock into the file, for the error message of another runner."""
    owner = {"host": socket.gethostname(), "process": os.getpid(), "since": f"{datetime.now():%Y-%m-%d %H:%M:%S}"}
    with contextlib.suppress(OSError):  # the lock is valid also on a full disk
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(owner).encode(), 0)


def _owner(path: Path) -> str:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return f" (process {found['process']} on {found['host']}, since {found['since']})"
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""
