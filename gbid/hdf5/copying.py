"""Copy of an HDF5 file that has no checksum, made in another process: the library may fail on damaged bytes.

Files of gbid 0.1 have no checksum. What the other process could read in full is written to a new file in memory. This
one is sound, so that it can be opened here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid.errors import DataError
from gbid.files.reader_process import read_apart

_BYTES = 1 << 28  # most bytes of values in a small file
_BYTES_PER_BYTE = 4  # more in a larger one: the values may be compressed


@contextlib.contextmanager
def copied(path: Path, can_change: bool = False) -> Iterator[h5py.File]:
    """Return a context with the copy of a file, in memory.

    Raises
    ------
    DataError
        When the file cannot be read, or declares more values than it can contain.
    OSError
        When it is no HDF5 file.
    """
    image = read_apart(image_of, path)
    flags = h5py.h5f.FILE_IMAGE_OPEN_RW if can_change else 0
    with h5py.File(h5py.h5f.open_file_image(image, flags)) as file:
        yield file


def image_of(path: Path) -> bytes:
    """Return the bytes of a new HDF5 file with the groups, datasets and attributes of a file."""
    with (
        h5py.File(path, "r") as source,
        h5py.File("copy", "w", driver="core", backing_store=False) as target,
    ):
        room = _BYTES + _BYTES_PER_BYTE * path.stat().st_size
        HDF5Copier(path, room).copy(source, target)
        target.flush()
        image: bytes = target.id.get_file_image()
    return image


class HDF5Copier:
    """Copier of groups.

    Parameters
    ----------
    path : path
        The file, for messages.
    room : int
        Most bytes of values.
    """

    def __init__(self, path: Path, room: int) -> None:
        self._path, self._room = path, room

    def copy(self, source: h5py.Group, target: h5py.Group) -> None:
        """Copy what is in a group to another."""
        _copy_attributes(source, target)
        for name in source:
            if not isinstance(source.get(name, getlink=True), h5py.HardLink):
                raise DataError(f"{self._path}: {name!r} is a link to elsewhere, which gbid does not write")
            found = source[name]
            if isinstance(found, h5py.Group):
                self.copy(found, target.create_group(name))
            elif isinstance(found, h5py.Dataset):
                _copy_attributes(found, target.create_dataset(name, data=self._values(found), dtype=found.dtype))

    def _values(self, dataset: h5py.Dataset) -> Any:
        if dataset.external or dataset.is_virtual:
            raise DataError(f"{self._path}: {dataset.name} is in another file, which gbid does not write")
        self._room -= dataset.nbytes
        if self._room < 0:
            raise DataError(
                f"{self._path}: damaged: {dataset.name} declares {dataset.nbytes} bytes, more than the file can contain"
            )
        values = dataset[()]
        if np.asarray(values).dtype.hasobject:
            self._room -= sum(len(text) for text in np.asarray(values).flat)
        return values


def _copy_attributes(source: h5py.HLObject, target: h5py.HLObject) -> None:
    for name in source.attrs:
        target.attrs.create(name, source.attrs[name], dtype=source.attrs.get_id(name).dtype)
