"""HDF5 files of gbid: written in full or not at all, and checked when they are opened."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid._version import __version__
from gbid.core.apart import read_apart
from gbid.core.errors import DataError, GbidError
from gbid.core.files import atomic_path, has_valid_checksum, library_errors, with_checksum
from gbid.core.names import given_path

# ---- Entries of an HDF5 file: datasets and attributes with units and long names, checked when they are read.

TEXT = h5py.string_dtype()
_ROOM, _EXPANSION = 1 << 20, 1032  # most bytes of a dataset: deflate makes 1032 of one
_ONE = h5py.h5s.create(h5py.h5s.SCALAR)


class DamagedError(DataError):
    """An entry is missing or of the wrong type; `gbid.core.hdf5.reading` adds the file and what to do."""


def add_dataset(
    group: h5py.Group, name: str, values: npt.ArrayLike, unit: str, long_name: str, **options: Any
) -> h5py.Dataset:
    """Write one dataset with its unit and its long name; return it."""
    dataset = group.create_dataset(name, data=values, **options)
    add_attribute(dataset, "units", np.array(unit, dtype=object))
    add_attribute(dataset, "long_name", np.array(long_name, dtype=object))
    return dataset


def add_attribute(item: h5py.HLObject, name: str, values: npt.NDArray[Any]) -> None:
    """Write numbers or texts as a new attribute; low-level calls take half the time of ``item.attrs``."""
    text = values.dtype.kind == "O"
    values = np.asarray(values, dtype=TEXT) if text else values
    kind = h5py.h5t.py_create(values.dtype, logical=True)
    space = h5py.h5s.create_simple(values.shape) if values.ndim else _ONE
    h5py.h5a.create(item.id, name.encode(), kind, space).write(values)


def add_texts(item: h5py.HLObject, name: str, texts: Iterable[str]) -> None:
    """Write texts as a new attribute."""
    add_attribute(item, name, np.array(list(texts), dtype=object))


def read_dataset(group: h5py.Group, name: str, texts: bool = False) -> npt.NDArray[Any]:
    """Return the values of one dataset of any shape.

    Parameters
    ----------
    group : h5py.Group
        Group of the dataset.
    name : str
        Name or path below the group.
    texts : bool
        Whether the values are texts; else numbers.

    Returns
    -------
    array
        The values.

    Raises
    ------
    DamagedError
        When there is no dataset of that name, or its values have another type.
    """
    try:
        found = group[name]
    except KeyError:
        raise DamagedError(f"{where(group, name)} is missing") from None
    if not isinstance(found, h5py.Dataset):
        raise DamagedError(f"{where(group, name)} is a group, not a dataset")
    if found.shape is None:
        raise DamagedError(f"{where(group, name)} holds nothing, not {'texts' if texts else 'numbers'}")
    if found.nbytes > _ROOM + _EXPANSION * group.file.id.get_filesize():
        raise DamagedError(f"{where(group, name)} declares more values than the file can contain")
    if texts != (h5py.check_string_dtype(found.dtype) is not None) or (not texts and found.dtype.kind not in "fiub"):
        raise DamagedError(f"{where(group, name)} holds {found.dtype}, not {'texts' if texts else 'numbers'}")
    return np.asarray(found.asstr()[()] if texts else found[()])


def read_attribute(item: h5py.HLObject, name: str) -> Any:
    """Return the value of one attribute of a file, group or dataset.

    Raises
    ------
    DamagedError
        When the attribute is missing.
    """
    try:
        return item.attrs[name]
    except KeyError:
        raise DamagedError(f"{item.name} has no attribute {name!r}") from None


def read_text(item: h5py.HLObject, name: str) -> str:
    """Return the text of one attribute.

    Raises
    ------
    DamagedError
        When the attribute is missing or not a text.
    """
    found = read_attribute(item, name)
    if not isinstance(found, str):
        raise DamagedError(f"attribute {name!r} of {item.name} is not a text")
    return found


def read_texts(item: h5py.HLObject, name: str) -> tuple[str, ...]:
    """Return the texts of one attribute.

    Raises
    ------
    DamagedError
        When the attribute is missing or not a list of texts.
    """
    found = np.atleast_1d(read_attribute(item, name))
    if found.ndim != 1 or not all(isinstance(text, str) for text in found):
        raise DamagedError(f"attribute {name!r} of {item.name} is not a list of texts")
    return tuple(map(str, found))


def read_group(group: h5py.Group, name: str) -> h5py.Group:
    """Return the subgroup of that name.

    Raises
    ------
    DamagedError
        When there is no such group.
    """
    found = group.get(name)
    if not isinstance(found, h5py.Group):
        raise DamagedError(f"group {where(group, name)} is {'missing' if found is None else 'a dataset'}")
    return found


def where(group: h5py.Group, name: str) -> str:
    """Return the path of an entry within its file."""
    return f"{group.name.rstrip('/')}/{name}"


# ---- Copy of an HDF5 file that has no checksum, made in another process: the library may fail on damaged bytes.
#
# Files of gbid 0.1 have no checksum. What the other process could read in full is written to a new file in memory. This
# one is sound, so that it can be opened here.

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


_CHECKSUM = "checksum"  # attribute of the root: such a file ends with its checksum


@dataclass(frozen=True)
class FileKind:
    """Kind of file.

    Attributes
    ----------
    name : str
        Attribute ``gbid_kind`` of the root: ``"recording"``, ``"fit"`` and so on.
    remedy : str
        Advice for a file that cannot be read, as part of the error message.
    upgrades : tuple of callable or None
        Conversions of older files, in memory: the first from schema 1 to schema 2, and so on; None where such files are
        refused. The present schema is the one after the last.
    """

    name: str
    remedy: str
    upgrades: tuple[Callable[[h5py.File], None] | None, ...] = ()

    @property
    def schema_version(self) -> int:
        """Version of the schema that is written."""
        return len(self.upgrades) + 1


@contextlib.contextmanager
def writing(path: str | Path, kind: FileKind, overwrite: bool = False) -> Iterator[h5py.File]:
    """Return a context with a new HDF5 file, which appears under its name only when it is complete.

    Parameters
    ----------
    path : path
        The file.
    kind : Kind
        Kind of the file; it is checked at reading.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    DataError
        When a text cannot be stored in HDF5.
    """
    with atomic_path(given_path(path), overwrite) as part, _through_memory(part, "w") as file:
        file.attrs["gbid_kind"] = kind.name
        file.attrs["schema_version"] = kind.schema_version
        file.attrs["creator"] = f"gbid {__version__}"
        file.attrs["created"] = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            yield file
        except ValueError as error:
            if not isinstance(error, UnicodeEncodeError) and "embedded NULL" not in str(error):
                raise
            text = "a name or text contains a NUL character or half of a letter, which HDF5 cannot store"
            raise DataError(f"{path}: cannot be written: {text}; change it") from None


@contextlib.contextmanager
def changing(path: Path) -> Iterator[h5py.File]:
    """Return a context with an HDF5 file to change; it is written at the end if no error occurs."""
    with _through_memory(path, "r+") as file:
        yield file


@contextlib.contextmanager
def _through_memory(path: Path, mode: str) -> Iterator[h5py.File]:
    """Return a context with a file in memory, whose bytes are written at the end.

    On a full disk the HDF5 library cannot close its own file, and crashes the process at its end.
    """
    with _in_memory(path, mode) as file:
        yield file
        file.attrs[_CHECKSUM] = "sha256, the last line of the file"
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(with_checksum(image))


def _in_memory(path: Path, mode: str) -> h5py.File:
    return h5py.File(path, mode, driver="core", backing_store=False)


@contextlib.contextmanager
def reading(path: str | Path, kind: FileKind) -> Iterator[h5py.File]:
    """Return a context with an HDF5 file of a kind, opened for reading; older schemas are converted in memory.

    Raises
    ------
    DataError
        When the file is missing, not HDF5, truncated, of another kind or a newer schema. When its checksum is not that
        of its bytes; files of gbid 0.1 have none. Also when an entry that the context reads is missing, of the wrong
        type or shape, or contradicts another.
    """
    path = given_path(path)
    try:
        if not path.is_file():
            raise DataError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        with opened(path) as file:
            version = _checked_version(file, path, kind)
            if version == kind.schema_version:
                yield file
                return
        with opened(path, can_change=True) as file:
            for upgrade in kind.upgrades[version - 1 :]:
                if upgrade is None:
                    words = f"written by an older gbid (schema_version {version}); remove it and"
                    raise DataError(f"{path}: {words} {kind.remedy}")
                upgrade(file)
            yield file
    except DamagedError as error:
        raise DataError(f"{path}: {error}; {kind.remedy}") from None
    except (OSError, RuntimeError) as error:  # h5py raises either for a damaged file
        raise DataError(f"{path}: not a readable HDF5 file (truncated or of another format): {error}") from None
    except KeyError as error:
        words = str(error.args[0] if error.args else error)
        raise DataError(f"{path}: incomplete {kind.name} file: {words}; {kind.remedy}") from None
    except GbidError as error:
        if str(path) in str(error):
            raise
        raise DataError(f"{path}: damaged {kind.name} file: {error}; {kind.remedy}") from None
    except (TypeError, ValueError) as error:
        words = f"damaged {kind.name} file, its entries do not fit together ({error})"
        raise DataError(f"{path}: {words}; {kind.remedy}") from None
    except Exception as error:  # what the library or a value raises on an entry that gbid does not write
        with library_errors(path, kind.remedy):
            raise error from None


@contextlib.contextmanager
def opened(path: Path, can_change: bool = False) -> Iterator[h5py.File]:
    """Return a context with an HDF5 file of gbid: the file itself if its checksum is right, else a copy in memory.

    Changes, where they are allowed, stay in memory.

    Raises
    ------
    DataError
        When the checksum is wrong or missing. When a file that should have none cannot be copied.
    OSError
        When the file is not HDF5.
    """
    if has_valid_checksum(path):
        with _in_memory(path, "r+") if can_change else h5py.File(path, "r") as file:
            yield file
        return
    with copied(path, can_change) as file:
        if _CHECKSUM in file.attrs:
            words = "the checksum at its end is missing: it is truncated, or was changed by another program"
            raise DataError(f"{path}: {words}; take a copy of it from a backup, or make it again")
        yield file


def _checked_version(file: h5py.File, path: Path, kind: FileKind) -> int:
    found = file.attrs.get("gbid_kind")
    if not isinstance(found, str) or found != kind.name:
        other = found if isinstance(found, str) else "an HDF5 file of another program"
        raise DataError(f"{path}: expected a gbid {kind.name} file, found {other}")
    version = file.attrs.get("schema_version", "missing")
    if not isinstance(version, np.integer) or not 1 <= version <= kind.schema_version:
        raise DataError(
            f"{path}: schema_version {version}; this gbid reads up to {kind.schema_version}, "
            "so read the file with the gbid that wrote it"
        )
    return int(version)
