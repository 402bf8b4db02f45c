"""Schema of the cycle section."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, Field, Strict

from gbid.experiment.fields import Count, Name, Positive, Section, Switch, given
from gbid.experiment.stages.impact.schema import HammerTrain, ImpactPoint

MOST_ROUNDS = 5

Points = Annotated[tuple[ImpactPoint, ...], Field(min_length=1)]


class TrialSection(HammerTrain):
    """Impacts that measure the damping of each round.

    `operating_points`: where the rotor is hit; by default at the points of the new recordings.
    """

    operating_points: Points | None = None


class CycleSection(Section):
    """Identification-for-control cycle on the virtual rig.

    In each round the controller of the round before runs on the rig while new recordings are made. The surfaces are
    fitted again to all recordings so far, in open and in closed loop, and the controller is tuned again. Impacts
    measure the damping of every round. Round 0 is the design of this experiment.

    `design`: name of the design; it may be left out when there is one. `rounds`: number of rounds after round 0.
    `operating_points`: those of the new recordings; by default those of the rig. `recordings`: number in each round at
    each point. `in_run`: whether `gbid run` runs the cycle as well; `gbid cycle` runs it in any case. `duration_s`,
    `amplitude_m`, `hold_s`: of the new recordings; by default those of the section rig.
    """

    design: Name | None = None
    rounds: Annotated[int, Strict(), Field(ge=1, le=MOST_ROUNDS)] = 2
    operating_points: Points | None = None
    recordings: Count = 1
    in_run: Switch = True
    duration_s: Positive | None = None
    amplitude_m: Positive | None = None
    hold_s: Positive | None = None
    impacts: Annotated[TrialSection, BeforeValidator(given)] = TrialSection()
