"""What all HDF5 files of gbid share: atomic writing, annotated datasets, checked reading."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy.typing as npt

from gbid._version import __version__
from gbid.errors import DataError, UsageError

SCHEMA_VERSION = 1


@contextlib.contextmanager
def atomic_path(path: Path, overwrite: bool) -> Iterator[Path]:
    """Give a temporary path beside `path` that takes its place only when the block ends well.

    Raises
    ------
    UsageError
        When `path` exists and `overwrite` is not set; nothing is touched then.
    DataError
        When the folder cannot be written.
    """
    if path.exists() and not overwrite:
        raise UsageError(f"{path} exists already; choose another name or ask for overwriting")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    os.close(handle)
    part = Path(name)
    try:
        yield part
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)
        part.replace(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def writing(path: str | Path, kind: str, overwrite: bool = False) -> Iterator[h5py.File]:
    """Open a new HDF5 file that appears under its name only when complete.

    Parameters
    ----------
    path : path
        The file.
    kind : str
        What it holds: ``"recording"``, ``"fit"`` and so on; checked when read.
    overwrite : bool
        Whether an existing file may be replaced.
    """
    with atomic_path(Path(path), overwrite) as part:
        with h5py.File(part, "w") as file:
            file.attrs["gbid_kind"] = kind
            file.attrs["schema_version"] = SCHEMA_VERSION
            file.attrs["creator"] = f"gbid {__version__}"
            file.attrs["created"] = datetime.now(UTC).isoformat(timespec="seconds")
            yield file
        with part.open("rb") as handle:
            os.fsync(handle.fileno())


@contextlib.contextmanager
def reading(path: str | Path, kind: str) -> Iterator[h5py.File]:
    """Open an HDF5 file of gbid and check that it is of the kind asked for.

    Raises
    ------
    DataError
        When the file is missing, no HDF5, truncated, of another kind or of a newer schema, or lacks an entry
        that is read inside the block.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("gbid_kind")
            if found != kind:
                raise DataError(
                    f"{path}: expected a gbid {kind} file, found {found or 'an HDF5 file of another program'}"
                )
            version = int(file.attrs.get("schema_version", 0))
            if version != SCHEMA_VERSION:
                raise DataError(f"{path}: schema_version {version}; this gbid reads {SCHEMA_VERSION}")
            yield file
    except OSError as error:
        raise DataError(
            f"{path}: not a readable HDF5 file (truncated or of another format): {error}"
        ) from None
    except KeyError as error:
        raise DataError(f"{path}: incomplete {kind} file: {error.args[0] if error.args else error}") from None


def add_dataset(
    group: h5py.Group, name: str, values: npt.ArrayLike, unit: str, long_name: str, **options: Any
) -> h5py.Dataset:
    """Write one dataset with its unit and its name in words."""
    dataset = group.create_dataset(name, data=values, **options)
    dataset.attrs["units"] = unit
    dataset.attrs["long_name"] = long_name
    return dataset
