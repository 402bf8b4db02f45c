"""Start values of any linear structure from its data: a subspace estimate, matched to the structure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from gbid.arrays import ComplexArray, FloatArray
from gbid.discretise import Hold, check_holds, hold_response
from gbid.identify.data import FitData, Record, moves
from gbid.identify.predictor import build_predictor
from gbid.identify.start.black_box import BlackBox, black_box
from gbid.identify.start.match import Target, match
from gbid.structure import Parameter, Structure, symbolic_matrices

_FREQUENCIES = 80
_HIGHEST = 0.4  # highest frequency, as a part of the sampling frequency
_STARTS = 30  # largest number of starts of the match
_DECADES = 3.0  # range of the random starts of a parameter without bounds, to both sides of its scale
_LONGEST_DELAY = 30  # range of the random starts of a delay without a bound, in samples
_ACCURACY = 1e-3  # smallest relative standard deviation that is believed


@dataclass(frozen=True, eq=False)
class SubspaceStart:
    """Start values that were found by a subspace estimate.

    Attributes
    ----------
    values : dict of str to float
        Start values of the parameters that were not fixed.
    order, lags : int
        Order of the black-box model, and number of past samples of its regression.
    misfit : float
        Part of the response of the black-box model that the structure does not explain, from 0 to 1.
    """

    values: dict[str, float]
    order: int
    lags: int
    misfit: float


def subspace_start(
    structure: Structure,
    data: FitData,
    parameters: Sequence[Parameter],
    intersample: Hold | Sequence[Hold],
    seed: int = 0,
) -> SubspaceStart:
    """Return start values of a linear structure from the data alone.

    Parameters
    ----------
    structure : Structure
        The structure.
    data : FitData
        Data of the fit: recordings with inputs that move, in open or closed loop, or free decays.
    parameters : sequence of Parameter
        Parameters of the structure, with fixed values and bounds. A stated start is one of many starts of the match.
    intersample : {"zoh", "foh"} or sequence of these
        Hold of the inputs.
    seed : int
        Seed of the random starts of the match.

    Returns
    -------
    SubspaceStart
        Start values. Parameters of the disturbance gain alone start at zero, or at the bound next to it.

    Raises
    ------
    DataError
        When the recordings are too short.

    Notes
    -----
    A black-box model takes no start values. The structure is matched to its response, which has no noise and costs no
    pass over the samples, so that many starts are cheap.
    """
    fixed = {q.name: float(q.start) for q in parameters if q.fixed and q.start is not None}
    predictor = build_predictor(structure, fixed, data.sample_time, intersample, "simulation")
    known = {q.name: q for q in parameters}
    free = [known[q.name] for q in predictor.free]
    holds = check_holds(intersample, predictor.n_inputs)
    decays = not any(moves(r.inputs).any() for r in data.records)
    records = [Record(r.name, r.inputs[:, :0], r.outputs) for r in data.records] if decays else data.records
    found = black_box(records, predictor.n_states, feedthrough=not decays and _acts_at_once(structure, holds))
    target = _target(found, data, holds, decays)
    bounds = np.array([(q.lower, q.upper) for q in free], float).reshape(-1, 2)
    starts = _draw(free, bounds, _delay_names(structure), target, data.sample_time, seed)
    best = match(predictor, target, starts, bounds[:, 0], bounds[:, 1])
    values = {q.name: float(v) for q, v in zip(free, best.theta, strict=True)}
    unused = {name: float(np.clip(0.0, known[name].lower, known[name].upper)) for name in predictor.unused}
    return SubspaceStart({**unused, **values}, len(found.A), found.lags, min(best.misfit, 1.0))


def _acts_at_once(structure: Structure, holds: Sequence[Hold]) -> bool:
    """Return whether inputs act on the outputs of the same sample: by a feedthrough, or by a straight line to it."""
    return "foh" in holds or symbolic_matrices(structure)[1].D.nnz() > 0


def _delay_names(structure: Structure) -> set[str]:
    return {symbol.name() for symbol in ca.symvar(symbolic_matrices(structure)[1].delay)}


def _target(found: BlackBox, data: FitData, holds: Sequence[Hold], decays: bool) -> Target:
    h = data.sample_time
    values, vectors = np.linalg.eig(found.A.astype(complex))
    with np.errstate(divide="ignore"):
        poles = np.log(values) / h
    poles = np.where(np.isfinite(poles), poles, -np.pi / h)  # a pole at zero: faster than the samples
    f = _frequencies(poles, data)
    s = 2j * np.pi * f
    if decays:
        amplitudes = np.linalg.solve(vectors, found.first_states.T)
        response = np.einsum("yn,fn,nr->fyr", found.C @ vectors, 1 / (s[:, None] - poles), amplitudes)
        std = np.zeros(response.shape)
    else:
        response, std = found.response(np.exp(s * h))
        held = hold_response(f * h, holds)[:, None, :]
        response, std = response / held, std / np.abs(held)
    size = np.sqrt((np.abs(response) ** 2).mean(0, keepdims=True))
    # An accuracy that is not believed: else the most accurate frequencies would be all that is matched.
    weight = 1 / np.sqrt(std**2 + (_ACCURACY * np.abs(response)) ** 2 + (_ACCURACY**2 * size) ** 2)
    return Target(np.asarray(s, complex), np.asarray(response, complex), weight, poles, decays)


def _frequencies(poles: ComplexArray, data: FitData) -> FloatArray:
    """Return frequencies [Hz] with logarithmic spacing, and more around the poles of the black-box model."""
    high = _HIGHEST / data.sample_time
    longest = max(r.n_samples for r in data.records) * data.sample_time
    low = min(max(1 / longest, 0.05 * float(np.abs(poles).min()) / (2 * np.pi)), 0.1 * high)
    pairs = poles[poles.imag > 0]
    spread = np.array([-3.0, -1.5, -0.7, -0.3, 0.0, 0.3, 0.7, 1.5, 3.0])
    around = (pairs.imag[:, None] + np.abs(pairs.real)[:, None] * spread).ravel() / (2 * np.pi)
    inside = around[(around > low) & (around < high)]
    return np.unique(np.concatenate([np.geomspace(low, high, _FREQUENCIES), inside]))


def _draw(
    free: Sequence[Parameter], bounds: FloatArray, delays: set[str], target: Target, sample_time: float, seed: int
) -> Iterator[FloatArray]:
    """Yield starts of the match: the stated one, then random ones between the bounds or over many decades."""
    random = np.random.default_rng(seed)
    lower, upper = bounds.T
    stated = np.array([np.nan if q.start is None else q.start for q in free], float)
    late = np.array([q.name in delays for q in free], bool)
    low = np.where(late, np.maximum(lower, 0.0), lower)
    high = np.where(late, np.minimum(upper, _LONGEST_DELAY * sample_time), upper)
    between = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(between, low, 0.0), np.where(between, high, 1.0)
    scale = np.where(np.isfinite(stated) & (stated != 0), np.abs(stated), 1.0)
    rate = float(np.exp(np.log(np.maximum(np.abs(target.poles), 1e-12)).mean()))
    first = np.where(between, 0.5 * (low + high), np.where(upper <= 0, -1.0, 1.0))
    yield np.clip(np.where(np.isfinite(stated), stated, first), lower, upper)
    for _ in range(_STARTS - 1):
        powers = rate ** random.choice(
            [0, 1, 2], len(scale)
        )  # a damping has the size of the rate, a stiffness its square
        size = np.where(random.random(len(scale)) < 0.5, scale, powers)
        size = size * 10.0 ** random.uniform(-_DECADES, _DECADES, len(scale))
        sign = np.where(lower >= 0, 1.0, np.where(upper <= 0, -1.0, random.choice([-1.0, 1.0], len(scale))))
        yield np.clip(np.where(between, random.uniform(low, high), sign * size), lower, upper)
