"""Targets of `gbid export`: functions that write a model or controller, and their table `TARGETS`.

The command line, its help and its messages find the targets here. What a target needs is imported when it writes, so
that the help of the command line imports none of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gbid.core.errors import UsageError

if TYPE_CHECKING:
    from gbid.control import ControllerDesign
    from gbid.core.arrays import Point
    from gbid.export.chain import ChainOptions, Number
    from gbid.lpv import LPVFit
    from gbid.online.balance import BalanceWhileRunning
    from gbid.online.recursive import RecursiveFit
    from gbid.prefilter import RunoutMap

_N_FREQUENCIES = 400


@dataclass(frozen=True, eq=False)
class ExportItem:
    """Model, controller or recording that can be exported, with its name.

    Attributes
    ----------
    name : str
        Name of its files without ending: letters, digits and ``_``, a letter first; of a recording, that of its file.
    what : LinearModel, FitResult, LPVModel, ControllerDesign or Recording
        The value.
    maps : tuple of RunoutMap
        Run-out maps of the experiment, for a controller.
    options : ChainOptions, optional
        Limits, ramps, guards and watchdog, for a controller.
    fit : LPVFit, optional
        Fit of an LPV model, with its uncertainty.
    """

    name: str
    what: Any
    maps: tuple[RunoutMap, ...] = ()
    options: ChainOptions | None = None
    fit: LPVFit | None = None

    @property
    def kind(self) -> str:
        """Name of the type of the value."""
        return type(self.what).__name__


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """Request of the user to an export target: folder, overwriting, operating point, number type and mass.

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
    mass_kg : float, optional
        Modal mass, for targets in which a bearing has coefficients in N/m.
    balance : bool
        Whether generated source cancels unbalance.
    speeds_rpm : (float, float), optional
        Speeds at which it does.
    learn : tuple of str
        Parameters that generated source estimates while it runs.
    beside : tuple of ExportItem
        All items of the source, for a target that joins several of them, as a plant and its controller.
    """

    folder: Path
    overwrite: bool = False
    at: Point | None = None
    number: Number | None = None
    mass_kg: float | None = None
    balance: bool = False
    speeds_rpm: tuple[float, float] | None = None
    learn: tuple[str, ...] = ()
    beside: tuple[ExportItem, ...] = ()


@dataclass(frozen=True)
class ExportTarget:
    """Program or language to which models and controllers are exported.

    Attributes
    ----------
    write : callable
        From an item and the request to the paths of the files that it wrote. Raises UsageError and DataError.
    takes : tuple of str
        Types of values that it writes; other items of the source are passed over.
    """

    write: Callable[[ExportItem, ExportRequest], list[Path]]
    takes: tuple[str, ...] = ("LinearModel", "FitResult", "LPVModel", "ControllerDesign")


def export_target(name: str) -> ExportTarget:
    """Return the target of a name, from gbid or from an installed package.

    A package offers a target by an entry point of the group ``gbid.targets``, whose value is an `ExportTarget`.

    Raises
    ------
    UsageError
        When there is no such target, when the package fails on its import, or when it offers something else.
    """
    from gbid.core.extras import offered

    if name in TARGETS:
        return TARGETS[name]
    match offered("gbid.targets", name):
        case None:
            raise UsageError(f"--to {name}: no such target; choose from {', '.join(sorted(TARGETS))}")
        case ExportTarget() as target, _:
            return target
        case other, package:
            raise UsageError(f"--to {name}: {package} offers a {type(other).__name__}, no ExportTarget")


def write_c(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the control chain of a controller as C source; see `gbid.export.write_chain`.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, when the controller cannot run on a target, or when there is no
        run-out map at the chosen operating point.
    """
    from gbid.export.chain import SLOW_ROLL, ChainOptions, chain_of
    from gbid.export.chain_c import write_chain

    design = item.what
    options, maps = item.options or ChainOptions(), item.maps
    if request.number is not None:
        options = replace(options, number=request.number)
    if request.at is not None:
        design = replace(design, structure=None, models={None: design.at(*request.at)})
        maps = _maps_at(maps, request.at)
    balance = _balance_of(design, request) if request.balance else None
    if balance is not None and balance.speeds_rpm is not None:  # a map of slow roll holds at all speeds
        slow = [m for m in maps if 0 < m.conditions.get("speed_rpm", 0.0) <= SLOW_ROLL * balance.speeds_rpm[0]]
        maps = tuple(slow[:1]) or maps
    learn = _learn_of(design, request, options) if request.learn else None
    chain = chain_of(design, name=item.name, runout_maps=maps, options=options, balance=balance, learn=learn)
    return write_chain(chain, request.folder, overwrite=request.overwrite)


def _balance_of(design: ControllerDesign, request: ExportRequest) -> BalanceWhileRunning:
    """Return the cancellation of unbalance for a design, from the model for which it was made."""
    from gbid.control import exact_plant
    from gbid.online.balance import BalanceWhileRunning

    name, model = next(iter(_plants_of(design, request).items()))
    if request.at is not None and hasattr(model, "plant_at"):
        model = exact_plant(model, *request.at)
    elif fit := next((item.fit for item in request.beside if item.name == name and item.fit is not None), None):
        model = fit
    return BalanceWhileRunning(model, design, speeds_rpm=request.speeds_rpm)


def _learn_of(design: ControllerDesign, request: ExportRequest, options: ChainOptions) -> RecursiveFit:
    """Return the recursive estimates beside a design, from the fit for which it was made."""
    from gbid.identify import FitResult
    from gbid.online.recursive import RecursiveFit

    fits = {name: plant for name, plant in _plants_of(design, request).items() if isinstance(plant, FitResult)}
    if len(fits) != 1:
        raise UsageError(
            f"--learn: controller {design.name!r} was designed for {', '.join(fits) or 'no fit'}; tune it for one fit "
            "from r to p: fits: {NAME: {structure: plant, together: true, ...}}, controller: {...: {model: NAME, ...}}"
        )
    return RecursiveFit(
        next(iter(fits.values())),
        design,
        parameters=request.learn,
        forgetting_s=options.forgetting_s,
        memory_s=options.memory_s,
        dither=options.dither,
    )


def _maps_at(maps: tuple[RunoutMap, ...], at: Point) -> tuple[RunoutMap, ...]:
    from gbid.core.arrays import point_label
    from gbid.prefilter.runout import differing_condition

    conditions = {"pressure_bar": at[0], "speed_rpm": at[1]}
    chosen = tuple(each for each in maps if differing_condition(each.conditions, conditions) is None)
    if maps and not chosen:
        points = ", ".join(
            point_label(each.conditions.get("pressure_bar", 0.0), each.conditions.get("speed_rpm", 0.0))
            for each in maps
        )
        raise UsageError(
            f"--at {at[0]:g} {at[1]:g}: no run-out map at this operating point; there are maps at {points}"
        )
    return chosen


def write_tables(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write CSV tables of matrices, parameters, coefficients and frequency responses.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    import numpy as np

    from gbid.export.tables import save_csv

    def save(name: str, what: Any, **options: Any) -> Path:
        return save_csv(what, request.folder / f"{name}.csv", overwrite=request.overwrite, **options)

    if item.kind == "LPVModel":
        return [save(f"{item.name}_coefficients", item.what)]
    files = [save(f"{item.name}_parameters", item.what)] if item.kind == "FitResult" else []
    for name, value in _models(item, request).items():
        model = getattr(value, "linear_model", value)
        dt = getattr(value, "sample_time", None) or model.dt
        top = 0.5 / dt if dt is not None and np.isfinite(dt) else 2500.0
        frequency = np.geomspace(top / 2500.0, top, _N_FREQUENCIES)
        files += [save(f"{name}_matrices", model), save(f"{name}_response", model, frequency_hz=frequency)]
    return files


def write_models(item: ExportItem, request: ExportRequest, ending: str) -> list[Path]:
    """Write models as mat files or as plain YAML.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    from gbid.export.matlab import save_mat
    from gbid.export.tables import save_yaml

    save = {".mat": save_mat, ".yaml": save_yaml}[ending]
    models = _models(item, request).items()
    return [save(model, request.folder / f"{name}{ending}", overwrite=request.overwrite) for name, model in models]


def _models(item: ExportItem, request: ExportRequest) -> dict[str, Any]:
    """Return the models of an item by name; for a controller sampled models, at the chosen or at all stored points."""
    design = item.what
    if item.kind != "ControllerDesign":
        return {item.name: item.what}
    points = [point for point in design.models if point is not None]
    if not points:
        return {item.name: design.sampled_at()}
    if request.at is not None:
        points = [request.at]
    names = (f"{item.name}_p{p:g}_n{s:g}".replace(".", "_").replace("-", "_") for p, s in points)
    return {name: design.sampled_at(p, s) for name, (p, s) in zip(names, points, strict=True)}


def write_unit(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write the co-simulation unit (FMI 2.0) of a plant, or of a controller with its plant.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, when the plant of a controller is not found, or when a unit
        cannot be made.
    """
    from gbid.export.fmu import save_fmu

    what = item.what
    if item.kind == "ControllerDesign":
        plants = _plants_of(what, request)
        known = {"inputs": what.provenance.get("drives"), "outputs": what.provenance.get("measures")}
        channels = {key: names.split(", ") for key, names in known.items() if isinstance(names, str)}
        limits = None if item.options is None else item.options.limits
        options: dict[str, Any] = {"controller": what, "limits": limits, "overwrite": request.overwrite, **channels}
        names = [f"{item.name}_{name}" if len(plants) > 1 else item.name for name in plants]
        paths = [request.folder / f"{name}_loop.fmu" for name in names]
        return [save_fmu(plant, path, **options) for plant, path in zip(plants.values(), paths, strict=True)]
    if item.kind == "FitResult" and len(request.beside) > 1 and what.linear_model.dt is not None:
        return []  # the loop of a sampled controller is no plant
    return [save_fmu(what, request.folder / f"{item.name}.fmu", overwrite=request.overwrite)]


def _plants_of(design: ControllerDesign, request: ExportRequest) -> dict[str, Any]:
    """Return the models for which a controller was designed, by name: from the request, or a model of gbid."""
    from gbid.lpv.model_file import load_model

    plants = [item for item in request.beside if item.kind != "ControllerDesign"]
    for chosen in (
        [item for item in plants if design.plant in (item.name, getattr(item.what, "name", None))][:1],
        [item for item in plants if item.kind == "FitResult" and item.name.startswith(f"{design.plant}_")],
    ):
        if chosen:
            return {item.name: item.what for item in chosen}
    try:
        return {design.plant: load_model(design.plant)}
    except UsageError as error:
        raise UsageError(
            f"the plant {design.plant!r} of controller {design.name!r} is not among what is exported: {error}"
        ) from None


def write_elements(item: ExportItem, request: ExportRequest) -> list[Path]:
    """Write bearing elements of ROSS over speed as TOML, one file for each injection pressure.

    Raises
    ------
    UsageError
        When no mass is given, when ROSS is not installed, or when a file exists and `overwrite` is not set.
    """
    from gbid.core.files import atomic_path
    from gbid.export.ross import bearing_element

    model = item.what
    if request.mass_kg is None:
        raise UsageError(f"model {model.name!r} is per unit mass, ROSS needs N/m: give the modal mass with --mass KG")
    identified = sorted({pressure for pressure, _ in model.operating_points})
    files = []
    for pressure in identified or sorted(set(model.domain.pressure_bar)):
        name = f"{item.name}_p{pressure:g}"
        element = bearing_element(model, 0, mass_kg=request.mass_kg, pressure_bar=pressure, tag=name)
        path = request.folder / f"{name}.toml"
        with atomic_path(path, request.overwrite) as part:
            written = part.with_suffix(".toml")  # ROSS takes the format from the ending
            element.save(written)
            written.replace(part)
        files.append(path)
    return files


def write_data(item: ExportItem, request: ExportRequest, ending: str) -> list[Path]:
    """Write a recording as a file for another program; see `gbid.export.save_data`.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set, or the format cannot hold the recording.
    """
    from gbid.export.data_files import save_data

    return [save_data(item.what, request.folder / f"{item.name}{ending}", overwrite=request.overwrite)]


TARGETS = {
    "c": ExportTarget(write_c, ("ControllerDesign",)),
    "csv": ExportTarget(write_tables),
    "fmu": ExportTarget(write_unit),
    "matlab": ExportTarget(partial(write_models, ending=".mat")),
    "mdf": ExportTarget(partial(write_data, ending=".mf4"), ("Recording",)),
    "parquet": ExportTarget(partial(write_data, ending=".parquet"), ("Recording",)),
    "ross": ExportTarget(write_elements, ("LPVModel",)),
    "universal": ExportTarget(partial(write_data, ending=".unv"), ("Recording",)),
    "yaml": ExportTarget(partial(write_models, ending=".yaml")),
}
"""Targets by the word after ``gbid export --to``."""
