"""Elements of a page: sections of texts, tables and pictures. Templates turn them into HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from gbid.experiment.experiment import Experiment
from gbid.operating_point import point_label
from gbid.report.html.pictures import Picture
from gbid.tables.numbers import shown_unit
from gbid.tables.table import Table


@dataclass(frozen=True)
class Link:
    """Cell or item of a list with a link within the page."""

    text: str
    href: str


@dataclass(frozen=True)
class Words:
    """Paragraph; the tone is "", "good", "warn" or "bad"."""

    text: str
    tone: str = ""
    kind: ClassVar[str] = "words"


@dataclass(frozen=True)
class Listed:
    """List of items."""

    items: Sequence[str | Link]
    kind: ClassVar[str] = "list"


@dataclass(frozen=True)
class Shown:
    """Picture in the page."""

    picture: Picture
    kind: ClassVar[str] = "picture"


@dataclass(frozen=True)
class Gallery:
    """Blocks in a row if there is enough width."""

    blocks: Sequence[Any]
    kind: ClassVar[str] = "gallery"


@dataclass(frozen=True)
class Fold:
    """Blocks that open on a click; in print they are open."""

    title: str
    blocks: Sequence[Any]
    kind: ClassVar[str] = "fold"


@dataclass(frozen=True)
class Templated:
    """Block with its own template and the data for it."""

    template: str
    values: dict[str, Any] = field(default_factory=dict)
    kind: ClassVar[str] = "part"


Block = Words | Listed | Table | Shown | Gallery | Fold | Templated


@dataclass(frozen=True)
class PageSection:
    """Section of the page."""

    id: str
    title: str
    blocks: Sequence[Block]


def point_words(experiment: Experiment, recording: str) -> str:
    """Return the operating point of a recording as text."""
    planned = experiment.recordings[recording]
    known = planned.conditions
    if "pressure_bar" in known and "speed_rpm" in known:
        return point_label(known["pressure_bar"], known["speed_rpm"])
    return ", ".join(f"{key} {value:g}" for key, value in known.items()) or "not stated"


def fit_href(name: str, model: str) -> str:
    """Return the address of a fit in the page."""
    return f"#fit&{name}%2F{model}"


def in_units(value: float, unit: str) -> str:
    """Return a value as text with three digits, in the unit of tables."""
    factor, shown = shown_unit(unit)
    return f"{factor * value:.3g} {shown}".rstrip()
