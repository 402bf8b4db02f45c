"""Optional packages, and data frames of pandas."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from gbid.core.errors import UsageError

# ---- Import of an optional package, or one clear line that says which extra to install.


def extra_package(module: str, extra: str, what: str) -> Any:
    """Return an optional package.

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


def data_frame(columns: Mapping[str, Any], *, index: str = "", units: Mapping[str, str] | None = None) -> Any:
    """Return a data frame.

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
