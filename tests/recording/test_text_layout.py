"""Layout of text files of loggers: found by itself, shown by the listing, and overridden."""

import numpy as np
import pytest
from experiment_files import json_of, printed_by

from gbid.core.errors import DataError
from gbid.recording import import_recording, text_files
from gbid.recording.mapping import TextOptions
from gbid.recording.text_files import read_table

ROWS = [[0.0, 1.5, -2.0], [0.1, 2.5, 4.0], [0.2, -3.25, 0.5], [0.3, 1e-3, 7.0]]


def body(delimiter=";", decimal=",", end=""):
    return "".join(delimiter.join(repr(v).replace(".", decimal) for v in row) + end + "\n" for row in ROWS)


PREAMBLE = "Messprogramm 3.1\nPrüfstand: Gaslager\nDatum;22.11.2026\nKanäle;3\n\n"
GERMAN = PREAMBLE + "Zeit;Weg x;Kraft\ns;µm;N\n" + body()


@pytest.mark.parametrize(
    ("data", "units", "layout"),
    [
        (GERMAN.encode("cp1252"), ("s", "µm", "N"), ("cp1252", ";", ",", 6, 7, 8)),
        (GERMAN.encode("utf-16"), ("s", "µm", "N"), ("utf-16", ";", ",", 6, 7, 8)),
        (GERMAN.encode("utf-16-le"), ("s", "µm", "N"), ("utf-16-le", ";", ",", 6, 7, 8)),
        (GERMAN.encode("utf-8-sig"), ("s", "µm", "N"), ("utf-8-sig", ";", ",", 6, 7, 8)),
        (
            GERMAN.replace("s;µm", "time;Taster oben;Dose\n[s];[µm]").encode(),
            ("s", "µm", "N"),
            ("utf-8", ";", ",", 6, 8, 9),
        ),
        (GERMAN.replace("s;µm;N\n", "").encode(), (None,) * 3, ("utf-8", ";", ",", 6, None, 7)),
        (
            b"sep=;\nZeit;Weg x (mm);Kraft\n" + body(end=";").encode(),
            (None, "mm", None),
            ("utf-8", ";", ",", 2, None, 3),
        ),
        (b"Zeit\tWeg x\tKraft\n" + body("\t").encode(), (None,) * 3, ("utf-8", "\t", ",", 1, None, 2)),
        (b"Zeit   Weg_x Kraft\n" + body("   ", ".").encode(), (None,) * 3, ("utf-8", " ", ".", 1, None, 2)),
        (
            b"% made by hand\n# Zeit,Weg x,Kraft\n" + body(",", ".").encode(),
            (None,) * 3,
            ("utf-8", ",", ".", 2, None, 3),
        ),
        (
            b"Zeit,Weg x,Kraft\n" + body('","', ",").replace("\n", '"\n"').encode()[:-1].join([b'"', b""]),
            (None,) * 3,
            ("utf-8", ",", ",", 1, None, 2),
        ),
    ],
)
def test_layouts_are_found(tmp_path, data, units, layout):
    path = tmp_path / "Messung 1.csv"
    path.write_bytes(data)
    table = read_table(path)
    assert tuple(table.layout.stated().values()) == layout
    assert table.headings[0] == "Zeit"
    assert table.units == units
    np.testing.assert_array_equal(table.columns([0, 1, 2]), ROWS)


def test_integers_at_the_end_do_not_hide_the_decimal_comma(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t;u\n0,5;1\n" + "".join(f"{k};0\n" for k in range(1, 60)))
    assert read_table(path).columns([0])[0, 0] == 0.5


def test_one_column_of_decimal_commas_is_one_column(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Weg\n1,5\n2,5\n")
    np.testing.assert_array_equal(read_table(path).columns([0]), [[1.5], [2.5]])


def test_what_is_given_is_not_looked_for(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("first;second;third\nTaster;Weg x;Kraft\n" + body(decimal=".").replace("0.5", "5"))
    assert read_table(path).headings == ("first", "second", "third")
    table = read_table(path, TextOptions(header_line=2))
    assert table.headings == ("Taster", "Weg x", "Kraft")
    mapping = {"sample_time_s": 0.1, "signals": {"f": {"columns": ["Kraft"], "unit": "N"}}}
    assert import_recording(path, {**mapping, "header_line": 2}).n_samples == len(ROWS)
    with pytest.raises(DataError, match=r"column 'Kraft': '-2\.0' is not a number; the decimal sign is ',' here"):
        import_recording(path, {**mapping, "header_line": 2, "decimal": ","})
    with pytest.raises(DataError, match="header_line: line 40 is empty or beyond the end"):
        read_table(path, TextOptions(header_line=40))


def test_the_listing_says_how_a_file_is_read(tmp_path, capsys):
    path = tmp_path / "Messung 1 ölig.csv"
    path.write_bytes(GERMAN.encode("cp1252"))
    for options, names in (([], ["Zeit", "Weg x", "Kraft"]), (["--encoding", "cp1250"], ["Zeit", "Weg x", "Kraft"])):
        document = json_of(capsys, "peek", str(path), *options)
        assert [row["channel"] for row in document["channels"]] == names
        assert document["layout"]["encoding"] == (options[1] if options else "cp1252")
        assert document["channels"][1]["first"] == [1.5, 2.5, -3.25]
    shown = printed_by(capsys, "peek", str(path)).out
    assert "encoding 'cp1252', delimiter ';', decimal ',', header line 6, unit line 7, first row in line 8" in shown
    assert "rises in even steps of 0.1: 10 Hz" in shown


@pytest.mark.parametrize(
    ("text", "names", "units"),
    [
        (
            "version,1.0\ntrace_values,,,\n,Time,Force,Pos\nunit,s,N,mm\ndescription,,,\n,0,1.5,2\n,0.1,1.6,3\n,0.2,1.7,4\n",
            ("", "Time", "Force", "Pos"),
            (None, "s", "N", "mm"),
        ),
        (
            "File;a\n\nName;Force;Name;Pos\nType;LREAL;Type;LREAL\nUnit;N;Unit;mm\n0,5;1,5;0,5;2\n1,5;1,6;1,5;3\n2,5;1,7;2,5;4\n",
            ("Name #1", "Force", "Name #2", "Pos"),
            (None, "N", None, "mm"),
        ),
        (
            "Samples\t3\t3\nY_Unit_Label\tN\tmm\t\nX0\t0\t0\nX_Value\tForce\tPos\tComment\n0.1\t1.5\t2\n0.2\t1.6\t3\n0.3\t1.7\t4\n",
            ("X_Value", "Force", "Pos"),
            (None, "N", "mm"),
        ),
        ("x-axis,1,2\nsecond,N,mm\n0.1,1.5,2\n0.2,1.6,3\n0.3,1.7,4\n", ("x-axis", "1", "2"), ("second", "N", "mm")),
        ("% Time px py\n% s um um\n0.1 1.5 2\n0.2 1.6 3\n0.3 1.7 4\n", ("Time", "px", "py"), ("s", "um", "um")),
        (
            "time\tY[0]\tratio [1]\n0.1\t1.5\t2\n0.2\t1.6\t3\n0.3\t1.7\t4\n",
            ("time", "Y[0]", "ratio [1]"),
            (None, None, "1"),
        ),
    ],
    ids=["dSPACE", "Beckhoff", "LabVIEW", "Keysight", "comments", "index"],
)
def test_a_line_that_says_unit_has_the_units(tmp_path, text, names, units):
    (tmp_path / "a.txt").write_text(text)
    table = read_table(tmp_path / "a.txt")
    assert (table.headings, table.units, len(table.rows)) == (names, units, 3)


def test_a_long_text_without_numbers_takes_no_longer_for_its_names(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(text_files, "is_file_unit", lambda cell: calls.append(cell))
    counts = []
    for lines in (3000, 6000):
        calls.clear()
        (tmp_path / "a.csv").write_text("a;b\tc, d\n" * lines)
        with pytest.raises(DataError, match="is not a number"):
            text_files.read_table(tmp_path / "a.csv").columns([0])
        counts.append(len(calls))
    assert counts[0] == counts[1]
