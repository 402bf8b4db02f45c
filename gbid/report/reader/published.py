"""The paper's controller on its machine, and where the paper shows its loop."""

from __future__ import annotations

from gbid.control import p_controller
from gbid.errors import DataError
from gbid.lpv import LPVModel
from gbid.lpv.machine_data import ProportionalDesign
from gbid.structure import LinearModel

POINT = (6.0, 0.0)
"""Where the paper shows static map, controller and impacts: pressure [bar], speed [rpm]."""


def published_gains(machine: LPVModel) -> ProportionalDesign:
    """Return gains and low-pass that come with a machine.

    Raises
    ------
    DataError
        When none do.
    """
    if machine.controller is None:
        raise DataError(f"machine {machine.name!r} comes with no controller; add one to its model file")
    return machine.controller


def published_controller(machine: LPVModel) -> LinearModel:
    """Return the controller of `published_gains`."""
    d = published_gains(machine)
    return p_controller(d.kappa_x, d.kappa_y, d.lowpass_hz, d.lowpass_order)


def shown_point(model: LPVModel) -> tuple[float, float]:
    """Return the point at which the loop is shown: the paper's, or the first where the model does not hold there."""
    return POINT if model.domain.contains(*POINT) else model.operating_points[0]
