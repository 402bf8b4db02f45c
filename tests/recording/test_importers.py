"""Import from csv, npz and mat files by a mapping."""

import hashlib
import os
import pickle
import re
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from places import DOCS, MEASURED
from refusals import refused
from ruamel.yaml import YAML

from gbid.core.errors import DataError, UsageError
from gbid.recording import (
    ImportMapping,
    SignalMapping,
    import_recording,
    importing,
    load_recording,
    save_recording,
    text_files,
)
from gbid.recording.importing import Peek, list_channels, peek, read_layout

N, DT = 300, 2e-4
RNG = np.random.default_rng(5)
DATA = RNG.standard_normal((N, 4))
T = DT * np.arange(N)
BOTH = {"columns": ["a", "b"], "unit": "um"}


def write_csv(path, header="t,a,b,c,d", values=None, sep=",", encoding="utf-8", eol="\n"):
    values = np.column_stack([T, DATA]) if values is None else values
    rows = [sep.join(repr(float(v)) for v in row) for row in values]
    path.write_bytes(eol.join([header.replace(",", sep), *rows, ""]).encode(encoding))
    return path


def write_v73(path, variables):
    """Write a file as MATLAB does for -v7.3: user block, HDF5, arrays by columns, structs as groups."""

    def put(group, name, value):
        if isinstance(value, dict):
            child = group.create_group(name)
            child.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, entry in value.items():
                put(child, key, entry)
        elif isinstance(value, str):
            dataset = group.create_dataset(name, data=np.array([[ord(c)] for c in value], dtype="u2"))
            dataset.attrs["MATLAB_class"] = np.bytes_("char")
        else:
            dataset = group.create_dataset(name, data=np.asarray(value).T)
            dataset.attrs["MATLAB_class"] = np.bytes_("double")

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            put(file, name, value)
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  5 10:00:00 2015 HDF5 schema 1.00 ."
    with path.open("r+b") as handle:
        handle.write(text.ljust(116) + bytes(8) + b"\x00\x02IM")
    return path


def write_v5(path, variables):
    scipy.io.savemat(path, variables, do_compression=True)
    return path


def write_v4(path, variables):
    scipy.io.savemat(path, variables, format="4")
    return path


MAT_WRITERS = pytest.mark.parametrize("write", [write_v5, write_v73])


# What is read


def test_csv_to_si_with_provenance(tmp_path):
    path = write_csv(tmp_path / "run 7.csv")
    mapping = ImportMapping(
        {"u": SignalMapping(("c", "a"), "um"), "volt": SignalMapping(("d",), "V", channels=("ch1",))},
        sample_time=DT,
        conditions={"pressure_bar": 6, "speed_rpm": 0},
    )
    rec = import_recording(path, mapping)
    np.testing.assert_allclose(rec.signals["u"], 1e-6 * DATA[:, [2, 0]], rtol=1e-15)
    np.testing.assert_array_equal(rec.signals["volt"], DATA[:, [3]])
    assert dict(rec.units) == {"u": "m", "volt": "V"}
    assert dict(rec.channels) == {"u": ("x", "y"), "volt": ("ch1",)}
    assert dict(rec.conditions) == {"pressure_bar": 6.0, "speed_rpm": 0.0}
    assert (rec.name, rec.sample_time) == ("run 7", DT)
    assert rec.provenance["source_file"] == "run 7.csv"
    assert rec.provenance["source_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    save_recording(rec, tmp_path / "a.h5")
    assert load_recording(tmp_path / "a.h5").provenance == rec.provenance


@pytest.mark.parametrize("sep", [",", ";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_csv_dialects(tmp_path, sep, encoding, eol):
    path = write_csv(tmp_path / "a.CSV", sep=sep, encoding=encoding, eol=eol)
    rec = import_recording(path, {"signals": {"x": {"columns": ["a", "d"]}}, "sample_time": DT})
    np.testing.assert_array_equal(rec.signals["x"], DATA[:, [0, 3]])


def test_csv_with_comments_quotes_blanks_and_text_in_other_columns(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('# rig, 7\n\n"time; s"; "p_x (um)"; note\n0 ;1.5; "a;b"\n # stop\n1; -2e0;\n\n2;"3";x\n')
    rec = import_recording(path, {"signals": {"z": {"columns": "p_x"}}, "time": "time; s"})
    np.testing.assert_array_equal(rec.signals["z"], [[1.5], [-2.0], [3.0]])
    assert rec.units["z"] == "um"
    assert rec.sample_time == 1.0


@pytest.mark.parametrize("header", ["t,u_x [um],u_y (mm),c,d", "t, u_x[um] ,u_y(mm),c,d"])
def test_units_in_the_header(tmp_path, header):
    path = write_csv(tmp_path / "a.csv", header)
    for mapping in ({"columns": ["u_x", "u_y"]}, {"columns": [h.strip() for h in header.split(",")[1:3]]}):
        rec = import_recording(path, {"signals": {"u": mapping}, "sample_time": DT})
        np.testing.assert_allclose(rec.signals["u"], DATA[:, :2] * [1e-6, 1e-3], rtol=1e-15)
    same = {"columns": ["u_x"], "unit": "µm", "channels": ["x"]}
    rec = import_recording(path, {"signals": {"u": same}, "sample_time": DT})
    np.testing.assert_allclose(rec.signals["u"], 1e-6 * DATA[:, :1], rtol=1e-15)
    differs = {"columns": ["u_x"], "unit": "mm", "channels": ["x"]}
    mapping = {"signals": {"u": differs}, "sample_time": DT}
    refused(path, mapping, "'u_x'", "header says 'um'", "mapping 'mm'")


def test_units_of_a_rig_of_ones_own(tmp_path):
    path = write_csv(tmp_path / "a.csv")

    def stored(name, **entry):
        rec = import_recording(path, {"signals": {name: {"columns": ["a", "b"], **entry}}, "sample_time": DT})
        return rec.units[name], rec.signals[name][0, 0] / DATA[0, 0]

    assert stored("y", unit="counts") == ("counts", 1.0)
    assert stored("y") == ("", 1.0)
    assert stored("y", unit="mm", stored_unit="m") == ("m", pytest.approx(1e-3))
    assert stored("u", unit="V", stored_unit="V") == ("V", 1.0)
    assert stored("u", unit="", stored_unit="") == ("", 1.0)
    mapping = {"signals": {"u": {"columns": ["a", "b"]}}, "sample_time": DT}
    refused(path, mapping, "signal 'u'", "column 'a'", "no unit", error=UsageError)
    mapping = {"signals": {"u": {"columns": ["a", "b"], "unit": "V"}}, "sample_time": DT}
    refused(path, mapping, "signal 'u'", "'V' cannot be converted to 'm'", error=UsageError)
    refused(path, mapping, "rename the signal, or give stored_unit: V", error=UsageError)


def test_npz_vectors_and_columns(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, data=DATA, v=DATA[:, 1], w=DATA[:, [2]], i=np.arange(N))
    columns = ["data[0]", "v", "w", "w[0]", "i"]
    rec = import_recording(path, {"signals": {"s": {"columns": columns}}, "sample_time": DT})
    expected = np.column_stack([DATA[:, 0], DATA[:, 1], DATA[:, 2], DATA[:, 2], np.arange(N)])
    np.testing.assert_array_equal(rec.signals["s"], expected)


@MAT_WRITERS
def test_mat_has_the_shape_that_matlab_shows(tmp_path, write):
    inner = {"u": DATA[:, :2], "deep": {"p": DATA[:, [2]]}, "note": "hello"}
    content = {"y": DATA, "row": DATA[:, 0][None, :], "col": DATA[:, [1]], "data": inner, "Ts": DT}
    path = write(tmp_path / "a.mat", content)
    columns = ["y[3]", "row", "col", "col[0]", "data.u[1]", "data.deep.p"]
    rec = import_recording(path, {"signals": {"s": {"columns": columns}}, "sample_time": DT})
    np.testing.assert_array_equal(rec.signals["s"], DATA[:, [3, 0, 1, 1, 1, 2]])


def test_mat_version_4_and_integers(tmp_path):
    counts = np.arange(N)[:, None]
    rec = import_recording(
        write_v4(tmp_path / "a.mat", {"c": counts}), {"signals": {"s": {"columns": ["c"]}}, "sample_time": DT}
    )
    np.testing.assert_array_equal(rec.signals["s"], counts)


GAPS = "t,u,y\n0,1,5\n0.1,,6\n0.2,3,\n0.3,nan,8\n0.6,5,9\n"


def test_missing_cells_and_steps_are_missing_samples(tmp_path):
    """What the rows mean is written out by hand."""
    path = tmp_path / "a.csv"
    path.write_text(GAPS)
    mapping = {"signals": {"u": {"columns": ["u"], "unit": "V", "stored_unit": "V", "hold": True}}, "sample_time": 0.1}
    mapping["signals"]["y"] = {"columns": ["y"], "unit": "V", "stored_unit": "V"}
    rec = import_recording(path, mapping)
    np.testing.assert_array_equal(rec.signals["u"][:, 0], [1, 1, 3, 3, 5])
    np.testing.assert_array_equal(rec.signals["y"][:, 0], [5, 6, np.nan, 8, 9])
    remarks = rec.provenance["import_remarks"]
    assert "signal 'u': 2 samples missing, the last value held" in remarks
    assert "signal 'y': 1 samples missing" in remarks
    timed = {**mapping, "time": "t", "gaps": "missing"}
    for sample_time in (0.1, None):
        rec = import_recording(path, {**timed, "sample_time": sample_time})
        np.testing.assert_array_equal(rec.signals["u"][:, 0], [1, 1, 3, 3, 3, 3, 5])
        np.testing.assert_array_equal(rec.signals["y"][:, 0], [5, 6, np.nan, 8, np.nan, np.nan, 9])
        assert rec.sample_time == 0.1
        assert "2 of 7 samples are missing" in rec.provenance["import_remarks"]
    fine = import_recording(path, {**timed, "sample_time": 0.05})
    assert fine.n_samples == 13
    assert fine.missing == {"y": 9}
    refused(path, {**timed, "sample_time": 0.07}, "off an even grid of", "resolution of the clock")
    refused(path, {**timed, "sample_time": 0.0005}, "there would be 1201 samples for 5")
    path.write_text(GAPS.replace("0.2,", ","))
    refused(path, timed, "column 't' holds 1 values that are not finite, the first nan at sample 2")
    path.write_text(GAPS.replace("0.2,", "0.1,"))
    refused(path, timed, "does not rise at sample 2")


def test_samples_cut_the_file(tmp_path):
    values = np.column_stack([T, DATA])
    values[5, 0], values[7, 1] = 99.0, np.nan  # outside the range: a cut is the cure for them
    path = write_csv(tmp_path / "a.csv", values=values)
    mapping = {"signals": {"p": BOTH}, "time": "t", "samples": [10, None]}
    rec = import_recording(path, mapping)
    np.testing.assert_allclose(rec.signals["p"], 1e-6 * DATA[10:, :2], rtol=1e-15)
    assert rec.provenance["source_samples"] == "10 to 300"
    assert import_recording(path, {**mapping, "samples": [10, 20]}).n_samples == 10
    refused(path, {**mapping, "samples": [10, 301]}, "samples 10 to 301", "300 samples")
    refused(path, {**mapping, "samples": [300, None]}, "samples 300 to 300")


# The clock


def test_the_time_column_gives_the_sample_time(tmp_path):
    path = write_csv(tmp_path / "a.csv", values=np.column_stack([1e3 * T + 70, DATA]))
    rec = import_recording(path, {"signals": {"p": BOTH}, "time": "t", "time_unit": "ms"})
    assert rec.sample_time == DT
    path = write_csv(tmp_path / "b.csv", "t [ms],a,b,c,d", values=np.column_stack([1e3 * T, DATA]))
    assert import_recording(path, {"signals": {"p": BOTH}, "time": "t"}).sample_time == DT
    refused(path, {"signals": {"p": BOTH}, "time": "t", "time_unit": "s"}, "header says 'ms'")
    both = {"signals": {"p": BOTH}, "time": "t"}
    assert import_recording(path, {**both, "sample_time": 1.0009 * DT}).sample_time == 1.0009 * DT
    refused(path, {**both, "sample_time": 1.0011 * DT}, "sample_time_s = 0.00020022 s", "steps of 0.0002 s")
    refused(path, {**both, "time_unit": "um"}, "time column 't'")


@pytest.mark.parametrize(
    ("k", "shift", "fault", "taken"),
    [
        (100, DT, "1 samples missing after sample 99 (0.0198 s)", "100 to 300"),
        (100, 3.5 * DT, "a gap of 0.0009 s after sample 99", "100 to 300"),
        (100, -DT, "two samples of one time after sample 99", "100 to 300"),
        (200, -5 * DT, "the clock goes back by 0.0008 s after sample 199", "0 to 200"),
    ],
)
def test_gaps_cut_a_file_into_pieces(tmp_path, k, shift, fault, taken):
    clock = T + shift * (np.arange(N) >= k)
    path = write_csv(tmp_path / "a.csv", values=np.column_stack([clock, DATA]))
    mapping = {"signals": {"p": BOTH}, "time": "t"}
    longest = import_recording(path, mapping)
    assert fault in longest.provenance["import_remarks"]
    assert "2 pieces without gap (1: samples 0 to" in longest.provenance["import_remarks"]
    assert longest.provenance["source_samples"] == taken
    assert peek(path, ImportMapping.from_dict(mapping)) == Peek(200, pytest.approx(DT))
    pieces = [import_recording(path, {**mapping, "piece": i}) for i in (1, 2)]
    assert [q.provenance["source_samples"] for q in pieces] == [f"0 to {k}", f"{k} to 300"]
    for rec, part in zip(pieces, (slice(None, k), slice(k, None)), strict=True):
        np.testing.assert_allclose(rec.signals["p"], 1e-6 * DATA[part, :2], rtol=1e-15)
        assert rec.sample_time == pytest.approx(DT, rel=1e-9)
    refused(path, {**mapping, "piece": 3}, "there is no piece 3; the clock has 2 without gap", error=UsageError)


def test_doubled_samples_are_left_out(tmp_path):
    rows = np.column_stack([T, DATA])
    doubled = np.insert(rows, [10, 200], rows[[9, 199]], axis=0)
    rec = import_recording(write_csv(tmp_path / "a.csv", values=doubled), {"signals": {"p": BOTH}, "time": "t"})
    np.testing.assert_allclose(rec.signals["p"], 1e-6 * DATA[:, :2], rtol=1e-15)
    assert "2 doubled samples left out, the first is sample 10" in rec.provenance["import_remarks"]


def test_signals_at_uneven_times_are_interpolated(tmp_path):
    rng = np.random.default_rng(3)
    n, jitter = 3000, 0.02 * DT
    time = DT * np.arange(n) + rng.uniform(-jitter, jitter, n)

    def at(t):  # tones up to a quarter of the sampling rate, an angle in degrees that wraps, and a held command
        tones = sum(np.sin(2 * np.pi * f * t + f) for f in (37.0, 411.0, 1250.0))
        held = np.where(np.floor((t + DT / 2) / (20 * DT)) % 2 > 0.5, 1.0, -1.0)
        return np.column_stack([tones, np.mod(360 * 70.1 * t, 360), held])

    path = write_csv(tmp_path / "a.csv", "t,a,phi [Grad],r", np.column_stack([time, at(time)]))
    signals = {"s": {"columns": "a"}, "phi": {"columns": "phi"}, "v": {"columns": "r", "unit": "V"}}
    rec = import_recording(path, {"signals": signals, "time": "t"})
    assert "ppm of the sample time (rms)" in rec.provenance["import_remarks"]
    assert rec.sample_time == DT
    even = at(time[0] + rec.time)
    inner = slice(20, -20)
    np.testing.assert_allclose(rec.signals["s"][inner, 0], even[inner, 0], atol=1e-5)
    assert np.abs(at(time) - even)[inner, 0].max() > 0.05  # what the jitter was
    turned = np.deg2rad(even[:, 1])
    assert np.abs(np.angle(np.exp(1j * (rec.signals["phi"][:, 0] - turned)))).max() < 1e-9
    assert 0 <= rec.signals["phi"].min() <= rec.signals["phi"].max() < 2 * np.pi
    np.testing.assert_array_equal(rec.signals["v"][:, 0], even[:, 2])
    delayed = DT * np.arange(n) + rng.uniform(-12 * jitter, 12 * jitter, n)
    path = write_csv(tmp_path / "b.csv", "t,a,phi [Grad],r", np.column_stack([delayed, at(delayed)]))
    refused(path, {"signals": signals, "time": "t"}, "let the clock of the converter time them")


def test_a_clock_that_falls_or_is_only_rounded_is_refused(tmp_path):
    jitter = np.random.default_rng(6).uniform(-0.4, 0.4, N) * 0.01 * DT
    path = write_csv(tmp_path / "a.csv", values=np.column_stack([T + jitter, DATA]))
    rec = import_recording(path, {"signals": {"p": BOTH}, "time": "t"})
    assert rec.sample_time == DT  # the rounding of the column leaves it open
    assert "import_remarks" not in rec.provenance
    path = write_csv(tmp_path / "b.csv", values=np.column_stack([-T, DATA]))
    refused(path, {"signals": {"p": BOTH}, "time": "t"}, "at sample 1: step -0.0002 s", "299 such steps")
    refused(path, {"signals": {"p": BOTH}, "time": "t", "samples": (0, 1)}, "one sample")
    path = write_csv(tmp_path / "c.csv", values=np.column_stack([np.round(T, 3), DATA]))
    refused(path, {"signals": {"p": BOTH}, "time": "t"}, "give sample_time_s instead if only the column is rounded")


def test_a_range_in_seconds(tmp_path):
    path = write_csv(tmp_path / "a.csv", values=np.column_stack([T + 7.0, DATA]))
    for clock in ({"time": "t"}, {"sample_time_s": DT}):
        mapping = {"signals": {"p": BOTH}, **clock, "from_s": 0.01, "to_s": 0.05}
        rec = import_recording(path, mapping)
        assert rec.provenance["source_samples"] == "50 to 250"
        assert peek(path, ImportMapping.from_dict(mapping)) == Peek(200, pytest.approx(DT))


# Bad csv files

GOOD = "t,a,b\n" + "".join(f"{k},{k % 7},{k % 5}\n" for k in range(50))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "header line"),
        ("t,a,b\n", "header line"),
        ("# only\n# comments\n", "header line"),
        ("1,2,3\n4,5,6\n7,8,9\n", "no header line"),
        (GOOD.replace("t,a,b", "t,a,a"), "'a' occurs 2 times with different numbers; name one, 'a #1' to 'a #2'"),
        (GOOD.replace("t,a,b", "t,a,bb"), "did you mean 'bb'? choose from t, a, bb"),
        (GOOD.replace("t,a,b", "t,a [um],a [mm]"), "may be any of 'a [um]', 'a [mm]'"),
        (GOOD.replace("10,3,0", "10,three,0"), "line 12, column 'a': 'three' is not a number"),
        (GOOD.replace("10,3,0", "10,3,1_0"), "line 12, column 'b': '1_0' is not a number"),
        ("# x\n\n" + GOOD.replace("10,3,0", "10,3,?"), "line 14, column 'b': '?'"),
        (GOOD.replace("10,3,0", "10,3"), "line 12 has 2 cells, the header line has 3"),
        (GOOD.replace("10,3,0", "10,3,0,0"), "line 12 has 4 cells"),
        (GOOD.replace("10,3,0", "10,inf,0"), "column 'a' holds 1 values"),
        (
            GOOD.replace("3\n", "3.5\n").replace("10,3,0", '10,"3,5",0'),
            "'3,5' is not a number; the decimal sign is '.' here",
        ),
        (GOOD.replace("10,3,0", '10,"3,0'), "not readable as csv"),
        (GOOD.replace("10,3,0", '10,"3"4,0'), "line 12: not readable as csv"),
    ],
)
def test_bad_csv_files(tmp_path, text, words):
    path = tmp_path / "a.csv"
    path.write_text(text)
    refused(path, {"signals": {"p": BOTH}, "sample_time": DT}, words)


def test_csv_that_is_not_text(tmp_path):
    path = write_csv(tmp_path / "a.csv", "t,a [µm],b,c,d", encoding="cp1252")
    mapping = {"signals": {"p": {"columns": ["a", "b"], "unit": "um"}}, "sample_time": DT}
    assert import_recording(path, mapping).n_samples == N
    refused(path, {**mapping, "encoding": "utf-8"}, "not text in utf-8 (byte 5): give its encoding")
    path.write_bytes(np.arange(2000, dtype=">f8").tobytes())
    refused(path, mapping, "not text in cp1252")
    np.savez(tmp_path / "a.npz", a=T, b=T)
    refused(tmp_path / "a.npz", {**mapping, "decimal": ","}, "decimal is for text files", error=UsageError)


# Bad npz and mat files


class Trap:
    """Shows whether a pickle was loaded."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was loaded",))


def test_pickled_objects_are_never_loaded(tmp_path):
    path = tmp_path / "a.npz"
    trap = np.empty(1, dtype=object)
    trap[0] = Trap()
    np.savez(path, a=trap, b=DATA[:, 0])
    refused(path, {"signals": {"p": BOTH}, "sample_time": DT}, "'a' holds pickled Python objects")
    path.write_bytes(pickle.dumps(Trap()))
    refused(path, {"signals": {"p": BOTH}, "sample_time": DT}, "not a readable npz archive")


@pytest.mark.parametrize("write", ["npz", write_v5, write_v73])
@pytest.mark.parametrize(
    ("column", "words"),
    [
        ("dat", "no variable 'dat'; did you mean 'data'? choose from "),
        ("data", "shape (300, 4); name one of its columns, e.g. data[0]"),
        ("data[4]", "columns count from 0 to 3"),
        ("data[-1]", "no variable 'data[-1]'"),
        ("wide", "shape (4, 300)"),
        ("wide[0]", "channels along axis 0"),
        ("number", "expected (n_samples,) or (n_samples, n_channels)"),
        ("text", "not an array of real numbers"),
        ("complex", "not an array of real numbers"),
        ("short", "different numbers of samples: data[0] 300, short 299"),
        ("inf", "column 'inf' holds 1 values that are not finite, the first inf at sample 12"),
        ("empty", "empty"),
    ],
)
def test_bad_columns_of_arrays(tmp_path, write, column, words):
    inf = DATA[:, [0]].copy()
    inf[12] = np.inf
    content = {"data": DATA, "wide": DATA.T, "number": 3.0, "short": DATA[1:, [0]], "inf": inf, "text": "hello"}
    if write is write_v73:
        path = write(tmp_path / "a.mat", content)
        with h5py.File(path, "r+") as file:
            file["complex"] = np.zeros((1, N), dtype=[("real", "f8"), ("imag", "f8")])
            file["empty"] = np.zeros(2, dtype="u8")
            file["empty"].attrs["MATLAB_empty"] = np.uint8(1)
            for name in ("complex", "empty"):
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
    else:
        content |= {"complex": DATA[:, [0]] * 1j, "empty": np.zeros((0, 0))}
        path = tmp_path / ("a.npz" if write == "npz" else "a.mat")
        np.savez(path, **content) if write == "npz" else write(path, content)
    refused(path, {"signals": {"s": {"columns": ["data[0]", column]}}, "sample_time": DT}, words)


def test_a_null_dataset_of_hdf5_is_empty(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["u"], file["nothing"] = DATA[:, 0], h5py.Empty("f8")
    refused(path, {"signals": {"s": {"columns": ["u", "nothing"]}}, "sample_time": DT}, "nothing is empty: shape (0,)")


def test_vectors_of_npz_are_not_turned_and_have_no_columns(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, row=DATA[:, 0][None, :], v=DATA[:, 0], cube=np.zeros((N, 2, 2)))
    for column, words in [("row", "(1, 300)"), ("v[0]", "leave the index out: v"), ("cube[0]", "(300, 2, 2)")]:
        refused(path, {"signals": {"s": {"columns": [column]}}, "sample_time": DT}, words)


@MAT_WRITERS
def test_bad_struct_paths(tmp_path, write):
    path = write(tmp_path / "a.mat", {"data": {"u": DATA}, "y": DATA, "row": DATA[:, 0][None, :]})
    for column, words in [
        ("data.v[0]", "data has no field 'v'; choose from u"),
        ("y.u[0]", "y is not a struct"),
        ("data.u.x", "data.u is not a struct"),
        ("data", "data is a dict"),
        ("row[0]", "leave the index out: row"),
    ]:
        refused(path, {"signals": {"s": {"columns": [column]}}, "sample_time": DT}, words)


def test_arrays_of_structs_and_cells_are_refused(tmp_path):
    structs = np.array([(DATA[:, 0],), (DATA[:, 1],)], dtype=[("u", object)])
    cells = np.empty(2, dtype=object)
    cells[:] = [DATA[:, 0], DATA[:, 1]]
    path = write_v5(tmp_path / "a.mat", {"s": structs, "c": cells})
    refused(path, {"signals": {"p": {"columns": ["s.u"]}}, "sample_time": DT}, "s is not a struct")
    refused(path, {"signals": {"p": {"columns": ["c"]}}, "sample_time": DT}, "not an array of real numbers")


@pytest.mark.parametrize("kind", ["a.npz", "v5.mat", "v73.mat"])
def test_truncated_and_foreign_files(tmp_path, kind):
    path = tmp_path / kind
    content = {"a": DATA[:, [0]], "b": DATA[:, [1]]}
    if kind == "a.npz":
        np.savez(path, **content)
    else:
        (write_v5 if kind == "v5.mat" else write_v73)(path, content)
    data, mapping = path.read_bytes(), {"signals": {"p": BOTH}, "sample_time": DT}
    assert import_recording(path, mapping).n_samples == N
    middle = len(data) // 2
    damaged = data[: len(data) // 4] + bytes(b ^ 255 for b in data[len(data) // 4 : middle]) + data[middle:]
    for bad in (b"", b"hello\n" * 100, data[:60], data[:200], data[:middle], data[:-30]):
        path.write_bytes(bad)
        refused(path, mapping, "another format" if kind != "a.npz" else "npz archive")
    if kind != "v73.mat":  # HDF5 as MATLAB writes it has no checksums
        path.write_bytes(damaged)
        refused(path, mapping)


def test_files_that_are_not_there_or_of_unknown_kind(tmp_path):
    mapping = {"signals": {"p": BOTH}, "sample_time": DT}
    for kind in ("csv", "npz", "mat"):
        refused(tmp_path / f"none.{kind}", mapping, "cannot be read: No such file")
    (tmp_path / "dir.csv").mkdir()
    refused(tmp_path / "dir.csv", mapping, "directory")
    for name in ("a.xlsx", "a"):
        refused(tmp_path / name, mapping, "cannot be read: No such file")
        (tmp_path / name).write_bytes(b"PK\x03\x04\x14\x00\x06\x00")
        ending = Path(name).suffix
        refused(tmp_path / name, mapping, f"unknown file ending {ending!r}, and no text; expected", ".csv, ", ".npz, ")


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_pipes_and_devices_are_refused_at_once(tmp_path, ending):
    os.mkfifo(tmp_path / f"pipe.{ending}")
    (tmp_path / f"zeros.{ending}").symlink_to("/dev/zero")
    for path in tmp_path.iterdir():
        mapping = {"signals": {"p": BOTH}, "sample_time": DT}
        refused(path, mapping, "is not a file, but a directory, a pipe or a device")
        for look in (list_channels, partial(peek, mapping=ImportMapping.from_dict(mapping))):
            with pytest.raises(DataError, match="is not a file"):
                look(path)


@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_of_a_large_csv_file_the_ends_are_looked_at(tmp_path, monkeypatch, eol):
    path = write_csv(tmp_path / "a.csv", "t [s],a [um],b,c,d", eol=eol)
    lines = path.read_bytes().split(eol.encode())
    lines[150:150] = [b"# a comment", b"", b"% another"]
    path.write_bytes(b"# made by hand" + eol.encode() + eol.encode().join(lines))
    mapping = ImportMapping.from_dict({"signals": {"p": {"columns": ["a", "b"], "unit": "um"}}, "time": "t"})
    complete = list_channels(path), read_layout(path), peek(path, mapping)
    monkeypatch.setattr(
        importing, "read_apart", lambda read, *arguments, **_: read(*arguments)
    )  # see it in this process
    monkeypatch.setattr(text_files, "_END", 4000)
    monkeypatch.setattr(text_files, "_BLOCK", 3000)
    monkeypatch.setattr(Path, "read_bytes", None)
    assert (read_layout(path), peek(path, mapping)) == complete[1:]
    for ours, expected in zip(list_channels(path), complete[0], strict=True):
        assert replace(ours, step=None) == replace(expected, step=None)
        assert ours.step == pytest.approx(expected.step)


@pytest.mark.parametrize(
    "times", [1e307 * np.arange(9), 1.7e308 * np.linspace(-1, 1, 9), 1e200 * (np.arange(9) + T[:9])]
)
def test_times_beyond_all_measure_are_refused(tmp_path, times):
    path = write_csv(tmp_path / "a.csv", "t,a,b", np.column_stack([times, DATA[:9, :2]]))
    mapping = {"signals": {"p": BOTH}, "time": "t"}
    refused(path, mapping, "which is no time")
    with pytest.raises(DataError, match="which is no time"):
        peek(path, ImportMapping.from_dict(mapping))
    assert [channel.name for channel in list_channels(path)] == ["t", "a", "b"]


def test_a_cell_longer_than_the_reader_takes_is_named(tmp_path):
    for text in (f"t,a\n1,2\n3,{140_000 * '1'}x\n", f"{140_000 * 'x'},a\n1,2\n3,4\n"):
        (tmp_path / "a.csv").write_text(text)
        refused(tmp_path / "a.csv", {"signals": {"p": {"columns": ["b"], "unit": "m"}}, "sample_time": DT})


def test_a_text_file_beyond_the_memory_is_refused(tmp_path, monkeypatch):
    path = write_csv(tmp_path / "a.csv")
    monkeypatch.setattr(
        importing, "read_apart", lambda read, *arguments, **_: read(*arguments)
    )  # see it in this process
    monkeypatch.setattr(text_files, "usable_memory", lambda: 100_000)
    refused(path, {"signals": {"p": BOTH}, "time": "t"}, "of memory, of which this process can use 100", "Parquet")


# Cut and damaged files


def test_a_cut_csv_file_gives_no_wrong_number(tmp_path):
    """Cut anywhere within its last lines: the last row is left out and said, or the cut is between two rows."""
    complete, path = write_csv(tmp_path / "a.csv").read_bytes(), tmp_path / "b.csv"
    mapping, told = {"signals": {"p": BOTH}, "time": "t"}, 0
    for end in {*range(len(complete) - 120, len(complete), 6), complete.rstrip().rindex(b"\n") + 1, len(complete) - 1}:
        path.write_bytes(complete[:end])
        if complete[:end].splitlines()[-1].count(b",") < 4:
            refused(path, mapping, "is the file truncated")
            continue
        rec = import_recording(path, mapping)
        n, rows = rec.n_samples, rec.provenance["source_rows"]
        np.testing.assert_array_equal(rec.signals["p"], 1e-6 * DATA[:n, :2])
        is_told = "the last line is left out" in rec.provenance.get("import_remarks", "")
        assert is_told == (complete[end - 1 : end] != b"\n")
        assert rows.startswith(f"{n} rows; the first: t = 0, a = {DATA[0, 0]:g}, ")
        assert f"; the last: t = {T[n - 1]:g}, " in rows
        told += is_told
    assert told > 2
    path.write_bytes(complete[:-1])
    assert read_layout(path)["last_line"].startswith("left out")


def test_an_archive_with_a_variable_twice_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=DATA[:, 0], b=DATA[:, 1])
    with zipfile.ZipFile(path) as archive:
        other = archive.read("b.npy")
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("a.npy", other)
    refused(
        path, {"signals": {"p": {"columns": ["a"], "unit": "um"}}, "sample_time": DT}, "variable 'a' more than once"
    )


# The mapping


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sample_time": None}, "neither sample_time_s nor time"),
        ({"sample_time": 0}, "sample_time = 0; give a number above 0 or None"),
        ({"sample_time_s": DT}, "both given"),
        ({"sampel_time": DT}, "unknown key 'sampel_time'; did you mean 'sample_time'?"),
        ({"time_unit": "ms"}, "time_unit is given without time"),
        ({"time": ""}, "time is empty"),
        ({"samples": [5]}, "samples = [5]; give (a whole number of at least 0, a whole number of at least 0 or None)"),
        ({"samples": [5, 5]}, "samples = (5, 5); give the first and the end, which lies after it"),
        ({"samples": [0, 5], "from_s": 1.0}, "samples is given beside from_s"),
        ({"from_s": 2.0, "to_s": 1.0}, "to_s = 1.0; give a time after from_s"),
        ({"piece": 1}, "piece chooses a part between gaps in time"),
        ({"encoding": "klingon"}, "encoding: 'klingon' is not known"),
        ({"decimal": ";"}, "decimal = ';'; give '.', ',' or None"),
        ({"delimiter": "::"}, "delimiter = '::'; give one character"),
        ({"conditions": {"pressure_bar": "6"}}, "conditions['pressure_bar'] = '6'; give a number"),
        ({"signals": {}}, "at least one signal"),
        ({"signals": ["p"]}, "at least one signal"),
        ({"signals": {"p": "a"}}, "signals: p: expected columns and unit"),
        ({"signals": {"p": {"unit": "um"}}}, "signals: p: key 'columns' is missing"),
        ({"signals": {"p": {"columns": []}}}, "signals: p: columns: expected a list of names"),
        ({"signals": {"p": {"columns": [1, 2]}}}, "signals: p: columns: expected a list of names"),
        ({"signals": {"p": {"columns": ["a"], "unti": "m"}}}, "unknown key 'unti'; did you mean 'unit'?"),
        ({"signals": {"p": {"columns": ["a"], "unit": 1}}}, "signals: p: unit = 1; give a text or None"),
        ({"signals": {"p": {"columns": ["a"], "channels": ["x", "y"]}}}, "1 columns but 2 channels"),
    ],
)
def test_malformed_mappings(tmp_path, change, words):
    path = write_csv(tmp_path / "a.csv")
    mapping = {"signals": {"p": BOTH}, "sample_time": DT, **change}
    refused(path, mapping, words, error=UsageError)


def test_a_recording_that_does_not_fit_names_the_file(tmp_path):
    path = write_csv(tmp_path / "a.csv")
    slash = {"signals": {"p/x": BOTH}, "sample_time": DT}
    refused(path, slash, "recording 'a': 'p/x' cannot name a signal")
    many = {"signals": {"p": BOTH}, "sample_time": DT, "samples": [0, 1]}
    refused(path, many, "signal 'p' has shape (1, 2): more channels than samples")


def test_mappings_of_both_forms_are_equal():
    plain = {"signals": {"p": BOTH}, "sample_time_s": DT, "samples": [0, 10], "conditions": None}
    built = ImportMapping({"p": SignalMapping(("a", "b"), "um")}, sample_time=DT, samples=(0, 10))
    assert ImportMapping.from_dict(plain) == built
    assert pickle.loads(pickle.dumps(built)) == built


def test_the_mappings_of_the_file_format_page_are_valid():
    page = (DOCS / "file-formats.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)
    assert blocks
    for block in blocks:
        entries = YAML(typ="safe").load(block)
        assert Path(entries.pop("file")).suffix in (".csv", ".mat")
        assert ImportMapping.from_dict(entries).all_columns()


def test_the_csv_of_the_file_format_page_is_read_by_its_mapping(tmp_path):
    page = (DOCS / "file-formats.md").read_text(encoding="utf-8")
    text = re.search(r"```text\n(# rig 2.*?)```", page, flags=re.DOTALL)[1]
    (tmp_path / "a.csv").write_text(text)
    entries = YAML(typ="safe").load(re.search(r"```yaml\n(.*?)```", page, flags=re.DOTALL)[1])
    del entries["file"]
    rec = import_recording(tmp_path / "a.csv", entries)
    assert rec.sample_time == DT
    np.testing.assert_allclose(rec.signals["p"], [[1.13e-7, -2.04e-7], [1.17e-7, -2.01e-7]], rtol=1e-14)


# Real data


def test_the_twin_mode_rig():
    path = MEASURED / "twin_mode_rig.npz"
    if not path.is_file():
        pytest.skip("the measured recordings are not beside the checkout")
    mapping = {
        "sample_time_s": 1 / 40,
        "samples": [0, 12000],
        "signals": {
            "u": {"columns": ["noise[0]", "noise[1]"], "unit": "", "stored_unit": "", "channels": ["1", "2"]},
            "y": {"columns": ["noise[2]", "noise[3]"]},
        },
    }
    rec = import_recording(path, mapping)
    with np.load(path) as archive:
        np.testing.assert_array_equal(rec.signals["u"], archive["noise"][:12000, :2])
        np.testing.assert_array_equal(rec.signals["y"], archive["noise"][:12000, 2:])
