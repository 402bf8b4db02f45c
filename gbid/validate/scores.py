"""Scores of many models on many recordings, and what they say together: paper, Sec. 3.8, Figs. 9 and 10."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gbid.arrays import FloatArray, IntArray
from gbid.brief import brief
from gbid.errors import DataError, UsageError


@dataclass(frozen=True, eq=False)
class ValidationScores:
    """How well models explain recordings; n pairs of model and recording, q outputs.

    Attributes
    ----------
    models : tuple of str, n
        Recordings that each model was fitted to, or its name.
    recordings : tuple of str, n
        Recordings that they were put to.
    pressure_bar, speed_rpm : (n,) array
        Operating points of the recordings; nan where they do not tell.
    output_names, output_units : tuple of str, q
    fit_percent : (n, q) array
    infinity_norm : (n, q) array
        Largest deviation of the simulation, in the outputs' units.
    """

    models: tuple[str, ...]
    recordings: tuple[str, ...]
    pressure_bar: FloatArray
    speed_rpm: FloatArray
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    fit_percent: FloatArray
    infinity_norm: FloatArray

    def __repr__(self) -> str:
        return brief(
            self,
            f"{len(self.models)} pairs of model and recording",
            models=self.models,
            output_names=self.output_names,
            fit_percent=self.fit_percent,
            infinity_norm=self.infinity_norm,
        )

    def __len__(self) -> int:
        return len(self.models)


@dataclass(frozen=True)
class WorstPair:
    """A pair with a poor fit of one output.

    Attributes
    ----------
    model, recording, output : str
    fit_percent : float
    infinity_norm : float
        In the output's unit.
    """

    model: str
    recording: str
    output: str
    fit_percent: float
    infinity_norm: float


@dataclass(frozen=True, eq=False)
class PointSummary:
    """The pairs of one operating point.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        nan where the recordings do not tell.
    n_pairs : int
    mean, std : (n_outputs,) array
        Of the fit percent; std is nan for a single pair.
    infinity_norm : (n_outputs,) array
        The largest, in the outputs' units.
    """

    pressure_bar: float
    speed_rpm: float
    n_pairs: int
    mean: FloatArray
    std: FloatArray
    infinity_norm: FloatArray


@dataclass(frozen=True, eq=False)
class ValidationSummary:
    """What the cross-validation of a fit says as a whole; q outputs, b bins.

    Attributes
    ----------
    n_pairs, n_models, n_recordings : int
    output_names, output_units : tuple of str, q
    mean, std : (q,) array
        Of the fit percent over the pairs; std with n - 1, nan for a single pair.
    median, least, greatest : (q,) array
        Of the fit percent.
    edges : (q, b + 1) array
        Bins of the histograms [%].
    counts : (q, b) integer array
        Pairs in each bin; those below the first edge are in `below`.
    below : (q,) integer array
        Pairs that fit worse than the histogram reaches.
    infinity_norm_mean, infinity_norm_max : (q,) array
        Largest deviation of each pair: mean and largest over the pairs, in the outputs' units.
    worst : tuple of WorstPair
        For each output the pairs that fit worst, the worst first.
    points : tuple of PointSummary
        By operating point of the recordings, by rising pressure, then speed.
    failed : tuple of str
        Pairs that could not be validated, and why.
    """

    n_pairs: int
    n_models: int
    n_recordings: int
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    mean: FloatArray
    std: FloatArray
    median: FloatArray
    least: FloatArray
    greatest: FloatArray
    edges: FloatArray
    counts: IntArray
    below: IntArray
    infinity_norm_mean: FloatArray
    infinity_norm_max: FloatArray
    worst: tuple[WorstPair, ...]
    points: tuple[PointSummary, ...]
    failed: tuple[str, ...] = ()

    def __repr__(self) -> str:
        outputs = {
            name: f"{self.mean[j]:.2f} +- {self.std[j]:.2f} %, {self.least[j]:.2f} to {self.greatest[j]:.2f} %"
            for j, name in enumerate(self.output_names)
        }
        about = f"{self.n_pairs} pairs, {self.n_models} models on {self.n_recordings} recordings"
        return brief(self, about, **outputs, failed=self.failed)


class _Validated(Protocol):
    """What a score belongs to; read-only."""

    @property
    def name(self) -> str: ...
    @property
    def conditions(self) -> Mapping[str, float]: ...
    @property
    def output_names(self) -> tuple[str, ...]: ...
    @property
    def output_units(self) -> tuple[str, ...]: ...


def join_scores(found: Sequence[tuple[str, _Validated, FloatArray, FloatArray]]) -> ValidationScores:
    """Put the scores of single pairs side by side.

    Parameters
    ----------
    found : sequence of (model, data, fit_percent, infinity_norm)
        At least one.
    """
    first = found[0][1]
    return ValidationScores(
        tuple(model for model, *_ in found),
        tuple(data.name for _, data, *_ in found),
        np.array([data.conditions.get("pressure_bar", np.nan) for _, data, *_ in found]),
        np.array([data.conditions.get("speed_rpm", np.nan) for _, data, *_ in found]),
        first.output_names,
        first.output_units,
        np.array([fit for _, _, fit, _ in found]).reshape(len(found), -1),
        np.array([norm for *_, norm in found]).reshape(len(found), -1),
    )


def summarise(
    scores: ValidationScores, *, bins: int = 20, worst: int = 3, failed: Iterable[str] = ()
) -> ValidationSummary:
    """Summarise a cross-validation: mean, standard deviation and histogram of each output, and the worst pairs.

    The histogram of an output spans its fits, but reaches no further below its median than six robust standard
    deviations: one model that fails altogether would leave all others in one bin. What lies below is counted.

    Parameters
    ----------
    scores : ValidationScores
    bins : int
        Of each histogram.
    worst : int
        How many pairs of each output are named.
    failed : iterable of str
        Pairs that could not be validated, in words.

    Returns
    -------
    ValidationSummary

    Raises
    ------
    DataError
        When there is no pair.
    UsageError
        For fewer than one bin.
    """
    if not len(scores):
        raise DataError("no pair of model and recording was validated, so there is nothing to summarise")
    if bins < 1 or worst < 0:
        raise UsageError(f"bins = {bins}, worst = {worst}: give at least one bin and no negative number of pairs")
    fit, norm = scores.fit_percent, scores.infinity_norm
    edges = np.array([_edges(column, bins) for column in fit.T])
    counts = np.array([np.histogram(column, edge)[0] for column, edge in zip(fit.T, edges, strict=True)])
    below = (fit < edges[:, 0]).sum(axis=0)
    named = [
        WorstPair(scores.models[i], scores.recordings[i], output, float(fit[i, j]), float(norm[i, j]))
        for j, output in enumerate(scores.output_names)
        for i in np.argsort(fit[:, j], kind="stable")[:worst]
    ]
    return ValidationSummary(
        n_pairs=len(scores),
        n_models=len(set(scores.models)),
        n_recordings=len(set(scores.recordings)),
        output_names=scores.output_names,
        output_units=scores.output_units,
        mean=fit.mean(axis=0),
        std=_std(fit),
        median=np.median(fit, axis=0),
        least=fit.min(axis=0),
        greatest=fit.max(axis=0),
        edges=edges,
        counts=counts.astype(np.int64),
        below=below.astype(np.int64),
        infinity_norm_mean=norm.mean(axis=0),
        infinity_norm_max=norm.max(axis=0),
        worst=tuple(named),
        points=tuple(_points(scores)),
        failed=tuple(failed),
    )


def _edges(fit: FloatArray, bins: int) -> FloatArray:
    low, high, median = float(fit.min()), float(fit.max()), float(np.median(fit))
    reach = 6 * 1.4826 * float(np.median(np.abs(fit - median)))
    low = max(low, median - reach) if reach > 0 else low
    if not high - low > 1e-9 * max(1.0, abs(high)):
        low, high = high - 0.5, high + 0.5
    return np.linspace(low, high, bins + 1)


def _std(fit: FloatArray) -> FloatArray:
    return np.asarray(fit.std(axis=0, ddof=1)) if len(fit) > 1 else np.full(fit.shape[1], np.nan)


def _points(scores: ValidationScores) -> Iterable[PointSummary]:
    groups: dict[tuple[float, float], list[int]] = {}
    for i, where in enumerate(zip(scores.pressure_bar, scores.speed_rpm, strict=True)):
        known = [np.inf if np.isnan(v) else float(v) for v in where]  # nan is not equal to itself
        groups.setdefault((known[0], known[1]), []).append(i)
    for _, rows in sorted(groups.items()):
        fit = scores.fit_percent[rows]
        yield PointSummary(
            float(scores.pressure_bar[rows[0]]),
            float(scores.speed_rpm[rows[0]]),
            len(rows),
            fit.mean(axis=0),
            _std(fit),
            scores.infinity_norm[rows].max(axis=0),
        )
