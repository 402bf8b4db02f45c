"""Faults of the measuring chain are found by name, and nothing is found where nothing is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from places import MEASURED as DATA
from rig_point import machine

from gbid.recording import Recording, find_problems, import_recording, quality
from gbid.recording.quality import find_group_problems, find_rub
from gbid.rig import (
    Faults,
    FilmPoint,
    FilmStiffening,
    FlexibleMode,
    GasFilm,
    Hammer,
    Machine,
    NonSynchronous,
    PiezoStacks,
    Played,
    Prbs,
    ProcessNoise,
    RunUp,
    SampledController,
    Staircase,
    Stationary,
    record,
    touch_downs,
)

POINTS = [(p, n) for p in (3.0, 4.0, 5.0, 6.0, 7.0) for n in (0.0, 4000.0, 6000.0)]
TURN = 2 * np.pi


def rig(experiment, pressure=5.0, speed=6000.0, name="rec", seed=1, made=None, **options):
    conditions = {"pressure_bar": pressure, "speed_rpm": speed}
    return record(made or machine(pressure, speed), experiment, conditions=conditions, seed=seed, name=name, **options)


@pytest.fixture(scope="module")
def prbs():
    return {point: rig(Prbs(1.0), *point) for point in POINTS}


def found(rec, signals=None):
    return [(p.kind, p.signal, p.channel) for p in find_problems(rec, signals) if p.kind != "constant"]


def swapped(rec, *names):
    return rec.with_signals(**{name: rec.signal(name)[:, ::-1] for name in names})


def dead(rec, name, channel, noise=30e-9):
    values = rec.signal(name).copy()
    values[:, channel] = 2e-6 + noise * np.random.default_rng(7).standard_normal(len(values))
    return rec.with_signals(**{name: values})


# ---- no false alarms ----


@pytest.mark.parametrize("point", POINTS)
def test_nothing_is_wrong_with_clean_recordings(point, prbs):
    assert found(prbs[point]) == []
    assert found(rig(Stationary(1.0), *point)) == []


@pytest.mark.parametrize("point", [(3.0, 0.0), (5.0, 4000.0), (7.0, 6000.0)])
def test_nothing_is_wrong_with_the_whole_rig(point):
    made = replace(
        machine(*point),
        actuator=PiezoStacks(),
        flexible_mode=FlexibleMode(),
        stiffening=FilmStiffening(),
        non_synchronous=NonSynchronous(),
        process_noise=ProcessNoise(),
    )
    assert found(rig(Prbs(1.0), *point, made=made)) == []
    assert found(rig(Stationary(1.0), *point, made=made)) == []


@pytest.mark.parametrize(
    "experiment",
    [Staircase("x", hold_s=0.2), Staircase("y", hold_s=0.2), Hammer(), RunUp()],
    ids=lambda e: repr(e)[:16],
)
def test_nothing_is_wrong_with_other_experiments(experiment):
    # a run-up is nothing wrong, but it has no one speed
    changing = [("speed", "", "")] if isinstance(experiment, RunUp) else []
    assert found(rig(experiment, 6.0, 0.0)) == changing


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured recordings are not on this machine")
def test_nothing_is_wrong_with_measured_rigs():
    for k in range(1, 5):
        signals = {"u": {"columns": f"u{k}", "unit": "", "stored_unit": ""}, "y": {"columns": f"y{k}", "unit": "rad"}}
        signals["u"]["channels"] = "u"
        for signal in signals.values():
            signal["columns"] = (signal["columns"],)
        signals["u"]["channels"] = ("u",)
        mapping = {"name": f"arm{k}", "sample_time_s": 0.01, "signals": signals}
        kinds = [problem.kind for problem in find_problems(import_recording(DATA / "rotary_arm.npz", mapping))]
        assert set(kinds) <= {"saturated"}  # one drive is a ramp that ends at its limit by design
    values = np.load(DATA / "twin_mode_rig.npz")["noise"]
    twin = Recording({"u": values[:, :2], "y": values[:, 2:]}, 0.025, units={"u": "V", "y": "V"})
    assert find_problems(twin) == []
    # the same rig under the names of ours: it does answer, and straight
    assert find_problems(Recording({"u": values[:, :2], "p": values[:, 2:]}, 0.025)) == []


# ---- swapped and dead ----


@pytest.mark.parametrize("point", POINTS[::2])
def test_swapped_channels_are_caught_by_name(point, prbs):
    for name in ("r", "u", "p"):
        assert found(swapped(prbs[point], name)) == [("swapped", name, "")]


@pytest.mark.parametrize("point", POINTS[1::2])
def test_dead_sensors_are_caught_by_name(point, prbs):
    for name in ("u", "p"):
        for number, channel in enumerate("xy"):
            assert found(dead(prbs[point], name, number)) == [("dead", name, channel)]


def test_swapped_without_references_leaves_it_open(prbs):
    rec = prbs[5.0, 0.0]
    alone = replace(rec, signals={name: rec.signal(name) for name in ("u", "p")})
    assert found(alone) == []
    (problem,) = find_problems(swapped(alone, "p"))
    assert "either 'u' or 'p' has x and y swapped" in problem.text


def test_texts_name_recording_channel_evidence_and_cure(prbs):
    (problem,) = [p for p in find_problems(dead(prbs[5.0, 0.0], "p", 1)) if p.kind == "dead"]
    for word in ("recording 'rec'", "signal 'p' channel 'y' is dead", "not respond to 'r'", "coherence 0.", "cable"):
        assert word in problem.text


def test_only_the_signals_asked_for_are_reported(prbs):
    assert found(swapped(prbs[5.0, 0.0], "p"), ["r", "u"]) == []


def test_faults_of_the_rig_are_caught():
    assert found(rig(Prbs(1.0), faults=Faults(swapped=("p",)))) == [("swapped", "p", "")]
    assert [p.kind for p in find_problems(rig(Prbs(1.0), faults=Faults(dead={"p.y": 1e-6})))] == ["constant"]
    assert [p.kind for p in find_problems(rig(Prbs(1.0), faults=Faults(sample_time_factor=1.25)))] == ["sample_time"]
    assert found(rig(Prbs(1.0), faults=Faults(spikes_per_s=20.0))) == []  # the median of three takes these out


# ---- cause ----


def early(rec, name, samples):
    """Return the recording with one signal that comes some samples too early."""
    n = rec.n_samples - samples
    return replace(rec, signals={q: v[samples:] if q == name else v[:n] for q, v in rec.signals.items()})


def feedback(gain=1.0, slope_s=0.0):
    """Feedback of position and velocity, as differences over a sample."""
    rate = slope_s / 2e-4
    return SampledController(np.zeros((2, 2)), np.eye(2), -rate * np.eye(2), (gain + rate) * np.eye(2), 2e-4)


@pytest.mark.parametrize(("late", "names"), [((0, 15), "rup"), ((8, 0), "ru"), ((0, 15), "up"), ((0, 40), "up")])
def test_an_answer_before_its_cause_is_named(prbs, late, names):
    for point in ((5.0, 6000.0), (3.0, 0.0)):
        rec = replace(prbs[point], signals={q: prbs[point].signal(q) for q in names})
        rec = early(early(rec, "u", late[0]) if late[0] else rec, "p", late[1]) if late[1] else early(rec, "u", late[0])
        (problem,) = (q for q in find_problems(rec) if q.kind == "cause")
        assert problem.signal == ("u" if late[0] else "p")
        assert "answers before its cause" in problem.text
        assert "[GB143]" in problem.text
        assert int(problem.text.partition("about ")[2].split()[0]) == pytest.approx(sum(late), rel=0.7)


@pytest.mark.parametrize("controller", [None, feedback(), feedback(0.5, 2e-4)], ids=["open", "P", "PD"])
def test_white_noise_shows_an_answer_before_its_cause(controller):
    """In a loop the noise is w; a recorded r that follows p is no white noise."""
    levels = 4e-6 * np.random.default_rng(1).standard_normal((5000, 2))
    options = {"controller": controller} if controller else {}
    rec = rig(Played(levels, 2e-4), 6.0, 0.0, **options)
    for names in ("wrup", "rup", "up"):
        some = replace(rec, signals={q: v for q, v in rec.signals.items() if q in names})
        assert "cause" not in {kind for kind, *_ in found(some)}
    assert ("cause", "p", "") in found(early(rec, "p", 15))


def test_one_sample_early_is_the_time_between_two_converters(prbs):
    assert found(early(prbs[5.0, 6000.0], "p", 1)) == []


@pytest.mark.parametrize("controller", [feedback(), feedback(0.5, 2e-4)], ids=["P", "PD"])
@pytest.mark.parametrize(
    "experiment", [Stationary(1.0), Hammer(), Prbs(1.0, amplitude_m=1e-6, hold_s=2e-3)], ids=["still", "blows", "prbs"]
)
def test_feedback_is_no_answer_before_its_cause(controller, experiment):
    for point in ((6.0, 0.0), (3.0, 4000.0)):
        rec = rig(experiment, *point, controller=controller)
        for names in ("wrup", "rup", "up"):
            some = replace(rec, signals={q: v for q, v in rec.signals.items() if q in names})
            assert not {"cause"} & {kind for kind, *_ in found(some)}
    if isinstance(experiment, Prbs):
        assert "cause" in {kind for kind, *_ in found(early(rec, "p", 15))}


# ---- rub ----


@pytest.mark.parametrize(("point", "clearance"), [((3.0, 0.0), 6e-6), ((5.0, 4000.0), 7e-6), ((7.0, 6000.0), 9e-6)])
def test_a_rub_is_caught_by_name(point, clearance):
    rec = rig(Prbs(2.0), *point, faults=Faults(rub_clearance_m=clearance))
    assert touch_downs(rec)
    problems = [p for p in find_problems(rec) if p.kind == "rub"]
    assert [(p.signal, p.channel) for p in problems] == [("p", "")]
    assert "impacts at" in problems[0].text


def test_a_rub_at_the_true_clearance_is_caught():
    rec = rig(Prbs(2.0, amplitude_m=9e-6, hold_s=5e-3), touch_down="flag")
    assert len(touch_downs(rec)) > 5
    assert "rub" in [p.kind for p in find_problems(rec)]


def test_a_rub_without_input_and_angle_is_caught():
    rec = rig(Prbs(2.0), 5.0, 0.0, faults=Faults(rub_clearance_m=7e-6))
    alone = replace(rec, signals={"p": rec.signal("p")})
    assert [p.kind for p in find_rub(alone)] == ["rub"]


@pytest.mark.parametrize(("point", "clearance"), [((3.0, 0.0), 7e-6), ((5.0, 4000.0), 7e-6), ((7.0, 6000.0), 8e-6)])
def test_a_rub_is_caught_in_the_noise_of_the_papers_campaign(point, clearance):
    made = machine(*point)
    made = replace(made, sensors=replace(made.sensors, noise_p_m=650e-9))
    rec = rig(Prbs(2.0), *point, made=made, faults=Faults(rub_clearance_m=clearance))
    assert len(touch_downs(rec)) > 12
    assert "rub" in [p.kind for p in find_problems(rec)]
    assert found(rig(Prbs(2.0), *point, made=made)) == []


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_a_film_that_stiffens_is_no_rub(seed):
    """At 3 bar and 6000 rpm the disc moves far, and run-out hides where the centre of the film is."""
    made = replace(machine(3.0, 6000.0), stiffening=FilmStiffening())
    assert found(rig(Prbs(1.5), 3.0, 6000.0, made=made, seed=seed)) == []


def test_gas_that_the_equation_of_motion_leaves_out_is_no_rub(monkeypatch):
    """The errors of the equation last longer than an impact: they halve with the window."""
    film = FilmPoint(GasFilm(around=36, along=6), 7.0, 0.0, 25e-6, 2.18)
    usual = machine(7.0, 0.0)
    made = Machine.from_parameters({}, PiezoStacks(), usual.unbalance, usual.sensors, film=film)
    rec = record(made, Prbs(2.0), conditions={"pressure_bar": 7.0, "speed_rpm": 0.0}, seed=2, name="film")
    assert [*find_rub(rec)] == []
    monkeypatch.setattr(quality, "SHARP", 0.0)
    assert len([*find_rub(rec)]) == 1


# ---- clock and encoder ----


def test_encoder_faults_are_named_and_the_wrap_is_not(prbs):
    rec = prbs[5.0, 6000.0]
    phi = rec.signal("phi").copy()
    phi[2000:] = np.mod(phi[2000:] + np.deg2rad(20), TURN)
    (problem,) = find_problems(rec.with_signals(phi=phi))
    assert problem.kind == "encoder"
    assert "jumps 1 times, the first by +20.0 degrees at 0.3998 s" in problem.text
    phi = rec.signal("phi").copy()
    phi[1000:1200] = phi[1000]
    (problem,) = find_problems(rec.with_signals(phi=phi))
    assert "stays at one angle for 200 samples (4.0%), the first at 0.2000 s" in problem.text
    assert found(rec.with_signals(phi=np.unwrap(rec.signal("phi"), axis=0))) == []


def test_a_speed_that_changes_is_named_with_the_part_to_keep(prbs):
    rec = prbs[5.0, 6000.0]
    n = rec.n_samples
    for share, words in (
        (
            np.minimum(1.0, 0.2 + 2.0 * np.arange(n) / n),
            "a run-up before it: cut to the part at this speed with from_s: 0.45 (sec",
        ),
        (
            np.minimum(1.0, 2.0 - 1.5 * np.arange(n) / n),
            "a change of speed beside it: cut to the part at this speed with to_s: 0.65 (sec",
        ),
        (0.3 + 0.5 * np.arange(n) / n, "in 100% of it, but speed_rpm = 6000; correct speed_rpm"),
    ):
        phi = np.mod(np.cumsum(share * 6000 / 60 * TURN * rec.sample_time), TURN)
        (problem,) = find_problems(rec.with_signals(phi=phi[:, None]), ["phi"])
        assert (problem.kind, problem.signal) == ("speed", "")
        assert words in problem.text


def test_wrong_sample_time_shows_against_the_shaft(prbs):
    (problem,) = find_problems(replace(prbs[5.0, 6000.0], sample_time=1e-3))
    assert problem.kind == "sample_time"
    assert "phi turns at 1200.0 rpm, but speed_rpm = 6000; a sample time of 0.0002 s would fit" in problem.text


def test_wrong_sample_time_shows_beside_the_others_at_rest():
    group = [rig(Prbs(1.0), 5.0, 0.0, name=f"r{i}") for i in range(4)]
    assert find_group_problems(group) == {}
    group[2] = replace(group[2], sample_time=1e-3)
    problems = find_group_problems(group)
    assert {name: [p.kind for p in found_problems] for name, found_problems in problems.items()} == {
        "r2": ["sample_time"]
    }
    assert "a sample time of 0.0002 s would fit" in problems["r2"][0].text
    # another hold at the right clock is another experiment, not a fault
    group[2] = rig(Prbs(1.0, hold_s=10e-3), 5.0, 0.0, name="r2")
    assert find_group_problems(group) == {}


def test_one_content_under_two_names():
    one, two = (rig(Prbs(1.0), name=name) for name in ("one", "two"))
    problems = find_group_problems([one, two, replace(one, name="copy")])
    assert list(problems) == ["copy"]
    assert problems["copy"][0].kind == "duplicate"
    assert "holds the same samples as 'one'" in problems["copy"][0].text


@pytest.mark.parametrize(("length", "is_saturated"), [(quality.MIN_RUN - 1, False), (quality.MIN_RUN, True)])
def test_a_saturated_channel_stays_at_its_limit_for_five_samples(length, is_saturated):
    column = np.random.default_rng(1).uniform(-1.0, 0.5, 2000)
    for k in range(20, 2000, 50):
        column[k : k + length] = 1.0
    assert quality.stays_at_limits(column) == ({1.0: 40 * length} if is_saturated else {})
