"""What libraries raise on damaged files, in words: the one place that turns it into an error of the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gbid.errors import DataError, GbidError


@contextmanager
def library_errors(path: Path, remedy: str = "save it again") -> Iterator[None]:
    """Return a context in which whatever a library raises on a file becomes a DataError with the name of the file.

    Errors of gbid and of the system (`OSError`) come out as they are.

    Parameters
    ----------
    path : path
        The file.
    remedy : str
        What the user can do.
    """
    try:
        yield
    except (GbidError, OSError):
        raise
    except MemoryError:
        raise DataError(f"{path}: its reader needs more memory than the file can contain; {remedy}") from None
    except Exception as error:
        words = in_one_line(error)
        raise DataError(f"{path}: cannot be read, damaged or of another format ({words}); {remedy}") from None


def in_one_line(error: BaseException) -> str:
    """Return type and text of an error; of a long text the beginning."""
    lines = f"{type(error).__name__}: {error}".splitlines()
    return lines[0][:_LONGEST]


_LONGEST = 300
