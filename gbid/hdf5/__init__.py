"""HDF5 files of gbid: atomic writing, checked reading, dataclasses stored by the types of their fields."""

from gbid.hdf5.entries import (
    DamagedError,
    add_dataset,
    add_texts,
    read_attribute,
    read_dataset,
    read_group,
    read_text,
    read_texts,
)
from gbid.hdf5.file import FileKind, changing, opened, reading, writing
from gbid.hdf5.store import load, read_fields, save, write_fields
from gbid.hdf5.stored import NOT_STORED, Stored

__all__ = [
    "NOT_STORED",
    "DamagedError",
    "FileKind",
    "Stored",
    "add_dataset",
    "add_texts",
    "changing",
    "load",
    "opened",
    "read_attribute",
    "read_dataset",
    "read_fields",
    "read_group",
    "read_text",
    "read_texts",
    "reading",
    "save",
    "write_fields",
    "writing",
]
