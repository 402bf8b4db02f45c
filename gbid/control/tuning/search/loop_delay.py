"""Delay by sampling and computation, approximated in a continuous loop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import casadi as ca

from gbid.arrays import is_finite
from gbid.control.controllers.scheduled import Scheduled, controller_at
from gbid.control.loop.sampled import exact_plant, sampled_loop
from gbid.control.loop.sampling import Method
from gbid.errors import UsageError
from gbid.lpv import LPVModel
from gbid.structure import pade_delay
from gbid.structure.linear import Structure

PADE_ORDER = 3
"""Order of the Padé delays of a loop that is designed for sampling."""


def loop_delay(sample_time: float | None, computation_s: float | None) -> float:
    """Return the delay by holding the references (half a sample) and by their computation (one sample by default) [s].

    Raises
    ------
    UsageError
        When a time is not allowed, or when a computation time is given without a sample time.
    """
    if sample_time is None:
        if computation_s is not None:
            raise UsageError("computation_s: give sample_time as well")
        return 0.0
    computation = sample_time if computation_s is None else computation_s
    if not (is_finite(sample_time) and sample_time > 0):
        raise UsageError(f"sample_time = {sample_time!r}; give seconds, above 0")
    if not (is_finite(computation) and computation >= 0):
        raise UsageError(f"computation_s = {computation!r}; give seconds, 0 or more")
    return computation + sample_time / 2


def smallest_sampled_damping(
    lpv: LPVModel,
    controller: Structure | Scheduled,
    gains: Mapping[str, float],
    points: Iterable[tuple[float, float]],
    sample_time: float,
    computation_s: float | None,
    method: Method = "tustin",
) -> tuple[float, tuple[float, float]]:
    """Return the smallest damping factor of the sampled loop over points, and its point; -1 when it is unstable.

    Delays are exact.
    """
    found = []
    for point in points:
        K = controller_at(controller, gains, *point)
        loop = sampled_loop(exact_plant(lpv, *point), K, sample_time, computation_s=computation_s, method=method)
        found.append((loop.damping if loop.stable else -1.0, point))
    return min(found)


def delayed_outputs(controller: dict[str, ca.SX], delay_s: float) -> dict[str, ca.SX]:
    """Return a controller with both outputs delayed.

    Parameters
    ----------
    controller : dict of str to casadi.SX
        A (n, n), B (n, 2), C (2, n), D (2, 2).
    delay_s : float
        Delay [s], as a Padé approximation of order `PADE_ORDER`; 0 leaves the controller unchanged.

    Returns
    -------
    dict of str to casadi.SX
        Matrices; the states of the delays follow those of the controller.
    """
    if not delay_s:
        return controller
    A, B, C, D = (controller[letter] for letter in "ABCD")
    late, two = pade_delay(delay_s, PADE_ORDER), ca.SX.eye(2)
    a, b, c, d = (ca.kron(two, M) for M in (late.A, late.B, late.C, late.D))
    return {
        "A": ca.blockcat([[A, ca.SX(A.shape[0], a.shape[0])], [b @ C, a]]),
        "B": ca.vertcat(B, b @ D),
        "C": ca.horzcat(d @ C, c),
        "D": d @ D,
    }
