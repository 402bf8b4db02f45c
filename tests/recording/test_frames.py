"""Recordings and data frames of pandas, arrays of one dimension, stretches, and pictures."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated

import gbid
from gbid.core.errors import DataError, UsageError


@pytest.fixture(scope="module")
def rec():
    data = simulated(MODE, MODE_AT, levels(600, hold=2), noise=0.3)
    two = {"p": np.column_stack([data.signal("y"), -data.signal("y")]), **data.signals}
    units = {"p": "m", "y": "V"}
    return gbid.Recording(two, data.sample_time, {"speed_rpm": 3.0}, "run", units, {"p": ("x", "y")})


@pytest.fixture(scope="module")
def result(rec):
    return gbid.fit(MODE, rec, focus="simulation")


def test_there_and_back(rec):
    frame = rec.to_frame()
    assert list(frame.columns) == ["p.x", "p.y", *(f"{name}.1" for name in rec.signals if name != "p")]
    assert frame.attrs["units"] == {"p.x": "m", "p.y": "m", "y.1": "V"}
    assert frame.attrs["conditions"] == {"speed_rpm": 3.0}
    back = gbid.Recording.from_frame(frame, units=rec.units, conditions=rec.conditions, name="run")
    assert back.sample_time == rec.sample_time
    assert back.channels == dict(rec.channels)
    assert repr(back) == repr(rec)
    for name, values in rec.signals.items():
        np.testing.assert_array_equal(back.signal(name), values)


def test_columns_by_name_and_times_of_every_kind():
    t = pd.to_datetime("2024-05-01") + pd.to_timedelta(0.002 * np.arange(50), unit="s")
    frame = pd.DataFrame({"when": t, "ux": np.arange(50), "uy": -np.arange(50), "note": ["a"] * 50})
    rec = gbid.Recording.from_frame(frame, {"u": ["ux", "uy"], "v": "ux"}, time="when")
    assert (rec.sample_time, rec.signal("u").shape, rec.signal("v").shape) == (0.002, (50, 2), (50, 1))
    assert gbid.Recording.from_frame(frame.set_index("when")[["ux"]]).sample_time == 0.002
    assert gbid.Recording.from_frame(frame[["ux"]], sample_time=0.1).channels["ux"] == ("1",)
    for reason, kind, arguments in (
        ("index numbers the rows; give sample_time", UsageError, (frame[["ux"]],)),
        ("no column 'w'; it has when, ux", UsageError, (frame, {"u": "w"})),
        ("'note' is not an array of real numbers", DataError, (frame[["note"]].set_index(t),)),
        ("step 0.004 s at row 6, median step 0.002 s", DataError, (frame[["ux"]].set_index(t).drop(t[6]),)),
    ):
        with pytest.raises(kind, match=reason):
            gbid.Recording.from_frame(*arguments)


@pytest.mark.parametrize("stamps", [None, np.cumsum(np.linspace(1.0, 2.0, 600))])
def test_there_and_back_by_xarray(rec, tmp_path, stamps):
    pytest.importorskip("xarray", reason="xarray is not installed: pip install 'gbid[xarray]'")
    provenance = {"source_file": "a.csv"}
    sent = replace(rec, provenance=provenance, stamps=stamps)
    dataset = sent.to_xarray()
    assert dataset["p"].dims == ("time", "p_channel")
    assert dataset["p"].attrs["units"] == "m"
    assert dataset.attrs == {"name": "run", "speed_rpm": 3.0} | provenance
    dataset.to_netcdf(tmp_path / "a.nc", engine="scipy")
    import xarray

    for each in (dataset, xarray.load_dataset(tmp_path / "a.nc", engine="scipy", decode_times=False)):
        back = gbid.Recording.from_xarray(each)
        for key in ("sample_time", "name", "conditions", "units", "channels", "provenance"):
            assert getattr(back, key) == getattr(sent, key)
        np.testing.assert_array_equal(back.time, sent.time)
        for name, values in sent.signals.items():
            np.testing.assert_array_equal(back.signal(name, irregular=True), values)


def test_datasets_of_others():
    xarray = pytest.importorskip("xarray", reason="xarray is not installed: pip install 'gbid[xarray]'")
    t = np.datetime64("2026-11-22") + (2_000_000 * np.arange(50)).astype("m8[ns]")
    variables = {"u": ("when", np.arange(50)), "map": (("x", "when"), np.zeros((3, 50)))}
    dataset = xarray.Dataset(variables, {"when": t}, {"speed_rpm": np.int64(3), "station": "A", "box": [1, 2]})
    rec = gbid.Recording.from_xarray(dataset, ["u"], time="when", units={"u": "V"}, conditions={"load": 1.0})
    assert (rec.sample_time, rec.units["u"], rec.signal("u").shape) == (0.002, "V", (50, 1))
    assert (rec.conditions, rec.provenance) == ({"speed_rpm": 3.0, "load": 1.0}, {"station": "A"})
    late = dataset[["u"]].assign_coords(when=("when", 2.0 * np.arange(50), {"units": "ms"}))
    assert gbid.Recording.from_xarray(late, time="when").sample_time == 0.002
    for reason, given, arguments in (
        (r"'map' has the dimensions \('x', 'when'\)", dataset, {}),
        ("no variable 'w'; it has u, map", dataset, {"signals": ["w"]}),
        ("no coordinate 'when'", dataset.drop_vars("when"), {"signals": ["u"]}),
    ):
        with pytest.raises(UsageError, match=reason):
            gbid.Recording.from_xarray(given, time="when", **arguments)
    with pytest.raises(DataError, match="not evenly spaced"):
        gbid.Recording.from_xarray(dataset[["u"]].drop_isel(when=6), time="when")


def test_one_dimension_is_one_channel():
    u = np.sin(np.arange(30.0))
    rec = gbid.Recording({"u": u, "y": u[:, None]}, 0.1)
    np.testing.assert_array_equal(rec.signal("u"), rec.signal("y"))
    model = gbid.LinearModel([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    np.testing.assert_array_equal(model.simulate(u, 0.1), model.simulate(u[:, None], 0.1))
    np.testing.assert_array_equal(model.predict(u, u, 0.1), model.predict(u[:, None], u[:, None], 0.1))
    two = gbid.LinearModel([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])
    with pytest.raises(UsageError, match=r"\(30,\), expected \(n_samples, 2\)"):
        two.simulate(u, 0.1)


def test_a_stretch_of_a_recording(rec):
    assert len(rec) == rec.n_samples == 600
    part = rec[100:200]
    assert len(part) == 100
    np.testing.assert_array_equal(part.signal("p"), rec.signal("p")[100:200])
    assert len(rec[-50:]) == 50
    with pytest.raises(UsageError, match="without a filter"):
        rec[::2]
    with pytest.raises(UsageError, match=r"recording\.signal\(name\)"):
        rec["p"]
    with pytest.raises(TypeError, match="not iterable"):
        list(rec)


def test_results_as_frames(rec, result):
    frame = result.to_frame()
    assert frame.loc["w", "std"] == result.std["w"]
    assert set(frame.index) == set(result.parameters)
    validation = gbid.cross_validate(result, rec)
    np.testing.assert_array_equal(validation.to_frame()["y_simulated"], validation.simulated[:, 0])
    bode = result.bode([0.5, 1.0]).to_frame()
    assert bode["frequency_hz"].tolist() == [0.5, 1.0]
    assert gbid.measured_response(rec, "u", "y").to_frame()["coherence"].between(0, 1).all()
    scores = gbid.validate.cross_validate_many([result], [rec.slice(0, 500, "other")]).to_frame()
    assert scores.loc[0, "fit_percent_y"] == pytest.approx(validation.fit_percent[0], abs=1.0)
    assert scores.loc[0, "recording"] == "other"


def test_pandas_is_wanted_only_for_frames(monkeypatch, rec):
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(UsageError, match=r"pip install 'gbid\[pandas\]'"):
        rec.to_frame()


def test_values_draw_themselves(rec, result):
    panels = rec.plot(signals=("p", "y"), from_s=1.0)
    assert [ax.get_ylabel() for ax in panels] == ["$p$ [mm]", "$y$ [V]"]
    assert panels[0].lines[0].get_xdata()[0] == pytest.approx(1.0)
    assert rec.plot(panels, signals=("p", "y"))[0] is panels[0]
    assert result.plot()[0, 0].get_ylabel() == "magnitude [output/input]"
    assert result.model.plot().shape == (2, 1)
    assert gbid.measured_response(rec, "u", "y").plot().shape == (3, 1)
    assert gbid.cross_validate(result, rec).plot().shape == (2,)
    assert gbid.check_residuals(result, rec).plot().shape == (1, 2)
    before = plt.get_fignums()
    plt.ion()
    try:
        drawn = rec.plot()
        assert plt.gcf() is drawn[0].figure
        assert plt.isinteractive()  # else a notebook shows the first picture only
        with pytest.raises(UsageError, match="no samples"):
            rec.plot(from_s=1e3)
        assert len(plt.get_fignums()) == len(before) + 1
    finally:
        plt.ioff()
        plt.close("all")
    with pytest.raises(UsageError, match="no picture belongs to float; there is one for FitResult"):
        gbid.report.plot(1.0)


@pytest.mark.parametrize("call", [gbid.fit, gbid.fit_multistart, gbid.cross_validate, gbid.check_residuals])
def test_data_first_is_told(call, rec, result):
    expected_argument = "structure" if call in (gbid.fit, gbid.fit_multistart) else "result"
    with pytest.raises(
        UsageError,
        match=rf"{expected_argument} = .*; the order is the other way round: \w+\({expected_argument}, recording",
    ):
        call([rec] if call is gbid.fit else rec, result)
