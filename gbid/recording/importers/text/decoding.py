"""Text of a file whose encoding is given or found."""

from __future__ import annotations

import codecs
from pathlib import Path

from gbid.errors import DataError

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_CONTROL = frozenset(map(chr, range(32))) - set("\t\n\r\x0b\x0c\x1a")  # characters that no text has


def read_text(path: Path, encoding: str | None = None) -> tuple[str, str]:
    """Return the text of a file and its encoding.

    A byte order mark states the encoding. Without one it is UTF-16 when every other byte is zero, UTF-8 when the bytes
    are valid UTF-8, and otherwise cp1252, the encoding of Windows in western Europe.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    encoding : str, optional
        The encoding when it is known.

    Raises
    ------
    DataError
        When the bytes are not text in this encoding, or not text at all.
    OSError
        When the file cannot be read.
    """
    data = path.read_bytes()
    found = encoding or _encoding(data)
    try:
        text = data.decode(found)
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: not text in {found} (byte {error.start}): give its encoding (encoding: ...), or export it as csv "
            "in UTF-8"
        ) from None
    strange = _CONTROL.intersection(text[:100_000])
    if strange:
        raise DataError(
            f"{path}: not a text file in {found}: it holds the character {min(strange)!r}; give its encoding "
            "(encoding: ...), or export it as csv"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n").rstrip("\x1a"), found


def _encoding(data: bytes) -> str:
    for mark, name in _MARKS:
        if data.startswith(mark):
            return name
    head = data[:2000]
    if len(head) > 3 and not any(head[1::2]):
        return "utf-16-le"
    if len(head) > 3 and not any(head[::2]):
        return "utf-16-be"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"
