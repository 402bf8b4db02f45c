"""What a fit hands to the assembly: a structure with its own parameters, and what they are tied to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.identify.problem.ties import Ties
from gbid.identify.scheduled.courses import Courses
from gbid.structure import AnyStructure, Parameter
from gbid.structure.scheduling.schedule import coefficient_names
from gbid.structure.scheduling.scheduled_structure import ScheduledStructure


@dataclass(frozen=True)
class TiedEquations:
    """Structure with constant parameters, and its ties to the parameters of the fit.

    Attributes
    ----------
    structure : AnyStructure
        Equations.
    parameters : tuple of Parameter
        Parameters of the equations.
    begin : dict of str to float
        Start values of these, at the mean of the courses.
    ties : Ties or None
        How they follow from the parameters of the fit; None where they are the same.
    """

    structure: AnyStructure
    parameters: tuple[Parameter, ...]
    begin: Mapping[str, float]
    ties: Ties | None


def tied_equations(
    structure: AnyStructure,
    parameters: tuple[Parameter, ...],
    begin: Mapping[str, float],
    courses: Courses | None,
) -> TiedEquations:
    """Return the equations of a fit; `parameters` and `begin` are those of its structure."""
    if not isinstance(structure, ScheduledStructure):
        return TiedEquations(structure, parameters, begin, None)
    assert courses is not None
    names = courses.schedule.names
    coefficients = {name for key in structure.surfaces for name in names(key)}
    if held := [q.name for q in parameters if q.fixed and q.name in coefficients]:
        raise UsageError(
            f"fixed: {', '.join(held)}; coefficients of surfaces are estimated. Leave a parameter out of the surfaces "
            "(gbid.scheduled(..., surfaces=[...])) to fix it"
        )
    mean = np.concatenate(courses.terms).mean(axis=0)
    at_mean = {key: float(mean @ [begin[name] for name in names(key)]) for key in structure.surfaces}
    known = {q.name: q for q in parameters}
    own = tuple(
        replace(q, start=float(np.clip(at_mean[q.name], q.lower, q.upper))) if q.name in at_mean else known[q.name]
        for q in structure.base.parameters
    )
    values = {q.name: at_mean[q.name] if q.name in at_mean else begin[q.name] for q in own}
    return TiedEquations(structure.base, own, values, courses.ties(parameters))


def centre_tie(structure: AnyStructure, predictor: Sequence[Parameter], free: Sequence[str]) -> FloatArray | None:
    """Return the matrix from the free parameters of a fit to those of a predictor in the middle of the range.

    Only the first coefficient of each surface counts there. None for a structure with constant parameters.
    """
    if not isinstance(structure, ScheduledStructure):
        return None
    place = {name.partition("[")[0]: i for i, name in reversed(list(enumerate(free)))}
    own = [q.name for q in predictor]
    names = [coefficient_names(name, 1)[0] if name in structure.surfaces else name for name in own]
    return np.eye(len(free))[[place[name] for name in names]]
