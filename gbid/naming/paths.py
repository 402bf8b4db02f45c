"""Paths that a caller gives, checked before a file is opened, and names of files made of free text."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from gbid.errors import UsageError

LONGEST = 120
"""Largest number of bytes of a part of a file name that is made of a name; file systems take 255 with all additions."""
_DIGITS = 8


def given_path(path: object) -> Path:
    """Return a path as the caller gave it.

    Parameters
    ----------
    path : str or path-like
        The path.

    Raises
    ------
    UsageError
        When it is no path, or when it contains a NUL character, which no file name has.
    """
    if not isinstance(path, str | os.PathLike):
        raise UsageError(f"{path!r} is no path; give the name of a file as a text or a pathlib.Path")
    found = Path(path)
    if "\0" in str(found):
        raise UsageError(f"{str(found)!r}: a path cannot contain a NUL character; correct the name of the file")
    return found


def file_stem(name: str, longest: int = LONGEST, join: str = "-") -> str:
    """Return a name for a part of a file name; a long one is cut and ends with a digest, so that it stays unique.

    Parameters
    ----------
    name : str
        A name without path separators.
    longest : int
        Largest number of bytes.
    join : str
        What stands before the digest.

    Examples
    --------
    >>> file_stem("p5_n6000_prbs1"), len(file_stem(300 * "x"))
    ('p5_n6000_prbs1', 120)
    """
    encoded = name.encode()
    if len(encoded) <= longest:
        return name
    digest = hashlib.sha256(encoded).hexdigest()[:_DIGITS]
    return f"{encoded[: longest - _DIGITS - len(join)].decode(errors='ignore')}{join}{digest}"
