"""Impact studies in HDF5, kind ``impact``, and their rows for csv."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gbid.control.impact.figures_of_merit import FIELDS, ImpactFigures
from gbid.control.impact.measured import MeasuredImpact
from gbid.control.impact.ringdown.ringdown_result import RingDown
from gbid.control.impact.study import ImpactStudy
from gbid.control.impact.validation import ImpactValidation
from gbid.hdf5 import add_dataset, read_attribute, read_dataset, reading, writing

KIND = "impact"
_RINGDOWN = {
    "frequency_hz": ("Hz", "natural frequencies from the ring-down"),
    "damping": ("1", "damping factors from the ring-down"),
    "frequency_std": ("Hz", "standard deviations of the frequencies"),
    "damping_std": ("1", "standard deviations of the damping factors"),
    "covariance": ("", "covariance of frequency 1, damping 1, frequency 2, damping 2"),
    "stiffness": ("1/s^2", "K of the free response"),
    "damping_matrix": ("1/s", "D of the free response"),
    "lag_rates": ("1/s", "rates of the decays beside the modes"),
    "residual_rms": ("m", "what the fit leaves of x and y"),
}
_CURVES = {
    "time": ("s", "time"),
    "measured": ("m", "position as measured, less its offset"),
    "stationary": ("m", "part of it that turns with the shaft"),
    "simulated": ("m", "simulated response, scaled"),
    "force": ("N", "measured force"),
    "fit_percent": ("%", "fit of simulated to measured response, x and y"),
    "windows": ("1", "samples of each impact and the response to it"),
}
_MODES = {"expected": "modes of the model", "expected_running": "modes of the loop as it runs"}


def save_impacts(study: ImpactStudy, path: str | Path, overwrite: bool = False) -> None:
    """Store an impact study.

    Parameters
    ----------
    study : ImpactStudy
    path : path
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When it cannot be written.
    """
    with writing(path, KIND, overwrite) as file:
        file.attrs.update({"loop": study.loop, "model": study.model, "controller": study.controller})
        file.create_group("conditions").attrs.update(study.conditions)
        for name, words in _MODES.items():
            add_dataset(file, name, np.array(getattr(study, name)).reshape(-1, 2), "Hz, 1", words)
        _write(file.create_group("ringdown"), study.ringdown, _RINGDOWN)
        for i, validation in enumerate(study.validations):
            group = file.create_group(f"responses/{i:03d}")
            _write(group, validation, _CURVES, compress=True)
            group.create_dataset(
                "impacts", data=np.array([tuple(asdict(b).values()) for b in validation.impacts], float)
            )
            group["impacts"].attrs["long_name"] = ", ".join(f.name for f in fields(MeasuredImpact))
        table = np.array([tuple(asdict(q).values()) for q in study.figures], float).reshape(-1, len(FIELDS))
        add_dataset(file, "figures", table, "m, s", ", ".join(FIELDS))


def load_impacts(path: str | Path) -> ImpactStudy:
    """Read what `save_impacts` stored.

    Parameters
    ----------
    path : str or path

    Raises
    ------
    DataError
        When the file is missing, unreadable, incomplete or of another kind.
    """
    with reading(path, KIND) as file:
        modes = {n: tuple((float(f), float(z)) for f, z in read_dataset(file, n)) for n in _MODES}
        validations = []
        for group in file["responses"].values():
            rows = read_dataset(group, "impacts")
            impacts = tuple(MeasuredImpact(int(a), int(b), float(p), float(d), int(k)) for a, b, p, d, k in rows)
            found = _read(group, ImpactValidation, _CURVES)
            found["windows"] = tuple((int(a), int(b)) for a, b in found["windows"])
            validations.append(ImpactValidation(**found, impacts=impacts))
        return ImpactStudy(
            {key: float(value) for key, value in file["conditions"].attrs.items()},
            str(read_attribute(file, "loop")),
            str(read_attribute(file, "model")),
            str(read_attribute(file, "controller")),
            modes["expected"],
            modes["expected_running"],
            RingDown(**_read(file["ringdown"], RingDown, _RINGDOWN)),
            tuple(validations),
            tuple(ImpactFigures(*map(float, row)) for row in read_dataset(file, "figures")),
        )


def mode_rows(study: ImpactStudy) -> list[dict[str, Any]]:
    """List expected and obtained modes, a row each, names with their units in brackets."""
    ring = study.ringdown
    return [
        {
            "pressure_bar": study.conditions["pressure_bar"],
            "speed_rpm": study.conditions["speed_rpm"],
            "loop": study.loop,
            "mode": i + 1,
            "expected_frequency [Hz]": study.expected[i][0],
            "running_frequency [Hz]": study.expected_running[i][0],
            "obtained_frequency [Hz]": float(ring.frequency_hz[i]),
            "obtained_frequency_std [Hz]": float(ring.frequency_std[i]),
            "expected_damping": study.expected[i][1],
            "running_damping": study.expected_running[i][1],
            "obtained_damping": float(ring.damping[i]),
            "obtained_damping_std": float(ring.damping_std[i]),
            "lags": len(ring.lag_rates),
            "impacts": ring.n_impacts,
            "converged": ring.success,
        }
        for i in range(min(2, len(study.expected), len(study.expected_running)))
    ]


def response_rows(study: ImpactStudy) -> list[dict[str, Any]]:
    """List force scaling, fit, and what the impacts do to disc and piezos, a row for each recording."""
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


def _write(group: h5py.Group, value: Any, table: dict[str, tuple[str, str]], *, compress: bool = False) -> None:
    for name, (unit, words) in table.items():
        array = np.asarray(getattr(value, name))
        options = {"compression": "gzip", "shuffle": True} if compress and array.size > 1000 else {}
        add_dataset(group, name, array, unit, words, **options)
    for item in fields(value):
        entry = getattr(value, item.name)
        if item.name in table or item.name == "impacts":
            continue
        if isinstance(entry, tuple):
            group.attrs.create(item.name, list(entry), dtype=h5py.string_dtype(), shape=(len(entry),))
        else:
            group.attrs[item.name] = str(entry) if isinstance(entry, str) else entry


def _read(group: h5py.Group, kind: type, table: dict[str, tuple[str, str]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for item in fields(kind):
        if item.name in table:
            found[item.name] = read_dataset(group, item.name)
        elif item.name != "impacts":
            value = read_attribute(group, item.name)
            found[item.name] = (
                tuple(str(v) for v in value) if np.ndim(value) else value.item() if hasattr(value, "item") else value
            )
    return found
