"""Criterion of several outputs: the default, its price, and its invariance to units."""

import numpy as np
import pytest
from fit_cases import H, levels

from gbid.identify import fit
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, evaluate

TWO_LAGS = LinearStructure(
    "two lags in series",
    [Parameter("a", 2.0, 0.01, 20.0), Parameter("b", 1.0, 0.01, 20.0)],
    lambda p: {"A": [[-p.a, 0], [p.b, -p.b]], "B": [[p.a], [0]], "C": [[1, 0], [0, 1]]},
)
AT = {"a": 1.5, "b": 0.8}


def data(seed=0, scale=(1.0, 1.0), noise=(0.01, 0.3), n=2000):
    u = levels(n, seed=seed)
    y = evaluate(TWO_LAGS, AT).simulate(u, H)
    y = y + np.random.default_rng(seed).normal(size=y.shape) * noise
    return Recording({"u": u, "y": y * scale}, H, name="data")


def scaled(scale):
    """The same two lags, with outputs in other units."""
    return LinearStructure(
        "two lags in series",
        TWO_LAGS.parameters,
        lambda p: {**TWO_LAGS.matrices(p), "C": np.diag(scale)},
    )


def test_the_default_is_the_determinant_for_several_outputs_only():
    rec = data()
    assert fit(TWO_LAGS, rec).options.criterion == "det"
    assert fit(TWO_LAGS, rec, output_weights=[1.0, 1.0]).options.criterion == "trace"
    assert fit(TWO_LAGS, rec, criterion="trace").options.criterion == "trace"
    one = LinearStructure("one lag", TWO_LAGS.parameters[:1], lambda p: {"A": [[-p.a]], "B": [[p.a]], "C": [[1]]})
    assert fit(one, rec, outputs="y.1").options.criterion == "trace"


def test_the_price_of_the_trace():
    """Errors a hundred times as large in one output: the trace takes the pole of the other from them."""
    rec = data(noise=(0.003, 0.3))
    trace, det = (fit(TWO_LAGS, rec, criterion=criterion) for criterion in ("trace", "det"))
    assert trace.std["a"] > 5 * det.std["a"]
    weighted = fit(TWO_LAGS, rec, output_weights=[1 / 0.003**2, 1 / 0.3**2])
    for name in AT:
        assert det.std[name] == pytest.approx(weighted.std[name], rel=0.05)
        assert abs(det.parameters[name] - weighted.parameters[name]) < 0.1 * det.std[name]
        assert abs(det.parameters[name] - AT[name]) < 4 * det.std[name]


@pytest.mark.parametrize("scale", [(1.0, 1e-9), (1e6, 1e-3)])
def test_the_determinant_does_not_know_units(scale):
    """Volts beside nanometres: neither vanishes in the rounding of the other."""
    plain, other = fit(TWO_LAGS, data()), fit(scaled(scale), data(scale=scale))
    assert other.success
    for name in AT:
        assert other.parameters[name] == pytest.approx(plain.parameters[name], abs=1e-3 * plain.std[name])
        assert other.std[name] == pytest.approx(plain.std[name], rel=1e-3)


def test_exact_data_in_units_far_apart_converge_at_rounding():
    result = fit(scaled((1.0, 1e-9)), data(scale=(1.0, 1e-9), noise=0.0))
    assert result.success
    for name in AT:
        assert result.parameters[name] == pytest.approx(AT[name], rel=1e-6)
