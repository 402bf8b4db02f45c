"""Fits of a bearing with a cubic film by the pattern of CasADi's documentation for identification (its ``sysid``).

One step as a function of scalar operations; `mapaccum` over the samples; Gauss-Newton Hessian from the Jacobian of all
errors; IPOPT on the free parameters and the first state (single shooting).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from gbid import Recording
from gbid.core.arrays import FloatArray

STEPS = 2
"""Runge-Kutta steps in a sample, as many as gbid takes for the same data."""
_GAIN = {"c": 1e14, "g": 1e3}
"""Sizes of cubic stiffness and disturbance gains that begin at zero."""
_INPUT = 1e-6
_DELAY = 1e-9


@dataclass(frozen=True, eq=False)
class Found:
    """A fit by the pattern, with its processor time.

    Attributes
    ----------
    parameters : dict of str to float
        All parameters.
    initial_state : (6,) array
        In SI units.
    build_cpu_s, solve_cpu_s : float
        Time to construct the functions, and to solve.
    iterations : int
        Of IPOPT.
    status : str
        Of IPOPT.
    mean_square : float
        Mean squared error, summed over the outputs [m^2].
    """

    parameters: dict[str, float]
    initial_state: FloatArray
    build_cpu_s: float
    solve_cpu_s: float
    iterations: int
    status: str
    mean_square: float

    def figures(self) -> dict[str, Any]:
        """Return what is stored."""
        names = ("build_cpu_s", "solve_cpu_s", "iterations", "status", "mean_square")
        return {name: getattr(self, name) for name in names}


def fit_with_mapaccum(
    equations: ca.Function,
    recording: Recording,
    start: Mapping[str, float],
    free: Sequence[str],
    initial_state: FloatArray | None = None,
    *,
    tolerance: float = 1e-8,
    most_s: float = 600.0,
) -> Found:
    """Return the fit of some of the parameters; the others keep their start values, as constants in the step.

    Parameters
    ----------
    equations : casadi.Function
        ``f(x, u, p)``, the derivatives of the six states, with all parameters in the order of `start`.
    recording : Recording
        Signals ``u`` and ``p`` of two channels each.
    start : dict of str to float
        Start values of all parameters, the four disturbance gains last.
    free : sequence of str
        Names of those to fit.
    initial_state : (6,) array, optional
        Where the first state begins; zero by default.
    tolerance : float
        Of IPOPT.
    most_s : float
        Limit of the solver's processor time.

    Returns
    -------
    Found
        The last iterate, also when the time was not enough.
    """
    began = time.process_time()
    u, y = recording.signal("u"), recording.signal("p")
    n, h = len(y), recording.sample_time
    size_y = float(y.std())
    velocity = float(np.diff(y[:, 0]).std() / h)
    x_scale = np.array([size_y, size_y, velocity, velocity, _DELAY, _DELAY])
    scale = np.array([abs(start[name]) or _GAIN[name[0]] for name in free])
    x, z, theta = ca.SX.sym("x", 6), ca.SX.sym("z", 6), ca.SX.sym("theta", len(free))
    own = dict(zip(free, ca.vertsplit(theta * scale), strict=True))
    p = ca.vertcat(*(own.get(name, value) for name, value in start.items()))
    step = ca.Function("step", [x, z, theta], [_sample(equations, h, x * x_scale, z, p, size_y) / x_scale])

    z_all = np.hstack([u / _INPUT, np.vstack([u[1:], u[-1:]]) / _INPUT, y / size_y]).T
    V = ca.MX.sym("V", len(free) + 6)
    every = step.mapaccum(n - 1)
    states = ca.horzcat(V[-6:], every(V[-6:], z_all[:, :-1], ca.repmat(V[:-6], 1, n - 1)))
    e = ca.vec(y.T / size_y - states[:2, :] * (x_scale[:2] / size_y))
    J = ca.jacobian(e, V)
    none, sigma, multipliers = ca.MX.sym("p", 0), ca.MX.sym("sigma"), ca.MX.sym("lam_g", 0)
    hessian = ca.Function(
        "nlp_hess_l",
        [V, none, sigma, multipliers],
        [sigma * ca.triu(J.T @ J) / n],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
    limits = {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 50, "max_cpu_time": most_s}
    nlp = {"x": V, "f": 0.5 * ca.dot(e, e) / n, "g": ca.MX(0, 1)}
    solver = ca.nlpsol("solver", "ipopt", nlp, {"hess_lag": hessian, "print_time": False, "ipopt": limits})
    built = time.process_time()
    first = np.zeros(6) if initial_state is None else initial_state / x_scale
    found = solver(x0=np.concatenate([np.array([start[name] for name in free]) / scale, first]))
    solved = time.process_time()
    stats, values = solver.stats(), np.asarray(found["x"])[:, 0]
    return Found(
        parameters={**start, **dict(zip(free, (values[:-6] * scale).tolist(), strict=True))},
        initial_state=values[-6:] * x_scale,
        build_cpu_s=built - began,
        solve_cpu_s=solved - built,
        iterations=int(stats["iter_count"]),
        status=str(stats["return_status"]),
        mean_square=2 * float(found["f"]) * size_y**2,
    )


def _sample(equations: ca.Function, h: float, x: ca.SX, z: ca.SX, p: ca.SX, size_y: float) -> ca.SX:
    """Return the state one sample later: inputs linear between samples, the prediction error held."""
    now, last, y = z[:2] * _INPUT, z[2:4] * _INPUT, z[4:] * size_y
    held = ca.vertcat(ca.SX(2, 2), ca.reshape(p[-4:], 2, 2).T, ca.SX(2, 2)) @ (y - x[:2])
    s = h / STEPS

    def f(state: ca.SX, drive: ca.SX) -> ca.SX:
        return equations(state, drive, p)[0] + held

    for i in range(STEPS):
        a, c = now + (last - now) * (i / STEPS), now + (last - now) * ((i + 1) / STEPS)
        m = (a + c) / 2
        k1 = f(x, a)
        k2 = f(x + s / 2 * k1, m)
        k3 = f(x + s / 2 * k2, m)
        x = x + s / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + s * k3, c))
    return x
