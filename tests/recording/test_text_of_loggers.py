"""Text files as twelve loggers write them, from one table of numbers; and files that are nearly such ones."""

import numpy as np
import pytest
from experiment_files import json_of

from gbid.core.errors import DataError
from gbid.recording import import_recording
from gbid.recording.importing import list_channels

N, STEP = 40, 1e-3
TIME = STEP * np.arange(N)
X = np.round(1500 * np.sin(40 * TIME) + np.random.default_rng(3).standard_normal(N), 3)
Y = np.round(0.5 * np.cos(40 * TIME), 5)


def numbers(delimiter, decimal=".", lead="", columns=(TIME, X, Y)):
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return "".join(lead + delimiter.join(repr(v).replace(".", decimal) for v in row) + "\n" for row in rows)


def stamped(text):
    """Rows with a text for the time and, below it, x and y with decimal commas."""
    rows = zip(TIME, X.tolist(), Y.tolist(), strict=True)
    return "".join(f"{text(t)};{x};{y}\n".replace(".", ",") for t, x, y in rows).replace("22,11,", "22.11.")


def grouped(value, sign, decimal):
    return f"{value:,.3f}".translate(str.maketrans(",.", sign + decimal))


DSPACE = """type,string
origin,ControlDesk 7
trace,Time,x,y
path,Model/a,Model/b,Model/c
description,none
unit,s,V,V
min,0,0,0
raster,HostService
trace_values
"""
SPEEDGOAT = """Time,x,y
Application: gasbearing
File log version 2
double,double,double
1x1,1x1,1x1
s,V,V
sample time 0.001
"""
BECKHOFF = "Name\tScope\nStartTime\t132\n\nTime\tx\tTime\ty\ns\tV\ts\tV\n"
TRAILER = "\nEnde der Messung;22.11.2026\nMittelwert;0,5;0,2\nAnzahl Werte: 40"
LABVIEW = """LabVIEW Measurement\t
Separator\tTab
Decimal_Separator\t,
X_Columns\tOne
Date\t2026/11/22
***End_of_Header***\t
\t
Channels\t2\t\t
Samples\t40\t40\t
Date\t2026/11/22\t2026/11/22\t
Time\t10:00:00,5\t10:00:00,5\t
X_Dimension\tTime\tTime\t
Delta_X\t0,001\t0,001\t
***End_of_Header***\t\t\t
X_Value\tx\ty\tComment
"""


def with_thousands(sign, decimal):
    rows = zip(TIME.tolist(), X.tolist(), Y.tolist(), strict=True)
    return "Zeit;x;y\n" + "".join(
        ";".join([repr(t).replace(".", decimal), grouped(x, sign, decimal), repr(y).replace(".", decimal)]) + "\n"
        for t, x, y in rows
    )


FILES = {
    "dspace.csv": (DSPACE + numbers(",", lead=","), "Time", "lines 4 to 9 between names and numbers left out"),
    "speedgoat.csv": (SPEEDGOAT + numbers(","), "Time", "lines 2 to 7 between names and numbers left out"),
    "trailer.csv": ("Zeit;x;y\ns;V;V\n" + numbers(";", ",") + TRAILER, "Zeit", "what follows line 42 begins with"),
    "beckhoff.csv": (BECKHOFF + numbers("\t", columns=(TIME, X, TIME, Y)), "Time", ""),
    "thousands.csv": (with_thousands(".", ","), "Zeit", ""),
    "swiss.csv": (with_thousands("'", "."), "Zeit", ""),
    "iso.csv": ("Zeit;x;y\n" + stamped(lambda t: f"2026-11-22T10:59:{59 + t:.3f}+01:00"), "Zeit", ""),
    "german.csv": ("Zeit;x;y\n" + stamped(lambda t: f"22.11.2026 23:59:5{9.95 + t:.3f}"), "Zeit", ""),
    "headerless.csv": (numbers(";"), "column 1", "no line has names"),
    "units.csv": ("# Zeit;x;y\nV;V;V\n" + numbers(";"), "Zeit", ""),
    "text.asc": ("Zeit;x;y\n" + numbers(";", ","), "Zeit", ""),
    "labview.lvm": (LABVIEW + numbers("\t", ","), "X_Value", ""),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_twelve_loggers(tmp_path, name):
    text, time, said = FILES[name]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    if name == "units.csv":
        path.write_text(text.replace("V;V;V", "s;V;V"))
    x, y = ("column 2", "column 3") if name == "headerless.csv" else ("x", "y")
    made = import_recording(path, {"time": time, "signals": {"d": {"columns": [x, y], "unit": "V"}}})
    np.testing.assert_allclose(made.signal("d"), np.column_stack([X, Y]), rtol=0, atol=1e-9)
    assert made.sample_time == STEP
    assert said in made.provenance.get("import_remarks", "")
    assert bool(said) == ("import_remarks" in made.provenance)


@pytest.mark.parametrize("lines", [1, 2, 3])
def test_no_row_goes_with_the_lines_after_it(tmp_path, lines):
    path = tmp_path / "trailer.csv"
    path.write_text("Zeit;x;y\ns;V;V\n" + numbers(";", ",") + "Mittelwert;0,5;0,2\n" * lines, encoding="utf-8")
    made = import_recording(path, {"time": "Zeit", "signals": {"d": {"columns": ["x", "y"], "unit": "V"}}})
    np.testing.assert_allclose(made.signal("d"), np.column_stack([X, Y]), rtol=0, atol=1e-9)


GOOD = numbers(";", columns=(TIME, np.arange(N) / 2, np.arange(N) % 7 * 1.0))
TWO_CLOCKS = "a;b;a;c\n" + numbers(";", columns=(TIME, X, 2 * TIME, Y))


def thousands(sign):
    return "a;b\n" + "".join(f"{k / 1000};{980 + k:,}\n".replace(",", sign) for k in range(N))


@pytest.mark.parametrize(
    ("text", "time", "words"),
    [
        ("a;b;c\n" + GOOD + "na", "a", "line 42 has 1 cells"),  # cut within a number
        ("a;b;c\n" + GOOD + "1e", "a", "line 42 has 1 cells"),
        ("a;b;c\nn/a;1;2\n" + GOOD, "a", "line 2, column 'a': 'n/a' is not a number"),
        ("a;b;c\n0x;1;2\n" + GOOD, "a", "line 2, column 'a': '0x' is not a number"),
        ("a;b;b\n" + GOOD, "a", "column 'b' occurs 2 times with different numbers; name one, 'b #1' to 'b #2'"),
        (TWO_CLOCKS.replace("c\n", "b\n"), "a", "column 'b' occurs 2 times"),
        (TWO_CLOCKS.replace("c\n", "b\n"), "a #1", "column 'b' occurs 2 times"),
        (
            TWO_CLOCKS.replace(";b;", ";c;").replace("c\n", "b\n"),
            "a #1",
            "columns have different sample times: a #1",
        ),
        (thousands("."), "a", "'1.000' may be a number of thousands"),
        (thousands(",").replace("0.", "0,"), "a", "'1,000' may be a number of thousands"),
        ("0;1;2\n" + GOOD, "column 1", "no header line"),
        ("Messung 1\n" + GOOD, "column 1", "header_line: 0 numbers the columns"),
        ("a;b\n31.02.2026 10:00:00;1\n31.02.2026 10:00:01;1\n", "a", "'31.02.2026 10:00:00' is no time stamp"),
        ("a;b\n2026-11-22 10:00:00Z;1\n2026-11-22 10:00:01;1\n", "a", "no time stamp of the form of '2026-11-22 10:0"),
        ("a;b\n31/02/2026 10:00:00;1\n31/02/2026 10:00:01;1\n", "a", "'31/02/2026 10:00:00' is no time stamp"),
        ("a;b\n13:00:00 PM;1\n13:00:01 PM;1\n", "a", "'13:00:00 PM' is no time stamp"),
        (
            "a;b\n" + "".join(f"1{k // 20}/03/2026 {23 * (k < 20):02d}:59:{k:02d};1\n" for k in range(40)),
            "a",
            "may begin with the day or the month, and the date changes within the file",
        ),
    ],
)
def test_what_may_be_read_in_two_ways_is_refused(tmp_path, text, time, words):
    path = tmp_path / "a.csv"
    path.write_text(text)
    column = "b" if time[0] == "a" else "column 2"
    with pytest.raises(DataError) as error:
        import_recording(path, {"time": time, "signals": {"s": {"columns": [column], "unit": "V"}}})
    assert words in str(error.value)


def test_a_point_is_the_decimal_sign_where_it_is_said(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(thousands("."))
    mapping = {"time": "a", "decimal": ".", "signals": {"s": {"columns": ["b"], "unit": "V"}}}
    assert import_recording(path, mapping).signal("s")[20, 0] == 1.0


def test_a_time_of_day_passes_midnight(tmp_path):
    path = tmp_path / "a.csv"
    rows = (f"{'23:59:59' if k < 30 else '00:00:00'},{(970 + k) % 1000:03d};{k}\n" for k in range(60))
    path.write_text("a;b\n" + "".join(rows))
    made = import_recording(path, {"time": "a", "signals": {"s": {"columns": ["b"], "unit": "V"}}})
    assert (made.n_samples, made.sample_time) == (60, pytest.approx(1e-3))


def test_days_and_months_are_told_apart_by_midnight(tmp_path):
    """The 3rd of December goes on as the 4th; March 12 does not as April 12."""
    path = tmp_path / "a.csv"
    rows = (
        f"0{3 + k // 30}/12/2026 {'23:59:59' if k < 30 else '00:00:00'},{(970 + k) % 1000:03d};{k}\n" for k in range(60)
    )
    path.write_text("a;b\n" + "".join(rows))
    made = import_recording(path, {"time": "a", "signals": {"s": {"columns": ["b"], "unit": "V"}}})
    assert (made.n_samples, made.sample_time) == (60, pytest.approx(1e-3))


def test_units_below_names_may_begin_with_an_empty_cell(tmp_path):
    """A stamp has no unit."""
    path = tmp_path / "a.txt"
    path.write_text("t\ta\tb\n\tmm\tV\n" + "".join(f"10:00:00.{k:03d}\t{k}\t1\n" for k in range(40)))
    assert [channel.unit for channel in list_channels(path)] == ["s", "mm", "V"]


def test_lines_are_named_by_the_listing(tmp_path, capsys):
    path = tmp_path / "messung.txt"
    path.write_text(SPEEDGOAT + numbers(",") + "End of file\n")
    layout = json_of(capsys, "peek", str(path))["layout"]
    assert (layout["header_line"], layout["unit_line"], layout["first_row_in_line"]) == (1, 6, 8)
    assert (layout["lines_skipped"], layout["last_row_in_line"]) == ("2 to 7", 47)
    assert [channel.unit for channel in list_channels(path)] == ["s", "V", "V"]


def of_labview(*begins, names="X_Value\tu\tComment", x_columns="One", rows=20):
    """An LVM file with a segment for each time of begin, which has a header of its own."""
    lines = ["LabVIEW Measurement\t", "Separator\tTab", "Decimal_Separator\t.", f"X_Columns\t{x_columns}"]
    lines += ["***End_of_Header***\t", ""]
    for k, begin in enumerate(begins):
        lines += [
            "Channels\t1\t",
            f"Samples\t{rows}\t",
            f"X0\t{begin}\t",
            "Delta_X\t0.001\t",
            "***End_of_Header***\t\t",
        ]
        lines += [
            names if k else "X_Value\tu\tComment",
            *(f"{begin + i / 1000:.3f}\t{k}.{i:012}" for i in range(rows)),
            "",
        ]
    return "\n".join(lines) + "\n"


def test_segments_of_labview_are_joined_by_their_times(tmp_path):
    path = tmp_path / "a.lvm"
    path.write_text(of_labview(0.0, 0.02, 0.05))
    mapping = {"time": "X_Value", "signals": {"u": {"columns": "u", "unit": "V", "stored_unit": "V"}}}
    complete = import_recording(path, {**mapping, "gaps": "missing"})
    assert complete.n_samples == 70
    assert complete.missing == {"u": 10}
    np.testing.assert_allclose(complete.signals["u"][[0, 20, 50], 0], [0, 1, 2])
    remarks = complete.provenance["import_remarks"]
    assert "3 segments; the headers of those after the first, lines 34, 61, left out" in remarks
    assert import_recording(path, mapping).n_samples == 40  # the longest piece without a gap
    path.write_text(of_labview(0.0, 0.02, x_columns="No"))
    with pytest.raises(DataError, match="2 segments without times"):
        import_recording(path, mapping)
    path.write_text(of_labview(0.0, 0.02, names="X_Value\tv\tComment"))
    with pytest.raises(DataError, match="line 39: segments with other columns"):
        import_recording(path, mapping)


def test_a_large_file_of_labview_is_read_in_part_where_it_has_one_segment(tmp_path):
    path, n = tmp_path / "a.lvm", 110_000
    mapping = {"time": "X_Value", "signals": {"u": {"columns": "u", "unit": "V", "stored_unit": "V"}}}
    for begins, words in (([0.0], "read alone"), ([0.0, 110.0], "220000 rows")):
        path.write_text(of_labview(*begins, rows=n))
        made = import_recording(path, {**mapping, "samples": [n - 10, n - 5]})
        assert words in made.provenance["source_rows"]
        np.testing.assert_allclose(made.signals["u"][:, 0], [float(f"0.{i:012}") for i in range(n - 10, n - 5)])


def in_time(n=N, late=0.0, form="{h:02d}:{m:02d}:{s:06.3f}", day=22):
    """Return rows of a stamp, x and y, each 10 ms after the one before."""
    rows = []
    for k in range(n):
        t = late + 0.01 * k
        h, m = int(t // 3600), int(t % 3600 // 60)
        words = {"d": day + h // 24, "h": h % 24, "h12": (h - 1) % 12 + 1, "m": m, "s": round(t % 60, 3)}
        rows.append(f"{form.format(**words)}{' PM' if h % 24 >= 12 else ' AM'};{k};{k % 3}\n")
    return "Time;x;y\n" + "".join(
        rows if "h12" in form else [row.replace(" PM", "").replace(" AM", "") for row in rows]
    )


CLOCK = "{h:02d}:{m:02d}:{s:06.3f}"
NEAR_NOON, NEAR_MIDNIGHT = 11 * 3600 + 3599.8, 23 * 3600 + 3599.8


@pytest.mark.parametrize(
    ("form", "late", "day"),
    [
        ("03/{d:02d}/2026 " + CLOCK, NEAR_MIDNIGHT, 22),
        ("{d:02d}/03/2026 " + CLOCK, NEAR_MIDNIGHT, 22),
        ("{d:02d}/03/26 " + CLOCK, 3600.0, 4),
        ("{d}-3-2026 " + CLOCK, NEAR_NOON, 4),
        ("{d:02d}-Mar-2026 " + CLOCK, NEAR_MIDNIGHT, 4),
        ("2026/3/{d} " + CLOCK, NEAR_MIDNIGHT, 4),
        ("3/{d}/2026 {h12}:{m:02d}:{s:06.3f}", NEAR_NOON, 4),
        ("{h12:02d}:{m:02d}:{s:06.3f}", NEAR_NOON, 4),
    ],
)
def test_dates_and_halves_of_a_day_of_any_order(tmp_path, form, late, day):
    """Only differences matter: within a day no order of day and month does."""
    path = tmp_path / "a.csv"
    path.write_text(in_time(late=late, form=form, day=day))
    made = import_recording(path, {"time": "Time", "signals": {"d": {"columns": ["x"], "unit": "V"}}})
    assert made.sample_time == 0.01
    assert made.n_samples == N
    assert "import_remarks" not in made.provenance


def three_decimals(time, whole="120,000"):
    rows = (f"{0.25 * k if time == '%.2f' else k:{time[1:]}};{119.99 + k / 500:.3f}\n" for k in range(N))
    return "Zeit;x\n" + "".join(rows).replace(".", ",").replace("120,000", whole)


@pytest.mark.parametrize("whole", ["120,000", "120"])
def test_the_decimal_sign_is_settled_by_the_whole_file(tmp_path, whole):
    path = tmp_path / "a.csv"
    mapping = {"time": "Zeit", "signals": {"d": {"columns": ["x"], "unit": "V"}}}
    path.write_text(three_decimals("%.2f", whole))
    expected = [round(119.99 + k / 500, 3) for k in range(N)]
    np.testing.assert_allclose(import_recording(path, mapping).signal("d")[:, 0], expected, rtol=1e-12)
    path.write_text(three_decimals("%d", whole))
    with pytest.raises(DataError, match="may be a number of thousands"):
        import_recording(path, mapping)
    np.testing.assert_allclose(
        import_recording(path, {**mapping, "decimal": ","}).signal("d")[:, 0], expected, rtol=1e-12
    )


PLAIN = "".join(f"{k * STEP:.4f},{k},{k % 3}\n" for k in range(N))


@pytest.mark.parametrize(
    ("top", "said"),
    [
        *((f"{mark} rig 3, run 5\n{mark}Time,x,y\n", "") for mark in ("#", "%", "//", ";", "!", "'", "*")),
        ("Source,CH1,CH2\nTime,x,y\n", ""),
        ("Source,CH1,CH2\nTime,x,y\ns,V,V\n", ""),
        ("Time,x,y,Note\n", ""),
        (f"Model,MSO\nRecord Length,{N}\n\nTime,x,y\n", ""),
        ("Model,MSO\nRecord Length,5000\n\nTime,x,y\n", f"line 2 states 5000 samples, the file has {N}"),
        ("# Anzahl Messwerte: 20\nTime,x,y\n", f"line 1 states 20 samples, the file has {N}"),
        ("Nombre de points;41\nTime,x,y\n", f"line 1 states 41 samples, the file has {N}"),
    ],
)
def test_comments_blocks_and_counts_above_the_rows(tmp_path, top, said):
    path = tmp_path / "a.csv"
    rows = PLAIN if "Note" not in top else PLAIN.replace("\n", ",\n").replace(",1,\n", ",1,seen\n", 1)
    path.write_text(top + rows)
    made = import_recording(path, {"time": "Time", "signals": {"d": {"columns": ["x", "y"], "unit": "V"}}})
    np.testing.assert_array_equal(made.signal("d"), [[k, k % 3] for k in range(N)])
    assert made.provenance.get("import_remarks", "") == said


def test_a_quoted_first_name_is_no_comment(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("'x','y'\n0,1\n1,2\n2,3\n")
    made = import_recording(path, {"sample_time_s": 1.0, "signals": {"d": {"columns": ["'x'"], "unit": "V"}}})
    assert made.n_samples == 3


def test_labview_rows_that_end_with_a_tab(tmp_path):
    path = tmp_path / "a.lvm"
    path.write_text(LABVIEW + numbers("\t", ",").replace("\n", "\t\n"))
    made = import_recording(path, {"time": "X_Value", "signals": {"d": {"columns": ["x", "y"], "unit": "V"}}})
    np.testing.assert_allclose(made.signal("d"), np.column_stack([X, Y]), rtol=0, atol=1e-9)
