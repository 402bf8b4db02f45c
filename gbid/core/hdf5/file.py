"""HDF5 files of gbid: datasets and attributes, atomic writing, checked reading."""

from __future__ import annotations

import contextlib
import json
import platform
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, lru_cache
from importlib import metadata
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from gbid._version import __version__
from gbid.core.apart import read_apart
from gbid.core.errors import DataError, GbidError
from gbid.core.files import atomic_path, has_valid_checksum, library_errors, with_checksum
from gbid.core.names import given_path, one_line

TEXT = h5py.string_dtype()
_ROOM, _EXPANSION = 1 << 20, 1032  # most bytes of a dataset: deflate makes 1032 of one
_COMPRESSED = 10_000  # smallest number of values in a compressed dataset


class DamagedError(DataError):
    """Missing entry, or entry of the wrong type; `gbid.core.hdf5.reading` completes the message."""


def add_dataset(
    group: h5py.Group, name: str, values: npt.ArrayLike, unit: str, long_name: str, compress: bool = False
) -> h5py.HLObject:
    """Write one dataset of numbers or texts with unit and long name, and return it; `compress` acts on large ones."""
    values = np.asarray(values)
    if compress and values.size >= _COMPRESSED:
        dataset = group.create_dataset(name, data=values, compression="gzip", shuffle=True)
    else:  # the low-level calls take half the time
        values, kind, memory, space = _stored(values)
        dataset = h5py.HLObject(h5py.h5d.create(group.id, name.encode(), kind, space, *_WITHOUT_TIMES))
        dataset.id.write(h5py.h5s.ALL, h5py.h5s.ALL, values, memory)
    add_attribute(dataset, "units", _text(unit))
    add_attribute(dataset, "long_name", _text(long_name))
    return dataset


def add_attribute(item: h5py.HLObject, name: str, values: npt.NDArray[Any]) -> None:
    """Write numbers or texts as a new attribute, by low-level calls: twice as fast as ``item.attrs``."""
    values, kind, memory, space = _stored(values)
    h5py.h5a.create(item.id, name.encode(), kind, space).write(values, memory)


@lru_cache
def _text(text: str) -> npt.NDArray[Any]:
    return np.array(text, dtype=TEXT)


def _stored(values: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], h5py.h5t.TypeID, h5py.h5t.TypeID, h5py.h5s.SpaceID]:
    """Return numbers or texts as h5py stores them, with file type, memory type and dataspace."""
    values = np.asarray(values, dtype=TEXT if values.dtype.kind == "O" else None, order="C")
    return values, *_types_of(values.dtype), _space_of(values.shape)


_space_of = lru_cache(h5py.h5s.create_simple)


@cache
def _types_of(dtype: np.dtype[Any]) -> tuple[h5py.h5t.TypeID, h5py.h5t.TypeID]:
    """Return file type and memory type of values, cached: their creation takes a third of the time of a write."""
    return h5py.h5t.py_create(dtype, logical=True), h5py.h5t.py_create(dtype)


def _properties() -> tuple[h5py.h5p.PropDCID, h5py.h5p.PropLCID]:
    """Return property lists of a new dataset and of its link: no time stamps, missing groups are created."""
    dataset, link = h5py.h5p.create(h5py.h5p.DATASET_CREATE), h5py.h5p.create(h5py.h5p.LINK_CREATE)
    dataset.set_obj_track_times(False)
    link.set_create_intermediate_group(True)
    link.set_char_encoding(h5py.h5t.CSET_UTF8)
    return dataset, link


_WITHOUT_TIMES = _properties()


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
        dataset = h5py.h5d.open(group.id, name.encode())  # half the time of ``group[name]``
    except (KeyError, ValueError):
        problem = "is a group, not a dataset" if name in group else "is missing"
        raise DamagedError(f"{where(group, name)} {problem}") from None
    shape, kind = dataset.shape, dataset.dtype
    if shape is None:
        raise DamagedError(f"{where(group, name)} holds nothing, not {'texts' if texts else 'numbers'}")
    size = prod(shape) * kind.itemsize
    created_with = dataset.get_create_plist()
    if created_with.get_external_count() or created_with.get_layout() == h5py.h5d.VIRTUAL:
        raise DamagedError(f"{where(group, name)} takes its data from another file, which gbid never writes")
    if size > _ROOM and size > _ROOM + _EXPANSION * dataset.get_storage_size():
        raise DamagedError(f"{where(group, name)} declares more values than the file can contain")
    is_text = h5py.check_string_dtype(kind) is not None
    if texts != is_text or (not texts and kind.kind not in "fiub"):
        raise DamagedError(f"{where(group, name)} holds {kind}, not {'texts' if texts else 'numbers'}")
    if texts:
        return np.asarray(h5py.Dataset(dataset).asstr()[()])
    values = np.empty(shape, kind)
    dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, values, _types_of(kind)[1])
    return values


def read_attribute(item: h5py.HLObject, name: str, at: str = ".") -> Any:
    """Return the value of an attribute of a file, group or dataset; `at` is the path of an item in a group.

    Raises
    ------
    DamagedError
        When the attribute is missing.
    """
    try:
        attribute = h5py.h5a.open(item.id, name.encode(), obj_name=at.encode())
    except KeyError:
        raise DamagedError(f"{where(item, at)} has no attribute {name!r}") from None
    shape, kind = attribute.shape, attribute.dtype
    is_text = kind == TEXT
    if shape is None or not (is_text or kind.kind in "fiub"):
        return item[at].attrs[name]
    values = np.empty(shape, kind)
    attribute.read(values, _types_of(kind)[1])  # half the time of ``item.attrs``
    if is_text:
        texts = [text.decode("utf-8", "surrogateescape") for text in values.flat]
        values = np.array(texts, dtype=object).reshape(shape)
    return values[()]


def read_text(item: h5py.HLObject, name: str, at: str = ".") -> str:
    """Return the text of one attribute; see `read_attribute`.

    Raises
    ------
    DamagedError
        When the attribute is missing or not a text.
    """
    text = read_attribute(item, name, at)
    if not isinstance(text, str):
        raise DamagedError(f"attribute {name!r} of {where(item, at)} is not a text")
    return text


def read_texts(item: h5py.HLObject, name: str, at: str = ".") -> tuple[str, ...]:
    """Return the texts of one attribute; see `read_attribute`.

    Raises
    ------
    DamagedError
        When the attribute is missing or not a list of texts.
    """
    texts = np.atleast_1d(read_attribute(item, name, at))
    if texts.ndim != 1 or not all(isinstance(text, str) for text in texts):
        raise DamagedError(f"attribute {name!r} of {where(item, at)} is not a list of texts")
    return tuple(map(str, texts))


def read_group(group: h5py.Group, name: str) -> h5py.Group:
    """Return the subgroup with the given name.

    Raises
    ------
    DamagedError
        When there is no such group.
    """
    try:
        return h5py.Group(h5py.h5g.open(group.id, name.encode()))  # a third of the time of ``group[name]``
    except (KeyError, ValueError):
        problem = "a dataset" if name in group else "missing"
        raise DamagedError(f"group {where(group, name)} is {problem}") from None


def where(group: h5py.HLObject, name: str) -> str:
    """Return the path of an entry within its file; for "." the path of the group itself."""
    return group.name if name == "." else f"{group.name.rstrip('/')}/{name}"


# ---- Whole files: atomic writing, and checks before the HDF5 library opens them.

_CHECKSUM = "checksum"  # attribute of the root: such a file ends with its checksum
_KEY_LINE = 200  # bytes at the end of a result: the lines of its key and its checksum
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True)
class FileKind:
    """Kind of an HDF5 file of gbid.

    Attributes
    ----------
    name : str
        Attribute ``gbid_kind`` of the root: ``"recording"``, ``"fit"`` and so on.
    remedy : str
        Advice for a file that cannot be read, as part of the error message.
    schema_version : int
        Version of the schema that is written; files of other versions are refused.
    """

    name: str
    remedy: str
    schema_version: int = 1


_ANY = FileKind("result", "make it again")


KEY = "key"
"""Attribute of the root: content key of the result of an experiment; again in the line before the checksum."""
MADE_WITH = "made_with"
"""Attribute of the root: JSON with the versions of programs and, for the result of an experiment, what it came from."""


@cache
def versions() -> Mapping[str, str]:
    """Return the versions of gbid, Python, numpy, scipy and CasADi, and the platform."""
    libraries = {name: metadata.version(name) for name in ("numpy", "scipy", "casadi")}
    return {"gbid": __version__, "python": platform.python_version(), **libraries, "platform": platform.platform()}


def read_made_with(path: Path) -> dict[str, Any]:
    """Return the versions that wrote an HDF5 file; empty for a file without them.

    Raises
    ------
    DataError
        When the file cannot be read.
    """
    with reading(path) as file:
        text = file.attrs.get(MADE_WITH, "{}")
        return dict(json.loads(text)) if isinstance(text, str) else {}


@contextlib.contextmanager
def writing(path: str | Path, kind: FileKind, overwrite: bool = False) -> Iterator[h5py.File]:
    """Return a context with a new HDF5 file, which appears under its name when it is complete.

    Parameters
    ----------
    path : path
        The file.
    kind : FileKind
        Kind of the file; it is checked at reading.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    DataError
        When a text cannot be stored in HDF5.
    """
    with atomic_path(given_path(path), overwrite) as part, changing(part, "w") as file:
        add_attribute(file, "schema_version", np.array(kind.schema_version))
        created = datetime.now(UTC).isoformat(timespec="seconds")
        place, origin = _origin.get()
        texts = {"gbid_kind": kind.name, "creator": f"gbid {__version__}", "created": created}
        texts |= {MADE_WITH: json.dumps(dict(versions())), **(origin if place == path else {})}
        for name, text in texts.items():
            add_attribute(file, name, np.array(text, dtype=object))
        try:
            yield file
        except ValueError as error:
            if not isinstance(error, UnicodeEncodeError) and "embedded NULL" not in str(error):
                raise
            text = "a name or text contains a NUL character or half of a letter, which HDF5 cannot store"
            raise DataError(f"{path}: cannot be written: {text}; change it") from None


_origin: ContextVar[tuple[Path | None, Mapping[str, str]]] = ContextVar("origin", default=(None, MappingProxyType({})))


@contextlib.contextmanager
def with_origin(path: Path, key: str, origin: Mapping[str, Any]) -> Iterator[None]:
    """Return a context that writes a result to a path; the file stores the content key and origin of the result.

    A file of `writing` gets them with all else, one of another library at the end.
    """
    attributes = {KEY: key, MADE_WITH: json.dumps({**versions(), **origin})}
    token = _origin.set((path, attributes))
    try:
        yield
    finally:
        _origin.reset(token)
    if key.encode() not in path.read_bytes()[-_KEY_LINE:]:
        with changing(path) as file:
            file.attrs.update(attributes)


@contextlib.contextmanager
def changing(path: Path, mode: str = "r+") -> Iterator[h5py.File]:
    """Return a context with an existing or new ("w") HDF5 file; the changes are saved if no error occurs.

    It is in memory: on a full disk the HDF5 library cannot close its own file, and crashes the process at its end.
    """
    with h5py.File(path, mode, driver="core", backing_store=False) as file:
        yield file
        if not h5py.h5a.exists(file.id, _CHECKSUM.encode()):
            add_attribute(file, _CHECKSUM, _text("sha256, the last line of the file"))
        file.flush()
        image, key = file.id.get_file_image(), read_text(file, KEY) if h5py.h5a.exists(file.id, KEY.encode()) else ""
    path.write_bytes(with_checksum(image + f"\ncontent_key: {key}".encode() if key else image))


@contextlib.contextmanager
def reading(path: str | Path, kind: FileKind = _ANY, *, apart: bool = False) -> Iterator[h5py.File]:
    """Return a context with an HDF5 file of a kind, opened for reading; by default of any kind.

    With `apart` the reader process first reads all entries: the checksum of a crafted file is right, and the HDF5
    library may crash or never return on it.

    Raises
    ------
    DataError
        When the file is missing, not HDF5, truncated, of another kind or another schema. When its checksum is missing,
        or is not that of its bytes. Also when an entry that the context reads is missing, of the wrong type or shape,
        or contradicts another.
    """
    path = given_path(path)
    try:
        if not path.is_file():
            raise DataError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        with opened(path, apart=apart) as file:
            if kind is not _ANY:
                _check_kind(file, path, kind)
            yield file
    except DamagedError as error:
        raise DataError(f"{path}: {error}; {kind.remedy}") from None
    except (OSError, RuntimeError) as error:  # h5py raises either for a damaged file
        problem = one_line(str(error))  # an error of input or output has three
        raise DataError(f"{path}: not a readable HDF5 file (truncated or of another format): {problem}") from None
    except KeyError as error:
        problem = str(error.args[0] if error.args else error)
        raise DataError(f"{path}: incomplete {kind.name} file: {problem}; {kind.remedy}") from None
    except GbidError as error:
        if str(path) in str(error):
            raise
        raise DataError(f"{path}: damaged {kind.name} file: {error}; {kind.remedy}") from None
    except (TypeError, ValueError) as error:
        problem = f"damaged {kind.name} file, its entries do not fit together ({error})"
        raise DataError(f"{path}: {problem}; {kind.remedy}") from None
    except Exception as error:  # what the library or a value raises on an entry that gbid does not write
        with library_errors(path, kind.remedy):
            raise error from None


@contextlib.contextmanager
def opened(path: Path, *, apart: bool = False) -> Iterator[h5py.File]:
    """Return a context with an HDF5 file of gbid for reading, after verification of its checksum; `apart` as above.

    Raises
    ------
    DataError
        When the checksum is wrong or missing.
    OSError
        When the file is not HDF5.
    """
    if not has_valid_checksum(path):
        with path.open("rb") as start:
            if start.read(len(_SIGNATURE)) != _SIGNATURE:
                raise OSError("it does not begin as HDF5 does")
        raise DataError(
            f"{path}: the checksum at its end is missing: it is truncated, changed by another program, of another "
            "program, or of gbid 0.1.0; create it again, import it, or restore it from a backup"
        )
    if apart:
        read_apart(_read_all, path)
    with h5py.File(path, "r") as file:
        link = file.id.links.visit(_outside, info=True)
        if link is not None:
            raise DamagedError(
                f"{link.decode('utf-8', 'replace')!r} is a link to another file, which gbid never writes"
            )
        yield file


def _read_all(path: Path) -> None:
    """Read every entry of a file; errors of single entries are left to the reader of the value."""

    def read(name: bytes) -> None:
        try:
            item = file[name]
            for key in item.attrs:
                read_attribute(item, key)
            if isinstance(item, h5py.Dataset):
                read_dataset(item, ".", texts=item.dtype.kind == "O")
        except MemoryError:
            raise
        except Exception:
            return

    with contextlib.suppress(OSError, RuntimeError), h5py.File(path, "r") as file:
        read(b"/")
        file.id.links.visit(read)


def _outside(name: bytes, about: Any) -> bytes | None:
    return None if about.type in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT) else name


def _check_kind(file: h5py.File, path: Path, kind: FileKind) -> None:
    stated: dict[str, Any] = {}
    for key in ("gbid_kind", "schema_version"):
        with contextlib.suppress(DamagedError):
            stated[key] = read_attribute(file, key)
    name = stated.get("gbid_kind")
    if not isinstance(name, str) or name != kind.name:
        other = name if isinstance(name, str) else "an HDF5 file of another program"
        raise DataError(f"{path}: expected a gbid {kind.name} file, found {other}")
    version = stated.get("schema_version", "missing")
    if not isinstance(version, np.integer) or version != kind.schema_version:
        raise DataError(
            f"{path}: schema_version {version}, this gbid reads {kind.schema_version}; {kind.remedy}, or read the file "
            "with the gbid that wrote it"
        )
