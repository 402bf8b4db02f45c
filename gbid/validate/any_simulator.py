"""Simulator of a fitted model of either kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from gbid.arrays import BoolArray, FloatArray
from gbid.errors import UsageError
from gbid.identify import FitResult
from gbid.identify.disturbances.disturbances import UNDISTURBED, Disturbances
from gbid.structure import LinearModel, NonlinearModel
from gbid.validate.nonlinear_simulator import NonlinearSimulator
from gbid.validate.simulator import Explained, Simulator


class AnySimulator(Protocol):
    """Model prepared for the simulation on recordings; see `Simulator`."""

    @property
    def model(self) -> LinearModel | NonlinearModel: ...  # noqa: D102
    @property
    def sample_time(self) -> float: ...  # noqa: D102
    @property
    def name(self) -> str: ...  # noqa: D102

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return the initial state whose simulation is closest to the outputs, and the residuals."""
        ...

    def run(self, inputs: FloatArray, initial_state: FloatArray | None = None) -> FloatArray:
        """Return the simulated outputs without trend and hum, (n_outputs, n_samples)."""
        ...

    def disturbed(self, error: FloatArray, counted: BoolArray | None = None) -> FloatArray:
        """Return the trend and hum that are closest to an error of the simulation."""
        ...


def simulator_of(
    model: LinearModel | NonlinearModel,
    sample_time: float,
    intersample: str | Sequence[str] = "zoh",
    disturbances: Disturbances = UNDISTURBED,
    name: str = "model",
) -> AnySimulator:
    """Return the simulator of a model."""
    if isinstance(model, NonlinearModel):
        return NonlinearSimulator(model, sample_time, intersample, disturbances, name)
    return Simulator(model, sample_time, intersample, disturbances, name)


def refuse_scheduled(result: FitResult) -> None:
    """Refuse the fit of a scheduled structure, whose model holds in the middle of the range only."""
    if result.options.schedule is not None:
        raise UsageError(
            f"the parameters of {result.structure!r} follow {', '.join(result.options.schedule.variables)}; its model "
            "is that of the middle of their range. Take gbid.lpv_of(result).model.at(...) at an operating point"
        )


def simulator(result: FitResult) -> AnySimulator:
    """Return a fitted model prepared for the simulation on many recordings."""
    options = result.options
    refuse_scheduled(result)
    return simulator_of(
        result.model, result.sample_time, options.intersample, options.disturbances, ", ".join(result.recordings)
    )
