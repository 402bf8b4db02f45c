"""Fits from several starts, for user structures without good start values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbid.arrays import BoolArray, FloatArray
from gbid.brief import brief
from gbid.errors import UsageError
from gbid.identify.fit import fit
from gbid.identify.result import FitResult, StartsTried
from gbid.recording import Recording
from gbid.structure import Structure


@dataclass(frozen=True, eq=False)
class MultiStart:
    """Results of fits from several starts.

    Attributes
    ----------
    best : FitResult
        Converged fit with the smallest loss; of all fits when none converged. Its `multi_start` counts the others.
    losses : (n_starts,) array
        Losses in the order of the starts, the first from the structure's own start; nan for a start that overflowed.
    converged : (n_starts,) boolean array
        Whether each fit converged.
    same_optimum : int
        Number of fits that converged to the best loss, within a relative 1e-6.
    spread : float
        Largest over smallest converged loss; 1 when all are equal.
    """

    best: FitResult
    losses: FloatArray
    converged: BoolArray
    same_optimum: int
    spread: float

    def __repr__(self) -> str:
        about = (
            f"{len(self.losses)} starts, {int(self.converged.sum())} converged, {self.same_optimum} to the same optimum"
        )
        return brief(self, about, losses=self.losses, best=f"{self.best.structure}, {self.best.status}")


def fit_multistart(
    structure: Structure,
    recordings: Recording | Sequence[Recording],
    *,
    starts: int = 10,
    seed: int = 0,
    reach: float = 0.5,
    **options: Any,
) -> MultiStart:
    """Return fits from the start of the structure and from random starts.

    Parameters
    ----------
    structure : Structure
        Structure to fit.
    recordings : Recording or sequence of Recording
        Recordings to fit.
    starts : int
        Number of starts, with the structure's own.
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
        When there is less than one start or a parameter has no start value, and for the errors of `fit`.
    """
    if starts < 1 or reach <= 0:
        raise UsageError(f"starts = {starts} must be at least 1 and reach = {reach} positive")
    first = fit(structure, recordings, **options)
    rng = np.random.default_rng(seed)
    asked = dict(options.pop("start", None) or {})
    fixed = set(options.get("fixed") or {})
    bounds = options.get("bounds") or {}
    own = first.own_names
    centres = {own.get(name, name): first.start[name] for name in first.free}  # one draw for all values of a local one
    results = [first]
    for _ in range(starts - 1):
        drawn = dict(asked)
        for q in structure.parameters:
            if q.name in fixed or q.fixed or q.name not in centres:
                continue
            lower, upper = bounds.get(q.name, (q.lower, q.upper))
            centre = centres[q.name]
            half = reach * (abs(centre) if centre else 1.0)
            low, high = (lower, upper) if np.isfinite([lower, upper]).all() else (centre - half, centre + half)
            drawn[q.name] = float(np.clip(rng.uniform(low, high), lower, upper))
        results.append(fit(structure, recordings, start=drawn, **options))
    losses = np.array([r.loss for r in results])
    converged = np.array([r.success for r in results])
    eligible = converged & np.isfinite(losses) if converged.any() else np.isfinite(losses)
    best = results[int(np.argmin(np.where(eligible, losses, np.inf)))]
    good = losses[converged & np.isfinite(losses)]
    same = int((np.abs(good - best.loss) <= 1e-6 * abs(best.loss)).sum())
    spread = float(good.max() / good.min()) if len(good) else np.inf
    tried = StartsTried(starts, seed, int(converged.sum()), same, spread)
    return MultiStart(replace(best, multi_start=tried), losses, converged, same, spread)
