"""Drawing of the page of concepts: machine, signals, loop and surface."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

import gbid
from gbid.report.diagrams import block, chain, total, wire, word

BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#666666"
figure = Figure(figsize=(9.0, 7.6), layout="constrained")
panels = figure.subplots(2, 2)


def arrow(ax, begin, end, colour, style="-|>", **options):
    ax.add_patch(
        FancyArrowPatch(begin, end, arrowstyle=style, mutation_scale=11, color=colour, shrinkA=0, shrinkB=0, **options)
    )


# The machine, seen along the shaft.
ax = panels[0, 0]
ax.set(xlim=(-2.5, 2.5), ylim=(-2.5, 2.5), aspect="equal", title="the machine, seen along the shaft")
ax.set_axis_off()
ax.add_patch(Circle((0, 0), 1.25, fill=False, edgecolor=GREY, linewidth=6))
centre = np.array([0.16, 0.12])
ax.add_patch(Circle(centre, 0.95, facecolor="#e3edf5", edgecolor="black"))
for angle in (0, 90, 180, 270):
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    corner = 1.9 * direction - 0.3
    ax.add_patch(Rectangle(corner, 0.6, 0.6, facecolor="#f5e3d5", edgecolor="black"))
    arrow(ax, 1.6 * direction, 1.31 * direction, ORANGE)
ax.text(0, 1.9, "piezo", ha="center", va="center", fontsize=8)
ax.text(0, -1.9, "piezo", ha="center", va="center", fontsize=8)
ax.text(1.9, 0, "piezo", ha="center", va="center", fontsize=8)
ax.text(-1.9, 0, "piezo", ha="center", va="center", fontsize=8)
ax.text(-2.45, -2.1, "orange: gas, at the\ninjection pressure", fontsize=8, color=ORANGE, va="center")
arrow(ax, (1.6, -0.5), (2.2, -0.5), BLUE, "<|-|>")
ax.text(1.9, -0.62, "$u_x$", color=BLUE, ha="center", va="top", fontsize=11)
arrow(ax, (-0.5, 1.6), (-0.5, 2.2), BLUE, "<|-|>")
ax.text(-0.62, 1.9, "$u_y$", color=BLUE, ha="right", va="center", fontsize=11)
ax.plot(0, 0, "+", color="black", markersize=9)
ax.plot(*centre, "o", color=BLUE, markersize=4)
ax.text(centre[0] + 0.08, centre[1] - 0.26, "$p$", color=BLUE, fontsize=12)
ax.plot(
    [centre[0], centre[0] + 0.95 * np.cos(2.2)], [centre[1], centre[1] + 0.95 * np.sin(2.2)], color=GREY, linewidth=1
)
ax.add_patch(
    FancyArrowPatch(
        (centre[0] + 0.5, centre[1]),
        (centre[0] + 0.5 * np.cos(2.2), centre[1] + 0.5 * np.sin(2.2)),
        connectionstyle="arc3,rad=0.45",
        arrowstyle="-|>",
        mutation_scale=10,
        color=GREY,
    )
)
ax.text(centre[0] + 0.18, centre[1] + 0.52, "$\\phi$", color=GREY, fontsize=12)

# The signals over time, from the virtual rig.
ax = panels[0, 1]
published = gbid.load_model("theisen2016")
machine = gbid.rig.Machine.from_parameters(published.key_parameters(5.0, 6000.0), published.actuators)
made = gbid.rig.record(
    machine, gbid.rig.Prbs(0.3), conditions={"pressure_bar": 5.0, "speed_rpm": 6000.0}, seed=4, name="moved"
)
still = gbid.rig.record(
    machine, gbid.rig.Stationary(0.3), conditions={"pressure_bar": 5.0, "speed_rpm": 6000.0}, seed=5, name="still"
)
runout = gbid.identify_runout(still)
clean = gbid.prefilter(made, runout)[0]
window = slice(860, 1110)
ms = 1e3 * made.sample_time * np.arange(len(made))[window]
for name, source, colour, shift in (
    ("r", made, GREY, 46.0),
    ("u", made, ORANGE, 24.0),
    ("p", made, BLUE, -4.0),
    ("p", clean, "black", -34.0),
):
    value = 1e6 * (source.signal(name)[window, 0] - source.signal(name)[:, 0].mean()) + shift
    ax.plot(ms, value, color=colour, linewidth=1.1, drawstyle="steps-post" if name == "r" else "default")
texts = (
    "r: the computer holds it between samples",
    "u: the piezos follow",
    "p as the sensor shows it, with run-out",
    "p without run-out: what the model describes",
)
for level, words, colour in zip((53, 33, 8, -22), texts, (GREY, ORANGE, BLUE, "black"), strict=True):
    ax.text(ms[0], level, words, fontsize=8, color=colour)
ax.set(xlabel="time [ms]", yticks=[], title="the signals in x", ylim=(-48, 60))

# The loop.
ax = panels[1, 0]
ax.set(xlim=(0, 10), ylim=(0.2, 5.2), aspect="equal", title="the loop")
ax.set_axis_off()
piezos = block(ax, 2.7, 3.6, "piezos", 1.6, 0.9)
delay = block(ax, 5.0, 3.6, "delay\n$\\tau$", 1.2, 0.9)
rotor = block(ax, 7.2, 3.6, "rotor and\nbearing", 1.8, 0.9)
control = block(ax, 5.0, 1.0, "run-out removed,\ncontroller", 2.6, 0.9)
junction = total(ax, 9.1, 3.6)
chain(ax, (0.6, 3.6), piezos, delay, rotor, junction)
wire(ax, [(9.1, 4.9), (9.1, 3.75)])
wire(ax, [(9.23, 3.6), (9.8, 3.6), (9.8, 1.0), control.right])
wire(ax, [control.left, (0.6, 1.0), (0.6, 3.6)], arrow=False)
word(ax, 1.2, 3.65, "$r$", fontsize=12)
word(ax, 3.95, 3.65, "$u$", fontsize=12)
word(ax, 8.5, 3.65, "$p$", fontsize=12)
word(ax, 8.9, 4.75, "run-out($\\phi$)", ha="right", va="center", fontsize=9)

# Surfaces over operating points.
ax.figure.delaxes(panels[1, 1])
ax = figure.add_subplot(2, 2, 4, projection="3d")
pressure, speed = np.meshgrid(np.linspace(3, 7, 20), np.linspace(0, 6000, 20))
damping = np.vectorize(lambda bar, rpm: min(d for _, d in published.at(bar, rpm).modes()))(pressure, speed)
ax.plot_surface(pressure, speed / 1000, damping, color="#9ec5e8", alpha=0.7, edgecolor="none")
points = [(bar, rpm) for bar in (3.0, 5.0, 7.0) for rpm in (0.0, 3000.0, 6000.0)]
ax.scatter(
    *zip(*((bar, rpm / 1000, min(d for _, d in published.at(bar, rpm).modes())) for bar, rpm in points), strict=True),
    color="black",
    s=14,
)
ax.set(
    xlabel="pressure [bar]",
    ylabel="speed [1000 rpm]",
    title="a surface and operating points",
    xticks=[3, 5, 7],
    yticks=[0, 3, 6],
)
ax.tick_params(labelsize=8)
ax.set_box_aspect(None, zoom=0.85)
ax.set_zlabel("smallest damping factor", labelpad=8)
