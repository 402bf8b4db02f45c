"""Proportional controller as a linear model, from the disc position p to the piezo reference r."""

from __future__ import annotations

import numpy as np

from gbid.errors import UsageError
from gbid.structure import LinearModel


def p_controller(kappa_x: float, kappa_y: float, lowpass_hz: float = 1000.0, order: int = 1) -> LinearModel:
    r"""Return a decentralised proportional controller with low-pass (paper, Eq. 21).

    .. math:: K_{pl}(s) = \mathrm{diag}(\kappa_x, \kappa_y) \left(\frac{p_{lp}}{s + p_{lp}}\right)^n

    Parameters
    ----------
    kappa_x, kappa_y : float
        Gains [m/m]. Positive gains are positive feedback (see `gbid.control.close_loop`), as in the paper.
    lowpass_hz : float
        Corner frequency of the low-pass [Hz]; ``p_lp = 2 pi lowpass_hz`` in rad/s.
    order : int
        Order n of the low-pass; 0 for none.

    Returns
    -------
    LinearModel
        Continuous; inputs p_x, p_y, outputs r_x, r_y [m]; n states per axis.

    Raises
    ------
    UsageError
        When gains are not finite, the corner frequency is not positive, or the order is negative.
    """
    for name, gain in (("kappa_x", kappa_x), ("kappa_y", kappa_y)):
        if not np.isfinite(gain):
            raise UsageError(f"p_controller: {name} = {gain}; give a finite number")
    if not (np.isfinite(lowpass_hz) and lowpass_hz > 0):
        raise UsageError(f"p_controller: lowpass_hz = {lowpass_hz}; give a positive number of Hz")
    if order < 0:
        raise UsageError(f"p_controller: order = {order}; it must be at least 0")
    corner = 2.0 * np.pi * lowpass_hz
    chain = corner * (np.eye(order, k=-1) - np.eye(order))  # the output of each stage is the input of the next
    first, last = np.zeros((order, 1)), np.zeros((1, order))
    first[:1], last[:, -1:] = corner, 1.0
    axes, gains = np.eye(2), np.diag(np.array([kappa_x, kappa_y], float))
    return LinearModel(
        np.asarray(np.kron(axes, chain), np.float64),
        np.asarray(np.kron(axes, first), np.float64),
        np.asarray(np.kron(gains, last), np.float64),
        gains if order == 0 else np.zeros((2, 2)),
        input_names=("p_x", "p_y"),
        output_names=("r_x", "r_y"),
        state_names=tuple(f"lowpass{i + 1}_{axis}" for axis in "xy" for i in range(order)),
        name="p_controller",
    )
