"""Tables of results hold the values of their documents; the words are made from them."""

import math

import pytest

from gbid.core.tables import csv_text
from gbid.identify.fit_tables import gain_table, mode_table, parameter_table
from gbid.report.fit_tables import (
    campaign_tables,
    crossval_table,
    lpv_table,
    nominal_table,
    recording_table,
    static_table,
)


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
    row = {
        "model": "a", "recording": "b", "output": "p_x", "fit_percent": 88.123, "infinity_norm": 1.234e-6, "unit": "m",
        "residuals_white": False, "residuals_follow": ("my u", "v"), "missed": True, "minimum_percent": 90.0,
    }  # fmt: skip
    fine = {**row, "residuals_white": None, "residuals_follow": (), "missed": False, "unit": "V"}
    assert crossval_table("fit", [row, fine]).texts() == [
        ["a", "b", "p_x", "88.12", "1.2 µm", "no", "my u, v", "below 90 %"],
        ["a", "b", "p_x", "88.12", "1.2e-6 V", "-", "-", ""],
    ]
    assert len(crossval_table("fit", [fine]).columns) == 7


def test_nominal_table_tells_outliers_only_where_there_are_any():
    document = {
        "fit": "piezos", "model": "run1", "chosen_from": 3, "parameters": {"p1_x": 2000.0}, "std": {"p1_x": math.nan},
        "outliers": [], "left_out": [],
    }  # fmt: skip
    assert nominal_table(document).texts() == [["run1", "p1_x", "2000.0", "-", "rad/s"]]
    left_out = nominal_table({**document, "left_out": ["run7: not there"]})
    assert left_out.texts()[1] == ["left out", "", "", "", "", "run7: not there"]


def test_static_gains_have_their_lengths_in_micrometres():
    gain = {
        "input": "u_x", "output": "p_x", "gain": 0.28, "std": 1e-5, "rms": 2e-9, "largest": 5e-9, "hysteresis": None,
        "hysteresis_std": None,
    }  # fmt: skip
    document = {
        "name": "film", "kind": "bearing", "recordings": ["r1"], "units": ["m", "m"], "gains": [gain], "notes": ["few"],
    }  # fmt: skip
    table = static_table(document)
    assert [column.heading for column in table.columns][3:5] == ["rms off linear [µm]", "largest [µm]"]
    assert table.texts() == [["u_x to p_x", "0.28000", "10e-6", "0.00200", "0.00500", "-", "-"]]
    assert table.notes == ["few"]


@pytest.mark.parametrize("published", [None, 0.02])
def test_deviations_from_surfaces_stand_beside_the_papers(published):
    row = {"name": "tau_x", "rms": 1e-5, "published_rms": published, "largest": 3e-5, "unit": "s", "recording": "r"}
    document = {
        "item": "surfaces", "recordings": 9, "operating_points": 9, "options": {"method": "mixed"}, "status": "found",
        "deviations": [row], "outliers": [], "orders": [], "notes": ["thin"], "path": "a.yaml",
    }  # fmt: skip
    table = lpv_table(document)
    numbers = ["0.01", "0.03"] if published is None else ["0.01", "20", "0.03"]
    assert table.texts() == [["tau_x", *numbers, "ms", "r"]]
    assert table.notes == ["", "note: thin", "model: a.yaml"]


def test_a_campaign_without_fits_has_one_table():
    stages = {"fit": {"made": 3, "kept": 0, "failed": 1, "not_converged": 2}}
    assert [t.texts() for t in campaign_tables({"stages": stages, "fits": []})] == [[["fit", "3", "0", "1", "2"]]]
    row = {"fit": "a", "fits": 0, "converged": 0, "missing": 4, "median_fit_percent": {}, "worst": None,
           "worst_fit_percent": None}  # fmt: skip
    assert campaign_tables({"stages": {}, "fits": [row]})[0].texts() == [["a", "0", "0", "4", "", "", ""]]


def test_recordings_tell_length_and_operating_point():
    row = {"name": "run", "samples": 500, "duration_s": 0.5, "conditions": {"pressure_bar": 6.0}, "state": "made"}
    assert recording_table([row]).texts() == [["run", "500", "0.5", "pressure_bar 6", "made"]]
