"""Synthetic data for every figure of the report, made from the published model."""

from __future__ import annotations

from functools import cache

import numpy as np
from fit_cases import MODE, MODE_AT, levels, simulated

import gbid
from gbid import report
from gbid.control import p_controller, sensitivity_data
from gbid.report.impact_pictures import ImpactCurves, ImpactLoops
from gbid.report.loop_pictures import ParetoCurves
from gbid.report.measured_pictures import piezo_data
from gbid.report.page import Picture, Pictures
from gbid.structure import LinearModel, evaluate
from gbid.validate import NominalActuator, ValidationScores, summarise
from gbid.validate.central import ActuatorOutlier

POINT = "6 bar, 0 rpm"


class BlankPictures(Pictures):
    """Pictures for tests that read the text around them; to render them takes most of the time of a report."""

    def picture(self, figure, alt, caption=""):
        return Picture("<svg></svg>", caption or alt)


def machine():
    return gbid.load_model("theisen2016")


def estimates(names, points, seed=1):
    """Key parameters at operating points with the scatter of estimates."""
    random = np.random.default_rng(seed)
    true = machine().key_parameters(points[:, 0], points[:, 1])
    return {name: true[name] * (1 + 0.03 * random.standard_normal(len(points))) for name in names}


def grid_points():
    return np.array([(bar, rpm) for bar in (3, 4, 5, 6, 7) for rpm in (0, 4000, 6000)], float)


def surfaces():
    names, points = ("k_xx", "d_xy", "b_yx", "b_yy"), grid_points()
    data = report.surfaces_data(machine(), names, points=points, estimates=estimates(names, points))
    return report.plot_surfaces(data)


def delays():
    points = grid_points()
    result = estimates(("tau_x", "tau_y"), points)
    return report.plot_over_pressure(report.over_pressure_data(machine(), "delay", points=points, estimates=result))


def modes():
    points, random = grid_points(), np.random.default_rng(2)
    true = np.array([[frequency for frequency, _ in machine().at(*point).modes()[:2]] for point in points])
    results = {f"frequency_{i + 1}": true[:, i] * (1 + 0.01 * random.standard_normal(len(points))) for i in range(2)}
    return report.plot_over_pressure(
        report.over_pressure_data(machine(), "frequency", points=points, estimates=results)
    )


def static_gains():
    points, random = grid_points(), np.random.default_rng(3)
    true = np.array([machine().at(*point).static_gain().ravel() for point in points])
    names = [f"g_{i}{j}" for i in "xy" for j in "xy"]
    results = {name: true[:, k] + 0.005 * random.standard_normal(len(points)) for k, name in enumerate(names)}
    return report.plot_over_pressure(report.over_pressure_data(machine(), "gain", points=points, estimates=results))


def histograms():
    random, names = np.random.default_rng(4), tuple(f"r{i}" for i in range(86))
    percent = np.array([81.1, 85.1]) + np.array([2.66, 3.37]) * random.standard_normal((86, 2))
    where, outputs = np.full(86, 6.0), ("p_x", "p_y")
    scores = ValidationScores(names, names, where, where, outputs, ("m", "m"), percent, 1e-6 * percent)
    return report.plot_fit_histogram(summarise(scores))


def nominal():
    """A choice among 86 actuator models, some of them 15 % off."""
    random, true = np.random.default_rng(5), machine().actuators
    models, names = tuple(f"r{i}" for i in range(86)), tuple(true)
    values = np.array(list(true.values())) * (1 + 0.01 * random.standard_normal((86, len(names))))
    out = random.random(values.shape) < 0.06
    values[out] *= 1.15
    typical, z = np.median(values, axis=0), np.where(out, 15.0, 0.0)
    outliers = tuple(
        ActuatorOutlier(models[i], names[k], "gain" if "kappa" in names[k] else "pole", values[i, k], typical[k], 15.0)
        for i, k in np.argwhere(out)
    )
    chosen = dict(zip(names, values[38], strict=True))
    return NominalActuator(
        models[38], chosen, chosen, models, names, values, z, z.mean(axis=1), 3.5, outliers, left_out=()
    )


def actuators():
    return report.plot_actuator_parameters(nominal())


def static_map():
    gain, random = machine().at(6, 0).static_gain(), np.random.default_rng(6)
    levels, recordings = 1e-6 * np.array([*range(-10, 11, 2), *range(8, -11, -2)]), []
    for axis in (0, 1):
        u = np.zeros((200 * len(levels), 2))
        u[:, axis] = np.repeat(levels, 200)
        noise = np.repeat(1e-7 * random.standard_normal((len(levels), 2)), 200, axis=0)
        p = u @ gain.T + 1e-6 * np.array([3.0, -2.0]) + noise + 1e-8 * random.standard_normal(u.shape)
        signals, conditions = {"r": u, "u": u, "p": p}, {"pressure_bar": 6.0, "speed_rpm": 0.0}
        recordings.append(gbid.Recording(signals, 2e-4, name="xy"[axis], conditions=conditions))
    return report.plot_static_map(gbid.characterise_staircase(recordings))


def loop():
    return machine().plant_at(6, 0), p_controller(1.125, 0.99)


def sensitivity():
    return report.plot_magnitudes(sensitivity_data(*loop()), title=POINT)


def impact():
    plant, controller = loop()
    closed = gbid.close_loop(plant, controller)
    time = 2e-4 * np.arange(1000)
    pulse = np.zeros((1000, 2))
    pulse[50:60, 0] = np.sin(np.pi * np.arange(10) / 10)
    responses = {
        name: 2e-5 * m.simulate(pulse, 2e-4)[:, 0] for name, m in (("open loop", plant), ("closed loop", closed))
    }
    forces = {"open loop": 30 * pulse[:, 0], "closed loop": 29 * pulse[:, 0]}
    return report.plot_impact(ImpactCurves(time, responses, forces, "x", POINT))


def impact_loops():
    time = 2e-4 * np.arange(-25, 250)
    since = np.maximum(time, 0)
    mean = {
        name: 8e-6 * np.column_stack([np.exp(-d * since) * np.sin(w * since) for w in (800, 840)])
        for name, d in (("open loop", 25), ("published gains", 300), ("biquad", 600))
    }
    spread = {name: np.full_like(values, 3e-7) for name, values in mean.items()}
    return report.plot_impact_loops(ImpactLoops(time, mean, spread, POINT))


def piezo_staircases():
    steps = np.array([*range(0, 11), *range(9, -1, -1)], float)
    command = np.repeat(steps, 200)
    bow = np.where(np.arange(len(steps)) <= 10, -4.2e-6, 4.2e-6) * (1 - ((steps - 5) / 5) ** 2)

    def settle(plateaus, samples):
        before = np.concatenate([plateaus[:1], plateaus[:-1]])
        decay = np.exp(-np.arange(1, 201) / samples)
        return (plateaus[:, None] + (before - plateaus)[:, None] * decay).ravel()

    staircases = []
    for unit, scale, position in (
        ("V", 1.0, settle(4.5e-6 * steps + bow, 25.0)),
        ("m", 4.5e-6, settle(4.5e-6 * steps, 8.0)),
    ):
        signals = {"r": scale * command, "u": position}
        recording = gbid.Recording(signals, 2e-3, units={"r": unit, "u": "m"})
        staircases.append(piezo_data(gbid.characterise_piezo(recording), recording, "r"))
    return staircases


def hysteresis():
    return report.plot_piezo_hysteresis(piezo_staircases())


def staircase():
    return report.plot_piezo_staircase(piezo_staircases())


def pareto():
    peak = np.linspace(1.4, 2.8, 9)
    designs = {
        "P": list(zip(peak, 0.35 * (1 - np.exp(1.0 - peak)), strict=True)),
        "biquad": list(zip(peak, 0.75 * (1 - np.exp(1.2 * (1.0 - peak))), strict=True)),
    }
    return report.plot_pareto(ParetoCurves(designs, {"paper": (2.283, 0.318)}, title=POINT))


def damping_map():
    return report.plot_damping_map(
        report.damping_map_data(machine(), p_controller(1.125, 0.99), n=9, title="closed loop")
    )


def root_locus():
    plant = loop()[0]

    def controller(factor: float) -> LinearModel:
        return p_controller(1.125 * factor, 0.99 * factor)

    return report.plot_root_locus(report.root_locus_data(plant, controller, np.linspace(0, 1.2, 121), title=POINT))


@cache
def fitted():
    recording = simulated(MODE, MODE_AT, levels(600, hold=2), noise=0.3)
    result = gbid.fit(MODE, recording, focus="simulation")
    return recording, {"fit": result, "truth": evaluate(MODE, MODE_AT), "slower": evaluate(MODE, {**MODE_AT, "w": 4.0})}


def bode_diagram():
    recording, models = fitted()
    return report.plot_bode(models, measured=gbid.measured_response(recording, "u", "y"))


def measured_alone():
    return report.plot(gbid.measured_response(fitted()[0], "u", "y"))


def bode_of_four():
    return report.plot_bode({"6 bar": machine().plant_at(6.0, 0.0), "3 bar": machine().plant_at(3.0, 0.0)})


def poles():
    return report.plot_poles(fitted()[1])


def steps():
    return report.plot_step(fitted()[1])


def impulses():
    return report.plot_impulse(fitted()[1])


def campbell():
    results = {speed: machine().at(6.0, speed) for speed in (0.0, 2000.0, 4000.0, 6000.0)}
    return report.plot_campbell({**results, 3000.0: machine().at(6.0, 3000.0)})


def orbit():
    random, t = np.random.default_rng(0), 2e-4 * np.arange(10_000)
    phi = 2 * np.pi * 50 * t
    whirl = np.column_stack([3 * np.cos(phi) + 1, 2 * np.sin(phi + 0.4)]) + 0.3 * random.standard_normal((10_000, 2))
    signals = {"p": 1e-6 * whirl, "phi": np.mod(phi, 2 * np.pi)}
    return report.plot_orbit(gbid.Recording(signals, 2e-4, units={"p": "m", "phi": "rad"}, channels={"p": ("x", "y")}))


def iso_zones():
    return report.plot_iso_zones(gbid.sensitivities(*loop()))


def recorded():
    recording = fitted()[0]
    position = 1e-6 * np.hstack([recording.signal("y"), -recording.signal("y")])
    units = {"p": "m", "u": "V", "y": "m"}
    return report.plot_recording(gbid.Recording({"p": position, **recording.signals}, 0.1, units=units))


FIGURES = {
    case.__name__: case
    for case in (
        surfaces, delays, modes, static_gains, histograms, actuators, static_map, sensitivity, impact, impact_loops,
        hysteresis, staircase, pareto, damping_map, root_locus, bode_diagram, bode_of_four, measured_alone,
        poles, steps, impulses, campbell, orbit, iso_zones, recorded,
    )
}  # fmt: skip
FIGURES |= {
    name: getattr(report, f"plot_{name}")
    for name in ("differential_pairing", "identification_flow", "rotor_bearing_model", "closed_loop")
}
