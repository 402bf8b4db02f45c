"""Filter of any order: a product of second-order sections per axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gbid.control.controllers.parts import AxisGain, PerAxis, first_order, in_series, inside, second_order
from gbid.core.errors import UsageError


@dataclass(frozen=True)
class FilterStructure(PerAxis):
    r"""Filter of order n per axis, as a product of second-order sections.

    .. math:: K_i(s) = \prod_k \frac{b_{2,k} s^2 + b_{1,k} \omega_k s + b_{0,k} \omega_k^2}
                                    {s^2 + 2 \zeta_k \omega_k s + \omega_k^2}

    Numerators are scaled by the frequency of their section, so that all gains are of order one. ``b0`` of the first
    section is the static gain, that of the others is 1. At the start they are 1 at all frequencies. An odd order adds a
    section ``(c s + omega) / (s + omega)``. The gains of section k end in ``k``: ``b0_1_x``, ``frequency_2_y`` [kHz].

    Parameters
    ----------
    filter_order : int
        Order n per axis, 1 to 8.
    gain_limit : float
        Bound on the magnitude of the numerators' gains [m/m].
    frequency_khz, damping : (lowest, highest)
        Bounds of frequency [kHz] and damping factor of each section, which keep it stable.
    lowpass_hz, order, tune_corner, axes
        As in `PStructure`; by default there is no low-pass.
    """

    order: int = 0
    filter_order: int = 4
    gain_limit: float = 5.0
    frequency_khz: tuple[float, float] = (0.02, 1.5)
    damping: tuple[float, float] = (0.05, 3.0)
    name: str = "filter"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.filter_order, int) or not 1 <= self.filter_order <= 8:
            raise UsageError(f"controller 'filter': filter_order = {self.filter_order}; give a whole number, 1 to 8")
        self._check_positive(gain_limit=self.gain_limit)
        self._check_ranges("frequency_khz", "damping")

    def _axis_gains(self) -> tuple[AxisGain, ...]:
        limit, gains, khz = self.gain_limit, [], self.frequency_khz
        for k in range(1, self.filter_order // 2 + 1):
            zeta = inside(0.7, self.damping)
            first = k == 1
            if first:
                gains.append(AxisGain("b0_1", 0.0, -limit, limit, "m/m"))
            gains += [
                AxisGain(f"b1_{k}", 0.0 if first else inside(2 * zeta, (-limit, limit)), -limit, limit, "m/m"),
                AxisGain(f"b2_{k}", 0.0 if first else inside(1.0, (-limit, limit)), -limit, limit, "m/m"),
                AxisGain(f"frequency_{k}", inside(0.15 * 1.6 ** (k - 1), khz), *khz, "kHz"),
                AxisGain(f"damping_{k}", zeta, *self.damping, ""),
            ]
        if self.filter_order % 2:
            alone = self.filter_order == 1
            if alone:
                gains.append(AxisGain("b0_1", 0.0, -limit, limit, "m/m"))
            gains += [
                AxisGain("c", 0.0 if alone else 1.0, -limit, limit, "m/m"),
                AxisGain("corner", inside(0.3, self.frequency_khz), *self.frequency_khz, "kHz"),
            ]
        return tuple(gains)

    def _filter(self, gain: Mapping[str, Any], lowpass: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        found: tuple[Any, ...] = lowpass
        for k in range(1, self.filter_order // 2 + 1):
            b = [gain["b0_1"] if k == 1 else 1.0, gain[f"b1_{k}"], gain[f"b2_{k}"]]
            found = in_series(found, second_order(b, gain[f"frequency_{k}"], gain[f"damping_{k}"]))
        if self.filter_order % 2:
            still = gain["b0_1"] if self.filter_order == 1 else 1.0
            found = in_series(found, first_order(still, gain["c"], gain["corner"]))
        A, B, C, D = found
        return A, B, C, D
