"""Course of the scheduling variables in each recording, and its pieces with constant parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError
from gbid.identify.problem.ties import Ties
from gbid.recording import Recording
from gbid.structure import Parameter
from gbid.structure.scheduling.schedule import Schedule
from gbid.structure.scheduling.scheduled_structure import ScheduledStructure

_DARK = 1e-7  # terms are not determined when a singular value is below this share of the largest


@dataclass(frozen=True, eq=False)
class Courses:
    """Scheduling variables of the recordings of a fit.

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
        """Mean of the terms in each piece of each recording, (n_pieces, n_terms).

        The mean of a term, not the term of the mean: a parameter that is linear in the terms has its mean there.
        """
        return [
            np.add.reduceat(self.schedule.terms(own), [0, *edges]) / np.diff([0, *edges, len(own)])[:, None]
            for own, edges in zip(self.values, self.edges, strict=True)
        ]

    def ties(self, parameters: Sequence[Parameter]) -> Ties:
        """Return the map from coefficients to the parameters of each piece.

        Parameters
        ----------
        parameters : sequence of Parameter
            Parameters of the scheduled structure, with the coefficients among them.
        """
        k, m = len(self.schedule.surfaces), len(self.schedule.exponents)
        rows = np.concatenate(self.terms)
        maps = np.zeros((len(rows), k, k * m))
        for i in range(k):
            maps[:, i, i * m : (i + 1) * m] = rows
        names = [name for key in self.schedule.surfaces for name in self.schedule.names(key)]
        known = {q.name: q for q in parameters}
        return Ties(
            self.schedule.surfaces, tuple(known[name] for name in names), maps, (), np.zeros((k, 0)), self.edges
        )


def read_courses(structure: ScheduledStructure, recordings: Sequence[Recording]) -> Courses:
    """Return the course of the scheduling variables, from signals or conditions of the recordings.

    Raises
    ------
    DataError
        When a recording has neither, or the courses do not determine the terms.
    """
    values = tuple(np.column_stack([_variable(r, name) for name in structure.scheduling]) for r in recordings)
    together = np.concatenate(values)
    edges = tuple(
        _edges(own, max(2, round(structure.piece_s / r.sample_time))) for own, r in zip(values, recordings, strict=True)
    )
    schedule = Schedule(
        structure.scheduling,
        tuple(together.min(axis=0).tolist()),
        tuple(together.max(axis=0).tolist()),
        structure.surfaces,
        structure.exponents,
        sum(len(own) + 1 for own in edges),
        structure.pade_order,
    )
    courses = Courses(schedule, values, edges)
    size = np.linalg.svd(np.concatenate(courses.terms), compute_uv=False)
    if len(size) < len(schedule.exponents) or size[-1] < _DARK * size[0]:
        ranges = ", ".join(
            f"{name} from {low:g} to {high:g}"
            for name, low, high in zip(schedule.variables, schedule.low, schedule.high, strict=True)
        )
        raise DataError(
            f"{structure.name}: the recordings ({ranges}) do not determine the {len(schedule.exponents)} terms of "
            f"order {structure.order}; add recordings in which the variables change differently, or lower the order"
        )
    return courses


def _variable(recording: Recording, name: str) -> FloatArray:
    """Return a scheduling variable of a recording, (n_samples,)."""
    if name in recording.signals:
        found = recording.signal(name)
        if found.shape[1] != 1 or not np.isfinite(found).all():
            raise DataError(f"recording {recording.name!r}: signal {name!r} must be one channel of finite numbers")
        return found[:, 0]
    if name not in recording.conditions:
        raise DataError(
            f"recording {recording.name!r} has neither a signal nor a condition {name!r}, which the parameters follow; "
            "add one"
        )
    return np.full(recording.n_samples, float(recording.conditions[name]))


def _edges(values: FloatArray, longest: int) -> tuple[int, ...]:
    """Return the first samples of all pieces but the first; a constant course is one piece."""
    n = len(values)
    if not np.ptp(values, axis=0).any():
        return ()
    count = -(-n // longest)
    return tuple((np.arange(1, count) * n // count).tolist())
