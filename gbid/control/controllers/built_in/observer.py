"""State feedback from an observer of fixed order per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from gbid.control.controllers.parts import AxisGain, PerAxis, in_series, inside


@dataclass(frozen=True)
class ObserverStructure(PerAxis):
    r"""State feedback from an observer that models one mode per axis.

    .. math:: \dot{\hat x} = \omega \begin{pmatrix} 0 & 1 \\ -1 & -2 \zeta_m \end{pmatrix} \hat x
              + \omega \begin{pmatrix} 0 \\ 1 \end{pmatrix} r
              + \omega \begin{pmatrix} l_1 \\ l_2 \end{pmatrix} (p - \hat x_1), \quad
              r = f_1 \hat x_1 + f_2 \hat x_2

    The states are position and velocity over omega. The gains per axis are ``l1``, ``l2`` of the observer, ``f1``,
    ``f2`` of the feedback [m/m], and ``frequency`` of the modelled mode [kHz]. Observer and feedback alone are stable
    within the bounds.

    Parameters
    ----------
    observer_limit, feedback_limit : float
        Bounds on l (from 0) and on the magnitude of f.
    frequency_khz : (lowest, highest)
        Bounds of the frequency of the mode [kHz].
    model_damping : float
        Damping factor of the modelled mode.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    """

    order: int = 0
    observer_limit: float = 8.0
    feedback_limit: float = 3.0
    frequency_khz: tuple[float, float] = (0.02, 1.0)
    model_damping: float = 0.1
    name: str = "observer"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive(
            observer_limit=self.observer_limit, feedback_limit=self.feedback_limit, model_damping=self.model_damping
        )
        self._check_ranges("frequency_khz")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        top, limit = self.observer_limit, self.feedback_limit
        return (
            AxisGain("l1", inside(1.0, (0.0, top)), 0.0, top, ""),
            AxisGain("l2", inside(0.5, (-1.0, top)), -1.0, top, ""),
            AxisGain("f1", 0.0, -limit, limit, "m/m"),
            AxisGain("f2", 0.0, -limit, limit, "m/m"),
            AxisGain("frequency", inside(0.12, self.frequency_khz), *self.frequency_khz, "kHz"),
        )

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        w = 2e3 * np.pi * gain["frequency"]
        l1, l2, f1, f2 = (gain[name] for name in ("l1", "l2", "f1", "f2"))
        A = ca.blockcat([[ca.SX(-w * l1), ca.SX(w)], [w * (f1 - 1 - l2), w * (f2 - 2 * self.model_damping)]])
        own = A, ca.vertcat(ca.SX(w * l1), ca.SX(w * l2)), ca.horzcat(ca.SX(f1), ca.SX(f2)), ca.SX(1, 1)
        return in_series(lowpass, own)
