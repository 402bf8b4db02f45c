"""Fit results in HDF5; docs/file-formats.md describes the tree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import h5py

from gbid import hdf5
from gbid.identify.disturbances.disturbances import Disturbances, Trend
from gbid.identify.options import FitOptions
from gbid.identify.result import FitResult, StartsTried
from gbid.identify.status import FitStatus


def _from_schema_1(file: h5py.File) -> None:
    """Convert options, other starts and status, which were texts in gbid 0.1.0."""
    options = json.loads(hdf5.read_text(file, "options"))
    hold = options["intersample"].split()
    local_names = json.loads(hdf5.read_text(file, "local_names"))
    own = {full: name for names in local_names.values() for name, full in names.items()}
    estimated = {own.get(name, name) for name in hdf5.read_texts(file["parameters"], "free")}
    inputs, outputs = (hdf5.read_texts(file["model"], name) for name in ("input_names", "output_names"))
    asked = FitOptions(
        inputs=tuple(options["inputs"].split()),
        outputs=tuple(options["outputs"].split()),
        horizon=int(options["horizon"]),
        intersample=tuple(hold * len(inputs) if len(hold) == 1 else hold),
        disturbances=_offsets(outputs, all(f"offset_{name}" in estimated for name in outputs)),
        robust=None,
        window=None if options["window"] == "one per recording" else int(options["window"]),
        **{key: options[key] for key in ("focus", "criterion", "stop", "initial_state", "engine")},
    )
    hdf5.write_fields(file.create_group("options"), asked)
    if "starts" in options:
        seed, converged, agreed = (int(options[f"starts_{key}"]) for key in ("seed", "converged", "agreed"))
        tried = StartsTried(int(options["starts"]), seed, converged, agreed, float(options["starts_spread"]))
        hdf5.write_fields(file.create_group("multi_start"), tried)
    file.attrs["status"] = status_of_text(hdf5.read_text(file, "status"), success=bool(file.attrs["success"])).value


def _offsets(outputs: Sequence[str], estimated: bool) -> Disturbances:
    return Disturbances(tuple(outputs), (Trend(int(estimated)),) * len(outputs))


def status_of_text(text: str, *, success: bool) -> FitStatus:
    """Return the status of a text. Version 0.1.0 added further words; for these it is the nearest status."""
    if text in list(FitStatus):
        return FitStatus(text)
    stem = text.partition(", with the disturbance gain held")[0]
    if success:
        return FitStatus.CONVERGED_GAIN_HELD
    return FitStatus(stem) if stem in list(FitStatus) else FitStatus.SOLVER_FAILED


KIND = hdf5.FileKind("fit", "make the fit anew", (_from_schema_1,))


def save_fit(result: FitResult, path: str | Path, overwrite: bool = False, key: str = "") -> None:
    """Write a fit result to an HDF5 file.

    Parameters
    ----------
    result : FitResult
        The result.
    path : path
        The file; missing folders are made.
    overwrite : bool
        Whether an existing file may be replaced.
    key : str
        Text that identifies settings and data of the fit; stored as attribute ``key``.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    hdf5.save(result, path, KIND, overwrite, key=key, success=result.success)


def load_fit(path: str | Path) -> FitResult:
    """Return the fit result in an HDF5 file.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    FitResult
        The result.

    Raises
    ------
    DataError
        When the file is missing, damaged, incomplete or of another kind.
    """
    with hdf5.reading(path, KIND) as file:
        trusted = hdf5.read_text(file, "trusted")
        covariance = hdf5.read_dataset(file, f"parameters/covariance_{trusted}")
        return hdf5.read_fields(file, FitResult, covariance=covariance)
