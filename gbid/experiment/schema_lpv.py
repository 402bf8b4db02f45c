"""What an experiment YAML may say of the surfaces over pressure and speed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Name, Section, Switch, Text

Term = Literal["1", "P", "Omega", "Omega P", "P^2", "Omega^2"]


class LpvSection(Section):
    """Surfaces through the key parameters of a fit to each recording (paper, Eq. 16); see `gbid.fit_lpv`.

    `actuators`: the word ``nominal`` (of the section of that name), or a model's name or file; none when left out.
    `direct`: whether all surfaces are also estimated straight from the recordings; see `gbid.fit_lpv_direct`.
    """

    fit: Name
    weighting: Literal["scatter", "fits", "ordinary"] = "scatter"
    order: Annotated[int, Strict(), Field(ge=0, le=2)] | Literal["auto"] | tuple[Term, ...] = 2
    robust: Switch = False
    direct: Switch = False
    actuators: Text | None = None
