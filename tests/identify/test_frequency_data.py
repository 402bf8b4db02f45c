"""Frequency responses as data of a fit, from an independent generator: numpy and scipy."""

import json
import time

import numpy as np
import pytest
from scipy import optimize, signal

import gbid
from gbid import FrequencyData, LinearStructure, Parameter
from gbid.core.errors import DataError, UsageError
from tests.benchmarks.response_intervals import measure
from tests.benchmarks.running import DOCS

TRUTH = {"k": (200 * np.pi) ** 2, "d": 0.04 * 200 * np.pi, "g": 100.0, "tau": 3e-4}
FREQUENCIES = np.linspace(5, 300, 120)
h = 2e-4


def matrices(p):
    zero = [[0], [0]]
    delayed = {"B_delayed": [[0], [p.g]], "delay": [[p.tau]]}
    return {"A": [[0, 1], [-p.k, -p.d]], "B": zero, "C": [[1, 0]], **delayed}


STARTS = (3e5, 30.0, 50.0, 1e-4)
OSCILLATOR = LinearStructure(
    "oscillator",
    [Parameter(name, start, lower=0.0) for name, start in zip(TRUTH, STARTS, strict=True)],
    matrices,
)


def response(f=FREQUENCIES, **changed):
    q, s = TRUTH | changed, 2j * np.pi * f
    return q["g"] * np.exp(-s * q["tau"]) / (s**2 + q["d"] * s + q["k"])


def measured(seed, f=FREQUENCIES, part=0.03, stated=1.0):
    rng, exact = np.random.default_rng(seed), response(f)
    std = part * np.abs(exact).mean()
    noise = rng.standard_normal((2, len(f))) * std
    return FrequencyData(f, exact + noise[0] + 1j * noise[1], std=stated * std)


def off(result):
    return np.array([(result.parameters[name] - TRUTH[name]) / result.std[name] for name in TRUTH])


def driven(u, seed, noise=1e-5):
    """Outputs of the oscillator to held inputs whose delay is one and a half samples."""
    A, B = np.array([[0, 1], [-TRUTH["k"], -TRUTH["d"]]]), np.array([[0], [TRUTH["g"]]])
    half = signal.cont2discrete((A, B, np.eye(1, 2), np.zeros((1, 1))), h / 2)
    delayed = np.concatenate([np.zeros(3), np.repeat(u, 2)[:-3]])
    y = signal.dlsim((*half[:4], h / 2), delayed)[1][::2, 0]
    return gbid.Recording({"u": u, "y": y + noise * np.random.default_rng(seed).standard_normal(len(u))}, h)


def test_estimates_and_intervals_hold_over_seeds():
    deviations = np.array([off(gbid.fit(OSCILLATOR, measured(seed))) for seed in range(20)])
    # 80 intervals of 95 %: 69 or more contain the truth with a probability of 99.8 % (binomial).
    assert (np.abs(deviations) < 1.96).sum() >= 69
    assert 0.8 < np.sqrt((deviations**2).mean()) < 1.2


def test_the_stored_study_has_honest_intervals_and_can_be_made_again():
    stored = json.loads((DOCS / "response-intervals.json").read_text(encoding="utf-8"))
    assert stored["seeds"] >= 100
    for row in stored["rows"]:
        assert 0.92 < row["coverage"] < 0.98
        assert row["failed"] == 0
    assert stored["rows"][1]["near"] > 0.95  # the multisine
    assert [row["case"] for row in measure(1)["rows"]] == [row["case"] for row in stored["rows"]]


def test_a_response_without_a_deviation_counts_as_not_measured():
    """A coherence of exactly one gives the deviation 0: such a line would decide the fit alone."""
    data, wild = measured(0), 7
    response, std = data.response[:, 0, 0].copy(), data.std[:, 0, 0].copy()
    response[wild], std[wild] = 1e6 * response[wild], 0.0
    others = np.arange(len(FREQUENCIES)) != wild
    with_it = gbid.fit(OSCILLATOR, FrequencyData(FREQUENCIES, response, std=std))
    without = gbid.fit(OSCILLATOR, FrequencyData(FREQUENCIES[others], response[others], std=std[others]))
    for name in TRUTH:
        assert with_it.parameters[name] == pytest.approx(without.parameters[name], rel=1e-6)
        assert with_it.std[name] == pytest.approx(without.std[name], rel=1e-6)


def test_the_time_of_a_fit_is_that_of_a_clock():
    together = [measured(0), driven(np.random.default_rng(0).standard_normal(300), 0)]
    for data in (measured(0), together):
        began = time.perf_counter()
        result = gbid.fit(OSCILLATOR, data)
        assert 0 < result.wall_time_s < time.perf_counter() - began


def test_start_values_come_from_the_responses():
    blind = LinearStructure("oscillator", [Parameter(n, 1e-4 if n == "tau" else None) for n in TRUTH], matrices)
    result = gbid.fit(blind, measured(1))
    assert result.success
    assert np.abs(off(result)).max() < 4
    assert result.start_origin["k"] == "data"


def test_together_with_a_recording_the_estimates_are_better_and_honest():
    joint = []
    for seed in range(4):
        u = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 200), 10)
        recording, data = driven(u, seed), measured(seed, part=0.01)
        both = gbid.fit(OSCILLATOR, [recording, data], focus="simulation")
        alone = [gbid.fit(OSCILLATOR, each, focus="simulation").std for each in (recording, data)]
        information = sum(1 / std["k"] ** 2 for std in alone)  # k is hardly correlated with the others
        assert both.std["k"] == pytest.approx(information**-0.5, rel=0.1)
        joint.append(off(both))
    assert 0.5 < np.sqrt(np.square(joint).mean()) < 1.6  # 16 deviations: 0.5 to 1.55 with 99.8 % (chi-square)


def test_a_multisine_gives_what_the_fit_in_time_gives():
    n, rng = 2500, np.random.default_rng(3)
    lines, phases = np.arange(5, 400), rng.uniform(0, 2 * np.pi, 395)
    period = np.cos(2 * np.pi * np.outer(np.arange(n), lines) / n + phases).sum(axis=1)
    recording = driven(np.tile(period, 9), 3, noise=1e-4)
    data = gbid.measured_response(recording, "u", "y", period_s=n * h)
    np.testing.assert_allclose(data.frequency_hz, lines / (n * h))
    in_time, result = gbid.fit(OSCILLATOR, recording, focus="simulation"), gbid.fit(OSCILLATOR, data)
    assert result.trusted == "white"
    assert all(abs(result.parameters[q] - in_time.parameters[q]) < in_time.std[q] for q in TRUTH)
    assert np.abs(off(result)).max() < 4


def test_inputs_with_lines_of_their_own_share_a_recording():
    n, rng = 2000, np.random.default_rng(0)
    lines = np.arange(4, 200)
    t = np.arange(n)
    periods = [np.cos(2 * np.pi * np.outer(t, lines[j::2]) / n + lines[j::2] ** 2).sum(axis=1) for j in range(2)]
    u = np.tile(np.array(periods).T, (5, 1))
    y = u @ [[1.0, -3.0], [0.5, 2.0]]
    recording = gbid.Recording({"u": u, "y": y + 1e-3 * rng.standard_normal(y.shape)}, h, channels={"u": ("x", "y")})
    data = gbid.measured_response(recording, "u", "y", period_s=n * h, intersample=None)
    for j in range(2):
        np.testing.assert_allclose(
            data.response[j::2, :, j], [[1.0, -3.0], [0.5, 2.0]][j] * np.ones((98, 1)), atol=1e-3
        )
        assert np.isnan(data.response[j::2, :, 1 - j]).all()
    together = np.tile((periods[0] + periods[1])[:, None], (5, 2))
    same = gbid.Recording({"u": together, "y": together}, h, channels={"u": ("x", "y")})
    with pytest.raises(DataError, match="as many recordings"):
        gbid.measured_response(same, "u", "y", period_s=n * h)


@pytest.mark.parametrize("recordings", [1, 3])
def test_the_coherence_of_periods_is_the_share_of_the_output_that_is_no_noise(recordings):
    n, periods, std, rng = 400, 10, 5.0, np.random.default_rng(0)
    lines, data = np.arange(10, 190), []
    for k in range(recordings):
        phases = rng.uniform(0, 2 * np.pi, len(lines))
        u = np.tile(np.cos(2 * np.pi * np.outer(np.arange(n), lines) / n + phases).sum(axis=1), periods)
        data.append(gbid.Recording({"u": u, "y": u + std * rng.standard_normal(len(u))}, h, name=f"r{k}"))
    response = gbid.measured_response(data, "u", "y", period_s=n * h, intersample=None)
    noise = n * std**2 / periods / ((n / 2) ** 2 + n * std**2 / periods)  # of the mean over the periods, at each line
    assert (1 - response.coherence).mean() == pytest.approx(noise, rel=0.15)


def test_channels_are_taken_in_the_order_of_the_structure():
    values = np.arange(2 * 3 * 2).reshape(2, 3, 2)
    data = FrequencyData([1, 2], values, std=1.0, inputs=["u_x", "u_y"], outputs=["p_x", "p_y", "q"])
    for inputs, outputs, columns, rows in (("u", ["q", "p"], [0, 1], [2, 0, 1]), ("u.y", "p_y", [1], [1])):
        chosen = data.channels(inputs, outputs)
        np.testing.assert_array_equal(chosen.response, values[:, rows][:, :, columns])
        assert chosen.output_names == tuple(["p_x", "p_y", "q"][i] for i in rows)
    with pytest.raises(DataError, match="no channel 'v'; it has u_x, u_y"):
        data.channels("v", "p")


def levitated(seed, n=2500, periods=6):
    """Recording of an unstable magnetic bearing under a sampled PD controller, excited by a multisine."""
    stiffness, gain, mass = 2e5, 80.0, 2.0
    A, B = np.array([[0, 1], [stiffness / mass, 0]]), np.array([[0], [gain / mass]])
    F, G, *_ = signal.cont2discrete((A, B, np.eye(1, 2), np.zeros((1, 1))), h)
    rng = np.random.default_rng(seed)
    lines = np.arange(5, 600, 3)
    wave = np.cos(2 * np.pi * np.outer(np.arange(n), lines) / n + rng.uniform(0, 2 * np.pi, len(lines)))
    r, x, last = np.tile(0.1 * wave.sum(axis=1), periods), np.zeros(2), 0.0
    u, y = np.zeros(len(r)), np.zeros(len(r))
    for k, noise in enumerate(2e-7 * rng.standard_normal(len(r))):
        y[k] = x[0] + noise
        u[k] = r[k] - 6000 * y[k] - 12 * (y[k] - last) / h
        last, x = y[k], F @ x + G[:, 0] * u[k]
    return gbid.Recording({"r": r, "u": u, "p": y}, h), {"k_s": stiffness, "k_i": gain}


def test_a_magnetic_bearing_in_its_loop_gives_its_stiffness_and_gain():
    def plant(p):
        return {"A": [[0, 1], [p.k_s / 2.0, 0]], "B": [[0], [p.k_i / 2.0]], "C": [[1, 0]]}

    structure = LinearStructure("magnetic bearing", [Parameter("k_s", 1e5), Parameter("k_i", 50.0)], plant, "u", "p")
    recording, truth = levitated(0)
    result = gbid.fit(structure, gbid.measured_response(recording, "u", "p", period_s=0.5))
    assert result.success
    for name, value in truth.items():
        assert abs(result.parameters[name] - value) < 4 * result.std[name]
        assert result.std[name] < 1e-3 * value


def test_the_responses_of_a_loop_give_what_signals_of_the_loop_give():
    recording, _ = levitated(0)
    direct = gbid.measured_response(recording, "u", "p", period_s=0.5)
    loop = gbid.measured_response(recording, "r", ["u", "p"], period_s=0.5, intersample=None)
    plant = loop.channels("u", "p", reference="r")
    held = np.isin(direct.frequency_hz, plant.frequency_hz)
    quotient = gbid.measured_response(recording, "u", "p", period_s=0.5, intersample=None)
    np.testing.assert_allclose(plant.response, quotient.response[held], rtol=1e-9)
    assert plant.channels("u", "p").of_loop


def test_a_sampled_loop_is_no_structure_of_responses():
    law = gbid.LinearModel(*(np.array([[q]]) for q in (0.0, 1.0, 2.0, -3.0)), dt=h)
    loop = gbid.ClosedLoop(OSCILLATOR, law, inputs="r", outputs="y", pade_order=1)
    with pytest.raises(UsageError, match="is a sampled loop; fit its plant"):
        gbid.fit(loop, measured(0))


def test_stated_deviations_that_are_too_small_are_told_and_not_believed():
    result = gbid.fit(OSCILLATOR, measured(5, stated=0.3))
    assert result.trusted == "robust"
    assert any("GB106" in note for note in result.notes)
    honest = gbid.fit(OSCILLATOR, measured(5))
    assert result.std["k"] == pytest.approx(honest.std["k"], rel=0.4)


def test_what_the_structure_leaves_out_is_told_from_noise():
    def without(p):
        return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.g]], "C": [[1, 0]]}

    prompt = LinearStructure("prompt", OSCILLATOR.parameters[:3], without)
    result = gbid.fit(prompt, measured(2))
    assert result.trusted == "none"
    assert any("GB123" in note for note in result.notes)


def test_neighbours_that_a_window_correlates_count_as_fewer():
    data = measured(4)
    window = FrequencyData(data.frequency_hz, data.response, data.std, correlation=(4 / 9, 1 / 36))
    plain, fewer = gbid.fit(OSCILLATOR, data), gbid.fit(OSCILLATOR, window)
    assert fewer.std["k"] == pytest.approx(plain.std["k"] * (1 + 2 * (4 / 9 + 1 / 36)) ** 0.5, rel=1e-6)


def test_a_reference_gives_the_deviation_that_repeated_loops_have():
    responses = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        r, noise = rng.standard_normal((2, 4000))
        u, y = np.zeros(4000), np.zeros(4000)
        for k in range(1, 4000):
            y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1] + 0.3 * (noise[k] - 0.9 * noise[k - 1])
            u[k] = r[k] - 2.0 * y[k]
        recording = gbid.Recording({"r": r, "u": u, "y": y}, h)
        responses.append(gbid.measured_response(recording, "u", "y", reference="r", intersample=None, resolution_hz=50))
    scatter = np.array([each.response.real for each in responses]).std(axis=0, ddof=1)
    stated = np.mean([each.std for each in responses], axis=0)
    assert np.sqrt((scatter**2).mean() / (stated**2).mean()) == pytest.approx(1, abs=0.15)


def test_progress_is_called_at_every_step_and_may_end_the_fit():
    seen = []
    result = gbid.fit(OSCILLATOR, measured(1), progress=seen.append)
    assert [each.iteration for each in seen] == list(range(len(seen)))
    assert 3 < len(seen) == result.iterations + 1
    assert seen[-1].cost < seen[0].cost
    assert seen[-1].sigma < 0.01

    def stop(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gbid.fit(OSCILLATOR, measured(1), progress=stop)


def test_prior_and_bound_and_fixed_values_hold():
    data = measured(6)
    known = gbid.fit(OSCILLATOR, data, prior={"k": (TRUTH["k"], 1.0)}, fixed={"tau": 3e-4})
    assert known.std["k"] < 1.0
    assert known.std["tau"] == 0.0
    bounded = gbid.fit(OSCILLATOR, data, bounds={"d": (0.0, 20.0)}, start={"d": 10.0})
    assert bounded.parameters["d"] == pytest.approx(20.0)
    assert np.isnan(bounded.std["d"])
    assert any("GB101" in note for note in bounded.notes)


def test_a_file_gives_back_what_was_saved(tmp_path):
    data = measured(7)
    gbid.export.save_csv(data, tmp_path / "frf.csv")
    again = FrequencyData.read(tmp_path / "frf.csv")
    np.testing.assert_allclose(again.response, data.response, rtol=1e-6)
    np.testing.assert_allclose(again.std, data.std, rtol=1e-6)
    coherence = "frequency_hz,real,imaginary,coherence\n10,1,0,0.5\n20,0.5,-0.5,0.9\n"
    (tmp_path / "c.csv").write_text(coherence)
    shaker = FrequencyData.read(tmp_path / "c.csv", averages=10)
    assert shaker.std[0, 0, 0] == pytest.approx(np.sqrt(0.5 / (2 * 0.5 * 10)))


@pytest.mark.parametrize(
    "text",
    [
        "Frequency response\nRun;3\nFrequency [Hz];Magnitude [dB];Phase [°];Coherence\n"
        "10,0;20,0;-90,0;0,5\n20,0;0,0;180,0;0,9\n",
        "Frequency (Hz)\tReal (m/N)\tImaginary (m/N)\tCoherence\n10.0\t0.0\t-10.0\t0.5\n20.0\t-1.0\t0.0\t0.9\n",
    ],
)
def test_files_of_analysers_are_read(tmp_path, text):
    (tmp_path / "a.txt").write_bytes(text.encode("cp1252"))
    data = FrequencyData.read(tmp_path / "a.txt", averages=10)
    np.testing.assert_allclose(data.frequency_hz, [10, 20])
    np.testing.assert_allclose(data.response[:, 0, 0], [-10j, -1], atol=1e-12)
    assert data.std[0, 0, 0] == pytest.approx(10 * np.sqrt(0.5 / 10))
    (tmp_path / "a.txt").write_text("Frequency (Hz),Level\n1,2\n")
    with pytest.raises(DataError, match=r"a\.txt: needs the columns frequency_hz.*; it has frequency_hz, level"):
        FrequencyData.read(tmp_path / "a.txt")


def test_python_control_gives_the_response_of_its_object():
    control = pytest.importorskip("control", reason="control is not installed: pip install 'gbid[control]'")
    plant = control.tf([TRUTH["g"]], [1, TRUTH["d"], TRUTH["k"]], inputs="force", outputs="gap")
    omega = 2 * np.pi * FREQUENCIES[::-1]  # in falling order
    values = np.stack([plant(1j * omega), 2 * plant(1j * omega)])[:, None]
    frd = control.frd(values, omega, inputs="force", outputs=["gap", "twice"], name="rig")
    exact = response(tau=0.0)
    std = np.linspace(1, 2, 2 * len(omega)).reshape(2, 1, -1)
    data = FrequencyData.from_control(frd, np.moveaxis(std, -1, 0))
    assert (data.name, data.input_names, data.output_names) == ("rig", ("force",), ("gap", "twice"))
    np.testing.assert_allclose(data.frequency_hz, FREQUENCIES)
    np.testing.assert_allclose(data.response[:, :, 0], np.column_stack([exact, 2 * exact]))
    np.testing.assert_allclose(data.std, np.moveaxis(std, -1, 0)[::-1])
    result = gbid.fit(OSCILLATOR, FrequencyData.from_control(frd, 1e-5).channels("force", ["gap"]), fixed={"tau": 0.0})
    assert result.parameters["k"] == pytest.approx(TRUTH["k"], rel=1e-6)
    with pytest.raises(UsageError, match="a TransferFunction is no frequency response of python-control"):
        FrequencyData.from_control(plant, 1.0)


def test_a_profile_is_that_of_a_search_on_a_grid():
    """Few lines near the resonance, so that the likelihood is no parabola; scipy searches without slopes."""
    f = np.linspace(94, 106, 9)
    data = measured(3, f=f, part=0.4)
    result = gbid.fit(OSCILLATOR, data, fixed={"tau": TRUTH["tau"]}, profile=["d"])
    profile = result.profiles["d"]

    def cost(x, d):
        model = response(f, k=x[0] * TRUTH["k"], d=d, g=x[1] * TRUTH["g"])
        return (np.abs((model - data.response[:, 0, 0]) / data.std[:, 0, 0]) ** 2).sum()

    def least(d):
        search = optimize.minimize(
            cost, [1, 1], (d,), "Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-9, "maxiter": 4000}
        )
        return search.fun

    at_minimum = optimize.minimize_scalar(least, bounds=(1.0, 60.0), method="bounded", options={"xatol": 1e-4})
    ends = [
        optimize.brentq(lambda d: least(d) - at_minimum.fun - 3.8415, *bracket, xtol=1e-3)
        for bracket in ((1.0, at_minimum.x), (at_minimum.x, 200.0))
    ]
    np.testing.assert_allclose(profile.interval, ends, rtol=0.01)
    low, high = abs(profile.interval - np.array(result.parameters["d"]))
    assert high > 1.1 * low  # no parabola
    assert gbid.profile(result, ["d"], structure=OSCILLATOR, recordings=data)["d"].interval == pytest.approx(
        profile.interval, rel=1e-3
    )


def test_a_parameter_on_its_bound_has_a_profile_on_one_side():
    result = gbid.fit(OSCILLATOR, measured(1), bounds={"tau": (0.0, 2.9e-4)}, profile="all")
    assert np.isnan(result.std["tau"])
    profile = result.profiles["tau"]
    assert (profile.verdict, profile.interval[1]) == ("one-sided", 2.9e-4)
    assert profile.interval[0] < 2.9e-4


def test_a_fit_to_responses_is_drawn_and_validated_on_a_recording():
    result = gbid.fit(OSCILLATOR, measured(1))
    curve = result.bode()
    assert curve.frequency_hz.min() < 100 < curve.frequency_hz.max()
    validated = gbid.cross_validate(result, driven(np.random.default_rng(5).standard_normal(400), 5))
    assert validated.fit_percent[0] > 90


def test_a_result_is_stored(tmp_path):
    result = gbid.fit(OSCILLATOR, measured(8))
    gbid.save(result, tmp_path / "fit.h5")
    assert gbid.load(tmp_path / "fit.h5").parameters == result.parameters


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: FrequencyData([1, 2], [1, 2]), "give std, or coherence"),
        (lambda: FrequencyData([2, 1], [1, 2], std=1), "ascend"),
        (lambda: FrequencyData([1, 2], [1, 2, 3], std=1), "responses"),
        (lambda: FrequencyData([1, 2], [1, 2], coherence=0.9), "averages"),
        (lambda: FrequencyData([1, 2], [1, 2], coherence=1.9, averages=3), "between 0 and 1"),
        (lambda: FrequencyData([1, 2], [1, 2], std=-1), "positive"),
        (lambda: gbid.fit(OSCILLATOR, measured(0), trend="offset"), "trend has no meaning"),
        (lambda: gbid.fit(gbid.scheduled(OSCILLATOR, "speed_rpm"), measured(0)), "linear structures"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(UsageError, match=words):
        make()


def test_a_table_without_rows_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("frequency_hz,magnitude,phase_deg,std\n")
    with pytest.raises(DataError, match="but no rows"):
        gbid.FrequencyData.read(tmp_path / "a.csv")
