"""Fit results in HDF5. The tree is documented in docs/file-formats.md."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid import hdf5
from gbid.errors import DataError
from gbid.identify.options import FitOptions
from gbid.identify.result import FitResult, StartsTried
from gbid.identify.status import FitStatus
from gbid.structure import LinearModel

KIND = "fit"
_TEXT = h5py.string_dtype()


def save_fit(result: FitResult, path: str | Path, overwrite: bool = False, key: str = "") -> None:
    """Write a fit result to an HDF5 file.

    Parameters
    ----------
    result : FitResult
    path : path
        The file; missing folders are made.
    overwrite : bool
        Whether an existing file may be replaced.
    key : str
        What the result was made from, as a caller may want to know it again.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    with hdf5.writing(path, KIND, overwrite) as file:
        attributes = {
            "key": key,
            "structure": result.structure,
            "status": str(result.status),
            "success": result.success,
            "iterations": result.iterations,
            "options": json.dumps(asdict(result.options)),
            "trusted": result.trusted,
            "local_names": json.dumps({name: dict(own) for name, own in result.local_names.items()}),
            "multi_start": json.dumps(result.multi_start and asdict(result.multi_start)),
        }
        file.attrs.update(attributes)
        for name, texts in (("recordings", result.recordings), ("notes", result.notes)):
            file.attrs.create(name, list(texts), shape=(len(texts),), dtype=_TEXT)
        scalars = (
            ("loss", result.loss, "", "criterion at the estimate"),
            ("wall_time_s", result.wall_time_s, "s", "time that the fit took"),
            ("sample_time", result.sample_time, "s", "time between samples"),
            ("fit_percent", result.fit_percent, "%", "fit, recordings by outputs"),
            ("error_covariance", result.error_covariance, "", "mean square of the errors"),
            ("initial_states", result.initial_states, "", "initial state of each recording"),
            ("whiteness", result.whiteness, "", "probability of less white residuals, per output"),
            ("modes_std", result.modes_std, "Hz and 1", "standard deviations of natural frequency and damping"),
            ("static_gain_std", result.static_gain_std, "", "standard deviations of the static gain"),
            ("aic", result.aic, "", "Akaike's information criterion"),
            ("fpe", result.fpe, "", "final prediction error"),
            ("condition", result.condition, "", "condition of the scaled information"),
        )
        for name, values, unit, long_name in scalars:
            hdf5.add_dataset(file, name, values, unit, long_name)
        _write_parameters(file.create_group("parameters"), result)
        _write_model(file.create_group("model"), result.model)


def load_fit(path: str | Path) -> FitResult:
    """Read a fit result from an HDF5 file.

    Parameters
    ----------
    path : path

    Returns
    -------
    FitResult

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete or of another kind.
    """
    with hdf5.reading(path, KIND) as file:
        try:
            return _read_result(file)
        except DataError:
            raise
        except (TypeError, ValueError) as error:
            raise DataError(
                f"{path}: damaged fit file, its entries do not fit together ({error}); make the fit anew"
            ) from None


def _read_result(file: h5py.File) -> FitResult:
    parameters = file["parameters"]
    names = _texts(parameters, "names")
    numbers = {
        column: dict(zip(names, hdf5.read_dataset(parameters, column).tolist(), strict=True))
        for column in ("estimate", "std", "start")
    }
    attribute = hdf5.read_attribute
    trusted = str(attribute(file, "trusted"))
    model = _read_model(file["model"])
    free = _texts(parameters, "free")
    local_names = json.loads(str(attribute(file, "local_names")))
    options = json.loads(str(attribute(file, "options")))
    if isinstance(options["inputs"], str):
        options, tried = _from_0_1_0(options, model, free, local_names)
    else:
        tried = json.loads(str(attribute(file, "multi_start")))
    found: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in options.items()}
    return FitResult(
        structure=str(attribute(file, "structure")),
        recordings=_texts(file, "recordings"),
        parameters=numbers["estimate"],
        std=numbers["std"],
        units=dict(zip(names, _texts(parameters, "units"), strict=True)),
        free=free,
        covariance=hdf5.read_dataset(parameters, f"covariance_{trusted}"),
        covariance_white=hdf5.read_dataset(parameters, "covariance_white"),
        covariance_robust=hdf5.read_dataset(parameters, "covariance_robust"),
        trusted="robust" if trusted == "robust" else "white",
        whiteness=hdf5.read_dataset(file, "whiteness"),
        modes_std=hdf5.read_dataset(file, "modes_std"),
        static_gain_std=hdf5.read_dataset(file, "static_gain_std"),
        initial_states=hdf5.read_dataset(file, "initial_states"),
        loss=float(hdf5.read_dataset(file, "loss")),
        error_covariance=hdf5.read_dataset(file, "error_covariance"),
        fit_percent=hdf5.read_dataset(file, "fit_percent"),
        status=_status(str(attribute(file, "status")), success=bool(attribute(file, "success"))),
        iterations=int(attribute(file, "iterations")),
        wall_time_s=float(hdf5.read_dataset(file, "wall_time_s")),
        start=numbers["start"],
        start_origin=dict(zip(names, _texts(parameters, "start_origin"), strict=True)),
        aic=float(hdf5.read_dataset(file, "aic")),
        fpe=float(hdf5.read_dataset(file, "fpe")),
        condition=float(hdf5.read_dataset(file, "condition")),
        local_names=local_names,
        multi_start=StartsTried(**tried) if tried else None,
        notes=_texts(file, "notes"),
        options=FitOptions(**found),
        model=model,
        sample_time=float(hdf5.read_dataset(file, "sample_time")),
    )


def _write_parameters(group: h5py.Group, result: FitResult) -> None:
    names = list(result.parameters)
    for key, texts in (
        ("names", names),
        ("units", [result.units[name] for name in names]),
        ("free", list(result.free)),
        ("start_origin", [result.start_origin[name] for name in names]),
    ):
        group.attrs.create(key, texts, shape=(len(texts),), dtype=_TEXT)
    columns = (
        ("estimate", result.parameters, "estimates in the order of the attribute names"),
        ("std", result.std, "standard deviations; 0 fixed, nan none"),
        ("start", result.start, "start values"),
    )
    for column, values, long_name in columns:
        hdf5.add_dataset(group, column, [values[name] for name in names], "as attribute units", long_name)
    kinds = (
        ("covariance_white", result.covariance_white, "covariance of the free parameters for white residuals"),
        ("covariance_robust", result.covariance_robust, "covariance of the free parameters for any residuals"),
    )
    for name, matrix, long_name in kinds:
        hdf5.add_dataset(group, name, matrix, "as attribute units", long_name)


def _write_model(group: h5py.Group, model: LinearModel) -> None:
    group.attrs["name"] = model.name
    for key in ("input_names", "output_names", "state_names"):
        group.attrs.create(key, list(getattr(model, key)), dtype=_TEXT)
    for name in (*"ABCDK", "B_delayed", "delay"):
        matrix = getattr(model, name)
        if matrix is not None:
            hdf5.add_dataset(group, name, matrix, "s" if name == "delay" else "SI", f"{name} of the continuous model")


def _read_model(group: h5py.Group) -> LinearModel:
    A, B, C, D = (hdf5.read_dataset(group, letter) for letter in "ABCD")
    return LinearModel(
        A,
        B,
        C,
        D,
        K=hdf5.read_dataset(group, "K") if "K" in group else None,
        B_delayed=hdf5.read_dataset(group, "B_delayed") if "B_delayed" in group else None,
        delay=hdf5.read_dataset(group, "delay") if "delay" in group else None,
        name=str(hdf5.read_attribute(group, "name")),
        input_names=_texts(group, "input_names"),
        output_names=_texts(group, "output_names"),
        state_names=_texts(group, "state_names"),
    )


def _texts(item: h5py.HLObject, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in np.atleast_1d(hdf5.read_attribute(item, name)))


def _status(text: str, *, success: bool) -> FitStatus:
    """Return the status of a text; of version 0.1.0, which added words of its own, the nearest one."""
    if text in list(FitStatus):
        return FitStatus(text)
    stem = text.partition(", with the disturbance gain held")[0]
    if success:
        return FitStatus.CONVERGED_GAIN_HELD
    return FitStatus(stem) if stem in list(FitStatus) else FitStatus.SOLVER_FAILED


def _from_0_1_0(
    options: Mapping[str, str], model: LinearModel, free: tuple[str, ...], local_names: Mapping[str, Mapping[str, str]]
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Return the options and the other starts of a file of version 0.1.0, which has them as texts."""
    hold = options["intersample"].split()
    own = {full: name for names in local_names.values() for name, full in names.items()}
    estimated = {own.get(name, name) for name in free}
    found: dict[str, Any] = {key: options[key] for key in ("focus", "criterion", "stop", "initial_state", "engine")}
    found["inputs"], found["outputs"] = options["inputs"].split(), options["outputs"].split()
    found["horizon"] = int(options["horizon"])
    found["intersample"] = hold * len(model.input_names) if len(hold) == 1 else hold
    found["offsets"] = all(f"offset_{name}" in estimated for name in model.output_names)
    found["window"] = None if options["window"] == "one per recording" else int(options["window"])
    if "starts" not in options:
        return found, None
    tried: dict[str, Any] = {key: int(options[f"starts_{key}"]) for key in ("seed", "converged", "agreed")}
    return found, {"starts": int(options["starts"]), **tried, "spread": float(options["starts_spread"])}
