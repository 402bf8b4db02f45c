"""What became of one result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

State = Literal["made", "kept", "failed"]
Cause = Literal["", "input", "data", "usage", "defect", "crash"]


@dataclass(frozen=True)
class Outcome:
    """What became of one result file.

    Attributes
    ----------
    stage, item : str
        ``"fit"`` and ``"bearing/p5_n6000_prbs1"``, for example.
    path : pathlib.Path
        The file.
    state : {"made", "kept", "failed"}
        Kept: it was there, made from the same settings and data.
    text : str
        Why it failed, or what to know about it.
    seconds : float
        Time it took.
    converged : bool
        False for a fit that did not; its file is written all the same.
    fit_percent : float
        Of a fit, the smallest of its outputs; nan for anything else.
    cause : {"", "input", "data", "usage", "defect", "crash"}
        Of a failure: an input that is not there, bad data, wrong options, a defect of gbid, a process that died.
    before : bool
        Whether it failed in an earlier run, and was not tried again.
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
    """What to know of a result; see `Outcome`."""

    text: str = ""
    converged: bool = True
    fit_percent: float = math.nan
