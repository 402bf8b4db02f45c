"""MATLAB files with objects: what is read by dotted names, and what is refused with the way out."""

import warnings

import numpy as np
import pandas as pd
import pytest
import refusals
from matio import save_to_mat
from matio.utils.matclass import MatlabObject, MatlabOpaque

from gbid.recording import import_recording, importing

N, H = 50, 0.01
T = H * np.arange(N)[:, None]
U = np.random.default_rng(1).standard_normal((N, 2))
Y = np.random.default_rng(2).standard_normal((N, 1))
VERSIONS = pytest.mark.parametrize("version", ["v7", "v7.3"])
PLAIN = "save plain arrays in MATLAB: u = data.u; y = data.y; save('plain.mat','u','y','-v7')"


def cell(*entries):
    made = np.empty((1, len(entries)), dtype=object)
    made[0, :] = entries
    return made


def struct(**fields):
    made = np.empty((1, 1), dtype=[(name, object) for name in fields])
    for name, value in fields.items():
        made[name][0, 0] = value
    return made


def opaque(classname, **properties):
    return MatlabOpaque(properties=properties, classname=classname)


def file(tmp_path, version, **variables):
    path = tmp_path / "a.mat"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the unit of durations
        save_to_mat(str(path), variables, version=version)
    return path


def read(path, *columns, time=None):
    mapping = {"signals": {"s": {"columns": list(columns)}}}
    mapping |= {"time": time} if time else {"sample_time": H}
    return import_recording(path, mapping)


def refused(path, column):
    return refusals.refused(path, {"signals": {"s": {"columns": [column]}}, "sample_time": H})


@VERSIONS
def test_timeseries_beside_arrays_and_in_a_struct(tmp_path, version):
    ts = opaque("timeseries", Data=U, Time=T, Name="drive")
    path = file(tmp_path, version, ts=ts, y=Y, run={"log": ts, "y": Y})
    rec = read(path, "ts.Data[0]", "ts.Data[1]", "y", "run.log.Data[1]", "run.y", time="ts.Time")
    np.testing.assert_array_equal(rec.signals["s"], np.column_stack([U, Y, U[:, 1], Y]))
    assert rec.sample_time == H


@VERSIONS
def test_timeseries_as_matlab_stores_it(tmp_path, version):
    """Properties that are computed have a stored twin with an underscore; uniform times are start and increment."""
    info = opaque("tsdata.timemetadata", Start_=0.5, Increment_=H, Length=float(N), Time_=np.zeros((0, 0)))
    own = opaque("tsdata.timemetadata", Time_=2 * T, Length=float(N))
    stored = {"Data_": U, "Data": np.zeros((0, 0)), "Time": np.zeros((0, 0))}
    a, b = opaque("timeseries", TimeInfo_=info, **stored), opaque("timeseries", TimeInfo=own, **stored)
    path = file(tmp_path, version, a=a, b=b)
    rec = read(path, "a.Data[1]", "a.Time", "b.Time", "b.TimeInfo.Time", time="a.Time")
    np.testing.assert_allclose(rec.signals["s"], np.column_stack([U[:, 1], 0.5 + T, 2 * T, 2 * T]), atol=1e-15)
    assert rec.sample_time == H


@VERSIONS
@pytest.mark.parametrize("old", [False, True])
def test_iddata_of_one_experiment(tmp_path, version, old):
    fields = {
        "InputData": cell(U), "OutputData": cell(Y), "Ts": cell(np.array([[H]])), "SamplingInstants": cell(T),
        "InputName": cell("a", "b"), "InputUnit": cell("V", "V"),
    }  # fmt: skip
    data = MatlabObject(struct(**fields), "iddata") if old else opaque("iddata", **fields)
    rec = read(file(tmp_path, version, data=data), "data.InputData[1]", "data.OutputData", time="data.SamplingInstants")
    np.testing.assert_array_equal(rec.signals["s"], np.column_stack([U[:, 1], Y]))
    plain = opaque("iddata", InputData_=U, OutputData_=Y)  # without cells, with stored twins
    rec = read(file(tmp_path, version, data=plain), "data.InputData[0]", "data.OutputData[0]")
    np.testing.assert_array_equal(rec.signals["s"], np.column_stack([U[:, 0], Y]))


@VERSIONS
def test_tables_and_times(tmp_path, version):
    seconds = pd.to_timedelta(T[:, 0], unit="s").astype("timedelta64[ms]")
    columns = {"u": U[:, 0], "y": Y[:, 0]}
    days = (pd.Timestamp("2026-01-05") + seconds).to_numpy().astype("datetime64[ms]")
    path = file(
        tmp_path,
        version,
        tab=pd.DataFrame(columns),
        tt=pd.DataFrame(columns, index=pd.Index(seconds, name="Time")),
        clock=days[:, None],
    )
    rec = read(path, "tab.u", "tt.y", "clock", time="tt.Time")
    np.testing.assert_allclose(rec.signals["s"], np.column_stack([U[:, 0], Y[:, 0], T[:, 0]]), atol=1e-12)
    assert rec.sample_time == pytest.approx(H, rel=1e-12)
    assert "tab is a MATLAB table object; name one of its fields, there is u, y; or" in refused(path, "tab")
    assert "tab has no field 'U'; there is u, y (MATLAB table; " in refused(path, "tab.U")


@VERSIONS
def test_what_cannot_be_read_names_class_and_way_out(tmp_path, version):
    several = opaque("iddata", InputData=cell(U, U), OutputData=cell(Y, Y))
    model = opaque("idss", A=np.eye(2), Report=opaque("idresults.ssest", Fit=1.0))
    path = file(tmp_path, version, data=several, sys=model, ts=opaque("timeseries", Name="empty"))
    text = refused(path, "sys")
    assert "column 'sys': sys is a MATLAB idss object; name one of its fields, there is A, Report" in text
    assert text.endswith(PLAIN)
    text = refused(path, "sys.Report")
    assert "sys.Report is a MATLAB idresults.ssest object" in text
    assert "ts has no field 'Data'" in (text := refused(path, "ts.Data"))
    assert text.endswith(f"(MATLAB timeseries; {PLAIN})")
    assert "data.InputData is an array of object, not an array of real numbers" in refused(path, "data.InputData[0]")


def test_a_damaged_object_is_named(tmp_path, monkeypatch):
    path = file(tmp_path, "v7", data=opaque("iddata", InputData=U))

    def fails(*_, **__):
        raise ValueError("unknown subsystem")

    monkeypatch.setattr("matio.load_from_mat", fails)
    monkeypatch.setattr(importing, "read_apart", lambda read, *arguments: read(*arguments))  # see it in this process
    text = refused(path, "data.InputData[0]")
    assert "not a readable MATLAB file at data (iddata)" in text
    assert f"unknown subsystem; {PLAIN}" in text
