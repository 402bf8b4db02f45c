"""Elements of block diagrams: blocks, sums, wires and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch

from gbid.report.figures.canvas import BLACK, panels

Point = tuple[float, float]
FILL, TINT = "#ffffff", "#e3edf5"
_LINE = 0.9
_RADIUS = 0.13


def diagram(ax: Axes | None, width: float, top: float, inches: float, bottom: float = 0.0) -> Axes:
    """Return axes with `width` units for a diagram; new axes are `inches` wide."""
    _, (ax, *_) = panels(ax, size=(inches, inches * (top - bottom) / width))
    ax.set(xlim=(0, width), ylim=(bottom, top), aspect="equal")
    ax.set_axis_off()
    return ax


@dataclass(frozen=True)
class Block:
    """Block with the points at which wires end."""

    x: float
    y: float
    width: float
    height: float

    @property
    def left(self) -> Point:
        """Middle of the left side."""
        return self.x - self.width / 2, self.y

    @property
    def right(self) -> Point:
        """Middle of the right side."""
        return self.x + self.width / 2, self.y

    @property
    def top(self) -> Point:
        """Middle of the upper side."""
        return self.x, self.y + self.height / 2

    @property
    def bottom(self) -> Point:
        """Middle of the lower side."""
        return self.x, self.y - self.height / 2


def block(
    ax: Axes, x: float, y: float, text: str, width: float = 1.3, height: float = 0.7, fill: str = FILL, **options: Any
) -> Block:
    """Draw a block with a text of one or more lines."""
    corner = (x - width / 2, y - height / 2)
    style = "round,pad=0,rounding_size=0.06"
    look: dict[str, Any] = {"facecolor": fill, "edgecolor": BLACK, "linewidth": _LINE, "zorder": 2.5}
    ax.add_patch(FancyBboxPatch(corner, width, height, style, **look))  # above a wire that passes through
    ax.text(x, y, text, ha="center", va="center", **{"fontsize": 9, "linespacing": 1.25, "zorder": 3, **options})
    return Block(x, y, width, height)


def total(ax: Axes, x: float, y: float, **signs: str) -> Block:
    """Draw a sum; signs by side, as ``left="+", bottom="-"``, are written beside the wires that end there."""
    ax.add_patch(Circle((x, y), _RADIUS, facecolor=FILL, edgecolor=BLACK, linewidth=_LINE))
    places = {"left": (-0.24, 0.13), "right": (0.24, 0.13), "top": (0.15, 0.24), "bottom": (0.15, -0.24)}
    for side, sign in signs.items():
        dx, dy = places[side]
        ax.text(x + dx, y + dy, sign.replace("-", "−"), ha="center", va="center", fontsize=8)
    return Block(x, y, 2 * _RADIUS, 2 * _RADIUS)


def wire(ax: Axes, points: Sequence[Point], arrow: bool = True, **style: Any) -> None:
    """Draw a line through points, with an arrow at its end."""
    look = {"color": BLACK, "linewidth": _LINE, **style}
    line = points[:-1] if arrow else points
    if len(line) > 1:
        ax.plot(*zip(*line, strict=True), solid_joinstyle="miter", solid_capstyle="butt", **look)
    if arrow:
        shape = {"arrowstyle": "-|>,head_width=0.16,head_length=0.36", "shrinkA": 0, "shrinkB": 0, **look}
        ax.annotate("", xy=points[-1], xytext=points[-2], arrowprops=shape)


def dot(ax: Axes, x: float, y: float) -> None:
    """Mark a branch of a wire."""
    ax.plot(x, y, marker="o", markersize=3, color=BLACK)


def word(ax: Axes, x: float, y: float, text: str, **options: Any) -> None:
    """Write a label beside a wire."""
    ax.text(x, y, text, **{"ha": "center", "va": "bottom", "fontsize": 9, **options})


def frame(ax: Axes, x: float, y: float, width: float, height: float, text: str, down: float = 0.1) -> None:
    """Draw a tinted frame around a group, from its lower left corner, with its name `down` below its top."""
    style = "round,pad=0,rounding_size=0.1"
    box = FancyBboxPatch((x, y), width, height, style, facecolor=TINT, edgecolor="none", zorder=0)
    ax.add_patch(box)
    ax.text(x + width / 2, y + height - down, text, ha="center", va="top", fontsize=8, color="#33505f")
