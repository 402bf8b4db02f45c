"""Outputs that are combinations of others: the fit names them, and gives what it gives without them."""

import numpy as np
import pytest
from fit_cases import H, levels

from gbid.identify import fit, profile
from gbid.recording import Recording
from gbid.structure import LinearStructure, NonlinearStructure, Parameter, evaluate

PARAMETERS = [Parameter("a", 2.0, 0.01, 20.0), Parameter("b", 1.0, 0.01, 20.0)]
GAINS = [Parameter(f"k{i}", 0.0) for i in range(3)]
AT = {"a": 1.5, "b": 0.8}
TWO = np.eye(2)


def lags(C, gain=False):
    """Two lags in series with outputs C x, and a free gain of the first error of each output."""

    def matrices(p):
        K = [[p[f"k{i}"] for i in range(len(C))], [0] * len(C)] if gain else np.zeros((2, len(C)))
        return {"A": [[-p.a, 0], [p.b, -p.b]], "B": [[p.a], [0]], "C": np.asarray(C, float), "K": K}

    return LinearStructure("lags", [*PARAMETERS, *GAINS[: len(C) if gain else 0]], matrices)


def nonlinear(C, gain=False):
    return NonlinearStructure(
        "lags",
        PARAMETERS,
        ["x", "z"],
        lambda x, u, p: [p.a * (u[0] - x[0]), p.b * (x[0] - x[1])],
        lambda x, _u, _p: [row[0] * x[0] + row[1] * x[1] for row in np.asarray(C).tolist()],
        "u",
        [f"y.{i + 1}" for i in range(len(C))],
    )


def data(C, made=None, noise=0.02, seed=0):
    """A recording of outputs C x with coloured noise and, beside them, `made` of the measured ones."""
    random, u = np.random.default_rng(seed), levels(1000, seed=seed)
    y = evaluate(lags(C), AT).simulate(u, H)
    e = noise * random.normal(size=y.shape)
    e[1:] += 0.8 * e[:-1]
    y = y + e
    columns = y if made is None else np.column_stack([y, made(y, random)])
    return Recording({"u": u, "y": columns}, H, name="run")


def same(result, alone, gain=False):
    assert result.success
    assert alone.success
    assert "GB142" in " ".join(result.notes)
    assert "GB142" not in " ".join(alone.notes)
    for name in alone.free:
        assert abs(result.parameters[name] - alone.parameters[name]) < 0.01 * alone.std[name]
        assert result.std[name] == pytest.approx(alone.std[name], rel=0.01)


FIFTEEN = np.random.default_rng(3).normal(size=(14, 2))
CASES = {
    "twice": (TWO, [[0, 1]], lambda y, _: y[:, 1]),
    "nearly twice": (TWO, [[0, 1]], lambda y, random: y[:, 1] + 1e-9 * random.normal(size=len(y))),
    "with an offset": (TWO, [[0, 1]], lambda y, _: y[:, 1] + 3.0),
    "mean": (TWO, [[0.5, 0.5]], lambda y, _: y.mean(axis=1)),
    "of fifteen": (FIFTEEN, [FIFTEEN[0] - 2 * FIFTEEN[7]], lambda y, _: y[:, 0] - 2 * y[:, 7]),
}


@pytest.mark.parametrize(("case", "criterion"), [*((case, "auto") for case in CASES), ("mean", "trace")])
def test_a_dependent_output_changes_nothing_and_is_named(case, criterion):
    C, row, made = CASES[case]
    recording = data(C, made)
    result = fit(lags(np.vstack([C, row])), recording, criterion=criterion, focus="simulation")
    alone = fit(lags(C), data(C), criterion=criterion, focus="simulation")
    same(result, alone)
    assert f"'y_{len(C) + 1}'" in " ".join(result.notes)
    assert len(result.model.C) == len(C)


@pytest.mark.parametrize("made", [lags, nonlinear])
def test_prediction_and_nonlinear_structures(made):
    C, row, column = CASES["mean"]
    focus = {"focus": "simulation"} if made is nonlinear else {}
    result = fit(made(np.vstack([C, row]), True), data(C, column), **focus)
    same(result, fit(made(C, True), data(C), **focus))


def test_a_profile_of_a_stored_result_leaves_the_output_out_as_well():
    C, row, made = CASES["twice"]
    structure, recording = lags(np.vstack([C, row])), data(C, made)
    result = fit(structure, recording, focus="simulation")
    assert profile(result, ["a"], structure=structure, recordings=recording)["a"].interval[0] < result.parameters["a"]


def test_an_output_with_errors_of_its_own_counts():
    result = fit(lags([*TWO, [0, 1]]), data(TWO, lambda y, r: y[:, 1] + 1e-3 * r.normal(size=len(y))))
    assert len(result.model.C) == 3


@pytest.mark.parametrize("n", [3, 14])
def test_outputs_without_noise_keep_all(n):
    """More outputs than states: all depend on each other, and the determinant has no value at the start."""
    C = FIFTEEN[:n]
    result = fit(lags(C), data(C, noise=0.0), focus="simulation")
    assert result.success
    assert not result.notes
    assert len(result.model.C) == n
    assert result.parameters["b"] == pytest.approx(AT["b"], rel=1e-6)


def test_a_parameter_of_the_output_alone_keeps_it():
    def matrices(p):
        return {"A": [[-p.a, 0], [p.b, -p.b]], "B": [[p.a], [0]], "C": [[1, 0], [0, 1], [0, p.c]]}

    structure = LinearStructure("lags", [*PARAMETERS, Parameter("c", 1.0)], matrices)
    result = fit(structure, data(TWO, lambda y, _: 2 * y[:, 1]), focus="simulation")
    assert "GB142" in " ".join(result.notes)
    assert not result.success
    clean = fit(structure, data(TWO, lambda y, _: 2 * y[:, 1], noise=0.0), focus="simulation")
    assert clean.success
    assert clean.parameters["c"] == pytest.approx(2.0, rel=1e-6)
