"""HDF5 files of gbid: written whole or not at all, and checked when they are opened."""

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
from gbid.errors import DataError
from gbid.hdf5.entries import DamagedError


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes
    ----------
    name : str
        Attribute ``gbid_kind`` of its root: ``"recording"``, ``"fit"`` and so on.
    remedy : str
        What to do about a file that cannot be read.
    upgrades : tuple of callable or None
        How older files are read: the first changes a tree of schema 1, in memory, to one of schema 2, and so on; None
        where such files are refused. The present schema is the one after the last.
    """

    name: str
    remedy: str
    upgrades: tuple[Callable[[h5py.File], None] | None, ...] = ()

    @property
    def schema_version(self) -> int:
        """Version of the tree that is written."""
        return len(self.upgrades) + 1


@contextlib.contextmanager
def writing(path: str | Path, kind: FileKind, overwrite: bool = False) -> Iterator[h5py.File]:
    """Open a new HDF5 file that appears under its name only when complete.

    Parameters
    ----------
    path : path
        The file.
    kind : FileKind
        What it holds; checked when read.
    overwrite : bool
        Whether an existing file may be replaced.
    """
    with atomic_path(Path(path), overwrite) as part, _through_memory(part, "w") as file:
        file.attrs["gbid_kind"] = kind.name
        file.attrs["schema_version"] = kind.schema_version
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
    with _in_memory(path, mode) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


def _in_memory(path: Path, mode: str) -> h5py.File:
    return h5py.File(path, mode, driver="core", backing_store=False)


@contextlib.contextmanager
def reading(path: str | Path, kind: FileKind) -> Iterator[h5py.File]:
    """Open an HDF5 file of gbid and check that it is of the kind asked for; older trees are brought up to date.

    Raises
    ------
    DataError
        When the file is missing, no HDF5, truncated, of another kind or a newer schema, or when what is read inside
        the block is missing, of the wrong type or shape, or does not fit together.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise DataError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        with h5py.File(path, "r") as file:
            version = _checked_version(file, path, kind)
            if version == kind.schema_version:
                yield file
                return
        with _in_memory(path, "r+") as file:
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
    except (TypeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"{path}: damaged {kind.name} file, its entries do not fit together ({error}); {kind.remedy}"
        ) from None


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
