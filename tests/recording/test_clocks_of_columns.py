"""Columns of one file whose clocks begin at different times, times without a unit, and headers of loggers."""

import re
from pathlib import Path

import numpy as np
import pytest

import gbid
from gbid.core.errors import DataError, UsageError
from gbid.recording.clock import even_pieces
from gbid.recording.columns import name_and_unit
from gbid.recording.importing import list_channels, peek
from gbid.recording.mapping import ImportMapping
from gbid.recording.quality import find_problems

DT, LATE = 2e-4, 15
INPUTS = Path(__file__).parents[3] / "shared" / "inputs"
P_AND_U = {"signals": {"p": {"columns": ["p"], "unit": "um"}, "u": {"columns": ["u"], "unit": "um"}}}
OF_INPUTS = {"time": "Time", "signals": {"p": {"columns": ["px", "py"]}}}
inputs = pytest.mark.skipif(not INPUTS.is_dir(), reason="the folder of small inputs is not beside the project")


def signals(n=200):
    """p from the first sample on, and u of the same times: the first `LATE` samples of u are not recorded."""
    rng = np.random.default_rng(1)
    return rng.normal(size=n), rng.normal(size=n)


def check_aligned(recording, p, u):
    n = len(p) - LATE
    assert recording.signals["p"][:, 0] == pytest.approx(1e-6 * p[LATE:])
    assert recording.signals["u"][:, 0] == pytest.approx(1e-6 * u[:n])
    assert recording.sample_time == pytest.approx(DT, rel=1e-12)
    remark = recording.provenance["import_remarks"]
    assert "(15 samples) after" in remark
    assert f"aligned on their common span of {n} samples" in remark


def write_csv(path, p, u, late=LATE * DT, step=DT):
    rows = [f"{DT * k:.7f},{p[k]!r},{late + step * k:.7f},{u[k]!r}" for k in range(len(p))]
    path.write_text("\n".join(["Time (s),p (um),Time (s),u (um)", *rows, ""]))
    return path


@pytest.mark.parametrize("time", ["Time", "Time #1", None])
def test_text_with_two_time_columns(tmp_path, time):
    p, u = (each.tolist() for each in signals())
    path = write_csv(tmp_path / "a.csv", p, u)
    mapping = {**P_AND_U, **({"time": time} if time else {"sample_time": DT})}
    recording = gbid.import_recording(path, mapping)
    p, u = np.array(p), np.array(u)
    n = len(p) - LATE
    assert np.array_equal(recording.signals["p"][:, 0], p[LATE:] * 1e-6)
    assert np.array_equal(recording.signals["u"][:, 0], u[:n] * 1e-6)
    assert "15 samples" in recording.provenance["import_remarks"]
    assert peek(path, ImportMapping.from_dict(mapping)).n_samples == n


def test_a_shorter_column_with_its_own_clock_ends_the_span(tmp_path):
    p, u = (each.tolist() for each in signals())
    path = write_csv(tmp_path / "a.csv", p, u)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:101], *(",".join([*line.split(",")[:2], "", ""]) for line in lines[101:]), ""]))
    recording = gbid.import_recording(path, {**P_AND_U, "time": "Time"})
    assert np.array_equal(recording.signals["u"][:, 0], np.array(u[:100]) * 1e-6)
    assert np.array_equal(recording.signals["p"][:, 0], np.array(p[LATE : LATE + 100]) * 1e-6)


def test_a_first_column_that_ends_early_is_no_other_delimiter(tmp_path):
    """Rows of LabVIEW end with a tab; cells that are empty begin the last rows."""
    p, u = signals()
    rows = [f"{DT * k:.4f}\t{float(p[k])!r}" if k < 120 else "\t" for k in range(200)]
    head = ["LabVIEW Measurement", "Separator\tTab", "X_Value\tp\tX_Value\tu\tComment"]
    rows = [f"{row}\t{DT * (k + LATE):.4f}\t{float(u[k])!r}\t" for k, row in enumerate(rows)]
    (tmp_path / "a.lvm").write_text("\n".join([*head, *rows, ""]))
    recording = gbid.import_recording(tmp_path / "a.lvm", {**P_AND_U, "time": "X_Value"})
    assert np.array_equal(recording.signals["u"][:, 0], u[: 120 - LATE] * 1e-6)
    assert np.array_equal(recording.signals["p"][:, 0], p[LATE:120] * 1e-6)


@pytest.mark.parametrize(
    ("late", "step", "words"),
    [
        (0.4 * DT, DT, "off the others"),
        (LATE * DT, 1.0005 * DT, "off the others"),
        (0.0, 2 * DT, "different sample times"),
        (1.0, DT, "no common time"),
    ],
)
def test_clocks_that_no_whole_samples_join_are_refused(tmp_path, late, step, words):
    path = write_csv(tmp_path / "a.csv", *(each.tolist() for each in signals()), late=late, step=step)
    with pytest.raises(DataError, match=words):
        gbid.import_recording(path, {**P_AND_U, "time": "Time"})


@pytest.mark.parametrize(
    ("first", "second", "stamp"),
    [
        ("t1 (s)", "t2 (s)", "{:.4f}"),
        ("Time p [ms]", "clock of u [us]", None),
        ("Zeit A", "Zeit B", "28.11.2026 10:00:{:07.4f}"),
        ("Time", "Timestamp", "23:59:{:07.4f}"),
    ],
)
def test_time_columns_with_different_names(tmp_path, first, second, stamp):
    p, u = (each.tolist() for each in signals())
    write = stamp.format if stamp else lambda time: f"{1e3 * time:.1f}"
    late = stamp.format if stamp else lambda time: f"{1e6 * time:.0f}"
    rows = [f"{write(DT * k)};{p[k]!r};{late(DT * (k + LATE))};{u[k]!r}" for k in range(len(p))]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"{first};p (um);{second};u (um)", *rows, ""]))
    recording = gbid.import_recording(path, {**P_AND_U, "time": name_and_unit(first)[0]})
    check_aligned(recording, np.array(p), np.array(u))


def test_two_columns_of_the_same_times_are_one_clock(tmp_path):
    rows = [f"{DT * k:.4f},{k % 7},{0.2 * k:.1f},{1790000000 + DT * k:.4f},{k % 3}" for k in range(40)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["t (s),p (um),t (ms),Epoch (s),u (um)", *rows, ""]))
    with pytest.raises(DataError, match="no common time"):  # u stands behind a time column of its own
        gbid.import_recording(path, {**P_AND_U, "time": "t (s)"})
    path.write_text("\n".join(["t (s),p (um),t (ms),u (um)", *(re.sub(r",179[^,]*", "", row) for row in rows), ""]))
    assert gbid.import_recording(path, {**P_AND_U, "time": "t (s)"}).n_samples == 40


@pytest.mark.parametrize("key", ["wf_start_time", "wf_start_offset"])
def test_tdms_channels_with_their_own_starts(tmp_path, key):
    nptdms = pytest.importorskip("nptdms")
    p, u = signals()
    begin = np.datetime64("2024-02-01T10:00:00")
    late = {"wf_start_time": begin + np.timedelta64(3000, "us"), "wf_start_offset": LATE * DT}[key]
    common = {"wf_increment": DT, "wf_start_time": begin, "wf_start_offset": 0.0}
    channels = [
        nptdms.ChannelObject("g", "p", p, properties=common),
        nptdms.ChannelObject("g", "u", u, properties={**common, key: late}),
    ]
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(channels)
    check_aligned(gbid.import_recording(tmp_path / "a.tdms", P_AND_U), p, u)
    part = gbid.import_recording(tmp_path / "a.tdms", {**P_AND_U, "samples": (10, 50)})
    assert part.signals["p"][:, 0] == pytest.approx(1e-6 * p[LATE + 10 : LATE + 50])


@pytest.mark.parametrize("even", [True, False])
def test_mdf_groups_with_their_own_masters(tmp_path, even):
    asammdf = pytest.importorskip("asammdf")
    p, u = signals()
    times = DT * np.arange(len(p))
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(p, times, name="p", unit="um")])
        late = times + LATE * DT if even else LATE * DT + times * (1 + 10 * times)
        file.append([asammdf.Signal(u, late, name="u", unit="um")])
        file.save(tmp_path / "a.mf4")
    if even:
        check_aligned(gbid.import_recording(tmp_path / "a.mf4", P_AND_U), p, u)
    else:
        with pytest.raises(DataError, match="a clock of its own"):
            gbid.import_recording(tmp_path / "a.mf4", {**P_AND_U, "sample_time": DT})


@pytest.mark.parametrize(
    ("first", "step", "sample_time"),
    [
        (1732780000000, 10, 0.01),
        (1732780000000000, 200, 2e-4),
        (45597.5, 0.01 / 86400, 0.01),
        (739473.25, 0.01 / 86400, 0.01),
        (0, 2, 2.0),
    ],
)
def test_times_without_unit_that_are_dates_are_told(tmp_path, first, step, sample_time):
    rows = [f"{first + k * step!r},{k % 7},{k % 3}" for k in range(40)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["Time,px (um),py (um)", *rows, ""]))
    recording = gbid.import_recording(path, OF_INPUTS)
    assert recording.sample_time == pytest.approx(sample_time, rel=1e-2)
    assert "has no unit" in recording.provenance["import_remarks"]


def test_days_that_may_be_seconds_are_refused_with_both(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["Time,px (um),py (um)", *(f"{45597.5 + k * 5e-6!r},{k % 7},1" for k in range(40)), ""]))
    with pytest.raises(UsageError, match=r"days .* or seconds; give time_unit"):
        gbid.import_recording(path, OF_INPUTS)


@inputs
@pytest.mark.parametrize("name", ["a1_tdms_start_times.tdms", "a2_tdms_start_offset.tdms"])
def test_small_inputs_with_starts(name):
    pytest.importorskip("nptdms")
    mapping = {"signals": {key: {"columns": [f"g/{key}"], "unit": "um"} for key in ("p", "u")}}
    recording = gbid.import_recording(INPUTS / name, mapping)
    assert len(recording.signals["p"]) == 185
    assert "15 samples" in recording.provenance["import_remarks"]


@inputs
@pytest.mark.parametrize(
    ("name", "mapping", "words"),
    [
        ("b3_mil_pp.csv", OF_INPUTS, "'pp' is no unit"),
        ("b4_phi_grad.csv", {"time": "Time", "signals": {"phi": {"columns": ["Winkel"]}}}, "deg or gon"),
    ],
)
def test_small_inputs_with_units_that_are_refused(name, mapping, words):
    with pytest.raises(UsageError, match=words):
        gbid.import_recording(INPUTS / name, mapping)


UM = {"time": "Time", "signals": {"p": {"columns": ["px", "py"], "unit": "um"}}}
SCOPE = {"time": "TIME", "signals": {"p": {"columns": ["CH1", "CH2"], "unit": "um"}}}


@inputs
@pytest.mark.parametrize(
    ("name", "mapping", "first", "sample_time"),
    [
        ("b1_speed_hz.mf4", {"signals": {"speed_rpm": {"columns": ["n"]}}}, [6000.0], 2e-4),
        (
            "b4_phi_grad.csv",
            {"time": "Time", "signals": {"phi": {"columns": ["Winkel"], "unit": "deg"}}, "samples": (1, None)},
            [np.deg2rad(7.2)],
            2e-4,
        ),
        ("c1_mil.csv", OF_INPUTS, [25.4e-6, -76.2e-6], 2e-4),
        ("c3_volts.tdms", {"signals": {"v": {"columns": ["g/ai0"]}}}, [0.0], 2e-4),
        ("e1_sparse_last_column.csv", UM, [1e-6, -3e-6], 2e-4),
        ("e2_scope_block.csv", SCOPE, [1e-6, -3e-6], 2e-4),
        ("f1_epoch_ms.csv", UM, [1e-6, -3e-6], 0.01),
        ("f2_excel_days.csv", UM, [1e-6, -3e-6], 0.01),
    ],
)
def test_small_inputs_that_are_read(name, mapping, first, sample_time):
    if name.endswith((".mf4", ".tdms")):
        pytest.importorskip("asammdf" if name.endswith(".mf4") else "nptdms")
    recording = gbid.import_recording(INPUTS / name, mapping)
    (values,) = recording.signals.values()
    assert values[0] == pytest.approx(first, rel=1e-9)
    assert recording.sample_time == pytest.approx(sample_time, rel=1e-9)


@inputs
def test_an_index_that_jumps_while_the_piezos_rest_is_named():
    columns = {"p": ["p_x", "p_y"], "phi": ["phi"]}
    mapping = {"time": "Time", "signals": {name: {"columns": each} for name, each in columns.items()}}
    recording = gbid.import_recording(INPUTS / "g1_index_jump_still.csv", mapping)
    (problem,) = (each for each in find_problems(recording) if each.kind == "encoder")
    assert "jumps 1 times, the first by +63.0 degrees at 0.3998 s" in problem.text


@inputs
def test_an_empty_date_is_listed_beside_the_others():
    channels = {channel.name: channel for channel in list_channels(INPUTS / "d1_empty_datetime.mat")}
    assert {name: channel.n_samples for name, channel in channels.items()} == {"p": 50, "stamp": 0, "t": 50}
    assert channels["stamp"].remark


def test_a_sparse_last_column_is_a_column(tmp_path):
    rows = [f"{DT * k:.4f};{k % 5};{'7' if k == 3 else ''}" for k in range(60)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["t [s];p;trigger", *rows, ""]))
    recording = gbid.import_recording(path, {"time": "t", "signals": {"q": {"columns": ["trigger"], "unit": "V"}}})
    assert np.flatnonzero(recording.signals["q"][:, 0] == 7).tolist() == [3]


def test_names_of_an_oscilloscope_are_the_last_ones(tmp_path):
    block = "Model,X\nVertical Units,V,A\nVertical Offset,0,0\nLabel,,\nTIME,CH1,CH2\n"
    path = tmp_path / "a.csv"
    path.write_text(block + "".join(f"{DT * k:.4f},{k % 5},{k % 3}\n" for k in range(60)))
    mapping = {"time": "TIME", "signals": {"q": {"columns": ["CH1", "CH2"], "unit": "V"}}}
    assert gbid.import_recording(path, mapping).signals["q"].shape == (60, 2)


def test_a_piece_has_two_samples_at_least():
    time = np.r_[0:10, 20:22, 30, 40:50].astype(float)
    pieces = even_pieces(Path("a.csv"), "t", time, {}, 0)
    assert [(piece.rows.tolist(), piece.number, piece.of) for piece in pieces] == [
        (list(range(10)), 1, 3),
        ([10, 11], 2, 3),
        (list(range(13, 23)), 3, 3),
    ]
