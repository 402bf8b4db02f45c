"""Start values of surfaces: fits to parts of the recordings, and a polynomial through their estimates."""

from __future__ import annotations

import itertools
from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold
from gbid.errors import DataError, GbidError
from gbid.identify.data import FitData, Record
from gbid.identify.kernel.engine import EngineName
from gbid.identify.predictor import Focus
from gbid.identify.scheduled.courses import Courses
from gbid.identify.scheduled.part_fit import PartFit, fit_part
from gbid.identify.start.begin import Begin
from gbid.notes.fit_notes import FitNote
from gbid.structure import Parameter
from gbid.structure.scheduling.scheduled_structure import ScheduledStructure

_LENGTH_S, _SHORTEST, _MOST = 1.0, 200, 12  # usual part [s], samples of the shortest, and most parts of a recording
_HUBER = 1.5
_ROUNDS = 10


def scheduled_start(
    structure: ScheduledStructure,
    parameters: Sequence[Parameter],
    data: FitData,
    courses: Courses,
    intersample: Hold | Sequence[Hold],
    focus: Focus,
    engine: EngineName,
    asked: Set[str],
) -> Begin:
    """Return the start values of all parameters.

    Each part of a recording is fitted as if the variables were constant at their mean. Robust least squares through
    these estimates, weighted by their variances, give the coefficients.

    Parameters
    ----------
    structure : ScheduledStructure
        Structure of the fit.
    parameters : sequence of Parameter
        Its parameters, with fixed values and starts of the caller.
    data : FitData
        Data of the fit.
    courses : Courses
        Their scheduling variables.
    intersample : {"zoh", "foh"} or sequence of these
        Behaviour of the inputs between samples.
    focus, engine
        As for `gbid.fit`.
    asked : set of str
        Parameters whose value comes from the caller.

    Raises
    ------
    DataError
        When too few parts can be fitted.
    """
    coefficients = {name for key in structure.surfaces for name in courses.schedule.names(key)}
    stated = {q.name: q.start for q in parameters if q.start is not None and (q.fixed or q.name in coefficients)}
    if all(q.start is not None for q in parameters):
        values = {q.name: float(q.start or 0.0) for q in parameters}
        return Begin(values, {name: "user" if name in asked else "structure" for name in values}, ())
    known = {q.name: q for q in parameters}
    own = tuple(known.get(q.name, q) for q in structure.base.parameters)
    found: list[PartFit] = []
    at: list[FloatArray] = []
    failure = "they are too short"
    needed = -(-2 * len(courses.schedule.exponents) // len(data.records))
    for record, course in zip(data.records, courses.values, strict=True):
        seconds = record.n_samples * data.sample_time
        count = int(np.clip(max(seconds // _LENGTH_S, needed), 1, min(_MOST, max(1, record.n_samples // _SHORTEST))))
        edges = (np.arange(count + 1) * record.n_samples // count).tolist()
        for a, b in itertools.pairwise(edges):
            inputs, outputs = (rows[a:b] - rows[a:b].mean(axis=0) for rows in (record.inputs, record.outputs))
            part = replace(data, records=(Record(record.name, inputs, outputs),))
            try:
                made = fit_part(structure.base, own, part, intersample, focus, engine, asked)
            except (GbidError, np.linalg.LinAlgError) as error:
                failure = str(error)
                continue
            if made is not None:
                found.append(made)
                at.append(courses.schedule.terms(course[a:b]).mean(axis=0))
    terms, m = np.array(at), len(courses.schedule.exponents)
    if len(found) < m or np.linalg.matrix_rank(terms, 1e-6) < m:
        raise DataError(
            f"{structure.name}: {len(found)} parts of the recordings could be fitted alone, too few for {m} terms "
            f"({failure}); give start values (start=...), or longer recordings"
        )
    begun: dict[str, float] = {}
    every = np.concatenate(courses.terms)
    for q in own:
        values_of = np.array([each.values[q.name] for each in found])
        if q.name in structure.surfaces:
            std = np.sqrt([each.variances[q.name] for each in found])
            surface = _inside(_robust(terms, values_of, std), every, q)
            begun |= dict(zip(courses.schedule.names(q.name), surface.tolist(), strict=True))
        else:
            begun[q.name] = float(np.median(values_of))
    values = {q.name: float(np.clip(stated.get(q.name, begun[q.name]), q.lower, q.upper)) for q in parameters}
    note = f"start values: surfaces through fits to {len(found)} parts of the recordings with constant parameters"
    origin = {name: "user" if name in asked else "data" for name in values}
    return Begin(values, origin, (FitNote.STARTS_FROM_DATA(note),))


def _robust(terms: FloatArray, values: FloatArray, std: FloatArray) -> FloatArray:
    """Return coefficients by weighted least squares in which values far from the surface count less (Huber)."""
    std = np.maximum(std, 0.3 * np.median(std)) if (std > 0).any() else np.ones(len(values))
    weight = 1 / std
    for _ in range(_ROUNDS):
        coefficients = np.linalg.lstsq(terms * weight[:, None], values * weight, rcond=None)[0]
        away = np.abs(values - terms @ coefficients) / std
        size = 1.4826 * float(np.median(away))
        weight = np.sqrt(np.minimum(1.0, _HUBER * size / np.maximum(away, 1e-300))) / std
    return np.asarray(coefficients)


def _inside(coefficients: FloatArray, terms: FloatArray, q: Parameter) -> FloatArray:
    """Return the coefficients of a surface, flattened towards its mean where it leaves the bounds of its parameter."""
    values = terms @ coefficients
    mean = float(np.clip(np.median(values), q.lower, q.upper))
    width = np.where(values < mean, mean - q.lower, q.upper - mean)
    away = np.abs(values - mean)
    share = float(np.min(np.where(away > 0, 0.9 * width / np.maximum(away, 1e-300), np.inf), initial=1.0))
    flat = np.zeros_like(coefficients)
    flat[0] = mean
    return np.asarray(flat + min(share, 1.0) * (coefficients - flat))
