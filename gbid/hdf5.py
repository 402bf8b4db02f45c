"""What all HDF5 files of gbid share: writing, annotated datasets, checked reading."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid._version import __version__
from gbid.atomic import atomic_path
from gbid.errors import DataError

SCHEMA_VERSION = 1


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
    with atomic_path(Path(path), overwrite) as part, _through_memory(part, "w") as file:
        file.attrs["gbid_kind"] = kind
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["creator"] = f"gbid {__version__}"
        file.attrs["created"] = datetime.now(UTC).isoformat(timespec="seconds")
        yield file


@contextlib.contextmanager
def changing(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file to be changed; it is written when the block ends well."""
    with _through_memory(path, "r+") as file:
        yield file


@contextlib.contextmanager
def _through_memory(path: Path, mode: str) -> Iterator[h5py.File]:
    """Give a file that is in memory only, and write its bytes at the end.

    On a full disk the library of HDF5 cannot close a file of its own, and crashes the process when it ends.
    """
    with h5py.File(path, mode, driver="core", backing_store=False) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


@contextlib.contextmanager
def reading(path: str | Path, kind: str) -> Iterator[h5py.File]:
    """Open an HDF5 file of gbid and check that it is of the kind asked for.

    Raises
    ------
    DataError
        When the file is missing, no HDF5, truncated, of another kind or schema, or lacks an entry that is
        read inside the block.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise DataError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("gbid_kind")
            if not isinstance(found, str) or found != kind:
                other = found if isinstance(found, str) else "an HDF5 file of another program"
                raise DataError(f"{path}: expected a gbid {kind} file, found {other}")
            version = file.attrs.get("schema_version", "missing")
            if np.ndim(version) != 0 or version != SCHEMA_VERSION:
                raise DataError(
                    f"{path}: schema_version {version}; this gbid reads {SCHEMA_VERSION}, "
                    "so read the file with the gbid that wrote it"
                )
            yield file
    except (OSError, RuntimeError) as error:  # h5py raises either for a damaged file
        raise DataError(f"{path}: not a readable HDF5 file (truncated or of another format): {error}") from None
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


def read_dataset(group: h5py.Group, name: str) -> npt.NDArray[Any]:
    """Values of one numeric dataset, any shape.

    Raises
    ------
    DataError
        When there is no dataset of that name, or it does not hold real numbers.
    """
    found = group.get(name)
    if not isinstance(found, h5py.Dataset):
        raise DataError(f"{_where(group, name)} is {'missing' if found is None else 'a group, not a dataset'}")
    if found.dtype.kind not in "fiub" or found.shape is None:
        raise DataError(f"{_where(group, name)} holds {found.dtype}, not numbers")
    values: npt.NDArray[Any] = np.asarray(found[()])
    return values


def read_attribute(item: h5py.HLObject, name: str) -> Any:
    """Value of one attribute of a file, group or dataset.

    Raises
    ------
    DataError
        When it is missing.
    """
    if name not in item.attrs:
        raise DataError(f"{item.file.filename}: {item.name} has no attribute {name!r}")
    return item.attrs[name]


def _where(group: h5py.Group, name: str) -> str:
    return f"{group.file.filename}: {group.name.rstrip('/')}/{name}"
