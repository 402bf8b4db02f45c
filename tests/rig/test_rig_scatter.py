"""Scatter between recordings, faults put in on purpose, quantisation, and all of the rig from the YAML."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from experiment_files import gbid, write_quick
from rig_point import machine, modes, rotor_bearing

from gbid.core.errors import UsageError
from gbid.experiment.fields import ExperimentError
from gbid.experiment.load import load_experiment
from gbid.experiment.machine import true_values
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.rig import RIG
from gbid.experiment.structures import make_structure
from gbid.lpv.model import PUBLISHED_RMS
from gbid.recording import find_problems, load_recording
from gbid.rig import Faults, PiezoStacks, Prbs, RotorBearingTruth, Scatter, SensorChain, record, saturations
from gbid.rig.machine import scatter_random, scattered, scattered_bearing
from gbid.rig.simulation import drawn_truth

TS = 2e-4
FIG7 = {"pressure_bar": 5.0, "speed_rpm": 6000.0}
POINTS = [(p, n) for p in (3.0, 4.0, 5.0, 6.0, 7.0) for n in (0.0, 4000.0, 6000.0)]


TRUTH = RotorBearingTruth(
    np.array([[-5e5, 3e3], [-2e3, -8e5]]),
    np.array([[-250.0, 30.0], [-20.0, -280.0]]),
    np.array([[1.5e5, 3e3], [2e3, 2.5e5]]),
    np.array([0.8e-3, 0.6e-3]),
)
SCATTER = Scatter(
    share=0.5, delay_s=(1e-4, 2e-4), frequency_hz=(2.0, 4.0), damping=(0.01, 0.02), static_gain=(0.01, 0.02, 0.03, 0.04)
)


# ---- scatter ----


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_every_operating_point_stays_stable(share):
    random = np.random.default_rng(1)
    for pressure, speed in POINTS:
        truth = rotor_bearing(pressure, speed)
        for _ in range(40):
            drawn, _ = scattered(truth, Scatter(share), random)
            drawn.check_stable()
            assert (modes(drawn)[1] >= np.minimum(0.01, modes(truth)[1] / 2).min() - 1e-12).all()
            assert (drawn.delay > 0).all()


def test_draw_belongs_to_seed_name_and_operating_point_and_is_told():
    def make(seed=1, name="a", point=None):
        return record(machine(), Prbs(0.1), conditions=point or FIG7, seed=seed, name=name, scatter=Scatter())

    first = drawn_truth(make())
    assert first == drawn_truth(make())
    expected, _ = scattered(rotor_bearing(), Scatter(), scatter_random(1, "a", FIG7))
    assert first == expected.key_parameters()
    others = [make(seed=2), make(name="b"), make(point={**FIG7, "pressure_bar": 5.1})]
    assert len({json.dumps(first), *(json.dumps(drawn_truth(o)) for o in others)}) == 4
    rig = json.loads(make().provenance["rig"])["rotor_bearing"]
    assert rig["delay"] == [first["tau_x"], first["tau_y"]]
    assert drawn_truth(record(machine(), Prbs(0.1), conditions=FIG7, seed=1, name="a")) == pytest.approx(
        rotor_bearing().key_parameters()
    )


def test_recordings_at_a_point_share_a_deviation_and_scatter_little_about_it():
    """Variance of the delays within and between points, by hand; the draw of a point belongs to seed and point."""
    scatter = replace(SCATTER, share=None, within=0.2, delay_s=(1e-5, 2e-5))
    delays = np.array([
        [scattered_bearing(TRUTH, scatter, 1, f"prbs{i}", {"pressure_bar": float(k)})[0].delay for i in range(30)]
        for k in range(60)
    ])  # fmt: skip
    within, between = delays.var(axis=1, ddof=1).mean(axis=0), delays.mean(axis=1).var(axis=0, ddof=1)
    np.testing.assert_allclose(np.sqrt(within + between), (1e-5, 2e-5), rtol=0.15)
    np.testing.assert_allclose(within / (within + between), 0.2, atol=0.05)
    point = {"pressure_bar": 0.0}
    nearly = replace(scatter, within=1e-12)
    one, other = (scattered_bearing(TRUTH, nearly, 1, name, point)[0].delay for name in "ab")
    np.testing.assert_allclose(one, other, rtol=1e-6)
    assert (Scatter().sizes, Scatter(within=0.36).sizes) == ((0.0, 0.5), pytest.approx((0.8, 0.6)))


# ---- scatter from random numbers that are known ----


class Given(np.random.Generator):
    """Random numbers that are told beforehand, ten for each draw."""

    def __init__(self, *draws: Any) -> None:
        super().__init__(np.random.PCG64(0))
        self._draws = iter(draws)

    def standard_normal(self, n: int) -> Any:
        assert n == 10
        return np.array(next(self._draws), float)


def gain(truth: RotorBearingTruth) -> Any:
    return -np.linalg.solve(truth.stiffness, truth.input_gain)


def test_each_number_moves_its_own_quantity_by_half_its_deviation() -> None:
    z = [1.0, -0.5, 0.6, -0.8, 1.0, -2.0, 1.0, -1.0, 0.5, 2.0]
    drawn, rejected = scattered(TRUTH, SCATTER, Given(z))
    assert rejected == 0
    frequency, damping = modes(TRUTH)
    np.testing.assert_allclose(modes(drawn)[0], frequency + np.array([1.0, -1.0]), rtol=1e-9)
    np.testing.assert_allclose(modes(drawn)[1], damping + np.array([0.003, -0.008]), rtol=1e-9)
    np.testing.assert_allclose(drawn.delay, TRUTH.delay + np.array([0.5e-4, -2e-4]), rtol=1e-12)
    np.testing.assert_allclose(gain(drawn), gain(TRUTH) + np.array([[0.005, -0.01], [0.0075, 0.04]]), rtol=1e-9)


def test_the_scatter_is_that_of_the_papers_recordings() -> None:
    paper = Scatter()
    assert (paper.sizes, paper.minimum_damping, paper.minimum_delay_s) == ((0.0, 0.5), 0.01, 2e-5)  # as the docs say
    stated = (*paper.delay_s, *paper.frequency_hz, *paper.damping, *paper.static_gain)
    assert stated == tuple(PUBLISHED_RMS.values())


def test_mode_shapes_are_kept() -> None:
    drawn, _ = scattered(TRUTH, SCATTER, Given([1.0, -0.5, 0.6, -0.8, *[0.0] * 6]))

    def shapes(truth: RotorBearingTruth) -> Any:
        values, vectors = np.linalg.eig(np.block([[np.zeros((2, 2)), np.eye(2)], [truth.stiffness, truth.damping]]))
        upper = [i for i in np.argsort(np.abs(values), kind="stable") if values[i].imag > 0]
        return vectors[1, upper] / vectors[0, upper]

    np.testing.assert_allclose(shapes(drawn), shapes(TRUTH), rtol=1e-8)


@pytest.mark.parametrize(("place", "sign"), [(2, -1), (3, -1), (4, -1), (5, -1), (2, 1), (0, -1)])
def test_draws_beyond_the_limits_are_rejected_and_counted(place: int, sign: int) -> None:
    """Too little damping or a delay too short; a mode that no longer oscillates; a frequency below zero."""
    wild = np.zeros(10)
    wild[place] = sign * 1000.0
    drawn, rejected = scattered(TRUTH, SCATTER, Given(wild, wild, np.zeros(10)))
    assert rejected == 2
    np.testing.assert_allclose(drawn.stiffness, TRUTH.stiffness, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(drawn.damping, TRUTH.damping, rtol=1e-9, atol=1e-8)


def test_half_of_a_small_damping_or_delay_is_allowed() -> None:
    """Limits far above the truth become half of it."""
    strict = Scatter(share=1.0, damping=(1.0, 1.0), delay_s=(1.0, 1.0), minimum_damping=0.9, minimum_delay_s=1.0)
    damping, delay = modes(TRUTH)[1], TRUTH.delay
    just = np.concatenate([[0, 0], -0.49 * damping, -0.49 * delay, np.zeros(4)])
    drawn, rejected = scattered(TRUTH, strict, Given(just))
    assert rejected == 0
    np.testing.assert_allclose(modes(drawn)[1], 0.51 * damping, rtol=1e-8)
    for place, size in ((2, damping[0]), (3, damping[1]), (4, delay[0]), (5, delay[1])):
        below = np.zeros(10)
        below[place] = -0.51 * size
        assert scattered(TRUTH, strict, Given(below, np.zeros(10)))[1] == 1


# ---- faults and converters ----


def made(faults=None, rig=None, **options):
    return record(rig or machine(), Prbs(1.0), conditions=FIG7, seed=1, name="a", faults=faults, **options)


def test_faults_do_what_they_say_and_leave_the_rest():
    right = made()
    swapped = made(Faults(swapped=("p",)))
    np.testing.assert_array_equal(swapped.signal("p"), right.signal("p")[:, ::-1])
    np.testing.assert_array_equal(swapped.signal("u"), right.signal("u"))
    assert swapped.provenance["faults"] == "x and y of p swapped"

    dead = made(Faults(dead={"p.y": 1e-6}))
    assert (dead.signal("p")[:, 1] == 1e-6).all()
    np.testing.assert_array_equal(dead.signal("p")[:, 0], right.signal("p")[:, 0])
    assert [(q.kind, q.channel) for q in find_problems(dead)] == [("constant", "y")]

    ended = made(Faults(saturation={"p.x": 4e-6}))
    assert np.abs(ended.signal("p")[:, 0]).max() == 4e-6

    slow = made(Faults(sample_time_factor=2.0))
    assert slow.sample_time == 2 * TS
    assert slow.n_samples == right.n_samples

    lost = made(Faults(missing_index=True))
    shift = np.mod(lost.signal("phi") - right.signal("phi"), 2 * np.pi)
    assert np.ptp(np.exp(1j * shift)) < 1e-9
    assert 0 < shift[0] < 2 * np.pi

    spiky = made(Faults(spikes_per_s=20, spike_size_m=20e-6))
    off = np.abs(spiky.signal("p") - right.signal("p"))
    assert set(np.round(np.unique(off) * 1e6, 6)) == {0.0, 20.0}
    assert 5 <= (off > 0).sum() <= 40

    assert "faults" not in made(Faults()).provenance


def test_converters_step():
    sensors = SensorChain(resolution_p_m=5e-9, resolution_u_m=7e-9)
    for rig in (machine(sensors=sensors), replace(machine(sensors=sensors), actuator=PiezoStacks())):
        rec = made(rig=rig)
        for signal, step in (("p", 5e-9), ("u", 7e-9)):
            counts = rec.signal(signal) / step
            np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    fine = made()
    assert np.abs(made(rig=machine(sensors=sensors)).signal("p") - fine.signal("p")).max() <= 2.5e-9 * 1.001


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Faults(dead={"p": 0.0}), "faults: no channel p; write signal.channel"),
        (lambda: Faults(sample_time_factor=0.0), "sample_time_factor = 0.0; give a number above 0"),
        (lambda: made(Faults(dead={"q.x": 0.0})), "has no channel q.x"),
        (lambda: made(Faults(swapped=("phi",))), "no signal phi with two channels"),
        (
            lambda: Scatter(delay_s=(1.0,)),
            r"delay_s = \(1.0,\); give \(a number of at least 0, a number of at least 0\)",
        ),
        (lambda: SensorChain(resolution_p_m=-1e-9), "resolution_p_m = -1e-09; give a number of at least 0"),
        (
            lambda: scattered(replace(rotor_bearing(), damping=-4000 * np.eye(2)), Scatter(), np.random.default_rng(0)),
            "does not oscillate",
        ),
    ],
)
def test_bad_input_is_one_clear_line(call, words):
    with pytest.raises(UsageError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


# ---- from the YAML ----

WHOLE = """\
format: 1
name: whole
rig:
  seed: 3
  operating_points:
    - {pressure_bar: 5.0, speed_rpm: 4000, prbs_recordings: 1}
    - {pressure_bar: 6.0, speed_rpm: 0}
  duration_s: 0.5
  settle_s: 0.1
  touch_down: flag
  prbs: {recordings: 2}
  stationary: {recordings: 1}
  staircase: {hold_s: 0.02, step_m: 2e-6}
  stack_staircase: {stacks: [1, 4], hold_s: 0.02}
  hammer: {axes: [y], times_s: [0.1, 0.3], peak_n: 9.0, duration_s: 0.5}
  run_up: {to_rpm: 4000, duration_s: 0.5}
  sensors: {resolution_p_m: 5e-9}
  actuators: {kind: stacks, spread: 0.1, seed: 2, creep: 0.02}
  flexible_mode: {frequency_hz: 450.0}
  stiffening: {}
  non_synchronous: {size_m: 0.2e-6}
  process_noise: {density: 0.02}
  scatter: {share: 1.0}
  faults:
    - {recordings: p6_n0_prbs2, swapped: [p]}
fits:
  bearing: {structure: rotor_bearing}
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    experiment = load_experiment(write_quick(folder, text=WHOLE))
    outcomes = run_stage(Job(experiment), RIG)
    assert {o.state for o in outcomes} == {"made"}
    return experiment


def test_yaml_makes_every_kind_of_recording(whole):
    names = [f"p5_n4000_{w}" for w in ("still1", "prbs1")] + [f"p6_n0_{w}" for w in ("still1", "prbs1", "prbs2")]
    rest = "stairs_x1 stairs_y1 stack1_open1 stack1_controlled1 stack4_open1 stack4_controlled1 hammer_y1 runup1"
    names += [f"{point}_{w}" for point in ("p5_n4000", "p6_n0") for w in rest.split()]
    assert set(whole.recordings) == set(names)
    kinds = {q.name.split("_", 2)[2]: q.kind for q in whole.recordings.values()}
    assert kinds["prbs2"] == "excited"
    assert kinds["still1"] == "stationary"
    assert {kinds[n] for n in ("stairs_x1", "stack4_open1")} == {"staircase"}
    assert (kinds["hammer_y1"], kinds["runup1"]) == ("hammer", "run_up")
    assert [q.name for q in whole.fit_recordings("bearing")] == ["p5_n4000_prbs1", "p6_n0_prbs1", "p6_n0_prbs2"]
    for name, planned in whole.recordings.items():
        rec = load_recording(whole.results / "recordings" / f"{name}.h5")
        assert rec.provenance["simulation"] == "stepping, compiled"
        assert {signal: rec.channels[signal] for signal in rec.signals} == dict(planned.signals)
        rig = json.loads(rec.provenance["rig"])
        assert rig["flexible_mode"]["frequency_hz"] == 450.0
        assert rig["stiffening"]["deviation_m"] == 0.9e-6
        assert rig["process_noise"]["density"] == 0.02
        assert rig["actuator"]["stacks"][2]["creep"] == 0.02
        assert rig["sensors"]["resolution_p_m"] == 5e-9
    hit = load_recording(whole.results / "recordings" / "p6_n0_hammer_y1.h5")
    assert hit.signal("f")[:, 1].max() == pytest.approx(9.0, abs=0.3)
    swapped = load_recording(whole.results / "recordings" / "p6_n0_prbs2.h5")
    assert swapped.provenance["faults"] == "x and y of p swapped"
    assert saturations(load_recording(whole.results / "recordings" / "p6_n0_stack4_open1.h5"))


def test_truth_that_fits_are_compared_with_is_the_one_drawn(whole):
    structure = make_structure(whole, "bearing")
    told = true_values(whole, ["p6_n0_prbs1"], structure)
    rec = load_recording(whole.results / "recordings" / "p6_n0_prbs1.h5")
    assert told == pytest.approx(drawn_truth(rec))
    assert told != pytest.approx(rotor_bearing(6.0, 0.0).key_parameters(), rel=1e-4)
    assert true_values(whole, ["p6_n0_prbs1", "p6_n0_prbs2"], structure) == {}  # each its own


def test_a_change_of_any_part_makes_the_recording_anew(tmp_path, capsys):
    path = write_quick(tmp_path)
    assert gbid("rig", path) == 0
    for old, new in (
        ("seed: 3", "seed: 3\n  settle_s: 0.2"),
        ("seed: 3", "seed: 3\n  scatter: {}"),
        ("seed: 3", "seed: 3\n  actuators: {kind: stacks}"),
        ("seed: 3", "seed: 3\n  faults: [{recordings: '*', swapped: [p]}]"),
        ("seed: 3", "seed: 3\n  oversampling: 30"),
    ):
        write_quick(tmp_path, (old, new))
        assert gbid("rig", path) == 2
        assert "made with other settings" in capsys.readouterr().err
    write_quick(tmp_path)
    assert gbid("rig", path) == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seed: 3", "seed: 3\n  stiffening:", "rig.stiffening: is empty; write {} for the defaults"),
        ("seed: 3", "seed: 3\n  hammer: {axes: [z]}", "rig.hammer.axes[0]: expected 'x' or 'y', found 'z'"),
        ("seed: 3", "seed: 3\n  hammer: {times_s: [2.0]}", "rig: hammer: an impact at 2.0 s"),
        (
            "seed: 3",
            "seed: 3\n  staircase: {hold_s: 1.05e-3}",
            "rig.staircase.hold_s: hold_s = 0.00105 s is not",
        ),
        ("seed: 3", "seed: 3\n  stack_staircase: {}", "kind: stacks"),
        ("seed: 3", "seed: 3\n  stack_staircase: {stacks: [5]}", "rig.stack_staircase.stacks[0]: must be at most 4"),
        ("seed: 3", "seed: 3\n  scatter: {shares: 1}", "did you mean 'share'"),
        ("seed: 3", "seed: 3\n  faults: [{recordings: nosuch}]", "no recording of the rig matches 'nosuch'"),
        ("seed: 3", "seed: 3\n  faults: [{recordings: '*', dead: {p: 0.0}}]", "write signal.channel"),
    ],
)
def test_yaml_problems_are_named(tmp_path, old, new, words):
    with pytest.raises(ExperimentError) as caught:
        load_experiment(write_quick(tmp_path, (old, new)))
    assert words in str(caught.value)
