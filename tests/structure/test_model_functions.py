"""Functions of CasADi for structures, against the simulation and prediction of their models."""

import numpy as np
import pytest
from nonlinear_cases import DUFFING, DUFFING_TRUTH, LINEAR_TRUTH, SAME

import gbid
from gbid.core.errors import UsageError
from gbid.structure import evaluate, nonlinear_model
from gbid.structure.kinds import equations_of


def _run(functions, u, y, p):
    """Return simulation and one-step predictions by functions over one sample."""
    n = len(u)
    columns = np.array([np.clip(np.arange(n) + 1 - lag, 0, n - 1) for lag in range(functions.lags + 2)])
    simulated, predicted = [], []
    a = b = np.zeros(functions.continuous.size1_in("x"))
    for k in range(n):
        now = u[columns[:, k]].T
        made = functions.discretised(x=a, u=now, p=p)
        a, _ = made["x_next"], simulated.append(np.array(made["y"]).ravel())
        made = functions.predictor(x=b, u=now, y=y[k], p=p)
        b, _ = made["x_next"], predicted.append(np.array(made["yhat"]).ravel())
    return np.array(simulated), np.array(predicted)


def _signals(n_inputs, n_outputs, n=40):
    rng = np.random.default_rng(0)
    return rng.normal(size=(n, n_inputs)), rng.normal(size=(n, n_outputs))


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("delay", ["pade", "exact"])
def test_functions_of_a_linear_structure_are_its_model(hold, delay):
    structure = gbid.RotorBearing(delay=delay)
    rng, h = np.random.default_rng(1), 2e-4
    key = gbid.load_model("theisen2016").key_parameters(5.0, 6000.0)
    values = {q.name: key.get(q.name, 50.0 * rng.normal()) for q in structure.parameters} | {"tau_x": 3.3 * h}
    near = {
        **values,
        "k_xx": 0.9 * values["k_xx"],
        "tau_x": 3.6 * h,
    }  # the graphs hold near the values they are built at
    functions = gbid.structure.casadi_functions(structure, h, values=near, intersample=hold)
    assert functions.lags == (4 if delay == "exact" else 0)
    u, y = _signals(2, 2)
    model = evaluate(structure, values)
    simulated, predicted = _run(functions, u, y, [values[name] for name in functions.parameters])
    np.testing.assert_allclose(simulated, model.simulate(u, h, intersample=hold), rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(predicted, model.predict(u, y, h, intersample=hold), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_functions_of_a_nonlinear_structure_are_its_model(hold):
    u, y = _signals(1, 1)
    for structure, values, steps in ((DUFFING, DUFFING_TRUTH, 3), (SAME["nonlinear"], LINEAR_TRUTH, 16)):
        functions = gbid.structure.casadi_functions(structure, 0.05, intersample=hold, steps=steps)
        model = nonlinear_model(structure, values, steps=steps)
        simulated, predicted = _run(functions, u, y, [values[name] for name in functions.parameters])
        np.testing.assert_allclose(simulated, model.simulate(u, 0.05, intersample=hold), rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(predicted, model.predict(u, y, 0.05, intersample=hold), rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_functions_of_a_nonlinear_structure_with_exact_delays_are_its_model(hold):
    structure, h, (u, y) = gbid.RotorBearing(film="stiffening", delay="exact"), 2e-4, _signals(2, 2)
    key = gbid.load_model("theisen2016").key_parameters(5.0, 6000.0)
    values = {q.name: key.get(q.name, 1.0) for q in structure.parameters} | {"tau_x": 3.3 * h}
    functions = gbid.structure.casadi_functions(
        structure, h, values={**values, "tau_x": 3.6 * h}, intersample=hold, steps=2
    )
    model = nonlinear_model(equations_of(structure), values, steps=2)
    simulated, predicted = _run(functions, u, y, [values[name] for name in functions.parameters])
    np.testing.assert_allclose(simulated, model.simulate(u, h, intersample=hold), rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(predicted, model.predict(u, y, h, intersample=hold), rtol=1e-9, atol=1e-12)
    p = [values[q] for q in functions.parameters]
    now = functions.continuous(x=[0.1, 0.2, 0, 0], u=9.0, u_delayed=[0.3, 0.4], p=p)
    wanted = model.function([0.1, 0.2, 0, 0], [0.3, 0.4], model.parameters)[0]
    np.testing.assert_allclose(now["dx"], wanted, rtol=1e-12)


def test_continuous_functions_have_the_same_form_for_both_kinds():
    linear, other = (gbid.structure.casadi_functions(SAME[kind], 0.02) for kind in ("linear", "nonlinear"))
    p = np.array([*LINEAR_TRUTH.values()])
    for functions in (linear, other):
        made = functions.continuous(x=[0.1, 0.2], u=0.3, e=0.4, p=p)
        np.testing.assert_allclose(made["dx"], [[0.2 + 2.0 * 0.4], [-10.0 - 0.2 + 3.5 * 0.3 + 1.0 * 0.4]])
        assert float(made["y"]) == pytest.approx(0.5)
        at_rest = functions.continuous(x=[0.1, 0.2], u=0.3, p=p)  # what is left out is zero
        assert float(at_rest["y"]) == pytest.approx(0.1)
    assert gbid.structure.casadi_functions(DUFFING, 0.1).parameters == ("k", "d", "c")


def test_wrong_options_are_refused():
    with pytest.raises(UsageError, match="steps = 2: structure 'mass' is linear"):
        gbid.structure.casadi_functions(SAME["linear"], 0.02, steps=2)
    with pytest.raises(UsageError, match="no value for k_xx"):
        gbid.structure.casadi_functions(gbid.RotorBearing(), 1e-3)
    with pytest.raises(UsageError, match="values names unknown parameters: q"):
        gbid.structure.casadi_functions(DUFFING, 1e-3, values={"q": 1.0})
