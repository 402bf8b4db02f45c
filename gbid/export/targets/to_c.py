"""Export of controllers as C source: the whole chain from the sensors to the piezo stacks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gbid.control import ControllerDesign
from gbid.core.arrays import point_label
from gbid.core.errors import UsageError
from gbid.export.chain import chain_of
from gbid.export.chain_c import write_chain
from gbid.export.target import ExportItem, ExportRequest, ExportTarget, Point
from gbid.prefilter import RunoutMap
from gbid.prefilter.runout import differing_condition


def write_c(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the chain of a controller, and return the files; see `gbid.export.write_chain`.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, when the controller cannot run on a target, or when there is no
        run-out map at the chosen operating point.
    """
    design, around = item.what, item.surroundings
    assert isinstance(design, ControllerDesign)
    options = around.options if request.number is None else replace(around.options, number=request.number)
    maps = around.maps
    if request.at is not None:
        design = replace(design, structure=None, models={None: design.at(*request.at)})
        maps = _maps_at(maps, request.at)
    chain = chain_of(design, name=item.name, runout_maps=maps, options=options)
    return write_chain(chain, request.folder, measure=request.measure, overwrite=request.overwrite)


def _maps_at(maps: tuple[RunoutMap, ...], at: Point) -> tuple[RunoutMap, ...]:
    wanted = {"pressure_bar": at[0], "speed_rpm": at[1]}
    found = tuple(each for each in maps if differing_condition(each.conditions, wanted) is None)
    if maps and not found:
        there = ", ".join(
            point_label(each.conditions.get("pressure_bar", 0.0), each.conditions.get("speed_rpm", 0.0))
            for each in maps
        )
        raise UsageError(f"--at {at[0]:g} {at[1]:g}: no run-out map at this operating point; there are maps at {there}")
    return found


TARGET = ExportTarget("controllers as C source, with filters, limits and watchdog", (ControllerDesign,), write_c)
