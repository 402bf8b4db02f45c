import csv
from dataclasses import fields

import numpy as np
import pytest

import gbid
from gbid.core import hdf5
from gbid.core.errors import DataError, UsageError
from gbid.core.tables import write_csv
from gbid.identify.table import TableEntry, csv_table, tabulate
from gbid.rig import Machine, Prbs, record

POINT = {"pressure_bar": 6.0, "speed_rpm": 0.0}


@pytest.fixture(scope="module")
def fits():
    """Two bearing fits, one with a fixed parameter, and one of the piezos."""
    model = gbid.load_model("theisen2016")
    truth = {name: float(np.asarray(value)) for name, value in model.key_parameters(6.0, 0.0).items()}
    machine = Machine.from_parameters(truth, model.actuators)
    rec = record(machine, Prbs(0.6), conditions=POINT, seed=1, name="run1")
    bearing = gbid.RotorBearing(disturbance_gain="none")
    common = {"focus": "simulation", "stop": "paper"}
    return {
        "free": gbid.fit(bearing, rec, **common),
        "fixed": gbid.fit(bearing, rec, fixed={"tau_y": truth["tau_y"]}, **common),
        "piezos": gbid.fit(gbid.PiezoPair(disturbance_gain="none"), rec, **common),
    }


@pytest.fixture(scope="module")
def table(fits):
    return tabulate(
        [
            TableEntry("bearing", "run1", ("run1",), POINT, fits["free"]),
            TableEntry("bearing", "run2", ("run2",), {**POINT, "pressure_bar": 3.0}, fits["fixed"]),
            TableEntry("bearing", "run3", ("run3",), POINT, failure="failed: a dead sensor"),
            TableEntry("piezos", "run1", ("run1",), {}, fits["piezos"]),
        ]
    )


def test_columns_are_those_of_all_fits(table, fits):
    names = [*fits["free"].parameters, *fits["piezos"].parameters]
    assert table.parameter_names == tuple(dict.fromkeys(names))
    assert table.output_names == ("p_x", "p_y", "u_x", "u_y")
    assert table.values.shape == (4, len(names))
    assert table.covariance.shape == (4, len(names), len(names))
    assert np.isnan(table.values[2]).all()
    assert np.isnan(table.parameter("p1_x")[:3]).all()
    assert table.status[2] == "failed: a dead sensor"
    np.testing.assert_array_equal(table.success, [True, True, False, True])
    np.testing.assert_array_equal(table.pressure_bar, [6.0, 3.0, 6.0, np.nan])


def test_numbers_are_those_of_the_fits(table, fits):
    for row, name in ((0, "free"), (1, "fixed"), (3, "piezos")):
        result, free = fits[name], fits[name].free
        for parameter, value in result.parameters.items():
            assert table.parameter(parameter)[row] == value
        np.testing.assert_array_equal(table.covariance_of(free)[row], result.covariance)
        shown = table.row(table.fit[row], table.model[row])
        modes = result.model.modes()  # none of the piezos
        assert [(shown[f"mode{i + 1}_frequency_hz"], shown[f"mode{i + 1}_damping"]) for i in range(len(modes))] == modes
        for i, output in enumerate(result.model.output_names):
            assert shown[f"fit_percent_{output}"] == result.fit_percent[0, i]
            for j, source in enumerate(result.model.input_names):
                assert shown[f"gain_{source}_to_{output}"] == result.model.static_gain()[i, j]
                assert shown[f"gain_{source}_to_{output}_std"] == result.static_gain_std[i, j]


def test_a_fixed_parameter_has_no_covariance(table, fits):
    at = table.parameter_names.index("tau_y")
    columns = [table.parameter_names.index(name) for name in fits["fixed"].parameters]
    assert table.std[1, at] == 0.0
    assert not table.covariance[1, at, columns].any()
    assert table.covariance[0, at, at] > 0


def test_select_keeps_rows_and_their_columns(table, fits):
    bearing = table.select(fit="bearing")
    assert (len(bearing), bearing.parameter_names) == (3, tuple(fits["free"].parameters))
    assert bearing.output_names == ("p_x", "p_y")
    assert bearing.covariance.shape == (3, 14, 14)
    assert bearing.recordings == (("run1",), ("run2",), ("run3",))
    assert list(bearing.select(success=False).model) == ["run3"]
    assert list(table.select(pressure_bar=6.0, speed_rpm=0.0).model) == ["run1", "run3"]
    assert list(table.select([True, False, False, True]).fit) == ["bearing", "piezos"]
    assert bearing.select(np.zeros(3, dtype=bool)).parameter_names == ()
    for wrong in ({"fit": "bearings"}, {"mask": [True]}, {"mask": [1, 0, 0, 1]}):
        with pytest.raises(UsageError):
            table.select(**wrong)
    for call in (
        lambda: table.parameter("k"),
        lambda: table.row("bearing", "run9"),
        lambda: table.covariance_of(["k"]),
    ):
        with pytest.raises(UsageError):
            call()


def test_round_trip(table, tmp_path):
    gbid.save(table, tmp_path / "table.h5")
    again = gbid.load(tmp_path / "table.h5")
    for field in fields(table):
        first, second = getattr(table, field.name), getattr(again, field.name)
        if isinstance(first, np.ndarray):
            np.testing.assert_array_equal(second, first)
            assert second.dtype.kind == first.dtype.kind
        else:
            assert second == first
    with pytest.raises(UsageError, match="exists already"):
        gbid.save(table, tmp_path / "table.h5")
    empty = tabulate([])
    gbid.save(empty, tmp_path / "empty.h5")
    assert len(gbid.load(tmp_path / "empty.h5")) == 0


def test_csv_holds_the_columns_bit_for_bit(table, tmp_path):
    write_csv(csv_table(table), tmp_path / "table.csv")
    lines = (tmp_path / "table.csv").read_text().splitlines()
    assert "k_xx_std [N/(kg m)]" in lines[0]
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert list(rows[0]) == list(table.columns())
    for name, (values, _) in table.columns().items():
        for row, value in zip(rows, values, strict=True):
            if values.dtype.kind == "f":
                assert row[name] == ("" if np.isnan(value) else repr(float(value)))
            else:
                assert row[name] == (str(value).lower() if values.dtype.kind == "b" else str(value))


def test_a_fit_to_several_recordings_shows_its_worst(fits):
    result = fits["free"]
    percent = np.array([[90.0, 80.0], [70.0, 95.0]])
    both = result.changed(recordings=("run1", "run2"), fit_percent=percent)
    table = tabulate([TableEntry("bearing", "together", ("run1", "run2"), {}, both)])
    np.testing.assert_array_equal(table.fit_percent, [[70.0, 80.0]])
    assert table.recordings == (("run1", "run2"),)
    assert table.row("bearing", "together")["recordings"] == "run1 run2"


def test_damaged_tables_are_refused(table, tmp_path):
    path = tmp_path / "table.h5"
    gbid.save(table, path)
    with hdf5.changing(path) as file:
        del file["std"]
        file["std"] = np.zeros((4, 2))
    with pytest.raises(DataError, match=r"/std has shape \(4, 2\), expected \(4, 20\)"):
        gbid.load(path)
    gbid.save(table, path, overwrite=True)
    with hdf5.changing(path) as file:
        del file["status"]
    with pytest.raises(DataError, match="/status is missing"):
        gbid.load(path)
    (tmp_path / "table.csv").write_text("fit,model\n")
    with pytest.raises(DataError, match="HDF5"):
        gbid.load(tmp_path / "table.csv")
