"""Low-pass filter in series with each axis of a controller (paper, Eq. 21)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from gbid.arrays import is_finite, is_whole
from gbid.errors import UsageError


@dataclass(frozen=True)
class Lowpass:
    """Low-pass filter ``(p_lp / (s + p_lp))^n`` as a chain of first-order lags.

    Parameters
    ----------
    corner_hz : float or casadi.SX
        Corner frequency ``p_lp / 2 pi`` [Hz].
    order : int
        Order n; 0 for none.
    """

    corner_hz: Any = 1000.0
    order: int = 1

    def check(self, where: str) -> None:
        """Refuse a corner frequency that is not positive, and an order that is not a whole number of at least 0.

        Raises
        ------
        UsageError
            When one of them is wrong.
        """
        if not (is_finite(self.corner_hz) and self.corner_hz > 0):
            raise UsageError(f"{where}: lowpass_hz = {self.corner_hz!r}; give a positive number of Hz")
        if not is_whole(self.order, 0):
            raise UsageError(f"{where}: order = {self.order}; it must be a whole number, at least 0")

    def matrices(self) -> tuple[Any, Any, Any, Any]:
        """Return A (n, n), B (n, 1), C (1, n), D (1, 1) as casadi.SX."""
        n, corner = self.order, 2 * np.pi * self.corner_hz
        chain = ca.sparsify(
            ca.SX(ca.DM(np.eye(n, k=-1) - np.eye(n)))
        )  # the output of each stage is the input of the next
        first, last = ca.SX(n, 1), ca.SX(1, n)
        if n:
            first[0], last[n - 1] = corner, 1.0
        return corner * chain, first, last, ca.SX(1, 1) if n else ca.SX(1)
