"""Names of signals and recordings are free text: they come through fit, validation, tests and file."""

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated

import gbid
from gbid.identify import FitStatus
from gbid.recording import Recording

NAMES = [("my u", "y"), ("a,b", "x;y"), ("p.x", "p.y"), ("[1]", "v[2]"), ("p", "p.x"), ("=SUM(A1)", "µ, °")]
ASKED = {"trend": "offset", "local": {"g": "recording"}}


def renamed(recording, source, target, name):
    signals = {source: recording.signal("u"), target: recording.signal("y")}
    return Recording(signals, recording.sample_time, name=name)


@pytest.fixture(scope="module")
def plain():
    return [simulated(MODE, MODE_AT, levels(300, seed=i), noise=0.3, seed=i, name=f"{i}") for i in range(2)]


@pytest.fixture(scope="module")
def reference(plain):
    return gbid.fit(MODE, plain, **ASKED)


@pytest.mark.parametrize(("source", "target"), NAMES)
def test_any_name_comes_through(source, target, plain, reference, tmp_path):
    data = [renamed(r, source, target, f"run; {i}, [x] of 'me'") for i, r in enumerate(plain)]
    computed = gbid.fit(MODE, data, inputs=source, outputs=target, **ASKED)
    assert list(computed.parameters.values()) == list(reference.parameters.values())
    assert computed.units[f"offset_{target}[{data[0].name}]"] == ""
    assert computed.start_origin[f"offset_{target}[{data[0].name}]"] == reference.start_origin["offset_y[0]"]
    assert list(computed.parameters_of(data[1].name).values()) == list(reference.parameters_of("1").values())
    gbid.save(computed, tmp_path / "fit.h5")
    again = gbid.load(tmp_path / "fit.h5")
    assert again.options == computed.options
    assert (again.options.inputs, again.options.outputs) == ((source,), (target,))
    assert again.model.input_names == (source,)
    for result in (computed, again):
        scored = gbid.cross_validate(result, data[1])
        np.testing.assert_array_equal(scored.fit_percent, gbid.cross_validate(reference, plain[1]).fit_percent)
        tested = gbid.check_residuals(result, data[1])
        assert tested.input_names == (source,)
        np.testing.assert_array_equal(tested.p_white, gbid.check_residuals(reference, plain[1]).p_white)


def test_a_prior_finds_local_offsets_of_a_bracketed_signal(plain):
    data = [renamed(r, "u", "v[2]", r.name) for r in plain]
    prior = {"offset_v[2]": (1.0, 1e-6)}
    result = gbid.fit(MODE, data, inputs="u", outputs="v[2]", trend="offset", prior=prior)
    assert result.parameters["offset_v[2][0]"] == pytest.approx(1.0, abs=1e-3)
    assert result.parameters["offset_v[2][1]"] == pytest.approx(1.0, abs=1e-3)


def test_statuses_read_as_text_and_know_success():
    assert f"{FitStatus.CONVERGED}" == "converged"
    assert {status.success for status in FitStatus if str(status).startswith("not converged")} == {False}
    assert {status.success for status in FitStatus if str(status).startswith("converged")} == {True}
    assert sum(status.success for status in FitStatus) == 6
