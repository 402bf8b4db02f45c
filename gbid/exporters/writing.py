"""Writing of the exported files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gbid.errors import UsageError
from gbid.exporters.export_target import ExportRequest
from gbid.exporters.finding import Exports
from gbid.exporters.targets import export_target

_WORDS = {
    "ControllerDesign": "controllers",
    "LPVModel": "LPV models",
    "FitResult": "fits",
    "LinearModel": "linear models",
}


def write_exports(found: Exports, to: str, request: ExportRequest) -> list[Path]:
    """Write everything that a target takes, and return the files.

    Parameters
    ----------
    found : Exports
        Models and controllers, from `find_exports`.
    to : str
        Name of the target, one of `target_names`.
    request : ExportRequest
        Folder and options.

    Returns
    -------
    list of pathlib.Path
        The files.

    Raises
    ------
    UsageError
        When there is no such target, when it takes nothing of what was found, or when a file exists and `overwrite` is
        not set.
    DataError
        When a file cannot be written.
    """
    target = export_target(to)
    items = [item for item in found.items if isinstance(item.what, target.takes)]
    if not items:
        takes = ", ".join(_WORDS.get(kind.__name__, kind.__name__) for kind in target.takes)
        there = ", ".join(dict.fromkeys(_WORDS[type(item.what).__name__] for item in found.items))
        raise UsageError(f"{found.source}: --to {to} takes {takes}; here are only {there}: choose another target")
    request = replace(request, beside=found.items)
    return [path for item in items for path in target.write(item, request)]
