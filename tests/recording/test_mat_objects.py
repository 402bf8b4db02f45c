"""MATLAB files with objects: what is read by dotted names, and what is refused with the way out."""

import warnings

import numpy as np
import pandas as pd
import pytest
import refusals
import scipy.io
from experiment_files import json_of
from matio import save_to_mat
from matio.utils.matclass import MatlabObject, MatlabOpaque

import gbid
from gbid.core.errors import GbidError
from gbid.recording import import_recording, importing

N, H = 200, 0.01
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
    metadata = opaque("tsdata.timemetadata", Time_=2 * T, Length=float(N))
    stored = {"Data_": U, "Data": np.zeros((0, 0)), "Time": np.zeros((0, 0))}
    a, b = opaque("timeseries", TimeInfo_=info, **stored), opaque("timeseries", TimeInfo=metadata, **stored)
    path = file(tmp_path, version, a=a, b=b)
    for columns, time, values in (
        (("a.Data[1]", "a.Time"), "a.Time", [U[:, 1], 0.5 + T]),
        (("b.Time", "b.TimeInfo.Time"), "b.Time", [2 * T, 2 * T]),
    ):
        rec = read(path, *columns, time=time)
        np.testing.assert_allclose(rec.signals["s"], np.column_stack(values), atol=1e-15)
        assert rec.sample_time == pytest.approx(H if time == "a.Time" else 2 * H)


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
    assert "tab is a MATLAB table object; name one of its fields, such as u, y; or" in refused(path, "tab")
    assert "tab has no field 'U'; choose from u, y (MATLAB table; " in refused(path, "tab.U")


@VERSIONS
def test_what_cannot_be_read_names_class_and_way_out(tmp_path, version):
    several = opaque("iddata", InputData=cell(U, U), OutputData=cell(Y, Y))
    model = opaque("idss", A=np.eye(2), Report=opaque("idresults.ssest", Fit=1.0))
    path = file(tmp_path, version, data=several, sys=model, ts=opaque("timeseries", Name="empty"))
    text = refused(path, "sys")
    assert "column 'sys': sys is a MATLAB idss object; name one of its fields, such as A, Report" in text
    assert text.endswith(PLAIN)
    text = refused(path, "sys.Report")
    assert "sys.Report is a MATLAB idresults.ssest object" in text
    assert "ts has no field 'Data'" in (text := refused(path, "ts.Data"))
    assert text.endswith(f"(MATLAB timeseries; {PLAIN})")
    assert "data.InputData is an array of object, not an array of real numbers" in refused(path, "data.InputData[0]")


def test_a_reference_to_an_object_is_no_signal(tmp_path):
    """What mat-io returns of an object when the part of the file that describes objects is damaged."""
    scipy.io.savemat(tmp_path / "a.mat", {"u": np.array([[0xDD000000, 2, 1, 1, 1, 1]], np.uint32).T})
    assert "u is a MATLAB object" in refused(tmp_path / "a.mat", "u")


def test_a_damaged_object_is_named(tmp_path, monkeypatch):
    path = file(tmp_path, "v7", data=opaque("iddata", InputData=U))

    def fails(*_, **__):
        raise ValueError("unknown subsystem")

    monkeypatch.setattr("matio.load_from_mat", fails)
    monkeypatch.setattr(
        importing, "read_apart", lambda read, *arguments, **_: read(*arguments)
    )  # see it in this process
    text = refused(path, "data.InputData[0]")
    assert "not a readable MATLAB file at data (iddata)" in text
    assert f"unknown subsystem; {PLAIN}" in text


def merged(**more):
    """Two experiments as MATLAB's `merge` makes them, in milliseconds."""
    fields = {
        "InputData_": cell(U, U[:120]), "OutputData_": cell(Y, Y[:120]),
        "Ts_": cell(np.array([[10.0]]), np.array([[20.0]])),
        "Tstart_": cell(np.array([[0.0]]), np.array([[500.0]])), "TimeUnit_": "milliseconds", "Domain_": "Time",
        "InputName_": cell("force", "u2"), "InputUnit_": cell("N", "V"), "OutputName_": cell("gap"),
        "OutputUnit_": cell("um"), "ExperimentName_": cell("quiet", "loud"), "SamplingInstants_": cell(T[:0], T[:0]),
        "InterSample_": cell("zoh", "foh", "zoh", "foh"),
    }  # fmt: skip
    return opaque("iddata", **(fields | more))


@VERSIONS
def test_iddata_of_several_experiments_needs_no_mapping(tmp_path, version):
    path = file(tmp_path, version, z=merged(), other=Y)
    quiet, loud = gbid.recording.load_iddata(path)
    assert (quiet.name, loud.name) == ("quiet", "loud")
    assert (quiet.sample_time, loud.sample_time) == (0.01, 0.02)
    assert dict(loud.units) == {"force": "N", "u2": "V", "gap": "um"}
    np.testing.assert_array_equal(loud.signal("force")[:, 0], U[:120, 0])
    np.testing.assert_array_equal(quiet.signal("gap"), Y)
    assert (loud.provenance["start_s"], loud.provenance["intersample"]) == ("0.5", "zoh, foh")


def test_sample_times_in_a_vector_and_no_names(tmp_path):
    bare = {
        "Ts_": np.array([[10.0, 20.0]]),
        "Tstart_": np.zeros((0, 0)),
        "InputName_": cell("", ""),
        "InputUnit_": cell(),
    }
    bare |= {"ExperimentName_": cell(), "OutputName_": np.zeros((0, 0)), "TimeUnit_": np.zeros((0, 0))}
    first, second = gbid.recording.load_iddata(file(tmp_path, "v7", z=merged(**bare)))
    assert (first.name, second.name, second.sample_time) == ("Exp1", "Exp2", 20.0)
    assert list(second.signals) == ["u1", "u2", "y1"]
    one = opaque("iddata", InputData=U, OutputData=Y, Ts=np.array([[H]]))
    (alone,) = gbid.recording.load_iddata(file(tmp_path, "v7", a=one, z=merged()), "a")
    assert (alone.sample_time, alone.units["y1"]) == (H, "")


def test_an_experiment_names_its_channels_in_the_yaml(tmp_path, capsys):
    path = file(tmp_path, "v7", z=merged())
    rows = {row["channel"]: row for row in json_of(capsys, "peek", str(path))["channels"]}
    assert list(rows) == [f"z.{e}.{c}" for e in ("quiet", "loud") for c in ("force", "u2", "gap")]
    assert (rows["z.loud.gap"]["unit"], rows["z.loud.gap"]["sample_time_s"]) == ("um", 0.02)
    signals = "{force: {columns: z.loud.force}, gap: {columns: z.loud.gap, stored_unit: m}}"
    text = f"format: 1\nname: own\nimport:\n  recordings:\n    - {{name: loud, file: a.mat, signals: {signals}}}\n"
    (tmp_path / "own.yaml").write_text(text)
    json_of(capsys, "import", tmp_path / "own.yaml")
    recording = gbid.load_recording(tmp_path / "results" / "own" / "recordings" / "loud.h5")
    assert recording.sample_time == 0.02
    np.testing.assert_allclose(recording.signal("gap"), 1e-6 * Y[:120])


def test_sampling_instants_are_kept(tmp_path):
    instants = T + 1e-3 * np.sin(np.arange(len(T)))[:, None]
    variables = {"z": merged(Ts_=cell(T[:0], T[:0]), SamplingInstants_=cell(instants, T[:120]))}
    irregular, even = gbid.recording.load_iddata(file(tmp_path, "v7", **variables))
    np.testing.assert_allclose(irregular.time, 1e-3 * (instants - instants[0])[:, 0], atol=1e-12)
    assert irregular.stamps is not None
    assert even.stamps is None
    assert even.sample_time == pytest.approx(1e-3 * H)


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"z": merged(Domain_="Frequency")}, "data over frequency; give frequency responses"),
        ({"z": merged(TimeUnit_="fortnights")}, "the time unit 'fortnights' is not one of nanoseconds"),
        ({"z": merged(OutputData_=cell(Y))}, "has 1 experiments of outputs and 2 of inputs"),
        ({"z": merged(Ts_=cell(T[:0], T[:0]))}, "experiment 1 has neither a sample time Ts nor SamplingInstants"),
        ({"z": merged(OutputName_=cell("force"))}, "'force' is an input and an output; rename one"),
        ({"z": merged(), "w": merged()}, "has the iddata objects z, w; name one"),
        ({"y": Y}, "has no iddata object; import its arrays"),
    ],
)
def test_what_iddata_cannot_be_read_is_named(tmp_path, variables, words):
    with pytest.raises(GbidError, match=words):
        gbid.recording.load_iddata(file(tmp_path, "v7", **variables))


def test_objects_with_their_own_starts(tmp_path):
    def recorded(start):
        return opaque("iddata", InputData=U, OutputData=Y, Ts=np.array([[H]]), Tstart=np.array([[start]]))

    def series(start):
        return opaque("timeseries", Data=Y, Time=T + start)

    for made, columns in ((recorded, ["a.y1", "b.y1"]), (series, ["a.Data", "b.Data"])):
        mapping = {"signals": {"s": {"columns": columns}}}
        rec = import_recording(file(tmp_path, "v7", a=made(0.0), b=made(15 * H)), mapping)
        np.testing.assert_array_equal(rec.signals["s"], np.column_stack([Y[15:], Y[:-15]]))
        with pytest.raises(GbidError, match=r"0\.5 of a sample off"):
            import_recording(file(tmp_path, "v7", a=made(0.0), b=made(2.5 * H)), mapping)
