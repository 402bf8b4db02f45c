"""Options of the fit: local parameters, offsets, priors, initial states, gaps, weights, starts."""

from dataclasses import replace

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

from gbid.core.errors import DataError, UsageError
from gbid.identify import fit
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, Plant, RotorBearing, evaluate

LAG = LinearStructure(
    "lag",
    [Parameter("a", 1.0, lower=0.01, upper=50.0), Parameter("b", 1.0), Parameter("k", 0.0)],
    lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1]], "K": [[p.k]]},
)
LAG_AT = {"a": 1.5, "b": 2.0, "k": 0.0}
PHYSICAL = ("w", "z", "g")


def lag_data(n=600, seed=1, noise=0.2, name="data", conditions=None, **values):
    rec = simulated(LAG, {**LAG_AT, **values}, levels(n, seed=seed), noise=noise, seed=seed, name=name)
    return replace(rec, conditions=conditions or {})


def mode_data(n=1200, seed=1, noise=0.3, **more):
    return simulated(MODE, MODE_AT, levels(n, seed=seed), noise=noise, seed=seed, **more)


def away(result, truth, names, std=None):
    """Estimates' distance from some values, in standard deviations."""
    std = std or result.std_with("white")
    return np.array([(result.parameters[name] - truth[name]) / std[name] for name in names])


# ---- parameters local to a recording or an operating point ----


def test_parameters_local_to_a_recording():
    gains = {"r0": 1.0, "r1": 2.0, "r2": -3.0}
    recs = [lag_data(seed=i, name=name, b=b) for i, (name, b) in enumerate(gains.items())]
    result = fit(LAG, recs, focus="simulation", local={"b": "recording"})
    assert result.success
    assert result.free == ("a", "b[r0]", "b[r1]", "b[r2]")
    assert "b" not in result.parameters
    truth = {"a": 1.5, **{f"b[{name}]": b for name, b in gains.items()}}
    assert np.abs(away(result, truth, truth)).max() < 4
    for name in gains:
        local_values = result.parameters_of(name)
        assert local_values == {"a": result.parameters["a"], "b": result.parameters[f"b[{name}]"], "k": 0.0}
        assert result.local_names[name] == {"b": f"b[{name}]"}
    with pytest.raises(KeyError, match="recording 'r9' was not fitted; choose from r0, r1, r2"):
        result.parameters_of("r9")
    np.testing.assert_allclose(result.model.B, [[result.parameters["b[r0]"]]])  # that of the first recording
    shared = fit(LAG, recs, focus="simulation")
    assert shared.loss > 10 * result.loss  # one gain cannot serve all three


def test_local_in_everything_is_as_many_fits():
    recs = [lag_data(n, seed=i, name=f"r{i}", a=1.0 + i, b=3.0 - i) for i, n in enumerate((500, 700))]
    together = fit(LAG, recs, focus="simulation", local={"a": "recording", "b": "recording"})
    for rec in recs:
        alone = fit(LAG, rec, focus="simulation")
        for name in ("a", "b"):
            full, std = f"{name}[{rec.name}]", alone.std_with("white")[name]
            assert abs(together.parameters[full] - alone.parameters[name]) < 1e-3 * std
            assert together.std_with("white")[full] == pytest.approx(std, rel=0.1)
    order = [together.free.index(f"{q}[r{i}]") for i in range(2) for q in "ab"]
    cross = together.covariance_white[np.ix_(order[:2], order[2:])]
    assert np.abs(cross).max() < 1e-9 * together.covariance_white.max()


def test_parameters_local_to_an_operating_point():
    points = [(5.0, 0.0), (5.0, 6000.0), (5.0, 0.0)]
    gains = {points[0]: 1.0, points[1]: 2.0}
    recs = [
        lag_data(seed=i, name=f"r{i}", b=gains[point], conditions={"pressure_bar": point[0], "speed_rpm": point[1]})
        for i, point in enumerate(points)
    ]
    result = fit(LAG, recs, focus="simulation", local={"b": "operating_point"})
    assert result.free == ("a", "b[5 bar, 0 rpm]", "b[5 bar, 6000 rpm]")
    truth = {"a": 1.5, "b[5 bar, 0 rpm]": 1.0, "b[5 bar, 6000 rpm]": 2.0}
    assert np.abs(away(result, truth, truth)).max() < 4
    assert result.parameters_of("r0") == result.parameters_of("r2") != result.parameters_of("r1")
    # Two recordings tell more about what they share than one about its own.
    std = result.std_with("white")
    assert std["b[5 bar, 0 rpm]"] < std["b[5 bar, 6000 rpm]"]


def test_one_recording_has_no_groups():
    result = fit(LAG, lag_data(), focus="simulation", local={"a": "recording"})
    assert result.free == ("a", "b")
    assert result.local_names == {}


LOCAL = {
    "unknown": ({"local": {"q": "recording"}}, UsageError, "local names parameters that are not estimated: q"),
    "fixed": (
        {"local": {"b": "recording"}, "fixed": {"b": 2.0}},
        UsageError,
        "local names parameters that are not estimated: b",
    ),
    "scope": ({"local": {"b": "day"}}, UsageError, "local.'b'. = 'day'; choose 'recording' or 'operating_point'"),
    "no point": (
        {"local": {"b": "operating_point"}},
        DataError,
        "recording 'r0' states no pressure_bar and speed_rpm, which parameters local to an operating point need",
    ),
}


@pytest.mark.parametrize(("options", "kind", "text"), LOCAL.values(), ids=LOCAL)
def test_wrong_local_parameters_are_refused(options, kind, text):
    with pytest.raises(kind, match=text):
        fit(LAG, [lag_data(name="r0"), lag_data(name="r1")], **options)


@pytest.mark.parametrize(
    "options", [{"local": {"b": "recording"}}, {"trend": "offset"}, {"left_out": {"data": [(5, 9)]}}]
)
def test_recordings_that_are_told_apart_by_name_must_have_their_own(options):
    with pytest.raises(UsageError, match="several recordings are named 'data'"):
        fit(LAG, [lag_data(seed=1), lag_data(seed=2)], **options)
    assert fit(LAG, [lag_data(seed=1), lag_data(seed=2)], focus="simulation").success


# ---- offsets ----


def test_offsets_of_each_recording():
    offsets = {"r0": 5.0, "r1": -2.0}
    recs = []
    for i, (name, offset) in enumerate(offsets.items()):
        rec = lag_data(seed=i, name=name)
        recs.append(rec.with_signals(y=rec.signal("y") + offset))
    result = fit(LAG, recs, focus="simulation", trend="offset")
    assert result.free == ("a", "b", "offset_y[r0]", "offset_y[r1]")
    truth = {**LAG_AT, **{f"offset_y[{name}]": value for name, value in offsets.items()}}
    assert np.abs(away(result, truth, result.free)).max() < 4
    assert result.parameters_of("r1")["offset_y"] == result.parameters["offset_y[r1]"]
    assert fit(LAG, recs, focus="simulation").loss > 10 * result.loss
    # What does not touch the dynamics does not move them either: a shift of the data is a shift of the offset.
    shifted = [rec.with_signals(y=rec.signal("y") + 100.0) for rec in recs]
    again = fit(LAG, shifted, focus="simulation", trend="offset")
    for name in result.free:
        shift = 100.0 * name.startswith("offset")
        assert again.parameters[name] == pytest.approx(result.parameters[name] + shift, abs=1e-3 * result.std[name])


# ---- priors ----


def test_a_prior_is_weighed_against_the_data():
    """Two sources that are equally sure meet half way, and together are sqrt(2) times as sure."""
    rec = lag_data(3000)
    free = fit(LAG, rec, focus="simulation")
    std = free.std_with("white")["b"]
    for said, sure in ((2.0, 1.0), (-3.0, 2.0)):  # in standard deviations of the data
        prior = {"b": (free.parameters["b"] + said * std, sure * std)}
        result = fit(LAG, rec, focus="simulation", prior=prior)
        assert result.success
        shifted = (result.parameters["b"] - free.parameters["b"]) / std
        assert shifted == pytest.approx(said / (1 + sure**2), rel=0.03)
        expected = std / np.sqrt(1 + sure**-2)
        assert result.std_with("white")["b"] == pytest.approx(expected, rel=0.02)
        assert result.std_with("white")["a"] < free.std_with("white")["a"]  # b no longer takes the blame


@pytest.mark.parametrize("criterion", ["trace", "det"])
def test_a_prior_weighs_as_much_beside_two_outputs(criterion):
    """Two sensors of one signal: their mean is the estimate, and a prior as sure as they are moves it half way."""
    one = lag_data(3000)
    both = {"y1": one.signal("y"), "y2": lag_data(3000, seed=2).signal("y")}
    both["y2"] = both["y2"] - simulated(LAG, LAG_AT, levels(3000, seed=2)).signal("y")  # its noise alone
    both["y2"] = both["y2"] + simulated(LAG, LAG_AT, one.signal("u")).signal("y")
    rec = replace(one, signals={"u": one.signal("u"), **both})
    double = LinearStructure(
        "double",
        LAG.parameters[:2],
        lambda p: {"A": [[-p.a]], "B": [[p.b]], "C": [[1], [1]]},
        outputs=("y1", "y2"),
    )
    options = {"focus": "simulation", "criterion": criterion}
    free = fit(double, rec, **options)
    std = free.std_with("white")["b"]
    result = fit(double, rec, prior={"b": (free.parameters["b"] + 2 * std, std)}, **options)
    assert (result.parameters["b"] - free.parameters["b"]) / std == pytest.approx(1.0, rel=0.05)
    assert result.std_with("white")["b"] == pytest.approx(std / np.sqrt(2), rel=0.03)


def test_a_prior_settles_what_the_data_leave_open():
    twice = LinearStructure(
        "twice",
        [Parameter("a", 1.0), Parameter("b", 1.0), Parameter("c", 1.5)],
        lambda p: {"A": [[-p.a]], "B": [[p.b * p.c]], "C": [[1]]},
    )
    rec = simulated(twice, {"a": 2.0, "b": 3.0, "c": 1.0}, levels(800), noise=0.1)
    result = fit(twice, rec, prior={"c": (1.0, 0.05)})
    assert result.success
    assert not [note for note in result.notes if "do not determine" in note]
    assert result.parameters["c"] == pytest.approx(1.0, abs=1e-3)  # the data have no word in it
    assert result.std_with("white")["c"] == pytest.approx(0.05, rel=0.01)
    # b = (b c) / c: uncertain in proportion.
    assert result.std_with("white")["b"] == pytest.approx(3.0 * 0.05, rel=0.1)


def test_a_prior_of_a_local_parameter_holds_for_all_groups_or_one():
    recs = [lag_data(300, seed=i, name=f"r{i}") for i in range(2)]
    local = {"b": "recording"}
    both = fit(LAG, recs, focus="simulation", local=local, prior={"b": (1.0, 1e-6)})
    assert [both.parameters[f"b[r{i}]"] for i in range(2)] == pytest.approx([1.0, 1.0], abs=1e-4)
    one = fit(LAG, recs, focus="simulation", local=local, prior={"b[r1]": (1.0, 1e-6)})
    assert one.parameters["b[r1]"] == pytest.approx(1.0, abs=1e-4)
    assert one.parameters["b[r0]"] > 1.5


# ---- initial states ----


def test_initial_states_zero_given_and_estimated():
    rec = mode_data(60, x0=[3.0, -4.0])
    estimated = fit(MODE, rec, focus="simulation")
    given = fit(MODE, rec, focus="simulation", initial_state=[3.0, -4.0])
    zero = fit(MODE, rec, focus="simulation", initial_state="zero")
    np.testing.assert_allclose(given.initial_states, [[3.0, -4.0]], rtol=1e-12)
    np.testing.assert_allclose(zero.initial_states, [[0.0, 0.0]], atol=1e-12)
    assert estimated.loss < given.loss < 1.3 * estimated.loss
    assert zero.loss > 2 * given.loss
    known, unknown = given.std_with("white"), estimated.std_with("white")
    assert all(known[name] < 1.001 * unknown[name] for name in PHYSICAL)
    assert any(known[name] < 0.98 * unknown[name] for name in PHYSICAL)  # not estimating it leaves more information
    assert np.abs(away(given, MODE_AT, PHYSICAL)).max() < 4
    assert [r.options.initial_state for r in (estimated, given, zero)] == ["estimated", (3.0, -4.0), "zero"]


# ---- samples left out ----

RUB = slice(400, 460)


def rubbed(rec, values, where=RUB):
    y = rec.signal("y").copy()
    y[where] = values
    return rec.with_signals(y=y)


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
@pytest.mark.parametrize("window", [None, 77])
def test_a_rub_that_is_left_out_does_no_harm(focus, window):
    if focus == "simulation":
        structure, truth, start, clean = MODE, MODE_AT, {}, mode_data()
        names = PHYSICAL
    else:
        structure, truth, start = EVERY, EVERY_AT, EVERY_AT
        clean, names = innovations(EVERY, EVERY_AT, levels(1500, 2, hold=3), noise=[0.2, 0.1]), tuple(EVERY_AT)
    wild = 40.0 * np.random.default_rng(3).normal(size=clean.signal("y")[RUB].shape)
    options = {"focus": focus, "window": window, "start": start}
    reference = fit(structure, clean, **options)
    gaps = {"data": [(RUB.start, RUB.stop)]}
    a = fit(structure, rubbed(clean, wild), left_out=gaps, **options)
    b = fit(structure, rubbed(clean, -7.0), left_out=gaps, **options)
    assert a.success, a.status
    std = reference.std_with("white")
    assert np.abs(away(a, reference.parameters, names, std)).max() < 1
    assert np.abs(away(a, truth, names)).max() < 4
    # What was measured there has no say at all, nor the start of what follows.
    assert np.abs(away(b, a.parameters, names, std)).max() < 2e-3
    np.testing.assert_allclose(b.fit_percent, a.fit_percent, rtol=1e-5)
    np.testing.assert_allclose(a.fit_percent, reference.fit_percent, atol=2)
    # Five per cent of the samples fewer, five per cent less information, but no more.
    for name in names:
        assert 0.97 < a.std_with("white")[name] / std[name] < 1.25, name
    kept = fit(structure, rubbed(clean, wild), **options)
    assert kept.loss > 5 * a.loss
    assert np.abs(away(kept, reference.parameters, names, std)).max() > 4


def test_several_stretches_left_out_and_whole_windows():
    rec = mode_data()
    gaps = [(0, 50), (200, 290), (291, 300), (1150, 1200)]
    y = rec.signal("y").copy()
    for start, stop in gaps:
        y[start:stop] = 99.0
    broken = rec.with_signals(y=y)
    results = [fit(MODE, broken, focus="simulation", left_out={"data": gaps}, window=w) for w in (None, 40, 300)]
    for result in results:
        assert result.success
        assert np.abs(away(result, MODE_AT, PHYSICAL)).max() < 4
        assert np.abs(away(result, results[0].parameters, PHYSICAL)).max() < 2e-3
    with_gain = [fit(MODE, broken, left_out={"data": gaps}, window=w) for w in (None, 40)]
    assert np.abs(away(with_gain[1], with_gain[0].parameters, MODE_AT)).max() < 5e-3
    assert np.abs(away(with_gain[0], MODE_AT, MODE_AT)).max() < 4


LEFT_OUT = {
    "stranger": ({"other": [(0, 5)]}, UsageError, "left_out names recordings that are not fitted: other"),
    "beyond": ({"data": [(290, 301)]}, DataError, "'data': samples 290 to 301 of left_out are not within its 300"),
    "backwards": ({"data": [(30, 20)]}, DataError, "samples 30 to 20 of left_out are not within"),
    "negative": ({"data": [(-5, 20)]}, DataError, "samples -5 to 20 of left_out are not within"),
    "all": ({"data": [(0, 150), (150, 300)]}, DataError, "'data': all samples are left out"),
}


@pytest.mark.parametrize(("left_out", "kind", "text"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_wrong_stretches_are_refused(left_out, kind, text):
    with pytest.raises(kind, match=text):
        fit(MODE, mode_data(300), left_out=left_out)


# ---- options that are refused ----


WRONG = {
    "weights": (
        {"output_weights": [1.0, 2.0]},
        r"output_weights = \[1.0, 2.0\]; give one positive number for each of y",
    ),
    "weight of zero": ({"output_weights": [0.0]}, "give a positive number for each output or None"),
    "weight of nan": ({"output_weights": [np.nan]}, "give a positive number for each output or None"),
    "prior of a stranger": ({"prior": {"q": (1.0, 1.0)}}, "prior names a parameter that is not estimated: q"),
    "prior of a fixed one": (
        {"prior": {"z": (0.1, 1.0)}, "fixed": {"z": 0.1}},
        "prior names a parameter that is not estimated: z",
    ),
    "prior without a spread": ({"prior": {"z": (0.1, 0.0)}}, r"prior of z = \(0.1, 0.0\); give a value and a positive"),
    "prior of nan": ({"prior": {"z": (np.nan, 1.0)}}, r"prior = \{'z': \(nan, 1.0\)\}; give a finite number"),
}


@pytest.mark.parametrize(("options", "text"), WRONG.values(), ids=WRONG)
def test_wrong_options_are_refused_in_one_line(options, text):
    with pytest.raises(UsageError, match=text) as caught:
        fit(MODE, mode_data(300), **options)
    assert "\n" not in str(caught.value)


# ---- criteria and weights ----


def two_outputs(spread, n=1500, seed=5):
    """EVERY's outputs with noise of a given (2, 2) root of its covariance."""
    u = levels(n, 2, hold=3)
    e = np.random.default_rng(seed).normal(size=u.shape) @ np.transpose(spread)
    return Recording({"u": u, "y": evaluate(EVERY, EVERY_AT).simulate(u, H) + e}, H, name="data")


def simulation_errors(rec, values, x0):
    model = evaluate(EVERY, {**values, "k": 0.0})
    return rec.signal("y") - model.simulate(rec.signal("u"), H, initial_state=x0)


def cost_slopes(result, rec, cost):
    """Derivatives of some cost of the errors by the parameters, in standard deviations."""
    slopes = []
    for name in result.free:
        step = 1e-2 * result.std_with("white")[name]
        ends = [
            cost(
                simulation_errors(
                    rec, {**result.parameters, name: result.parameters[name] + s}, result.initial_states[0]
                )
            )
            for s in (step, -step)
        ]
        slopes.append((ends[0] - ends[1]) / (2 * step) * result.std_with("white")[name])
    return np.abs(slopes)


def test_the_determinant_is_maximum_likelihood_for_correlated_noise():
    """At the estimate the log-likelihood of normal errors of unknown covariance is stationary; at the trace's not."""
    rec = two_outputs(0.5 * np.array([[1.0, 0.0], [0.95, 0.2]]))
    trace, det = (fit(EVERY, rec, start=EVERY_AT, focus="simulation", criterion=c) for c in ("trace", "det"))

    def likelihood(e):
        return 0.5 * len(e) * np.linalg.slogdet(e.T @ e / len(e))[1]

    def squares(e):
        return 0.5 * len(e) * np.log(np.sum(e**2)) * 2

    assert cost_slopes(det, rec, likelihood).max() < 0.01
    assert cost_slopes(trace, rec, likelihood).max() > 0.3
    assert cost_slopes(trace, rec, squares).max() < 0.01
    correlation = det.error_covariance[0, 1] / np.sqrt(np.prod(np.diag(det.error_covariance)))
    assert correlation == pytest.approx(0.95 / np.hypot(0.95, 0.2), abs=0.02)
    assert np.sum(list(det.std_with("white").values())[:5]) < 0.8 * np.sum(list(trace.std_with("white").values())[:5])
    for result in (det, trace):
        assert np.abs(away(result, EVERY_AT, "awbcd")).max() < 4


def test_output_weights_are_a_change_of_the_outputs_units():
    rec = two_outputs(np.diag([0.5, 0.05]))
    weights = np.array([4.0, 0.25])
    weighted = fit(EVERY, rec, start=EVERY_AT, focus="simulation", output_weights=weights)
    root = np.sqrt(weights)

    def scaled(p):
        given = EVERY.matrices(p)
        for letter in "CD":
            given[letter] = [[r * entry for entry in row] for r, row in zip(root, given[letter], strict=True)]
        return given

    same = fit(
        LinearStructure("scaled", EVERY.parameters, scaled, "u", "y"),
        rec.with_signals(y=rec.signal("y") * root),
        start=EVERY_AT,
        focus="simulation",
        criterion="trace",
    )
    names = "awbcd"
    std = weighted.std_with("white")
    assert np.abs(away(same, weighted.parameters, names, std)).max() < 1e-3
    for name in names:
        assert same.std_with("white")[name] == pytest.approx(std[name], rel=1e-3)
    assert weighted.loss == pytest.approx(np.trace(weighted.error_covariance))  # reported without the weights
    only_ratios = fit(EVERY, rec, start=EVERY_AT, focus="simulation", output_weights=7.0 * weights)
    assert np.abs(away(only_ratios, weighted.parameters, names, std)).max() < 1e-3


# ---- windows, starts, gains ----


def test_the_windows_that_were_tried_are_told():
    rec = mode_data(2000)
    result = fit(MODE, rec, focus="simulation", start={"w": 9.0}, max_iterations=1)
    assert not result.success
    (note,) = [note for note in result.notes if "did not converge; this is the result" in note]
    usual, shorter, longer = 125, 62, 500
    tried = {str(w) for w in (usual, shorter, longer)}
    others = set(note.removeprefix("windows of ").split(" samples")[0].split(", "))
    assert others | {str(result.options.window)} == tried
    assert note.endswith(f"the result with {result.options.window} [GB113]")
    losses = {}
    for w in (usual, shorter, longer):
        alone = fit(MODE, rec, focus="simulation", start={"w": 9.0}, max_iterations=1, window=w)
        losses[w] = alone.loss
        assert not [note for note in alone.notes if "windows of" in note]  # asked for, so nothing else was tried
    assert result.loss == min(losses.values())
    assert losses[result.options.window] == result.loss
    assert not [note for note in fit(MODE, rec, focus="simulation").notes if "windows of" in note]


def test_where_starts_come_from_is_told():
    result = fit(MODE, mode_data(300), start={"w": 5.5}, fixed={"l1": 0.0})
    assert result.start_origin == {"w": "user", "z": "structure", "g": "structure", "l1": "user", "l2": "structure"}
    assert result.start["w"] == 5.5
    bearing = RotorBearing(disturbance_gain="none")
    rec = simulated(bearing, KEY, piezo_motion(1500), h=TS, hold="foh", noise=3e-8)
    result = fit(bearing, rec, start={"tau_x": 3e-4})
    assert result.start_origin == {name: "user" if name == "tau_x" else "data" for name in KEY}
    assert result.start["tau_x"] == 3e-4


def test_starts_of_local_parameters_have_an_origin_too():
    recs = [lag_data(300, seed=i, name=f"r{i}") for i in range(2)]
    result = fit(LAG, recs, focus="simulation", local={"b": "recording"}, start={"b": 1.7}, trend="offset")
    assert [result.start[f"b[r{i}]"] for i in range(2)] == [1.7, 1.7]
    assert [result.start_origin[f"b[r{i}]"] for i in range(2)] == ["user", "user"]
    # The offset starts where the model at its start leaves it.
    model = evaluate(LAG, {"a": 1.0, "b": 1.7, "k": 0.0})
    left = recs[0].signal("y") - model.simulate(recs[0].signal("u"), H)
    assert result.start["offset_y[r0]"] == pytest.approx(float(np.median(left)), rel=1e-9)


@pytest.mark.parametrize("gain", [0.0, 2.0])
def test_a_disturbance_gain_that_is_held(gain):
    rec = innovations(LAG, {**LAG_AT, "k": 3.0}, levels(800), noise=[0.3])
    result = fit(LAG, rec, fixed={"k": gain})
    assert result.parameters["k"] == gain
    assert result.free == ("a", "b")
    u, y = rec.signal("u"), rec.signal("y")
    model = evaluate(LAG, {**result.parameters, "k": gain})
    error = y - model.predict(u, y, H, initial_state=result.initial_states[0])
    assert result.loss == pytest.approx(float(np.mean(error**2)), rel=1e-9)
    free = fit(LAG, rec)
    assert free.loss < result.loss
    if gain == 0:  # no gain is the model's own run
        simulation = fit(LAG, rec, focus="simulation")
        assert np.abs(away(simulation, result.parameters, "ab")).max() < 1e-3
        assert simulation.loss == pytest.approx(result.loss, rel=1e-8)


# ---- what the data do not determine ----


def test_the_plant_without_its_actuators_is_refused_or_named():
    """From r to p the actuators' gain and the input gain enter as a product alone."""
    plant = Plant(RotorBearing(disturbance_gain="none"))
    rec = simulated(plant, {**ACTUATORS, **KEY}, 4.5e-6 * levels(2500, 2, 40), h=TS, noise=1e-9)
    alone = Plant(plant.bearing, outputs="p")
    with pytest.raises(UsageError, match="does not determine the actuators: fix p1_x"):
        fit(alone, rec)
    result = fit(alone, rec, start=ACTUATORS, window=156)
    undetermined = [name for name in result.free if np.isnan(result.std[name])]
    assert {"kappa_x", "kappa_y", "b_xx", "b_xy", "b_yx", "b_yy"} <= set(undetermined)
    said = " ".join(note for note in result.notes if "do not determine" in note)
    assert all(name in said for name in ("kappa_x", "kappa_y", "b_xx", "b_yy"))
    assert "k_xx" not in said
    assert np.isfinite(result.std["k_xx"])
    held = fit(alone, rec, fixed={"kappa_x": ACTUATORS["kappa_x"], "kappa_y": ACTUATORS["kappa_y"]}, start=ACTUATORS)
    assert np.isfinite([held.std[name] for name in held.free]).all()
    assert not [note for note in held.notes if "do not determine" in note]


def test_a_single_parameter_that_is_not_seen_is_named():
    idle = LinearStructure(
        "idle",
        [Parameter("a", 1.0), Parameter("b", 1.0), Parameter("c", 0.7)],
        lambda p: {"A": [[-p.a, 0], [0, -p.c]], "B": [[p.b], [0]], "C": [[1, 0]]},
    )
    rec = simulated(idle, {"a": 2.0, "b": 3.0, "c": 1.0}, levels(500), noise=0.1)
    result = fit(idle, rec)
    assert np.isnan(result.std["c"])
    assert any("do not determine c: its input or state is not excited" in note for note in result.notes)
    assert np.abs(away(result, {"a": 2.0, "b": 3.0}, "ab")).max() < 4
