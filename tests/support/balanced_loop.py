"""A machine at 6 bar whose unbalance is cancelled while it runs, by the exported chain in the loop of the rig."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from rig_point import BARE

import gbid
from gbid.control import ControllerDesign, exact_plant
from gbid.export.chain import Chain, ChainOptions, chain_of
from gbid.export.chain_python import ChainInput
from gbid.rig import Machine, ProgramController, Stationary, Unbalance, record

MODEL = gbid.load_model("theisen2016")
PLANT = exact_plant(MODEL, 6.0, 6000.0)
GAINS = {"kappa_x": 1.1, "kappa_y": 1.0}
DESIGN = ControllerDesign("damper", gbid.controller_structure("P"), GAINS, sample_time=2e-4, plant="theisen2016")
FADE_S = 0.02


class Logged:
    """Program of the rig's controller that keeps the outputs of its chain."""

    def __init__(self, chain) -> None:
        self.chain, self.outputs = chain, []

    def references(self, position, angle, pressure_bar, speed_rpm):
        given = ChainInput(tuple(map(float, position)), float(angle), float(pressure_bar), float(speed_rpm))
        self.outputs.append(self.chain.step(given))
        return np.array(self.outputs[-1].reference)


def chain(balance, **options) -> Chain:
    known = {"ramp_s": 2e-4, "fade_s": FADE_S, "spike_limit_m": None, **options}
    return chain_of(DESIGN, options=ChainOptions(**known), balance=balance)


def machine(**parts) -> Machine:
    given = {"sensors": BARE, "unbalance": Unbalance(0.5e-6, 0.7), **parts}
    parameters = {**MODEL.key_parameters(6.0, 6000.0), **given.pop("parameters", {})}
    return Machine.from_parameters(parameters, MODEL.actuators, **given)


def run(rotor, program, speed_rpm, seconds, experiment=None, **options):
    """Return the recording and the logged outputs of a run; the control begins with it."""
    logged = Logged(program)
    recording = record(
        rotor,
        experiment or Stationary(seconds),
        conditions={} if speed_rpm is None else {"pressure_bar": 6.0, "speed_rpm": speed_rpm},
        seed=1,
        name="run",
        settle_s=0.0,
        controller=ProgramController(logged, 2e-4),
        **options,
    )
    return recording, logged.outputs


def once_per_turn(recording, turns=4):
    """Return times and amplitudes of the once-per-turn motion of x and y over windows of some turns, (n,), (n, 2)."""
    angle, p = np.unwrap(recording.signal("phi")[:, 0]), recording.signal("p")
    step = 2 * np.pi * turns
    edges = np.searchsorted(angle, angle[0] + step * np.arange(1 + (angle[-1] - angle[0]) // step))
    turned = p * np.exp(-1j * angle[:, None])
    waves = [2 * np.abs(turned[a:b].mean(axis=0)) for a, b in pairwise(edges)]
    return edges[1:] * 2e-4, np.array(waves)
