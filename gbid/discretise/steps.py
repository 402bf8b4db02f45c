"""One step of an integrator for ``xd = f(x, u)`` as a CasADi expression, and the inputs within a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import casadi as ca

from gbid.discretise.exact import Hold

IntegratorName = Literal["rk4", "implicit"]


def one_step(method: IntegratorName, f: ca.Function, x: ca.SX, u: tuple[ca.SX, ca.SX], step: ca.SX) -> ca.SX:
    """Return the state after one step of an integrator.

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


def step_inputs(
    u: ca.SX, holds: Sequence[Hold], early: Sequence[Any | None], at: Any, part: Any
) -> tuple[ca.SX, ca.SX]:
    """Return the inputs at the start and the end of a step of an integrator.

    Parameters
    ----------
    u : (n_inputs, 3) casadi.SX
        Inputs at the samples ``k - shift + 1``, ``k - shift`` and ``k - shift - 1``, where `shift` is the whole samples
        in the delay of each.
    holds : sequence of {"zoh", "foh"}
        Hold of each input.
    early : sequence of (casadi.SX or None)
        The rest of each delay, in samples: the input changes to its next piece at this part of the sample. None for an
        input without delay.
    at, part : casadi.SX or float
        Start and length of the step, in samples.

    Returns
    -------
    (n_inputs, 1) casadi.SX, (n_inputs, 1) casadi.SX
        Ends of a straight line.

    Notes
    -----
    Without delay the line is the input itself. A delayed input has a kink (first-order hold) or a jump (zero-order
    hold) within the sample. In the step with the kink the line has the same mean and the same first moment as the
    input. So the error of a step is of fourth order in its length, and the response is a smooth function of the
    delay. For a kink at the part r of a step, with a bend of one, the line goes from ``-r (1 - r)^2`` to ``(1 - r)^2 (1
    + r)``. For a jump of one it goes from ``(1 - r)(1 - 3 r)`` to ``(1 - r)(1 + 3 r)``.
    """
    ends = [_line(u[i, :], holds[i], early[i], at, part) for i in range(u.shape[0])]
    first, last = (ca.vertcat(*each) for each in zip(*ends, strict=True)) if ends else (ca.SX(0, 1), ca.SX(0, 1))
    return first, last


def _line(u: ca.SX, hold: Hold, early: Any | None, at: Any, part: Any) -> tuple[Any, Any]:
    following, now, before = u[0], u[1], u[2]
    if early is None:
        rise = 0 if hold == "zoh" else following - now
        return now + rise * at, now + rise * (at + part)
    r = ca.fmin(ca.fmax((early - at) / part, 0), 1)
    if hold == "zoh":
        jump = now - before
        return before + jump * ((1 - r) * (1 - 3 * r)), before + jump * ((1 - r) * (1 + 3 * r))
    rise, bend = now - before, following - 2 * now + before
    past = ca.fmax(at - early, 0)  # since the kink
    first = now + rise * (at - early) + bend * (past - part * r * (1 - r) ** 2)
    last = now + rise * (at + part - early) + bend * (past + part * (1 - r) ** 2 * (1 + r))
    return first, last
