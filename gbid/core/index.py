"""Index of a results folder: facts about files, cached so that an unchanged file is not read again.

A fact holds for a version of a file: its inode, size and times. Whatever writes or replaces the file changes these, and
the fact is read again. The index is a cache: it may be deleted, and it is not written where it would save nothing.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from gbid._version import __version__
from gbid.core.errors import DataError
from gbid.core.files import atomic_path, checked_end, with_checksum

T = TypeVar("T")
NAME = ".gbid.index"
DOCUMENT = "document"
"""Fact that is as long as its file: it is not written into the index."""
_FEWEST = 100  # facts worth an index; to read as many files takes about 50 ms
_SETTLED_NS = 2_000_000_000  # age of a change [ns] from which on a further one has another time, on any file system
_facts: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {}  # by file; a cache, as that of `functools.lru_cache`


def version_of(path: str | Path) -> tuple[int, ...]:
    """Return inode, size and times of a file, which change when the file is written or replaced.

    Raises
    ------
    OSError
        When there is no such file.
    """
    stat = os.stat(path)  # noqa: PTH116  a campaign asks for thousands
    return stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def known(path: Path, fact: str, read: Callable[[Path], T]) -> T:
    """Return a named fact about a file, computed once for each version of the file.

    Parameters
    ----------
    path : path
        The file.
    fact : str
        Name of the fact; a `DOCUMENT` is kept in memory alone.
    read : callable
        Function that reads the fact, a plain value of JSON.

    Raises
    ------
    OSError
        When there is no such file.
    """
    version, name = version_of(path), str(path)
    if _facts.get(name, ((),))[0] != version:
        _facts[name] = version, {}
    facts = _facts[name][1]
    if fact not in facts:
        facts[fact] = read(path)
    value: T = facts[fact]
    return value


def load_index(results: Path) -> None:
    """Load the facts in the index of a results folder, for files that have not changed since."""
    path, folder = results / NAME, f"{results}{os.sep}"
    with suppress(OSError, DataError, ValueError):  # without an index, or with a damaged one, the files are read
        if checked_end(path) is not None:
            document = json.JSONDecoder().raw_decode(path.read_text(encoding="utf-8"))[0]
            for name, version, facts in document["files"] if document["gbid"] == __version__ else ():
                _facts.setdefault(folder + name, (tuple(version), facts))


def save_index(results: Path) -> None:
    """Write the index of a results folder if it saves time; a folder without write access is no error."""
    folder, latest = f"{results}{os.sep}", time.time_ns() - _SETTLED_NS
    settled = [
        (name.removeprefix(folder), version, {fact: value for fact, value in facts.items() if fact != DOCUMENT})
        for name, (version, facts) in _facts.items()
        if name.startswith(folder) and version[-1] < latest
    ]
    document = {"gbid": __version__, "files": settled}
    path, content = results / NAME, with_checksum(json.dumps(document).encode())
    if len(settled) >= _FEWEST and not (path.is_file() and path.read_bytes() == content):
        with suppress(DataError), atomic_path(path, overwrite=True) as part:
            part.write_bytes(content)
