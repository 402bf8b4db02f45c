"""Rotors of ROSS as structures, and identified bearings as elements of ROSS."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from experiment_files import gbid as run
from scipy.linalg import expm

import gbid
from gbid.core.errors import UsageError
from gbid.export.ross import bearing_element, ross_package
from gbid.structure import evaluate

pytestmark = pytest.mark.skipif(
    find_spec("ross") is None, reason="ross-rotordynamics is not installed: pip install 'gbid[ross]'"
)
MODEL = gbid.load_model("theisen2016")
SENSORS = [(0, "x"), (0, "y"), (6, "x"), (6, "y")]
ACTUATORS = [(2, "x"), (2, "y")]
EYE = np.eye(2)


def rotor(left_k=1e6 * EYE, left_c=0 * EYE, right_k=1e6 * EYE, right_c=0 * EYE):
    """The rotor of Friswell et al. 2010, Dynamics of Rotating Machines, Example 5.9.1 (p. 206), on other bearings."""
    ross = ross_package("these tests")  # not before: its import takes seconds
    steel = ross.Material(name="steel", rho=7810, E=211e9, G_s=81.2e9)
    shaft = [ross.ShaftElement(0.25, 0.0, 0.05, material=steel) for _ in range(6)]
    discs = [
        ross.DiskElement.from_geometry(n=n, material=steel, width=0.07, i_d=0.05, o_d=diameter)
        for n, diameter in ((2, 0.28), (4, 0.35))
    ]
    bearings = []
    for n, tag, k, c in ((0, "left", left_k, left_c), (6, "right", right_k, right_c)):
        named = {
            f"{w}{a}{b}": float(m[i, j])
            for w, m in (("k", k), ("c", c))
            for i, a in enumerate("xy")
            for j, b in enumerate("xy")
        }
        bearings.append(ross.BearingElement(n=n, tag=tag, **named))
    return ross.Rotor(shaft, discs, bearings)


TRUE = {
    "left_k": np.array([[1.0e6, 1.5e5], [-1.2e5, 0.8e6]]),
    "left_c": np.array([[900.0, 40.0], [-30.0, 1100.0]]),
    "right_k": np.array([[1.3e6, -0.8e5], [1.0e5, 1.1e6]]),
    "right_c": np.array([[1500.0, -50.0], [60.0, 1300.0]]),
}
START = {
    key: np.diag(np.diag(value)) * factor
    for (key, value), factor in zip(TRUE.items(), (0.8, 0.7, 1.25, 1.3), strict=True)
}


def lateral(machine, omega):
    """State matrix, mass and places of the whole finite-element model without axial and torsional motion."""
    n, per = machine.ndof, machine.number_dof
    keep = [i for i in range(n) if i % per in (0, 1, 3, 4)]
    both = [*keep, *(n + i for i in keep)]
    return (
        machine.A(omega)[np.ix_(both, both)],
        machine.M(omega)[np.ix_(keep, keep)],
        {dof: k for k, dof in enumerate(keep)},
    )


def whole_model(machine, speed_rpm, force, step):
    """Positions at the sensors from all degrees of freedom, for held forces."""
    A, M, at = lateral(machine, speed_rpm * np.pi / 30)
    n = len(M)
    places = np.zeros((n, 2))
    for i, (node, axis) in enumerate(ACTUATORS):
        places[at[machine.number_dof * node + "xy".index(axis)], i] = 1.0
    B = np.vstack([np.zeros((n, 2)), np.linalg.solve(M, places)])
    both = expm(step * np.block([[A, B], [np.zeros((2, 2 * n + 2))]]))
    rows = [at[machine.number_dof * node + "xy".index(axis)] for node, axis in SENSORS]
    x, p = np.zeros(2 * n), np.zeros((len(force), len(rows)))
    for k, f in enumerate(force):
        p[k] = x[rows]
        x = both[: 2 * n, : 2 * n] @ x + both[: 2 * n, 2 * n :] @ f
    return p


def natural(structure):
    model = evaluate(structure, {parameter.name: parameter.start for parameter in structure.parameters})
    return np.sort(np.abs(model.poles()))[::2][:6]


@pytest.mark.parametrize(
    ("speed_rpm", "published"),
    [(0, [86.66, 86.66, 274.31, 274.31, 716.78, 716.78]), (4000, [85.39, 87.80, 251.78, 294.71, 600.18, 827.08])],
)
def test_natural_frequencies_of_a_published_rotor(speed_rpm, published):
    # published: as ROSS compares itself with the book, rad/s, to 0.1 %
    machine = rotor()
    structure = gbid.export.from_ross(machine, sensors=SENSORS, actuators=ACTUATORS, speed_rpm=speed_rpm)
    frequencies = natural(structure)
    np.testing.assert_allclose(frequencies, published, rtol=1e-3)
    complete, _, _ = lateral(machine, speed_rpm * np.pi / 30)
    np.testing.assert_allclose(frequencies, np.sort(np.abs(np.linalg.eigvals(complete)))[::2][:6], rtol=1e-5)


def test_more_modes_come_closer_and_all_of_them_are_exact():
    machine = rotor(**TRUE)
    complete = np.sort(np.abs(np.linalg.eigvals(lateral(machine, 300.0)[0])))[::2][:6]
    off = []
    for modes in (3, 6, 12, 28):
        structure = gbid.export.from_ross(
            machine, sensors=SENSORS, actuators=ACTUATORS, speed_rpm=300.0 * 30 / np.pi, modes=modes
        )
        off.append(np.abs(natural(structure) / complete - 1).max())
    assert off[0] > off[1] > off[2]
    assert off[3] < 1e-8


def test_the_response_is_that_of_the_whole_model():
    force = 20.0 * np.repeat(np.random.default_rng(3).choice([-1.0, 1.0], (150, 2)), 4, axis=0)
    machine, off = rotor(**TRUE), []
    expected = whole_model(machine, 3000, force, 1e-3)
    for modes in (8, 16):
        structure = gbid.export.from_ross(machine, sensors=SENSORS, actuators=ACTUATORS, speed_rpm=3000, modes=modes)
        model = evaluate(structure, {parameter.name: parameter.start for parameter in structure.parameters})
        off.append(np.abs(model.simulate(force, 1e-3) - expected).max() / np.abs(expected).max())
    assert off[0] < 1e-3
    assert off[1] < 1e-4


def test_coefficients_of_two_bearings_are_found_from_four_sensors():
    step, rng = 1e-3, np.random.default_rng(0)
    force = 20.0 * np.repeat(rng.choice([-1.0, 1.0], (500, 2)), 4, axis=0)
    measured = whole_model(rotor(**TRUE), 3000, force, step) + 1e-7 * rng.standard_normal((2000, 4))
    structure = gbid.export.from_ross(rotor(**START), sensors=SENSORS, actuators=ACTUATORS, speed_rpm=3000, modes=6)
    result = gbid.fit(structure, gbid.Recording({"f": force, "p": measured}, step, name="run"), focus="simulation")
    assert result.success
    assert result.engine == "numpy"
    assert any("would take minutes to build: the slower portable pass was used" in note for note in result.notes)
    true = {
        f"{key[-1]}_{a}{b}_{key[:-2]}": matrix[i, j]
        for key, matrix in TRUE.items()
        for i, a in enumerate("xy")
        for j, b in enumerate("xy")
    }
    assert set(true) == set(result.parameters)
    z = np.array([(result.parameters[name] - value) / result.std[name] for name, value in true.items()])
    assert np.abs(z).max() < 3
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.5
    assert result.std["k_xx_left"] < 1e-3 * true["k_xx_left"]


def test_bearings_that_are_not_named_keep_their_coefficients():
    machine = rotor(**TRUE)
    structure = gbid.export.from_ross(machine, bearings={"one": 6}, sensors=[(0, np.pi / 4)], actuators=[(2, "x")])
    assert [parameter.name for parameter in structure.parameters][:2] == ["k_xx_one", "k_xy_one"]
    assert len(structure.parameters) == 8
    assert structure.parameters[0].start == 1.3e6
    all_known = natural(gbid.export.from_ross(machine, sensors=SENSORS, actuators=ACTUATORS))
    np.testing.assert_allclose(natural(structure), all_known, rtol=1e-4)
    ross = ross_package("these tests")
    probe = gbid.export.from_ross(machine, sensors=[ross.Probe(0, np.pi / 4, tag="p")], actuators=[(2, "x")])
    values = [evaluate(s, {p.name: p.start for p in s.parameters}).static_gain() for s in (structure, probe)]
    np.testing.assert_allclose(*values, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"bearings": ["middle"]}, "no bearing 'middle' in the rotor; choose from 'left' at node 0, 'right' at node 6"),
        ({"bearings": {"a b": "left"}}, "'a b' cannot be the suffix of parameter names"),
        ({"bearings": {"a": "left", "b": 0}}, "0 is named twice"),
        ({"bearings": {}}, "none is named"),
        ({"sensors": []}, "no sensors"),
        ({"sensors": [(7, "x")]}, "sensors[0]: node 7; the rotor has nodes 0 to 6"),
        ({"sensors": [(1, "z")]}, "sensors[0]: axis 'z'; give 'x', 'y' or an angle"),
        ({"sensors": [3]}, "sensors[0]: 3; give (node, 'x')"),
        ({"actuators": [(0, "x"), (-1, "y")]}, "actuators[1]: node -1"),
        ({"speed_rpm": float("nan")}, "speed_rpm = nan; give a finite number"),
        ({"modes": 0}, "modes = 0; the rotor has 1 to 28 lateral modes"),
        ({"modes": 99}, "modes = 99"),
        ({"modes": 2.5}, "modes = 2.5; give a whole number"),
        ({"rotor": "a rotor"}, "a str is no rotor of ROSS"),
    ],
)
def test_wrong_arguments_are_one_line(change, words):
    options = {"sensors": SENSORS, "actuators": ACTUATORS, **change}
    machine = options.pop("rotor", None) or rotor()
    with pytest.raises(UsageError) as caught:
        gbid.export.from_ross(machine, **options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [2, 3])
def test_an_identified_bearing_is_an_element_with_units_and_signs_of_ross(version, monkeypatch):
    ross = ross_package("this test")

    class OfRoss3(ross.BearingElement):
        """Element with the argument of ROSS 3, which is not released yet."""

        def __init__(self, n, *, speed=None, **coefficients):
            super().__init__(n=n, frequency=speed, **coefficients)

    if version == 3:
        monkeypatch.setattr(ross, "BearingElement", OfRoss3)
    mass, speeds = 2.5, np.array([0.0, 2000.0, 6000.0])
    element = bearing_element(MODEL, 3, mass_kg=mass, pressure_bar=6.0, speed_rpm=speeds)
    values = MODEL.key_parameters(6.0, speeds)
    np.testing.assert_allclose(element.kxx, -mass * values["k_xx"])
    np.testing.assert_allclose(element.kxy, -mass * values["k_xy"])
    np.testing.assert_allclose(element.cyx, -mass * values["d_yx"])
    np.testing.assert_allclose(element.frequency, speeds * np.pi / 30)
    assert element.n == 3
    assert min(element.kxx) > 0
    # a rigid disc of this mass on the element has the modes of the model without its delays
    A = np.block([[0 * EYE, EYE], [-element.K(0)[:2, :2] / mass, -element.C(0)[:2, :2] / mass]])
    computed = sorted(np.abs(np.linalg.eigvals(A)))[::2]
    np.testing.assert_allclose(
        np.array(computed) / (2 * np.pi), [f for f, _ in MODEL.at(6.0, 0.0).modes()][:2], rtol=1e-6
    )


def test_wrong_requests_of_an_element():
    for options, words in (
        ({"mass_kg": 0.0, "pressure_bar": 6.0}, "mass_kg = 0.0; give the modal mass"),
        ({"mass_kg": 2.0}, "give pressure_bar"),
        ({"mass_kg": 2.0, "pressure_bar": 9.0}, "pressure_bar = 9 lies outside its domain"),
    ):
        with pytest.raises(UsageError, match=words):
            bearing_element(MODEL, 0, **options)


def test_the_command_line_writes_files_that_ross_reads(tmp_path, capsys):
    assert run("export", "theisen2016", "--to", "ross", "--output", tmp_path) == 2
    assert "give the modal mass with --mass KG" in capsys.readouterr().err
    assert run("export", "theisen2016", "--to", "ross", "--mass", 2.04, "--output", tmp_path) == 0
    files = capsys.readouterr().out.split()
    assert [Path(file).name for file in files] == [f"theisen2016_p{p}.toml" for p in (3, 4, 5, 6, 7)]
    read = ross_package("these tests").BearingElement.load(files[3])
    read = read[0] if isinstance(read, list) else read
    expected = bearing_element(MODEL, 0, mass_kg=2.04, pressure_bar=6.0)
    np.testing.assert_allclose(read.kxx, expected.kxx)
    np.testing.assert_allclose(read.cxy, expected.cxy)
    assert run("export", "theisen2016", "--to", "ross", "--mass", 2.05, "--output", tmp_path) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_model_without_operating_points_is_written_at_the_ends_of_its_domain(tmp_path):
    from gbid.export.targets import ExportItem, ExportRequest, write_elements

    item = ExportItem("bare", replace(MODEL, operating_points=()))
    files = write_elements(item, ExportRequest(tmp_path, mass_kg=1.0))
    assert [file.name for file in files] == ["bare_p3.toml", "bare_p7.toml"]


def test_the_structure_says_how_good_its_reduction_is():
    machine = rotor(**TRUE)
    complete = np.linalg.eigvals(lateral(machine, 300.0)[0])
    complete = complete[complete.imag > 0]
    complete = complete[np.argsort(np.abs(complete))]
    options = {"sensors": SENSORS, "actuators": ACTUATORS, "speed_rpm": 300.0 * 30 / np.pi}
    few, many = (gbid.export.from_ross(machine, modes=modes, **options) for modes in (6, 28))
    model = evaluate(few, {parameter.name: parameter.start for parameter in few.parameters})
    for mode, expected in zip(few.reduction, complete, strict=False):
        assert mode.whole_frequency_hz == pytest.approx(abs(expected) / (2 * np.pi), rel=1e-9)
        assert mode.whole_damping == pytest.approx(-expected.real / abs(expected), rel=1e-6)
        assert np.abs(np.abs(model.poles()) / (2 * np.pi) / mode.frequency_hz - 1).min() < 1e-9
    assert len(few.reduction) == 6
    assert max(abs(mode.error) for mode in many.reduction) < 1e-7
    assert many.notes == ()
    # shapes at rest are no basis for gyroscopic moments ten times as large: 2.8 % of the lowest frequency
    fast = gbid.export.from_ross(machine, bearings={"one": 6}, sensors=SENSORS, actuators=[], speed_rpm=30000, modes=3)
    worst = max(fast.reduction, key=lambda mode: abs(mode.error))
    assert abs(worst.error) > 0.02
    assert len(fast.notes) == 1
    assert "1 of 3 modes of the reduced rotor differ from the full rotor by more than 1 %" in fast.notes[0]
    assert f"the worst has {worst.frequency_hz:.4g} Hz" in fast.notes[0]
    assert fast.notes[0].endswith("[GB141]")


# of the rotors that ROSS ships; by default their magnetic bearings are without controller
EXAMPLES = ("rotor_example", "rotor_example_6dof", "rotor_example_with_damping", "compressor_example")


@pytest.mark.filterwarnings("ignore:the matrix subclass:PendingDeprecationWarning")  # of ROSS
@pytest.mark.filterwarnings("ignore:File was created with ROSS:UserWarning")
@pytest.mark.parametrize("name", [*EXAMPLES, "coaxrotor_example", "rotor_amb_example"])
@pytest.mark.parametrize("speed_rpm", [0.0, 3000.0])
def test_rotors_that_ross_ships_have_the_poles_of_ross(name, speed_rpm):
    ross, omega = ross_package("these tests"), speed_rpm * np.pi / 30
    machine = getattr(__import__("ross.rotor_assembly").rotor_assembly, name)()
    bearings = None
    if name == "rotor_amb_example":  # the controller of the other bearing is in ROSS's matrices
        bearings, free = [machine.bearing_elements[0].tag], machine.bearing_elements[0]
        plain = ross.BearingElement(n=free.n, kxx=float(free.ks), kyy=float(free.ks), cxx=0.0, cyy=0.0)
        expected = ross.Rotor(machine.shaft_elements, machine.disk_elements, [plain, machine.bearing_elements[1]])
    else:
        expected = machine
    structure = gbid.export.from_ross(
        machine, bearings=bearings, sensors=[(0, "x")], actuators=[(1, "y")], speed_rpm=speed_rpm, modes=12
    )
    of_ross = np.linalg.eigvals(expected.A(omega))
    assert len(structure.reduction) >= 8
    for mode in structure.reduction:
        rate, damping = 2 * np.pi * mode.whole_frequency_hz, mode.whole_damping
        pole = rate * (-damping + 1j * np.sqrt(1 - damping**2))
        # ROSS's state matrix is not balanced: its slow poles are off by 1e-6
        assert np.abs(of_ross - pole).min() < 1e-4 * rate
    model = evaluate(structure, {parameter.name: parameter.start for parameter in structure.parameters})
    for mode in structure.reduction[:2]:
        assert np.abs(np.abs(model.poles()) / (2 * np.pi) / mode.whole_frequency_hz - 1).min() < 1e-3


def test_every_rotor_that_ross_ships_is_among_the_examples():
    ross_package("these tests")
    import ross.rotor_assembly

    shipped = {name for name, value in vars(ross.rotor_assembly).items() if "_example" in name and callable(value)}
    assert shipped == {*EXAMPLES, "coaxrotor_example", "rotor_amb_example"}


def test_a_rotor_with_gears_and_a_random_one_are_refused():
    ross = ross_package("these tests")
    geared = __import__("ross.multi_rotor").multi_rotor.two_shaft_rotor_example()
    with pytest.raises(UsageError, match=r"give each shaft as a separate ross\.Rotor"):
        gbid.export.from_ross(geared, sensors=[(0, "x")], actuators=[(1, "y")])
    random = __import__("ross.stochastic.st_rotor_assembly").stochastic.st_rotor_assembly.st_rotor_example()
    with pytest.raises(UsageError, match="a ST_Rotor is no rotor of ROSS"):
        gbid.export.from_ross(random, sensors=[(0, "x")], actuators=[(1, "y")])
    thrust = ross.BearingElement(n=3, kxx=1e6, cxx=0.0, kzz=1e7, czz=1e3, tag="thrust")
    machine = rotor(**TRUE)
    machine = ross.Rotor(machine.shaft_elements, machine.disk_elements, [*machine.bearing_elements, thrust])
    poles = [
        evaluate(s, {q.name: q.start for q in s.parameters}).poles()
        for s in (
            gbid.export.from_ross(machine, bearings=tags, sensors=SENSORS, actuators=ACTUATORS, modes=28)
            for tags in (["left"], ["left", "right", "thrust"])
        )
    ]
    np.testing.assert_allclose(*(np.sort(np.abs(values))[:16] for values in poles), rtol=1e-8)


def magnetic_rotor():
    """The rotor of the book on two magnetic bearings with the tags that ROSS gives by itself."""
    ross = ross_package("these tests")
    steel = ross.Material(name="steel", rho=7810, E=211e9, G_s=81.2e9)
    shaft = [ross.ShaftElement(0.25, 0.0, 0.05, material=steel) for _ in range(6)]
    disc = ross.DiskElement.from_geometry(n=2, material=steel, width=0.07, i_d=0.05, o_d=0.28)
    coils = {"g0": 1e-3, "i0": 1.0, "ag": 1e-4, "nw": 200, "kp_pid": 5000.0, "kd_pid": 100.0}
    bearings = [ross.MagneticBearingElement(n=n, **coils) for n in (0, 6)]
    return ross.Rotor(shaft, [disc], bearings)


@pytest.mark.filterwarnings("ignore:the matrix subclass:PendingDeprecationWarning")  # of ROSS
def test_a_rotor_with_magnetic_bearings_is_the_plant_of_its_controller():
    machine = magnetic_rotor()
    element = machine.bearing_elements[0]
    name, currents = element.tag, [(element.tag, "x"), (element.tag, np.pi / 2), (6, "y")]
    structure = gbid.export.from_ross(machine, sensors=SENSORS, actuators=currents, speed_rpm=3000, modes=28)
    starts = {parameter.name: parameter.start for parameter in structure.parameters}
    end = name.replace(" ", "_")
    assert set(starts) == {f"{k}_{e.tag.replace(' ', '_')}" for k in ("k_s", "k_i") for e in machine.bearing_elements}
    assert starts[f"k_s_{end}"] == pytest.approx(-element.ks)
    assert starts[f"k_i_{end}"] == pytest.approx(element.ki)
    model = evaluate(structure, starts)
    # the whole rotor: free shaft and disc with negative springs at both nodes, written here without gbid
    omega, per = 100 * np.pi, machine.number_dof
    keep = [i for i in range(machine.ndof) if i % per in (0, 1, 3, 4)]
    K, M, C = machine.K(omega), machine.M(omega), machine.C(omega) + omega * machine.G()
    for e in machine.bearing_elements:
        dofs = [per * e.n, per * e.n + 1]
        K[np.ix_(dofs, dofs)] += float(e.ks) * EYE - np.asarray(e.K(omega), float)[:2, :2]
        C[np.ix_(dofs, dofs)] -= np.asarray(e.C(omega), float)[:2, :2]
    K, M, C = (matrix[np.ix_(keep, keep)] for matrix in (K, M, C))
    places = np.zeros((len(K), 3))
    places[keep.index(0), 0] = places[keep.index(1), 1] = float(element.ki)
    places[keep.index(6 * per + 1), 2] = 1.0
    rows = [keep.index(per * node + "xy".index(axis)) for node, axis in SENSORS]
    for hz in (0.0, 20.0, 150.0):
        s = 2j * np.pi * hz
        expected = np.linalg.solve(M * s**2 + C * s + K, places)[rows]
        np.testing.assert_allclose(
            model.frequency_response([hz])[0], expected, rtol=1e-5, atol=1e-9 * np.abs(expected).max()
        )
    assert (model.poles().real > 1).sum() == 4  # unstable without the controller
    with pytest.raises(UsageError, match="'left' is no magnetic bearing with unknown coefficients; choose from"):
        gbid.export.from_ross(machine, sensors=SENSORS, actuators=[("left", "x")])
