"""Tables of results hold the values of their documents; the words are made from them."""

import math
from dataclasses import replace

import numpy as np

from gbid.core.tables import csv_text
from gbid.experiment.stages.crossval import CrossvalRow, pair_table
from gbid.identify.fit_tables import gain_table, mode_table, parameter_table
from gbid.report.campaign_tables import campaign_tables
from gbid.validate import NominalActuator


def parameter(name, estimate, std, unit="", truth=None, fixed=False):
    off = None if truth is None else estimate - truth
    return {
        "parameter": name, "estimate": estimate, "std": std, "unit": unit, "truth": truth, "fixed": fixed,
        "deviation_percent": None if off is None else 100 * off / abs(truth),
        "deviation_std": None if off is None else off / std,
    }  # fmt: skip


def test_a_parameter_has_one_power_of_ten_and_its_times_in_milliseconds():
    rows = [
        parameter("k_xx", -633314.2, 120.0, "N/(kg m)", truth=-633000.0),
        parameter("tau_x", 1.25e-3, 2e-6, "s"),
        parameter("b_xy", 1.2, None, fixed=True),
    ]
    table = parameter_table(rows, "robust")
    assert [column.heading for column in table.columns] == [
        "parameter", "estimate", "std (robust)", "truth", "off by", "in std", "unit"
    ]  # fmt: skip
    assert table.texts() == [
        ["k_xx", "-633.31e3", "0.12e3", "-633.00e3", "-0.05 %", "-2.6", "N/(kg m)"],
        ["tau_x", "1.2500", "0.0020", "-", "-", "-", "ms"],
        ["b_xy", "1.2000", "fixed", "-", "-", "-", ""],
    ]
    assert table.document()["rows"][1][:3] == ["tau_x", 1.25, 2e-3]
    assert csv_text(table).splitlines()[1].startswith("k_xx,-633314.2,120.0,-633000.0,")


def test_without_truth_there_is_no_column_for_it():
    assert len(parameter_table([parameter("k", 1.0, 0.1)], "white").columns) == 4
    modes = [
        {"mode": 1, "frequency_hz": 101.23456, "frequency_std_hz": 0.0123, "damping": 0.05, "damping_std": None,
         "true_frequency_hz": None, "true_damping": None}
    ]  # fmt: skip
    table = mode_table(modes)
    assert table.texts() == [["1", "101.235", "0.012", "0.0500", "-"]]
    assert table.document()["rows"][0][1] == 101.23456


def test_gains_that_are_held_at_zero_are_left_out():
    rows = [
        {"input": "u", "output": y, "gain": g, "std": s, "truth": None}
        for y, g, s in (("a", 0.3, 1e-3), ("b", 0.0, None))
    ]
    assert gain_table(rows).texts() == [["u to a", "0.30000", "0.0010"]]


def test_crossval_says_what_was_missed():
    row = CrossvalRow("fit", "a", "b", "p_x", 88.123, 1.234e-6, "m", 0.0, False, ("my u", "v"), 90.0)
    fine = replace(row, residuals_white=None, residuals_follow=(), minimum_percent=None, unit="V")
    assert pair_table([row, fine]).texts() == [
        ["a", "b", "p_x", "88.12", "1.2 µm", "no", "my u, v", "below 90 %"],
        ["a", "b", "p_x", "88.12", "1.2e-6 V", "-", "-", ""],
    ]
    assert len(pair_table([fine]).columns) == 7


def nominal(**changes):
    names = ("p1_x",)
    made = NominalActuator(
        "run1", {"p1_x": 2000.0}, {"p1_x": math.nan}, ("run1", "run2", "run3"), names,
        np.ones((3, 1)), np.zeros((3, 1)),
        np.ones(3), 3.5, (), (),
    )  # fmt: skip
    return replace(made, **changes)


def test_nominal_actuator_has_outliers_only_where_there_are_any():
    (table,) = nominal().tables()
    assert table.texts() == [["run1", "p1_x", "2000.0", "-", "rad/s"]]
    outliers = nominal(left_out=("run7: not there",)).tables()[1]
    assert outliers.texts() == [["left out", "run7: not there"]]


def test_a_campaign_without_fits_has_one_table():
    stages = {"fit": {"made": 3, "kept": 0, "failed": 1, "not_converged": 2}}
    assert [t.texts() for t in campaign_tables({"stages": stages, "fits": []})] == [[["fit", "3", "0", "1", "2"]]]
    row = {"fit": "a", "fits": 0, "converged": 0, "missing": 4, "median_fit_percent": {}, "worst": None,
           "worst_fit_percent": None}  # fmt: skip
    assert campaign_tables({"stages": {}, "fits": [row]})[0].texts() == [["a", "0", "0", "4", "", "", ""]]
