"""Scheduled fits: scheduling signals in pieces of constant parameters, start values, equations of a piece."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from math import ceil
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.notes import FitNote
from gbid.discretise import Hold
from gbid.identify.data import FitData, Record
from gbid.identify.options import FitArguments, Focus
from gbid.identify.problem.assemble import Ties, assemble, build_problem, full_start
from gbid.identify.problem.solve import solve
from gbid.identify.start.start import Begin, begin_values
from gbid.recording import Recording
from gbid.structure import Parameter, Structure
from gbid.structure.built_in import pade_order_of
from gbid.structure.scheduling import Schedule, ScheduledStructure, coefficient_names, term_name

_DARK = 1e-7  # terms are not determined when a singular value is below this share of the largest


@dataclass(frozen=True, eq=False)
class Courses:
    """Scheduling signals of the recordings of a fit, cut into pieces.

    Attributes
    ----------
    schedule : Schedule
        Terms of the surfaces over the range of the recordings.
    values : tuple of (n_samples, n_variables) array
        Variables of each recording.
    edges : tuple of tuple of int
        For each recording the first samples of its pieces after the first one.
    """

    schedule: Schedule
    values: tuple[FloatArray, ...]
    edges: tuple[tuple[int, ...], ...]

    @property
    def terms(self) -> list[FloatArray]:
        """Time mean of the polynomial terms over each piece of each recording, (n_pieces, n_terms).

        The mean of a term, not the term of the mean: a parameter that is linear in the terms has its mean there. A
        piece lasts until the first sample of the next one, so that its own samples alone are half a sample early.
        """
        return [
            _time_means(self.schedule.terms(values), [0, *edges, len(values) - 1])
            for values, edges in zip(self.values, self.edges, strict=True)
        ]

    @property
    def changes(self) -> list[list[float]]:
        """Largest change of any term within each piece of each recording.

        Twice the difference between the means of both halves: all of the change of a straight course, and little of the
        noise of a measured one. Zero for a piece that is too short for halves.
        """
        changes = []
        for values, edges in zip(self.values, self.edges, strict=True):
            terms, of_pieces = self.schedule.terms(values), list[float]()
            for a, b in itertools.pairwise([0, *edges, len(values) - 1]):
                halves = _time_means(terms[a : b + 1], [0, (b - a) // 2, b - a]) if b - a > 1 else np.zeros((2, 1))
                of_pieces.append(2 * float(np.abs(halves[1] - halves[0]).max()))
            changes.append(of_pieces)
        return changes

    def cut(self, largest: float, shortest: int = 2) -> Courses:
        """Return the signals in shorter pieces: no term changes by more than a limit within a piece."""
        every = []
        for values, edges, changes in zip(self.values, self.edges, self.changes, strict=True):
            ends = itertools.pairwise([0, *edges, len(values) - 1])
            starts = list[int]()
            for (a, b), change in zip(ends, changes, strict=True):
                count = max(1, min(ceil(change / largest), (b - a) // shortest))
                starts += (a + np.arange(count) * (b - a) // count).tolist()
            every.append(tuple(starts[1:]))
        return replace(self, edges=tuple(every), schedule=replace(self.schedule, pieces=_number(every)))

    def ties(self, parameters: Sequence[Parameter]) -> Ties:
        """Return the map from coefficients to the parameters of each piece.

        Parameters
        ----------
        parameters : sequence of Parameter
            Parameters of the scheduled structure, with the coefficients among them.
        """
        surfaces, known = self.schedule.surfaces, {q.name: q for q in parameters}
        maps = np.array([np.kron(np.eye(len(surfaces)), row) for row in np.concatenate(self.terms)])
        shared = tuple(known[name] for key in surfaces for name in self.schedule.names(key))
        return Ties(surfaces, shared, maps, self.edges)


def _time_means(terms: FloatArray, ends: Sequence[int]) -> FloatArray:
    """Return time means of terms (n_samples, n_terms) between samples `ends`, by linear interpolation."""
    between = (terms[:-1] + terms[1:]) / 2
    return np.asarray(np.add.reduceat(between, ends[:-1]) / np.diff(ends)[:, None])


def _number(edges: Sequence[Sequence[int]]) -> int:
    """Return the number of pieces of all recordings."""
    return sum(len(each) + 1 for each in edges)


def read_courses(structure: ScheduledStructure, recordings: Sequence[Recording]) -> Courses:
    """Return the scheduling signals, from signals or conditions of the recordings.

    Raises
    ------
    DataError
        When a recording has neither, or the courses do not determine the terms.
    """
    values = tuple(np.column_stack([_variable(r, name) for name in structure.scheduling]) for r in recordings)
    together = np.concatenate(values)
    edges = tuple(
        _edges(each, max(2, round(structure.piece_s / r.sample_time)))
        for each, r in zip(values, recordings, strict=True)
    )
    schedule = Schedule(
        structure.scheduling,
        tuple(together.min(axis=0).tolist()),
        tuple(together.max(axis=0).tolist()),
        structure.surfaces,
        structure.exponents,
        _number(edges),
        pade_order_of(structure.base),
    )
    courses = Courses(schedule, values, edges)
    size = np.linalg.svd(np.concatenate(courses.terms), compute_uv=False)
    if len(size) < len(schedule.exponents) or size[-1] < _DARK * size[0]:
        ranges = ", ".join(
            f"{name} from {low:g} to {high:g}"
            for name, low, high in zip(schedule.variables, schedule.low, schedule.high, strict=True)
        )
        terms = ", ".join(term_name(e, schedule.variables) for e in schedule.exponents)
        raise DataError(
            f"{structure.name}: the recordings ({ranges}) do not determine the {len(schedule.exponents)} terms "
            f"({terms}); add recordings in which the variables change differently, or lower the order"
        )
    return courses


def _variable(recording: Recording, name: str) -> FloatArray:
    """Return the values of a scheduling variable in a recording, (n_samples,)."""
    if name in recording.signals:
        values = recording.signal(name)
        if values.shape[1] != 1 or not np.isfinite(values).all():
            raise DataError(f"recording {recording.name!r}: signal {name!r} must be one channel of finite numbers")
        return values[:, 0]
    if name not in recording.conditions:
        raise DataError(
            f"recording {recording.name!r} has neither a signal nor a condition {name!r}, which the parameters follow; "
            "add one"
        )
    return np.full(recording.n_samples, float(recording.conditions[name]))


def _edges(values: FloatArray, longest: int) -> tuple[int, ...]:
    """Return the first samples of all pieces but the first; a constant signal is one piece."""
    n = len(values)
    if not np.ptp(values, axis=0).any():
        return ()
    count = -(-n // longest)
    return tuple((np.arange(1, count) * n // count).tolist())


# ---- Start values of surfaces: fits to parts of the recordings, and polynomials through their estimates.


class PartFit(NamedTuple):
    """Estimates and variances of parameters by name; the variance of a fixed parameter is zero."""

    values: dict[str, float]
    variances: dict[str, float]


def fit_part(
    structure: Structure,
    parameters: tuple[Parameter, ...],
    part: FitData,
    intersample: Hold | Sequence[Hold],
    focus: Focus,
    given: Set[str],
) -> PartFit | None:
    """Return the estimates from a part of a recording; None when the solver does not converge.

    The arguments are those of `scheduled_start`. The variances are those of white errors with known initial states:
    they only weight the estimates of several parts.
    """
    begin = begin_values(structure, parameters, part, intersample, given, from_data=False).values
    options = FitArguments(criterion="det", stop="paper", max_iterations=30, intersample=intersample, focus=focus)
    assembly = assemble(structure, parameters, begin, part, options)
    problem, unknowns = build_problem(assembly, part, options, full_start(assembly, begin))
    solution = solve(problem, unknowns, options)
    theta, starts = problem.unpack(solution.unknowns)
    values = problem.values(theta)
    products = problem.error_products(values, starts)
    if not (solution.status.success and np.isfinite(products).all()):
        return None
    weight = np.asarray(problem.n_samples * np.linalg.inv(products), np.float64)
    ((group, sums),) = zip(problem.parts, problem.sweeps(values, starts, weight), strict=True)
    hessian = np.zeros((len(theta), len(theta)))
    hessian[np.ix_(group.index, group.index)] = sums.hessian
    known = dict(zip((q.name for q in assembly.free), theta.tolist(), strict=True))
    spread = dict(zip(known, _inverse_diagonal(hessian).tolist(), strict=True))
    return PartFit({**begin, **known}, {**dict.fromkeys(begin, 0.0), **spread})


def _inverse_diagonal(hessian: FloatArray) -> FloatArray:
    """Return the diagonal of an inverse information matrix; large values for a nearly singular matrix."""
    size = 1 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian * np.outer(size, size))
    return np.asarray((vectors**2 / np.maximum(values, 1e-12 * values[-1])).sum(axis=1) * size**2)


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
    given: Set[str],
) -> Begin:
    """Return start values of all parameters of a scheduled structure.

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
    focus
        As for `gbid.fit`.
    given : set of str
        Parameters whose value comes from the caller.

    Raises
    ------
    DataError
        When too few parts can be fitted.
    """
    schedule, m = courses.schedule, len(courses.schedule.exponents)
    coefficients = {name for key in structure.surfaces for name in schedule.names(key)}
    stated = {q.name: q.start for q in parameters if q.start is not None and (q.fixed or q.name in coefficients)}
    if all(q.start is not None for q in parameters):
        values = {q.name: float(q.start or 0.0) for q in parameters}
        return Begin(values, {name: "user" if name in given else "structure" for name in values}, ())
    known = {q.name: q for q in parameters}
    local = tuple(known.get(q.name, q) for q in structure.base.parameters)
    fits: list[PartFit] = []
    terms: list[FloatArray] = []
    failure = "they are too short"
    needed = -(-2 * m // len(data.records))
    for record, course in zip(data.records, courses.values, strict=True):
        seconds = record.n_samples * data.sample_time
        count = int(np.clip(max(seconds // _LENGTH_S, needed), 1, min(_MOST, max(1, record.n_samples // _SHORTEST))))
        edges = (np.arange(count + 1) * record.n_samples // count).tolist()
        for a, b in itertools.pairwise(edges):
            inputs, outputs = (rows[a:b] - rows[a:b].mean(axis=0) for rows in (record.inputs, record.outputs))
            part = replace(data, records=(Record(record.name, inputs, outputs),))
            try:
                estimates = fit_part(structure.base, local, part, intersample, focus, given)
            except (GbidError, np.linalg.LinAlgError) as error:
                failure = str(error)
                continue
            if estimates is not None:
                fits.append(estimates)
                terms.append(schedule.terms(course[a:b]).mean(axis=0))
    if len(fits) < m or np.linalg.matrix_rank(terms, 1e-6) < m:
        raise DataError(
            f"{structure.name}: {len(fits)} parts of the recordings could be fitted alone, too few for {m} terms "
            f"({failure}); give start values (start=...), or longer recordings"
        )
    begin: dict[str, float] = {}
    for q in local:
        values_of = np.array([each.values[q.name] for each in fits])
        if q.name in structure.surfaces:
            std = np.sqrt([each.variances[q.name] for each in fits])
            surface = _inside(_robust(np.array(terms), values_of, std), np.concatenate(courses.terms), q)
            begin |= dict(zip(schedule.names(q.name), surface.tolist(), strict=True))
        else:
            begin[q.name] = float(np.median(values_of))
    values = {q.name: float(np.clip(stated.get(q.name, begin[q.name]), q.lower, q.upper)) for q in parameters}
    note = f"start values: surfaces through fits to {len(fits)} parts of the recordings with constant parameters"
    origin = {name: "user" if name in given else "data" for name in values}
    return Begin(values, origin, (FitNote.STARTS_FROM_DATA(note),))


def _robust(terms: FloatArray, values: FloatArray, std: FloatArray) -> FloatArray:
    """Return coefficients of a surface by weighted least squares with Huber weights."""
    std = np.maximum(std, 0.3 * np.median(std)) if (std > 0).any() else np.ones(len(values))
    weight = 1 / std
    for _ in range(_ROUNDS):
        coefficients = np.linalg.lstsq(terms * weight[:, None], values * weight, rcond=None)[0]
        away = np.abs(values - terms @ coefficients) / std
        size = 1.4826 * float(np.median(away))
        weight = np.sqrt(np.minimum(1.0, _HUBER * size / np.maximum(away, 1e-300))) / std
    return np.asarray(coefficients)


def _inside(coefficients: FloatArray, terms: FloatArray, q: Parameter) -> FloatArray:
    """Return surface coefficients, flattened towards the mean where the surface leaves the parameter's bounds."""
    values = terms @ coefficients
    mean = float(np.clip(np.median(values), q.lower, q.upper))
    width = np.where(values < mean, mean - q.lower, q.upper - mean)
    away = np.abs(values - mean)
    share = float(np.min(np.where(away > 0, 0.9 * width / np.maximum(away, 1e-300), np.inf), initial=1.0))
    flat = np.zeros_like(coefficients)
    flat[0] = mean
    return np.asarray(flat + min(share, 1.0) * (coefficients - flat))


# ---- Equations of one piece with constant parameters, as functions of the coefficients of the surfaces.


def tied_equations(
    structure: ScheduledStructure, parameters: Sequence[Parameter], begin: Mapping[str, float], courses: Courses
) -> tuple[Structure, tuple[Parameter, ...], Mapping[str, float], Ties]:
    """Return the equations of a piece, their parameters, start values at mean scheduling signals, and ties.

    `parameters` and `begin` are those of the scheduled structure; the ties tell how those of the equations follow.
    """
    names, known = courses.schedule.names, {q.name: q for q in parameters}
    if held := [name for key in structure.surfaces for name in names(key) if known[name].fixed]:
        raise UsageError(
            f"fixed: {', '.join(held)}; coefficients of surfaces are estimated. Leave a parameter out of the surfaces "
            "(gbid.scheduled(..., surfaces=[...])) to fix it"
        )
    mean = np.concatenate(courses.terms).mean(axis=0)
    at_mean = {key: float(mean @ [begin[name] for name in names(key)]) for key in structure.surfaces}
    local = tuple(
        replace(q, start=float(np.clip(at_mean[q.name], q.lower, q.upper))) if q.name in at_mean else known[q.name]
        for q in structure.base.parameters
    )
    values = {q.name: at_mean[q.name] if q.name in at_mean else begin[q.name] for q in local}
    return structure.base, local, values, courses.ties(parameters)


def centre_tie(structure: ScheduledStructure, predictor: Sequence[Parameter], free: Sequence[str]) -> FloatArray:
    """Return the matrix from free parameters of a fit to predictor parameters in the middle of the range.

    Only the first coefficient of each surface counts there.
    """
    first = {name: coefficient_names(name, 1)[0] for name in structure.surfaces}
    place = {name.partition("[")[0]: i for i, name in reversed(list(enumerate(free)))}
    return np.eye(len(free))[[place[first.get(q.name, q.name)] for q in predictor]]
