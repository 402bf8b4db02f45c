"""Checksum of a text file: the SHA-256 of its lines, written in a comment.

A text file may be changed by hand, so a checksum that is not that of the lines is no error here: the reader says so.
The end of lines does not count, because editors and version control change it.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

_COMMENTS = {
    ".yaml": ("# ", ""),
    ".csv": ("# ", ""),
    ".md": ("<!-- ", " -->"),
    ".c": ("/* ", " */"),
    ".h": ("/* ", " */"),
    ".m": ("% ", ""),
}
_BELOW_HELP = ".m"  # MATLAB shows the first comment as the help of the function
_LINE = re.compile(
    rb"^(?:# |% |/\* |<!-- )gbid sha256 ([0-9a-f]{64}) of the other lines(?:| \*/| -->)(?:\n|\Z)", re.MULTILINE
)
_TRACE = re.compile(rb"gbid sha256|[0-9a-f]{31} of the other")  # of a damaged checksum


def with_text_checksum(text: str, ending: str) -> str:
    """Return the text of a file with its checksum, in place of the one that it has.

    Parameters
    ----------
    text : str
        The text.
    ending : str
        Ending of the name of the file, as ``".yaml"``. It decides the form of the comment.
    """
    before, after = _COMMENTS[ending]
    text = _LINE.sub(b"", text.encode()).decode()
    line = f"{before}gbid sha256 {_digest(text.encode())} of the other lines{after}\n"
    help_text, gap, code = text.partition("\n\n") if ending == _BELOW_HELP else ("", "", text)
    return f"{help_text}{gap}{line}{code}"


def add_text_checksum(path: Path, ending: str) -> None:
    """Write the checksum into a text file; files whose format has no comments stay as they are."""
    if ending in _COMMENTS:
        text = path.read_bytes().decode()
        path.write_bytes(with_text_checksum(text, ending).encode())


def is_changed(content: bytes) -> bool:
    """Return whether the bytes of a text file have a checksum that is not that of their lines.

    False also for a text without checksum, as people write it.
    """
    content = _plain(content)
    found = _LINE.search(content)
    if found is None:
        return bool(_TRACE.search(content))
    return found[1].decode() != _digest(content[: found.start()] + content[found.end() :])


def _digest(content: bytes) -> str:
    return hashlib.sha256(_plain(content)).hexdigest()


def _plain(content: bytes) -> bytes:
    return content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").rstrip()
