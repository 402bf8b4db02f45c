"""Reader of npz archives."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gbid.errors import DataError
from gbid.recording.importers.columns import FileColumn, pick_column, split_reference
from gbid.recording.importers.file_format import FileFormat
from gbid.recording.importers.mapping import nearest


def read_npz(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of an npz archive; pickled objects are never loaded.

    Raises
    ------
    DataError
        When the file is damaged or not an npz archive, or when a variable is missing, holds pickled objects, or is not
        an array of numbers with that column.
    """
    if not zipfile.is_zipfile(path):
        raise DataError(f"{path}: not an npz archive (truncated or of another format); write it with numpy.savez")
    columns = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
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
    except DataError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: damaged npz archive: {error}") from None
    return columns


FORMAT = FileFormat((".npz",), read_npz)
