"""Optional packages, entry points of other packages, and pandas data frames."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from gbid.core.errors import UsageError


def extra_package(module: str, extra: str, what: str) -> Any:
    """Return an optional package; the error for a missing package names the extra to install.

    Parameters
    ----------
    module : str
        Name for the import.
    extra : str
        Extra of gbid that installs it.
    what : str
        What needs it, as the subject of the message.

    Raises
    ------
    UsageError
        When it is not installed, or when it fails on its import.
    """
    name = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise UsageError(f"{what}: package {name!r} lacks {error.name!r}; {_install(extra)}") from error
        raise UsageError(f"{what}: package {name!r} is not installed; {_install(extra)}") from None
    except Exception as error:  # a package can fail in any way with another version of what it needs
        reason = str(error).strip().splitlines()[-1:] or [""]
        text = f"{what}: package {name!r} fails on its import: {type(error).__name__}: {reason[0]}; {_install(extra)}"
        raise UsageError(text) from error


def _install(extra: str) -> str:
    return f"install the extra: pip install 'gbid[{extra}]'"


def offered(group: str, name: str) -> tuple[Any, str] | None:
    """Return the object of another package's entry point, and that package with its version; None without any.

    Parameters
    ----------
    group : {"gbid.structures", "gbid.formats", "gbid.targets"}
        Group of the entry points.
    name : str
        Name in the group.

    Raises
    ------
    UsageError
        When several packages offer the name, or when the import of the package fails.
    """
    points = list(entry_points(group=group, name=name))
    packages = [f"{point.dist.name} {point.dist.version}" if point.dist else point.value for point in points]
    if not points:
        return None
    if len(points) > 1:
        raise UsageError(f"{name!r} ({group}) is offered by {' and '.join(packages)}; uninstall one of them")
    try:
        return points[0].load(), packages[0]
    except Exception as error:  # foreign code can fail in any way
        text = f"{name!r} ({group}): {packages[0]} fails on its import: {type(error).__name__}: {error}"
        raise UsageError(f"{text}; repair or uninstall it") from error


def data_frame(columns: Mapping[str, Any], *, index: str = "", units: Mapping[str, str] | None = None) -> Any:
    """Return a pandas data frame.

    Parameters
    ----------
    columns : dict of str to (n,) array or sequence
        Columns by name.
    index : str
        Column that becomes the index; without it the rows are numbered.
    units : dict of str to str, optional
        Units of columns, stored in ``frame.attrs["units"]``.

    Returns
    -------
    pandas.DataFrame

    Raises
    ------
    UsageError
        When pandas is not installed.
    """
    pandas = extra_package("pandas", "pandas", "a data frame")
    frame = pandas.DataFrame(dict(columns))
    frame.attrs["units"] = {name: unit for name, unit in (units or {}).items() if unit}
    return frame.set_index(index) if index else frame
