"""Profile likelihood against brute force on data of scipy: constrained fits by least squares, and a root search."""

import pickle
import time

import numpy as np
import pytest
from experiment_files import gbid as run_gbid
from experiment_files import write_spring
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq, least_squares
from scipy.signal import dlsim, lfilter
from scipy.stats import chi2
from start_problems import MAGLEV, start_problem

import gbid
from gbid.core.errors import UsageError
from gbid.identify.problem.nlp import Shooting
from gbid.identify.uncertainty.profiles import Side, _end
from gbid.structure import LinearStructure, NonlinearStructure, Parameter

DT, W = 0.005, 20 * np.pi
OSCILLATOR = LinearStructure(
    "oscillator",
    [Parameter("w", W), Parameter("d", 6.0, lower=0.0), Parameter("b", W**2)],
    lambda p: {"A": [[0, 1], [-p.w * p.w, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]},
    inputs="u",
    outputs="y",
    intersample="zoh",
)
QUANTILE = chi2.ppf(0.95, 1)


def motion(at, u, x0=(0.0, 0.0), dt=DT):
    """Motion of the oscillator for a held force, (n,)."""
    w, d, b = at
    step = expm(np.array([[0, 1, 0], [-w * w, -d, b], [0, 0, 0]]) * dt)
    return dlsim((step[:2, :2], step[:2, 2:], [[1, 0]], [[0]], dt), u[:, None], x0=np.array(x0))[1][:, 0]


def force(n, seed, hold=7):
    return np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], -(-n // hold)), hold)[:n]


def recording(u, y, name="run", dt=DT):
    return gbid.Recording({"u": u[:, None], "y": y[:, None]}, dt, name=name)


def data(n=150, seed=1, noise=0.4, damping=0.05, gain=1.0, name="run"):
    u = force(n, seed)
    e = noise * np.random.default_rng([seed, 7]).normal(size=n)
    return recording(u, motion((W, 2 * damping * W, gain * W**2), u) + e, name)


def ends(errors, at, scale, k, guess):
    """Ends of the interval of unknown k, where the ratio of the likelihoods is the quantile.

    `errors` are those of all samples for all unknowns; `at` is near their minimum, `guess` how far the ends are.
    """
    at, scale = np.asarray(at, float), np.asarray(scale, float)
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    best = least_squares(lambda z: errors(z * scale), at / scale, **tight)
    freedom = len(best.fun) - len(at)

    def above(value):
        def held(z):
            return errors(np.insert(z, k, value / scale[k]) * scale)

        cost = least_squares(held, np.delete(best.x, k), **tight).cost
        return freedom * np.log(cost / best.cost) - QUANTILE

    begin = best.x[k] * scale[k]
    return [brentq(above, begin, begin + way * 3 * guess, xtol=1e-6 * guess) for way in (-1, 1)]


def test_the_ends_are_those_of_constrained_fits_by_least_squares():
    rec = data(n=60, noise=0.4)
    u, y = rec.signals["u"][:, 0], rec.signals["y"][:, 0]
    result = gbid.fit(OSCILLATOR, rec)
    at = [*result.parameters.values(), *result.initial_states[0]]
    for k, name in ((1, "d"), (2, "b")):
        profile = result.profile(name)
        true = ends(lambda z: y - motion(z[:3], u, z[3:]), at, [1, 1, 100, 1, W], k, 2 * result.std[name])
        assert profile.interval == pytest.approx(true, abs=5e-3 * result.std[name])
        assert profile.verdict == "identifiable"
    wald = result.parameters["d"] + 1.96 * result.std["d"] * np.array([-1, 1])
    assert np.abs(np.subtract(result.profile("d").interval, wald)).max() > 0.1 * result.std["d"]  # no parabola


def test_values_ratios_and_losses_belong_together():
    rec, level = data(), 0.8
    result = gbid.fit(OSCILLATOR, rec)
    profile = result.profile("d", level)
    k = int(np.argmin(profile.ratios))
    assert (np.diff(profile.values) > 0).all()
    assert profile.ratios[k] == 0
    assert profile.values[k] == pytest.approx(result.parameters["d"], abs=1e-3 * result.std["d"])
    assert profile.losses[k] == pytest.approx(result.loss)
    assert profile.threshold == pytest.approx(chi2.ppf(level, 1))
    assert profile.ratios[0] > profile.threshold < profile.ratios[-1]
    fixed = gbid.fit(OSCILLATOR, rec, fixed={"d": float(profile.values[-1])})
    assert profile.losses[-1] == pytest.approx(fixed.loss, rel=1e-6)
    assert fixed.loss > 1.005 * result.loss


def test_coloured_errors_have_the_robust_standard_deviation():
    u = force(4000, 2)
    e = 0.2 * lfilter([1.0], [1.0, -0.9], np.random.default_rng(4).normal(size=4500))[500:]
    result = gbid.fit(OSCILLATOR, recording(u, motion((W, 0.1 * W, W**2), u) + e))
    assert result.trusted == "robust"
    for name, profile in gbid.profile(result).items():
        sides = np.abs(np.subtract(profile.interval, result.parameters[name])) / np.sqrt(QUANTILE)
        assert sides == pytest.approx([result.std[name]] * 2, rel=0.02)
    assert abs(result.std_with("white")["b"] / result.std["b"] - 1) > 0.2


def test_a_parameter_without_effect_is_flat():
    structure = LinearStructure(
        "at rest",
        [*OSCILLATOR.parameters, Parameter("q", 5.0)],
        lambda p: {
            "A": [[0, 1, 0], [-p.w * p.w, -p.d, 0], [0, 0, -p.q]],
            "B": [[0], [p.b], [0]],
            "C": [[1, 0, 1]],
        },
        "u",
        "y",
        intersample="zoh",
    )
    result = gbid.fit(structure, data(), initial_state=["estimated", "estimated", 0.0], window=None)
    profile = result.profile("q")
    assert (profile.verdict, profile.interval) == ("flat", (-np.inf, np.inf))
    assert np.isnan(profile.std)
    assert profile.ratios.max() < 1e-6
    assert np.ptp(profile.values) > 500 * 5.0
    assert result.profile("w").verdict == "identifiable"


def test_of_a_product_neither_factor_has_an_end_away_from_zero():
    structure = LinearStructure(
        "product",
        [*OSCILLATOR.parameters[:2], Parameter("b", 30.0, lower=0.0), Parameter("c", 130.0, lower=0.0)],
        lambda p: {"A": [[0, 1], [-p.w * p.w, -p.d]], "B": [[0], [p.b]], "C": [[p.c, 0]]},
        "u",
        "y",
        intersample="zoh",
    )
    result = gbid.fit(structure, data())
    assert not result.success
    profile = result.profile("b")
    assert profile.interval[1] == np.inf
    assert profile.interval[0] < 1e-3 * profile.estimate
    assert profile.ratios[profile.values > 1e-3 * profile.estimate].max() < 1e-3


def test_a_parameter_on_its_bound_is_one_sided():
    for seed in range(8):
        result = gbid.fit(OSCILLATOR, data(n=60, seed=seed, noise=1.0, damping=0.0))
        profile = result.profile("d")
        if not np.isnan(result.std["d"]):
            continue
        assert profile.verdict == "one-sided"
        assert profile.interval[0] == 0
        assert 0 < profile.interval[1] < 6 * profile.std
        beyond = gbid.fit(OSCILLATOR, data(n=60, seed=seed, noise=1.0, damping=0.0), fixed={"d": profile.interval[1]})
        ratio = np.log(beyond.loss / result.loss) * (60 - 5)  # three parameters and two initial states
        assert ratio == pytest.approx(QUANTILE, rel=0.03)
        return
    pytest.fail("no estimate is on the bound")


def test_other_parameters_keep_to_their_bounds():
    """Along b the damping would become negative: its bound holds it, and lets it go again."""
    rec = data(n=60, seed=3, noise=0.5)
    free = gbid.fit(OSCILLATOR, rec)
    bound = free.parameters["d"] + 0.1 * free.std["d"]
    limited = {"bounds": {"d": (bound, np.inf)}, "start": {"d": 2 * bound}}
    profile = gbid.fit(OSCILLATOR, rec, **limited).profile("b")
    for value, loss in zip(profile.values, profile.losses, strict=True):
        fixed = gbid.fit(
            OSCILLATOR, rec, fixed={"b": float(value)}, bounds={"d": (bound, np.inf)}, start={"d": 2 * bound}
        )
        assert loss == pytest.approx(fixed.loss, rel=2e-4)


def test_a_nonlinear_structure():
    a, c, g, n, dt = 2.0, 3.0, 8.0, 120, 0.05
    structure = NonlinearStructure(
        "drag",
        [Parameter("a", a, lower=0.0), Parameter("c", c), Parameter("g", g)],
        ["v"],
        lambda x, u, p: [-p.a * x[0] - p.c * x[0] ** 3 + p.g * u[0]],
        lambda x, u, p: [x[0]],
        "u",
        "y",
        steps=8,
    )
    u = force(n, 5, 12)

    def simulated(z):
        speeds, x = [], z[3]
        for held in u:
            speeds.append(x)
            x = solve_ivp(lambda _, v, held=held: -z[0] * v - z[1] * v**3 + z[2] * held, (0, dt), [x], rtol=1e-8).y[
                0, -1
            ]
        return np.array(speeds)

    y = simulated((a, c, g, 0.0)) + 0.3 * np.random.default_rng(6).normal(size=n)
    result = gbid.fit(structure, recording(u, y, dt=dt), focus="simulation")
    assert result.success
    profile = result.profile("a")
    loss, limits = {}, ([-1, 0, -1], [20, 20, 1])
    for value in (profile.values[0], profile.values[-1]):
        begin = [result.parameters["c"], result.parameters["g"], result.initial_states[0, 0]]
        best = least_squares(lambda z, value=value: y - simulated([value, *z]), begin, bounds=limits)
        loss[value] = 2 * best.cost / n
    assert [profile.losses[0], profile.losses[-1]] == pytest.approx(list(loss.values()), rel=2e-4)
    assert profile.ratios.max() > QUANTILE / 2


def test_local_parameters_of_several_recordings():
    recs = [data(n=100, seed=2, gain=1.0, name="one"), data(n=80, seed=3, gain=1.4, name="two")]
    result = gbid.fit(OSCILLATOR, recs, local={"b": "recording"})
    profiles = gbid.profile(result)
    assert list(profiles) == ["w", "d", "b[one]", "b[two]"]
    signals = [(rec.signals["u"][:, 0], rec.signals["y"][:, 0]) for rec in recs]

    def errors(z):
        each = zip(signals, z[2:4], (z[4:6], z[6:8]), strict=True)
        return np.concatenate([y - motion((z[0], z[1], b), u, x0) for (u, y), b, x0 in each])

    at = [*(result.parameters[name] for name in result.free), *result.initial_states.ravel()]
    scale = [1, 1, 100, 100, 1, W, 1, W]
    std = result.std["b[two]"]
    assert profiles["b[two]"].interval == pytest.approx(ends(errors, at, scale, 3, 2 * std), abs=5e-3 * std)


def test_prior_constraint_and_robust_loss():
    rec = data()
    free = gbid.fit(OSCILLATOR, rec).profile("d")
    std = 0.5 * free.std
    known = gbid.fit(OSCILLATOR, rec, prior={"d": (free.estimate, std)}).profile("d")
    assert np.diff(known.interval) == pytest.approx(np.diff(free.interval) / np.sqrt(5), rel=0.05)
    half = {"constraints": lambda p, _: [(-np.inf, p.d - free.estimate - std, 0.0)]}
    limited = gbid.fit(OSCILLATOR, rec, **half).profile("d")
    assert limited.interval[1] == pytest.approx(free.estimate + std, abs=0.02 * std)
    assert limited.interval[0] == pytest.approx(free.interval[0], abs=0.02 * std)
    robust = gbid.fit(OSCILLATOR, rec, robust="student")
    sides = np.abs(np.subtract(robust.profile("w").interval, robust.parameters["w"])) / np.sqrt(QUANTILE)
    assert sides == pytest.approx([robust.std["w"]] * 2, rel=0.05)


def test_an_unstable_plant_is_profiled_in_its_windows():
    problem = start_problem("maglev")
    result = gbid.fit(problem.structure, problem.recording, start=MAGLEV, **problem.options)
    name = result.free[0]
    profile = result.profile(name)
    sides = np.abs(np.subtract(profile.interval, result.parameters[name])) / np.sqrt(QUANTILE)
    assert sides == pytest.approx([result.std[name]] * 2, rel=0.05)


def test_twenty_four_parameters_take_one_pass_a_point(monkeypatch):
    machine = gbid.load_model("theisen2016")
    plant = gbid.Plant(gbid.RotorBearing(delay="exact"))
    names = [q.name for q in plant.parameters]
    assert len(names) == 24
    true = {**dict.fromkeys(names, 0.0), **machine.actuators, **machine.key_parameters(6.0, 0.0)}
    random = np.random.default_rng(1)
    r = np.repeat(random.choice([-4.5e-6, 4.5e-6], (125, 2)), 40, axis=0)
    y = gbid.structure.evaluate(plant, {name: true[name] for name in names}).simulate(r, 2e-4)
    y += np.array([5e-9, 5e-9, 30e-9, 30e-9]) * random.normal(size=y.shape)
    rec = gbid.Recording({"r": r, "u": y[:, :2], "p": y[:, 2:]}, 2e-4, name="joint")
    began = time.process_time()
    result = gbid.fit(plant, rec)
    fit_s = time.process_time() - began
    points, evaluate = [], Shooting._evaluate
    monkeypatch.setattr(Shooting, "_evaluate", lambda *at: points.append(1) or evaluate(*at))
    began = time.process_time()
    profiles = gbid.profile(result)
    assert time.process_time() - began < 20 * fit_s
    assert len(points) < 1.3 * sum(len(each.values) for each in profiles.values())
    for name, profile in profiles.items():
        assert profile.verdict == "identifiable"
        if not name.startswith("bd"):  # the disturbance gain is no parabola
            sides = np.abs(np.subtract(profile.interval, result.parameters[name])) / np.sqrt(QUANTILE)
            assert sides == pytest.approx([result.std[name]] * 2, rel=0.1)


def test_a_stored_result_needs_its_recordings(tmp_path):
    rec = data()
    result = gbid.fit(OSCILLATOR, rec, profile=["d"])
    gbid.save(result, tmp_path / "fit.h5")
    for copy in (gbid.load(tmp_path / "fit.h5"), pickle.loads(pickle.dumps(result))):
        assert copy.profile("d").interval == result.profiles["d"].interval
        with pytest.raises(UsageError, match=r"gbid\.profile\(result, structure=\.\.\., recordings=\.\.\.\)"):
            copy.profile("w")
        again = gbid.profile(copy, ["w"], structure=OSCILLATOR, recordings=rec)["w"]
        assert again.interval == pytest.approx(result.profile("w").interval, rel=1e-6)
        with pytest.raises(UsageError, match="give the recordings and the structure of the fit"):
            gbid.profile(copy, ["w"], structure=OSCILLATOR, recordings=data(seed=9))


def test_what_has_no_profile():
    result = gbid.fit(OSCILLATOR, data(), fixed={"b": W**2})
    with pytest.raises(UsageError, match="b is no estimated parameter; choose from w, d"):
        result.profile("b")
    with pytest.raises(UsageError, match="between 0 and 1"):
        result.profile("d", 95)
    with pytest.raises(UsageError, match="unknown parameters: k"):
        gbid.fit(OSCILLATOR, data(), profile=["k"])
    with pytest.raises(UsageError, match="a profile begins at a minimum"):
        gbid.fit(OSCILLATOR, data(), start={"w": 20.0}, max_iterations=1).profile("d")


def test_the_option_in_a_yaml(tmp_path, capsys):
    path = write_spring(tmp_path, ("focus:", "profile: [k, d], focus:"))
    assert run_gbid("import", path) == run_gbid("fit", path) == 0
    assert "profile likelihood, 95 %" in capsys.readouterr().out
    result = gbid.load(next(tmp_path.rglob("fits/spring/run1.h5")))
    assert list(result.profiles) == ["k", "d"]
    assert result.profile("k").verdict == "identifiable"
    assert run_gbid("report", path) == 0
    assert "Profile likelihoods: k identifiable, d identifiable" in next(tmp_path.rglob("report.html")).read_text()
    path.write_text(path.read_text().replace("[k, d]", "[k, m]"))
    assert run_gbid("check", path) == 2
    assert "no parameter of spring" in capsys.readouterr().err


def test_the_picture():
    profiles = gbid.fit(OSCILLATOR, data(), profile="all").profiles
    axes = gbid.report.plot_profile(profiles)
    assert [ax.get_title(loc="right") for ax in axes] == ["identifiable"] * 3
    parabola, curve = axes[1].lines[1:]
    np.testing.assert_array_equal(curve.get_xdata(), profiles["d"].values)
    np.testing.assert_array_equal(curve.get_ydata(), profiles["d"].ratios)
    at = np.interp(profiles["d"].interval, parabola.get_xdata(), parabola.get_ydata())
    assert at == pytest.approx(profiles["d"].threshold, rel=0.15)
    assert len(np.ravel(profiles["w"].plot())) == 1


def test_the_end_of_an_interval_is_on_the_parabola_through_all_points():
    """Values are 1 + 2 r + 3 r^2 of the root r of the ratio, at r = 0, 1 and 2."""
    side = Side([1.0, 6.0, 17.0], [0.0, 1.0, 4.0], "crossed")
    assert _end(side, 1, 1.5**2) == pytest.approx(1 + 2 * 1.5 + 3 * 1.5**2)
    fallen = Side([1.0, 2.0, 6.0, 17.0], [0.0, 9.0, 1.0, 4.0], "crossed")  # another minimum on the way: from there on
    assert _end(fallen, 1, 1.5**2) == pytest.approx(11.5)
