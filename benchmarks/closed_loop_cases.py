"""Recordings of the closed-loop study: the published rotor under its published controller, by the virtual rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import gbid
from benchmarks.orbit import about_the_orbit
from gbid.control import p_controller
from gbid.control.loop.close import sample_controller
from gbid.rig import (
    FilmStiffening,
    Machine,
    Prbs,
    ProcessNoise,
    SampledController,
    SensorChain,
    Stationary,
    record,
)

SAMPLE_TIME = 2e-4
POINT = (7.0, 6000.0)
"""Pressure [bar] and speed [rpm] at which the published rotor is damped least."""
SENSORS = SensorChain(noise_p=(0.65e-6, 0.5e-6), noise_u=45e-9)
"""Run-out of the rig, and noise of the probes in x and y as the paper's recordings have it."""
CONTROLLER = sample_controller(p_controller(1.125, 0.99), SAMPLE_TIME)
"""The controller of the paper (Sec. 5) as it runs: positive gains are positive feedback."""
BINS = 720  # angles of the table that the controller subtracts


@dataclass(frozen=True)
class LoopCase:
    """Rotor, effects beyond the model, and excitation.

    Attributes
    ----------
    name : str
        Name in the table.
    parts : dict
        Effects of the rig, arguments of `gbid.rig.Machine`.
    amplitude, hold_s, duration_s : float
        Excitation, see `gbid.rig.Prbs`.
    """

    name: str
    parts: Mapping[str, Any]
    amplitude: float = 4.5e-6
    hold_s: float = 5e-3
    duration_s: float = 2.0

    @cached_property
    def truth(self) -> dict[str, float]:
        """True parameters of rotor, bearing and actuators."""
        model = gbid.load_model("theisen2016")
        return {**model.key_parameters(*POINT), **model.actuators}

    def linearised(self, recording: gbid.Recording) -> dict[str, float]:
        """Return the true parameters for the motion in a recording: a film that stiffens is linearised over it.

        The stiffness is the mean derivative of the film's force over the orbit of the unbalance, which the prefilter
        subtracts, and over the motion about it, as if that were normal.
        """
        film = self.parts.get("stiffening")
        if film is None:
            return self.truth
        s = film.inverse_square_length
        keys = {key: np.array([value]) for key, value in self.truth.items()}
        orbit = about_the_orbit(keys, np.array([POINT[1]]), s)
        noise = np.diag(np.square(np.asarray(SENSORS.noise_p)))
        motion = np.cov(recording.signal("p").T) - noise
        moved = {key: float(value[0]) for key, value in orbit.items()}
        for b in "xy":
            own = np.array([self.truth[f"k_{b}{c}"] for c in "xy"])
            more = s * (own * np.trace(motion) + 2 * own @ motion)
            moved |= {f"k_{b}{c}": moved[f"k_{b}{c}"] + float(v) for c, v in zip("xy", more, strict=True)}
        return moved

    @property
    def machine(self) -> Machine:
        """The rig."""
        return Machine.from_parameters(self.truth, self.truth, sensors=SENSORS, **self.parts)

    @cached_property
    def runout_map(self) -> gbid.prefilter.RunoutMap:
        """Run-out and unbalance of the rotor in open loop."""
        return gbid.identify_runout(self._record(self.machine, Stationary(5.0), 0, "still"))

    def recording(self, seed: int, *, closed: bool = True) -> gbid.Recording:
        """Return one recording without run-out and means; in closed loop the controller subtracts the run-out, too."""
        nodes = np.arange(BINS) * (2 * np.pi / BINS)
        law = SampledController(
            CONTROLLER.A,
            CONTROLLER.B,
            CONTROLLER.C,
            CONTROLLER.D,
            SAMPLE_TIME,
            runout=self.runout_map.evaluate(nodes) - self.runout_map.mean,
            offset=self.runout_map.mean,
        )
        run = Prbs(self.duration_s, self.amplitude, self.hold_s)
        made = self._record(self.machine, run, seed, f"run {seed}", law if closed else None)
        return gbid.prefilter(made, self.runout_map)[0]

    def _record(
        self, machine: Machine, run: Prbs | Stationary, seed: int, name: str, law: SampledController | None = None
    ) -> gbid.Recording:
        at = {"pressure_bar": POINT[0], "speed_rpm": POINT[1]}
        return record(machine, run, conditions=at, seed=seed, name=name, controller=law)


NOISE: dict[str, Any] = {"process_noise": ProcessNoise(0.03)}
FILM = {**NOISE, "stiffening": FilmStiffening(0.3e-6)}  # as in experiments/theisen2016.yaml
CASES = (LoopCase("noise", NOISE), LoopCase("noise, film", FILM))
