"""Content keys: a result stays valid while its settings and its sources are the same."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from gbid._version import __version__
from gbid.atomic import atomic_path
from gbid.errors import DataError, UsageError
from gbid.files.text_checksum import add_text_checksum, is_changed
from gbid.hdf5 import changing, opened

ATTRIBUTE = "key"
"""Attribute at the root of an HDF5 file; other files contain ``content_key: <key>`` in a comment."""

_IN_TEXT = re.compile(rb"content_key: ([0-9a-f]{64})")


def content_key(stage: str, settings: Mapping[str, Any], sources: Iterable[str] = ()) -> str:
    """Return the content key of a result: sha256 over the settings of a stage and the keys of its sources.

    Parameters
    ----------
    stage : str
        Name of the stage.
    settings : dict
        Settings as plain values; of arrays, mappings and dataclasses all values count.
    sources : iterable of str
        Content keys of the files that the stage reads.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    document = {"stage": stage, "gbid": __version__, "settings": settings, "sources": list(sources)}
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return the sha256 of the bytes of a file.

    Raises
    ------
    OSError
        When the file cannot be read.
    """
    stat = path.stat()
    return _digest(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=1024)
def _digest(path: Path, _mtime_ns: int, _size: int) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def stored_key(path: Path) -> str:
    """Return the content key in a result file; empty when the file has none, is damaged or cannot be read."""
    try:
        if path.suffix == ".h5":
            with opened(path) as file:
                return str(file.attrs.get(ATTRIBUTE, ""))
        content = path.read_bytes()
        found = _IN_TEXT.search(content)
        return found[1].decode() if found and not is_changed(content) else ""
    except (OSError, DataError):
        return ""


def is_current(path: Path, key: str, overwrite: bool) -> bool:
    """Return whether a result exists already and was made from the same settings and data.

    Raises
    ------
    UsageError
        When the result was made from other settings or data and `overwrite` is not set.
    DataError
        When the file cannot be read.
    """
    if not path.exists():
        return False
    found = stored_key(path)
    if found == key:
        return True
    if overwrite:
        return False
    if not found:
        words = "damaged, changed after it was made, or not made by an experiment"
        raise DataError(f"{path}: {words}; remove it or use --overwrite")
    raise UsageError(
        f"{path} was made with other settings or data, or by another version of gbid; "
        "use --overwrite to replace it, or --results to write elsewhere"
    )


@contextmanager
def writing_keyed(path: Path, key: str) -> Iterator[Path]:
    """Return a context that gives a path to write to; at its end the file gets its key and replaces `path`."""
    with atomic_path(path, overwrite=True) as part:
        yield part
        if path.suffix == ".h5":
            with changing(part) as file:
                file.attrs[ATTRIBUTE] = key
        else:
            add_text_checksum(part, path.suffix)


def _plain(value: Any) -> Any:
    """Return arrays as lists, and other values (models, read-only mappings) as the dict of all that they hold."""
    if isinstance(value, Mapping):
        return dict(value)
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return value.tolist()
