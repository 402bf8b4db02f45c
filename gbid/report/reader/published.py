"""Controller of the paper on its machine, and the operating point of its figures."""

from __future__ import annotations

from gbid.control import p_controller
from gbid.errors import DataError
from gbid.lpv import LPVModel
from gbid.lpv.machine_data import ProportionalDesign
from gbid.structure import LinearModel

POINT = (6.0, 0.0)
"""Operating point of static map, controller and impacts in the paper: pressure [bar], speed [rpm]."""


def published_gains(machine: LPVModel) -> ProportionalDesign:
    """Return the published gains and low-pass of a machine.

    Raises
    ------
    DataError
        When the machine has none.
    """
    if machine.controller is None:
        raise DataError(f"machine {machine.name!r} comes with no controller; add one to its model file")
    return machine.controller


def published_controller(machine: LPVModel) -> LinearModel:
    """Return the controller of `published_gains`."""
    d = published_gains(machine)
    return p_controller(d.kappa_x, d.kappa_y, d.lowpass_hz, d.lowpass_order)


def shown_point(model: LPVModel) -> tuple[float, float]:
    """Return the operating point for pictures of the loop: that of the paper if inside the domain, else the first."""
    return POINT if model.domain.contains(*POINT) else model.operating_points[0]
