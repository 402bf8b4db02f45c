"""Impact studies in HDF5 (kind ``impact``), and their rows for CSV."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid import hdf5
from gbid.control.impact.figures_of_merit import ImpactFigures
from gbid.control.impact.measured import MeasuredImpact
from gbid.control.impact.ringdown.ringdown_result import RingDownStatus
from gbid.control.impact.study import ImpactStudy


def _from_schema_1(file: h5py.File) -> None:
    """Convert tables to columns with names, and the names of gbid 0.1, in which impacts were called blows."""
    _spread(file, "figures", ImpactFigures)
    ringdown = file["ringdown"].attrs
    if "n_blows" in ringdown:
        ringdown["n_impacts"] = ringdown["n_blows"]
    if ringdown["status"].startswith(RingDownStatus.NOT_CONVERGED):  # the reason followed in words
        ringdown["status"] = RingDownStatus.NOT_CONVERGED.value
    responses = file.require_group("responses")
    responses.attrs["count"] = len(responses)
    for group in responses.values():
        if "blows" in group:
            group.move("blows", "impacts")
        _spread(group, "impacts", MeasuredImpact, whole=("start", "stop", "pulses"))


def _spread(group: h5py.Group, name: str, row: type, whole: tuple[str, ...] = ()) -> None:
    """Replace a table by a group of its columns, whose names are the fields of a dataclass."""
    columns = hdf5.read_dataset(group, name).T
    del group[name]
    for field, column in zip(fields(row), columns, strict=True):
        numbers = column.astype(int) if field.name in whole else column
        hdf5.add_dataset(group, f"{name}/{field.name}", numbers, "", field.name)


def _from_schema_2(file: h5py.File) -> None:
    """Add the further oscillations of a ring-down, of which there were none."""
    hdf5.add_dataset(file["ringdown"], "oscillations", np.zeros((0, 2)), "Hz, 1", "decays that oscillate")


KIND = hdf5.FileKind("impact", "make it again with `gbid impact`", (_from_schema_1, _from_schema_2))


def save_impacts(study: ImpactStudy, path: str | Path, overwrite: bool = False) -> None:
    """Write an impact study to an HDF5 file.

    Parameters
    ----------
    study : ImpactStudy
        The study.
    path : path
        The file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    hdf5.save(study, path, KIND, overwrite)


def load_impacts(path: str | Path) -> ImpactStudy:
    """Return the impact study in an HDF5 file of `save_impacts`.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    ImpactStudy
        The study.

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    return hdf5.load(path, KIND, ImpactStudy)


def mode_rows(study: ImpactStudy) -> list[dict[str, Any]]:
    """Return rows of expected and identified modes, one for each mode; names have their units in brackets."""
    ring = study.ringdown
    return [
        {
            "pressure_bar": study.conditions["pressure_bar"],
            "speed_rpm": study.conditions["speed_rpm"],
            "loop": study.loop,
            "mode": i + 1,
            "expected_frequency [Hz]": study.expected[i][0],
            "running_frequency [Hz]": study.expected_sampled[i][0],
            "obtained_frequency [Hz]": float(ring.frequency_hz[i]),
            "obtained_frequency_std [Hz]": float(ring.frequency_std[i]),
            "expected_damping": study.expected[i][1],
            "running_damping": study.expected_sampled[i][1],
            "obtained_damping": float(ring.damping[i]),
            "obtained_damping_std": float(ring.damping_std[i]),
            "lags": len(ring.lag_rates),
            "impacts": ring.n_impacts,
            "converged": ring.success,
        }
        for i in range(min(2, len(study.expected), len(study.expected_sampled)))
    ]


def response_rows(study: ImpactStudy) -> list[dict[str, Any]]:
    """Return rows of force scaling, fit percent, and motion of disc and piezos, one for each recording."""
    return [
        {
            "recording": v.recording,
            "pressure_bar": study.conditions["pressure_bar"],
            "speed_rpm": study.conditions["speed_rpm"],
            "loop": study.loop,
            "axis": v.axis,
            "impacts": len(v.impacts),
            "force_scale [1/kg]": v.force_scale,
            "force_scale_std [1/kg]": v.force_scale_std,
            "fit_along [%]": v.along_percent,
            "fit_x [%]": float(v.fit_percent[0]),
            "fit_y [%]": float(v.fit_percent[1]),
            **{f"{name[: name.rindex('_')]} [{name[-1]}]": value for name, value in asdict(q).items()},
        }
        for v, q in zip(study.validations, study.figures, strict=True)
    ]
