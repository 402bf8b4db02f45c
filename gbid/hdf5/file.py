"""HDF5 files of gbid: written in full or not at all, and checked when they are opened."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from gbid._version import __version__
from gbid.atomic import atomic_path
from gbid.errors import DataError, GbidError
from gbid.files.checksum import has_valid_checksum, with_checksum
from gbid.files.library_errors import library_errors
from gbid.hdf5.copying import copied
from gbid.hdf5.entries import DamagedError
from gbid.naming.paths import given_path

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
