"""Table of fits from their results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.identify.result import FitResult
from gbid.identify.table.fit_table import FitTable


@dataclass(frozen=True, eq=False)
class TableEntry(Brief):
    """Source of one row of a table of fits.

    Attributes
    ----------
    fit, model : str
        Names of the fit and of its model.
    recordings : tuple of str
        Recordings of the model.
    conditions : dict of str to float
        Operating point: ``pressure_bar`` [bar] and ``speed_rpm`` [rpm], if they are known.
    result : FitResult or None
        The result; None for a fit without one.
    failure : str
        Reason of a missing result, which becomes the status.
    """

    fit: str
    model: str
    recordings: tuple[str, ...]
    conditions: Mapping[str, float] = field(default_factory=dict)
    result: FitResult | None = None
    failure: str = ""


def tabulate(entries: Sequence[TableEntry]) -> FitTable:
    """Return a table of fits with one row for each entry, in their order.

    Parameters
    ----------
    entries : sequence of TableEntry
        Sources of the rows.

    Returns
    -------
    FitTable
        The table.
    """
    results = [entry.result for entry in entries]
    there = [result for result in results if result is not None]
    units = {name: unit for result in reversed(there) for name, unit in result.units.items()}
    names = _union(result.parameters for result in there)
    outputs = _union(result.model.output_names for result in there)
    gains = _union(_gain_names(result) for result in there)
    modes = [np.array(r.model.modes(), dtype=float).reshape(-1, 2) if r is not None else None for r in results]
    n_modes = max((found.shape[0] for found in modes if found is not None), default=0)

    n, k = len(entries), len(names)
    values, std = _nan(n, k), _nan(n, k)
    covariance = _nan(n, k, k)
    frequency, frequency_std, damping, damping_std = (_nan(n, n_modes) for _ in range(4))
    gain, gain_std = _nan(n, len(gains)), _nan(n, len(gains))
    percent = _nan(n, len(outputs))
    at = {name: j for j, name in enumerate(names)}
    for i, (result, found) in enumerate(zip(results, modes, strict=True)):
        if result is None or found is None:
            continue
        own = [at[name] for name in result.parameters]
        free = [at[name] for name in result.free]
        values[i, own] = list(result.parameters.values())
        std[i, own] = [result.std[name] for name in result.parameters]
        covariance[np.ix_([i], own, own)] = 0.0
        covariance[np.ix_([i], free, free)] = result.covariance
        m = found.shape[0]
        frequency[i, :m], damping[i, :m] = found.T
        if result.modes_std.shape == (m, 2):
            frequency_std[i, :m], damping_std[i, :m] = result.modes_std.T
        columns = [gains.index(name) for name in _gain_names(result)]
        if columns:
            gain[i, columns], gain_std[i, columns] = result.model.static_gain().ravel(), result.static_gain_std.ravel()
        percent[i, [outputs.index(name) for name in result.model.output_names]] = result.fit_percent.min(axis=0)
    return FitTable(
        fit=np.array([entry.fit for entry in entries], dtype=str),
        model=np.array([entry.model for entry in entries], dtype=str),
        structure=np.array([r.structure if r else "" for r in results], dtype=str),
        recordings=tuple(tuple(entry.recordings) for entry in entries),
        pressure_bar=_condition(entries, "pressure_bar"),
        speed_rpm=_condition(entries, "speed_rpm"),
        parameter_names=names,
        units=tuple(units[name] for name in names),
        values=values,
        std=std,
        covariance=covariance,
        mode_frequency_hz=frequency,
        mode_frequency_std_hz=frequency_std,
        mode_damping=damping,
        mode_damping_std=damping_std,
        gain_names=gains,
        static_gain=gain,
        static_gain_std=gain_std,
        output_names=outputs,
        fit_percent=percent,
        success=np.array([r is not None and r.success for r in results], dtype=bool),
        status=np.array([e.result.status if e.result else e.failure for e in entries], dtype=str),
        notes=tuple(r.notes if r else () for r in results),
        iterations=np.array([r.iterations if r else 0 for r in results], dtype=np.int64),
        wall_time_s=np.array([r.wall_time_s if r else np.nan for r in results], dtype=float),
    )


def _gain_names(result: FitResult) -> tuple[str, ...]:
    """Return the names of the static gains, by outputs, then inputs; empty for a model with a pole at zero."""
    model = result.model
    try:
        model.static_gain()
    except UsageError:
        return ()
    return tuple(f"{source} to {output}" for output in model.output_names for source in model.input_names)


def _union(names: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """Return all names, each once, in the order of their first occurrence."""
    return tuple(dict.fromkeys(name for each in names for name in each))


def _condition(entries: Sequence[TableEntry], name: str) -> FloatArray:
    return np.array([entry.conditions.get(name, np.nan) for entry in entries], dtype=float)


def _nan(*shape: int) -> FloatArray:
    return np.full(shape, np.nan)
