"""Export of models and controllers of an experiment or file, as `gbid export` does."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from gbid.control import ControllerDesign
from gbid.control.controllers.file import load_controller
from gbid.core.arrays import Point
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.files import atomic_set
from gbid.core.names import file_stem
from gbid.core.yaml_file import read_yaml
from gbid.experiment.controllers import TUNED, chain_options, design_structure
from gbid.experiment.experiment import Experiment, fit_models
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.experiment.stages.fit import load_made_fit
from gbid.experiment.stages.prefilter import MAP_FOLDER
from gbid.export.targets import ExportItem, ExportRequest, export_target
from gbid.identify import FitResult
from gbid.lpv import LPVFit, LPVModel
from gbid.lpv.model_file import load_model
from gbid.prefilter import RunoutMap
from gbid.prefilter.filtering import PrefilterFile
from gbid.recording import Recording
from gbid.stored import load

FOLDER = "export"
_LONGEST = 50  # characters of a name in C and MATLAB, with room for what is added to it


@dataclass(frozen=True, eq=False)
class Exports:
    """Models, controllers and recordings of a source that can be exported.

    Attributes
    ----------
    source : str
        The source as given.
    items : tuple of ExportItem
        Models and controllers.
    folder : pathlib.Path
        Folder of the files when the user names none.
    left_out : tuple of str
        Reason for each item that could not be read.
    notes : tuple of str
        What a user should know about the files that were read.
    """

    source: str
    items: tuple[ExportItem, ...]
    folder: Path
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def find_exports(
    source: str, at: Point | None = None, results: Path | None = None, announce: Callable[[str], None] | None = None
) -> Exports:
    """Return the models and controllers of an experiment, model file, controller file or fit.

    Parameters
    ----------
    source : str
        An experiment YAML, a model YAML or name, a controller YAML, a fit or a recording in .h5, or a folder of these.
    at : (pressure_bar, speed_rpm), optional
        Operating point. LPV models give their linear models there.
    results : path, optional
        Folder of the results of an experiment, instead of the one in its YAML.
    announce : callable, optional
        See `gbid.experiment.load.load_experiment`.

    Returns
    -------
    Exports

    Raises
    ------
    UsageError
        When the source is of no such kind, when `at` is given for a fit, or when a file is faulty.
    DataError
        When the experiment has no models and no controllers yet.
    """
    path = Path(source)
    if at is not None and (path.is_dir() or path.suffix in (".h5", ".hdf5")):
        raise UsageError(f"--at is for LPV models and controllers, not for {source}; leave it out")
    if path.is_dir():
        items, left_out = [], []
        for file in sorted(path.glob("*.h5")):
            try:
                items.append(_stored(file))
            except GbidError as error:
                left_out.append(str(error))
        if not items:
            raise DataError(f"{source}: no recordings and no fits (.h5) in this folder")
        return Exports(source, _apart(items), Path(), tuple(left_out))
    if path.suffix in (".h5", ".hdf5"):
        return Exports(source, (_stored(path),), Path())
    if path.suffix in (".yaml", ".yml"):
        kind = read_yaml(path).data.get("kind")
        if kind == "controller":
            design = load_controller(path)
            return Exports(source, (ExportItem(_controller_name(design), design),), Path(), notes=design.notes)
        if kind != "lpv_model":
            return _of_experiment(load_experiment(path, results, announce=announce), at)
    model = load_model(source)
    return Exports(source, _of_model(identifier(model.name), model, at), Path(), notes=model.notes)


def _stored(path: Path) -> ExportItem:
    """Return the recording or the fit in a file; a recording gets the name of its file."""
    value = load(path)
    if not isinstance(value, FitResult | Recording):
        raise UsageError(f"{path}: a {type(value).__name__} is not exported; give a fit or a recording")
    is_fit = isinstance(value, FitResult)
    return ExportItem(identifier(f"{path.parent.name}_{path.stem}") if is_fit else path.stem, value)


def identifier(text: str) -> str:
    """Return a name that is valid as a C identifier and as the name of a MATLAB function."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return file_stem(name if name[:1].isalpha() else f"m_{name}", _LONGEST, "_")


def _of_model(name: str, model: LPVModel, at: Point | None) -> tuple[ExportItem, ...]:
    if at is None:
        return (ExportItem(name, model),)
    point = identifier(f"{name}_p{at[0]:g}_n{at[1]:g}")
    bearing = ExportItem(f"{point}_bearing", model.at(*at))
    return (bearing, ExportItem(f"{point}_plant", model.plant_at(*at))) if model.actuators else (bearing,)


def _controller_name(design: ControllerDesign) -> str:
    return identifier(f"controller_{design.name}")


def _of_experiment(experiment: Experiment, at: Point | None) -> Exports:
    job, path, folder = Job(experiment), experiment.file.path, experiment.results
    items: list[ExportItem] = []
    left_out = []
    for fit in job.experiment.spec.fits:
        for model in fit_models(job.experiment, fit):
            try:
                items.append(ExportItem(identifier(f"{fit}_{model}"), load_made_fit(job, fit, model)))
            except DataError as error:
                left_out.append(str(error))
    for file in sorted(folder.rglob("*.yaml")):
        if FOLDER in file.relative_to(folder).parts:
            continue
        try:
            if read_yaml(file).data.get("kind") == "lpv_model":
                name = "_".join(part for part in file.relative_to(folder).with_suffix("").parts if part != "lpv")
                stored = load(beside) if (beside := file.with_suffix(".h5")).is_file() else None
                lpv_fit, of_model = stored if isinstance(stored, LPVFit) else None, load_model(file)
                items += [replace(item, fit=lpv_fit) for item in _of_model(identifier(name), of_model, at)]
        except GbidError as error:
            left_out.append(str(error))
    notes = [note for item in items if isinstance(item.what, LPVModel) for note in item.what.notes]
    maps, options = made_maps(job), chain_options(job.experiment)
    for name in job.experiment.spec.controller:
        try:
            design = _tuned(job, name)
            items.append(ExportItem(_controller_name(design), design, maps, options))
            notes += design.notes
        except GbidError as error:
            left_out.append(str(error))
    if not items:
        reason = f": {left_out[0]}" if left_out else ""
        raise DataError(f"{path}: no models and no controllers in {folder} yet{reason}; run `gbid run {path}` first")
    return Exports(str(path), _apart(items), folder / FOLDER, tuple(left_out), tuple(notes))


def _apart(items: Iterable[ExportItem]) -> tuple[ExportItem, ...]:
    """Return items with unique names; repeated names get numbers."""
    named: dict[str, ExportItem] = {}
    for item in items:
        names = (item.name, *(f"{item.name}_{count}" for count in range(2, len(named) + 3)))
        name = next(name for name in names if name.lower() not in named)  # some file systems do not tell capitals
        named[name.lower()] = replace(item, name=name)
    return tuple(named.values())


def _tuned(job: Job, name: str) -> ControllerDesign:
    """Return a tuned design of the experiment; a user-defined structure is loaded from its file."""
    path, section = job.path(TUNED, name, ending=".yaml"), job.experiment.spec.controller[name]
    if not path.is_file():
        raise DataError(f"{path}: file is missing; `gbid tune` makes it")
    is_own = ":" in section.structure and section.schedule is None
    return load_controller(path, design_structure(job.experiment, section) if is_own else None)


def made_maps(job: Job) -> tuple[RunoutMap, ...]:
    """Return the run-out maps stored by the prefilter, one for each operating point."""
    points = job.experiment.points if job.experiment.spec.prefilter is not None else ()
    paths = [path for point in points if (path := job.path(MAP_FOLDER, point)).is_file()]
    maps = [load(path, PrefilterFile).runout_map for path in paths]
    return tuple(runout_map for runout_map in maps if runout_map is not None)


_WORDS = {
    "ControllerDesign": "controllers",
    "LPVModel": "LPV models",
    "FitResult": "fits",
    "LinearModel": "linear models",
    "Recording": "recordings",
}


def write_exports(exports: Exports, to: str, request: ExportRequest) -> list[Path]:
    """Write the files of a target, all or none, and return their paths.

    The files are written into a folder beside and renamed at the end, see `gbid.core.files.atomic_set`.

    Parameters
    ----------
    exports : Exports
        Models and controllers, from `find_exports`.
    to : str
        Name of the target, one of `gbid.export.targets.TARGETS`.
    request : ExportRequest
        Folder and options.

    Returns
    -------
    list of pathlib.Path
        The files.

    Raises
    ------
    UsageError
        When there is no such target, when it takes nothing of what was found, or when a file exists with other
        contents and `overwrite` is not set.
    DataError
        When a file cannot be written.
    """
    target = export_target(to)
    items = [item for item in exports.items if item.kind in target.takes]
    if not items:
        takes = ", ".join(_WORDS[kind] for kind in target.takes)
        kinds = ", ".join(dict.fromkeys(_WORDS[item.kind] for item in exports.items))
        hint = "give a recording (.h5) or a folder of them" if "Recording" in target.takes else "choose another target"
        raise UsageError(f"{exports.source}: --to {to} takes {takes}; here are only {kinds}: {hint}")
    with atomic_set(request.folder, request.overwrite) as stage:
        staged = replace(request, folder=stage, beside=exports.items)
        files = [path for item in items for path in target.write(item, staged)]
    return [request.folder / path.relative_to(stage) for path in files]
