"""Data frames of pandas, which is an optional package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gbid.extras.loading import extra_package


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
