"""Actuators with complex poles: a fit with real poles notes that they coalesce; `poles="any"` describes them."""

import casadi as ca
import numpy as np
import pytest
from experiment_files import gbid as command
from scipy.signal import cont2discrete

import gbid
from gbid import PiezoPair, Plant, Recording, fit
from gbid.core.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.structures import make_structure
from gbid.structure import evaluate

H = 5e-4
OMEGA, KAPPA = (700.0, 900.0), 0.9
EQUAL = ["p1_x and p2_x are equal: complex poles may have a lower loss; fit PiezoPair(poles='any') [GB129]"]


def moved(zeta, seed=0, n=4000):
    """References held 20 samples, and the positions of two actuators with these damping factors, by scipy."""
    rng = np.random.default_rng(seed)
    r, u = np.repeat(rng.choice([-1e-5, 1e-5], (n // 20, 2)), 20, axis=0), np.empty((n, 2))
    for axis, (omega, damping) in enumerate(zip(OMEGA, zeta, strict=True)):
        A = np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]])
        B = np.array([[0.0], [KAPPA * omega**2]])
        F, G, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), H)
        x = np.zeros(2)
        for i in range(n):
            u[i, axis] = x[0]
            x = F @ x + G[:, 0] * r[i, axis]
    return Recording({"r": r, "u": u + 0.02 * u.std(axis=0) * rng.standard_normal(u.shape)}, H, name=f"run{seed}")


def of_axis(result, names, axis):
    return np.array([[result.parameters[f"{name}_{axis}"], result.std[f"{name}_{axis}"]] for name in names]).T


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("damping", [0.8, 0.957, 0.99])
def test_poles_that_meet_are_equal_ones_with_standard_deviations(damping, seed):
    result = fit(PiezoPair(), moved((damping, 1.5), seed))
    assert result.success
    assert [note for note in result.notes if "GB129" in note] == EQUAL
    assert not any("GB101" in note or "GB102" in note or "GB103" in note for note in result.notes)
    poles, std = of_axis(result, ("p1", "p2"), "x")
    assert poles[0] == pytest.approx(poles[1], rel=1e-4)
    assert std[0] == pytest.approx(std[1], rel=0.02)
    white = std_of_a_double_pole(moved((damping, 1.5), seed), poles[0])
    assert result.std_with("white")["p1_x"] == pytest.approx(white, rel=0.02)


def std_of_a_double_pole(record, start):
    """Standard deviation of a structure that has but one pole, in both places."""

    def matrices(p):
        A = ca.vertcat(ca.horzcat(-p["p"], 0), ca.horzcat(p["p"], -p["p"]))
        return {"A": A, "B": ca.vertcat(p["p"] * p["kappa"], 0), "C": ca.DM([[0, 1]])}

    parameters = [gbid.Parameter("p", float(start)), gbid.Parameter("kappa", KAPPA)]
    structure = gbid.LinearStructure("double", parameters, matrices, ["r"], ["u"])
    return fit(structure, record, inputs="r.x", outputs="u.x", focus="simulation").std_with("white")["p"]


@pytest.mark.parametrize("zeta", [(0.957, 0.957), (0.957, 1.5), (0.3, 1.2)])
def test_any_poles_are_found_with_a_lower_loss(zeta):
    record = moved(zeta)
    real, result = fit(PiezoPair(), record), fit(PiezoPair(poles="any"), record)
    assert result.success
    assert not result.notes
    assert result.loss < 0.95 * real.loss
    for i, axis in enumerate("xy"):
        values, std = of_axis(result, ("omega", "zeta", "kappa"), axis)
        assert (np.abs(values - (OMEGA[i], zeta[i], KAPPA)) < 4 * std).all()


def test_real_poles_are_described_by_both():
    record = moved((1.3, 2.0))
    real, result = fit(PiezoPair(), record), fit(PiezoPair(poles="any"), record)
    assert result.loss == pytest.approx(real.loss, rel=1e-6)
    (slow, fast), _ = of_axis(real, ("p1", "p2"), "x")
    (omega, zeta), _ = of_axis(result, ("omega", "zeta"), "x")
    assert omega**2 == pytest.approx(slow * fast, rel=1e-3)
    assert 2 * zeta * omega == pytest.approx(slow + fast, rel=1e-3)
    assert not any("GB129" in note for note in real.notes)


def test_a_plant_has_the_poles_of_its_actuators():
    plant = Plant(actuators=PiezoPair(poles="any"))
    assert [q.name for q in plant.parameters][:6] == ["omega_x", "zeta_x", "kappa_x", "omega_y", "zeta_y", "kappa_y"]
    assert plant.exchangeable == ()
    assert Plant().exchangeable == (("p1_x", "p2_x"), ("p1_y", "p2_y"))
    values = {"omega_x": 700.0, "zeta_x": 1.25, "kappa_x": 0.9, "omega_y": 900.0, "zeta_y": 0.5, "kappa_y": 0.9}
    poles = evaluate(plant.actuators, values).poles()
    assert np.sort(poles.real)[[0, 3]] == pytest.approx([-1400.0, -350.0])
    assert np.abs(poles.imag).max() == pytest.approx(900 * np.sqrt(0.75))
    with pytest.raises(UsageError, match="poles = 'both'; choose 'real' or 'any'"):
        PiezoPair(poles="both")


YAML = """\
format: 1
name: pairs
import:
  data_folder: data
  recordings:
    - {{name: run0, file: run0.npz, sample_time_s: 5.0e-4, signals: {signals}}}
    - {{name: run1, file: run1.npz, sample_time_s: 5.0e-4, signals: {signals}}}
fits:
  piezos: {{structure: piezo_pair}}
  any: {{structure: piezo_pair, options: {{poles: any}}}}
nominal: {{fit: {nominal}}}
"""
SIGNALS = "{r: {columns: [r_x, r_y], unit: m}, u: {columns: [u_x, u_y], unit: m}}"


def campaign(folder, nominal):
    (folder / "data").mkdir()
    for seed in range(2):
        record = moved((0.957, 0.957), seed)
        columns = {f"{name}_{axis}": record.signal(name)[:, i] for name in "ru" for i, axis in enumerate("xy")}
        np.savez(folder / "data" / f"run{seed}.npz", **columns)
    (folder / "pairs.yaml").write_text(YAML.format(signals=SIGNALS, nominal=nominal))
    return folder / "pairs.yaml"


def test_a_run_goes_on_where_poles_meet(tmp_path, capsys):
    path = campaign(tmp_path, "piezos")
    assert make_structure(load_experiment(path), "any") == PiezoPair(poles="any")
    assert command("crossval", path) == 3
    assert "none of its 2 models yet; `gbid fit` makes them" in capsys.readouterr().err
    assert command("run", path, "--engine", "serial") == 0
    assert "GB129" in "".join(capsys.readouterr())
    assert (tmp_path / "results" / "pairs" / "nominal" / "piezos.yaml").is_file()


def test_a_nominal_actuator_has_real_poles(tmp_path, capsys):
    assert command("check", campaign(tmp_path, "any")) == 2
    assert "with real poles" in capsys.readouterr().err
