"""Recordings of the virtual rig that pages take as examples."""

import re

import numpy as np

import gbid
from gbid.rig import Machine, Prbs, SensorChain, Unbalance, record
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


def compare_surfaces(fit):
    """Print how often the surfaces of a fit lie within three standard deviations of the published ones."""
    rng = np.random.default_rng(0)
    pressure, speed = rng.uniform(3, 7, 1000), rng.uniform(0, 6000, 1000)
    std = np.sqrt(np.einsum("nii->ni", fit.uncertainty_at(pressure, speed)))
    estimates, true = (model.key_parameters(pressure, speed) for model in (fit.model, published))
    error = np.stack([estimates[key] - true[key] for key in KEY_PARAMETERS], axis=-1)
    print(f"within 3 standard deviations: {100 * np.mean(np.abs(error) < 3 * std):.1f} %")


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


def show(results, names=("k_xx", "d_xx", "tau_x")):
    """Print some estimates of each fit with their standard deviations, its status and the codes of its notes."""
    for label, result in results.items():
        numbers = ", ".join(f"{name} {result.parameters[name]:.7g} +- {result.std[name]:.2g}" for name in names)
        codes = ", ".join(re.findall(r"\[(GB\d+)\]", " ".join(result.notes)))
        print(f"{label:22} {numbers}; {result.status}{f'; notes {codes}' if codes else ''}")
