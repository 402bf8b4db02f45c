"""Recordings, results, models and loops that the tables of "coming from" name."""

import casadi as ca
import numpy as np
from scipy.io import savemat

import gbid
from docs.code.rig_recordings import quiet_machine, still_rotor
from gbid.control import controller_model, disk_margin, exact_plant, loop_margins, p_controller, peak_gain  # noqa: F401
from gbid.report import root_locus_data
from gbid.rig import Stationary, record

machine = gbid.load_model("theisen2016")
recording, other = (gbid.prefilter(still_rotor(6.0, f"run {seed}", seed))[0] for seed in (1, 2))
structure = gbid.RotorBearing(pade_order=1)  # c2d and python-control know no exact delays
result = gbid.fit(structure, recording)
model, Ts, frame = result.model, recording.sample_time, recording.to_frame()
u, p, frequency_hz = recording.signal("u"), recording.signal("p"), np.geomspace(1, 500, 50)
axis = gbid.Recording({"r": recording.signal("r")[:, 0], "u": u[:, 0]}, Ts, name="piezo x")
savemat("run.mat", {"p": p})
mapping = {"sample_time_s": Ts, "signals": {"p": {"columns": ["p[0]", "p[1]"], "unit": "m"}}}
parameters, matrices = [gbid.Parameter("a", 1.0)], lambda p: {"A": [[-p.a]], "B": [[1]], "C": [[1]]}
plant, controller, gains = machine.plant_at(6, 0), p_controller(1.125, 0.99), {"kappa_x": 1.125, "kappa_y": 0.99}
still = record(
    quiet_machine(6.0), Stationary(0.6), conditions={"pressure_bar": 6.0, "speed_rpm": 0.0}, seed=3, name="still"
)
A, B, C, D, loop, system = plant.A, plant.B, plant.C, plant.D, gbid.sensitivities(plant, controller), plant.to_control()
locus = root_locus_data(plant, lambda f: p_controller(1.125 * f, 0.99 * f), [0.0, 0.5, 1.0])
delayed = exact_plant(machine, 6, 0)
covariance = np.zeros((84, 84))
g = ca.SX.sym("g")
matrices_of_gains = ca.Function("A", [g], [ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-1, -g))])
