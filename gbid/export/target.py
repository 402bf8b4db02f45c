"""Sampled controllers of a design by the names of their files, one for each operating point of a schedule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from gbid.control import ControllerDesign
from gbid.export.chain import ChainOptions, Number
from gbid.export.matlab import Exportable
from gbid.prefilter import RunoutMap
from gbid.structure import LinearModel

# ---- Export target: what a writer of files for another program consists of.

Point = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a controller needs around it on a target.

    Attributes
    ----------
    maps : tuple of RunoutMap
        Run-out maps of the experiment.
    options : ChainOptions
        Limits, ramps, guards and watchdog.
    """

    maps: tuple[RunoutMap, ...] = ()
    options: ChainOptions = field(default_factory=ChainOptions)


@dataclass(frozen=True, eq=False)
class ExportItem:
    """One thing that can be exported.

    Attributes
    ----------
    name : str
        Name of its files without ending: letters, digits and ``_``, a letter first.
    what : LinearModel, FitResult, LPVModel or ControllerDesign
        The value.
    surroundings : Surroundings
        What a controller needs around it; empty for models.
    """

    name: str
    what: Exportable | ControllerDesign
    surroundings: Surroundings = field(default_factory=Surroundings)


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """What the user asked for.

    Attributes
    ----------
    folder : pathlib.Path
        Folder of the files.
    overwrite : bool
        Whether existing files may be replaced.
    at : (pressure_bar, speed_rpm), optional
        Operating point.
    number : {"double", "float"}, optional
        Type of the numbers in generated source, instead of that in the experiment.
    measure : bool
        Whether generated source is run on an emulated microcontroller to count its instructions.
    mass_kg : float, optional
        Modal mass, for targets in which a bearing has coefficients in N/m.
    beside : tuple of ExportItem
        All items of the source, for a target that joins several of them, as a plant and its controller.
    """

    folder: Path
    overwrite: bool = False
    at: Point | None = None
    number: Number | None = None
    measure: bool = False
    mass_kg: float | None = None
    beside: tuple[ExportItem, ...] = field(default=())


@dataclass(frozen=True)
class ExportTarget:
    """A program or language that models and controllers are exported to.

    Attributes
    ----------
    about : str
        What the files are, for the help of the command line.
    takes : tuple of type
        Types of values that it writes; other items of the source are passed over.
    write : callable
        From an item and the request to the paths of the files that it wrote. Raises UsageError and DataError.
    """

    about: str
    takes: tuple[type, ...]
    write: Callable[[ExportItem, ExportRequest], list[Path]]


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
