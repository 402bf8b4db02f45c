"""Formats of files that recordings are imported from, one file each.

A file of this room defines ``FORMAT``, a `gbid.recording.readers.FileFormat`. The import, the check of an
experiment, the patterns of a folder and the messages find it here.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType

from gbid.recording.readers import FileFormat


@cache
def file_formats() -> Mapping[str, FileFormat]:
    """Return the formats by file ending."""
    found = [import_module(module.name).FORMAT for module in iter_modules(__path__, f"{__name__}.")]
    return MappingProxyType({ending: each for each in found for ending in each.endings})
