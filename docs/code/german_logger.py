"""Folder of a German logger for the page of imports, and command lines in the process of that page."""

import io
import os
import shlex
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
from scipy.io import savemat

import gbid
from gbid.cli.main import app
from gbid.rig import Machine, Prbs, Stationary, record

os.chdir(tempfile.mkdtemp())
STEP, RUN_UP_S, SPEED = 4e-4, 2.0, 4000
random = np.random.default_rng(1)
published = gbid.load_model("theisen2016")
before = ["Messprogramm 3.1", "Prüfstand: Gaslager; Anlauf in den ersten 2 s", ""]
names = "Zeit;Referenz x;Referenz y;Piezo x;Piezo y;Weg x;Weg y;Drehwinkel"
n = round(RUN_UP_S / STEP)
rest = RUN_UP_S - STEP * np.arange(n)
junk = np.column_stack([np.zeros((n, 2)), 0.5 * random.standard_normal((n, 4))])


def logged(pressure, kind, name):
    """Columns of a file: time, six positions in um, angle in degrees."""
    point = {"pressure_bar": pressure, "speed_rpm": SPEED}
    true = {**published.key_parameters(**point), **published.actuators}
    what = Stationary(1.1) if kind == "still" else Prbs(1.6)
    made = record(Machine.from_parameters(true, true), what, conditions=point, seed=1, name=name, sample_time=STEP)
    angle = np.rad2deg(np.unwrap(made.signal("phi")[:, 0]))
    run_up = angle[0] - 6 * SPEED * (rest - rest**2 / (2 * RUN_UP_S))
    phi = np.mod(np.concatenate([run_up, angle]), 360)
    positions = np.vstack([junk, 1e6 * np.hstack([made.signal(signal) for signal in "rup"])])
    return np.column_stack([STEP * np.arange(len(phi)), positions, phi])


Path("Messungen").mkdir()
form = ";".join(["%.6f"] + ["%.4f"] * 7)
for pressure in (5, 6):
    for kind in ("still 1", "prbs 1"):
        name = f"Lager {pressure} bar {SPEED} rpm {kind}"
        rows = [form % tuple(row) for row in logged(pressure, kind.split()[0], name).tolist()]
        text = "\r\n".join([*before, names, "s;µm;µm;µm;µm;µm;µm;°", *(row.replace(".", ",") for row in rows), ""])
        Path("Messungen", f"{name}.csv").write_bytes(text.encode("cp1252"))
name = f"Lager 6 bar {SPEED} rpm prbs 2"
values = logged(6, "prbs", name)
channels = {"Zeit": values[:, 0], "Referenz": values[:, 1:3], "Piezo": values[:, 3:5], "Weg": values[:, 5:7]}
savemat(f"Messungen/{name}.mat", {**channels, "Drehwinkel": values[:, 7]})


def run(command, last=60, code=0):
    """Run a command line in this process and print the last lines that it prints."""
    said, end, words = io.StringIO(), 0, shlex.split(command)[1:]
    words += ["--engine", "serial"] * (words[0] == "run")
    with redirect_stdout(said), redirect_stderr(said):
        try:
            app(words, prog_name="gbid")
        except SystemExit as stop:
            end = stop.code or 0
    lines = said.getvalue().rstrip().splitlines()
    print(f"$ {command}", *(["..."] if len(lines) > last else []), *lines[-last:], sep="\n")
    assert end == code, said.getvalue()
