"""Recordings of the virtual rig that pages take as examples."""

import os
import re
import tempfile
from pathlib import Path

import numpy as np

import gbid
from gbid.rig import Machine, Prbs, Scatter, SensorChain, Stationary, Unbalance, record
from gbid.structure import KEY_PARAMETERS

published = gbid.load_model("theisen2016")
NO_RUNOUT = {"runout_amplitude_m": np.zeros((2, 1)), "runout_phase_rad": np.zeros((2, 1))}


def parameters_at(pressure_bar, speed_rpm=0.0):
    """Parameters of the published machine at an operating point, with its actuators."""
    return {**published.key_parameters(pressure_bar, speed_rpm), **published.actuators}


def quiet_machine(pressure_bar):
    """The published machine without rotation, its sensors without run-out."""
    true = parameters_at(pressure_bar)
    return Machine.from_parameters(true, true, sensors=SensorChain(**NO_RUNOUT))


def still_rotor(pressure_bar, name="prbs", seed=1, duration=1.0, machine=None, **excitation):
    """Recording of a rotor without rotation, as it comes from the sensors."""
    point = {"pressure_bar": pressure_bar, "speed_rpm": 0.0}
    machine = machine or quiet_machine(pressure_bar)
    return record(machine, Prbs(duration, **excitation), conditions=point, seed=seed, name=name)


def scattered_recordings():
    """Eighteen short recordings of a machine whose parameters differ from its surfaces by 1 %, and their points."""
    sensors = SensorChain(**NO_RUNOUT, offset_p_m=(0, 0), offset_u_m=(0, 0))
    random, excitation = np.random.default_rng(1), Prbs(amplitude_m=1.5e-6, hold_s=4e-3, duration_s=0.2)
    points = [(pressure, speed) for pressure in (3.0, 5.0, 7.0) for speed in (0.0, 3000.0, 6000.0) for _ in range(2)]
    recordings = []
    for number, (pressure, speed) in enumerate(points):
        true = parameters_at(pressure, speed)
        true |= {key: true[key] * (1 + 0.01 * random.normal()) for key in KEY_PARAMETERS}
        machine = Machine.from_parameters(true, true, unbalance=Unbalance(0.0), sensors=sensors)
        conditions = {"pressure_bar": pressure, "speed_rpm": speed}
        recordings.append(record(machine, excitation, conditions=conditions, seed=number, name=f"run{number}"))
    return recordings, points


def six_recordings():
    """Three filtered recordings at each of two operating points."""
    recordings = []
    for pressure, speed in ((5.0, 6000.0), (6.0, 4000.0)):
        true = parameters_at(pressure, speed)
        machine = Machine.from_parameters(true, true)
        for seed in range(3):
            name = f"p{pressure:g}_n{speed:g}_{seed + 1}"
            conditions = {"pressure_bar": pressure, "speed_rpm": speed}
            raw = record(machine, Prbs(1.0), conditions=conditions, seed=seed + int(10 * pressure), name=name)
            recordings.append(gbid.prefilter(raw)[0])
    return recordings


def logger_files():
    """Go to an empty folder and write the files of the first hour, as a data logger might write them."""
    os.chdir(tempfile.mkdtemp())
    Path("measured").mkdir()
    header = ",".join([*(f"{signal}_{axis} [um]" for signal in "rup" for axis in "xy"), "angle [rad]"])
    for seed, (pressure, speed) in enumerate((p, n) for p in (4.0, 5.0, 6.0) for n in (0.0, 3000.0, 6000.0)):
        machine = Machine.from_parameters(published.key_parameters(pressure, speed), published.actuators)
        conditions = {"pressure_bar": pressure, "speed_rpm": speed}
        for kind, excitation in (("prbs1", Prbs(0.6)), ("prbs2", Prbs(0.6)), ("still1", Stationary(0.6))):
            name = f"p{pressure:g}_n{speed:g}_{kind}"
            made = record(machine, excitation, conditions=conditions, seed=seed, name=name, scatter=Scatter(0.2))
            columns = [*(1e6 * made.signal(signal) for signal in "rup"), made.signal("phi")]
            np.savetxt(f"measured/{name}.csv", np.hstack(columns), "%.7g", ",", header=header, comments="")


def show(results, names=("k_xx", "d_xx", "tau_x")):
    """Print some estimates of each fit with their standard deviations, its status and the codes of its notes."""
    for label, result in results.items():
        numbers = ", ".join(f"{name} {result.parameters[name]:.7g} +- {result.std[name]:.2g}" for name in names)
        codes = ", ".join(re.findall(r"\[(GB\d+)\]", " ".join(result.notes)))
        print(f"{label:22} {numbers}; {result.status}{f'; notes {codes}' if codes else ''}")
