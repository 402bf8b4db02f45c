"""Schema of the excite section; names and defaults are those of `gbid.design_excitation`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gbid.experiment.fields import Name, Names, NotNegative, Positive, Section, Switch, Text


class ExciteLimitsSection(Section):
    """Limits of an excitation; see `gbid.ExcitationLimits`.

    `peaks` and `radius` are by signal or channel of the fit, in SI units. `clearance_m` is that of the rig when left
    out, with its unbalance, run-out and scatter; without a rig there is none.
    """

    peaks: dict[Text, Positive] = Field(min_length=1)
    radius: dict[Text, Positive] = Field(default_factory=dict)
    clearance_m: Positive | None = None
    taken_m: NotNegative = 0.0


class ExciteSection(Section):
    """Excitation of the next recording, for each model of a fit; see `gbid.design_excitation`.

    `together`: whether the recordings of the fit count as well, so that the next one is best after them.
    """

    fit: Name
    duration_s: Positive = 5.0
    kind: Literal["multisine", "prbs"] = "multisine"
    focus: Names | dict[Text, Positive] | None = None
    together: Switch = True
    limits: ExciteLimitsSection
