"""Further effects of the rig, one file each.

A file of this room defines a subclass of `gbid.rig.machine.RigEffect`. The default of its field `name` is
the name in the YAML, its other fields are the keys there. Nothing else has to know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pkgutil import walk_packages
from types import MappingProxyType
from typing import Any

from gbid.core.errors import UsageError
from gbid.rig.machine import RigEffect


@cache
def rig_effects() -> Mapping[str, type[RigEffect]]:
    """Return the effects of this room by name."""
    found = {}
    for module in walk_packages(__path__, f"{__name__}."):
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and issubclass(value, RigEffect) and value.__module__ == module.name:
                found[value.name] = value
    return MappingProxyType(dict(sorted(found.items())))


def rig_effect(name: str, **options: Any) -> RigEffect:
    """Return an effect of the rig by name.

    Parameters
    ----------
    name : str
        Name of an effect.
    **options
        Its fields.

    Returns
    -------
    RigEffect

    Raises
    ------
    UsageError
        When there is no such effect or field, or when a value is not allowed.
    """
    known = rig_effects()
    if name not in known:
        raise UsageError(f"no effect {name!r}; there is {', '.join(known)}")
    kind = known[name]
    fields = [key for key in kind.__dataclass_fields__ if key != "name"]
    unknown = [key for key in options if key not in fields]
    if unknown:
        raise UsageError(f"effect {name!r}: unknown option {', '.join(unknown)}; there is {', '.join(fields)}")
    return kind(**options)
