"""Models that `gbid export` finds, and the files that it writes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gbid.errors import DataError, GbidError, UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.run.job import Job
from gbid.experiment.stages.fit.plan import fit_models
from gbid.experiment.stages.fit.stage import load_made_fit
from gbid.identify import FitResult, load_fit
from gbid.interchange import Exportable, save_csv, save_mat, save_yaml
from gbid.lpv import LPVModel, load_model
from gbid.yaml_file import read_yaml

FOLDER = "export"
_N_FREQUENCIES = 400


@dataclass(frozen=True)
class Exports:
    """Models by the names of their files, the folder of the files, and reasons for models that are left out."""

    items: dict[str, Exportable]
    folder: Path
    left_out: tuple[str, ...] = ()


def find_exportable(source: str, at: tuple[float, float] | None, results: Path | None) -> Exports:
    """Return the models of an experiment, model file, model name or fit.

    Raises
    ------
    UsageError
        When the source is of no such kind, when `at` is given for another source than an LPV model, or when a file is
        faulty.
    DataError
        When the experiment has no models yet.
    """
    path = Path(source)
    if path.suffix in (".h5", ".hdf5"):
        _refuse_at(at, source)
        return Exports({_matlab_name(f"{path.parent.name}_{path.stem}"): load_fit(path)}, Path())
    if path.suffix in (".yaml", ".yml") and read_yaml(path).data.get("kind") != "lpv_model":
        _refuse_at(at, source)
        return _of_experiment(path, results)
    model = load_model(source)
    return Exports(_of_model(model, at), Path())


def write_files(what: Exportable, name: str, to: str, folder: Path, overwrite: bool) -> list[Path]:
    """Write one model and return the files; see `gbid.interchange`.

    Raises
    ------
    UsageError
        When a file exists and `overwrite` is not set.
    """
    if to == "mat":
        return save_mat(what, folder / f"{name}.mat", overwrite=overwrite)
    if to == "yaml":
        return [save_yaml(what, folder / f"{name}.yaml", overwrite=overwrite)]
    if isinstance(what, LPVModel):
        return [save_csv(what, folder / f"{name}_coefficients.csv", overwrite=overwrite)]
    model = what.model if isinstance(what, FitResult) else what
    written = [save_csv(model, folder / f"{name}_matrices.csv", overwrite=overwrite)]
    if isinstance(what, FitResult):
        written.append(save_csv(what, folder / f"{name}_parameters.csv", overwrite=overwrite))
    dt = what.sample_time if isinstance(what, FitResult) else model.dt
    top = 2500.0 if dt is None else 0.5 / dt
    frequency = np.geomspace(top / 2500.0, top, _N_FREQUENCIES)
    return [*written, save_csv(model, folder / f"{name}_response.csv", frequency_hz=frequency, overwrite=overwrite)]


def _of_model(model: LPVModel, at: tuple[float, float] | None) -> dict[str, Exportable]:
    name = _matlab_name(model.name)
    if at is None:
        return {name: model}
    point = _matlab_name(f"{name}_p{at[0]:g}_n{at[1]:g}")
    items: dict[str, Exportable] = {f"{point}_bearing": model.at(*at)}
    if model.actuators:
        items[f"{point}_plant"] = model.plant_at(*at)
    return items


def _of_experiment(path: Path, results: Path | None) -> Exports:
    job = Job(load_experiment(path, results))
    items: dict[str, Exportable] = {}
    left_out = []
    for fit in job.experiment.spec.fits:
        for model in fit_models(job.experiment, fit):
            try:
                items[_matlab_name(f"{fit}_{model}")] = load_made_fit(job, fit, model)
            except DataError as error:
                left_out.append(str(error))
    folder = job.experiment.results
    for file in sorted(folder.rglob("*.yaml")):
        if FOLDER in file.relative_to(folder).parts:
            continue
        try:
            if read_yaml(file).data.get("kind") == "lpv_model":
                items[_matlab_name(file.stem)] = load_model(file)
        except GbidError as error:
            left_out.append(str(error))
    if not items:
        reason = f": {left_out[0]}" if left_out else ""
        raise DataError(f"{path}: no models in {folder} yet{reason}; run `gbid run {path}` first")
    return Exports(items, folder / FOLDER, tuple(left_out))


def _refuse_at(at: tuple[float, float] | None, source: str) -> None:
    if at is not None:
        raise UsageError(f"--at is for an LPV model; {source} is none, so leave it out")


def _matlab_name(text: str) -> str:
    """Return a name that is also valid for a MATLAB function."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return (name if name[:1].isalpha() else f"m_{name}")[:50]
