"""Files of loggers and of other programs: TDMS, MDF, Parquet, Feather, HDF5; their import and their listing."""

import sys
import wave
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from experiment_files import json_of, printed_by
from refusals import refused
from scipy.io import wavfile

import gbid
from gbid.core.errors import DataError, UsageError
from gbid.recording import importing
from gbid.recording.importing import import_recording, list_channels

N, DT = 500, 2e-4
RNG = np.random.default_rng(8)
X, Y, SLOW = RNG.standard_normal(N), RNG.standard_normal(N), RNG.standard_normal(N // 10)
T = DT * np.arange(N)
XY = {"columns": ["p_x", "p_y"], "unit": "um"}


def write_tdms(path: Path) -> Path:
    nptdms = pytest.importorskip("nptdms", reason="nptdms is not installed: pip install 'gbid[tdms]'")
    wave = {"wf_increment": DT, "wf_samples": N, "unit_string": "um"}
    slow = {"wf_increment": 10 * DT, "NI_UnitDescription": "bar"}
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("fast", "p_x", X, properties=wave),
                nptdms.ChannelObject("fast", "p_y", Y, properties=wave),
                nptdms.ChannelObject("slow", "pressure", SLOW, properties=slow),
                nptdms.ChannelObject("slow", "p_x", SLOW, properties=slow),
                nptdms.ChannelObject("slow", "note", ["a", "b"]),
            ]
        )
    return path


def write_mf4(path: Path) -> Path:
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'gbid[mdf]'")
    fast = [asammdf.Signal(v, T, unit="um", name=name) for name, v in (("p_x", X), ("p_y", Y))]
    slow = [asammdf.Signal(SLOW, 10 * T[: N // 10], unit="bar", name=name) for name in ("pressure", "p_x")]
    slow.append(asammdf.Signal(np.array([b"on"] * (N // 10)), 10 * T[: N // 10], name="note", encoding="utf-8"))
    with asammdf.MDF(version="4.10") as file:
        file.append(fast, acq_name="fast", common_timebase=True)
        file.append(slow, acq_name="slow", common_timebase=True)
        file.save(path, overwrite=True)
    return path


def arrow_table():
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gbid[arrow]'")
    fields = [
        pa.field("t [s]", pa.float64()),
        pa.field("p_x", pa.float64(), metadata={"unit": "um"}),
        pa.field("p_y [um]", pa.float64()),
        pa.field("u", pa.list_(pa.float64(), 2)),
        pa.field("when", pa.timestamp("us")),
        pa.field("holed", pa.float64()),
        pa.field("note", pa.string()),
    ]
    pairs = np.column_stack([X, Y]).tolist()
    when = (np.datetime64("2026-01-05T10:00:00", "us") + np.round(1e6 * T).astype("timedelta64[us]")).tolist()
    holed = [None, *X[1:].tolist()]
    return pa.table([T, X, Y, pairs, when, holed, ["a"] * N], schema=pa.schema(fields))


def write_arrow(path: Path) -> Path:
    table = arrow_table()
    from pyarrow import feather, parquet

    (parquet.write_table if path.suffix == ".parquet" else feather.write_feather)(table, path)
    return path


def write_hdf5(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        file["run/p_x"], file["run/p_y"], file["run/p"] = X, Y, np.column_stack([X, Y])
        file["run/p_x"].attrs["units"] = "um"
        file["run/p_y"].attrs["unit"] = np.bytes_("um")
        file["run/note"] = "by hand"
        table = np.zeros(N, dtype=[("t", "f8"), ("p_x", "f4"), ("p_y", "f8")])
        table["t"], table["p_x"], table["p_y"] = T, X, Y
        file["run/table"] = table
        file["run/rate"] = 1 / DT
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    ".tdms": write_tdms,
    ".mf4": write_mf4,
    ".parquet": write_arrow,
    ".feather": write_arrow,
    ".h5": write_hdf5,
}
STATED = {  # what a mapping of each has to say
    ".tdms": {"signals": {"p": {"columns": ["fast/p_x", "p_y"]}}},
    ".mf4": {"signals": {"p": {"columns": ["fast/p_x", "p_y"]}}},
    ".parquet": {"signals": {"p": {"columns": ["p_x", "p_y"]}}, "time": "t"},
    ".feather": {"signals": {"p": {"columns": ["p_x", "p_y [um]"]}}, "time": "t [s]"},
    ".h5": {"signals": {"p": {"columns": ["run/p_x", "run/p_y"]}}, "time": "run/table/t"},
}
KINDS = pytest.mark.parametrize("kind", WRITERS)


@KINDS
def test_the_samples_are_those_that_were_written(tmp_path, kind):
    path = WRITERS[kind](tmp_path / f"run 7{kind}")
    recording = gbid.import_recording(path, STATED[kind])
    np.testing.assert_allclose(recording.signal("p"), 1e-6 * np.column_stack([X, Y]), rtol=1e-15)
    assert (recording.name, recording.units["p"]) == ("run 7", "m")
    assert recording.sample_time == pytest.approx(DT, rel=1e-12)


@KINDS
def test_the_listing_has_names_units_and_rates(tmp_path, kind, capsys):
    path = WRITERS[kind](tmp_path / f"a{kind}")
    rows = {row["channel"]: row for row in json_of(capsys, "peek", str(path))["channels"]}
    for name in STATED[kind]["signals"]["p"]["columns"]:
        row = rows.get(name.removesuffix(" [um]")) or rows[f"fast/{name}"]
        assert (row["samples"], row["unit"]) == (N, "um")
        if kind in (".tdms", ".mf4"):
            assert row["rate_hz"] == pytest.approx(1 / DT)
    # every name that is listed without remark can be imported under this name
    for name, row in rows.items():
        if not row["remark"]:
            mapping = {"signals": {"any": {"columns": [name], "stored_unit": row["unit"]}}, "sample_time_s": DT}
            if row["rate_hz"]:
                mapping["sample_time_s"] = row["sample_time_s"]
            assert gbid.import_recording(path, mapping).n_samples == row["samples"]
    assert "rises in even steps of 0.0002" in printed_by(capsys, "peek", str(path)).out or kind == ".tdms"


def test_the_listing_of_csv_npz_and_mat(tmp_path):
    from scipy.io import savemat

    (tmp_path / "a.csv").write_text("t [ms],p_x (um),word\n0.0,1,a\n0.2,2,b\n0.4,3,c\n")
    results = {channel.name: channel for channel in list_channels(tmp_path / "a.csv")}
    assert (results["t"].unit, results["t"].step) == ("ms", pytest.approx(0.2))
    assert (results["p_x"].unit, results["p_x"].n_samples, results["word"].remark) == (
        "um",
        3,
        "not all cells are numbers",
    )
    np.savez(tmp_path / "a.npz", p=np.column_stack([X, Y]), fs=5000.0, obj=np.array([{}], dtype=object))
    results = {channel.name: channel for channel in list_channels(tmp_path / "a.npz")}
    assert [*results] == ["p[0]", "p[1]", "fs", "obj"]
    assert (results["fs"].remark, results["obj"].remark[:7]) == ("one number: 5000", "pickled")
    savemat(tmp_path / "a.mat", {"data": {"p": np.column_stack([X, Y]), "t": T[:, None]}, "name": "rig"})
    results = {channel.name: channel for channel in list_channels(tmp_path / "a.mat")}
    assert {"data.p[0]", "data.p[1]", "data.t"} <= set(results)
    assert results["data.t"].step == pytest.approx(DT)
    assert results["name"].remark
    for path in ("a.csv", "a.npz", "a.mat"):
        assert all(channel.sample_time is None for channel in list_channels(tmp_path / path))


def test_rates_of_the_file_are_checked(tmp_path):
    for kind in (".tdms", ".mf4"):
        path = WRITERS[kind](tmp_path / f"a{kind}")
        assert gbid.import_recording(path, {**STATED[kind], "sample_time_s": 1.0005 * DT}).sample_time == 1.0005 * DT
        refused(path, {**STATED[kind], "sample_time_s": 1e-3}, "sample_time_s = 0.001 s, but the file states 0.0002 s")
        both = {"signals": {"p": XY, "s": {"columns": ["pressure"]}}}
        both["signals"]["p"] = {"columns": ["fast/p_x", "fast/p_y"]}
        refused(path, both, "different sample times")
        again = {"signals": {"p": {"columns": ["fast/p_x"]}}, "time": "slow/p_x"}
        refused(path, again, "different sample times")
    path = write_arrow(tmp_path / "a.parquet")
    nothing = {"signals": {"p": {"columns": ["p_x", "p_y"]}}}
    refused(path, nothing, "neither sample_time_s nor time is given, and the file states no", error=UsageError)


def test_channels_of_different_rates_are_not_put_together(tmp_path):
    nptdms = pytest.importorskip("nptdms", reason="nptdms is not installed: pip install 'gbid[tdms]'")
    with nptdms.TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("g", f"c{k}", X, properties={"wf_increment": k * DT}) for k in (1, 2)]
        )
    mapping = {"signals": {"s": {"columns": ["c1", "c2"]}}}
    refused(tmp_path / "a.tdms", mapping, "different sample times: c1 0.0002 s, c2 0.0004 s")


@pytest.mark.parametrize(
    ("kind", "column", "words"),
    [
        (".tdms", "p_x", "channel 'p_x' may be any of fast/p_x, slow/p_x; give group and channel"),
        (".tdms", "fast/p_z", "no channel 'fast/p_z'; did you mean 'fast/p_y'?"),
        (".tdms", "slow/note", "not an array of real numbers"),
        (".mf4", "p_x", "channel 'p_x' may be any of 0/p_x, 1/p_x; give group and channel"),
        (".mf4", "p_z", "no channel 'p_z'; did you mean 'p_y'?"),
        (".mf4", "note", "not an array of real numbers"),
        (".parquet", "p_z", "no column 'p_z'; did you mean 'p_y'?"),
        (".parquet", "note", "not an array of real numbers"),
        (".feather", "u", "u has shape (500, 2); name one of its columns, e.g. u[0]"),
        (".feather", "u[2]", "columns count from 0 to 1"),
        (".h5", "run/p_z", "no dataset 'run/p_z'; did you mean 'run/p_y'?"),
        (".h5", "run/table/z", "no dataset 'run/table/z'; did you mean 'run/table/t'?"),
        (".h5", "run/note", "not an array of real numbers"),
        (".h5", "run/p", "run/p has shape (500, 2); name one of its columns"),
        (".h5", "run", "no dataset 'run'"),
    ],
)
def test_columns_that_are_not_there_or_no_numbers(tmp_path, kind, column, words):
    path = WRITERS[kind](tmp_path / f"a{kind}")
    refused(path, {"signals": {"s": {"columns": [column]}}, "sample_time_s": DT}, words)


def test_times_and_lists_of_a_table(tmp_path):
    for path in (write_arrow(tmp_path / "a.parquet"), write_arrow(tmp_path / "a.feather")):
        recording = gbid.import_recording(
            path, {"signals": {"s": {"columns": ["u[0]", "u[1]"], "stored_unit": "um", "unit": "um"}}, "time": "when"}
        )
        np.testing.assert_array_equal(recording.signal("s"), np.column_stack([X, Y]))
        assert recording.sample_time == pytest.approx(DT, rel=1e-9)
        holed = gbid.import_recording(path, {"signals": {"s": {"columns": "holed", "unit": "um"}}, "time": "t"})
        np.testing.assert_array_equal(np.isnan(holed.signals["s"][:, 0]), np.arange(N) == 0)  # null


def test_samples_that_a_logger_marked_as_invalid(tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed: pip install 'gbid[mdf]'")
    bad = np.zeros(N, dtype=bool)
    bad[7:9] = True
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(X, T, unit="um", name="p_x", invalidation_bits=bad)], common_timebase=True)
        file.save(tmp_path / "a.mf4", overwrite=True)
    recording = gbid.import_recording(tmp_path / "a.mf4", {"signals": {"s": {"columns": ["p_x"]}}})
    np.testing.assert_array_equal(recording.signals["s"][:, 0], np.where(bad, np.nan, X))
    assert "signal 's': 2 samples missing" in recording.provenance["import_remarks"]


@KINDS
def test_damaged_files_are_refused_with_one_line(tmp_path, kind):
    path = WRITERS[kind](tmp_path / f"a{kind}")
    data = path.read_bytes()
    for bad in (b"", b"hello\n" * 100, data[:5], data[: len(data) // 2], data[:-30]):
        path.write_bytes(bad)
        refused(path, STATED[kind])
        with pytest.raises(DataError) as caught:
            list_channels(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    refused(tmp_path / f"none{kind}", STATED[kind], "cannot be read: No such file")


@pytest.mark.parametrize(
    ("kind", "package", "extra"),
    [(".tdms", "nptdms", "tdms"), (".mf4", "asammdf", "mdf"), (".parquet", "pyarrow", "arrow")],
)
def test_a_package_that_is_not_installed(tmp_path, monkeypatch, capsys, kind, package, extra):
    path = WRITERS[kind](tmp_path / f"a{kind}")
    for module in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(
        importing, "read_apart", lambda read, *arguments, **_: read(*arguments)
    )  # see it in this process
    refused(path, STATED[kind], f"pip install 'gbid[{extra}]'", package, error=UsageError)
    assert f"pip install 'gbid[{extra}]'" in printed_by(capsys, "peek", str(path), code=2).err


def test_every_accepted_bit_flip_of_a_parquet_file_with_checksums_gives_the_same_numbers(tmp_path, monkeypatch):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    monkeypatch.setattr(importing, "read_apart", lambda read, *arguments, **_: read(*arguments))
    path, p = tmp_path / "a.parquet", np.random.default_rng(3).normal(size=60)
    parquet.write_table(pyarrow.table({"p": p}), path, write_page_checksum=True, compression="none")
    good, refusals = path.read_bytes(), 0
    mapping = {"sample_time": 1e-3, "signals": {"y": {"columns": ["p"], "unit": "m"}}}
    for bit in range(8 * good.index(p.tobytes()[:8]), 8 * len(good), 61):
        content = bytearray(good)
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        try:
            read = gbid.import_recording(path, mapping).signals["y"][:, 0]
        except DataError:
            refusals += 1
        else:
            np.testing.assert_array_equal(read, p)
    assert refusals > 20


def test_wav_of_floating_point_numbers_is_read_as_it_is(tmp_path):
    values = np.random.default_rng(0).uniform(-1, 1, (64, 2)).astype("f4")
    wavfile.write(tmp_path / "a.wav", 8000, values)
    rec = import_recording(
        tmp_path / "a.wav", {"signals": {"y": {"columns": ["data[0]", "data[1]"], "stored_unit": ""}}}
    )
    np.testing.assert_array_equal(rec.signals["y"], values)


@pytest.mark.parametrize("width", [1, 2, 4])
def test_wav_in_parts_of_the_full_scale(tmp_path, width):
    """The bytes are written by the standard library; 8 bits are offset by 128 (Microsoft, RIFF specification, 1991)."""
    path, n, full = tmp_path / "a.wav", 64, 2 ** (8 * width - 1)
    values = np.random.default_rng(width).integers(-full, full, (n, 2))
    stored = (values + 128).astype("u1") if width == 1 else values.astype(f"<i{width}")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(width)
        file.setframerate(8000)
        file.writeframes(stored.tobytes())
    volts = {"unit": "V", "stored_unit": "V"}
    mapping = {"signals": {"y": {"columns": ["data[1]", "data[0]"], "stored_unit": ""}}}
    rec = import_recording(path, mapping)
    assert rec.sample_time == 1 / 8000
    np.testing.assert_allclose(rec.signals["y"], values[:, ::-1] / full, rtol=0, atol=1e-12)
    refused(path, {"signals": {"y": {"columns": ["left"], **volts}}}, "no channel 'left'", "data[0]")
    path.write_bytes(path.read_bytes()[:-40])
    refused(path, mapping, "WAV file")
