"""HDF5 files with data in other files: external links, external storage and virtual datasets.

HDF5 follows a link wherever it leads, looks for its file in the current folder, too, and reads zeros where a file is
missing or too short. Here gbid resolves each step of a path: other files lie in the folder of the first one or below
it, and have all samples.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import h5py

from gbid.core.apart import read_apart
from gbid.core.errors import DataError

HDF5_ENDINGS = (".h5", ".hdf5")
"""Endings of the HDF5 files of other programs."""
_MOST = 32  # links one after another, and virtual datasets of virtual datasets
_DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError)  # what h5py raises on a damaged file
_INSTEAD = "save the numbers in the file itself"


class ObjectInFile(NamedTuple):
    """Object of an HDF5 file.

    Attributes
    ----------
    file : pathlib.Path
        Its file.
    item : h5py.h5g.GroupID, h5py.h5d.DatasetID or other
        The object.
    """

    file: Path
    item: h5py.h5i.ObjectID


class LinkedFile:
    """Open HDF5 file together with the linked files of its folder.

    Attributes
    ----------
    used : dict of pathlib.Path to None
        Other files that were needed so far.
    """

    def __init__(self, path: Path, stack: ExitStack, *, alone: bool = False) -> None:
        self._path, self._stack = path, stack
        self._folder = None if alone else path.absolute().parent.resolve()
        self._roots: dict[Path, ObjectInFile] = {}
        self._root = self._opened(path.absolute())
        self._symbolic = False  # whether a linked file was reached by a symbolic link to it
        self.used: dict[Path, None] = {}

    def dataset(self, name: str) -> h5py.Dataset | None:
        """Return the dataset at a path; None if there is no dataset.

        Raises
        ------
        DataError
            When its data are outside the folder, or in a file that is missing or too short.
        """
        place = self._find(self._root, _bytes(name))
        return None if place is None else self._dataset(place, name)

    def datasets(self, most: int = sys.maxsize) -> Iterator[tuple[str, h5py.Dataset | DataError]]:
        """Yield each dataset once, with its path; an unreadable dataset is replaced by its error.

        Raises
        ------
        DataError
            When the groups have more entries than `most`.
        """
        todo, seen, count = [(b"", self._root, b"")], set[tuple[int, int]](), 0
        while todo:
            way, group, part = todo.pop()
            if part and group.item.links.get_info(part).type == h5py.h5l.TYPE_SOFT:
                continue  # another name of what is listed
            name = way.decode("utf-8", "surrogateescape")
            try:
                place = self._find(group, part)
                if place is None:
                    continue
                about = h5py.h5o.get_info(place.item)
                if (about.fileno, about.addr) in seen:
                    continue
                seen.add((about.fileno, about.addr))
                dataset = self._dataset(place, name)
            except DataError as error:
                yield name, error
                continue
            if dataset is not None:
                yield name, dataset
            elif isinstance(place.item, h5py.h5g.GroupID):
                parts: list[bytes] = []
                count += place.item.get_num_objs()
                if count > most:
                    text = f"{self._path}: {count} entries or more, of which at most {most} are listed"
                    raise DataError(f"{text}; name the columns in a mapping, or save the channels as one dataset")
                place.item.links.iterate(parts.append)
                todo += [(b"/".join(filter(None, (way, part))), place, part) for part in reversed(parts)]

    def _dataset(self, place: ObjectInFile, name: str) -> h5py.Dataset | None:
        if not isinstance(place.item, h5py.h5d.DatasetID):
            return None
        self._check_storage(place, name)
        return h5py.Dataset(place.item)

    def _opened(self, path: Path) -> ObjectInFile:
        if path not in self._roots:
            file = self._stack.enter_context(h5py.File(path, "r"))
            self._roots[path] = ObjectInFile(path, h5py.h5g.open(file.id, b"/"))
        return self._roots[path]

    def _find(self, start: ObjectInFile, way: bytes) -> ObjectInFile | None:
        """Return the object at a path below a group; None if it does not exist."""
        place, todo, links = start, way.split(b"/")[::-1], 0
        while todo:
            part = todo.pop()
            if part in (b"", b"."):
                continue
            if not isinstance(place.item, h5py.h5g.GroupID) or not place.item.links.exists(part):
                return None
            kind = place.item.links.get_info(part).type
            if kind == h5py.h5l.TYPE_HARD:
                place = self._child(place, part)
                continue
            links += 1
            what = f"{self._path}: link {part.decode('utf-8', 'replace')!r}"
            if links > _MOST:
                raise DataError(f"{what} leads to more than {_MOST} links one after another; {_INSTEAD}")
            if kind == h5py.h5l.TYPE_SOFT:
                rest = place.item.links.get_val(part)
                place = self._opened(place.file) if rest.startswith(b"/") else place
            elif kind == h5py.h5l.TYPE_EXTERNAL:
                name, rest = place.item.links.get_val(part)
                place = self._opened(self._beside(place.file, name, what))
            else:
                raise DataError(f"{what} is of a kind that HDF5 does not define; {_INSTEAD}")
            todo += rest.split(b"/")[::-1]
        return place

    @staticmethod
    def _child(place: ObjectInFile, part: bytes) -> ObjectInFile:
        """Return the object of a hard link; paths of external storage are relative to its file's folder."""
        item = h5py.h5o.open(place.item, part)
        if isinstance(item, h5py.h5d.DatasetID) and item.get_create_plist().get_external_count():
            del item  # it would keep the current folder
            access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
            access.set_efile_prefix(str(place.file.parent).encode())
            item = h5py.h5d.open(place.item, part, access)
        return ObjectInFile(place.file, item)

    def _beside(self, file: Path, name: bytes | str, what: str) -> Path:
        """Return the path of a linked file, after a check that it lies in the folder."""
        text = name if isinstance(name, str) else name.decode("utf-8", "surrogateescape")
        shown = f"{what} takes its data from the file {text.encode('utf-8', 'replace').decode()!r}"
        if self._folder is None:
            raise DataError(f"{shown}; a file of this format takes none: {_INSTEAD}")
        try:
            other = (file.parent / text).resolve(strict=True)
        except (OSError, RuntimeError, ValueError):
            raise DataError(
                f"{shown}, which is not there; copy it into the folder of the data, or {_INSTEAD}"
            ) from None
        if not other.is_relative_to(self._folder):
            raise DataError(f"{shown}, outside the folder of the data; copy it into this folder, or {_INSTEAD}")
        if not other.is_file():
            raise DataError(f"{shown}, which is no file; {_INSTEAD}")
        self._symbolic |= (file.parent / text).is_symlink()
        self.used[other] = None
        return other

    def _check_storage(self, place: ObjectInFile, name: str, depth: int = 0) -> None:
        """Refuse a dataset with data outside the folder."""
        made = place.item.get_create_plist()
        if not made.get_external_count() and made.get_layout() != h5py.h5d.VIRTUAL:
            return
        what = f"{self._path}: dataset {name!r}"
        if depth > _MOST:
            raise DataError(f"{what} is made of more than {_MOST} virtual datasets one within another; {_INSTEAD}")
        size = math.prod(place.item.shape or (0,))
        remaining = size * place.item.dtype.itemsize
        for i in range(made.get_external_count()):
            file, offset, length = made.get_external(i)
            other, needed = self._beside(place.file, file, what), min(length, remaining)
            if other.stat().st_size < offset + needed:
                raise DataError(f"{what}: the file {other.name!r} ends before its last sample; copy it again")
            remaining -= needed
        if made.get_layout() != h5py.h5d.VIRTUAL:
            return
        mapped = 0
        for i in range(made.get_virtual_count()):
            file, source = made.get_virtual_filename(i), made.get_virtual_dsetname(i)
            other = place.file if file == "." else self._beside(place.file, file, what)
            found = self._find(self._opened(other), _bytes(source))
            if found is None or not isinstance(found.item, h5py.h5d.DatasetID):
                raise DataError(f"{what} takes its data from {other.name}/{source}, which is not there; {_INSTEAD}")
            if found.item.get_create_plist().get_external_count():
                text = f"{what} takes its data from {other.name}/{source}, whose numbers are in a third file"
                raise DataError(f"{text}, which HDF5 looks for in the current folder; {_INSTEAD}")
            if found.file != other and (self._symbolic or "HDF5_EXT_PREFIX" in os.environ):
                text = f"{what} takes its data from {other.name}/{source}, a link that HDF5 follows by itself"
                raise DataError(f"{text}, perhaps to another folder by a symbolic link; {_INSTEAD}")
            self._check_storage(found, source, depth + 1)
            selected, shape = made.get_virtual_srcspace(i), found.item.shape or (0,)
            try:
                points = made.get_virtual_vspace(i).get_select_npoints()
            except RuntimeError:
                raise DataError(f"{what} is a virtual dataset without a fixed size; {_INSTEAD}") from None
            if selected.get_select_type() == h5py.h5s.SEL_ALL:
                is_short = math.prod(shape) != points
            else:
                is_short = any(k >= n for k, n in zip_longest(selected.get_select_bounds()[1], shape, fillvalue=0))
            if is_short:
                raise DataError(f"{what} takes other samples from {other.name}/{source} than it has; {_INSTEAD}")
            mapped += points
        if mapped < size:
            raise DataError(f"{what} is virtual, and not all of its samples have a source; {_INSTEAD}")


def _bytes(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


@contextmanager
def linked(path: Path, *, alone: bool = False) -> Iterator[LinkedFile]:
    """Return a context with an HDF5 file and its linked files; `alone` refuses linked files."""
    with ExitStack() as stack:
        yield LinkedFile(path, stack, alone=alone)


def linked_files(path: Path) -> list[Path]:
    """Return the files that an HDF5 file links to, without refused files; of a damaged file those that are found."""
    used: list[Path] = []
    if h5py.is_hdf5(path):
        with suppress(DataError, *_DAMAGED), linked(path) as file:
            for _ in file.datasets():
                used = list(file.used)
    return used


def refuse_links(path: Path) -> None:
    """Refuse a file with an entry whose data are in another file.

    Raises
    ------
    DataError
        When it has such an entry.
    """
    with linked(path, alone=True) as file:
        for _, dataset in file.datasets():
            if isinstance(dataset, DataError):
                raise dataset


def files_beside(path: Path) -> list[str]:
    """Return the files that a file links to; none for other formats.

    Raises
    ------
    OSError
        When the file cannot be read.
    DataError
        When its reader does not answer: a time-out, a crash, or memory.
    """
    return [str(other) for other in read_apart(linked_files, path)] if path.suffix.lower() in HDF5_ENDINGS else []
