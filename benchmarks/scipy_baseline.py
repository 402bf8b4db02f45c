"""Baseline (a): scipy's least squares with finite differences over a discrete simulation of the predictor."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import dlsim

from benchmarks.answer import Answer
from benchmarks.case import N_STATES, SAMPLE_TIME, Samples, sampled
from benchmarks.scaling import names, scales, start_state
from gbid.core.arrays import FloatArray


def continuous(p: Mapping[str, float]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Matrices A, B, C, K of Eq. 10 with first-order Pade delays, written out."""
    k, d, b, gain = (np.array([p[f"{c}_{pair}"] for pair in ("xx", "xy", "yx", "yy")]).reshape(2, 2) for c in _LETTERS)
    pole = np.diag([2 / p["tau_x"], 2 / p["tau_y"]])
    zero, eye = np.zeros((2, 2)), np.eye(2)
    A = np.block([[zero, eye, zero], [k, d, 2 * b @ pole], [zero, zero, -pole]])
    B = np.vstack([zero, -b, eye])
    K = np.vstack([zero, gain, zero])
    return A, B, np.hstack([eye, zero, zero]), K


_LETTERS = ("k", "d", "b", "bd")


def fit_with_scipy(samples: Samples, start: Mapping[str, float]) -> Answer:
    """Fit from given start values; unknowns scaled to the order of one."""
    inputs = np.hstack([samples.u, np.vstack([samples.u[1:], samples.u[-1:]]), samples.p])
    size = np.sqrt(np.mean(samples.p**2))
    none = np.zeros((2, inputs.shape[1]))
    first = np.array([start[name] for name in names()])
    began, spent = time.perf_counter(), time.process_time()
    theta_scale = scales(start)

    def predict(theta: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        A, B, C, K = continuous(dict(zip(names(), theta, strict=True)))
        F, G = sampled(A, B, K)
        # The disturbance y - C x is held between samples.
        _, y, x = dlsim((F - G[:, 4:] @ C, G, C, none, SAMPLE_TIME), inputs, x0=x0)
        return y, x

    x0 = start_state(samples)
    state_scale = predict(first, x0)[1].std(axis=0)

    def errors(z: FloatArray) -> FloatArray:
        y, _ = predict(z[:-N_STATES] * theta_scale, z[-N_STATES:] * state_scale)
        return np.asarray((samples.p - y) / size).ravel()

    begin = np.concatenate([first / theta_scale, x0 / state_scale])
    lower = np.full(len(begin), -np.inf)
    tau = [i for i, name in enumerate(names()) if name.startswith("tau")]
    lower[tau] = 5e-6 / theta_scale[tau]
    found = least_squares(errors, begin, bounds=(lower, np.inf), x_scale="jac", method="trf")
    wall, cpu = time.perf_counter() - began, time.process_time() - spent
    return Answer(
        time_s=wall,
        cpu_s=cpu,
        build_s=0.0,
        build_cpu_s=0.0,
        iterations=int(found.njev),
        loss=2 * float(found.cost) * float(size) ** 2 / len(samples.p),
        success=bool(found.success),
    )
