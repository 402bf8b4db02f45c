"""Fits from several starts, and the distinct minima that they reach."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, GbidError
from gbid.core.notes import FitNote
from gbid.core.option_types import Count, CountOrZero, Positive, options_of_call
from gbid.identify.fitting import fitted, with_profiles
from gbid.identify.options import FitArguments
from gbid.identify.pose import Measured
from gbid.identify.result import FitResult, FitStatus, StartsTried
from gbid.structure.kinds import AnyStructure, kind_of

_SAME_LOSS = 1e-6  # largest relative difference of the losses of fits at one minimum
_SAME_IN_STD = 0.1  # largest difference of their parameters, in standard deviations
_SAME_RELATIVE = 1e-4  # the same, as a part of the parameter


@dataclass(frozen=True)
class Minimum:
    """Minimum that one or several fits reached.

    Attributes
    ----------
    loss : float
        Smallest loss of these fits.
    starts : tuple of int
        Numbers of the starts that led there; 0 is the structure's own start.
    status : FitStatus
        Status of the fit with the smallest loss. Without success, the point may not be a minimum.
    parameters : dict of str to float
        Estimates of the fit with the smallest loss.
    """

    loss: float
    starts: tuple[int, ...]
    status: FitStatus
    parameters: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class MultiStart(Brief):
    """Results of fits from several starts.

    Attributes
    ----------
    best : FitResult
        Fit with the smallest loss, whatever its status. Its `multi_start` counts the others, and a note tells when it
        did not converge.
    losses : (n_starts,) array
        Losses in the order of the starts: the structure's own, the one from the data unless the structure's own was
        found there, random ones. It is nan for a start that overflowed or failed, as where the equations have no finite
        value.
    converged : (n_starts,) boolean array
        Whether each fit converged.
    same_optimum : int
        Number of fits that ended at the best loss, within a relative 1e-6.
    spread : float
        Largest over smallest converged loss; 1 when all are equal, inf when none converged.
    minima : tuple of Minimum
        Distinct points at which converged fits ended, by rising loss, and the end of the best fit in any case. Points
        are distinct when their losses or their determined parameters differ.
    """

    best: FitResult
    losses: FloatArray
    converged: BoolArray
    same_optimum: int
    spread: float
    minima: tuple[Minimum, ...]

    @property
    def status(self) -> FitStatus:
        """Status of the best fit."""
        return self.best.status

    @property
    def success(self) -> bool:
        """Whether the best fit is a success; see `FitResult.success`."""
        return self.best.success

    def _repr_html_(self) -> str:
        """Return the HTML description, including the best fit's, for a notebook."""
        return self._brief().html() + self.best._repr_html_()

    def _brief(self) -> Description:
        about = (
            f"{len(self.losses)} starts, {int(self.converged.sum())} converged, {self.same_optimum} ended at the best "
            f"of {len(self.minima)} minima"
        )
        minima = [f"{m.loss:.6g} from {len(m.starts)}" for m in self.minima]
        return brief(self, about, losses=self.losses, minima=minima, best=f"{self.best.structure}, {self.best.status}")


def fit_multistart(
    structure: AnyStructure,
    recordings: Measured,
    *,
    starts: Count = 10,
    seed: CountOrZero = 0,
    reach: Positive = 0.5,
    **options: Any,
) -> MultiStart:
    """Return fits from the structure's start values, from start values found in the data, and from random ones.

    Parameters
    ----------
    structure : Structure or NonlinearStructure
        Structure to fit.
    recordings : Recording or sequence of Recording
        Recordings, or frequency responses, to fit.
    starts : int
        Number of starts, with the structure's own and the one from the data.
    seed : int
        Seed of the random starts.
    reach : float
        Range of the random starts. A parameter with two finite bounds is drawn between them. Others are drawn within
        ``start (1 +- reach)``, or within ``+- reach`` when their start is zero.
    **options
        Arguments of `fit`.

    Returns
    -------
    MultiStart
        Results of all starts.

    Raises
    ------
    UsageError
        When `starts` is no whole number of at least 1, `reach` is not finite and positive, or a parameter has no start
        value, and for the errors of `fit`.
    """
    given = options_of_call(FitArguments, "fit_multistart", options)
    arguments = replace(given, profile=())  # of the best only
    first = fitted(structure, recordings, arguments)
    results = {0: first}
    searched = not kind_of(structure).nonlinear  # start values are found in the data for linear ones only
    by_observer = any(FitNote.BEGUN_ELSEWHERE.value in note for note in first.notes)  # not by the match to a black box
    if starts > 1 and searched and (by_observer or "data" not in first.start_origin.values()):
        with suppress(DataError):  # the recordings may not suffice for that
            results[1] = fitted(structure, recordings, replace(arguments, start="data"))
    rng = np.random.default_rng(seed)
    start = {} if isinstance(arguments.start, str) else arguments.start or {}
    fixed, bounds = arguments.fixed or {}, arguments.bounds or {}
    short = first.own_names
    centres = {short.get(name, name): first.start[name] for name in first.free}  # one draw for all of a local one
    for number in range(len(results), starts):
        drawn = dict(start)
        for q in structure.parameters:
            if q.name in fixed or q.fixed or q.name not in centres:
                continue
            lower, upper = bounds.get(q.name, (q.lower, q.upper))
            centre = centres[q.name]
            half = reach * (abs(centre) if centre else 1.0)
            low, high = (lower, upper) if np.isfinite([lower, upper]).all() else (centre - half, centre + half)
            drawn[q.name] = float(np.clip(rng.uniform(low, high), lower, upper))
        with suppress(GbidError):  # of this start alone: the first fit took the same options and recordings
            results[number] = fitted(structure, recordings, replace(arguments, start=drawn))
    summary = _summary(results, starts, seed)
    return replace(summary, best=with_profiles(summary.best, given.profile))


def _summary(results: Mapping[int, FitResult], starts: int, seed: int) -> MultiStart:
    """Return the results of numbered starts; starts without a result failed."""
    losses = np.array([results[i].loss if i in results else np.nan for i in range(starts)])
    converged = np.array([i in results and results[i].success for i in range(starts)])
    finite = np.isfinite(losses)
    best = results[int(np.argmin(np.where(finite, losses, np.inf)))]
    good = losses[converged & finite]
    same = int((np.abs(losses[finite] - best.loss) <= _SAME_LOSS * abs(best.loss)).sum())
    spread = float(good.max() / good.min()) if len(good) else np.inf
    minima = distinct_minima(results)
    counts = tuple(m.loss for m in minima), tuple(len(m.starts) for m in minima)
    tried = StartsTried(starts, seed, int(converged.sum()), same, spread, *counts)
    if not best.success and starts > 1:
        others = f"the smallest loss of a converged one is {good.min():.6g}" if len(good) else "none converged"
        note = f"this fit has the smallest loss of {starts} starts, but did not converge; {others}"
        best = best.noted(FitNote.BEST_DID_NOT_CONVERGE(note))
    return MultiStart(best.changed(multi_start=tried), losses, converged, same, spread, minima)


def distinct_minima(results: Mapping[int, FitResult]) -> tuple[Minimum, ...]:
    """Return the distinct minima of fits of one structure to the same data, by ascending loss.

    Parameters
    ----------
    results : dict of int to FitResult
        Fits by the number of their start.

    Returns
    -------
    tuple of Minimum
        Ends of the fits that converged, and the end of the fit with the smallest loss. Fits that ended close to one of
        these are counted with it, whatever their status.
    """
    groups: list[list[int]] = []
    for i in sorted((i for i, r in results.items() if np.isfinite(r.loss)), key=lambda i: results[i].loss):
        near = next((group for group in groups if _same_point(results[group[0]], results[i])), None)
        if near is None:
            groups.append([i])
        else:
            near.append(i)
    return tuple(
        Minimum(first.loss, tuple(sorted(group)), first.status, dict(first.parameters))
        for k, group in enumerate(groups)
        for first in [next((results[i] for i in group if results[i].success), results[group[0]])]
        if k == 0 or first.success
    )


def _same_point(one: FitResult, other: FitResult) -> bool:
    """Return whether two fits have equal loss and equal values of the determined parameters."""
    if abs(one.loss - other.loss) > _SAME_LOSS * abs(one.loss):
        return False
    for name in one.free:
        a, b, std = one.parameters[name], other.parameters[name], one.std[name]
        if np.isfinite(std) and abs(a - b) > max(_SAME_IN_STD * std, _SAME_RELATIVE * abs(a)):
            return False
    return True
