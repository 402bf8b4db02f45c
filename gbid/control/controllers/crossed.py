"""Full controllers with cross-coupling: every output from the filters of all inputs."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import casadi as ca

from gbid.control.controllers.lowpass import Lowpass
from gbid.control.controllers.per_axis import AxisGain, PerAxis, gain_name
from gbid.structure import Parameter
from gbid.structure.parameter import Values


@dataclass(frozen=True)
class Crossed(PerAxis):
    """Base class of the full structures: the filter of each input drives the references of all axes.

    `_axis_gains` are those of an input, once for each axis: ``frequency_x``. `_crossed_gains` are those from an input
    to an output, output first: ``kappa_xy`` goes from p_y to r_x.
    """

    @abstractmethod
    def _crossed_gains(self) -> tuple[AxisGain, ...]:
        """Return the gains from an input to an output."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gains from inputs to outputs, then those of the inputs; the corner frequency is last when it is tuned."""
        pairs = [f"{to}{of}" for to in self.axes for of in self.axes]
        crossed = [
            Parameter(f"{gain.name}_{pair}", gain.start, gain.lower, gain.upper, unit=gain.unit)
            for gain in self._crossed_gains()
            for pair in pairs
        ]
        return (*crossed, *super().parameters)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return A, B, C and D for gains by name."""
        corner = p["lowpass_khz"] * 1e3 if self.tune_corner else self.lowpass_hz
        lowpass = Lowpass(corner, self.order).matrices()
        columns = []
        for of in self.axes:
            own = {gain.name: p[gain_name(gain.name, of)] for gain in self._axis_gains()}
            # the filters to all outputs have equal A and B
            rows = [
                self._filter({**own, **{g.name: p[f"{g.name}_{to}{of}"] for g in self._crossed_gains()}}, lowpass)
                for to in self.axes
            ]
            columns.append(
                (rows[0][0], rows[0][1], ca.vertcat(*(r[2] for r in rows)), ca.vertcat(*(r[3] for r in rows)))
            )
        A, B = (ca.diagcat(*(column[i] for column in columns)) for i in (0, 1))
        C, D = (ca.horzcat(*(column[i] for column in columns)) for i in (2, 3))
        return {"A": A, "B": B, "C": C, "D": D}
