"""Targets of an export, one file each.

A file ``to_NAME.py`` of this room defines ``TARGET``, a `gbid.export.target.ExportTarget`. NAME is the word
after ``gbid export --to``. The command line, its help and its messages find the target here. The names are read from
the names of the files, so that the help of the command line imports none of them.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from gbid.core.errors import UsageError

if TYPE_CHECKING:
    from gbid.export.target import ExportTarget


_PREFIX = "to_"


def target_names() -> tuple[str, ...]:
    """Return the names of the targets, by the alphabet."""
    return tuple(sorted(m.name.removeprefix(_PREFIX) for m in iter_modules(__path__) if m.name.startswith(_PREFIX)))


def export_target(name: str) -> ExportTarget:
    """Return the target of a name.

    Raises
    ------
    UsageError
        When there is no such target.
    """
    if name not in target_names():
        raise UsageError(f"--to {name}: no such target; there are {', '.join(target_names())}")
    module = next(m for m in iter_modules(__path__, f"{__name__}.") if m.name == f"{__name__}.{_PREFIX}{name}")
    target: ExportTarget = import_module(module.name).TARGET
    return target
