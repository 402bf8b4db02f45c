"""ROSS's rotor in magnetic bearings, from a recording in its loop to compiled C that levitates it.

``python -m benchmarks.magnetic_bearings [--rotors N] [--output FILE]``; it needs ROSS and a C compiler.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import eig, eigh
from scipy.signal import cont2discrete

import gbid
from benchmarks.running import about, markdown, options_of, run_study, timed
from gbid.control import (
    ISO_LIMITS,
    AxisSensitivity,
    DisturbanceSpectrum,
    MaxDamping,
    MinDamping,
    MinDiskMargin,
    RmsResponse,
    sample_controller,
)
from gbid.export import ChainInput, ChainOptions
from gbid.export.chain import Chain, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import ChainMode
from gbid.export.ross import ross_package
from gbid.structure import evaluate

SAMPLE_TIME = 4e-5  # [s]
BIAS = 1.0  # current at rest, and limit of the control current [A]
GAP = 1e-3  # air gap of the data sheet [m]
RETAINER = GAP / 2  # clearance of the retainer bearings [m]
STIFFENED = 1e-3  # largest share of the stiffness that the squares of the magnets may add: a tenth of the 1 % wanted
FULL_SCALE = 1.2 * RETAINER  # of the converters of the positions, to both sides [m]
DISK_MARGIN = 0.3  # all gains of the loop may change by a quarter, and phases by 17 degrees
EVALUATIONS = 5000  # of the search for gains
BITS = 12
NOISE = 1e-7  # of a position, standard deviation [m]
CURRENT_NOISE = 1e-3  # of a current, standard deviation [A]
SENSOR_HZ = 8000.0
SPEEDS = (0.0, 9000.0)  # of the design [rpm]; the first bending mode is passed at 6 200 rpm
AXES = ("av", "aw", "bv", "bw")
"""Both bearings, each with the two axes of its coils, 45 degrees from x and y."""
UNBALANCE = 2.5e-6  # [kg m], G 0.4 at 9 000 rpm, at the middle disc


# ---- The machine: ROSS's example, and what differs from it in the shop.


@dataclass(frozen=True)
class Truth:
    """What the machine in the shop has, and ROSS's example has not.

    Attributes
    ----------
    k_s, k_i : tuple of float
        Stiffness [N/m] and force per current [N/A] of both bearings, in parts of the example's.
    amplifier_hz, delay_s : float
        Bandwidth [Hz] and delay [s] of the amplifiers.
    elasticity, density : float
        Of the shaft, in parts of the example's.
    """

    k_s: tuple[float, float] = (1.12, 1.06)
    k_i: tuple[float, float] = (0.93, 0.97)
    amplifier_hz: float = 2500.0
    delay_s: float = 1.5e-5
    elasticity: float = 1.0
    density: float = 1.0

    def perturbed(self, random: np.random.Generator) -> Truth:
        """Return another machine of the series."""

        def spread(value: float, share: float) -> float:
            return float(value * (1 + share * random.uniform(-1.0, 1.0)))

        return Truth(
            (spread(self.k_s[0], 0.05), spread(self.k_s[1], 0.05)),
            (spread(self.k_i[0], 0.05), spread(self.k_i[1], 0.05)),
            spread(self.amplifier_hz, 0.1),
            spread(self.delay_s, 0.2),
            spread(self.elasticity, 0.02),
            spread(self.density, 0.02),
        )


def example() -> Any:
    """Return ROSS's own example of a rotor in magnetic bearings."""
    return ross_package("this study").rotor_amb_example()


class Machine:
    """Simulation of the machine by its eigenvectors, with all degrees of freedom of ROSS's model; without gbid.

    Between two samples the references of the currents are held, each acts after the delay of its amplifier. The force
    of an unbalance is held as well. A run has the forces of the magnets with the squares of currents and gaps: what
    they differ from ``k_s z + k_i i`` is a further force, held before and after the delay.
    """

    def __init__(self, rotor: Any, truth: Truth, speed_rpm: float) -> None:
        omega, per = speed_rpm * np.pi / 30, rotor.number_dof
        M, K = truth.density * rotor.M(0), truth.elasticity * rotor.K(0)
        C, self.truth, self.omega = rotor.C(0) + omega * truth.density * rotor.G(), truth, omega
        self.places, heavy = np.zeros((len(M), 4)), int(np.median([disk.n for disk in rotor.disk_elements]))
        for j, element in enumerate(rotor.bearing_elements):
            first = per * element.n
            # the element of ROSS has its controller in it: take it out, and put the magnets in
            held = np.ix_(*[list(element.dof_global_index.values())] * 2)
            K[held] -= truth.elasticity * np.asarray(element.K(0), float)
            C[held] -= np.asarray(element.C(0), float)
            angle = float(element.sensors_axis_rotation)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            self.places[first : first + 2, 2 * j : 2 * j + 2] = turn
        magnets = rotor.bearing_elements
        k_s, k_i = (
            np.repeat([abs(float(getattr(e, k))) * f for e, f in zip(magnets, part, strict=True)], 2)
            for k, part in (("ks", truth.k_s), ("ki", truth.k_i))
        )
        free, self.gap = K, k_i * BIAS / k_s  # of a magnet k_s = k_i i_0 / g
        self.k_s, self.k_i = k_s, k_i
        K = K - self.places @ np.diag(k_s) @ self.places.T
        at_node = range(4) if per == 4 else (0, 1, 3, 4)  # what is along the shaft, and its twist, is at rest
        lateral = [i for i in range(len(M)) if i % per in at_node]
        M, C, K, free = (matrix[np.ix_(lateral, lateral)] for matrix in (M, C, K, free))
        self.places, n = self.places[lateral], len(lateral)
        _, rigid = eigh(free, M, subset_by_index=(0, 3))
        fast, slow = 2 * np.pi * truth.amplifier_hz, 2 * np.pi * SENSOR_HZ
        forces = [self.places * k_i, np.eye(n)[:, [lateral.index(per * heavy)]], self.places]
        per_force = np.linalg.solve(M, np.hstack(forces))
        A = np.zeros((2 * n + 8, 2 * n + 8))
        A[:n, n : 2 * n] = np.eye(n)
        A[n : 2 * n, :n], A[n : 2 * n, n : 2 * n] = -np.linalg.solve(M, K), -np.linalg.solve(M, C)
        A[n : 2 * n, 2 * n : 2 * n + 4] = per_force[:, :4]
        A[2 * n : 2 * n + 4, 2 * n : 2 * n + 4], A[2 * n + 4 :, 2 * n + 4 :] = -fast * np.eye(4), -slow * np.eye(4)
        A[2 * n + 4 :, :n] = slow * self.places.T
        scale = np.concatenate([np.full(n, 300.0), np.ones(n), np.full(8, 300.0)])  # balances the eigenvectors
        scale[2 * n : 2 * n + 4] = 1.0
        self.values, V = eig(scale[:, None] * A / scale)
        B = np.zeros((len(A), 9))
        B[2 * n : 2 * n + 4, :4] = fast * np.eye(4)
        B[n : 2 * n, 4:] = per_force[:, 4:]
        self.into = np.linalg.solve(V, scale[:, None] * B)
        self.shown, self.currents, self.at_magnets = V[-4:] / 300.0, V[-8:-4], self.places.T @ V[:n] / 300.0
        moved = rigid @ np.linalg.inv(self.places.T @ rigid)
        self.start = np.linalg.solve(V, np.vstack([300.0 * moved, np.zeros((n + 4, 4)), 300.0 * np.eye(4)]))

    def over(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Return what the states keep over a duration, and the effects of inputs that are held."""
        kept = np.exp(self.values * duration)
        return kept, ((kept - 1) / self.values)[:, None] * self.into

    def beyond_linear(self, z: np.ndarray, i: np.ndarray) -> np.ndarray:
        """Return the force of each magnet without its linear part [N], with both coils at their bias current."""
        z = np.clip(z, -0.95 * self.gap, 0.95 * self.gap)
        pulls = ((BIAS + i) / (self.gap - z)) ** 2 - ((BIAS - i) / (self.gap + z)) ** 2
        return np.asarray(self.k_i * self.gap**2 / (4 * BIAS) * pulls - self.k_s * z - self.k_i * i)

    def run(
        self, controlled: Callable[[np.ndarray], np.ndarray], steps: int, start: np.ndarray, seed: int, unbalance: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the measured positions and currents, and the references of the currents, each (steps, 4).

        `start` are the positions of the rotor at rest. `controlled` gets the positions as converted and returns the
        reference that acts one sample later.
        """
        random, delay = np.random.default_rng(seed), self.truth.delay_s
        parts = self.over(delay), self.over(SAMPLE_TIME - delay)
        x = self.start @ start.astype(complex)
        i_step, p_step = 2 * BIAS / 2**BITS, 2 * FULL_SCALE / 2**BITS
        p, i, references = np.zeros((3, steps, 4))
        later, now, before = np.zeros((3, 4))
        for k in range(steps):
            seen = (self.shown @ x).real + NOISE * random.standard_normal(4)
            p[k] = np.clip(p_step * np.round(seen / p_step), -FULL_SCALE, FULL_SCALE)
            flows = (self.currents @ x).real + CURRENT_NOISE * random.standard_normal(4)
            i[k] = np.clip(i_step * np.round(flows / i_step), -BIAS, BIAS)
            before, now, later = now, later, controlled(p[k])
            now = np.clip(i_step * np.round(now / i_step), -BIAS, BIAS)
            references[k] = now
            force = unbalance * self.omega**2 * np.cos(self.omega * k * SAMPLE_TIME)
            for (kept, effect), reference in zip(parts, (before, now), strict=True):
                more = self.beyond_linear((self.at_magnets @ x).real, (self.currents @ x).real)
                x = kept * x + effect @ np.concatenate([reference, [force], more])
        return p, i, references

    def plant_response(self, hz: np.ndarray) -> np.ndarray:
        """Return the response of the sampled plant, (n, 4, 4), from the references to the positions."""
        (late, before), (kept, now) = self.over(self.truth.delay_s), self.over(SAMPLE_TIME - self.truth.delay_s)
        z, before = np.exp(2j * np.pi * hz * SAMPLE_TIME), kept[:, None] * before
        return np.stack([(self.shown / (each - kept * late)) @ (now + before / each)[:, :4] for each in z])

    def sensitivity(self, law: gbid.LinearModel, hz: np.ndarray) -> np.ndarray:
        """Return the sensitivity of each axis with the others closed, (n, 4), with one sample of computation."""
        z = np.exp(2j * np.pi * hz * SAMPLE_TIME)
        K = np.stack([law.C @ np.linalg.solve(each * np.eye(len(law.A)) - law.A, law.B) + law.D for each in z])
        L = self.plant_response(hz) @ (K / z[:, None, None])
        return np.abs(np.einsum("kii->ki", np.linalg.inv(np.eye(4) - L)))


# ---- The way: structure, identification in the loop, design, C.


def structure(rotor: Any, speed_rpm: float, modes: int, outputs: tuple[str, ...] = ("p",)) -> gbid.MagneticBearing:
    """Return ROSS's rotor with unknown magnets, and amplifiers of which the data sheet tells something."""
    angles = [
        (e, float(e.sensors_axis_rotation) + quarter) for e in rotor.bearing_elements for quarter in (0.0, np.pi / 2)
    ]
    plant = gbid.from_ross(
        rotor,
        bearings={"a": rotor.bearing_elements[0].tag, "b": rotor.bearing_elements[1].tag},
        sensors=[(element.n, angle) for element, angle in angles],
        actuators=[(element.tag, angle) for element, angle in angles],
        speed_rpm=speed_rpm,
        modes=modes,
        inputs="i",
    )
    chain = {
        "amplifier_hz": 2000.0,
        "amplifier_delay_s": 2.5e-5,
        "longest_delay_s": SAMPLE_TIME,
        "sensor_hz": SENSOR_HZ,
    }
    return gbid.MagneticBearing(plant, **chain, outputs=outputs)


def law_of_bearings() -> gbid.LinearStructure:
    """Return PD control of each bearing, equal in its axes, with a low-pass of second order.

    Bounds from the data sheet: at kp = 1000 A/m = i_0 / g the bearing has no stiffness, at five times this 0.2 mm take
    the full current. With kd = 100 A s/m the rigid rotor is critically damped in the stiffest bearing. The corner lies
    a decade above the first bending mode, which the lead must damp, and below half of the Nyquist frequency. The
    damping of the low-pass has no bound of its own.
    """

    def matrices(p: Any) -> dict[str, Any]:
        parts = []
        for end in "ab":
            w, zeta = 2 * np.pi * p[f"corner_{end}"], p[f"zeta_{end}"]
            A, B = ca.blockcat([[0, w], [-w, -2 * zeta * w]]), ca.vertcat(0, w)
            parts += 2 * [(A, B, -ca.horzcat(p[f"kp_{end}"], p[f"kd_{end}"] * w))]
        return {letter: ca.diagcat(*column) for letter, column in zip("ABC", zip(*parts, strict=True), strict=True)}

    gains = [
        gbid.Parameter(f"{name}_{end}", start, low, high, unit=unit)
        for end in "ab"
        for name, start, low, high, unit in (
            ("kp", 2500.0, 1000.0, 5000.0, "A/m"),
            ("kd", 18.0, 1.0, 100.0, "A s/m"),
            ("corner", 1850.0, 1000.0, 6250.0, "Hz"),
            ("zeta", 0.1, 0.001, 1.0, ""),
        )
    ]
    channels = tuple(f"p_{axis}" for axis in AXES), tuple(f"i_{axis}" for axis in AXES)
    return gbid.LinearStructure("PD per bearing", gains, matrices, *channels)


def first_law() -> gbid.LinearModel:
    """Return the controller with which the rotor is recorded: the start values, sampled by scipy."""
    law = law_of_bearings()
    model = evaluate(law, {gain.name: gain.start for gain in law.parameters})
    A, B, C, D, _ = cont2discrete((model.A, model.B, model.C, model.D), SAMPLE_TIME, "bilinear")
    return gbid.LinearModel(A, B, C, D, dt=SAMPLE_TIME, name="first")


def recorded(machine: Machine, seconds: float, seed: int, amplitude: float) -> gbid.Recording:
    """Return a recording of the levitated rotor, with random currents added to those of its controller [A]."""
    law, steps, random = first_law(), round(seconds / SAMPLE_TIME), np.random.default_rng(seed)
    w = amplitude * np.repeat(random.choice([-1.0, 1.0], (-(-steps // 25), 4)), 25, axis=0)[:steps]
    z, k = np.zeros(len(law.A)), 0

    def controlled(p: np.ndarray) -> np.ndarray:
        nonlocal z, k
        current = law.C @ z + law.D @ p
        z, k = law.A @ z + law.B @ p, k + 1
        return current + (w[k] if k < steps else 0.0)

    w[0] = 0.0  # the first current acts at the second sample
    p, i, _ = machine.run(controlled, steps, np.zeros(4), seed, 0.0)
    units = {"w": "A", "i": "A", "p": "m"}
    return gbid.Recording({"w": w, "i": i, "p": p}, SAMPLE_TIME, name="levitated", units=units)


def stiffening(recording: gbid.Recording) -> float:
    """Return the largest share of the stiffness that the squares of the magnets add in a recording.

    It is the least-squares gain from the recorded position to the force beyond the linear one, by gap and bias current
    of the data sheet.
    """
    shares = []
    for z, i in zip(recording.signal("p").T / GAP, recording.signal("i").T / BIAS, strict=True):
        beyond = (((1 + i) / (1 - z)) ** 2 - ((1 - i) / (1 + z)) ** 2) / 4 - z - i
        shares.append(float(np.linalg.lstsq(np.stack([z, i], 1), beyond)[0][0]))
    return max(map(abs, shares))


def excited(machine: Machine) -> tuple[gbid.Recording, float]:
    """Return the recording with the largest excitation that the squares allow, and its amplitude [A].

    The amplitude begins with half a percent of the bias current and doubles.
    """
    amplitude = 0.005 * BIAS
    recording = recorded(machine, 0.8, 0, amplitude)
    while stiffening(louder := recorded(machine, 0.8, 0, 2 * amplitude)) <= STIFFENED:
        recording, amplitude = louder, 2 * amplitude
    return recording, amplitude


def identified(rotor: Any, recording: gbid.Recording, speed_rpm: float) -> gbid.FitResult:
    """Return the fit of the rotor in its loop."""
    loop = gbid.ClosedLoop(structure(rotor, speed_rpm, 4, ("i", "p")), first_law(), pade_order=None)
    return gbid.fit(loop, recording, focus="simulation", initial_state="zero", window=None, max_iterations=25)


def plants_of(rotor: Any, parameters: Mapping[str, float], speeds: Sequence[float]) -> list[gbid.LinearModel]:
    """Return the identified plants at some speeds, with more modes than the recording shows."""
    names = tuple(f"i_{axis}" for axis in AXES), tuple(f"p_{axis}" for axis in AXES)
    return [evaluate(structure(rotor, speed, modes=16), parameters, *names) for speed in speeds]


def noise() -> DisturbanceSpectrum:
    """Return the spectrum of sensor noise and rounding of the converters, white up to the Nyquist frequency."""
    density = (NOISE**2 + (2 * FULL_SCALE / 2**BITS) ** 2 / 12) * 2 * SAMPLE_TIME
    return DisturbanceSpectrum(np.array([0.0, 0.5 / SAMPLE_TIME]), np.stack(2 * [density * np.eye(4)]))


def tuned(plants: list[gbid.LinearModel]) -> gbid.GainResult:
    """Return the gains with the most damping of rigid and first bending modes, well within zone A, with a margin."""
    law = law_of_bearings()
    positions, currents = plants[0].output_names, plants[0].input_names
    goals = [
        MaxDamping(high_hz=150.0),
        AxisSensitivity(0.83 * ISO_LIMITS["A"]),
        MinDamping(4e-5, low_hz=150.0, high_hz=4200.0),
        RmsResponse(sources=positions, targets=currents, limit=0.2 * BIAS, spectrum=noise()),
        MinDiskMargin(DISK_MARGIN),
    ]
    return gbid.tune(plants, law, goals=goals, sample_time=SAMPLE_TIME, evaluations=EVALUATIONS)


def compiled(design: gbid.GainResult) -> Chain:
    """Return the control chain of the design, which stays on after a fault: without it the rotor falls."""
    limits = {"limits": (BIAS,) * 4, "beyond": (0.9 * FULL_SCALE,) * 4, "units": ("m", "A")}
    options = ChainOptions(ramp_s=SAMPLE_TIME, fade_s=SAMPLE_TIME, number="float", on_fault="control", **limits)
    return chain_of(replace(design.design(name="amb"), name="amb"), options=options)


def levitated(machine: Machine, chain: Chain, seconds: float, seed: int, start: np.ndarray) -> dict[str, float]:
    """Return largest position and current of the last fifth of a run with the compiled C, and of the whole run.

    `start` are the positions of the axes at rest. A radius above the clearance of the retainer bearings is a touch.
    """
    running = CompiledChain(chain)

    def controlled(p: np.ndarray) -> np.ndarray:
        return np.array(running.step(ChainInput(tuple(p), mode=ChainMode.CONTROL)).stack)

    p, _, i = machine.run(controlled, round(seconds / SAMPLE_TIME), start, seed, UNBALANCE)
    tail, radius = slice(-len(p) // 5, None), np.hypot(p[:, ::2], p[:, 1::2])
    return {
        "position_um": 1e6 * float(np.abs(p[tail]).max()),
        "current_A": float(np.abs(i[tail]).max()),
        "largest_current_A": float(np.abs(i).max()),
        "largest_radius_um": 1e6 * float(radius.max()),
    }


DIRECTIONS = {
    "both ends along a coil axis": (1.0, 0.0, 1.0, 0.0),
    "both ends between the coil axes": (0.5**0.5, 0.5**0.5, 0.5**0.5, 0.5**0.5),
    "ends on opposite sides": (1.0, 0.0, -1.0, 0.0),
}


def lift_off(machine: Machine, chain: Chain) -> list[dict[str, Any]]:
    """Return for each direction the largest offset, up to the retainer bearings, from which the rotor levitates.

    It levitates when it is within a tenth of the clearance after 0.3 s, and does not touch on the way.
    """
    rows = []
    for name, direction in DIRECTIONS.items():
        runs = []
        for share in np.arange(10, 0, -1) / 10:
            run = levitated(machine, chain, 0.3, 1, share * RETAINER * np.array(direction))
            touches = run["largest_radius_um"] > 1.01e6 * RETAINER
            held = run["position_um"] < 1e5 * RETAINER
            runs.append({"offset_um": 1e6 * share * RETAINER, "held": held, "touches": touches, **run})
            if held and not touches:
                break
        rows.append({"direction": name, "levitates": runs[-1], "from_retainer": runs[0]})
    return rows


# ---- ROSS as the judge, and the study.


def law_over_frequency(law: gbid.LinearModel, hz: np.ndarray) -> np.ndarray:
    """Return current per position of each axis, (n, 4), with converter, computation, amplifier and sensor."""
    s, truth = 2j * np.pi * hz, Truth()
    z = np.exp(s * SAMPLE_TIME)
    K = np.stack([np.diag(law.C @ np.linalg.solve(e * np.eye(len(law.A)) - law.A, law.B) + law.D) for e in z])
    delayed = np.exp(-s * (1.5 * SAMPLE_TIME + truth.delay_s)) * np.sinc(hz * SAMPLE_TIME)
    lags = (1 + s / (2 * np.pi * truth.amplifier_hz)) * (1 + s / (2 * np.pi * SENSOR_HZ))
    return np.asarray(K * (delayed / lags)[:, None])


def ross_sensitivity(rotor: Any, law: gbid.LinearModel, speed_rpm: float, hz: np.ndarray) -> np.ndarray:
    """Return the sensitivity of each axis by ROSS's closed-loop response, (n, 4).

    Each bearing is an element of ROSS with the stiffness and damping over frequency of magnets and controller, as its
    own element of magnetic bearings has them. ROSS's matrices give the response H to forces at the bearings, and
    ``S_ii = 1 + H_ii k_i K_i``.
    """
    ross, omega, w, truth = ross_package("this study"), speed_rpm * np.pi / 30, 2 * np.pi * hz, Truth()
    K, elements, k_i = law_over_frequency(law, hz), [], []
    for j, magnet in enumerate(rotor.bearing_elements):
        k_i.append(float(magnet.ki) * truth.k_i[j])
        pulled = -k_i[j] * K[:, 2 * j] - abs(float(magnet.ks)) * truth.k_s[j]
        k, c = pulled.real.tolist(), (pulled.imag / w).tolist()
        elements.append(ross.BearingElement(n=magnet.n, kxx=k, kyy=k, cxx=c, cyy=c, frequency=w.tolist()))
    held = ross.Rotor(rotor.shaft_elements, rotor.disk_elements, elements)
    M, G, S = held.M(0), held.G(), []
    forces = np.zeros((len(M), 4))
    for j, magnet in enumerate(rotor.bearing_elements):
        angle, first = float(magnet.sensors_axis_rotation), held.number_dof * magnet.n
        forces[first : first + 2, 2 * j] = np.cos(angle), np.sin(angle)
        forces[first : first + 2, 2 * j + 1] = -np.sin(angle), np.cos(angle)
    for each, gains in zip(w, K, strict=True):
        dynamic = -(each**2) * M + 1j * each * (held.C(each) + omega * G) + held.K(each)
        H = forces.T @ np.linalg.solve(dynamic, forces)
        S.append(np.abs(1 + np.diag(H) * np.repeat(k_i, 2) * gains))
    return np.array(S)


def identification(rotor: Any) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the figures of the identification, and the estimates."""
    (recording, amplitude), true = excited(Machine(rotor, Truth(), 3000.0)), true_values(rotor)
    share = stiffening(recording)
    fit, fit_s = timed(lambda: identified(rotor, recording, 3000.0))
    rows = [
        {
            "name": q.name,
            "truth": true[q.name],
            "start": q.start,
            "value": fit.parameters[q.name],
            "std": float(np.hypot(fit.std[q.name], share * fit.parameters[q.name] * q.name.startswith("k_s"))),
        }
        for q in structure(rotor, 0.0, modes=4).parameters
        if not q.fixed
    ]
    seconds = len(recording.signal("p")) * SAMPLE_TIME
    run = {
        "seconds": seconds,
        "amplitude_A": amplitude,
        "stiffening": share,
        "status": str(fit.status),
        "parameters": rows,
        "processor_s": fit_s,
    }
    return run, dict(fit.parameters)


def designed(rotor: Any, parameters: Mapping[str, float]) -> tuple[dict[str, Any], gbid.GainResult]:
    """Return the figures of the design, and the design."""
    plants = plants_of(rotor, parameters, SPEEDS)
    design, tune_s = timed(lambda: tuned(plants))
    assessed, assess_s = timed(lambda: gbid.assess(plants, design))
    _, chain_s = timed(lambda: CompiledChain(compiled(design)))
    run = {
        "status": str(design.status),
        "damping": design.value,
        "gains": dict(design.gains),
        "states": len(plants[0].A),
    }
    run["disk_margin"] = assessed.worst["disk_margin"][0]
    return {**run, "processor_s": {"tune": tune_s, "assess": assess_s, "chain and compiler": chain_s}}, design


def judged(rotor: Any, design: gbid.GainResult, rotors: int) -> dict[str, Any]:
    """Return what the independent simulation and ROSS say of a design, over the speeds and for other rotors."""
    law = sample_controller(design.design(name="amb").at(), SAMPLE_TIME, "tustin")
    chain, random = compiled(design), np.random.default_rng(7)
    hz = np.geomspace(1.0, 4000.0, 240)

    def one(truth: Truth, speed: float, seed: int) -> dict[str, float]:
        machine, start = Machine(rotor, truth, speed), 5e-6 * np.random.default_rng(seed).choice([-1.0, 1.0], 4)
        modes = np.abs(machine.values.imag) / (2 * np.pi)  # a bending mode has a narrow peak
        near = np.outer(modes[(modes > 1.0) & (modes < 8000.0)], 1 + np.array([-1e-3, -3e-4, 0.0, 3e-4, 1e-3]))
        peak = float(machine.sensitivity(law, np.concatenate([hz, near.ravel()])).max())
        return {"speed_rpm": speed, "peak": peak, **levitated(machine, chain, 0.1, seed, start)}

    coarse = hz[::8]
    by_ross = ross_sensitivity(rotor, law, 4500.0, coarse)
    simulated = Machine(rotor, Truth(), 4500.0).sensitivity(law, coarse)
    return {
        "degrees_of_freedom": int(rotor.ndof),
        "lift_off": lift_off(Machine(rotor, Truth(), 0.0), chain),
        "by_speed": [one(Truth(), float(speed), 1) for speed in np.linspace(0.0, SPEEDS[-1], 5)],
        "ross": {
            "speed_rpm": 4500.0,
            "peak": float(by_ross.max()),
            "peak_of_simulation": float(simulated.max()),
            "largest_difference": float(np.abs(by_ross / simulated - 1).max()),
        },
        "rotors": [
            one(Truth().perturbed(random), float(random.uniform(0, SPEEDS[-1])), 100 + i) for i in range(rotors)
        ],
    }


def study(rotors: int) -> dict[str, Any]:
    """Return the figures of the page."""
    rotor = example()
    fit, parameters = identification(rotor)
    tuning, design = designed(rotor, parameters)
    return {**about(), "fit": fit, "design": tuning, **judged(rotor, design, rotors)}


def true_values(rotor: Any) -> dict[str, float]:
    """Return the true values of the parameters."""
    truth = Truth()
    pairs = [
        (f"k_{s}_{end}", abs(float(getattr(e, f"k{s}"))) * part[j])
        for s, part in (("s", truth.k_s), ("i", truth.k_i))
        for j, (end, e) in enumerate(zip("ab", rotor.bearing_elements, strict=True))
    ]
    return {**dict(pairs), "omega_amplifier": 2 * np.pi * truth.amplifier_hz, "tau_amplifier": truth.delay_s}


def fit_table(run: Mapping[str, Any]) -> str:
    """Return the estimates beside the true values as Markdown."""
    rows = []
    for row in run["fit"]["parameters"]:
        off = row["value"] - row["truth"]
        cells = [f"{row[key]:.5g}" for key in ("start", "value", "std", "truth")]
        rows.append([row["name"], *cells, f"{100 * off / row['truth']:+.2f}", f"{off / row['std']:+.1f}"])
    head = ["parameter", "start", "estimate", "std", "truth", "error [%]", "error [std]"]
    fit = run["fit"]
    found = f"From {fit['seconds']:.1f} s with {fit['amplitude_A']:g} A; squares add {100 * fit['stiffening']:.2f} %."
    return markdown(head, rows, found)


def speed_table(run: Mapping[str, Any]) -> str:
    """Return peaks, positions and currents over the speed as Markdown."""
    keys = {"speed_rpm": ".0f", "peak": ".3f", "position_um": ".1f", "current_A": ".3f", "largest_current_A": ".2f"}
    rows = [[format(row[key], form) for key, form in keys.items()] for row in run["by_speed"]]
    head = ["speed [rpm]", "peak of S", "position at the end [um]", "current at the end [A]", "largest current [A]"]
    return markdown(head, rows)


def lift_off_table(run: Mapping[str, Any]) -> str:
    """Return the offsets from which the rotor levitates as Markdown."""
    rows = []
    for row in run["lift_off"]:
        best, first = row["levitates"], row["from_retainer"]
        reached = f"{best['offset_um']:.0f}" if best["held"] and not best["touches"] else "none"
        end = f"{first['largest_radius_um']:.0f}, {'then held' if first['held'] else 'not held'}"
        rows.append([row["direction"], reached, f"{best['largest_current_A']:.2f}", end])
    head = ["start", "largest offset that levitates [um]", "its current [A]", "radius from the retainer bearings [um]"]
    return markdown(head, rows)


def judgements(run: Mapping[str, Any]) -> str:
    """Return in words what ROSS and the other rotors say, and the processor time."""
    judge, rotors = run["ross"], run["rotors"]
    peaks, held = ([rotor[key] for rotor in rotors] for key in ("peak", "position_um"))
    seconds = {"fit": run["fit"]["processor_s"], **run["design"]["processor_s"]}
    return "\n".join(
        (
            f"{judge['speed_rpm']:.0f} rpm: peak {judge['peak']:.3f} by ROSS, {judge['peak_of_simulation']:.3f} in the "
            "simulation",
            f"largest difference at any frequency {100 * judge['largest_difference']:.2f} %",
            f"{len(peaks)} other rotors of the series: peaks {min(peaks):.2f} to {max(peaks):.2f}, "
            f"{sum(peak < 3 for peak in peaks)} in zone A",
            f"their positions at the end: at most {max(held):.1f} um",
            f"processor time [s]: {', '.join(f'{name} {s:.1f}' for name, s in seconds.items())}; "
            f"in all {sum(seconds.values()):.0f}",
        )
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    options = options_of(__doc__, arguments, "magnetic-bearings.json", rotors=(20, "number of perturbed rotors"))
    return run_study(lambda: study(options.rotors), options.output, lambda run: json.dumps(run, indent=2))


if __name__ == "__main__":
    sys.exit(main())
