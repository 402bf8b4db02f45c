"""Several steps of an integrator in a sample, and how many a structure needs to begin with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import Hold, IntegratorName, one_step, step_inputs
from gbid.errors import NoValueAtStartError
from gbid.structure.nonlinear.equations import Equations
from gbid.structure.nonlinear.nonlinear_structure import MOST_STEPS, NonlinearStructure

_RADIANS = 1.0  # that the fastest pole turns in a step of the explicit method, at the start


def first_steps(structure: NonlinearStructure, p: FloatArray, sample_time: float, own: Equations) -> int:
    """Return the steps of the integrator in a sample: those of the structure, or what the fastest pole needs.

    With ``steps="auto"`` the fastest pole at rest turns by a radian at most in one step.

    Parameters
    ----------
    structure : NonlinearStructure
        The structure.
    p : (n_parameters,) array
        Values of all parameters.
    sample_time : float
        Time between samples [s].
    own : Equations
        Its equations.

    Raises
    ------
    NoValueAtStartError
        When the pole is too fast for the explicit method.
    """
    if structure.steps != "auto":
        return structure.steps
    slopes = ca.Function("slopes", [own.x, own.u, own.p], [ca.densify(ca.jacobian(own.dx, own.x))])
    A = np.asarray(slopes(np.zeros(own.x.numel()), np.zeros(own.u.numel()), p), float)
    if structure.integrator == "implicit" or not np.isfinite(A).all():
        return 1
    fastest = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0)) * sample_time
    if fastest > MOST_STEPS:
        raise NoValueAtStartError(
            f"structure {structure.name!r}: the fastest pole at the start needs {fastest:.0f} steps in a sample: "
            "the equations are stiff; use integrator='implicit'"
        )
    return max(1, int(np.ceil(fastest / _RADIANS)))


def over_a_sample(
    method: IntegratorName,
    f: ca.Function,
    x: ca.SX,
    u: ca.SX,
    holds: Sequence[Hold],
    early: Sequence[Any | None],
    sample_time: ca.SX,
    steps: int,
) -> ca.SX:
    """Return the state after a sample of several steps of an integrator; arguments as for `one_step`, `step_inputs`."""
    at, a, b = (ca.SX.sym(name, n) for name, n in (("x", x.numel()), ("a", u.shape[0]), ("b", u.shape[0])))
    length = ca.SX.sym("h")
    sub = ca.Function("sub", [at, a, b, length], [one_step(method, f, at, (a, b), length)], {"allow_free": True})
    for i in range(steps):
        x = sub(x, *step_inputs(u, holds, early, i / steps, 1 / steps), sample_time / steps)
    return x
