"""Impact study: expected and measured modes at one operating point in one loop (Tables 3 and 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from gbid.brief import Brief
from gbid.control.impact.figures_of_merit import ImpactFigures, impact_figures
from gbid.control.impact.ringdown.fit_ringdown import fit_ringdown
from gbid.control.impact.ringdown.ringdown_result import RingDown
from gbid.control.impact.ringing_modes import Modes, ringing_modes
from gbid.control.impact.validation import ImpactValidation, validate_impact
from gbid.control.loop.sampled import exact_plant
from gbid.hdf5 import Stored
from gbid.lpv import LPVModel
from gbid.recording import Recording
from gbid.structure import LinearModel, PiezoPair, evaluate


@dataclass(frozen=True, eq=False)
class ImpactStudy(Brief):
    """Expected and measured modes, and measured and simulated responses.

    Attributes
    ----------
    conditions : dict of str to float
        Operating point.
    loop : str
        ``"open"``, ``"closed"``, or the name of another closed loop.
    model, controller : str
        Names of model and controller; the latter is empty in open loop.
    expected : tuple of (frequency_hz, damping)
        Modes of the continuous model with first-order Pade delays, as in the paper.
    expected_sampled : tuple of (frequency_hz, damping)
        Modes of the sampled loop: sampled controller, one sample of computation, exact delays. Equal to `expected` in
        open loop.
    ringdown : RingDown
        Modes measured from the impacts.
    validations : tuple of ImpactValidation
        One for each recording, against the sampled loop.
    figures : tuple of ImpactFigures
        One for each recording: largest motion of disc and stacks, decay time.
    """

    conditions: Mapping[str, float]
    loop: str
    model: str
    controller: str
    expected: Annotated[Modes, Stored("Hz, 1", "modes of the model")]
    expected_sampled: Annotated[Modes, Stored("Hz, 1", "modes of the sampled loop", at="expected_running")]
    ringdown: RingDown
    validations: Annotated[tuple[ImpactValidation, ...], Stored(at="responses")]
    figures: tuple[ImpactFigures, ...] = ()


def study_impacts(
    recordings: Sequence[Recording],
    model: LPVModel,
    controller: LinearModel | None = None,
    sampled: LinearModel | None = None,
    *,
    harmonics: int | None = None,
    lags: int | str = "auto",
    loop: str | None = None,
) -> ImpactStudy:
    """Return the modes fitted to the ring-downs of some recordings, compared with a model.

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings in one loop at one operating point, which their conditions give.
    model : LPVModel
        Model with actuators.
    controller, sampled : LinearModel, optional
        Controller during the recordings, continuous and sampled; open loop when not given.
    harmonics, lags
        See `fit_ringdown`.
    loop : str, optional
        Name of the loop; ``"open"`` or ``"closed"`` when not given.

    Returns
    -------
    ImpactStudy
    """
    point = {key: float(recordings[0].conditions[key]) for key in ("pressure_bar", "speed_rpm")}
    where = (point["pressure_bar"], point["speed_rpm"])
    plant, exact = model.plant_at(*where), exact_plant(model, *where)
    expected = ringing_modes(plant, controller)
    actuators = evaluate(PiezoPair(), model.actuators, plant.input_names, ("u_x", "u_y"))
    validations = tuple(validate_impact(rec, exact, sampled, harmonics=harmonics) for rec in recordings)
    return ImpactStudy(
        point,
        loop or ("open" if controller is None else "closed"),
        model.name,
        "" if controller is None else controller.name,
        expected,
        expected if sampled is None else ringing_modes(exact, sampled),
        fit_ringdown(recordings, harmonics=harmonics, lags=lags),
        validations,
        tuple(impact_figures(*pair, actuators, sampled) for pair in zip(recordings, validations, strict=True)),
    )
