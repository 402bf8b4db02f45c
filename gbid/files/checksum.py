"""Checksum of a file: the SHA-256 of its bytes, written as the last line of the file.

It covers every byte, so it is checked before the HDF5 library sees the file: this library may crash or never return
on damaged bytes. HDF5 readers ignore what follows the end that a file states.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from gbid.errors import DataError

_LABEL = b"\ngbid sha256 "
_LENGTH = len(_LABEL) + 64 + 1


def with_checksum(content: bytes) -> bytes:
    """Return the bytes of a file with their checksum."""
    return b"".join((content, _LABEL, hashlib.sha256(content).hexdigest().encode(), b"\n"))


def has_valid_checksum(path: Path) -> bool:
    """Return whether a file ends with its checksum; false when it ends otherwise.

    Raises
    ------
    DataError
        When the checksum is not that of the bytes.
    OSError
        When the file cannot be read.
    """
    size = path.stat().st_size - _LENGTH
    if size < 0:
        return False
    with path.open("rb") as file:
        file.seek(size)
        last = file.read(_LENGTH)
        if not last.startswith(_LABEL):
            return False
        file.seek(0)
        found = hashlib.sha256()
        while size > 0:
            block = file.read(min(size, 1 << 20))
            if not block:
                break
            found.update(block)
            size -= len(block)
    if last[len(_LABEL) : -1] != found.hexdigest().encode():
        raise DataError(
            f"{path}: damaged, or changed by another program: its checksum is not that of its bytes; "
            "take a copy of it from a backup, or make it again"
        )
    return True
