"""Fits with a model of the errors (errors="ar"), on data that scipy makes."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

import gbid
from gbid.core.errors import UsageError
from gbid.identify.uncertainty.coloured import (
    ErrorModel,
    RecordSensitivities,
    _taken,
    lag_products,
    log_likelihood,
    transformed,
    whitened,
    whitening,
)
from gbid.structure import LinearStructure, Parameter

TS = 0.003


def oscillator(poles, frequency=100.0, damping=0.0027):
    """A mode, its true parameters, and its motion with errors of an autoregression by matrices of scipy."""
    truth = {"a0": frequency**2, "a1": 2 * damping * frequency, "b0": frequency**2}
    structure = LinearStructure(
        "oscillator",
        [Parameter(name, value) for name, value in truth.items()],
        lambda p: {"A": [[0, 1], [-p.a0, -p.a1]], "B": [[0], [p.b0]], "C": [[1, 0]]},
        inputs="u",
        outputs="y",
        intersample="zoh",
    )
    step = expm(TS * np.array([[0, 1, 0], [-truth["a0"], -truth["a1"], truth["b0"]], [0, 0, 0]]))
    colour = np.poly(poles).real
    unit = np.sqrt((lfilter([1.0], colour, np.eye(1, 20_000)[0]) ** 2).sum())

    def recording(seed, n, level, hold=7):
        random = np.random.default_rng(seed)
        u = np.repeat(random.choice([-1.0, 1.0], -(-n // hold)), hold)[:n]
        state, y = np.zeros(3), np.zeros(n)
        for k in range(n):
            y[k], state[2] = state[0], u[k]
            state[:2] = (step @ state)[:2]
        y += level * lfilter([1.0], colour, random.normal(size=n + 3000))[3000:] / unit
        return gbid.Recording({"u": u[:, None], "y": y[:, None]}, TS, name=f"run-{seed}")

    return structure, truth, recording


PEAK = (0.95 * np.exp(0.3j), 0.95 * np.exp(-0.3j), 0.8)


def distances(result, truth):
    return np.array([(result.parameters[name] - value) / result.std[name] for name, value in truth.items()])


# ---- Estimates.


@pytest.mark.parametrize(("count", "coverage"), [(4, 0.76), pytest.param(15, 0.85, marks=pytest.mark.slow)])
def test_with_noise_at_the_mode_intervals_are_honest_and_narrower(count, coverage):
    """Of ``3 count`` intervals, three standard deviations below 95 % may miss the truth."""
    structure, truth, recording = oscillator((0.99 * np.exp(0.3j), 0.99 * np.exp(-0.3j)), damping=0.05)
    off, z, narrower, noted = {"white": [], "ar": []}, [], [], 0
    for seed in range(count):
        data = recording(seed, 1800, 1.0)
        fits = {kind: gbid.fit(structure, data, focus="simulation", errors=kind) for kind in off}
        assert fits["ar"].success
        assert fits["ar"].error_models[0].order >= 2
        narrower.append([fits["ar"].std[name] / fits["white"].std[name] for name in truth])
        noted += any("errors='ar'" in note and "GB106" in note for note in fits["white"].notes)
        for kind, result in fits.items():
            off[kind].append([result.parameters[name] - value for name, value in truth.items()])
        z.append(distances(fits["ar"], truth))
    white, ar = (np.sqrt((np.array(off[kind]) ** 2).mean(axis=0)) for kind in ("white", "ar"))
    assert (np.abs(z) < 1.96).mean() > coverage
    assert np.exp(np.log(ar / white).mean()) < 0.75
    assert np.median(narrower) < 0.75
    assert noted == count  # the fit with errors="white" says so


def test_white_errors_have_no_lags_and_the_estimates_of_least_squares():
    structure, truth, recording = oscillator((0.0,), damping=0.05)
    data = recording(3, 1500, 0.5)
    white, ar = (gbid.fit(structure, data, focus="simulation", errors=kind) for kind in ("white", "ar"))
    assert [model.order for model in ar.error_models] == [0]
    for name in truth:
        assert ar.parameters[name] == pytest.approx(white.parameters[name], abs=0.02 * white.std[name])
        assert ar.std[name] == pytest.approx(white.std[name], rel=0.01)
    assert not any("errors='ar'" in note for note in white.notes)


def test_of_two_maxima_that_chance_explains_the_one_from_the_start_counts_and_is_said():
    """Least squares goes to a line of the noise, far outside its interval; weighted, the interval contains the truth.

    The motion of the mode is so small that even with the true spectrum of the noise other frequencies explain the
    data better: an honest interval contains them.
    """
    structure, truth, recording = oscillator(PEAK)
    data = recording(0, 1800, 40.0)
    white, ar = (gbid.fit(structure, data, focus="simulation", errors=kind) for kind in ("white", "ar"))
    off = [abs(result.parameters["a0"] - truth["a0"]) for result in (white, ar)]
    assert off[0] > 5 * white.std["a0"]
    assert ar.success
    assert off[1] < 1.96 * ar.std["a0"]
    (note,) = (note for note in ar.notes if "GB138" in note)
    assert "which chance explains: a0 is 15009" in note


def test_where_the_mode_is_seen_well_other_maxima_do_not_widen_intervals():
    structure, truth, recording = oscillator(PEAK)
    fits = [gbid.fit(structure, recording(seed, 1800, 10.0), focus="simulation", errors="ar") for seed in range(2)]
    assert not any("GB138" in note for result in fits for note in result.notes)
    assert all(result.std["a0"] < 60 for result in fits)
    assert np.abs([distances(result, truth) for result in fits]).max() < 3


def test_two_outputs_and_two_recordings_with_noise_of_their_own():
    """The noise couples the outputs; one recording has ten times as much. Standard deviations are those of theory."""
    a, coupled = 3.0, np.array([[0.8, 0.15], [-0.1, 0.7]])
    structure = LinearStructure(
        "lags",
        [Parameter("a", a), Parameter("b", 1.0), Parameter("c", 2.0)],
        lambda p: {"A": [[-p.a]], "B": [[1.0]], "C": [[p.b], [p.c]]},
        inputs="u",
        outputs=("y1", "y2"),
    )
    truth = {"a": a, "b": 1.0, "c": 2.0}

    def recordings(seed):
        random, made = np.random.default_rng(seed), []
        for i, level in enumerate((0.02, 0.2)):
            u = np.repeat(random.choice([-1.0, 1.0], 150), 4)
            x = lfilter([0.0, (1 - np.exp(-a * 0.1)) / a], [1.0, -np.exp(-a * 0.1)], u)
            e, w = np.zeros((900, 2)), random.normal(size=(900, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
            for k in range(1, 900):
                e[k] = coupled @ e[k - 1] + w[k]
            y = np.outer(x, [1.0, 2.0]) + level * e[300:]
            signals = {"u": u[:, None], "y1": y[:, :1], "y2": y[:, 1:]}
            made.append(gbid.Recording(signals, 0.1, name=f"run-{i}"))
        return made

    fits = [gbid.fit(structure, recordings(seed), focus="simulation", errors="ar") for seed in range(20)]
    assert all(result.success for result in fits)
    z = np.array([distances(result, truth) for result in fits])
    assert 0.75 < np.sqrt((z**2).mean()) < 1.25
    assert np.median([result.error_models[0].order for result in fits]) == 1
    quiet, loud = (np.mean([result.error_models[i].innovation[0, 0] for result in fits]) for i in (0, 1))
    assert loud / quiet == pytest.approx(100, rel=0.1)


def test_bounds_priors_left_out_samples_and_free_decays():
    structure, truth, recording = oscillator((0.9,), damping=0.02)
    data = recording(1, 1200, 0.5)
    held = gbid.fit(
        structure, data, focus="simulation", errors="ar", start={"b0": 8000.0}, bounds={"b0": (0.0, 9000.0)}
    )
    assert held.parameters["b0"] == pytest.approx(9000.0)
    assert np.isnan(held.std["b0"])
    free = gbid.fit(structure, data, focus="simulation", errors="ar")
    told = gbid.fit(structure, data, focus="simulation", errors="ar", prior={"a1": (5.0, 1e-3)})
    assert abs(told.parameters["a1"] - 5.0) < 0.01 < abs(free.parameters["a1"] - 5.0)
    y = data.signal("y").copy()
    y[500:520] += 100.0
    spoilt = gbid.fit(
        structure,
        data.with_signals(y=y),
        focus="simulation",
        errors="ar",
        left_out={data.name: [(500, 520)]},
    )
    assert spoilt.success
    for name in truth:
        assert abs(spoilt.parameters[name] - free.parameters[name]) < 0.5 * free.std[name]
    t = TS * np.arange(600)
    decay = np.exp(-2 * t) * np.cos(100 * np.sqrt(1 - 0.02**2) * t)
    decay += 0.02 * lfilter([1.0], [1.0, -0.9], np.random.default_rng(2).normal(size=600))
    rung = gbid.fit(
        structure,
        gbid.Recording({"y": decay[:, None]}, TS),
        inputs=(),
        focus="simulation",
        errors="ar",
        fixed={"b0": 0.0},
    )
    assert rung.success
    assert abs(rung.parameters["a0"] - truth["a0"]) < 4 * rung.std["a0"]


# ---- Likelihood, file, notes and words.


@pytest.fixture(scope="module")
def coloured_fit():
    structure, _, recording = oscillator((0.9,), damping=0.02)
    return gbid.fit(structure, recording(5, 700, 1.0), focus="simulation", errors="ar")


def test_it_is_stored_with_its_models_and_shown(coloured_fit, tmp_path):
    gbid.save(coloured_fit, tmp_path / "fit.h5")
    loaded = gbid.load(tmp_path / "fit.h5")
    assert loaded.options.errors == "ar"
    assert loaded.log_likelihood == coloured_fit.log_likelihood
    for stored, made in zip(loaded.error_models, coloured_fit.error_models, strict=True):
        np.testing.assert_array_equal(stored.coefficients, made.coefficients)
        np.testing.assert_array_equal(stored.innovation, made.innovation)
    assert f"autoregression of order {coloured_fit.error_models[0].order}" in str(loaded)
    with pytest.raises(UsageError, match="profiles are for errors='white'"):
        coloured_fit.profile("a0")


def test_likelihood_of_white_errors_is_that_of_the_normal_distribution():
    structure, _, recording = oscillator((0.0,), damping=0.05)
    result = gbid.fit(structure, recording(3, 500, 0.5), focus="simulation")
    n, variance = 500, float(result.error_covariance[0, 0])
    assert result.log_likelihood == pytest.approx(-0.5 * n * (np.log(2 * np.pi * variance) + 1), rel=1e-9)
    assert result.aic == pytest.approx(-2 * result.log_likelihood - n * (1 + np.log(2 * np.pi)) + 2 * 5, rel=1e-9)


COUPLED = ErrorModel(
    np.array([[[0.6, 0.3], [-0.2, 0.5]], [[-0.3, 0.0], [0.1, -0.2]]]), np.array([[1.0, 0.5], [0.5, 0.34]])
)


def test_filter_and_likelihood_are_those_of_the_whole_covariance_also_around_a_gap():
    n, gap = 60, slice(25, 31)
    response = np.zeros((400, 2, 2))
    response[0] = np.linalg.cholesky(COUPLED.innovation)
    for k in range(1, 400):
        response[k] = sum(a @ response[k - i] for i, a in enumerate(COUPLED.coefficients[:k], 1))
    lags = [np.einsum("kab,kcb->ac", response[i:], response[: 400 - i]) for i in range(n)]
    S = np.block([[lags[i - j] if i >= j else lags[j - i].T for j in range(n)] for i in range(n)])
    counted = np.ones(n, bool)
    counted[gap] = False
    random = np.random.default_rng(0)
    psi, e = random.normal(size=(2, 3, n)) * counted, random.normal(size=(n, 2)) * counted[:, None]
    record = RecordSensitivities(np.arange(3), psi, e, counted)
    filter_ = whitening(COUPLED, n)
    computed, likelihood = whitened(record, filter_), 0.0
    for some in (slice(0, 25), slice(31, n)):
        rows = np.repeat(np.arange(n), 2)
        inside = (rows >= some.start) & (rows < some.stop)
        part = S[np.ix_(inside, inside)]
        white = np.linalg.solve(np.linalg.cholesky(part), psi[:, :, some].transpose(2, 0, 1).reshape(-1, 3))
        np.testing.assert_allclose(computed.psi[:, :, some].transpose(2, 0, 1).reshape(-1, 3), white, atol=1e-9)
        likelihood += multivariate_normal(np.zeros(len(part)), part).logpdf(e[some].ravel())
    assert log_likelihood(computed, filter_) == pytest.approx(likelihood, rel=1e-10)
    assert not computed.errors[gap].any()


def test_an_unstable_autoregression_gets_a_memory_of_the_record_at_most():
    model = whitening(ErrorModel(np.array([[[1.3]]]), np.eye(1)), 200).model
    assert model.coefficients[0, 0, 0] == pytest.approx(1 - 1 / 200)


def test_what_the_fit_took_is_given_back_over_the_same_samples_as_the_residuals():
    """Sums over other samples end in steps: they made a narrow peak wide, and its autoregression another one."""
    random, n, longest = np.random.default_rng(1), 300, 12
    psi, root = random.normal(size=(2, 3, n)), random.normal(size=(3, 3))
    counted = np.ones(n, bool)
    counted[140:150] = False
    record = RecordSensitivities(np.arange(3), psi * counted, np.ones((n, 2)) * counted[:, None], counted)
    computed = _taken(transformed(record, np.arange(3)), root @ root.T, longest)
    shifted = [np.einsum("ymk,m->ky", record.psi, column) for column in root.T]
    expected = sum(lag_products([each[:140], each[150:]], longest)[0] for each in shifted)
    np.testing.assert_allclose(computed, expected, atol=1e-9)


def test_options_that_contradict_it_are_refused(coloured_fit):
    structure, _, recording = oscillator((0.9,), damping=0.02)
    data = recording(5, 700, 1.0)
    for options, words in (
        ({}, "focus = 'simulation'"),
        ({"focus": "simulation", "robust": "huber"}, "leave robust out"),
        ({"focus": "simulation", "output_weights": [1.0]}, "leave output_weights out"),
        ({"focus": "simulation", "extra_cost": lambda p, x0: p.a0}, "extra_cost and constraints"),
    ):
        with pytest.raises(UsageError, match=words):
            gbid.fit(structure, data, errors="ar", **options)


def test_a_model_that_grows_is_no_success():
    structure = LinearStructure(
        "growing",
        [Parameter("a", 1.0), Parameter("b", 1.0)],
        lambda p: {"A": [[p.a]], "B": [[p.b]], "C": [[1.0]]},
        inputs="u",
        outputs="y",
    )
    u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 40), 5)
    y = lfilter([0.0, 0.1], [1.0, -np.exp(0.1)], u) + 0.01 * np.random.default_rng(1).normal(size=200)
    result = gbid.fit(
        structure, gbid.Recording({"u": u[:, None], "y": y[:, None]}, 0.1), focus="simulation", errors="ar"
    )
    assert not result.success
    assert "grows over a recording" in result.status
