"""Sampled controllers of a design by the names of their files, one for each operating point of a schedule."""

from __future__ import annotations

from gbid.control import ControllerDesign
from gbid.exporters.export_target import Point
from gbid.structure import LinearModel


def controller_models(name: str, design: ControllerDesign, at: Point | None) -> dict[str, LinearModel]:
    """Return the sampled controllers of a design by name.

    Parameters
    ----------
    name : str
        Name of the item.
    design : ControllerDesign
        The design.
    at : (pressure_bar, speed_rpm), optional
        Operating point; by default those that the controller file holds. A controller without schedule ignores it.

    Returns
    -------
    dict of str to LinearModel
    """
    points = [point for point in design.models if point is not None]
    if not points:
        return {name: design.sampled_at()}
    chosen = points if at is None else [at]
    return {f"{name}_p{p:g}_n{s:g}".replace(".", "_").replace("-", "_"): design.sampled_at(p, s) for p, s in chosen}
