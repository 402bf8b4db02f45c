"""Problem of a fit as functions of CasADi, extra cost, constraints and options of IPOPT."""

import casadi as ca
import numpy as np
import pytest
from nonlinear_cases import DUFFING, SAME, duffing_recording, mass_recording

import gbid
from gbid import LinearStructure, Parameter
from gbid.core.errors import UsageError


@pytest.fixture(scope="module")
def mass():
    return mass_recording(1, n=300)


@pytest.mark.parametrize("kind", ["linear", "nonlinear"])
def test_functions_are_those_of_casadis_own_derivatives(mass, kind):
    """Cost, gaps and derivatives against a graph that is built from the one-step predictor alone."""
    structure, window = SAME[kind], 100
    problem = gbid.identify.fit_problem(structure, mass, window=window)
    assert problem.names[:6] == ("k", "d", "b", "g1", "g2", f"mass 1[0].{'x' if kind == 'nonlinear' else 'x1'}")
    x = ca.MX.sym("x", len(problem.names))
    unscaled = x * ca.DM(problem.scale)
    p, starts = unscaled[:5], ca.reshape(unscaled[5:], 2, 3)
    u, y = mass.signal("u")[:, 0], mass.signal("y")[:, 0]
    step = gbid.structure.casadi_functions(structure, 0.02).predictor
    errors, gaps = [], []
    for k in range(3):
        rows = np.arange(k * window, (k + 1) * window)
        both = np.array([u[np.minimum(rows + 1, 299)], u[rows]]).T.reshape(1, -1)
        run = step.mapaccum(window)
        states, predicted = run(starts[:, k], both, y[rows][None], ca.repmat(p, 1, window))
        errors.append(y[rows] - predicted.T)
        if k < 2:
            gaps.append((states[:, -1] - starts[:, k + 1]) / problem.scale[5:7])
    e = ca.vertcat(*errors)
    floor = 1 + 1e-13  # of rounding, see Shooting
    cost, g = 0.5 * ca.log(ca.dot(e, e) / (300 * np.var(y))), ca.vertcat(*gaps)
    J = ca.jacobian(e, x)
    graph = ca.Function("f", [x], [cost, g, ca.gradient(cost, x), ca.jacobian(g, x), J.T @ J / ca.dot(e, e)])
    at = problem.start * (1 + 1e-3 * np.random.default_rng(0).normal(size=len(problem.names)))
    expected = [np.array(m, float) for m in graph(at)]
    results = [
        problem.cost(at),
        problem.constraints(at),
        problem.gradient(at),
        problem.jacobian(at),
        problem.hessian(at),
    ]
    for ours, theirs in zip(results, expected, strict=True):
        np.testing.assert_allclose(np.array(ours, float), theirs, rtol=2e-6, atol=2e-7 * np.abs(theirs).max() * floor)
    assert problem.sparsity["jacobian"].nnz() < 4 * 11


def test_nlpsol_solves_the_problem_as_the_fit_does():
    recording = duffing_recording(3, n=400)
    problem = gbid.identify.fit_problem(DUFFING, recording)
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9}}
    solver = ca.nlpsol("mine", "ipopt", problem.nlp, {**problem.functions.derivatives, **options})
    functions = problem.functions
    solution = solver(x0=problem.start, lbx=problem.lower, ubx=problem.upper, lbg=functions.lower, ubg=functions.upper)
    result = gbid.fit(DUFFING, recording)
    for name, value in problem.parameters(solution["x"]).items():
        assert value == pytest.approx(result.parameters[name], abs=1e-3 * result.std[name])


@pytest.mark.parametrize("window", ["auto", None])
def test_an_extra_cost_may_be_a_prior(mass, window):
    structure = SAME["linear"]
    prior = gbid.fit(structure, mass, prior={"d": (1.5, 0.02)}, window=window)
    free = gbid.fit(structure, mass, window=window)
    same = gbid.fit(structure, mass, extra_cost=lambda p, x0: ((p.d - 1.5) / 0.02) ** 2 / 2, window=window)
    assert same.success
    assert abs(prior.parameters["d"] - free.parameters["d"]) > 2 * prior.std["d"]
    for name in prior.free:
        assert same.parameters[name] == pytest.approx(prior.parameters[name], abs=1e-3 * prior.std[name])
        assert same.std[name] == pytest.approx(prior.std[name], rel=1e-5)


def test_an_equation_between_parameters_is_a_structure_with_one_less(mass):
    less = LinearStructure(
        "mass",
        [Parameter("d", 1.2), Parameter("b", 3.0), Parameter("g1", 0.5), Parameter("g2", 1.0)],
        lambda p: {"A": [[0, 1], [-90 * p.d, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]], "K": [[p.g1], [p.g2]]},
        intersample="foh",
    )
    expected = gbid.fit(less, mass, window=None)
    result = gbid.fit(SAME["linear"], mass, window=None, constraints=lambda p, x0: [(0, p.k / p.d - 90, 0)])
    assert result.success
    assert result.parameters["k"] == pytest.approx(90 * result.parameters["d"], rel=1e-7)
    for name in expected.free:
        assert result.parameters[name] == pytest.approx(expected.parameters[name], abs=2e-3 * expected.std[name])
        assert result.std[name] == pytest.approx(expected.std[name], rel=2e-3)
    assert result.std["k"] == pytest.approx(90 * result.std["d"], rel=1e-6)


def test_constraints_on_initial_states_and_bounds():
    """Two releases from one unknown position, which the recordings share; an inequality that holds is not felt."""
    records = [duffing_recording(seed, n=200) for seed in (1, 2)]
    a, b = (record.name for record in records)

    def same_start(p, x0):
        return [(0, x0[a][0] - x0[b][0], 0), (0.0, p.k, 50.0), (0.5, p.c, 9.0)]

    free = gbid.fit(DUFFING, records)
    result = gbid.fit(DUFFING, records, constraints=same_start)
    x0 = result.initial_states
    assert result.success
    assert abs(free.initial_states[0, 0] - free.initial_states[1, 0]) > 1e-4
    assert x0[0, 0] == pytest.approx(x0[1, 0], abs=1e-8)
    held = gbid.fit(DUFFING, records[0], constraints=lambda p, x0: [(0.6, p.c, 1.0)])
    assert held.parameters["c"] == pytest.approx(0.6, abs=1e-6)
    assert any("the constraint c is active" in note for note in held.notes)
    impossible = gbid.fit(
        DUFFING, records[0], constraints=lambda p, x0: [(4, p.c, 9), (0, p.c, 2)], window=None, max_iterations=20
    )
    assert not impossible.success
    assert any("is not met" in note for note in impossible.notes)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"extra_cost": 3.0}, "extra_cost = 3.0; give a function"),
        ({"extra_cost": lambda p, x0: p.q}, "no parameter 'q'"),
        ({"extra_cost": lambda p, x0: [p.k]}, "is list, which is no CasADi expression"),
        ({"extra_cost": lambda p, x0: x0["duffing 3"]}, r"has shape \(2, 1\)"),
        ({"constraints": lambda p, x0: [p.k]}, r"give \(lower, expression, upper\)"),
        ({"constraints": lambda p, x0: [(3, p.k, 2)]}, "lower bound 3 is above the upper bound 2"),
        ({"constraints": lambda p, x0: [(3, ca.SX.sym("w") + p.k, 4)]}, "no unknowns of the fit: w"),
        ({"ipopt": {"no_such": 1}}, "ipopt = .*no_such"),
    ],
)
def test_what_is_wrong_is_named(options, text):
    with pytest.raises(UsageError, match=text):
        gbid.fit(DUFFING, duffing_recording(3, n=100), **options)


def test_options_of_ipopt_replace_those_of_the_fit(mass):
    result = gbid.fit(SAME["linear"], mass, window=None, ipopt={"max_iter": 1})
    assert result.iterations <= 2
    assert not result.success


@pytest.mark.parametrize(
    "options", [{"criterion": "trace", "output_weights": (1.0, 9.0)}, {"criterion": "det"}], ids=str
)
def test_cost_and_derivatives_of_two_outputs_are_those_of_the_criterion(options):
    """By hand: half the logarithm of the weighted trace, or of the determinant; gradient by differences; J' W J."""
    u = np.sign(np.sin(0.37 * np.arange(200) ** 1.3))
    y = np.column_stack([u, 0.3 * np.roll(u, 1)]) + 0.1 * np.random.default_rng(1).standard_normal((200, 2))
    gains = [Parameter("a", 0.8), Parameter("b", 0.2)]
    matrices = {"A": [[-1.0]], "B": [[1.0]], "C": [[0.0], [0.0]]}
    structure = LinearStructure(
        "gains", gains, lambda p: {**matrices, "D": [[p.a], [p.b]]}, inputs="u", outputs="y", intersample="zoh"
    )
    problem = gbid.identify.fit_problem(
        structure, gbid.Recording({"u": u, "y": y}, 0.1, name="two"), window=200, **options
    )
    free = [problem.names.index(name) for name in "ab"]

    def errors(x):
        return y - np.outer(u, (np.array(x) * problem.scale)[free])

    def cost(x):
        e, power = errors(x), (y - y.mean(axis=0)).var(axis=0)
        if options["criterion"] == "trace":
            w = np.array(options["output_weights"])
            return 0.5 * np.log((w * (e**2).sum(axis=0)).sum() / (w * power).sum())
        return 0.5 * np.linalg.slogdet(e.T @ e)[1]

    at = np.array(problem.start)
    steps = 1e-6 * np.eye(len(at))[free]
    slopes = [(cost(at + h) - cost(at - h)) / 2e-6 for h in steps]
    np.testing.assert_allclose(np.array(problem.gradient(at), float).ravel()[free], slopes, rtol=1e-5, atol=1e-8)
    shifted = at + 0.1 * np.eye(len(at))[free[0]]
    assert float(problem.cost(shifted) - problem.cost(at)) == pytest.approx(cost(shifted) - cost(at), rel=1e-6)
    e = errors(at)
    J = [np.outer(u, np.eye(2)[i]) * problem.scale[free[i]] for i in (0, 1)]
    W = np.linalg.inv(e.T @ e)
    if options["criterion"] == "trace":
        w = np.array(options["output_weights"])
        W = np.diag(w) / (w * (e**2).sum(axis=0)).sum()
    hessian = np.array(problem.hessian(at), float)
    hessian = np.triu(hessian) + np.triu(hessian, 1).T
    expected = [[(a @ W * b).sum() for b in J] for a in J]
    np.testing.assert_allclose(hessian[np.ix_(free, free)], expected, rtol=1e-6)


def test_phases_tell_windows_and_gaps(mass):
    """Two states: each of two links has two gaps; the five parameters and the states of each window are unknown."""
    result, single = (gbid.fit(SAME["linear"], mass, window=window) for window in (100, None))
    sizes = [[(q.windows, q.gaps, q.unknowns) for q in computed.phases] for computed in (result, single)]
    assert [size[0] for size in sizes] == [(3, 4, 5 + 3 * 2), (1, 0, 5 + 2)]
    assert {q for size in sizes for q in size[1:]} <= {(1, 0, 5 + 2)}
    for computed in (result, single):
        assert sum(phase.iterations for phase in computed.phases) == computed.iterations
