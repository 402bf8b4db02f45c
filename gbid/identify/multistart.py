"""A fit from several starts: for structures of one's own, whose good starts nobody knows."""

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
    """Fits from several starts.

    Attributes
    ----------
    best : FitResult
        The converged one of smallest loss; of all, when none converged. Its `multi_start` counts the others.
    losses : (n_starts,) array
        In the order of the starts, the first being the structure's own; nan where a start overflowed.
    converged : (n_starts,) boolean array
    same_optimum : int
        How many converged to the best loss, within a relative 1e-6.
    spread : float
        Largest over smallest converged loss; 1 when all agree.
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
    """Fit from the structure's own start and from random ones.

    Parameters
    ----------
    structure : Structure
    recordings : Recording or sequence of Recording
    starts : int
        Number of starts, the structure's own included.
    seed : int
        Of the random starts.
    reach : float
        A parameter without two finite bounds is drawn within ``start (1 +- reach)``, one that starts at zero
        within ``+- reach``; one with two bounds anywhere between them.
    **options
        As for `fit`.

    Returns
    -------
    MultiStart

    Raises
    ------
    UsageError
        For fewer than one start, a parameter without a start value, and whatever `fit` raises.
    """
    if starts < 1 or reach <= 0:
        raise UsageError(f"starts = {starts} must be at least 1 and reach = {reach} positive")
    first = fit(structure, recordings, **options)
    rng = np.random.default_rng(seed)
    asked = dict(options.pop("start", None) or {})
    fixed = set(options.get("fixed") or {})
    bounds = options.get("bounds") or {}
    own = first.own_names
    centres = {own.get(name, name): first.start[name] for name in first.free}  # local ones draw one for all groups
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
