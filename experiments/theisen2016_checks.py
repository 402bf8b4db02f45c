"""Theisen et al. (2016): values of ours computed a second time, by numpy and scipy alone.

A row of `theisen2016_comparison.py` is open when the two ways differ.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from theisen2016_figures import PaperResults
from theisen2016_impacts import LOOPS

from gbid.core.arrays import FloatArray
from gbid.lpv.model import CHARACTERISTICS, LPVModel
from gbid.structure import KEY_PARAMETERS

# ---- Delays, modes and static gains of key parameters, and of surfaces.


def characteristics_again(values: npt.ArrayLike) -> FloatArray:
    """Return delays, frequencies [Hz], damping factors, static gains, (n, 10), from the characteristic polynomial."""
    rows: list[list[float]] = []
    for row in np.atleast_2d(np.asarray(values, float)):
        v = dict(zip(KEY_PARAMETERS, row, strict=True))
        entry = {  # s^2 - d s - k on the diagonal, -d s - k beside it
            pair: np.array([float(pair in ("xx", "yy")), -v[f"d_{pair}"], -v[f"k_{pair}"]])
            for pair in ("xx", "xy", "yx", "yy")
        }
        poles = np.roots(np.convolve(entry["xx"], entry["yy"]) - np.convolve(entry["xy"], entry["yx"]))
        pairs = sorted(poles[poles.imag > 0], key=abs)
        frequency, damping = [abs(p) / (2 * np.pi) for p in pairs], [-p.real / abs(p) for p in pairs]
        k, b = (np.array([[v[f"{q}_xx"], v[f"{q}_xy"]], [v[f"{q}_yx"], v[f"{q}_yy"]]]) for q in "kb")
        rows.append([v["tau_x"], v["tau_y"], *frequency, *damping, *(-np.linalg.inv(k) @ b).ravel()])
    return np.array(rows)


def _on_surface(coefficients: FloatArray, points: FloatArray) -> FloatArray:
    """Return key parameters (n, 14) by Eq. 16 at operating points (n, 2)."""
    bar, rpm = points.T
    terms = np.column_stack([np.ones_like(bar), bar, rpm, rpm * bar, bar**2, rpm**2])
    return np.asarray(terms @ coefficients.T)


def _coefficients(model: LPVModel) -> FloatArray:
    return np.array([model.coefficients[key] for key in KEY_PARAMETERS], float)


@lru_cache(maxsize=4)
def _off_surface(results: PaperResults) -> FloatArray:
    """Return estimates minus surface, (n, 10)."""
    fit = results.surface_fit
    surface = _on_surface(_coefficients(fit.model), fit.estimates.points)
    return characteristics_again(fit.estimates.values) - characteristics_again(surface)


def _rms_again(j: int, results: PaperResults) -> float:
    return float(np.sqrt(np.mean(_off_surface(results)[:, j] ** 2)))


def _largest_gain_again(results: PaperResults) -> float:
    return float(np.abs(_off_surface(results)[:, -4:]).max())


def _off_published_again(j: int, results: PaperResults) -> float:
    points = np.array(results.machine.operating_points, float)
    ours, published = (
        characteristics_again(_on_surface(_coefficients(model), points))
        for model in (results.surface_fit.model, results.machine)
    )
    return float(np.sqrt(np.mean((ours[:, j] - published[:, j]) ** 2)))


# ---- Modes of ring-downs: two coupled oscillators, by least squares with differences for derivatives.


@lru_cache(maxsize=4)
def ringing_again(results: PaperResults, loop: str) -> FloatArray:
    """Return frequency [Hz] and damping factor of both modes, (2, 2), from what `gbid.fit_ringdown` saw at rest.

    They are nan when its fit has decays beside the modes. Positions are weighted by the residuals of a first round.
    """
    study = results.impacts_at(False)[loop]
    if study.ringdown.lag_rates.size or study.ringdown.oscillations.size:
        return np.full((2, 2), np.nan)
    pieces = [
        (i, v.measured[hit.stop : end])
        for i, v in enumerate(study.validations)
        for hit, end in zip(v.impacts, [*(q.start for q in v.impacts[1:]), len(v.measured)], strict=True)
    ]
    length = min(len(p) for _, p in pieces)
    measured = np.array([p[:length] for _, p in pieces])  # (impacts, samples, 2)
    measured /= np.sqrt(np.mean(measured**2))
    of_recording = np.eye(len(study.validations))[[i for i, _ in pieces]]
    rate = 2 * np.pi * 110.0
    time = rate * np.arange(length) * float(np.mean(np.diff(study.validations[0].time)))

    def residuals(theta: FloatArray, weights: FloatArray) -> FloatArray:
        poles, shapes = np.linalg.eig(_system(theta))
        free = ((shapes[:2] * np.exp(np.multiply.outer(time, poles))[:, None]) @ np.linalg.inv(shapes)).real
        q = np.linalg.qr((free * weights[:, None]).reshape(2 * length, 4))[0]

        def left(signals: FloatArray) -> FloatArray:  # without the free response to any state after each impact
            return np.asarray(signals - q @ (q.T @ signals))

        offset = left(np.tile(np.diag(weights), (length, 1)))
        columns = np.einsum("sr,na->nsra", of_recording, offset).reshape(2 * length * len(measured), -1)
        target = left((measured * weights).reshape(len(measured), -1).T).ravel()
        return np.asarray(target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0])

    starts = [np.array([0.95, 0.0, 0.0, 1.05, 2 * z, 0.0, 0.0, 2 * z]) for z in (0.03, 0.4)]
    start = min(starts, key=lambda theta: float((residuals(theta, np.ones(2)) ** 2).sum()))
    first = least_squares(residuals, start, x_scale=0.1, max_nfev=60, args=(np.ones(2),))
    rms = np.sqrt(np.mean(first.fun.reshape(length, 2, -1) ** 2, axis=(0, 2)))
    second = least_squares(residuals, first.x, x_scale=0.1, max_nfev=60, args=(rms.mean() / rms,))
    poles = rate * np.linalg.eigvals(_system(second.x))
    return np.array([(abs(p) / (2 * np.pi), -p.real / abs(p)) for p in sorted(poles[poles.imag > 0], key=abs)])


def _system(theta: FloatArray) -> FloatArray:
    """Return [0 I; K D] with time in units of one over the rate, from -K and -D row by row."""
    return np.block([[np.zeros((2, 2)), np.eye(2)], [-theta[:4].reshape(2, 2), -theta[4:].reshape(2, 2)]])


def _obtained_again(loop: str, i: int, j: int, results: PaperResults) -> float:
    return float(ringing_again(results, loop)[i, j])


CHECKS: dict[str, Callable[[PaperResults], float]] = {
    **{f"rms_{name}": partial(_rms_again, j) for j, name in enumerate(CHARACTERISTICS)},
    "largest_gain": _largest_gain_again,
    **{f"surface_{name}": partial(_off_published_again, j) for j, name in enumerate(CHARACTERISTICS)},
    **{
        f"obtained_{loop}_{what}_{i}": partial(_obtained_again, loop, i - 1, j)
        for loop in LOOPS
        for i in (1, 2)
        for j, what in enumerate(("frequency", "damping"))
    },
}
"""Values of rows by other code in SI units, by id."""
