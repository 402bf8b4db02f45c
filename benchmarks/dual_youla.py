"""Dual-Youla identification (Hansen's scheme) of the closed-loop study: a black box in between, then the parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import least_squares

import gbid
from gbid.core.arrays import FloatArray
from gbid.identify.data import Record
from gbid.identify.predictor import Predictor, build_predictor
from gbid.identify.start.black_box import black_box
from gbid.structure import evaluate

ORDER = 48
"""States of the black-box model of the dual-Youla parameter, the best of 6 to 64 on recordings beside the study."""
FREQUENCIES = np.geomspace(20.0, 600.0, 120)  # [Hz]


def dual_youla(
    loop: gbid.ClosedLoop, recording: gbid.Recording, nominal: Mapping[str, float], fixed: Mapping[str, float]
) -> dict[str, float]:
    r"""Return the parameters by way of the dual-Youla parameter R, in three steps.

    Every plant that the controller stabilises is ``G = (N + V R) (D - U R)^-1`` with coprime factors of a nominal plant
    ``G_0 = N D^-1`` and of the controller ``K = U V^-1`` (Hansen, Franklin and Kosut, ACC 1989; for gas bearings
    Sekunda, Niemann, Poulsen and Santos). R is driven by w and gives z, both known from the data, without feedback. The
    controller is stable, so that V is one; with ``D = (I - K G_0)^-1`` then ``z = y - T_0 w``, where T is the response
    of the loop, and ``R = T - T_0``.

    A grey-box R with the parameters of the plant would have the residuals ``z - R w = y - T w`` of the indirect method,
    so that there is nothing to compare. As the field does it, R is a black-box model here, whose plant
    is matched by the structure over frequency, weighted by the accuracy of R.

    Parameters
    ----------
    loop : ClosedLoop
        The loop, without disturbance gain.
    recording : Recording
        Recording with w, u and p.
    nominal : dict of str to float
        Parameters of the nominal plant, which are also the start values of the match.
    fixed : dict of str to float
        Parameters of the actuators.
    """
    w = recording.signal("w")
    y = np.hstack([recording.signal(name) for name in loop.outputs])
    model = evaluate(loop, {**nominal, **fixed})
    z = y - model.simulate(w)
    found = black_box([Record("z", w, z)], ORDER, feedthrough=False)
    points = np.exp(2j * np.pi * FREQUENCIES * recording.sample_time)
    R, std = found.response(points)
    wanted = model.frequency_response(FREQUENCIES) + R
    predictor = build_predictor(loop, dict(fixed), recording.sample_time, "zoh", "simulation")
    scale = np.array([nominal[q.name] for q in predictor.free])

    def residual(relative: FloatArray) -> FloatArray:
        return _parts((_response(predictor, relative * scale, points)[0] - wanted) / std)

    def slopes(relative: FloatArray) -> FloatArray:
        by_theta = _response(predictor, relative * scale, points)[1] / std
        return np.array([_parts(column) for column in by_theta]).T * scale

    limits = np.sort(
        [np.array([q.lower, q.upper]) / size for q, size in zip(predictor.free, scale, strict=True)], axis=1
    )
    start = np.ones(len(scale))
    best = least_squares(residual, start, jac=slopes, bounds=limits.T, x_scale="jac", max_nfev=100).x * scale
    return {q.name: float(v) for q, v in zip(predictor.free, best, strict=True)}


def _response(predictor: Predictor, theta: FloatArray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the response of the loop (n_f, n_y, n_u), and its derivatives by the parameters."""
    A, B, C, D, *_ = predictor.matrices(theta)
    inverse = np.linalg.inv(points[:, None, None] * np.eye(A.shape[0]) - A.value)
    left, states = C.value @ inverse, inverse @ B.value
    by_theta = [
        dC @ states + left @ (dA @ states + dB) + dD
        for dA, dB, dC, dD in zip(A.slope, B.slope, C.slope, D.slope, strict=True)
    ]
    return left @ B.value + D.value, np.array(by_theta)


def _parts(values: np.ndarray) -> FloatArray:
    return np.concatenate([values.real.ravel(), values.imag.ravel()])
