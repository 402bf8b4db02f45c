"""HDF5 files of gbid: atomic writing, checked reading, dataclasses stored by the types of their fields."""

from gbid.core.hdf5.file import (
    DamagedError,
    FileKind,
    add_dataset,
    add_texts,
    changing,
    opened,
    read_attribute,
    read_dataset,
    read_group,
    read_text,
    read_texts,
    reading,
    writing,
)
from gbid.core.hdf5.types import AS_JSON, NOT_STORED, InFile, Stored, load, read_fields, save, write_fields

__all__ = [
    "AS_JSON",
    "NOT_STORED",
    "DamagedError",
    "FileKind",
    "InFile",
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
