"""Rows of the cycle: certainty of the model and damping of the loop, for each round and operating point."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.assessment.tuned_design import TunedDesign
from gbid.control.impact.study import ImpactStudy
from gbid.lpv import CHARACTERISTICS, LPVFit
from gbid.lpv.characteristics import characteristics
from gbid.structure import KEY_PARAMETERS
from gbid.tables.table import Table, plain_table

_STEP = 1e-3  # of the difference quotients, in standard deviations of a parameter
_MODES = ("frequency_1_hz", "frequency_2_hz", "damping_1", "damping_2")
_READ: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "bool": lambda text: text == "true"}


@dataclass(frozen=True)
class CycleRow:
    """One round at one operating point.

    Attributes
    ----------
    round : int
        The round; 0 is the design of the experiment.
    pressure_bar, speed_rpm : float
        Operating point.
    recordings : int
        Number of recordings behind the surfaces.
    model_frequency_1_hz, model_frequency_2_hz, model_damping_1, model_damping_2 : float
        Modes of the bearing without controller, from the surfaces; with ``_std`` their standard deviations.
    promised_damping : float
        Smallest damping that the design has over all operating points and plants of the search.
    expected_damping : float
        Smaller damping of the two modes that the surfaces give for the sampled loop at this point.
    frequency_1_hz, frequency_2_hz, damping_1, damping_2 : float
        Modes of the loop on the rig, measured by impacts; with ``_std`` their standard deviations.
    impacts : int
        Number of impacts.
    converged : bool
        Whether the fit to the ring-downs converged.
    """

    round: int
    pressure_bar: float
    speed_rpm: float
    recordings: int
    model_frequency_1_hz: float
    model_frequency_1_hz_std: float
    model_frequency_2_hz: float
    model_frequency_2_hz_std: float
    model_damping_1: float
    model_damping_1_std: float
    model_damping_2: float
    model_damping_2_std: float
    promised_damping: float
    expected_damping: float
    frequency_1_hz: float
    frequency_1_hz_std: float
    frequency_2_hz: float
    frequency_2_hz_std: float
    damping_1: float
    damping_1_std: float
    damping_2: float
    damping_2_std: float
    impacts: int
    converged: bool

    @property
    def reached(self) -> tuple[float, float]:
        """Smaller measured damping factor, and its standard deviation."""
        first = not self.damping_2 < self.damping_1
        return (self.damping_1, self.damping_1_std) if first else (self.damping_2, self.damping_2_std)


def rows_of_round(number: int, fit: LPVFit, design: TunedDesign, studies: Sequence[ImpactStudy]) -> list[CycleRow]:
    """Return the rows of a round, one for each impact study."""
    return [_row(number, fit, design, study) for study in studies]


def cycle_table(rows: Sequence[CycleRow]) -> Table:
    """Return the table of the rows, as in its CSV file."""
    notes = (
        "model_: modes of the bearing without controller, from the surfaces of the round; expected_damping: of the "
        "sampled loop, by the same surfaces; frequency and damping: of the loop on the rig, measured by impacts",
    )
    names = [field.name for field in fields(CycleRow)]
    return plain_table(names, [list(asdict(row).values()) for row in rows], notes)


def read_cycle(path: Path) -> list[CycleRow]:
    """Return the rows in the CSV file of a cycle."""
    with path.open(encoding="utf-8", newline="") as handle:
        table = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    kinds = {field.name: _READ[str(field.type)] for field in fields(CycleRow)}
    return [CycleRow(**{name: kind(row[name]) for name, kind in kinds.items()}) for row in table]


def _row(number: int, fit: LPVFit, design: TunedDesign, study: ImpactStudy) -> CycleRow:
    pressure, speed = (float(study.conditions[key]) for key in ("pressure_bar", "speed_rpm"))
    ring, places = study.ringdown, [0, 2, 1, 3]  # a ring-down has frequency and damping of each mode in turn
    measured = np.column_stack([ring.frequency_hz, ring.damping]).ravel()[places]
    measured_std = np.column_stack([ring.frequency_std, ring.damping_std]).ravel()[places]
    return CycleRow(
        number,
        pressure,
        speed,
        len(fit.estimates.recordings),
        promised_damping=design.result.value,
        expected_damping=min(damping for _, damping in study.expected_sampled),
        impacts=ring.n_impacts,
        converged=ring.success,
        **_named("model_", *modes_of_surfaces(fit, pressure, speed)),
        **_named("", measured, measured_std),
    )


def _named(prefix: str, mean: FloatArray, std: FloatArray) -> dict[str, Any]:
    """Return modes and their standard deviations as fields of a row."""
    pairs = zip(_MODES, mean.tolist(), std.tolist(), strict=True)
    return {f"{prefix}{name}{ending}": v for name, m, s in pairs for ending, v in (("", m), ("_std", s))}


def modes_of_surfaces(fit: LPVFit, pressure_bar: float, speed_rpm: float) -> tuple[FloatArray, FloatArray]:
    """Return both natural frequencies [Hz] and damping factors of surfaces at a point, with standard deviations.

    Parameters
    ----------
    fit : LPVFit
        Surfaces with their covariance.
    pressure_bar, speed_rpm : float
        Operating point.

    Returns
    -------
    mean : (4,) array
        Frequency 1, frequency 2, damping 1, damping 2.
    std : (4,) array
        Their standard deviations, to first order.
    """
    known = fit.model.key_parameters(pressure_bar, speed_rpm)
    values = np.array([float(known[key]) for key in KEY_PARAMETERS])
    covariance = fit.uncertainty_at(pressure_bar, speed_rpm)
    steps = _STEP * np.sqrt(np.diag(covariance))
    near = characteristics(np.vstack([values, values + np.diag(steps), values - np.diag(steps)]))
    columns = [CHARACTERISTICS.index(name) for name in ("omega_1", "omega_2", "zeta_1", "zeta_2")]
    mean, up, down = near[0, columns], near[1 : 1 + len(values), columns], near[1 + len(values) :, columns]
    moving = steps > 0
    slopes = (up - down)[moving] / (2 * steps[moving, None])
    spread = slopes.T @ covariance[np.ix_(moving, moving)] @ slopes
    return mean, np.sqrt(np.diag(spread))
