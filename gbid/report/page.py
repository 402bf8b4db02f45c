"""Elements of a page: sections of texts, tables and pictures. Templates turn them into HTML."""

from __future__ import annotations

import io
import json
import re
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from itertools import count
from typing import Any, ClassVar

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from gbid._version import __version__
from gbid.control import HalfSine, PStructure
from gbid.core.arrays import FloatArray, point_label
from gbid.core.names import printable
from gbid.core.tables import Table, html_table, shown_unit
from gbid.experiment.experiment import Experiment
from gbid.lpv import LPVModel
from gbid.report.canvas import STYLE, Drawn, figure_of, missing_letters_as_boxes
from gbid.validate import Validation

# ---- Figures of matplotlib as SVG in a page.

_IDS = re.compile(r'(\bid="|href="#|url\(#)')
_SIZE = re.compile(r'<svg\b[^>]*?viewBox="(?P<box>[^"]+)"[^>]*>')
_LONG = re.compile(r"(-?\d+\.\d{2})\d+")
_PATH = re.compile(r'\bd="[^"]*"')


@dataclass(frozen=True)
class Picture:
    """Figure in a page.

    Attributes
    ----------
    svg : str
        The SVG element, with the alternative text in it.
    caption : str
        Text below the picture.
    """

    svg: str
    caption: str


class Pictures:
    """Maker of the pictures of one page; each picture has its own ids."""

    def __init__(self) -> None:
        self._numbers = count(1)

    def picture(self, figure: Drawn, alt: str, caption: str = "") -> Picture:
        """Return a figure as SVG.

        Parameters
        ----------
        figure : matplotlib Figure, Axes, or array of Axes
            The figure, or what a picture function returned.
        alt : str
            Alternative text for readers who cannot see it.
        caption : str
            Text below the picture; by default the alternative text.
        """
        buffer = io.StringIO()
        # Letters as outlines: a device without these fonts shows them correctly.
        outlines = mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "gbid"})
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        with mpl.rc_context(fname=STYLE), outlines, missing_letters_as_boxes():
            figure_of(figure).savefig(buffer, format="svg", metadata=nothing)
        return Picture(_embedded(buffer.getvalue(), f"g{next(self._numbers)}-", alt), caption or alt)


def _embedded(text: str, prefix: str, alt: str) -> str:
    """Return the SVG element without the parts that only a file needs; ids get a prefix, paths two decimals."""
    body = text[text.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    size = _SIZE.search(body)
    assert size is not None
    body = body[size.end() :]
    body = _IDS.sub(rf"\g<1>{prefix}", body.replace("xlink:href", "href"))
    body = _PATH.sub(lambda path: _LONG.sub(r"\1", path[0]), body)
    body = re.sub(r"\n\s*", "\n", body)
    width, height = size["box"].split()[2:]
    # matplotlib measures in points of 1/72 inch, a page in pixels of 1/96
    look = f'style="--natural:{float(width) * 4 / 3:.0f}px;max-width:var(--natural)" class="picture"'
    return f'<svg {look} viewBox="0 0 {width} {height}" role="img" aria-label="{escape(alt, quote=True)}">{body}'


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


def in_units(value: float, unit: str) -> str:
    """Return a value as text with three digits, in the unit of tables."""
    factor, shown = shown_unit(unit)
    return f"{factor * value:.3g} {shown}".rstrip()


# ---- Rendering of a page: sections, styles and scripts in one HTML text without other files.

SCRIPTS = ("charts.js", "explorer_math.js", "explorer.js", "fits.js", "page.js")


def render(title: str, name: str, sections: Sequence[PageSection], left_out: Sequence[str], key: str) -> str:
    """Return the HTML of a page.

    Parameters
    ----------
    title, name : str
        Title and name of the experiment.
    sections : sequence of PageSection
        Sections of the page.
    left_out : sequence of str
        Parts of the method that the experiment does not use.
    key : str
        Content key, stored as a comment.

    Returns
    -------
    str
        HTML text.
    """
    return (
        environment(page_part)
        .get_template("report.html.j2")
        .render(
            title=title or name,
            name=name,
            sections=sections,
            left_out=left_out,
            key=key,
            version=__version__,
            style=Markup(page_part("style.css")),
            scripts=[script(page_part(name)) for name in SCRIPTS],
        )
    )


def environment(read: Callable[[str], str]) -> Environment:
    """Return the template environment of pages.

    Parameters
    ----------
    read : callable
        Function that returns the text of a template by its name.
    """
    made = Environment(
        loader=FunctionLoader(read),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
    )
    made.filters["embedded"] = _embedded_render
    made.filters["html_table"] = lambda table: Markup(html_table(table))
    return made


def page_part(name: str) -> str:
    """Return the text of a template, script or style of the page."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def script(text: str) -> Markup:
    """Return a script for a page, without the lines for programs outside of it."""
    outside = ('"use strict";', "if (typeof module")
    return Markup("\n".join(line for line in text.splitlines() if not line.startswith(outside)))


def _embedded_render(value: Any) -> Markup:
    """Return data for a script element; no text in it can end the element."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))


# ---- Measured and simulated curves of a fit, small enough for a page with hundreds of them.

SAMPLES = 1200
"""Number of samples in the part shown."""
POINTS = 600
"""Largest number of points of a curve."""
BINS = 240
"""Number of intervals of the whole recording for which the range of the error is stored."""
_LARGEST = 32767


def trace(validation: Validation, from_s: float | None = None) -> dict[str, Any]:
    """Return a part of a validation, and the range of its error over the whole recording.

    Parameters
    ----------
    validation : Validation
        The validation.
    from_s : float, optional
        Start of the part [s]; by default a third of the recording, also when too few samples follow.

    Returns
    -------
    dict
        recording; start, step, duration [s]; outputs, each with name, unit, n, measured, simulated, and error_n,
        error_low, error_high. Lengths are in micrometres. Curves are in the form of `packed`.
    """
    time, n = validation.time, len(validation.time)
    first = n // 3 if from_s is None else int(np.searchsorted(time, from_s))
    first = max(0, min(first, n - SAMPLES))
    every = max(1, min(SAMPLES, n) // POINTS)
    part = slice(first, first + SAMPLES, every)
    edges = np.linspace(0, n, min(BINS, n) + 1).astype(int)[:-1]
    outputs = []
    for i, (name, unit) in enumerate(zip(validation.output_names, validation.output_units, strict=True)):
        factor, shown = (1e6, "µm") if unit == "m" else (1.0, unit or "-")
        measured, simulated = factor * validation.measured[:, i], factor * validation.simulated[:, i]
        error = measured - simulated
        outputs.append(
            {
                "name": name,
                "unit": shown,
                "n": len(measured[part]),
                "measured": packed(measured[part]),
                "simulated": packed(simulated[part]),
                "error_n": len(edges),
                "error_low": packed(np.minimum.reduceat(error, edges)),
                "error_high": packed(np.maximum.reduceat(error, edges)),
            }
        )
    step = float(time[1] - time[0]) if n > 1 else 0.0
    return {
        "recording": validation.recording,
        "start": float(time[first]),
        "step": every * step,
        "duration": n * step,
        "outputs": outputs,
    }


def packed(values: FloatArray) -> dict[str, Any]:
    """Return a curve as base64 of little-endian 16-bit integers, and the factor from these to the values."""
    largest = float(np.abs(values).max(initial=0.0))
    scale = largest / _LARGEST if largest > 0 else 1.0
    integers = np.round(values / scale).astype("<i2")
    return {"scale": scale, "values": b64encode(integers.tobytes()).decode("ascii")}


# ---- Data of the gain explorer in the page: numbers of the model, ranges, and gains at the start.

PEAK_SENSITIVITY = 2.6
"""Largest peak of S_o without a warning: the default cap of `gbid.tune`."""
GAIN_RANGE = (-1.0, 3.0)
CORNER_RANGE = (100.0, 2500.0)
FREQUENCY_RANGE = (5.0, 1000.0)


def explorer_model(model: LPVModel, impact: HalfSine) -> dict[str, Any]:
    """Return the numbers from which the page computes the loop.

    Parameters
    ----------
    model : LPVModel
        Model with actuators.
    impact : HalfSine
        Impact; the page chooses its direction.

    Returns
    -------
    dict
        coefficients (Eq. 16), actuators (Eq. 12), pade_order, impact (peak [N], duration [s], mass [kg]),
        frequency [Hz] (first and last), peak_sensitivity.
    """
    return {
        "name": model.name,
        "coefficients": {key: list(values) for key, values in model.coefficients.items()},
        "actuators": dict(model.actuators),
        "pade_order": model.pade_order,
        "impact": {"peak": impact.peak_n, "duration": impact.duration_s, "mass": impact.mass_kg},
        "frequency": list(FREQUENCY_RANGE),
        "peak_sensitivity": PEAK_SENSITIVITY,
    }


def explorer_part(
    model: LPVModel,
    words: str,
    points: Sequence[tuple[float, float]],
    designs: Sequence[tuple[str, Any, Mapping[str, float]]],
    impact: HalfSine,
) -> Templated:
    """Return the gain explorer as a block of the page.

    Parameters
    ----------
    model : LPVModel
        Model with actuators.
    words : str
        Description of the model.
    points : sequence of (pressure_bar, speed_rpm)
        Operating points [bar], [rpm]. The explorer starts at the one nearest to the middle of the domain.
    designs : sequence of (name, structure, gains)
        Designs. P controllers with a first-order low-pass become buttons; the explorer starts with the last of them.
    impact : HalfSine
        Impact of the response.
    """
    buttons: list[tuple[str, list[float | None]]] = [("no feedback", [0.0, 0.0, None])]
    for name, structure, gains in designs:
        if isinstance(structure, PStructure) and structure.order == 1:
            corner = 1e3 * gains["lowpass_khz"] if structure.tune_corner else structure.lowpass_hz
            buttons.append((name, [gains["kappa_x"], gains["kappa_y"], corner]))
    pressures, speeds = ranges = model.domain.pressure_bar, model.domain.speed_rpm
    middle = sum(pressures) / 2, sum(speeds) / 2

    def far(point: tuple[float, float]) -> float:
        parts = zip(point, middle, ranges, strict=True)
        return sum(abs(value - centre) / (high - low or 1) for value, centre, (low, high) in parts)

    start = min(points, key=far, default=middle)
    gain_x, gain_y, lowpass = buttons[-1][1]
    controls = [
        ("pressure", "Injection pressure", "bar", *pressures, 0.05, start[0]),
        ("speed", "Speed", "rpm", *speeds, 50, start[1]),
        ("kappa_x", "Gain κx", "m/m", *GAIN_RANGE, 0.005, gain_x),
        ("kappa_y", "Gain κy", "m/m", *GAIN_RANGE, 0.005, gain_y),
        ("corner", "Low-pass corner", "Hz", *CORNER_RANGE, 10, lowpass or 1000.0),
    ]
    keys = ("name", "label", "unit", "low", "high", "step", "value")
    return Templated(
        "explorer.html.j2",
        {
            "words": words,
            "model": explorer_model(model, impact),
            "controls": [dict(zip(keys, control, strict=True)) for control in controls],
            "buttons": buttons,
        },
    )
