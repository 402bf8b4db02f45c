"""Outcome of a task."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

State = Literal["made", "kept", "failed"]
Cause = Literal["", "input", "data", "usage", "defect", "crash"]


@dataclass(frozen=True)
class Outcome:
    """Outcome of one result file.

    Attributes
    ----------
    stage, item : str
        Names of stage and item, for example ``"fit"`` and ``"bearing/p5_n6000_prbs1"``.
    path : pathlib.Path
        The result file.
    state : {"made", "kept", "failed"}
        ``kept``: the file existed already, made from the same settings and data.
    text : str
        Reason of a failure, or a note about the result.
    seconds : float
        Computing time [s].
    converged : bool
        False for a fit that did not converge; its file is written anyway.
    fit_percent : float
        For a fit, the smallest fit percent of its outputs; nan for other results.
    cause : {"", "input", "data", "usage", "defect", "crash"}
        Cause of a failure: missing input, bad data, wrong options, defect of gbid, or death of the process.
    before : bool
        Whether the task failed in an earlier run and was not tried again.
    """

    stage: str
    item: str
    path: Path
    state: State
    text: str = ""
    seconds: float = 0.0
    converged: bool = True
    fit_percent: float = math.nan
    cause: Cause = ""
    before: bool = False


@dataclass(frozen=True)
class Made:
    """Summary of a result; the fields are those of `Outcome`."""

    text: str = ""
    converged: bool = True
    fit_percent: float = math.nan
