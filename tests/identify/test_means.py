"""Means of outputs that the inputs do not explain: the fit names them with the remedy."""

import casadi as ca
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from gbid import LinearStructure, Parameter, Recording, RotorBearing, fit

H, N = 1e-3, 2500
TRUE = {"k_xx": -6e5, "k_xy": -1e4, "k_yx": 1.2e4, "k_yy": -5e5, "d_xx": -120.0, "d_yy": -100.0}


def rotor(mean=(0.0, 0.0), *, seed=0, noise=3e-8, memory=0.0):
    """A rotor on its bearing by the matrices of scipy, with sensors that have an offset [m]; noise of a first order."""
    rng = np.random.default_rng(seed)
    K = np.array([[TRUE["k_xx"], TRUE["k_xy"]], [TRUE["k_yx"], TRUE["k_yy"]]])
    D = np.array([[TRUE["d_xx"], -20.0], [20.0, TRUE["d_yy"]]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]])
    B = np.vstack([np.zeros((2, 2)), np.diag([3e5, 3.2e5])])
    F, G, *_ = cont2discrete((A, B, np.eye(4), np.zeros((4, 2))), H)
    u = np.repeat(rng.choice([-4e-6, 4e-6], (N // 20, 2)), 20, axis=0)
    x, p = np.zeros(4), np.empty((N, 2))
    for i in range(N):
        p[i] = x[:2]
        x = F @ x + G @ u[i]
    e = lfilter([np.sqrt(1 - memory**2)], [1.0, -memory], rng.standard_normal(p.shape), axis=0)
    return Recording({"u": u, "p": p + noise * e + mean}, H, name="rotor")


def fitted(record, **options):
    return fit(RotorBearing(), record, intersample="zoh", fixed={"tau_x": 0.0, "tau_y": 0.0}, **options)


@pytest.mark.parametrize("focus", ["prediction", "simulation"])
@pytest.mark.parametrize("mean", [(3e-7, -2e-7), (3e-6, -2e-6), (3e-5, -2e-5)])
def test_a_mean_that_was_not_removed_is_named_with_the_remedy(mean, focus):
    """The second and third mean disappear in the residuals of a prediction: the stiffness is wrong by half instead."""
    result = fitted(rotor(mean), focus=focus)
    (note,) = (note for note in result.notes if "GB130" in note)
    assert note.startswith("outputs have means that the inputs do not explain (offset_p_x, offset_p_y)")
    assert "trend='offset'" in note
    remedied = fitted(rotor(mean), focus=focus, trend="offset")
    assert remedied.success
    assert not any("GB130" in note or "GB106" in note for note in remedied.notes)
    assert remedied.iterations <= result.iterations
    for name, true in TRUE.items():
        assert abs(remedied.parameters[name] - true) < 4.5 * remedied.std[name]
    for axis, offset in zip("xy", mean, strict=True):
        assert abs(remedied.parameters[f"offset_p_{axis}"] - offset) < 4.5 * remedied.std[f"offset_p_{axis}"]


@pytest.mark.parametrize("seed", range(3))
def test_coloured_noise_without_a_mean_is_not_taken_for_one(seed):
    """The mean of slow noise is not zero in a record; its standard deviation says that it may be."""
    result = fitted(rotor(seed=seed, noise=3e-7, memory=0.95), focus="simulation")
    assert any("GB106" in note for note in result.notes)
    assert not any("GB130" in note for note in result.notes)


def test_a_mean_of_the_inputs_explains_one_of_the_outputs():
    record = rotor()
    G = np.linalg.solve(-np.array([[TRUE["k_xx"], TRUE["k_xy"]], [TRUE["k_yx"], TRUE["k_yy"]]]), np.diag([3e5, 3.2e5]))
    lifted = {"u": record.signal("u") + 5e-6, "p": record.signal("p") + G @ [5e-6, 5e-6]}
    result = fitted(Recording(lifted, H, name="lifted"))
    assert result.success
    assert not any("GB130" in note for note in result.notes)


def test_a_structure_with_an_offset_of_its_own_has_no_note():
    def matrices(p):
        A = ca.vertcat(ca.horzcat(0, 1, 0), ca.horzcat(-p["k"], -p["d"], 0), ca.horzcat(0, 0, -1e-9))
        return {"A": A, "B": ca.vertcat(0, p["g"], 0), "C": ca.horzcat(1, 0, 1)}

    rng, n = np.random.default_rng(0), 1500
    F, G, *_ = cont2discrete(
        (np.array([[0.0, 1.0], [-400.0, -2.0]]), np.array([[0.0], [50.0]]), np.eye(2), np.zeros((2, 1))), 0.01
    )
    u, x, y = np.repeat(rng.choice([-1.0, 1.0], n // 10), 10), np.zeros(2), np.empty(n)
    for i in range(n):
        y[i] = x[0]
        x = F @ x + G[:, 0] * u[i]
    slow = lfilter([0.3], [1.0, -0.9], rng.standard_normal(n))
    record = Recording({"u": u[:, None], "y": (y + 0.7 + 0.02 * slow)[:, None]}, 0.01, name="own")
    parameters = [Parameter("k", 300.0), Parameter("d", 1.0), Parameter("g", 40.0)]
    structure = LinearStructure("with offset", parameters, matrices, ["u"], ["y"])
    result = fit(structure, record, focus="simulation")
    assert abs(result.parameters["k"] - 400.0) < 4.5 * result.std["k"]
    assert not any("GB130" in note for note in result.notes)
