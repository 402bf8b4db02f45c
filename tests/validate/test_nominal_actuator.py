"""The most central actuator model: against brute force, outliers planted, poles in either order."""

from dataclasses import replace

import numpy as np
import pytest
from rig_point import machine
from scipy import stats

from gbid.core.errors import ChangedFileWarning, DataError, UsageError
from gbid.identify import FitTable, fit
from gbid.lpv import load_model
from gbid.rig import Prbs, record
from gbid.structure import PiezoPair
from gbid.validate import load_actuators, nominal_actuator
from gbid.validate.central import ACTUATOR, save_nominal_actuator

STILL = {"speed_rpm": 0.0}
TRUE = np.array([3078.0, 8143.0, 1.863, 2452.0, 6494.0, 1.865])


def table_of(values, **changes):
    n, k = values.shape
    blank = {
        "fit": np.full(n, "piezos"),
        "model": np.array([f"r{i}" for i in range(n)]),
        "structure": np.full(n, "piezo_pair"),
        "recordings": tuple((f"r{i}",) for i in range(n)),
        "pressure_bar": np.full(n, 6.0),
        "speed_rpm": np.zeros(n),
        "parameter_names": ACTUATOR,
        "units": ("rad/s", "rad/s", "m/m") * 2,
        "values": values,
        "std": 0.001 * values,
        "covariance": np.zeros((n, k, k)),
        "gain_names": (),
        "output_names": (),
        "success": np.ones(n, dtype=bool),
        "status": np.full(n, "converged", dtype="U60"),
        "notes": ((),) * n,
        "iterations": np.ones(n, dtype=int),
        "wall_time_s": np.zeros(n),
    }
    empty = ("mode_frequency_hz", "mode_frequency_std_hz", "mode_damping", "mode_damping_std")
    blank |= dict.fromkeys((*empty, "static_gain", "static_gain_std", "fit_percent"), np.zeros((n, 0)))
    return FitTable(**{**blank, **changes})


def scattered(n=86, seed=0):
    random = np.random.default_rng(seed)
    return TRUE * np.exp(random.normal(0, [0.05, 0.08, 0.003] * 2, (n, 6)))


@pytest.mark.parametrize("n", [12, 86])
def test_limit_of_outliers_is_the_quantile_of_all_entries(n):
    """One false alarm in twenty tables: Student's t, whose degrees of freedom are those of a median deviation."""
    expected = stats.t.isf(0.05 / (2 * 6 * n), 0.37 * (n - 1))
    assert nominal_actuator(table_of(scattered(n))).limit == pytest.approx(expected, rel=1e-9)


def test_the_model_with_the_smallest_distances_is_chosen():
    values = scattered()
    nominal = nominal_actuator(table_of(values))
    logs = np.log(values)
    scale = 1.4826 * np.array([np.median(abs(c - np.median(c))) for c in logs.T])
    sums = [sum(np.sqrt((((a - b) / scale) ** 2).sum()) for b in logs) for a in logs]
    assert nominal.name == f"r{int(np.argmin(sums))}"
    np.testing.assert_allclose(nominal.distances, np.array(sums) / 85)
    np.testing.assert_array_equal(list(nominal.parameters.values()), values[int(np.argmin(sums))])
    assert nominal.outliers == ()
    assert abs(np.log(list(nominal.parameters.values())) - np.log(TRUE)).max() < 0.08


def test_planted_outliers_are_named_and_do_not_move_the_choice():
    values = scattered()
    clean = nominal_actuator(table_of(values))
    spoilt = values.copy()
    victims = [i for i in range(86) if f"r{i}" != clean.name][:3]
    spoilt[victims[0], 2] *= 1.05  # a gain
    spoilt[victims[1], 4] *= 3  # a pole
    spoilt[victims[2]] = [900.0, 9e5, 1.2, 800.0, 9e5, 1.1]
    nominal = nominal_actuator(table_of(spoilt))
    assert nominal.name == clean.name
    named = {(o.model, o.parameter): o for o in nominal.outliers}
    assert (f"r{victims[0]}", "kappa_x") in named
    assert (f"r{victims[1]}", "p2_y") in named
    assert {p for m, p in named if m == f"r{victims[2]}"} == set(ACTUATOR)
    assert len(named) == 8
    gain = named[f"r{victims[0]}", "kappa_x"]
    assert gain.kind == "gain"
    assert gain.reason.startswith(f"kappa_x = {spoilt[victims[0], 2]:.4g}, median 1.86")
    assert "rad/s" in named[f"r{victims[1]}", "p2_y"].reason
    sizes = [abs(o.z) for o in nominal.outliers]
    assert sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("n", [4, 6, 12, 30, 86])
def test_normal_models_are_seldom_called_outliers(n):
    """Of normal models the rule names any in about every twentieth campaign, few models or many."""
    alarms = [bool(nominal_actuator(table_of(scattered(n, seed=s))).outliers) for s in range(200)]
    assert np.mean(alarms) < 0.1


def test_what_the_errors_of_the_estimates_explain_is_no_outlier():
    """All models but one agree closer than their own standard deviations say they can."""
    values = TRUE * np.exp(np.random.default_rng(0).normal(0, 1e-5, (20, 6)))
    values[4, 0] *= 1.002
    assert nominal_actuator(table_of(values)).outliers == ()
    assert [o.model for o in nominal_actuator(table_of(values, std=1e-6 * values)).outliers] == ["r4"]


def test_swapped_poles_are_the_same_model():
    values = scattered(30)
    swapped = values.copy()
    swapped[4, [0, 1]], swapped[9, [3, 4]] = values[4, [1, 0]], values[9, [4, 3]]
    one, other = nominal_actuator(table_of(values)), nominal_actuator(table_of(swapped))
    assert (one.name, one.outliers) == (other.name, other.outliers)
    np.testing.assert_array_equal(one.values, other.values)
    assert (other.values[:, 0] < other.values[:, 1]).all()


def test_failed_fits_are_left_out_and_named():
    values = scattered(12)
    good = np.ones(12, dtype=bool)
    good[5] = False
    status = np.full(12, "converged", dtype="U60")
    status[5] = "stopped after 100 iterations"
    values[7, 0] = np.nan
    nominal = nominal_actuator(table_of(values, success=good, status=status))
    assert len(nominal.models) == 10
    assert nominal.left_out == ("r5: stopped after 100 iterations", "r7: converged")
    with pytest.raises(DataError, match="none of 12 actuator fits converged; the first: r0"):
        nominal_actuator(table_of(values, success=np.zeros(12, dtype=bool)))


def test_other_tables_are_refused():
    table = table_of(scattered(4))
    two = replace(table, fit=np.array(["a", "a", "b", "b"]))
    with pytest.raises(UsageError, match=r"the fits a, b; choose one: fit='a'"):
        nominal_actuator(two)
    assert nominal_actuator(two, fit="b").models == ("r2", "r3")
    with pytest.raises(UsageError, match="they have no kappa_y"):
        nominal_actuator(replace(table, parameter_names=(*ACTUATOR[:5], "other")))
    with pytest.raises(DataError, match="no actuator models"):
        nominal_actuator([])


def test_results_of_fits_do_as_well_and_the_file_feeds_a_model(tmp_path):
    results = [fit(PiezoPair(), record(machine(), Prbs(1.0), conditions=STILL, seed=i, name=f"r{i}")) for i in range(3)]
    nominal = nominal_actuator(results)
    assert nominal.models == ("r0", "r1", "r2")
    for name, value in zip(ACTUATOR, TRUE, strict=True):
        assert nominal.parameters[name] == pytest.approx(value, rel=0.1)
    assert all(0 < std < 0.1 * nominal.parameters[name] for name, std in nominal.std.items())
    save_nominal_actuator(nominal, tmp_path / "a.yaml", source="here")
    actuators = load_actuators(tmp_path / "a.yaml")
    assert actuators == nominal.parameters
    model = replace(load_model("theisen2016"), actuators=actuators)
    assert model.plant_at(6, 0).A.shape[0] > 6
    with pytest.raises(UsageError, match="exists already"):
        save_nominal_actuator(nominal, tmp_path / "a.yaml")
    text = (tmp_path / "a.yaml").read_text()
    (tmp_path / "b.yaml").write_text(text.replace("kind: actuators", "kind: other"))
    with pytest.raises(DataError, match="not a file with a nominal actuator"):
        load_actuators(tmp_path / "b.yaml")
    (tmp_path / "b.yaml").write_text(text.replace("  p1_x: ", "  p1_x: 1"))
    with pytest.warns(ChangedFileWarning, match=r"b\.yaml: changed after gbid wrote it"):
        load_actuators(tmp_path / "b.yaml")
    (tmp_path / "b.yaml").write_text(text.replace("  p1_x: ", "  p1_x: -"))
    with pytest.raises(DataError, match=r"actuators.p1_x = -\d+.*; expected a positive number"):
        load_actuators(tmp_path / "b.yaml")
