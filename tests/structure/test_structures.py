"""The paper's structures against its equations, and a user's own against wrong input."""

import math

import casadi as ca
import numpy as np
import pytest

from gbid.core.errors import UsageError
from gbid.lpv import load_model
from gbid.structure import (
    KEY_PARAMETERS,
    LinearStructure,
    Parameter,
    PiezoPair,
    Plant,
    RotorBearing,
    Values,
    evaluate,
    load_structure,
    scheduled,
)
from gbid.structure.delay import pade_delay
from gbid.structure.linear import as_names, symbolic_matrices

FREQUENCIES = np.array([0.0, 20.0, 126.6, 400.0, 1500.0])
ACTUATORS = {"p1_x": 3078.0, "p2_x": 8143.0, "kappa_x": 1.863, "p1_y": 2452.0, "p2_y": 6494.0, "kappa_y": 1.865}
GAINS = {"bd_xx": 11.0, "bd_xy": 12.0, "bd_yx": 13.0, "bd_yy": 14.0}
KEY = load_model("theisen2016").key_parameters(5.0, 6000.0)


def square(letter):
    return np.array([[KEY[f"{letter}_xx"], KEY[f"{letter}_xy"]], [KEY[f"{letter}_yx"], KEY[f"{letter}_yy"]]])


def arm(p):
    return {"A": [[0, 1], [0, -p.b1]], "B": [[0], [p.K2]], "C": [[1, 0]]}


ARM = [Parameter("b1", 1.0), Parameter("K2", 1.0)]


# ---- rotor-bearing ----


@pytest.mark.parametrize("order", [1, 2, 4])
def test_rotor_bearing_has_the_transfer_function_of_equations_5_to_9(order):
    model = evaluate(RotorBearing(pade_order=order), {**KEY, **GAINS})
    assert model.n_states == 4 + 2 * order
    K, D, B = square("k"), square("d"), square("b")
    for s, computed in zip(2j * np.pi * FREQUENCIES, model.frequency_response(FREQUENCIES), strict=True):
        delays = []
        for tau in (KEY["tau_x"], KEY["tau_y"]):
            a, b, c, d = (np.array(ca.DM(m)) for m in pade_delay(tau, order)[:4])
            delays.append((c @ np.linalg.solve(s * np.eye(order) - a, b) + d)[0, 0])
        expected = np.linalg.solve(s**2 * np.eye(2) - s * D - K, B @ np.diag(delays))
        np.testing.assert_allclose(computed, expected, rtol=1e-9)
    np.testing.assert_allclose(model.static_gain(), -np.linalg.solve(K, B), rtol=1e-9)


def test_rotor_bearing_parameters():
    bearing = RotorBearing()
    names = [q.name for q in bearing.parameters]
    assert tuple(names[:14]) == KEY_PARAMETERS
    assert names[14:] == ["bd_xx", "bd_xy", "bd_yx", "bd_yy"]
    assert all(q.lower > 0 for q in bearing.parameters if q.name.startswith("tau"))
    units = {q.name: q.unit for q in bearing.parameters}
    assert (units["k_xy"], units["d_xx"], units["b_yy"], units["tau_x"]) == (
        "N/(kg m)",
        "N s/(kg m)",
        "N/(kg m)",
        "s",
    )
    assert (bearing.inputs, bearing.outputs, bearing.intersample) == (("u",), ("p",), "foh")


def test_disturbance_gain_choices():
    diagonal = RotorBearing(disturbance_gain="diagonal")
    assert [q.name for q in diagonal.parameters[14:]] == ["bd_xx", "bd_yy"]
    model = evaluate(diagonal, {**KEY, "bd_xx": 3.0, "bd_yy": 4.0})
    np.testing.assert_array_equal(model.K[2:4], np.diag([3.0, 4.0]))
    none = RotorBearing(disturbance_gain="none")
    assert len(none.parameters) == 14
    assert evaluate(none, KEY).K is None
    assert symbolic_matrices(none)[1].K.nnz() == 0


def test_equal_built_in_structures_share_their_matrices_and_those_of_a_user_are_made_each_time():
    """A user's function may return something else the next time, and a list of names has no hash."""
    first, again = (symbolic_matrices(RotorBearing(pade_order=1, name="twice")) for _ in range(2))
    assert again[1] is first[1]
    assert symbolic_matrices(RotorBearing(pade_order=2, name="twice"))[1] is not first[1]
    assert symbolic_matrices(RotorBearing(inputs=["u"]))[1].A.shape == (4, 4)
    size = [1]

    def matrices(p):
        return {"A": -p.b1 * np.eye(size[0]), "C": np.eye(1, size[0])}

    mine = LinearStructure("mine", ARM, matrices, ())
    assert symbolic_matrices(mine)[1].A.shape == (1, 1)
    size[0] = 2
    assert symbolic_matrices(mine)[1].A.shape == (2, 2)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: RotorBearing(pade_order=0), "pade_order = 0; give a whole number of at least 1 or None"),
        (lambda: RotorBearing(disturbance_gain="half"), "disturbance_gain = 'half'; choose 'full', 'diagonal'"),
        (lambda: PiezoPair(disturbance_gain="diagonal"), "disturbance_gain = 'diagonal'; choose 'none' or 'full'"),
        (lambda: Plant(outputs=("u",)), r"outputs = \('u',\); choose"),
        (lambda: Plant(outputs=("p", "u")), "choose"),
        (lambda: Plant(actuators=PiezoPair(disturbance_gain="full")), "must be 'none' in series"),
    ],
)
def test_wrong_options_of_the_papers_structures(make, text):
    with pytest.raises(UsageError, match=text):
        make()


# ---- actuators and series ----


def test_piezo_pair_is_equation_12():
    model = evaluate(PiezoPair(), ACTUATORS)
    for s, computed in zip(2j * np.pi * FREQUENCIES, model.frequency_response(FREQUENCIES), strict=True):
        axis = {
            a: ACTUATORS[f"kappa_{a}"] / ((s / ACTUATORS[f"p1_{a}"] + 1) * (s / ACTUATORS[f"p2_{a}"] + 1)) for a in "xy"
        }
        np.testing.assert_allclose(computed, np.diag([axis["x"], axis["y"]]), rtol=1e-12)
    np.testing.assert_allclose(np.sort(model.poles().real), [-8143, -6494, -3078, -2452], rtol=1e-12)
    assert model.K is None
    assert [q.name for q in PiezoPair().parameters] == list(ACTUATORS)


def test_piezo_pair_with_a_disturbance_gain_drives_its_own_axis():
    gains = {"bd1_x": 1.0, "bd2_x": 2.0, "bd1_y": 3.0, "bd2_y": 4.0}
    model = evaluate(PiezoPair(disturbance_gain="full"), {**ACTUATORS, **gains})
    np.testing.assert_array_equal(model.K, [[1, 0], [2, 0], [0, 3], [0, 4]])


@pytest.mark.parametrize("outputs", [("u", "p"), ("p",), "p"])
@pytest.mark.parametrize("order", [1, 3, None])
def test_plant_is_the_series_of_both(outputs, order):
    """Also without an approximation of the delays, where u as an output needs the actuators twice."""
    bearing = RotorBearing(pade_order=order) if order else RotorBearing(delay="exact")
    plant = Plant(bearing, outputs=outputs)
    model = evaluate(plant, {**ACTUATORS, **KEY, **GAINS})
    actuators = evaluate(PiezoPair(), ACTUATORS).frequency_response(FREQUENCIES)
    series = evaluate(bearing, {**KEY, **GAINS}).frequency_response(FREQUENCIES) @ actuators
    expected = np.concatenate([actuators, series], axis=1) if "u" in outputs else series
    response = model.frequency_response(FREQUENCIES)
    np.testing.assert_allclose(response, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    # Only the error of the disc position drives the rotor's velocities.
    twice = 4 if "u" in outputs and not order else 0
    K = np.zeros((8 + 2 * (order or 0) + twice, 4 if "u" in outputs else 2))
    K[twice + 6 : twice + 8, -2:] = [[11, 12], [13, 14]]
    np.testing.assert_array_equal(model.K, K)
    assert not model.D.any()
    assert [q.name for q in plant.parameters] == [*ACTUATORS, *KEY_PARAMETERS, *GAINS]


# ---- a structure of one's own ----


def test_linear_structure_takes_lists_arrays_and_casadi():
    forms = [
        arm,
        lambda p: {
            "A": ca.vertcat(ca.horzcat(0, 1), ca.horzcat(0, -p["b1"])),
            "B": ca.vertcat(0, p["K2"]),
            "C": np.array([[1.0, 0.0]]),
        },
        lambda p: {"A": ca.blockcat([[0, 1], [0, -p.b1]]), "B": [0, p.K2], "C": ca.DM([[1, 0]]), "D": 0, "K": [0, 0]},
    ]
    forms += [
        lambda p: {"A": np.array([[0, 1], [0, -p.b1]]), "B": np.array([0, p.K2]), "C": np.array([1, 0])},
        lambda p: {**arm(p), "A": np.diag([1, p.K2]) @ np.array([[0, 1], [0, -p.b1 / p.K2]])},
    ]
    for form in forms:
        model = evaluate(LinearStructure("arm", ARM, form), {"b1": 3.0, "K2": -5.0})
        np.testing.assert_array_equal(model.A, [[0, 1], [0, -3]])
        np.testing.assert_array_equal(model.B, [[0], [-5]])
        np.testing.assert_array_equal(model.C, [[1, 0]])
        np.testing.assert_array_equal(model.D, [[0]])
        assert model.K is None


def test_linear_structure_defaults():
    structure = LinearStructure("arm", ARM, arm)
    assert (structure.inputs, structure.outputs, structure.intersample) == (("u",), ("y",), "zoh")
    assert as_names("p.x") == ("p.x",)
    assert as_names(["a", "b"]) == ("a", "b")
    assert LinearStructure("arm", ARM, arm, inputs=["r.x", "r.y"], outputs="p").inputs == ("r.x", "r.y")


STRAY = ca.SX.sym("stray")


def filled_entry_by_entry(p):
    A = np.zeros((2, 2))
    A[0, 1], A[1, 1] = 1, -p.b1
    return A


@pytest.mark.parametrize(
    ("matrices", "text"),
    [
        (lambda p: {"A": [[0, 1]], "B": [[1]], "C": [[1]]}, r"A has shape \(1, 2\), expected \(1, 1\)"),
        (lambda p: {"A": [[0]], "B": [[1], [2]], "C": [[1]]}, r"B has shape \(2, 1\), expected \(1, 1\)"),
        (lambda p: {"A": [[0]], "B": [[1]], "C": [[1, 2]]}, r"C has shape \(1, 2\), expected \(1, 1\)"),
        (lambda p: {"A": [[0]], "B": [[1]], "C": [[1]], "D": [[1, 1]]}, r"D has shape \(1, 2\), expected \(1, 1\)"),
        (lambda p: {"A": [[0]], "B": [[1]], "C": [[1]], "K": [[1], [1]]}, r"K has shape \(2, 1\), expected \(1, 1\)"),
        (lambda p: {"B": [[1]], "C": [[1]]}, "B, D, K, x0, and B_delayed with delay; got B, C"),
        (lambda p: {}, "got nothing"),
        (lambda p: {**arm(p), "delay": [1]}, "and B_delayed with delay; got A, B, C, delay"),
        (lambda p: {**arm(p), "E": [[1]]}, "got A, B, C, E"),
        (lambda p: {**arm(p), "B": [[0], [STRAY]]}, "B contains symbols that are not parameters: stray"),
        (lambda p: {**arm(p), "A": [[0, 1], [0]]}, "A is not a matrix"),
        (lambda p: {**arm(p), "A": "zero"}, "A is not a matrix"),
        (lambda p: {**arm(p), "A": [[p.b2]]}, "no parameter 'b2'; choose from b1, K2"),
        (lambda p: {**arm(p), "A": [[p["b2"]]]}, "KeyError: 'b2'"),
        (lambda p: None, r"matrices\(p\) failed: TypeError"),
        (
            lambda p: {**arm(p), "A": [[0, 1], [0, 1 - math.sqrt(p.b1)]]},
            r"A\[1, 1\] is nan: .*casadi.sqrt for math.sqrt",
        ),
        (lambda p: {**arm(p), "B": [[0], [float(p.K2)]]}, r"B\[1, 0\] is nan: a parameter lost its symbol"),
        (lambda p: {**arm(p), "A": filled_entry_by_entry(p)}, r"A\[1, 1\] is nan: .*casadi.SX.zeros\(n, m\)"),
        (lambda p: {**arm(p), "A": [[0, 1], [0, -max(p.b1, 0)]]}, "truth value .*casadi.fmax for max, casadi.if_else"),
    ],
)
def test_wrong_matrices_are_refused_in_one_line(matrices, text):
    with pytest.raises(UsageError, match=text) as caught:
        symbolic_matrices(LinearStructure("mine", ARM, matrices))
    assert str(caught.value).startswith("structure 'mine': ")
    assert "\n" not in str(caught.value)


def test_a_symbol_of_ones_own_with_a_parameters_name_is_foreign():
    impostor = ca.SX.sym("b1")
    with pytest.raises(UsageError, match="A contains symbols that are not parameters: b1"):
        symbolic_matrices(LinearStructure("mine", ARM, lambda p: {**arm(p), "A": [[0, 1], [0, -impostor]]}))


def test_wrong_lists_of_parameters_and_outputs():
    with pytest.raises(UsageError, match="structure 'arm': parameter 'b1' is listed more than once"):
        LinearStructure("arm", [*ARM, Parameter("b1", 2.0)], arm)
    with pytest.raises(UsageError, match="structure 'arm': no outputs"):
        LinearStructure("arm", ARM, arm, outputs=())
    with pytest.raises(UsageError, match="no value for K2"):
        evaluate(LinearStructure("arm", ARM, arm), {"b1": 1.0})
    with pytest.raises(UsageError, match="A holds entries that are not finite"):
        evaluate(LinearStructure("arm", ARM, arm), {"b1": np.inf, "K2": 1.0})


# ---- parameters and values ----


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"name": "k xx"}, "parameter 'k xx': the name must be a Python identifier"),
        ({"name": "k", "lower": 2.0, "upper": 1.0}, "lower = 2.0 must be below upper = 1.0"),
        ({"name": "k", "lower": 1.0, "upper": 1.0}, "must be below"),
        ({"name": "k", "lower": np.nan}, "lower = nan"),
        ({"name": "k", "fixed": True}, "fixed without a value; give start"),
        ({"name": "k", "start": np.nan}, "start = nan is not finite"),
        ({"name": "k", "start": np.inf}, "start = inf is not finite"),
        ({"name": "k", "start": 3.0, "upper": 2.0}, r"start = 3 lies outside its bounds \[-inf, 2\]"),
    ],
)
def test_wrong_parameters(arguments, text):
    with pytest.raises(UsageError, match=text):
        Parameter(**arguments)


def test_values_by_key_and_attribute():
    p = Values.of((Parameter("tau"), Parameter("k")), [1.5, 2.5])
    assert (p.tau, p["tau"], p.k) == (1.5, 1.5, 2.5)
    assert p.get("none", 0) == 0
    with pytest.raises(AttributeError, match="no parameter 'd'; choose from tau, k"):
        p.d  # noqa: B018


# ---- from a file ----

FILE = """
import gbid

def matrices(p):
    return {"A": [[-p.a]], "B": [[1]], "C": [[1]]}

structure = gbid.LinearStructure("lag", [gbid.Parameter("a", 1.0)], matrices)

def make():
    return structure

def fails():
    raise RuntimeError("no luck")

number = 3
wrong = gbid.LinearStructure("wrong", [gbid.Parameter("a", 1.0)], lambda p: {"A": [[p.a, 1]], "B": [[1]], "C": [[1]]})
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "lag.py").write_text(FILE)
    (tmp_path / "broken.py").write_text("def f(:\n")
    (tmp_path / "needs.py").write_text("import no_such_module_anywhere\n")
    return tmp_path


@pytest.mark.parametrize("name", ["structure", "make"])
def test_load_structure(folder, name):
    structure = load_structure(f"lag.py:{name}", folder)
    assert structure.name == "lag"
    np.testing.assert_array_equal(evaluate(structure, {"a": 4.0}).A, [[-4.0]])
    assert load_structure(f"{folder / 'lag.py'}:{name}").name == "lag"


@pytest.mark.parametrize(
    ("reference", "text"),
    [
        ("lag.py", "structure 'lag.py': write it as file.py:name"),
        ("lag:structure", "write it as file.py:name"),
        ("other.py:structure", "no file .*other.py"),
        ("broken.py:structure", "broken.py: import failed: SyntaxError"),
        ("needs.py:structure", "needs.py: import failed: ModuleNotFoundError"),
        ("lag.py:structures", "lag.py: no name 'structures' in this file"),
        ("lag.py:number", "lag.py: number is not a structure; make it a gbid.LinearStructure"),
        ("lag.py:fails", r"lag.py: fails\(\) failed: RuntimeError: no luck"),
        ("lag.py:matrices", r"lag.py: matrices\(\) failed: TypeError"),
        ("lag.py:wrong", r"lag.py: structure 'wrong': A has shape \(1, 2\), expected \(1, 1\)"),
    ],
)
def test_load_structure_refuses(folder, reference, text):
    with pytest.raises(UsageError, match=text) as caught:
        load_structure(reference, folder)
    assert "\n" not in str(caught.value)


def test_unbalance_is_a_rotating_acceleration_of_the_disc():
    """B of (cos phi, sin phi) is [[c, -s], [s, c]] in the rows of the velocities; these inputs have no delay."""
    structure = RotorBearing(unbalance=True)
    values = {parameter.name: 1.0 + k for k, parameter in enumerate(structure.parameters)}
    parts = structure.matrices(values)
    B, B_delayed, D, delay = (np.array(ca.evalf(parts[key])) for key in ("B", "B_delayed", "D", "delay"))
    c, s = values["e_cos"], values["e_sin"]
    assert np.array_equal(B, np.block([[np.zeros((2, 4))], [np.zeros((2, 2)), np.array([[c, -s], [s, c]])]]))
    assert B_delayed.shape == (4, 4)
    assert not B_delayed[:, 2:].any()
    assert not D.any()
    assert D.shape == (2, 4)
    assert delay.ravel().tolist() == [values["tau_x"], values["tau_y"], 0.0, 0.0]


def test_a_schedule_has_the_key_parameters_or_those_that_start_off_zero():
    assert scheduled(RotorBearing(), "pressure_bar").scheduling == ("pressure_bar",)
    assert scheduled(RotorBearing(), ("pressure_bar", "speed_rpm")).surfaces == KEY_PARAMETERS
    free = [Parameter("a", 1.0), Parameter("e", 0.0)]
    lag = LinearStructure("lag", free, lambda p: {"A": [[p.e - p.a]], "B": [[1]], "C": [[1]]}, "u", "y")
    assert scheduled(lag, "speed_rpm").surfaces == ("a",)
    for wrong in ((), ("speed_rpm", "speed_rpm")):
        with pytest.raises(UsageError, match="each variable once"):
            scheduled(lag, wrong)
