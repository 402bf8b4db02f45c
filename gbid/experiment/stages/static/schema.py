"""Schema of the static sections."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Names, NotNegative, Number, Section, Text

Share = Annotated[float, Strict(), Field(gt=0, le=1)]


class StaticSection(Section):
    """Static characterisation from staircases (paper, Sec. 3.1 and Appendix A).

    `kind: bearing` is the map from piezo positions to disc position, from all its recordings together; `kind: piezo`
    characterises one piezo stack or pair from one recording. See `gbid.characterise_staircase` and
    `gbid.characterise_piezo`; keys that are left out have their defaults.
    """

    recordings: Names
    kind: Literal["bearing", "piezo"] = "bearing"
    command: Text | None = None
    source: Text | None = None
    position: Text | None = None
    keep: Share | None = None
    channel: Text | None = None
    command_channel: Text | None = None
    settle_s: NotNegative | None = None
    limits: tuple[Number, Number] | None = None


def wanted_signals(section: StaticSection) -> dict[str, str]:
    """Return the signals by the key that names them, with the defaults of the functions."""
    if section.kind == "piezo":
        return {"command": section.command or "r", "position": section.position or "u"}
    return {
        "command": section.command or "r",
        "source": section.source or "u",
        "position": section.position or "p",
    }
