"""Check for contact of rotor and bearing: sudden changes of velocity far from the centre."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from gbid.arrays import BoolArray, FloatArray
from gbid.recording.quality_problem import SignalProblem
from gbid.recording.recording import Recording

OUTSIDE = 0.7
"""Impacts are searched beyond this share of the largest radius."""
SIGMAS = 6.0
"""Smallest inward change of velocity by an impact, in robust standard deviations."""
LEAST = 0.25
"""Smallest inward change of velocity by an impact, over the rms of the velocity."""
MIN_IMPACTS = 2
"""Smallest number of impacts. A rotor that rubs bounces; a single jump may be a disturbed sample."""
OVER_OUTWARD = 1.5
"""An impact is larger than any outward change by this factor, because a wall cannot push outwards."""
HALF_WINDOW_S = 2e-3
"""Half the length of the window when u or r is recorded [s]: a quarter of a period of the modes of the rotor."""
SHORT_S = 0.6e-3
"""Half the length of the window without u and r [s]. The effect of the piezos grows with it, that of an impact does
not."""
_HARMONICS = 6  # of the shaft angle, for run-out and unbalance
_LAGS = (-2, 0, 2, 4, 6, 8)  # delays of the piezos in samples
_EVERY = 3  # every third sample in motion is used for the regression
_MIN_SAMPLES = 500
_CHANGE = 0.02  # of speed or pressure, over its largest value
_PART_S = 0.25  # of a recording in which they change [s]
_ROUNDS, _TRIM = 3, 4.0  # of the regression; larger residuals (in standard deviations) are left out of the next round


def find_rub(rec: Recording) -> Iterator[SignalProblem]:
    r"""Return impacts of the rotor on the bearing, found in the disc position p.

    On its gas film the disc follows an equation of motion. A wall changes its velocity at once, always inwards and
    always far from the centre. Differentiation would amplify the noise. Therefore the equation is multiplied by a
    smooth window :math:`\psi` of 4 ms and integrated (weak form). Integration by parts gives, around each sample,

    .. math:: \int \ddot\psi p = K \int \psi p - D \int \dot\psi p + B \int \psi u_\tau
              + \int \psi f + \psi(0) \Delta v,

    so noise enters with :math:`\ddot\psi`, 13 times less than with second differences over 1 ms. The left side is
    regressed on the integrals of p, of u (or r) at several delays, of a cubic film, and on the harmonics of the shaft
    angle. The residual is projected inwards and evaluated beyond 0.7 of the largest radius. Residuals above six robust
    standard deviations are impacts, when there are at least two and when no outward residual nearby is almost as large.
    Single wrong samples are removed before by a median of three. Times with a measured impact force are left out.
    Where speed or pressure are recorded and change, the equation is another one on the way: each 0.25 s have their own.
    """
    known = "u" in rec.signals or "r" in rec.signals
    half = max(3, round((HALF_WINDOW_S if known else SHORT_S) / rec.sample_time))
    if "p" not in rec.signals or rec.channels["p"] != ("x", "y") or rec.n_samples < _MIN_SAMPLES + 2 * half:
        return
    p = _median_of_three(rec.signal("p"))
    p = p - p.mean(axis=0)
    k = np.arange(half - 1, rec.n_samples - half + 1)
    weighted, basis = _weak_form(rec, p, half)
    sound = (k >= max(_LAGS) + half) & (k < rec.n_samples - half + min(_LAGS)) & ~_struck(rec, half)[k]
    k, weighted, basis = k[sound], weighted[sound], basis[sound]
    if len(k) < _MIN_SAMPLES // 2:
        return
    residual, sigma = np.empty_like(weighted), np.empty(len(k))
    for part in _parts(rec, k):
        some = _in_motion(weighted[part])[::_EVERY]
        residual[part], sigma[part] = _robust_residual(weighted[part], basis[part], some)
    speed = float(np.sqrt(np.mean(np.sum(np.diff(p, axis=0) ** 2, axis=1))))
    limit = np.maximum(SIGMAS * sigma, LEAST * speed)
    radius = np.hypot(*p[k].T)
    far = radius > OUTSIDE * radius.max()
    inward = -np.sum(p[k[far]] * residual[far], axis=1) / radius[far]
    at, limit, sigma = k[far], limit[far], sigma[far]
    outward = inward[_apart(at, at[inward > limit], 2 * half)].min(initial=0.0)
    hit = at[inward > np.maximum(limit, -OVER_OUTWARD * outward)]
    impacts = np.split(hit, np.flatnonzero(np.diff(hit) > 2 * half) + 1) if hit.size else []
    if len(impacts) < MIN_IMPACTS:
        return
    reached = np.hypot(*p[hit].T)
    size = float((inward / np.maximum(sigma, 1e-300)).max())
    text = (
        f"recording {rec.name!r}: signal 'p' shows a rub: {len(impacts)} impacts at {reached.min() * 1e6:.1f} to "
        f"{reached.max() * 1e6:.1f} um from the mean position, the first at {hit[0] * rec.sample_time:.4f} s, push "
        f"the disc back by up to {size:.0f} standard deviations more than a film does; "
        "lower the excitation and record again, or cut that part away."
    )
    yield SignalProblem("p", "", "rub", text)


def _parts(rec: Recording, k: npt.NDArray[np.int_]) -> list[slice]:
    """Return the parts of the samples that have one equation of motion each."""
    ways = [rec.signal(name) for name in ("pressure_bar", "speed_rpm") if name in rec.signals]
    if not any(np.ptp(way) > _CHANGE * np.abs(way).max() for way in ways):
        return [slice(None)]
    count = max(1, len(k) // max(_MIN_SAMPLES, round(_PART_S / rec.sample_time)))
    edges = np.linspace(0, len(k), count + 1).astype(int)
    return [slice(a, b) for a, b in itertools.pairwise(edges.tolist())]


def _weak_form(rec: Recording, p: FloatArray, half: int) -> tuple[FloatArray, FloatArray]:
    """Return both sides of the weak form around each sample: the second-derivative side and the regressors."""
    t = np.arange(1 - half, half) / half
    window = (1 + np.cos(np.pi * t)) / 2
    slope, bend = -np.pi / 2 * np.sin(np.pi * t) / half, -(np.pi**2) / 2 * np.cos(np.pi * t) / half**2
    n = len(p) - 2 * half + 2
    columns = [np.ones((n, 1)), _correlate(p, window), _correlate(p, slope)]
    columns.append(_correlate(_film(p), window))
    source = next((name for name in ("u", "r") if name in rec.signals), None)
    if source:
        moved = rec.signal(source)
        weighted = _correlate(moved - moved.mean(axis=0), window)
        columns += [np.roll(weighted, lag, axis=0) for lag in _LAGS]  # np.roll wraps at the ends, which are left out
    if "phi" in rec.signals and np.ptp(rec.signal("phi")) > 0:
        turned = np.exp(1j * rec.signal("phi")[half - 1 : half - 1 + n, :1])
        for order in range(1, _HARMONICS + 1):
            wave = turned**order
            columns += [wave.real, wave.imag]
    return _correlate(p, bend), np.hstack(columns)


def _robust_residual(weighted: FloatArray, basis: FloatArray, some: npt.NDArray[np.int_]) -> tuple[FloatArray, float]:
    """Return the residual of a robust regression on some samples, at all samples, and its standard deviation."""
    for _ in range(_ROUNDS):
        own, wanted = basis[some], weighted[some]
        found = _least_squares(own, wanted)
        left = wanted - own @ found
        size = np.abs(left - np.median(left, axis=0))
        sigma = 1.4826 * float(np.median(size, axis=0).max())
        some = some[(size < _TRIM * sigma).all(axis=1)] if sigma else some
    return weighted - basis @ found, sigma


def _film(p: FloatArray) -> FloatArray:
    """Return the regressors of a film that stiffens about an unknown centre."""
    x, y = np.ascontiguousarray(p.T)
    xx, yy = x * x, y * y  # products: powers of numpy call a function for each sample
    return np.stack([xx, x * y, yy, x * xx, xx * y, x * yy, y * yy]).T


def _apart(at: npt.NDArray[np.int_], hit: npt.NDArray[np.int_], gap: int) -> BoolArray:
    """Mark the samples with no impact nearby, because an impact changes the motion on both sides of it."""
    if not hit.size:
        return np.ones(len(at), dtype=bool)
    after = np.searchsorted(hit, at)
    before, behind = hit[np.maximum(after - 1, 0)], hit[np.minimum(after, hit.size - 1)]
    return np.asarray(np.minimum(np.abs(at - before), np.abs(behind - at)) > gap, dtype=bool)


def _correlate(values: FloatArray, window: FloatArray) -> FloatArray:
    return np.stack([np.correlate(column, window, mode="valid") for column in values.T]).T


def _in_motion(weighted: FloatArray) -> npt.NDArray[np.int_]:
    """Return the samples at which the disc moves; samples at rest would let noise decide the regression."""
    energy = np.sum(weighted**2, axis=1)
    return np.flatnonzero(energy > 0.1 * energy.mean())


def _least_squares(basis: FloatArray, change: FloatArray) -> FloatArray:
    """Return the coefficients by normal equations with a small ridge, because columns may be equal or zero."""
    size = np.sqrt(np.mean(basis**2, axis=0))
    size[size == 0] = 1.0
    scaled = basis / size
    gram = scaled.T @ scaled + 1e-9 * len(basis) * np.eye(basis.shape[1])
    return np.asarray(np.linalg.solve(gram, scaled.T @ change) / size[:, None])


def _struck(rec: Recording, half: int) -> BoolArray:
    """Mark the samples whose window contains a measured force."""
    struck = np.zeros(rec.n_samples, dtype=bool)
    for name in ("f", "force"):
        if name in rec.signals:
            size = np.abs(rec.signal(name)).max(axis=1)
            struck |= size > 0.05 * size.max()
    return np.asarray(np.convolve(struck, np.ones(2 * half + 5), mode="same") > 0, dtype=bool)


def _median_of_three(values: FloatArray) -> FloatArray:
    a, b, c = values[:-2], values[1:-1], values[2:]
    middle = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return np.concatenate([values[:1], middle, values[-1:]])
