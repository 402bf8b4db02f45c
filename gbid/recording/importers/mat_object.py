"""Objects in MATLAB files as mappings from the names of their properties."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from gbid.recording.importers.columns import seconds

SAVE_PLAIN = "save plain arrays in MATLAB: u = data.u; y = data.y; save('plain.mat','u','y','-v7')"
"""What helps with every object: arrays and structs are read from all files."""


class MatObject(Mapping[str, Any]):
    """A MATLAB object: its properties by name, and its class.

    MATLAB stores some properties under a name with an underscore at its end (`Data_` of a `timeseries`, `InputData_`).
    They are found by the name that MATLAB shows, too.
    """

    def __init__(self, kind: str, properties: Mapping[str, Any]) -> None:
        self.kind = kind
        self._properties = properties

    def __getitem__(self, name: str) -> Any:
        stored = self._properties.get(name)
        return self._properties[f"{name}_"] if stored is None or (not np.size(stored) and self._kept(name)) else stored

    def __contains__(self, name: object) -> bool:
        return name in self._properties or self._kept(name)

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(name.removesuffix("_") for name in self._properties))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def _kept(self, name: object) -> bool:
        return f"{name}_" in self._properties


def opened(value: Any, inside: Any = None) -> Any:
    """Return a struct, an object or a table as a mapping, times as seconds, and anything else as it is.

    Parameters
    ----------
    value : object
        What mat-io returned.
    inside : object
        What it is a field of. The data of an `iddata` object stand in a cell with one entry for each experiment; that
        of a single experiment is opened.
    """
    from matio.utils.matclass import MatlabObject, MatlabOpaque
    from pandas import DataFrame

    if isinstance(value, MatlabOpaque):
        return _timed(MatObject(str(value.classname), value.properties)) if _has_fields(value) else value
    if isinstance(value, DataFrame):
        return MatObject(*_table(value))
    if isinstance(value, np.number):
        return np.reshape(value, (1, 1))
    if isinstance(value, np.ndarray):
        if value.dtype.names and value.size == 1:
            fields = {name: value[name].flat[0] for name in value.dtype.names}
            return _timed(MatObject(str(value.classname), fields)) if isinstance(value, MatlabObject) else fields
        if isinstance(inside, MatObject) and value.dtype == object and value.size == 1:
            return opened(value.flat[0])
        if value.dtype.kind in "mM":
            return seconds(value)
    return value


def class_of(value: Any) -> str:
    """Return the MATLAB class of an object, with the word for it; empty for arrays, structs and cells."""
    kind = value.kind if isinstance(value, MatObject) else getattr(value, "classname", None)
    return f"{kind} object" if kind else ""


def _has_fields(value: Any) -> bool:
    return isinstance(value.properties, Mapping)


def _timed(found: MatObject) -> MatObject:
    """Add the times of a `timeseries` that stores them as start and increment."""
    if found.kind != "timeseries" or ("Time" in found and np.size(found["Time"])) or "TimeInfo" not in found:
        return found
    info = opened(found["TimeInfo"])
    if not isinstance(info, MatObject):
        return found
    if "Time" in info and np.size(info["Time"]):
        time = info["Time"]
    elif {"Start", "Increment", "Length"} <= set(info):
        start, step, length = (np.asarray(info[name]).item() for name in ("Start", "Increment", "Length"))
        time = start + step * np.arange(int(length))[:, None]
    else:
        return found
    return MatObject(found.kind, {**{name: found[name] for name in found}, "Time": time})


def _table(frame: Any) -> tuple[str, dict[str, Any]]:
    """Return class and variables of a table; the times of a timetable are seconds."""
    fields = {str(name): frame[name].to_numpy()[:, None] for name in frame.columns}
    if frame.index.dtype.kind not in "mM":
        return "table", fields
    return "timetable", {str(frame.index.name or "Time"): seconds(frame.index.to_numpy()[:, None]), **fields}
