"""Options of a fit, kept with its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gbid.discretise import Hold
from gbid.identify.kernel.engine import RunEngine
from gbid.identify.nlp.shooting import Criterion
from gbid.identify.nlp.watch import Stop
from gbid.identify.predictor import Focus


@dataclass(frozen=True)
class FitOptions:
    """What a fit was asked for, and what it took where it had the choice.

    Attributes
    ----------
    inputs, outputs : tuple of str
        Signals or channels, as they were named.
    focus : {"prediction", "simulation"}
    horizon : int
        Steps ahead that were predicted.
    intersample : tuple of {"zoh", "foh"}
        Behaviour between samples of each channel of the inputs.
    criterion : {"trace", "det"}
    stop : {"tolerance", "paper"}
    initial_state : {"estimated", "zero", "given"}
    offsets : bool
        Whether a constant offset of each output was estimated.
    window : int or None
        Samples in a shooting window; None for one window per recording.
    engine : {"compiled", "numpy"}
        What ran the pass over the samples.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    focus: Focus
    horizon: int
    intersample: tuple[Hold, ...]
    criterion: Criterion
    stop: Stop
    initial_state: Literal["estimated", "zero", "given"]
    offsets: bool
    window: int | None
    engine: RunEngine
