"""Steps of the five-minute page: each runs its commands, or shows the picture of what they made."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import gbid
from docs.code import command_line
from docs.code.pictures import show, show_impact
from gbid import report

os.chdir(tempfile.mkdtemp())
RESULTS = Path("rig1/results/one_point")
SHOWN = {  # lines of each command that the page shows, and how many
    "new": ("experiment.yaml", 9),
    "rig": ("^p5|done", 99),
    "prefilter": ("auto", 99),
    "fit": ("^bearing, p5_n6000_prbs1|^ *parameter|^[kdb]_xx|^tau", 7),
    "crossval": (r"^(model of|p5.* p_[xy] .*%|p5_n6000_prbs. .* p_)", 7),
    "lpv": ("made", 99),
    "tune": ("^(figure|smallest|peak S_o|sampled|feedback .P)", 6),
    "export": ("controller_feedback", 99),
}


def run(command):
    """Print a command line and the lines of its output that matter here."""
    verb = command.split(" --only ")[-1].split()[0] if " --only " in command else command.split()[1]
    keep, most = SHOWN[verb]
    command_line.run(command, keep=keep, most=most)


def print_experiment():
    print(Path("rig1/experiment.yaml").read_text().partition("format: 1")[2].strip())


def show_aim():
    alt = "Block diagram: the position p goes through a controller to the references r, the piezos and the rotor."
    return show(report.plot_closed_loop(), "aim", alt)


def show_recording():
    recording = gbid.load_recording(RESULTS / "recordings/p5_n6000_prbs1.h5")
    drawn = report.plot_recording(recording, from_s=1.0, to_s=1.2)
    return show(drawn, "recording", "References r, piezo positions u and disc position p over 0.2 s.")


def first_fit():
    return gbid.load(RESULTS / "fits/bearing/p5_n6000_prbs1.h5")


def show_modes():
    fit = first_fit()
    for (frequency, damping), (f_std, d_std) in zip(fit.model.modes(), fit.modes_std, strict=True):
        print(f"mode at {frequency:.2f} +- {f_std:.2g} Hz, damping factor {damping:.4f} +- {d_std:.1g}")
    filtered = gbid.load_recording(RESULTS / "prefiltered/p5_n6000_prbs1.h5")
    measured = gbid.measured_response(filtered, "u", "p", resolution_hz=2.0)
    drawn = report.plot_bode(fit, measured=measured, frequency_hz=np.geomspace(20, 400, 300))
    alt = "Magnitude and phase of the model with its confidence band, over the response measured in the recording."
    return show(drawn, "bode", alt)


def show_prediction():
    other = gbid.load_recording(RESULTS / "prefiltered/p5_n6000_prbs2.h5")
    drawn = report.plot_response(gbid.cross_validate(first_fit(), other), from_s=1.0, to_s=1.1)
    return show(drawn, "response", "Measured and simulated disc positions of another recording lie on each other.")


def show_design():
    design = gbid.load_controller(RESULTS / "controller/feedback.yaml")
    plant = gbid.load_model(RESULTS / "lpv/bearing.yaml").plant_at(5.0, 6000.0)
    return show_impact(plant, gbid.controller_structure("P"), design.gains, "impact")


def run_selftest():
    if shutil.which("cc"):
        sources = [str(RESULTS / f"export/controller_feedback{part}.c") for part in ("", "_selftest")]
        command = ["cc", "-std=c99", "-DCONTROLLER_FEEDBACK_SELFTEST_MAIN", *sources, "-lm", "-o", "selftest"]
        subprocess.run(command, check=True)
        printed = subprocess.run("./selftest", capture_output=True, text=True, check=True).stdout.strip()
        print("$ ./selftest", printed, sep="\n")
