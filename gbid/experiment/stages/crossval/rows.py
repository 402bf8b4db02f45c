"""Rows of a cross-validation, and their table in CSV."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gbid.experiment.run.job import Job
from gbid.tables.table import Table, Value, plain_table
from gbid.validate import ValidationScores

COLUMNS = ("model", "recording", "output", "fit_percent", "infinity_norm", "unit", "residual_p", "residuals_follow")
_LEVEL = 0.01  # significance level of the whiteness test, over all outputs


@dataclass(frozen=True)
class CrossvalRow:
    """Scores of one model for one output of a recording.

    Attributes
    ----------
    fit, model, recording, output : str
        Names.
    fit_percent : float
        Fit percent of the simulation.
    infinity_norm : float
        Largest deviation of the simulation, in `unit`.
    unit : str
        Unit of the output.
    residual_p : float or None
        p-value of the whiteness test of the residuals. The residuals are those of the focus of the fit. None when they
        were not tested.
    residuals_white : bool or None
        Whether the whiteness test does not reject; None when it was not made.
    residuals_follow : tuple of str
        Inputs that are correlated with the residuals.
    minimum_percent : float or None
        Smallest fit percent that the experiment requires.
    """

    fit: str
    model: str
    recording: str
    output: str
    fit_percent: float
    infinity_norm: float
    unit: str
    residual_p: float | None
    residuals_white: bool | None
    residuals_follow: tuple[str, ...]
    minimum_percent: float | None

    @property
    def missed(self) -> bool:
        """Whether the fit percent is below the required minimum."""
        return self.minimum_percent is not None and not self.fit_percent >= self.minimum_percent


def scores_of_rows(job: Job, rows: Sequence[CrossvalRow]) -> ValidationScores:
    """Return the scores of the rows of one fit as arrays."""
    outputs = tuple(dict.fromkeys(row.output for row in rows))
    first = rows[:: len(outputs)]
    known = [job.experiment.recordings[row.recording].conditions for row in first]
    shape = (len(first), len(outputs))
    return ValidationScores(
        tuple(row.model for row in first),
        tuple(row.recording for row in first),
        np.array([conditions.get("pressure_bar", np.nan) for conditions in known]),
        np.array([conditions.get("speed_rpm", np.nan) for conditions in known]),
        outputs,
        tuple(row.unit for row in rows[: len(outputs)]),
        np.array([row.fit_percent for row in rows]).reshape(shape),
        np.array([row.infinity_norm for row in rows]).reshape(shape),
    )


def rows_table(rows: Sequence[CrossvalRow]) -> Table:
    """Return the table of the cross-validation of a fit, as in its CSV file."""
    notes = (
        "fit_percent: 100 (1 - |y - yhat| / |y - mean y|), yhat simulated; infinity_norm: largest |y - yhat|",
        "residual_p: p-value of the whiteness test, empty where not tested; "
        "residuals_follow: inputs that are correlated with the residuals",
    )
    values = [[_value(getattr(row, column)) for column in COLUMNS] for row in rows]
    return plain_table(COLUMNS, values, notes)


def read_rows(job: Job, name: str, path: Path) -> list[CrossvalRow]:
    """Return the rows in the CSV table of the cross-validation of a fit."""
    with path.open(encoding="utf-8", newline="") as handle:
        table = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    minimum = job.experiment.spec.crossval[name].minimum_percent
    n_outputs = len({row["output"] for row in table})
    rows = []
    for row in table:
        p = float(row["residual_p"]) if row["residual_p"] else None
        rows.append(
            CrossvalRow(
                name,
                row["model"],
                row["recording"],
                row["output"],
                float(row["fit_percent"]),
                float(row["infinity_norm"]),
                row["unit"],
                p,
                None if p is None else p >= _LEVEL / n_outputs,
                tuple(shlex.split(row["residuals_follow"])),
                minimum,
            )
        )
    return rows


def _value(value: Any) -> Value:
    return shlex.join(value) if isinstance(value, tuple) else value
