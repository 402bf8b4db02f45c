"""The model of a fit simulates, predicts and is discretised with the inter-sample behaviour of the fit."""

import casadi as ca
import numpy as np
import pytest
from scipy.signal import lsim

import gbid
from gbid import LinearModel, LinearStructure, NonlinearStructure, Parameter, Recording, fit
from gbid.core.errors import UsageError
from gbid.export.matlab import linear_contents
from gbid.validate.simulate import simulator

H = 1e-3
TRUE = {"k": 6e5, "d": 80.0, "g": 3e5}
PARAMETERS = [Parameter("k", 5e5), Parameter("d", 50.0), Parameter("g", 2e5)]


def linear(intersample="foh"):
    def matrices(p):
        A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-p["k"], -p["d"]))
        return {"A": A, "B": ca.vertcat(0, p["g"]), "C": ca.DM([[1, 0]])}

    return LinearStructure("disc", PARAMETERS, matrices, ["u"], ["p"], intersample=intersample)


def nonlinear():
    return NonlinearStructure(
        "disc",
        PARAMETERS,
        ["q", "v"],
        lambda x, u, p: ca.vertcat(x[1], -p["k"] * x[0] - p["d"] * x[1] + p["g"] * u[0]),
        lambda x, u, p: x[0],
        ["u"],
        ["p"],
        intersample="foh",
        steps=8,
    )


@pytest.fixture(scope="module")
def record():
    """An input that moves on straight lines between samples, and the answer by scipy."""
    rng, n = np.random.default_rng(1), 4000
    u = np.convolve(rng.standard_normal(n), [0.3, 0.5, 0.2], "same")
    system = ([[0.0, 1.0], [-TRUE["k"], -TRUE["d"]]], [[0.0], [TRUE["g"]]], [[1.0, 0.0]], [[0.0]])
    _, y, _ = lsim(system, u, H * np.arange(n), interp=True)
    return Recording({"u": u[:, None], "p": (y + 1e-3 * y.std() * rng.standard_normal(n))[:, None]}, H, name="run")


def relative_error(simulated, record):
    p = record.signal("p")
    return float(np.sqrt(np.mean((simulated - p) ** 2)) / p.std())


@pytest.mark.parametrize("structure", [linear(), nonlinear()], ids=["linear", "nonlinear"])
def test_the_model_of_a_fit_simulates_with_the_hold_of_the_fit(structure, record, tmp_path):
    result = fit(structure, record, focus="simulation", window=None)
    assert result.success
    gbid.save(result, tmp_path / "fit.h5")
    u, start = record.signal("u"), {"initial_state": result.initial_states[0]}
    for model in (result.model, gbid.load(tmp_path / "fit.h5").model):
        assert model.intersample == ("foh",)
        assert relative_error(model.simulate(u, H, **start), record) < 1.1e-3
        assert relative_error(model.predict(u, record.signal("p"), H, **start), record) < 1.1e-3
        assert relative_error(model.simulate(u, H, intersample="zoh", **start), record) > 0.1
        assert model.linearise().intersample == ("foh",)
    assert relative_error(simulator(result).run(u.T, result.initial_states[0]).T, record) < 1.1e-3


def test_the_option_of_the_fit_counts_not_the_structure(record):
    result = fit(linear("zoh"), record, focus="simulation", intersample="foh")
    assert result.model.intersample == ("foh",)
    assert list(linear_contents(result)["InterSample"].ravel()) == ["foh"]


def test_a_discretised_model_has_the_hold_of_its_fit(record):
    model = fit(linear(), record, focus="simulation").model
    u = record.signal("u").copy()
    u[0] = 0.0  # the state of the discretised model begins at zero with that of the model
    np.testing.assert_allclose(model.discretise(H).simulate(u), model.simulate(u, H), atol=1e-12)
    held = model.discretise(H, intersample="zoh")
    np.testing.assert_allclose(held.simulate(u), model.simulate(u, H, intersample="zoh"), atol=1e-12)
    with pytest.raises(UsageError, match="discrete: intersample is for continuous time only"):
        LinearModel(held.A, held.B, held.C, held.D, dt=H, intersample="zoh")
