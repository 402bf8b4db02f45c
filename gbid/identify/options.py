"""Options of a fit, stored with its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gbid.discretise import Hold
from gbid.identify.disturbances.disturbances import Disturbances
from gbid.identify.kernel.engine import RunEngine
from gbid.identify.nlp.shooting import Criterion
from gbid.identify.nlp.watch import Stop
from gbid.identify.predictor import Focus
from gbid.identify.robust.loss import RobustLoss
from gbid.identify.uncertainty.bootstrap import Bootstrap, StdName
from gbid.structure.scheduling.schedule import Schedule


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit, with the choices that it made itself.

    Attributes
    ----------
    inputs, outputs : tuple of str
        Signals or channels, as the caller named them.
    focus : {"prediction", "simulation"}
        Focus of the errors.
    horizon : int
        Number of steps of the prediction.
    intersample : tuple of {"zoh", "foh"}
        Behaviour between samples of each input channel.
    criterion : {"trace", "det"}
        Criterion.
    stop : {"tolerance", "paper"}
        Stopping rule.
    initial_state : {"estimated", "zero", "structure", "given"}
        Initial state of each recording; "given" when it differs between recordings or states.
    disturbances : Disturbances
        Trends and hum of the outputs that were estimated along.
    robust : RobustLoss or None
        Robust loss; None for squared errors.
    window : int or None
        Number of samples in a shooting window; None for one window per recording.
    engine : {"compiled", "numpy"}
        Engine of the pass over the samples.
    bootstrap : Bootstrap or None
        Bootstrap of the standard deviations; None without one, also in a file of an earlier version.
    schedule : Schedule or None
        Terms of the surfaces of a scheduled structure; None for constant parameters.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    focus: Focus
    horizon: int
    intersample: tuple[Hold, ...]
    criterion: Criterion
    stop: Stop
    initial_state: Literal["estimated", "zero", "structure", "given"]
    disturbances: Disturbances
    robust: RobustLoss | None
    window: int | None
    engine: RunEngine
    bootstrap: Bootstrap | None = None
    schedule: Schedule | None = None

    @property
    def std(self) -> StdName:
        """Standard deviations that were asked for: "bootstrap", or by the whiteness test ("auto")."""
        return "auto" if self.bootstrap is None else "bootstrap"
