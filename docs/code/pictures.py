"""Pictures of pages: what a figure function has drawn, as a file and in the page."""

from pathlib import Path

import numpy as np
from IPython.display import Image

import gbid
from gbid.control import HalfSine, controller_model, impact_response
from gbid.report import plot_impact, save_figure
from gbid.report.impact_pictures import ImpactCurves


def show(drawn, name, alt, width=700):
    """Save a figure as NAME.png and return the image, with its text for readers who do not see it."""
    save_figure(drawn, Path(f"{name}.png"))
    return Image(f"{name}.png", alt=alt, width=width)


def show_impact(plant, structure, gains, name):
    """Position of the disc after a hammer impact of 12 N, without control and with a controller."""
    impact = HalfSine(peak_n=12.0, duration_s=2e-3, mass_kg=2.18)
    time, curves = np.arange(0.0, 0.1, 1e-4), {}
    for label, controller in {"without control": None, "tuned": controller_model(structure, gains)}.items():
        response = impact_response(plant, controller, impact)
        curves[label] = np.interp(time, response.time_s, response.p[:, 0])
    alt = "Disc position after a hammer impact: it rings for long without control, and decays fast with it."
    return show(plot_impact(ImpactCurves(time, curves)), name, alt)


def show_index():
    """Impact response of the design whose code the index shows."""
    machine = gbid.load_model("theisen2016")
    design = gbid.tune(machine, operating_points=[(6.0, 0.0)], peak_sensitivity=2.6)
    return show_impact(machine.plant_at(6.0, 0.0), design.controller, design.gains, "index")
