"""Models in other libraries and programs: what arrives there is what was here."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from scipy import signal
from scipy.io import loadmat

import gbid
from gbid.core.errors import UsageError
from gbid.core.yaml_file import read_yaml
from gbid.export.matlab import save_mat
from gbid.export.tables import save_csv, save_yaml
from gbid.identify import FitResult
from gbid.lpv.model import TERMS
from gbid.structure import KEY_PARAMETERS, LinearModel, evaluate

FREQUENCY = np.array([1.0, 90.0, 126.6, 132.0, 700.0])


def published(pade: int | None = None) -> LinearModel:
    return gbid.load_model("theisen2016").at(6.0, 0.0, pade_order=pade)


def exact(outputs: tuple[str, ...] = ("u", "p")) -> LinearModel:
    """The published plant with exact delays: u prompt, p late."""
    machine = gbid.load_model("theisen2016")
    values = {**machine.actuators, **machine.key_parameters(6.0, 0.0)}
    structure = gbid.Plant(gbid.RotorBearing(delay="exact", disturbance_gain="none"), outputs=outputs)
    names = tuple(f"{letter}_{axis}" for letter in outputs for axis in "xy")
    return evaluate(structure, values, ("r_x", "r_y"), names)


def only_late() -> LinearModel:
    machine = gbid.load_model("theisen2016")
    structure = gbid.RotorBearing(delay="exact", disturbance_gain="none")
    return evaluate(structure, machine.key_parameters(6.0, 0.0), ("u_x", "u_y"), ("p_x", "p_y"))


@cache
def some_fit() -> FitResult:
    recording = simulated(MODE, MODE_AT, levels(300), noise=0.1, name="run-1")
    fit = gbid.fit(MODE, recording, fixed={"l2": 0.0}, local={"w": "recording"})
    model = replace(fit.model, K=np.array([[3.0], [4.0]]))
    return fit.changed(model=model, std={**fit.std, "l2": float("nan")})


def response(A, B, C, D, frequency):
    """Frequency response by its definition, one frequency at a time."""
    eye = np.eye(len(A))
    return np.array([C @ np.linalg.inv(2j * np.pi * f * eye - A) @ B + D for f in frequency])


# --- scipy and python-control


@pytest.mark.parametrize("dt", [None, 2e-4])
def test_scipy_simulates_the_same(dt):
    model = published() if dt is None else published().discretise(dt)
    system = model.to_scipy()
    assert system.dt == dt
    assert isinstance(system, signal.StateSpace)
    u = np.random.default_rng(1).standard_normal((300, 2))
    time = 2e-4 * np.arange(300)
    computed = signal.lsim(system, u, time, interp=True)[1] if dt is None else signal.dlsim(system, u)[1]
    expected = model.simulate(u, 2e-4)
    np.testing.assert_allclose(computed, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("dt", [None, 2e-4])
def test_python_control_round_trip(dt):
    control = pytest.importorskip("control", reason="python-control is not installed: pip install 'gbid[control]'")
    model = published() if dt is None else published().discretise(dt)
    system = model.to_control()
    assert isinstance(system, control.StateSpace)
    assert system.dt == (0 if dt is None else dt)
    assert (system.input_labels, system.output_labels) == (["u_x", "u_y"], ["p_x", "p_y"])
    s = 2j * np.pi * FREQUENCY
    values = np.array([system(value if dt is None else np.exp(value * dt)) for value in s])
    np.testing.assert_allclose(values, model.frequency_response(FREQUENCY), rtol=1e-8)
    damping = sorted(control.damp(system, doprint=False)[1])[:4]
    np.testing.assert_allclose(damping, sorted(2 * [z for _, z in model.modes()]), rtol=1e-7)
    again = LinearModel.from_control(system)
    for letter in "ABCD":
        np.testing.assert_array_equal(getattr(again, letter), getattr(model, letter))
    for field in ("dt", "name", "input_names", "output_names", "state_names"):
        assert getattr(again, field) == getattr(model, field)
    assert LinearModel.from_control(system, "mine").name == "mine"


def test_python_control_closes_the_same_loop():
    control = pytest.importorskip("control", reason="python-control is not installed: pip install 'gbid[control]'")
    from gbid.control import p_controller

    plant, controller = gbid.load_model("theisen2016").plant_at(6, 0), p_controller(1.125, 0.99)
    ours = gbid.close_loop(plant, controller)
    theirs = control.feedback(plant.to_control(), controller.to_control(), sign=1)
    np.testing.assert_allclose(np.sort_complex(theirs.poles()), np.sort_complex(ours.poles()), rtol=1e-7)
    assert not any("." in label for label in ours.to_control().state_labels)  # which python-control refuses


def test_what_other_libraries_cannot_take_is_said(monkeypatch):
    control = pytest.importorskip("control", reason="python-control is not installed: pip install 'gbid[control]'")
    for convert in ("to_scipy", "to_control"):
        with pytest.raises(UsageError, match=r"exact delays.*with_pade\(model, order\)"):
            getattr(only_late(), convert)()
        getattr(gbid.structure.with_pade(only_late(), 2), convert)()
    unclear = published().to_control()
    unclear.dt = None
    with pytest.raises(UsageError, match=r"dt = None.*set system.dt to 0"):
        LinearModel.from_control(unclear)
    with pytest.raises(UsageError, match=r"TransferFunction is not a state-space system.*control.ss"):
        LinearModel.from_control(control.tf([1], [1, 1]))
    static = LinearModel(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]])
    np.testing.assert_array_equal(static.to_control().D, [[2.0]])
    np.testing.assert_array_equal(static.to_scipy().D, [[2.0]])
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(UsageError, match=r"pip install 'gbid\[control\]'"):
        published().to_control()


# --- MATLAB


def read(path):
    return loadmat(path, squeeze_me=False, chars_as_strings=True)


def texts(cell):
    return [str(entry[0]) if entry.size else "" for entry in cell.ravel()]


@pytest.mark.parametrize("make", [published, only_late, exact, lambda: exact(("p",))])
def test_mat_file_holds_the_model(make, tmp_path):
    """The numbers as MATLAB is told to combine them: u enters at once and, delayed, once more."""
    model = make()
    data = read(save_mat(model, tmp_path / "model.mat", units={model.input_names[0]: "m"}))
    delayed = data["B_delayed"] if data["B_delayed"].size else np.zeros_like(data["B"])
    delay = data["delay"].ravel() if data["delay"].size else np.zeros(data["B"].shape[1])
    shift = np.exp(-2j * np.pi * FREQUENCY[:, None] * delay)[:, None, :]
    B, D = np.hstack([data["B"], delayed]), np.hstack([data["D"], 0 * data["D"]])
    doubled, n = response(data["A"], B, data["C"], D, FREQUENCY), data["B"].shape[1]
    np.testing.assert_allclose(
        doubled[:, :, :n] + doubled[:, :, n:] * shift, model.frequency_response(FREQUENCY), rtol=1e-7
    )
    assert texts(data["InputName"]) == list(model.input_names)
    assert texts(data["StateName"]) == list(model.state_names)
    assert texts(data["InputUnit"]) == ["m", ""]
    assert data["Ts"] == 0


def test_mat_file_of_a_sampled_model_and_a_fit(tmp_path):
    assert read(save_mat(published().discretise(2e-4), tmp_path / "sampled.mat"))["Ts"] == 2e-4
    fit = some_fit().changed(structure="rotor_bearing")  # whose channels are in metres
    data = read(save_mat(fit, tmp_path / "fitted.mat"))
    np.testing.assert_array_equal(data["K"], fit.model.K)
    assert texts(data["InputUnit"]) == ["m"]
    assert dict(zip(texts(data["parameter_name"]), data["parameter_value"].ravel(), strict=True)) == fit.parameters
    np.testing.assert_array_equal(data["parameter_std"].ravel(), list(fit.std.values()))
    np.testing.assert_array_equal(data["covariance"], fit.covariance)


def test_mat_file_of_an_lpv_model_gives_the_operating_points(tmp_path):
    machine = gbid.load_model("theisen2016")
    data = read(save_mat(machine, tmp_path / "machine.mat"))
    assert TERMS == ("1", "P", "Omega", "Omega P", "P^2", "Omega^2")
    names = texts(data["parameter_name"])
    for P, W in ((3.0, 0.0), (6.0, 0.0), (7.0, 6000.0)):
        values = dict(zip(names, data["coefficients"] @ [1, P, W, W * P, P**2, W**2], strict=True))
        expected = machine.key_parameters(P, W)
        assert set(values) == set(KEY_PARAMETERS)
        np.testing.assert_allclose([values[key] for key in KEY_PARAMETERS], list(expected.values()), rtol=1e-12)
    actuators = data["actuators"]
    assert {name: float(actuators[name][0, 0][0, 0]) for name in actuators.dtype.names} == dict(machine.actuators)
    np.testing.assert_array_equal(data["pressure_bar"], [machine.domain.pressure_bar])


def test_mat_files_refuse_what_would_be_lost(tmp_path):
    with pytest.raises(UsageError, match=r"ends in \.mat"):
        save_mat(published(), tmp_path / "model.m")
    with pytest.raises(UsageError, match=r"no channel 'q' to give a unit; choose from u_x, u_y, p_x, p_y"):
        save_mat(published(), tmp_path / "model.mat", units={"q": "m"})
    (tmp_path / "model.mat").write_text("mine")
    with pytest.raises(UsageError, match=r"model\.mat exists already"):
        save_mat(published(), tmp_path / "model.mat")
    assert (tmp_path / "model.mat").read_text() == "mine"


# --- tables and YAML


def rows(path):
    with path.open(newline="") as handle:
        return list(csv.reader(handle))


def test_csv_of_matrices_reads_back_without_loss(tmp_path):
    model = replace(exact(), K=np.ones((exact().n_states, 4)))
    head, *entries = rows(save_csv(model, tmp_path / "model.csv"))
    assert head == ["matrix", "row", "column", "row_name", "column_name", "value"]
    results = {letter: np.zeros(getattr(model, letter).shape) for letter in ("A", "B", "C", "D", "K", "B_delayed")}
    delay = np.zeros(2)
    for letter, i, j, down, across, value in entries:
        if letter == "delay":
            delay[int(j) - 1] = float(value)
            continue
        results[letter][int(i) - 1, int(j) - 1] = float(value)
        if letter == "C":
            assert (down, across) == (model.output_names[int(i) - 1], model.state_names[int(j) - 1])
    for letter, values in results.items():
        np.testing.assert_array_equal(values, getattr(model, letter))
    np.testing.assert_array_equal(delay, model.delay)


def test_csv_of_responses_parameters_and_coefficients(tmp_path):
    model = published()
    head, *entries = rows(save_csv(model, tmp_path / "g.csv", frequency_hz=FREQUENCY))
    assert head[:3] == ["frequency_hz", "magnitude p_x/u_x", "phase_deg p_x/u_x"]
    table = np.array(entries, float)
    g = model.frequency_response(FREQUENCY)[:, 1, 0]
    column = head.index("magnitude p_y/u_x")
    computed = table[:, column] * np.exp(1j * np.deg2rad(table[:, column + 1]))
    np.testing.assert_allclose(computed, g, rtol=1e-12)
    head, *entries = rows(save_csv(some_fit(), tmp_path / "fit.csv"))
    assert head == ["parameter", "estimate", "std", "unit", "free"]
    fit = some_fit()
    expected = [[name, repr(value), repr(fit.std[name])] for name, value in fit.parameters.items()]
    assert [row[:3] for row in entries] == expected
    assert entries[0][3:] == ["rad/s", "yes"]
    assert entries[-1][2:] == ["nan", "", "no"]
    machine = gbid.load_model("theisen2016")
    head, *entries = rows(save_csv(machine, tmp_path / "lpv.csv"))
    assert head == ["parameter", "unit", *TERMS]
    assert {row[0]: tuple(map(float, row[2:])) for row in entries} == dict(machine.coefficients)
    with pytest.raises(UsageError, match="one operating point only"):
        save_csv(machine, tmp_path / "no.csv", frequency_hz=FREQUENCY)
    with pytest.raises(UsageError, match="exists already"):
        save_csv(machine, tmp_path / "lpv.csv")


def test_yaml_reads_back(tmp_path):
    machine = gbid.load_model("theisen2016")
    again = gbid.load_model(save_yaml(machine, tmp_path / "machine.yaml"))
    assert again.coefficients == machine.coefficients
    model = exact()
    data = read_yaml(save_yaml(model, tmp_path / "model.yaml")).data
    for letter in ("A", "B", "C", "D", "B_delayed", "delay"):
        np.testing.assert_array_equal(np.array(data[letter]), getattr(model, letter))
    fit = some_fit()
    data = read_yaml(save_yaml(fit, tmp_path / "fit.yaml")).data
    assert {name: entry["estimate"] for name, entry in data["parameters"].items()} == fit.parameters
    assert data["parameters"]["l2"]["std"] is None
    np.testing.assert_array_equal(np.array(data["model"]["K"]), fit.model.K)
