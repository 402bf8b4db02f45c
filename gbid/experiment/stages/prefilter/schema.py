"""Schema of the prefilter section."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Count, Section, Switch


class PrefilterSection(Section):
    """Corrections of the excited recordings before the fits (paper, Sec. 3.5).

    `harmonics`: their number, or ``auto`` for the smallest one that leaves no more than others on held-out data.
    """

    method: Literal["harmonics", "bins", "auto", "none"] = "harmonics"
    align_index: Switch = False
    harmonics: Count | Literal["auto"] = 10
    bins: Annotated[int, Strict(), Field(ge=4)] = 100
    spikes: Switch = True
    median: Count = 1
    remove_mean: Switch = True
