"""Block and flow diagrams of the method (paper, Figs. 3, 4, 6 and 19)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch

from gbid.report.canvas import BLACK, TWO_COLUMNS, one_panel, styled

Point = tuple[float, float]
FILL, TINT = "#ffffff", "#e3edf5"
_LINE = 0.9
_RADIUS = 0.13


def diagram(ax: Axes | None, width: float, top: float, inches: float, bottom: float = 0.0) -> Axes:
    """Return axes of `width` units for a diagram; the figure of new axes is `inches` wide."""
    _, ax = one_panel(ax, (inches, inches * (top - bottom) / width))
    ax.set(xlim=(0, width), ylim=(bottom, top), aspect="equal")
    ax.set_axis_off()
    return ax


@dataclass(frozen=True)
class Block:
    """Block of a diagram with the points at which wires end."""

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
    """Draw a summing junction; signs by side, such as ``left="+", bottom="-"``, stand beside the wires."""
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


def chain(ax: Axes, *places: Block | Point) -> None:
    """Draw a wire from each block to the next block on its right; the ends may be points."""
    for begin, end in pairwise(places):
        wire(ax, [begin.right if isinstance(begin, Block) else begin, end.left if isinstance(end, Block) else end])


def dot(ax: Axes, x: float, y: float) -> None:
    """Mark a branch of a wire."""
    ax.plot(x, y, marker="o", markersize=3, color=BLACK)


def word(ax: Axes, x: float, y: float, text: str, **options: Any) -> None:
    """Write a label beside a wire."""
    ax.text(x, y, text, **{"ha": "center", "va": "bottom", "fontsize": 9, **options})


def frame(ax: Axes, x: float, y: float, width: float, height: float, text: str, down: float = 0.1) -> None:
    """Draw a tinted frame around a group from its lower left corner; its name stands `down` below the top."""
    style = "round,pad=0,rounding_size=0.1"
    box = FancyBboxPatch((x, y), width, height, style, facecolor=TINT, edgecolor="none", zorder=0)
    ax.add_patch(box)
    ax.text(x + width / 2, y + height - down, text, ha="center", va="top", fontsize=8, color="#33505f")


@styled
def plot_differential_pairing(ax: Axes | None = None) -> Axes:
    """Draw how two references move four piezos, and four positions become two differences (Eqs. 1, 2; Fig. 3).

    Parameters
    ----------
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    ax = diagram(ax, 9.2, 4.6, TWO_COLUMNS)
    for axis, middle, (first, second) in (("x", 3.35, (2, 4)), ("y", 1.15, (1, 3))):
        orientation = "horizontal" if axis == "x" else "vertical"
        frame(ax, 1.55, middle - 1.0, 6.05, 2.0, f"{orientation} pair", down=0.9)
        word(ax, 0.45, middle, f"$r_{axis}$", ha="right", va="center")
        wire(ax, [(0.55, middle), (1.85, middle)], arrow=False)
        dot(ax, 1.85, middle)
        difference = total(ax, 7.05, middle, top="+", bottom="-")
        for number, y, sign in ((first, middle + 0.5, "+"), (second, middle - 0.5, "-")):
            up = number == first
            offset = total(ax, 2.75, y, left=sign)
            wire(ax, [(1.85, middle), (1.85, y), offset.left])
            side = offset.top if up else offset.bottom
            wire(ax, [(side[0], y + (0.42 if up else -0.42)), side])
            word(ax, 2.88, y + (0.28 if up else -0.28), "$r_0$", ha="left", va="center")
            piezo = block(ax, 4.85, y, f"piezo {number}, PD controlled", width=2.1, height=0.52)
            wire(ax, [offset.right, piezo.left])
            word(ax, 3.33, y + 0.04, f"$r_{{p,{number}}}$")
            wire(ax, [piezo.right, (7.05, y), difference.top if up else difference.bottom])
            word(ax, 6.35, y + 0.04, f"$y_{{p,{number}}}$")
        wire(ax, [difference.right, (8.6, middle)])
        word(ax, 8.7, middle, f"$u_{axis}$", ha="left", va="center")
    return ax


@styled
def plot_identification_flow(ax: Axes | None = None) -> Axes:
    """Draw which signals identify which model, and how the models make the plant (Eq. 3; Fig. 4).

    Parameters
    ----------
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    ax = diagram(ax, 9.2, 4.7, TWO_COLUMNS, bottom=0.3)
    frame(ax, 1.35, 3.35, 6.5, 1.25, "test rig, or virtual rig")
    actuators = block(ax, 2.75, 3.85, "piezos", width=1.6)
    bearing = block(ax, 6.2, 3.85, "gas bearing,\nshaft and disc", width=1.9)
    chain(ax, (0.75, 3.85), actuators, bearing, (8.5, 3.85))
    word(ax, 0.65, 3.85, r"$\mathbf{r}$", ha="right", va="center")
    word(ax, 4.4, 3.9, r"$\mathbf{u}$")
    word(ax, 8.6, 3.85, r"$\mathbf{p}$", ha="left", va="center")
    fits = []
    for x, text, taps in (
        (2.75, "fit the actuators\n" + r"$\{\mathbf{r}, \mathbf{u}\} \rightarrow \hat{\theta}_a$", (1.1, 4.2)),
        (6.2, "fit the rotor-bearing\n" + r"$\{\mathbf{u}, \mathbf{p}\} \rightarrow \hat{\theta}_b$", (4.6, 8.1)),
    ):
        fit = block(ax, x, 2.25, text, width=2.1, height=0.85, fill=TINT)
        for tap, end in zip(taps, (fit.left, fit.right), strict=True):
            dot(ax, tap, 3.85)
            wire(ax, [(tap, 3.85), (tap, 2.25), end])
        fits.append(fit)
    block(ax, 8.1, 2.95, "prefilter", width=1.3, height=0.46)
    for fit, text in zip(fits, (r"$\mathbf{G}_{act}$", r"$\mathbf{G}_{rb}$"), strict=True):
        model = block(ax, fit.x, 0.75, text, width=1.3, height=0.6)
        wire(ax, [fit.bottom, model.top])
        word(ax, fit.x + 0.1, 1.4, "cross-validated", ha="left", va="center", fontsize=8)
    wire(ax, [(3.4, 0.75), (5.55, 0.75)])
    word(ax, 4.475, 0.8, r"$\mathbf{G} = \mathbf{G}_{rb}\,\mathbf{G}_{act}$")
    wire(ax, [(1.2, 0.75), (2.1, 0.75)])
    wire(ax, [(6.85, 0.75), (7.75, 0.75)])
    word(ax, 1.1, 0.75, r"$\mathbf{r}$", ha="right", va="center")
    word(ax, 7.85, 0.75, r"$\hat{\mathbf{p}}$", ha="left", va="center")
    return ax


@styled
def plot_rotor_bearing_model(ax: Axes | None = None) -> Axes:
    """Draw the rotor-bearing model: delays, two degrees of freedom, disturbance (Eqs. 4 to 10; Fig. 6).

    Parameters
    ----------
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    ax = diagram(ax, 11.2, 4.4, TWO_COLUMNS)
    y = 2.6
    word(ax, 0.4, y, r"$\mathbf{u}$", ha="right", va="center")
    delay = block(ax, 1.45, y, "delays\n" + r"$\mathbf{G}_{\tau}(s)$", width=1.2, height=0.9)
    gain = block(ax, 3.35, y, r"$\mathbf{B}$", width=0.8)
    at = total(ax, 4.7, y, left="+", top="+", bottom="+")
    first = block(ax, 6.1, y, r"$\frac{1}{s}\,\mathbf{I}$", width=0.8)
    second = block(ax, 7.9, y, r"$\frac{1}{s}\,\mathbf{I}$", width=0.8)
    out = total(ax, 9.7, y, left="+", top="+")
    chain(ax, (0.5, y), delay, gain, at, first, second, out, (10.6, y))
    names = (r"\mathbf{u}_\tau", r"\ddot{\mathbf{p}}", r"\dot{\mathbf{p}}", r"\mathbf{p}")
    for x, name in zip((2.5, 5.27, 7.25, 9.15), names, strict=True):
        word(ax, x, y + 0.05, f"${name}$")
    word(ax, 10.68, y, r"$\mathbf{y}_b$", ha="left", va="center")
    damping = block(ax, 6.1, 1.5, r"$\mathbf{D}$", width=0.8, height=0.6)
    stiffness = block(ax, 6.1, 0.5, r"$\mathbf{K}$", width=0.8, height=0.6)
    dot(ax, 6.95, y)
    wire(ax, [(6.95, y), (6.95, 1.5), damping.right])
    dot(ax, 8.75, y)
    wire(ax, [(8.75, y), (8.75, 0.5), stiffness.right])
    wire(ax, [stiffness.left, (4.7, 0.5), (4.7, 1.5)], arrow=False)
    dot(ax, 4.7, 1.5)
    wire(ax, [damping.left, (4.7, 1.5)], arrow=False)
    wire(ax, [(4.7, 1.5), at.bottom])
    disturbance = block(ax, 6.1, 3.75, r"$\mathbf{B}_d$", width=0.8, height=0.6)
    wire(ax, [(9.7, 4.2), out.top])
    word(ax, 9.82, 4.05, r"$\mathbf{d}_b$", ha="left", va="center")
    dot(ax, 9.7, 3.75)
    wire(ax, [(9.7, 3.75), disturbance.right])
    wire(ax, [disturbance.left, (4.7, 3.75), at.top])
    return ax


@styled
def plot_closed_loop(ax: Axes | None = None) -> Axes:
    """Draw the loop with its decentralised controller and positive feedback (Eqs. 20 to 22; Fig. 19).

    Parameters
    ----------
    ax : matplotlib Axes, optional
        Axes to draw into; a new figure when left out.

    Returns
    -------
    matplotlib Axes
        The axes; ``axes.figure`` is the figure.
    """
    ax = diagram(ax, 10.2, 4.3, TWO_COLUMNS)
    rows = {"x": 3.2, "y": 2.0}
    frame(ax, 2.3, 1.45, 5.6, 2.75, r"plant $\mathbf{G} = \mathbf{G}_{rb}\,\mathbf{G}_{act}$")
    block(ax, 6.6, 2.6, "rotor and\nbearing\n" + r"$\mathbf{G}_{rb}(s)$", width=1.6, height=1.9)
    frame(ax, 3.1, 0.1, 4.1, 1.15, r"controller $\mathbf{K}_{pl}$")
    lowpass = block(ax, 6.2, 0.5, r"$H_{lp}(s)$", width=1.2, height=0.6)
    gains = block(ax, 4.3, 0.5, r"$\mathrm{diag}(\kappa_x, \kappa_y)$", width=1.8, height=0.6)
    for axis, y in rows.items():
        at = total(ax, 1.6, y, left="+", bottom="+")
        actuator = block(ax, 3.6, y, f"$G_{{a,{axis}}}(s)$", width=1.4, height=0.7)
        chain(ax, (0.6, y), at, actuator, (5.8, y))
        word(ax, 0.5, y, f"$w_{axis}$", ha="right", va="center")
        word(ax, 2.1, y + 0.05, f"$r_{axis}$")
        word(ax, 5.05, y + 0.05, f"$u_{axis}$")
        wire(ax, [(7.4, y), (9.6, y)])
        word(ax, 9.68, y, f"$p_{axis}$", ha="left", va="center")
    for axis, y, x in (("x", rows["x"], 8.5), ("y", rows["y"], 8.2)):
        dot(ax, x, y)
        down = 0.62 if axis == "x" else 0.38
        wire(ax, [(x, y), (x, down), (lowpass.right[0], down)])
        wire(ax, [(lowpass.left[0], down), (gains.right[0], down)])
    wire(ax, [(gains.left[0], 0.38), (1.6, 0.38), (1.6, rows["y"] - 0.13)])
    wire(ax, [(gains.left[0], 0.62), (1.15, 0.62), (1.15, 2.6), (1.6, 2.6), (1.6, rows["x"] - 0.13)])
    return ax
