"""Fits: recovery, invariance, options, uncertainty, interruption and bad input."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from fit_cases import (
    ACTUATORS,
    EVERY,
    EVERY_AT,
    KEY,
    MODE,
    MODE_AT,
    TS,
    H,
    innovations,
    levels,
    piezo_motion,
    simulated,
)
from places import SUPPORT

import gbid
from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.identify.options import FitArguments
from gbid.identify.pose import pose
from gbid.identify.problem.solve import solve
from gbid.recording import Recording
from gbid.structure import KEY_PARAMETERS, LinearStructure, Parameter, PiezoPair, Plant, RotorBearing, evaluate

PHYSICAL = ("w", "z", "g")  # of MODE
GAINS = {"bd_xx": 0.0, "bd_xy": 0.0, "bd_yx": 0.0, "bd_yy": 0.0}


def mode_data(n=2000, noise=0.3, seed=1, **more):
    return simulated(MODE, MODE_AT, levels(n, seed=seed), noise=noise, seed=seed, **more)


def rotor_data(n=2500, noise=3e-8, seed=1, **more):
    u = piezo_motion(n, seed)
    return simulated(RotorBearing(), {**KEY, **GAINS}, u, h=TS, hold="foh", noise=noise, seed=seed, **more)


def sigmas(result, truth, names):
    return np.array([(result.parameters[q] - truth[q]) / result.std[q] for q in names])


@pytest.fixture(scope="module")
def rotor():
    return rotor_data()


@pytest.fixture(scope="module")
def rotor_fit(rotor):
    return fit(RotorBearing(), rotor)


# ---- recovery ----


def assert_exact(result, truth, names):
    assert result.success, result.status
    for name in names:
        assert result.parameters[name] == pytest.approx(truth[name], rel=1e-6), name
    assert result.fit_percent.min() > 99.9999  # the loss is below 1e-12 of the power


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
@pytest.mark.parametrize("window", [None, 50])
def test_without_noise_the_truth_is_found_exactly(focus, window):
    rec = mode_data(600, noise=0.0, x0=[1.5, -2.0])
    result = fit(MODE, rec, focus=focus, window=window)
    assert_exact(result, MODE_AT, PHYSICAL)
    assert result.status == "converged: the errors are at rounding"
    np.testing.assert_allclose(result.initial_states, [[1.5, -2.0]], rtol=1e-6)


def test_without_noise_both_criteria_find_it():
    rec = rotor_data(1500, noise=0.0)
    for criterion in ("trace", "det"):
        assert_exact(fit(RotorBearing(), rec, focus="simulation", criterion=criterion), KEY, KEY_PARAMETERS)


def test_exact_recovery_of_actuators_and_plant_from_the_data_alone():
    r = 4.5e-6 * levels(1500, 2, 40)
    rec = simulated(PiezoPair(), ACTUATORS, r, h=TS)
    assert_exact(fit(PiezoPair(), rec), ACTUATORS, ACTUATORS)
    plant = Plant(RotorBearing(pade_order=2, disturbance_gain="none"))
    rec = simulated(plant, {**ACTUATORS, **KEY}, r, h=TS)
    assert_exact(fit(plant, rec), {**ACTUATORS, **KEY}, [*ACTUATORS, *KEY_PARAMETERS])
    # From r to p alone the actuators must be known.
    assert_exact(fit(Plant(plant.bearing, outputs="p"), rec, fixed=ACTUATORS), KEY, KEY_PARAMETERS)


def test_rotor_bearing_with_noise(rotor_fit):
    assert rotor_fit.success
    assert np.abs(sigmas(rotor_fit, KEY, KEY_PARAMETERS)).max() < 4
    np.testing.assert_allclose(np.diag(rotor_fit.error_covariance), 9e-16, rtol=0.15)
    truth = evaluate(RotorBearing(), {**KEY, **GAINS}).modes()[:2]
    for (f, z), (f0, z0) in zip(rotor_fit.model.modes()[:2], truth, strict=True):
        assert f == pytest.approx(f0, abs=0.3)
        assert z == pytest.approx(z0, abs=0.003)


def test_the_disturbance_gain_is_recovered_from_innovations():
    rec = innovations(EVERY, EVERY_AT, levels(3000, 2, hold=3), noise=[0.2, 0.1])
    start = {**EVERY_AT, "k": 0.5, "w": 2.5, "a": 1.0}
    result = fit(EVERY, rec, start=start, criterion="det")
    assert result.success
    assert np.abs(sigmas(result, EVERY_AT, EVERY_AT)).max() < 4
    np.testing.assert_allclose(result.error_covariance, np.diag([0.04, 0.01]), rtol=0.1, atol=0.001)
    # The other focus sees the same system with more error.
    simulated = fit(EVERY, rec, start=start, focus="simulation")
    assert np.trace(simulated.error_covariance) > 1.05 * np.trace(result.error_covariance)


@pytest.mark.parametrize(("hold", "bias"), [("zoh", True), ("foh", False)])
def test_the_hold_enters(hold, bias):
    """A delay found with the wrong hold is off by half a sample."""
    result = fit(RotorBearing(), rotor_data(), intersample=hold, focus="simulation")
    assert result.options.intersample == (hold, hold)
    off = KEY["tau_x"] - result.parameters["tau_x"]
    assert (abs(off - 1e-4) < 3e-5) if bias else (abs(off) < 1e-5)


def test_one_hold_for_each_input():
    u = levels(400, 2, hold=3)
    rec = simulated(EVERY, EVERY_AT, u, hold=("zoh", "foh"))
    result = fit(EVERY, rec, start={**EVERY_AT, "w": 2.8}, intersample=("zoh", "foh"), focus="simulation")
    assert_exact(result, EVERY_AT, "awbcd")
    assert result.options.intersample == ("zoh", "foh")


# ---- invariance ----


def assert_same_optimum(a, b):
    assert a.success, a.status
    assert b.success, b.status
    assert b.loss == pytest.approx(a.loss, rel=1e-6)
    for name in a.free:
        if np.isfinite(a.std[name]):
            assert abs(b.parameters[name] - a.parameters[name]) < 1e-3 * a.std[name], name


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
@pytest.mark.parametrize("window", [40, 333])
def test_windows_do_not_move_the_optimum(focus, window):
    rec = mode_data()
    assert_same_optimum(fit(MODE, rec, focus=focus, window=None), fit(MODE, rec, focus=focus, window=window))


@pytest.mark.parametrize("window", [None, 500])
def test_scaling_does_not_move_the_optimum_of_the_rotor(rotor, rotor_fit, window):
    """Stiffnesses of 1e5 beside delays of 1e-4: the solver's tolerance says nothing then, so success is not asked."""
    task = pose(RotorBearing(), rotor, FitArguments())
    problem = task.problem(task.begin.values, window)
    ones = np.ones(problem.shooting.n_theta), np.ones(problem.shooting.n_states)
    unscaled = replace(problem.shooting, theta_scale=ones[0], state_scale=ones[1])
    points = problem.unknowns, *problem.shooting.box
    start, *box = (unscaled.pack(*problem.shooting.unpack(x)) for x in points)
    theta, starts = unscaled.unpack(solve(replace(unscaled, box=tuple(box)), start).unknowns)
    computed = dict(zip((q.name for q in problem.assembly.free), theta, strict=True))
    products = unscaled.error_products(unscaled.values(theta), starts) / unscaled.n_samples
    assert np.linalg.det(products) == pytest.approx(rotor_fit.loss, rel=1e-6)
    for name in rotor_fit.free:
        assert abs(computed[name] - rotor_fit.parameters[name]) < 1e-3 * rotor_fit.std[name], name


def test_the_start_does_not_move_the_optimum(rotor, rotor_fit):
    start = {"k_xx": 0.98 * KEY["k_xx"], "d_xx": 1.5 * KEY["d_xx"], "tau_y": 3e-4, "bd_xx": 2e3}
    assert_same_optimum(rotor_fit, fit(RotorBearing(), rotor, start=start))


def test_units_of_the_signals_only_scale_the_answer():
    rec = mode_data()
    small = rec.with_signals(u=1e-3 * rec.signal("u"), y=1e-6 * rec.signal("y"))
    a, b = fit(MODE, rec, focus="simulation"), fit(MODE, small, focus="simulation")
    assert b.loss == pytest.approx(1e-12 * a.loss, rel=1e-6)
    assert b.parameters["g"] == pytest.approx(1e-3 * a.parameters["g"], rel=1e-6)
    assert b.std["g"] == pytest.approx(1e-3 * a.std["g"], rel=1e-3)
    np.testing.assert_allclose(b.fit_percent, a.fit_percent, rtol=1e-6)


# ---- criteria ----


def test_for_one_output_determinant_and_trace_are_the_same():
    rec = mode_data()
    assert_same_optimum(*(fit(MODE, rec, focus="simulation", criterion=c) for c in ("trace", "det")))


# ---- options ----


def test_fixed_parameters_stay():
    result = fit(MODE, mode_data(), fixed={"z": 0.06, "l1": 0.0, "l2": 0.0})
    assert result.parameters["z"] == 0.06
    assert result.std["z"] == 0.0
    assert result.free == ("w", "g")
    assert result.covariance.shape == (2, 2)
    structure = LinearStructure(
        "own", [*MODE.parameters[:1], Parameter("z", 0.06, fixed=True), *MODE.parameters[2:]], MODE.matrices
    )
    again = fit(structure, mode_data(), fixed={"l1": 0.0, "l2": 0.0})
    assert again.parameters == result.parameters


def test_a_bound_that_holds_the_estimate_is_noted():
    result = fit(MODE, mode_data(), focus="simulation", bounds={"w": (5.5, 8.0)})
    assert result.parameters["w"] == pytest.approx(5.5, abs=1e-5)
    assert result.parameters["w"] >= 5.5
    assert np.isnan(result.std["w"])
    assert np.isfinite([result.std["z"], result.std["g"]]).all()
    assert any("w lies on a bound" in note for note in result.notes)
    free = fit(MODE, mode_data(), focus="simulation", bounds={"w": (4.0, 8.0)})
    assert_same_optimum(fit(MODE, mode_data(), focus="simulation"), free)
    assert not any("bound" in note for note in free.notes)


def test_simulation_focus_says_what_it_does_not_see():
    result = fit(MODE, mode_data(), focus="simulation", start={"l1": 0.5})
    assert result.parameters["l1"] == result.parameters["l2"] == 0.0
    assert np.isnan(result.std["l1"])
    assert result.free == PHYSICAL
    assert any("l1, l2" in note for note in result.notes)


def test_the_papers_stopping_rule():
    rec = mode_data()
    tight, paper = (fit(MODE, rec, focus="simulation", stop=stop) for stop in ("tolerance", "paper"))
    assert paper.success
    assert paper.iterations <= tight.iterations
    assert paper.loss == pytest.approx(tight.loss, rel=1e-4)
    assert np.abs(sigmas(paper, tight.parameters, PHYSICAL)).max() < 0.1
    assert paper.options.stop == "paper"


def test_progress_is_reported():
    seen = []
    result = fit(MODE, mode_data(), progress=seen.append)
    assert [p.iteration for p in seen] == list(range(result.iterations + 1))
    assert seen[-1].cost < seen[0].cost
    assert seen[-1].gap < 1e-6


def test_progress_is_one_line_that_ends_empty(capsys):
    result = gbid.fit(MODE, mode_data(500), progress=True)
    gbid.fit(MODE, mode_data(500))
    lines = capsys.readouterr().err.split("\r")
    assert [line.split(",")[0] for line in lines[1:-2]] == [f"iteration {i}" for i in range(result.iterations + 1)]
    assert {len(line) for line in lines[1:-1]} == {79}
    assert lines[-2:] == [" " * 79, ""]


def test_several_recordings_share_parameters_and_have_their_own_initial_states():
    states = [[1.0, 0.0], [-2.0, 3.0], [0.0, 5.0]]
    lengths = [700, 333, 901]
    recordings = [
        mode_data(n, x0=x, seed=i, name=f"r{i}") for i, (n, x) in enumerate(zip(lengths, states, strict=True))
    ]
    together = fit(MODE, recordings, focus="simulation")
    assert together.recordings == ("r0", "r1", "r2")
    assert together.fit_percent.shape == (3, 1)
    assert together.initial_states == pytest.approx(np.array(states), abs=0.6)
    assert np.abs(sigmas(together, MODE_AT, PHYSICAL)).max() < 4
    assert_same_optimum(together, fit(MODE, recordings, focus="simulation", window=None))
    alone = [fit(MODE, rec, focus="simulation") for rec in recordings]
    assert sum(r.loss * n for r, n in zip(alone, lengths, strict=True)) < together.loss * sum(lengths)
    for name in PHYSICAL:  # information adds up
        expected = sum(r.std[name] ** -2 for r in alone) ** -0.5
        assert together.std[name] == pytest.approx(expected, rel=0.15)


def test_channels_can_be_picked():
    u = np.hstack([levels(800, seed=9), levels(800, seed=1)])
    mixed = Recording({"u": u, "y": mode_data(800).signal("y")}, H)
    result = fit(MODE, mixed, inputs="u.y", outputs="y", focus="simulation")
    assert np.abs(sigmas(result, MODE_AT, PHYSICAL)).max() < 4.5
    assert result.model.input_names == ("u_y",)
    assert result.options.inputs == ("u.y",)


def test_fit_percent_is_that_of_the_definition():
    rec = mode_data()
    result = fit(MODE, rec, focus="simulation")
    y = rec.signal("y")
    model = result.model.simulate(rec.signal("u"), H, initial_state=result.initial_states[0])
    expected = 100 * (1 - np.linalg.norm(y - model) / np.linalg.norm(y - y.mean()))
    assert result.fit_percent[0, 0] == pytest.approx(expected, rel=1e-9)
    assert result.loss == pytest.approx(np.mean((y - model) ** 2), rel=1e-9)


# ---- uncertainty ----


def test_the_covariance_is_that_of_the_jacobian_by_differences():
    """A short record, where the initial state takes its share of what the data tell."""
    rec = mode_data(60, x0=[1.0, 2.0], noise=0.1)
    result = fit(MODE, rec, focus="simulation")
    u, x0 = rec.signal("u"), result.initial_states[0]

    def simulate(unknowns):
        values = dict(zip(PHYSICAL, unknowns[:3], strict=True)) | {"l1": 0.0, "l2": 0.0}
        return evaluate(MODE, values).simulate(u, H, initial_state=unknowns[3:])[:, 0]

    at = np.array([*(result.parameters[q] for q in PHYSICAL), *x0])
    steps = 1e-6 * np.eye(5)
    J = np.array([(simulate(at + s) - simulate(at - s)) / 2e-6 for s in steps]).T
    variance = 60 * result.loss / (60 - 5)
    expected = variance * np.linalg.inv(J.T @ J)[:3, :3]
    np.testing.assert_allclose(result.covariance, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose([result.std[q] for q in PHYSICAL], np.sqrt(np.diag(expected)), rtol=1e-4)
    alone = np.sqrt(variance / np.diag(J.T @ J)[:3])
    assert (np.sqrt(np.diag(expected)) > 1.02 * alone).all()  # the initial state does matter here


# ---- start values ----


@pytest.mark.parametrize("hold", [40, 100, 25])
def test_start_values_of_the_rotor_come_near_the_truth(hold):
    """A hold of 40 samples leaves the input without power at 125 Hz, between the two resonances."""
    u = piezo_motion(6000, hold=hold)
    rec = simulated(RotorBearing(), {**KEY, **GAINS}, u, h=TS, hold="foh", noise=3e-8)
    start = fit(RotorBearing(), rec, max_iterations=1).start
    for name in ("k_xx", "k_yy", "b_xx", "b_yy"):
        assert start[name] == pytest.approx(KEY[name], rel=0.02), name
    for name in ("d_xx", "d_xy", "d_yx", "d_yy"):
        assert start[name] == pytest.approx(KEY[name], abs=0.1 * abs(KEY["d_xx"])), name
    for name in ("tau_x", "tau_y"):
        assert start[name] == pytest.approx(KEY[name], abs=3e-5), name
    modes = evaluate(RotorBearing(), {**start, **GAINS}).modes()[:2]
    truth = evaluate(RotorBearing(), {**KEY, **GAINS}).modes()[:2]
    np.testing.assert_allclose([f for f, _ in modes], [f for f, _ in truth], atol=1.0)


def test_start_values_of_actuators_and_plant_come_near_the_truth():
    r = 4.5e-6 * levels(4000, 2, 40)
    plant = Plant()
    rec = simulated(plant, {**ACTUATORS, **KEY, **GAINS}, r, h=TS, noise=1e-8)
    for structure, fixed in ((PiezoPair(), {}), (plant, {}), (Plant(outputs="p"), ACTUATORS)):
        start = fit(structure, rec, fixed=fixed, max_iterations=1).start
        if "u" in structure.outputs:
            for name, value in ACTUATORS.items():
                assert start[name] == pytest.approx(value, rel=0.1), name
        if "p" in structure.outputs:
            for name in ("k_xx", "k_yy", "b_xx", "b_yy"):
                assert start[name] == pytest.approx(KEY[name], rel=0.05), name


# ---- what ends otherwise ----


def test_the_iteration_limit_is_a_status():
    result = fit(MODE, mode_data(), max_iterations=1, start={"w": 7.0})
    assert not result.success
    assert result.status.startswith("not converged: iteration limit reached; start nearer")
    assert result.iterations == 1
    assert np.isfinite(list(result.parameters.values())).all()
    assert np.isfinite(result.loss)


SCRIPT = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from fit_cases import MODE, MODE_AT, levels, simulated
from gbid.identify import fit

seen = []
def progress(p):
    seen.append(p.iteration)
    if p.iteration == 2:
        os.kill(os.getpid(), signal.SIGINT)

rec = simulated(MODE, MODE_AT, levels(2000), noise=0.3)
try:
    fit(MODE, rec, progress=progress, start={{"w": 7.0}})
except KeyboardInterrupt:
    print("stopped after", seen[-1], signal.getsignal(signal.SIGINT) is signal.default_int_handler)
    again, fresh = (fit(MODE, rec, start={{"w": 7.0}}) for _ in range(2))
    print("then right", again.success, again.parameters == fresh.parameters, round(again.parameters["w"], 1))
os.kill(os.getpid(), signal.SIGINT)
"""


IGNORE = "signal.signal(signal.SIGINT, signal.SIG_IGN)"


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT to itself")
def test_ctrl_c_ends_the_fit_at_the_next_iteration():
    script = SCRIPT.format(tests=str(SUPPORT))
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert run.stdout.splitlines() == ["stopped after 2 True", "then right True True 5.0"]
    # Outside the fit Ctrl-C is what it was: the second one ended the program.
    assert run.returncode in (-signal.SIGINT, 130)
    assert "KeyboardInterrupt" in run.stderr
    assert "nan" not in run.stderr.lower()


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT to itself")
def test_ctrl_c_that_is_ignored_does_not_end_the_fit():
    """As in a worker of a batch."""
    script = SCRIPT.format(tests=str(SUPPORT)).replace("seen = []", "seen = []\n" + IGNORE)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_fits_in_two_threads_are_those_in_turn():
    data = [mode_data(500), mode_data(800)]
    with ThreadPoolExecutor(2) as pool:
        computed = list(pool.map(partial(fit, MODE), 2 * data))
    assert [result.parameters for result in computed] == 2 * [fit(MODE, each).parameters for each in data]


FORKED = """
import os, sys, threading
sys.path.insert(0, {tests!r})
from fit_cases import MODE, MODE_AT, levels, simulated
from gbid.identify import fit
from gbid.core.arrays import one_solver

rec = simulated(MODE, MODE_AT, levels(500), noise=0.3)
here = fit(MODE, rec).parameters
held, done = threading.Event(), threading.Event()

def hold():
    with one_solver():
        held.set()
        done.wait(60)

threading.Thread(target=hold, daemon=True).start()
held.wait(60)
child = os.fork()
if child == 0:
    os._exit(0 if fit(MODE, rec).parameters == here else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
done.set()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="has no fork")
def test_a_fit_in_a_forked_child_is_that_of_its_parent():
    """Also where another thread of the parent is in the solver, whose lock the child would wait for."""
    script = [sys.executable, "-W", "ignore", "-c", FORKED.format(tests=str(SUPPORT))]
    run = subprocess.run(script, capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "0", run.stderr


def test_what_a_progress_function_raises_comes_out(capfd):
    class OwnError(Exception):
        pass

    def progress(now):
        if now.iteration == 1:
            raise OwnError("mine")

    with pytest.raises(OwnError, match="mine"):
        fit(MODE, mode_data(500), progress=progress)
    assert capfd.readouterr().err == ""


def test_the_working_directory_stays_clean(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fit(MODE, mode_data(500))
    assert os.listdir(tmp_path) == []  # noqa: PTH208


# ---- bad input ----


def with_column(rec, name, value):
    return rec.with_signals(**{name: np.full_like(rec.signal(name), value)})


GOOD = mode_data(300)
FASTER = Recording(GOOD.signals, 0.05, name="b")
WIDE = Recording({"u": levels(50, 2), "y": levels(50, 2, seed=1)}, H, name="two")
BAD_DATA = {
    "input of zero": (
        with_column(GOOD, "u", 0.0),
        {},
        r"no recording moves u: the data do not determine g; fix each \(fixed=...\), or add a recording",
    ),
    "constant output": (with_column(GOOD, "y", 2.0), {}, r"channel 'y' is 2 throughout; the output is constant"),
    "too few samples": (
        GOOD.slice(0, 7),
        {},
        r"have 7 measured values, and this fit has 5 parameters and 2 initial states and trends to estimate; fix some",
    ),
    "sample times": ([GOOD, FASTER], {}, r"'data' and 'b' have different sample times: 0.1 s and 0.05 s"),
    "missing signal": (Recording({"u": GOOD.signal("u")}, H, name="half"), {}, r"'half' has no signal 'y'; it has u"),
    "missing channel": (GOOD, {"inputs": "u.x"}, r"signal 'u' has no channel 'x'; it has 1"),
    "no recordings": ([], {}, r"no recordings; give"),
    "different channels": ([WIDE, GOOD], {}, r"'two' and 'data' have different channels"),
}


@pytest.mark.parametrize(("recordings", "options", "text"), BAD_DATA.values(), ids=BAD_DATA)
def test_bad_data_is_refused_in_one_line(recordings, options, text):
    with pytest.raises(DataError, match=text) as caught:
        fit(MODE, recordings, **options)
    assert "\n" not in str(caught.value)


WRONG_USE = {
    "bounds without start": ({"bounds": {"w": (7.0, 8.0)}}, r"'w': start = 6 lies outside its bounds \[7, 8\]"),
    "start outside bounds": ({"start": {"z": 2.0}}, r"parameter 'z': start = 2 lies outside"),
    "crossed bounds": ({"bounds": {"w": (8.0, 7.0)}}, "'w': lower = 8.0 must be below upper = 7.0"),
    "unknown start": ({"start": {"q": 1.0}}, "start names unknown parameters: q; choose from w, z, g, l1, l2"),
    "focus": ({"focus": "predict"}, "focus = 'predict'; choose 'prediction' or 'simulation'"),
    "intersample": ({"intersample": "linear"}, "intersample = 'linear'; give 'zoh', 'foh', a list"),
    "number of holds": ({"intersample": ("zoh", "foh")}, "intersample names 2 inputs; there are 1"),
    "window": ({"window": 1}, "window = 1; give a whole number of at least 2, 'auto' or None"),
    "nothing free": ({"fixed": MODE_AT}, "structure 'mode': no free parameter to estimate"),
    "start is no number": ({"start": {"w": float("nan")}}, r"start = \{'w': nan\}; give values by name"),
}


@pytest.mark.parametrize(("options", "text"), WRONG_USE.values(), ids=WRONG_USE)
def test_wrong_use_is_refused_in_one_line(options, text):
    with pytest.raises(UsageError, match=text) as caught:
        fit(MODE, GOOD, **options)
    assert "\n" not in str(caught.value)


def test_a_structure_of_ones_own_states_its_starts_or_has_long_recordings():
    """They come from the data, if the recording is long enough for that."""
    with pytest.raises(DataError, match=r"50 samples are too few for a black-box model.* or give start values"):
        fit(EVERY, Recording({"u": levels(50, 2), "y": levels(50, 2, seed=1)}, H))


def test_signals_of_the_wrong_width_are_refused():
    with pytest.raises(UsageError, match="structure 'every' has 2 inputs and 2 outputs; the recordings give 1"):
        fit(EVERY, GOOD, start=EVERY_AT)
    three = Recording({"u": levels(500, 2), "y": levels(500, 3, seed=1)}, H)
    with pytest.raises(UsageError, match="has 2 inputs and 2 outputs; the recordings give 2"):
        fit(EVERY, three, start=EVERY_AT, trend="offset")
    one = Recording({"u": levels(500, 1), "p": levels(500, 1, seed=1)}, TS)
    for structure in (RotorBearing(), PiezoPair(), Plant()):
        with pytest.raises(UsageError, match=r"has 2 inputs and . outputs; the recordings give 1 and 1"):
            fit(structure, one, inputs="u", outputs="p")
