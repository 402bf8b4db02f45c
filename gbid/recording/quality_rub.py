"""Whether the rotor touched the bearing: sudden turns of its motion at the outside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from gbid.recording.quality_problem import SignalProblem
from gbid.recording.recording import FloatArray, Recording

OUTSIDE = 0.7
"""Impacts are looked for beyond this share of the largest radius."""
SIGMAS = 6.0
"""Robust standard deviations by which an impact changes the velocity inwards ..."""
LEAST = 0.1
"""... and share of the usual change of velocity (rms) that it is at least."""
MIN_IMPACTS = 2
"""A rotor that rubs bounces; a single kink may be a disturbed sample."""
CONTACT_S = 1e-3
"""Time over which the change of velocity is taken [s]; a contact is about as long."""
_HARMONICS = 6  # of the shaft angle, which run-out and unbalance make
_LAGS = (-2, 0, 2, 4, 6, 8)  # samples by which the piezos act earlier
_EVERY = 3  # sample of those in motion serves for the regression
_APART = 10  # samples that belong to one impact
_MIN_SAMPLES = 500


def find_rub(rec: Recording) -> Iterator[SignalProblem]:
    r"""Find impacts of the rotor on the bearing in the disc position p.

    On its gas film the disc changes its velocity smoothly: over one millisecond by what position, velocity, piezos u
    (or r) and shaft angle explain linearly. A wall changes it at once, always inwards and always far from the
    centre. So the change is regressed on these, and what is left, projected inwards, is looked at beyond 0.7 of the
    largest radius: changes of more than six robust standard deviations are impacts, when there are two at least and
    such changes outwards are rare. Single wrong samples are taken out by a median of three first, times of a
    measured impact force are left out. On the virtual rig clean recordings stay below 4, a rub gives 10 to 20.
    """
    if "p" not in rec.signals or rec.channels["p"] != ("x", "y") or rec.n_samples < _MIN_SAMPLES:
        return
    p = _median_of_three(rec.signal("p"))
    half = max(1, round(CONTACT_S / rec.sample_time / 2))
    k = np.arange(max(_LAGS) + half + 1, rec.n_samples - max(half + 2, -min(_LAGS)))
    k = k[~_struck(rec)[k]]
    if len(k) < _MIN_SAMPLES // 2:
        return
    k = _in_motion(p, k, half)
    place = p[k] - p.mean(axis=0)
    radius = np.hypot(*place.T)
    some, far = k[::_EVERY], k[radius > OUTSIDE * radius.max()]
    basis, change = _columns(rec, p, some, half), _change(p, some, half)
    law = _least_squares(basis, change)
    left = change - basis @ law
    sigma = 1.4826 * float(np.median(np.abs(left - np.median(left, axis=0)), axis=0).max())
    limit = max(SIGMAS * sigma, LEAST * float(np.sqrt(np.mean(change**2))))
    turned_back = _change(p, far, half) - _columns(rec, p, far, half) @ law
    inward = -np.sum((p[far] - p.mean(axis=0)) * turned_back, axis=1) / radius[radius > OUTSIDE * radius.max()]
    hit, lost = far[inward > limit], np.count_nonzero(inward < -limit)
    impacts = np.split(hit, np.flatnonzero(np.diff(hit) > _APART) + 1) if hit.size else []
    if len(impacts) < MIN_IMPACTS or 3 * lost > hit.size:
        return
    reached = np.hypot(*(p[hit] - p.mean(axis=0)).T)
    text = (
        f"recording {rec.name!r}: signal 'p' shows a rub: {len(impacts)} impacts at {reached.min() * 1e6:.1f} to "
        f"{reached.max() * 1e6:.1f} um from the mean position, the first at {hit[0] * rec.sample_time:.4f} s, turn "
        f"the disc back by up to {inward.max() / max(sigma, 1e-300):.0f} standard deviations more than a film does; "
        "lower the excitation and record again, or cut that part away."
    )
    yield SignalProblem("p", "", "rub", text)


def _columns(rec: Recording, p: FloatArray, k: npt.NDArray[np.int_], half: int) -> FloatArray:
    """Collect what a film's change of velocity follows linearly."""
    columns = [np.ones((len(k), 1)), p[k], p[k + half + 1] - p[k - half - 1]]
    source = next((name for name in ("u", "r") if name in rec.signals), None)
    if source:
        columns += [rec.signal(source)[k - lag] for lag in _LAGS]
    if "phi" in rec.signals and np.ptp(rec.signal("phi")) > 0:
        turned = np.exp(1j * rec.signal("phi")[k, :1])
        for order in range(1, _HARMONICS + 1):
            wave = turned**order
            columns += [wave.real, wave.imag]
    return np.hstack(columns)


def _change(p: FloatArray, k: npt.NDArray[np.int_], half: int) -> FloatArray:
    """Change of the velocity around samples [m per sample]."""
    return np.asarray((p[k + half + 1] - p[k + half]) - (p[k - half] - p[k - half - 1]))


def _in_motion(p: FloatArray, k: npt.NDArray[np.int_], half: int) -> npt.NDArray[np.int_]:
    """Keep the samples at which the disc moves: where it rests, noise would decide the regression."""
    energy = np.sum((p[k + half + 1] - p[k - half - 1]) ** 2 + _change(p, k, half) ** 2, axis=1)
    return np.asarray(k[energy > 0.1 * energy.mean()])


def _least_squares(basis: FloatArray, change: FloatArray) -> FloatArray:
    """Coefficients by normal equations with a slight ridge: columns may be alike or zero."""
    size = np.sqrt(np.mean(basis**2, axis=0))
    size[size == 0] = 1.0
    scaled = basis / size
    gram = scaled.T @ scaled + 1e-9 * len(basis) * np.eye(basis.shape[1])
    return np.asarray(np.linalg.solve(gram, scaled.T @ change) / size[:, None])


def _struck(rec: Recording) -> npt.NDArray[np.bool_]:
    """Mark the samples around a measured force."""
    struck = np.zeros(rec.n_samples, dtype=bool)
    for name in ("f", "force"):
        if name in rec.signals:
            size = np.abs(rec.signal(name)).max(axis=1)
            struck |= size > 0.05 * size.max()
    return np.asarray(np.convolve(struck, np.ones(2 * _APART + 1), mode="same") > 0, dtype=bool)


def _median_of_three(values: FloatArray) -> FloatArray:
    a, b, c = values[:-2], values[1:-1], values[2:]
    middle = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return np.concatenate([values[:1], middle, values[-1:]])
