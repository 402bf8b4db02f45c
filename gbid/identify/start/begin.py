"""Start values of a fit and where they come from: the caller, the structure, or the data."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from gbid.discretise import Hold
from gbid.errors import UsageError
from gbid.identify.data import FitData
from gbid.identify.problem.undriven import without_inputs
from gbid.identify.start.loop_start import plant_data
from gbid.identify.start.start_values import has_own_method, start_values
from gbid.identify.start.subspace_start import SubspaceStart, subspace_start
from gbid.notes.fit_notes import FitNote
from gbid.structure import ClosedLoop, Parameter

_POOR = 0.3  # smallest misfit of a match that may lead to a wrong minimum


@dataclass(frozen=True)
class Begin:
    """Start values of a fit.

    Attributes
    ----------
    values : dict of str to float
        Start values of all parameters, within their bounds.
    origin : dict of str to str
        Origin of each: ``"data"``, ``"user"`` or ``"structure"``.
    notes : tuple of str
        How values were found in the data, where a structure has no method of its own.
    """

    values: dict[str, float]
    origin: dict[str, str]
    notes: tuple[str, ...]


def begin_values(
    structure: Any,
    parameters: Sequence[Parameter],
    data: FitData,
    intersample: Hold | Sequence[Hold],
    asked: Set[str],
    *,
    from_data: bool,
) -> Begin:
    """Return the start values of a fit.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
    parameters : sequence of Parameter
        Parameters, with the starts, fixed values and bounds of the caller.
    data : FitData
        Data of the fit.
    intersample : {"zoh", "foh"} or sequence of these
        Hold of the inputs.
    asked : set of str
        Parameters whose value comes from the caller.
    from_data : bool
        Whether all start values are found in the data, also those that are stated.

    Returns
    -------
    Begin

    Raises
    ------
    UsageError, DataError
        When start values are missing and cannot be found in the data.
    """
    if isinstance(structure, ClosedLoop):
        return _of_loop(structure, parameters, data, asked, from_data=from_data)
    stated = {q.name: q.start for q in parameters if q.start is not None and (q.fixed or not from_data)}
    notes: tuple[str, ...] = ()
    missing = [q.name for q in parameters if q.name not in stated]
    if missing and not has_own_method(structure) and hasattr(structure, "matrices"):
        own: Any = structure if data.input_names else without_inputs(structure)
        found = subspace_start(own, data, parameters, intersample)
        values = {**found.values, **stated}
        notes = (_note(found, missing),)
    else:
        values = start_values(structure, data, stated)
    within = {
        q.name: values[q.name] if q.name in stated else float(np.clip(values[q.name], q.lower, q.upper))
        for q in parameters
    }
    given = {name: "user" if name in asked else "structure" for name in stated}
    return Begin(within, {q.name: given.get(q.name, "data") for q in parameters}, notes)


def _of_loop(
    loop: ClosedLoop, parameters: Sequence[Parameter], data: FitData, asked: Set[str], *, from_data: bool
) -> Begin:
    """Return the start values of a loop: those of its plant, whose inputs are known from what the controller did."""
    own = {gain.name for gain in loop.gains}
    gains = {q.name: q.start for q in parameters if q.name in own and q.start is not None}
    missing = [name for name in own if name not in gains]
    if missing:
        raise UsageError(f"{loop.name}: no start value for {', '.join(sorted(missing))}; give each a start")
    rest = [q for q in parameters if q.name not in own]
    plant = loop.structure
    if from_data or any(q.start is None for q in rest):
        data = plant_data(loop, data, gains)
    begin = begin_values(plant, rest, data, plant.intersample, asked, from_data=from_data)
    origin = {name: "user" if name in asked else "structure" for name in gains}
    return Begin({**begin.values, **gains}, {**begin.origin, **origin}, begin.notes)


def _note(found: SubspaceStart, missing: Sequence[str]) -> str:
    listed = ", ".join(missing) if len(missing) <= 8 else f"{len(missing)} parameters"
    note = (
        f"start values of {listed}: from the data, by a subspace model with {found.order} states; the structure "
        f"explains {100 * (1 - found.misfit):.1f} % of its response"
    )
    doubt = "; that is little: try fit_multistart" if found.misfit > _POOR else ""
    return FitNote.STARTS_FROM_DATA(f"{note}{doubt}")
