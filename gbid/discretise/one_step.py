"""One step of an integrator for ``xd = f(x, u)``, as a CasADi expression."""

from __future__ import annotations

from typing import Literal

import casadi as ca

IntegratorName = Literal["rk4", "implicit"]


def one_step(method: IntegratorName, f: ca.Function, x: ca.SX, u: tuple[ca.SX, ca.SX], step: ca.SX) -> ca.SX:
    """Return the state after one step.

    Parameters
    ----------
    method : {"rk4", "implicit"}
        Explicit Runge-Kutta method of order 4, or the Rosenbrock method Rodas3 of order 3, which is L-stable.
    f : casadi.Function
        ``f(x, u)``, the derivatives of the states.
    x : casadi.SX
        State, (n, 1).
    u : (casadi.SX, casadi.SX)
        Inputs at the start and the end of the step. Between them they lie on a straight line.
    step : casadi.SX
        Length of the step [s].

    Returns
    -------
    casadi.SX
        The state after the step, (n, 1).

    Notes
    -----
    Rodas3 (Sandu et al., Atmospheric Environment 31, 1997) solves one linear system with the matrix ``I / (h / 2) - J``
    in each of its four stages, which is one Newton step.
    """
    return _runge_kutta(f, x, u, step) if method == "rk4" else _rosenbrock(f, x, u, step)


def _runge_kutta(f: ca.Function, x: ca.SX, u: tuple[ca.SX, ca.SX], step: ca.SX) -> ca.SX:
    first, last = u
    middle = (first + last) / 2
    k1 = f(x, first)
    k2 = f(x + step / 2 * k1, middle)
    k3 = f(x + step / 2 * k2, middle)
    k4 = f(x + step * k3, last)
    return x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _rosenbrock(f: ca.Function, x: ca.SX, u: tuple[ca.SX, ca.SX], step: ca.SX) -> ca.SX:
    first, last = u
    free = {"allow_free": True}  # what stays constant within the step
    at, under = (ca.SX.sym(name, n) for name, n in (("x", x.numel()), ("u", first.numel())))
    slopes = ca.Function("slopes", [at, under], [ca.jacobian(f(at, under), each) for each in (at, under)], free)
    J, Ju = slopes(x, first)
    Q, R = ca.qr(ca.densify(2 / step * ca.SX.eye(x.numel()) - J))
    drift = ca.mtimes(Ju, last - first)  # the time derivative times the step

    def stage(value: ca.SX) -> ca.SX:
        return ca.solve(R, ca.mtimes(Q.T, value))

    at_first = f(x, first)
    k1 = stage(at_first + drift / 2)
    k2 = stage(at_first + 4 / step * k1 + 3 / 2 * drift)
    k3 = stage(f(x + 2 * k1, last) + (k1 - k2) / step)
    k4 = stage(f(x + 2 * k1 + k3, last) + (k1 - k2 - 8 / 3 * k3) / step)
    return x + 2 * k1 + k3 + k4
