"""Baseline (b): the pattern of CasADi's documentation for identification (its example ``sysid``).

One step as a function, expanded to scalar operations; `mapaccum` over the samples; Gauss-Newton Hessian from the
Jacobian of all errors; IPOPT on the parameters and the first state alone (single shooting). The step is the exact
one, by a matrix exponential once per parameter vector: the Pade pole of a delay of 0.12 ms would need many
Runge-Kutta steps per sample, which is slower and no longer the same model.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import casadi as ca
import numpy as np

from benchmarks.answer import Answer
from benchmarks.case import N_STATES, SAMPLE_TIME, Samples
from benchmarks.scaling import names, scales, start_state
from gbid.core.arrays import FloatArray

_SQUARINGS = 8  # of a matrix whose norm, once balanced, is below 30
_TERMS = 8


def fit_with_casadi(samples: Samples, start: Mapping[str, float]) -> Answer:
    """Fit from given start values; unknowns and states scaled to the order of one."""
    began, began_cpu = time.perf_counter(), time.process_time()
    n_theta, n = len(names()), len(samples.p)
    theta_scale = scales(start)
    first = np.array([start[name] for name in names()]) / theta_scale
    state_scale = _state_scale(samples)
    size = float(np.sqrt(np.mean(samples.p**2)))
    z = np.hstack([samples.u, np.vstack([samples.u[1:], samples.u[-1:]]), samples.p]) / size
    matrices = _step_matrices(theta_scale, state_scale, size)

    x, now = ca.MX.sym("x", N_STATES), ca.MX.sym("z", z.shape[1])
    F, G = ca.MX.sym("F", N_STATES, N_STATES), ca.MX.sym("G", N_STATES, z.shape[1])
    one_sample = ca.Function("one_sample", [x, now, F, G], [F @ x + G @ now]).expand()
    all_samples = one_sample.mapaccum("all_samples", n - 1)

    V = ca.MX.sym("V", n_theta + N_STATES)
    F_V, G_V = matrices(V[:n_theta])
    x0 = V[n_theta:]
    states = ca.horzcat(x0, all_samples(x0, z[:-1].T, ca.repmat(F_V, 1, n - 1), ca.repmat(G_V, 1, n - 1)))
    predicted = ca.diag(state_scale[:2] / size) @ states[:2, :]
    e = ca.vec((samples.p.T / size) - predicted)
    nlp = {"x": V, "f": 0.5 * ca.dot(e, e) / n, "g": ca.MX(0, 1)}

    J = ca.jacobian(e, V)
    H = ca.triu(J.T @ J) / n
    sigma, multipliers, none = ca.MX.sym("sigma"), ca.MX.sym("lam_g", 0), ca.MX.sym("p", 0)
    hessian = ca.Function(
        "nlp_hess_l", [V, none, sigma, multipliers], [sigma * H], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
    )
    options = {
        "hess_lag": hessian,
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 100},
    }
    solver = ca.nlpsol("solver", "ipopt", nlp, options)
    built, spent = time.perf_counter(), time.process_time()

    found = solver(x0=np.concatenate([first, start_state(samples) / state_scale]))
    wall, cpu = time.perf_counter() - built, time.process_time() - spent
    stats = solver.stats()
    return Answer(
        time_s=wall,
        cpu_s=cpu,
        build_s=built - began,
        build_cpu_s=spent - began_cpu,
        iterations=int(stats["iter_count"]),
        loss=2 * float(found["f"]) * size**2,
        success=bool(stats["success"]),
    )


def _state_scale(samples: Samples) -> FloatArray:
    """Sizes of positions, velocities and delay states (inputs held back by the time constant of the delay)."""
    velocity = np.diff(samples.p, axis=0).std(axis=0) / SAMPLE_TIME
    return np.concatenate([samples.p.std(axis=0), velocity, samples.u.std(axis=0) * SAMPLE_TIME])


def _step_matrices(theta_scale: FloatArray, state_scale: FloatArray, size: float) -> ca.Function:
    """Predictor ``x+ = F x + G [u, u+, y]`` of scaled states and signals, u linear between samples, y - C x held."""
    theta = ca.SX.sym("theta", len(theta_scale))
    p = dict(zip(names(), ca.vertsplit(theta * theta_scale), strict=True))
    k, d, b, gain = (
        ca.blockcat([[p[f"{c}_xx"], p[f"{c}_xy"]], [p[f"{c}_yx"], p[f"{c}_yy"]]]) for c in ("k", "d", "b", "bd")
    )
    pole, zero, eye = ca.diag(ca.vertcat(2 / p["tau_x"], 2 / p["tau_y"])), ca.SX(2, 2), ca.SX.eye(2)
    A = ca.blockcat([[zero, eye, zero], [k, d, 2 * b @ pole], [zero, zero, -pole]])
    B, K = ca.vertcat(zero, -b, eye), ca.vertcat(zero, gain, zero)
    T, T_inverse = ca.diag(state_scale), ca.diag(1 / state_scale)
    A, B, K = T_inverse @ A @ T, T_inverse @ B * size, T_inverse @ K * size
    big = ca.SX(N_STATES + 6, N_STATES + 6)
    big[:N_STATES, :] = SAMPLE_TIME * ca.horzcat(A, B, ca.SX(N_STATES, 2), K)
    big[N_STATES : N_STATES + 2, N_STATES + 2 : N_STATES + 4] = eye
    step = _exponential(big)[:N_STATES, :]
    F, now, slope, held = ca.horzsplit(step, [0, N_STATES, N_STATES + 2, N_STATES + 4, N_STATES + 6])
    C = ca.horzcat(ca.diag(state_scale[:2] / size), ca.SX(2, N_STATES - 2))
    return ca.Function("step", [theta], [ca.densify(F - held @ C), ca.densify(ca.horzcat(now - slope, slope, held))])


def _exponential(M: ca.SX) -> ca.SX:
    """Scaling and squaring of the Taylor series; CasADi's wheels have no matrix exponential."""
    function_of = ca.SX.sym("M", M.sparsity())
    scaled = function_of / 2**_SQUARINGS
    result = ca.SX.eye(M.shape[0])
    for i in range(_TERMS, 0, -1):
        result = ca.SX.eye(M.shape[0]) + scaled @ result / i
    for _ in range(_SQUARINGS):
        result = result @ result
    return ca.Function("exponential", [function_of], [result])(M)
