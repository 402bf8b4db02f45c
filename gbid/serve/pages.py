"""Pages of the server: the report with a line that follows the campaign, and the gain explorer."""

from __future__ import annotations

from importlib.resources import files
from math import isfinite
from typing import Any

from markupsafe import Markup

from gbid.report.html.render import environment, page_part, script
from gbid.report.reader.designs import AssessedDesign
from gbid.serve.live import Live

_STEPS = 400  # of a slider
_FOLLOW = "</body>"


def report_page(live: Live) -> str:
    """Return the report with the line that follows the campaign."""
    added = environment(_own).get_template("follow.html.j2").render(follow=script(_own("follow.js")))
    return live.page().replace(_FOLLOW, f"{added}\n{_FOLLOW}")


def explorer_page(live: Live) -> str:
    """Return the gain explorer for all designs of the experiment.

    Raises
    ------
    UsageError
        When there is no design.
    """
    designs = [_described(design) for design in live.designs().values()]
    template = environment(_own).get_template("explorer_page.html.j2")
    return template.render(
        name=live.name,
        designs=designs,
        style=Markup(page_part("style.css")),
        scripts=[script(page_part("charts.js")), script(_own("explorer_page.js"))],
    )


def _own(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _described(design: AssessedDesign) -> dict[str, Any]:
    """Return what the page needs to know of a design: ranges of operating point and gains, and values."""
    pressures, speeds = design.plant.domain.pressure_bar, design.plant.domain.speed_rpm
    first = design.figures.points[0]
    controls = [
        _control("pressure_bar", "Injection pressure", "bar", *pressures, float(first[0])),
        _control("speed_rpm", "Speed", "rpm", *speeds, float(first[1])),
    ]
    for parameter in design.structure.parameters:
        value = design.figures.gains[parameter.name]
        room = 3 * max(abs(value), 1e-3)
        low = parameter.lower if isfinite(parameter.lower) else value - room
        high = parameter.upper if isfinite(parameter.upper) else value + room
        controls.append(_control(parameter.name, parameter.name, parameter.unit or "-", low, high, value))
    return {
        "name": design.name,
        "structure": design.structure.name,
        "cap": design.cap,
        "sample_time_ms": 1e3 * design.sample_time,
        "impact": f"{design.impact.peak_n:g} N, {1e3 * design.impact.duration_s:g} ms",
        "controls": controls,
    }


def _control(name: str, label: str, unit: str, low: float, high: float, value: float) -> dict[str, Any]:
    step = (high - low) / _STEPS or 1.0
    return {"name": name, "label": label, "unit": unit, "low": low, "high": high, "step": step, "value": value}
