"""Experiments in MATLAB `iddata` objects: signals, sample time, names and units."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError

_SECONDS = {
    "nanoseconds": 1e-9,
    "microseconds": 1e-6,
    "milliseconds": 1e-3,
    "seconds": 1.0,
    "minutes": 60.0,
    "hours": 3600.0,
    "days": 86400.0,
}


class IddataChannel(NamedTuple):
    """One input or output of an experiment: samples (n_samples,) and unit, which may be empty."""

    values: FloatArray
    unit: str


class IddataExperiment(NamedTuple):
    """One experiment of an `iddata` object.

    Attributes
    ----------
    name : str
        Its name, ``Exp1`` where MATLAB has none.
    inputs, outputs : dict of str to IddataChannel
        Channels by name, ``u1``, ``y1`` where MATLAB has none.
    sample_time : float or None
        Time between samples [s]; None where the object has sampling instants instead.
    start : float or None
        Time of the first sample [s], where the object states it.
    time : (n_samples,) array or None
        Sampling instants [s].
    hold : tuple of str
        Inter-sample behaviour of the inputs as MATLAB states it: ``zoh``, ``foh`` or ``bl``.
    """

    name: str
    inputs: dict[str, IddataChannel]
    outputs: dict[str, IddataChannel]
    sample_time: float | None
    start: float | None
    time: FloatArray | None
    hold: tuple[str, ...]


def experiments_of(data: Mapping[str, Any], where: str) -> list[IddataExperiment]:
    """Return the experiments of an `iddata` object, given by its properties.

    Raises
    ------
    DataError
        When the data are spectra, or a property does not fit the others.
    """
    if (domain := _texts(data, "Domain")) and domain[0].lower().startswith("freq"):
        raise DataError(f"{where} has data over frequency; give frequency responses as gbid.FrequencyData")
    outputs, inputs = (_arrays(data, key) for key in ("OutputData", "InputData"))
    count = max(len(outputs), len(inputs))
    if not count or {len(each) for each in (outputs, inputs)} - {0, count}:
        raise DataError(f"{where} has {len(outputs)} experiments of outputs and {len(inputs)} of inputs")
    unit = (_texts(data, "TimeUnit") or ["seconds"])[0] or "seconds"
    if unit not in _SECONDS:
        raise DataError(f"{where}: the time unit {unit!r} is not one of {', '.join(_SECONDS)}")
    steps, starts, instants = (_arrays(data, key, count) for key in ("Ts", "Tstart", "SamplingInstants"))
    names, holds = _texts(data, "ExperimentName"), _texts(data, "InterSample")
    experiments = []
    for k in range(count):
        driving, measured = (
            _channels(data, side, letter, arrays[k] if arrays else np.zeros((0, 0)))
            for arrays, side, letter in ((inputs, "Input", "u"), (outputs, "Output", "y"))
        )
        step = steps[k] if k < len(steps) else np.zeros(0)
        begin = float(starts[k].flat[0]) * _SECONDS[unit] if k < len(starts) and starts[k].size else None
        even = bool(step.size) and bool(np.isfinite(step).all())
        time = instants[k].ravel() * _SECONDS[unit] if not even and k < len(instants) and instants[k].size else None
        if not even and time is None:
            raise DataError(f"{where}: experiment {k + 1} has neither a sample time Ts nor SamplingInstants")
        sample_time = float(step.flat[0]) * _SECONDS[unit] if even else None
        name = _name(names[k] if k < len(names) else "", f"Exp{k + 1}")
        hold = tuple(holds[: len(driving)])
        experiments.append(IddataExperiment(name, driving, measured, sample_time, begin, time, hold))
    return experiments


def _name(text: str, instead: str) -> str:
    """Return a name without characters that separate parts of a name."""
    clean = text.strip().translate(str.maketrans("./[]", "____"))
    return f"{clean}_" if clean == "time" else clean or instead


def _channels(data: Mapping[str, Any], side: str, letter: str, values: FloatArray) -> dict[str, IddataChannel]:
    columns = values.reshape(len(values), -1).T
    names, units = (_texts(data, f"{side}{what}")[: len(columns)] for what in ("Name", "Unit"))
    described = zip_longest(columns, names, units, fillvalue="")
    return {
        _name(str(name), f"{letter}{i}"): IddataChannel(np.asarray(column, float), str(unit))
        for i, (column, name, unit) in enumerate(described, start=1)
    }


def _arrays(data: Mapping[str, Any], key: str, count: int = 1) -> list[FloatArray]:
    """Return the entries of a property for each experiment: from a cell array, or from a vector of numbers."""
    value = data.get(key)
    if value is None:
        return []
    array = np.asarray(value)
    if array.dtype == object:
        return [np.asarray(entry, float) for entry in array.ravel()]
    if count > 1 and array.size == count:
        return list(np.asarray(array, float).reshape(count, 1))
    return [np.asarray(array, float)] * count


def _texts(data: Mapping[str, Any], key: str) -> list[str]:
    value = data.get(key)
    array = np.asarray([] if value is None else value)
    entries = array.ravel() if array.dtype == object else [array] if array.size else []
    return ["".join(map(str, np.asarray(entry).ravel())) for entry in entries]
