"""Sections of filters as symbolic state-space models, and their series connection."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

System = tuple[Any, Any, Any, Any]
"""A, B, C, D as casadi.SX."""


def second_order(b: Sequence[Any], frequency_khz: Any, damping: Any) -> System:
    """Return ``(b2 s^2 + b1 w s + b0 w^2) / (s^2 + 2 damping w s + w^2)``.

    Parameters
    ----------
    b : (b0, b1, b2)
        Gains of the numerator.
    frequency_khz, damping : float or casadi.SX
        ``w / (2 pi 1000)`` [kHz] and damping factor.
    """
    w = 2e3 * np.pi * frequency_khz
    # states w^2/den and w s/den; s^2/den = 1 - 2 damping (second) - (first)
    A = ca.blockcat([[ca.SX(1, 1), ca.SX(w)], [ca.SX(-w), ca.SX(-2 * damping * w)]])
    C = ca.horzcat(ca.SX(b[0] - b[2]), ca.SX(b[1] - 2 * damping * b[2]))
    return A, ca.vertcat(ca.SX(1, 1), ca.SX(w)), C, ca.SX(b[2])


def first_order(low: Any, high: Any, corner_khz: Any) -> System:
    """Return ``(high s + low w) / (s + w)``: the gain `low` at rest and `high` at high frequency.

    Parameters
    ----------
    low, high : float or casadi.SX
        Gains.
    corner_khz : float or casadi.SX
        ``w / (2 pi 1000)`` [kHz].
    """
    w = 2e3 * np.pi * corner_khz
    return ca.SX(-w), ca.SX(w), ca.SX(low - high), ca.SX(high)


def in_series(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the system whose input passes `first`, then `second`."""
    A, B, C, D = first
    a, b, c, d = second
    n, m = A.shape[0], a.shape[0]
    return ca.blockcat([[A, ca.SX(n, m)], [b @ C, a]]), ca.vertcat(B, b @ D), ca.horzcat(d @ C, c), d @ D


def in_parallel(first: Sequence[Any], second: Sequence[Any]) -> System:
    """Return the sum of two systems with one input."""
    A, B, C, D = first
    a, b, c, d = second
    return ca.diagcat(A, a), ca.vertcat(B, b), ca.horzcat(C, c), D + d
