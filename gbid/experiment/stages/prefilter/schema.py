"""Schema of the prefilter section."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Count, Names, Section, Switch


class PrefilterSection(Section):
    """Corrections of the excited recordings before the fits (paper, Sec. 3.5).

    `harmonics`: their number, or ``auto`` for the smallest one that leaves no more than others on held-out data.
    `slow_roll`: stationary recordings at a low speed. Their map, the run-out alone, is for recordings without an
    operating point, in which the speed changes; a fit estimates the unbalance of those (option ``unbalance``).
    """

    method: Literal["harmonics", "bins", "auto", "none"] = "harmonics"
    align_index: Switch = False
    harmonics: Count | Literal["auto"] = 10
    bins: Annotated[int, Strict(), Field(ge=4)] = 100
    spikes: Switch = True
    median: Count = 1
    remove_mean: Switch = True
    slow_roll: Names | None = None
