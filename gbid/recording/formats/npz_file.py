"""Reader of npz archives."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import DataError
from gbid.recording.mapping import nearest
from gbid.recording.readers import FileChannel, FileFormat, array_channels
from gbid.recording.text_files import FileColumn, pick_column, split_reference


def read_npz(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of an npz archive; pickled objects are never loaded.

    Raises
    ------
    DataError
        When the file is damaged or not an npz archive, or when a variable is missing, holds pickled objects, or is not
        an array of numbers with that column.
    """
    columns = {}
    with _opened(path) as archive:
        for reference in references:
            name, _ = split_reference(reference)
            if name not in archive.files:
                raise DataError(f"{path}: no variable {name!r}; {nearest(name, archive.files)}")
            try:
                value = archive[name]
            except ValueError as error:
                if "pickle" not in str(error):
                    raise
                raise DataError(
                    f"{path}: variable {name!r} holds pickled Python objects, which are not loaded; "
                    "save it as an array of numbers"
                ) from None
            columns[reference] = FileColumn(pick_column(path, reference, value))
    return columns


def npz_channels(path: Path) -> list[FileChannel]:
    """Return the channels of an npz archive.

    Raises
    ------
    DataError
        When the file is damaged or not an npz archive.
    """
    channels = []
    with _opened(path) as archive:
        for name in archive.files:
            try:
                channels += array_channels(name, archive[name])
            except ValueError as error:
                if "pickle" not in str(error):
                    raise
                channels.append(FileChannel(name, 0, remark="pickled Python objects: not loaded"))
    return channels


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Return the open archive; what its damage raises becomes a DataError."""
    if not zipfile.is_zipfile(path):
        with path.open("rb"):  # is_zipfile is also False for a file that cannot be read
            pass
        raise DataError(f"{path}: not an npz archive (truncated or of another format); write it with numpy.savez")
    try:
        with np.load(path, allow_pickle=False) as archive:
            yield archive
    except DataError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: damaged npz archive: {error}") from None


FORMAT = FileFormat((".npz",), read_npz, npz_channels, may_crash=True)
