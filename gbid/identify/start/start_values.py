"""Start values of a structure: those that it states, and for the built-in ones those found in the data."""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Any

from gbid.errors import UsageError
from gbid.identify.data import FitData, Record
from gbid.identify.start.bearing_start import bearing_start
from gbid.identify.start.lag_start import lag_start
from gbid.structure import NonlinearStructure, PiezoPair, Plant, RotorBearing, evaluate
from gbid.structure.rotor_bearing import AXES


@singledispatch
def start_values(structure: Any, data: FitData, given: Mapping[str, float]) -> dict[str, float]:  # noqa: ARG001
    """Return start values of all parameters that have none.

    Parameters
    ----------
    structure : Structure
        A built-in structure; a user's structure must state its start values.
    data : FitData
        Data of the fit.
    given : dict of str to float
        Known values (fixed, or start values of the user).

    Returns
    -------
    dict of str to float
        Values by name, with those of `given`.

    Raises
    ------
    UsageError
        When there is no method to find start values for the structure.
    """
    return _as_given(structure, given)


@start_values.register
def _(structure: RotorBearing, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    data = _without_unbalance(structure, data)
    _check_channels(structure, data.records, 2, 2)
    return {**bearing_start(structure, data.records, data.sample_time), **given}


@start_values.register
def _(structure: PiezoPair, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    if not data.records[0].inputs.size:
        return _as_given(structure, given)
    _check_channels(structure, data.records, 2, 2)
    found: dict[str, float] = {}
    for i, axis in enumerate(AXES):
        slow, fast, gain = lag_start(data.records, i, data.sample_time)
        found |= {f"p1_{axis}": slow, f"p2_{axis}": fast, f"kappa_{axis}": gain}
    return {**{q.name: found.get(q.name, 0.0) for q in structure.parameters}, **given}


@start_values.register
def _(structure: Plant, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    if not data.records[0].inputs.size:
        return _as_given(structure, given)
    data = _without_unbalance(structure.bearing, data)
    _check_channels(structure, data.records, 2, 2 * len(structure.outputs))
    if "u" in structure.outputs:
        actuator_records = tuple(Record(r.name, r.inputs, r.outputs[:, :2]) for r in data.records)
        bearing_records = tuple(Record(r.name, r.outputs[:, :2], r.outputs[:, 2:]) for r in data.records)
        actuators = start_values(structure.actuators, _like(data, actuator_records), {})
        found = {**actuators, **bearing_start(structure.bearing, bearing_records, data.sample_time)}
        return {**found, **given}
    needed = [q.name for q in structure.actuators.parameters if q.name not in given]
    if needed:
        raise UsageError(
            f"structure {structure.name!r} from r to p alone does not determine the actuators: "
            f"fix {', '.join(needed)} (fixed=...) or add u to the outputs"
        )
    model = evaluate(structure.actuators, given)
    records = tuple(
        Record(r.name, model.simulate(r.inputs, data.sample_time, intersample="zoh"), r.outputs) for r in data.records
    )
    return {**bearing_start(structure.bearing, records, data.sample_time), **given}


def has_own_method(structure: Any) -> bool:
    """Return whether there is a method to find start values that was made for the structure."""
    return start_values.dispatch(type(structure)) is not start_values.dispatch(object)


def _as_given(structure: Any, given: Mapping[str, float]) -> dict[str, float]:
    missing = [q.name for q in structure.parameters if q.name not in given]
    if missing:
        nonlinear = isinstance(structure, NonlinearStructure)
        why = ": nonlinear structures have no search for start values in the data" if nonlinear else ""
        raise UsageError(
            f"structure {structure.name!r}: no start value for {', '.join(missing)}; give each a start{why}"
        )
    return dict(given)


def _check_channels(structure: Any, records: tuple[Record, ...], n_inputs: int, n_outputs: int) -> None:
    found = records[0].inputs.shape[1], records[0].outputs.shape[1]
    if found not in {(n_inputs, n_outputs), (0, n_outputs)}:  # none: a free decay
        raise UsageError(
            f"structure {structure.name!r} has {n_inputs} inputs and {n_outputs} outputs; "
            f"the recordings give {found[0]} and {found[1]}"
        )


def _without_unbalance(bearing: RotorBearing, data: FitData) -> FitData:
    """Return the data without the last two inputs when they are the unbalance, which start values do not need."""
    if not (bearing.unbalance and data.records[0].inputs.shape[1] == 4):
        return data
    return _like(data, tuple(Record(r.name, r.inputs[:, :2], r.outputs) for r in data.records))


def _like(data: FitData, records: tuple[Record, ...]) -> FitData:
    return FitData(records, data.sample_time, (), (), ())
