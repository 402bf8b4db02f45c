"""Built-in controller structures, one file each, here or in a folder.

A file of this room defines a subclass of `gbid.control.controllers.parts.PerAxis`. The default of its field `name`
is the name in Python, YAML, controller files and messages. Nothing else has to know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pkgutil import walk_packages
from types import MappingProxyType

from gbid.control.controllers.parts import PerAxis


@cache
def built_in_structures() -> Mapping[str, type[PerAxis]]:
    """Return the built-in structures by name."""
    found = {}
    for module in walk_packages(__path__, f"{__name__}."):
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and issubclass(value, PerAxis) and value.__module__ == module.name:
                found[value.name] = value
    return MappingProxyType(dict(sorted(found.items())))
