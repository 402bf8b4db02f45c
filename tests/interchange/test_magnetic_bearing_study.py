"""Study of ROSS's rotor in magnetic bearings: its stored figures, and its parts on a small rotor without ROSS."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import gbid
from benchmarks import magnetic_bearings as study
from benchmarks.running import DOCS
from gbid.control.loop.sampled import sample_plant

STORED = json.loads((DOCS / "magnetic-bearings.json").read_text(encoding="utf-8"))


class SmallRotor:
    """Shaft of four beam elements with a disc and two magnets, as `gbid.from_ross` and the study take one of ROSS.

    Euler's beam without rotary inertia; the disc has gyroscopic moments.
    """

    number_dof = 4  # x, y, rotations about x and y
    ndof = 20

    def __init__(self):
        self.disk_elements = [SimpleNamespace(n=2)]
        self.bearing_elements = [self._magnet("Magnet 0", 0), self._magnet("Magnet 1", 4)]
        self.mass, self.stiffness, self.gyroscopic = (np.zeros((20, 20)) for _ in range(3))
        L, EI, rho = 0.12, 2e11 * np.pi / 64 * 0.018**4, 7800 * np.pi / 4 * 0.018**2
        k = EI / L**3 * np.array([[12, 6 * L, -12, 6 * L], [6 * L, 4 * L**2, -6 * L, 2 * L**2]])
        k = np.vstack([k, -k[0], [6 * L, 2 * L**2, -6 * L, 4 * L**2] * np.array(EI / L**3)])
        m = [[156, 22 * L, 54, -13 * L], [22 * L, 4 * L**2, 13 * L, -3 * L**2]]
        m = rho * L / 420 * np.array([*m, [54, 13 * L, 156, -22 * L], [-13 * L, -3 * L**2, -22 * L, 4 * L**2]])
        for e in range(4):
            for dofs, sign in (((0, 3, 4, 7), 1), ((1, 2, 5, 6), -1)):  # slope of x about y; of y about -x
                square, turn = np.ix_(*[[4 * e + dof for dof in dofs]] * 2), np.diag([1, sign, 1, sign])
                self.stiffness[square] += turn @ k @ turn
                self.mass[square] += turn @ m @ turn
        self.mass[8:12, 8:12] += np.diag([2.0, 2.0, 2e-3, 2e-3])
        self.gyroscopic[10, 11], self.gyroscopic[11, 10] = 4e-3, -4e-3

    def _magnet(self, tag, n):
        places = {"x": 4 * n, "y": 4 * n + 1}
        parts = {"K": lambda _: 3e4 * np.eye(2), "C": lambda _: 20.0 * np.eye(2)}  # with a controller, as ROSS's
        numbers = {"ks": -8e3, "ki": 12.0, "sensors_axis_rotation": np.pi / 4, "n_link": None}
        return SimpleNamespace(tag=tag, n=n, dof_global_index=places, **parts, **numbers)

    def _held(self, matrix, part):
        matrix = matrix.copy()
        for element in self.bearing_elements:
            matrix[np.ix_(*[list(element.dof_global_index.values())] * 2)] += getattr(element, part)(0)
        return matrix

    def M(self, _=0):
        return self.mass.copy()

    def K(self, _=0):
        return self._held(self.stiffness, "K")

    def C(self, _=0):
        return self._held(2.0 * self.mass, "C")

    def G(self):
        return self.gyroscopic.copy()


def test_the_simulation_is_the_identified_plant():
    """Eigenvectors of the whole model by scipy, and gbid's reduction with amplifiers, sensors and exact delay."""
    rotor, hz = SmallRotor(), np.array([3.0, 30.0, 150.0, 400.0])
    machine = study.Machine(rotor, study.Truth(), 6000.0)
    parameters = {**study.true_values(rotor), "omega_sensor": 2 * np.pi * study.SENSOR_HZ}
    (plant,) = study.plants_of(rotor, parameters, [6000.0])
    assert (plant.poles().real > 1).sum() == 4
    response = sample_plant(plant, study.SAMPLE_TIME, 0.0).frequency_response(hz)
    np.testing.assert_allclose(machine.plant_response(hz), response, rtol=1e-3, atol=1e-3 * np.abs(response).max())


def test_a_recording_is_held_by_its_controller_and_told_apart_from_others():
    machine = study.Machine(SmallRotor(), study.Truth(), 3000.0)
    recording = study.recorded(machine, 0.02, 3, 0.02)
    p = recording.signal("p")
    step = 2 * study.FULL_SCALE / 2**study.BITS
    np.testing.assert_allclose(p, step * np.round(p / step), atol=1e-15)
    assert 0 < np.abs(p).max() < study.FULL_SCALE
    other = study.Truth().perturbed(np.random.default_rng(0))
    assert 0 < abs(other.k_s[0] / study.Truth().k_s[0] - 1) <= 0.05


def test_the_squares_stiffen_by_three_halves_of_the_square_of_the_amplitude():
    """Without current the force is k g (w + 2 w^3 + ...), w = z / g; a sine of amplitude W stiffens it by 3/2 W^2."""
    wave = 0.02 * np.sin(2 * np.pi * np.arange(1000) / 100)[:, None]
    signals = {"p": study.GAP * np.hstack([wave, 0 * wave]), "i": np.zeros((1000, 2))}
    recording = gbid.Recording(signals, study.SAMPLE_TIME, name="sine")
    assert study.stiffening(recording) == pytest.approx(1.5 * 0.02**2, rel=2e-3)


def test_the_excitation_is_the_largest_that_the_squares_allow(monkeypatch):
    assert STORED["fit"]["stiffening"] <= study.STIFFENED
    monkeypatch.setattr(study, "recorded", lambda machine, seconds, seed, amplitude: amplitude)
    for share, amplitude in ((2.4, 0.02), (2.6, 0.01), (0.6, 0.04)):
        monkeypatch.setattr(study, "stiffening", lambda recording, share=share: share * recording**2)
        assert study.excited(None) == (pytest.approx(amplitude), pytest.approx(amplitude))


def test_stiffness_and_force_per_current_are_within_three_deviations_and_a_percent():
    rows = [row for row in STORED["fit"]["parameters"] if row["name"].startswith("k_")]
    assert len(rows) == 4
    assert STORED["fit"]["status"] == "converged"
    for row in rows:
        assert abs(row["value"] - row["truth"]) < min(3 * row["std"], 0.01 * abs(row["truth"])), row
        assert abs(row["start"] / row["truth"] - 1) > 0.03


def test_zone_a_holds_over_the_speeds_and_for_twenty_rotors():
    assert STORED["degrees_of_freedom"] == 318
    assert [row["speed_rpm"] for row in STORED["by_speed"]] == pytest.approx(np.linspace(0, 9000, 5))
    assert len(STORED["rotors"]) == 20
    for row in [*STORED["by_speed"], *STORED["rotors"]]:
        assert row["peak"] < 3.0
        assert row["position_um"] < 20.0
        assert row["current_A"] < 1.0
    assert STORED["ross"]["largest_difference"] < 0.01


def test_the_rotor_lifts_off_its_retainer_bearings_with_saturated_currents():
    assert len(STORED["lift_off"]) == len(study.DIRECTIONS)
    for row in STORED["lift_off"]:
        best = row["levitates"]
        assert best["held"]
        assert not best["touches"]
        assert best["offset_um"] >= 0.9e6 * study.RETAINER
        assert best["largest_current_A"] == pytest.approx(study.BIAS)
        assert row["from_retainer"]["held"]
        assert row["from_retainer"]["largest_radius_um"] < 1.06e6 * study.RETAINER


def test_the_design_is_certified_and_no_gain_lies_on_a_bound():
    assert STORED["design"]["status"] == "local optimum"
    assert STORED["design"]["damping"] > 0.02
    gains = STORED["design"]["gains"]
    for gain in study.law_of_bearings().parameters:
        assert gain.lower * 1.02 < gains[gain.name] < gain.upper / 1.02, gain.name


def test_forces_of_magnets_are_those_of_the_squares_of_currents_and_gaps():
    machine = study.Machine(SmallRotor(), study.Truth(k_s=(1.0, 1.0), k_i=(1.0, 1.0)), 0.0)
    z, i, gap = 3e-4, -0.4, 12.0 * study.BIAS / 8e3
    pole = 12.0 * gap**2 / (4 * study.BIAS)
    expected = pole * (((study.BIAS + i) / (gap - z)) ** 2 - ((study.BIAS - i) / (gap + z)) ** 2)
    more = machine.beyond_linear(np.full(4, z), np.full(4, i))
    np.testing.assert_allclose(more + 8e3 * z + 12.0 * i, expected)
    np.testing.assert_allclose(machine.beyond_linear(np.full(4, 1e-8), np.full(4, 1e-6)), 0.0, atol=1e-9)


def test_from_data_to_compiled_code_takes_less_than_five_minutes():
    assert STORED["fit"]["processor_s"] + sum(STORED["design"]["processor_s"].values()) < 300
