"""A folder of one's own files becomes a campaign: by the names of the files, or by a table."""

import csv
import json

import numpy as np
import pytest
from experiment_files import gbid, json_of, printed_by
from own_files import BY_NAME, BY_TABLE, CLOCK, COLUMNS, SIGNALS, columns_of, write_file
from rig_point import machine, modes

from gbid.core.errors import UsageError
from gbid.experiment.load import load_experiment
from gbid.experiment.schema import name_pattern
from gbid.rig import Prbs, Stationary, record
from gbid.structure import KEY_PARAMETERS

CAMPAIGN = """\
prefilter: {harmonics: 10, median: 1}
fits:
  bearing: {structure: rotor_bearing, options: {disturbance_gain: none}, focus: simulation, stop: paper}
  piezos: {structure: piezo_pair}
crossval:
  bearing: {on: cyclic}
  piezos: {on: others}
nominal: {fit: piezos}
"""
POINTS = ((5.0, 6000.0), (6.0, 0.0))


@pytest.fixture(scope="module")
def measured():
    """Two PRBS runs and a still one at each of two operating points, by file name without ending."""
    results = {}
    for seed, (pressure, speed) in enumerate(POINTS):
        conditions = {"pressure_bar": pressure, "speed_rpm": speed}
        rig, label = machine(pressure, speed), f"p{pressure:g}_n{speed:g}"
        still = record(rig, Stationary(0.6), conditions=conditions, seed=seed, name="still")
        results[f"{label}_still1"] = columns_of(still)
        for i in (1, 2):
            made = record(rig, Prbs(0.6), conditions=conditions, seed=10 * seed + i, name="prbs")
            results[f"{label}_prbs{i}"] = columns_of(made)
    return results


def write_folder(folder, measured, ending="npz", text=BY_NAME, more=CAMPAIGN):
    (folder / "data").mkdir(parents=True)
    for name, columns in measured.items():
        write_file(folder / "data" / f"{name}.{ending}", columns)
    path = folder / "experiment.yaml"
    path.write_text(text.format(ending=ending, clock=CLOCK, signals=SIGNALS.rstrip()) + more)
    return path


def small():
    """Recordings that only their names matter of."""
    random = np.random.default_rng(0)
    columns = {name: random.standard_normal(300) for name in (*COLUMNS, "phi")}
    labels = ("p5_n6000", "p6_n0")
    return {f"{label}_{kind}": columns for label in labels for kind in ("prbs1", "prbs2", "still1")}


def complaints(path):
    with pytest.raises(UsageError) as error:
        load_experiment(path)
    return str(error.value).splitlines()


# ---- end to end ----


def test_a_folder_runs_as_a_campaign(measured, tmp_path, capsys):
    path = write_folder(tmp_path, measured, "mat")
    rows = json_of(capsys, "import", path)["recordings"]
    kinds = {"prbs1": "excited", "prbs2": "excited", "still1": "stationary"}
    expected = [(f"{label}_{word}", kind) for label in ("p5_n6000", "p6_n0") for word, kind in kinds.items()]
    assert [(row["name"], row["kind"]) for row in rows] == expected
    assert rows[0]["conditions"] == {"pressure_bar": 5.0, "speed_rpm": 6000.0}
    fits = json_of(capsys, "fit", path, "--engine", "serial")["fits"]
    assert len(fits) == 8
    known = machine(6.0, 0.0).rotor_bearing
    by_name = {row["parameter"]: row["estimate"] for row in fits[2]["parameters"]}
    assert fits[2]["recordings"] == ["p6_n0_prbs1"]
    assert set(KEY_PARAMETERS) <= set(by_name)
    assert [row["frequency_hz"] for row in fits[2]["modes"]] == pytest.approx(modes(known)[0], rel=0.03)

    told = json_of(capsys, "crossval", path, "--engine", "serial")
    pairs = {(row["model"], row["recording"]) for row in told["crossval"] if row["fit"] == "bearing"}
    others = (("prbs1", "prbs2"), ("prbs2", "prbs1"))
    assert pairs == {(f"{label}_{a}", f"{label}_{b}") for label in ("p5_n6000", "p6_n0") for a, b in others}
    bearing, piezos = told["crossval_summary"]
    assert (bearing["fit"], bearing["n_pairs"], piezos["fit"], piezos["n_pairs"]) == ("bearing", 4, "piezos", 12)
    percents = [row["fit_percent"] for row in told["crossval"] if row["fit"] == "bearing" and row["output"] == "p_x"]
    assert bearing["mean"][0] == pytest.approx(np.mean(percents))
    assert bearing["std"][0] == pytest.approx(np.std(percents, ddof=1))
    assert sum(bearing["counts"][0]) + bearing["below"][0] == 4
    assert [(p["pressure_bar"], p["speed_rpm"]) for p in bearing["points"]] == [(5, 6000), (6, 0)]
    assert min(piezos["least"]) > 90
    assert told["nominal"]["model"] in {row["model"] for row in told["crossval"]}
    results = tmp_path / "results" / "own"
    for file in ("crossval/piezos_summary.csv", "crossval/piezos_summary.h5", "nominal/piezos.yaml"):
        assert (results / file).is_file()

    assert gbid("crossval", path, "--json") == 0  # read back from what is there
    again = json.loads(capsys.readouterr().out)
    assert {row["state"] for row in again["outcomes"]} == {"kept"}
    assert again["crossval"] == told["crossval"]
    out = printed_by(capsys, "crossval", path).out
    assert "piezos, cross-validation: 4 models, 4 recordings, 12 pairs" in out
    assert "piezos, nominal actuator" in out
    assert "of 4 models" in out

    (results / "fits" / "piezos" / "p6_n0_prbs1.h5").unlink()  # one model missing: the others are validated anew
    captured = printed_by(capsys, "crossval", path, "--overwrite", "--json", code=3)
    less = json.loads(captured.out)
    assert less["crossval_summary"][1]["n_pairs"] == 9
    assert len(less["crossval_summary"][1]["failed"]) == 3
    assert "`gbid fit` makes it" in captured.err
    assert less["nominal"]["left_out"][0].startswith("p6_n0_prbs1: ")


def test_a_table_gives_the_same_recordings(tmp_path):
    path = write_folder(tmp_path / "a", small(), text=BY_NAME, more="")
    other = write_folder(tmp_path / "b", {f"log{i}": c for i, c in enumerate(small().values())}, text=BY_TABLE, more="")
    rows = [("file", "name", "kind", "pressure_bar", "speed_rpm", "remark")]
    for i, name in enumerate(small()):
        pressure, speed = ("5.0", "6000") if name.startswith("p5") else ("6.0", "0")
        rows.append((f"log{i}.npz", name, "still" if "still" in name else "prbs", pressure, speed, "a, b"))
    with (other.parent / "data" / "runs.csv").open("w", newline="") as handle:
        csv.writer(handle).writerows(rows)

    def planned(where):
        return {q.name: (q.kind, dict(q.conditions), q.point) for q in load_experiment(where).recordings.values()}

    assert planned(path) == planned(other)


# ---- file names ----


def test_fields_of_file_names():
    pattern = name_pattern("{day}/{name}_p{pressure_bar:g}_n{speed_rpm:d}_{kind}.mat")
    words, point = {"day": "monday", "name": "run_1", "kind": "prbs"}, {"pressure_bar": 3.5, "speed_rpm": -40.0}
    assert pattern.read("monday/run_1_p3.5_n-40_prbs.mat") == words | point
    for other in ("a/b/r_p3_n4_x.mat", "a/r_p3_n4.5_x.mat", "a/r_p3_n4_x.npz", "a/r_p3_n4_x.mat.bak", "r_p3_n4_x.mat"):
        assert pattern.read(other) is None
    assert name_pattern("p{pressure_bar:g}.csv").read("p1e-1.csv") == {"pressure_bar": 0.1}
    assert name_pattern("a.b{name}.csv").read("axbq.csv") is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{}.mat", "names no field"),
        ("{a b}.mat", "names no field"),
        ("{name}{name}.mat", "occurs twice"),
        ("{speed_rpm:x}.mat", "unknown form 'x'"),
        ("{speed_rpm}.mat", "is a number; write {speed_rpm:g}"),
        ("{name:d}.mat", "is a word"),
        ("{name.mat", "a brace has no partner"),
    ],
)
def test_patterns_that_make_no_sense(text, says):
    with pytest.raises(UsageError) as error:
        name_pattern(text)
    assert says in str(error.value)


# ---- complaints ----


def test_files_that_do_not_fit_are_named(tmp_path):
    path = write_folder(tmp_path, {**small(), "notes_of_monday": small()["p6_n0_prbs1"]}, more="")
    (line,) = complaints(path)
    assert "experiment.yaml:6:5: import.folder.pattern: file notes_of_monday.npz does not match" in line
    assert "add it to ignore" in line
    path.write_text(path.read_text().replace("    sample_time", "    ignore: notes*\n    sample_time"))
    assert len(load_experiment(path).recordings) == 6
    (path.parent / "data" / "readme.txt").write_text("not a recording")
    assert len(load_experiment(path).recordings) == 6


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("_n{speed_rpm:d}", "_n{turns:d}", "has no field speed_rpm; write {speed_rpm:g} into it"),
        ("_n{speed", "_s{speed", "_s{speed_rpm:d}_{kind}{nr:d}.npz'; there is p5_n6000_prbs1.npz"),
        ("{nr:d}", "", "file p5_n6000_prbs1.npz: unknown kind 'prbs1'"),
        ("{kind}{nr:d}", "{name}{nr:d}", "p5_n6000_prbs1.npz both give the name 'prbs'; without {name}"),
        ("{nr:d}.npz", "{nr:d}", "has no ending; write that of the files"),
        ("data_folder: data", "data_folder: nowhere", "no folder"),
        ("  folder:", "  files:", "unknown key"),
        ("u: {columns: [u_x, u_y], unit: um}", "u: {columns: [u_x, u_y], channels: [a], unit: um}", "one name each"),
    ],
)
def test_folders_that_make_no_sense(old, new, says, tmp_path):
    path = write_folder(tmp_path, small(), more="")
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert [line for line in complaints(path) if says in line]


def test_a_word_for_a_kind_of_ones_own(tmp_path):
    path = write_folder(tmp_path, {name.replace("still", "idle"): c for name, c in small().items()}, more="")
    assert any("unknown kind 'idle'" in line for line in complaints(path))
    kinds = "    kinds: {prbs: excited, idle: stationary}\n    sample_time"
    path.write_text(path.read_text().replace("    sample_time", kinds))
    assert not load_experiment(path).recordings["p6_n0_idle1"].excited


TABLE = "file,name,kind,pressure_bar,speed_rpm\na.npz,a,prbs,5,6000\nb.npz,b,still,5,6000\n"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("b.npz,", "c.npz,", "line 3: no file"),
        ("5,6000\nb", ",6000\nb", "line 2: pressure_bar is empty; write a number"),
        ("5,6000\nb", "5,fast\nb", "line 2: speed_rpm is 'fast'; write a number"),
        ("speed_rpm", "rpm", "no column 'speed_rpm'; "),
        ("file,", "path,", "no column 'file'; "),
        ("b.npz,b", "b.npz,a", "a.npz both give the name 'a'; give each row"),
        ("b.npz,b", "b.npz,b b", "'b b' cannot be a name"),
        ("still", "idle", "unknown kind 'idle'"),
        ("b.npz,b,still,5,6000", "b.npz,b,still,5", "line 3 has 4 cells, the header line has 5"),
        ("b.npz,", ",", "line 3: file is empty"),
        (TABLE, "file\n", "the table has a line with the names of the columns and one line"),
    ],
)
def test_tables_that_make_no_sense(old, new, says, tmp_path):
    columns = small()["p6_n0_prbs1"]
    path = write_folder(tmp_path, {"a": columns, "b": columns}, text=BY_TABLE, more="")
    table = path.parent / "data" / "runs.csv"
    table.write_text(TABLE)
    assert len(load_experiment(path).recordings) == 2
    assert old in TABLE
    table.write_text(TABLE.replace(old, new))
    lines = complaints(path)
    assert any(says in line and "runs.csv" in line for line in lines), lines
    table.unlink()
    assert any("runs.csv: cannot be read" in line for line in complaints(path))


def test_run_10_comes_after_run_2(tmp_path):
    path = write_folder(tmp_path, {f"p5_n0_prbs{i}": small()["p6_n0_prbs1"] for i in (10, 2, 1)}, more="")
    assert list(load_experiment(path).recordings) == ["p5_n0_prbs1", "p5_n0_prbs2", "p5_n0_prbs10"]


def test_rigs_without_an_operating_point(tmp_path):
    columns = small()["p6_n0_prbs1"]
    path = write_folder(tmp_path, {"a": columns, "b": columns}, more="")
    text = path.read_text().replace("p{pressure_bar:g}_n{speed_rpm:d}_{kind}{nr:d}", "{name}")
    path.write_text(text)
    assert any("has no field pressure_bar" in line for line in complaints(path))
    path.write_text(text.replace("    sample_time", "    operating_point: false\n    sample_time"))
    assert [q.point for q in load_experiment(path).recordings.values()] == ["any", "any"]
    conditions = "    conditions: {pressure_bar: 4.0, speed_rpm: 0}\n    sample_time"
    path.write_text(text.replace("    sample_time", conditions))
    assert [q.point for q in load_experiment(path).recordings.values()] == ["p4_n0", "p4_n0"]


def test_recordings_listed_beside_a_folder(tmp_path):
    path = write_folder(tmp_path, {**small(), "extra": small()["p6_n0_prbs1"]}, more="")
    entry = "{name: extra, file: extra.npz, sample_time_s: 2.0e-4, signals: {u: {columns: u_x, unit: um}}}"
    listed = f"  recordings:\n    - {entry}\n"
    path.write_text(path.read_text().replace("  folder:\n", listed + "  folder:\n"))
    assert next(iter(load_experiment(path).recordings)) == "extra"
    assert len(load_experiment(path).recordings) == 7
    path.write_text(path.read_text().replace("name: extra,", "name: p6_n0_prbs1,"))
    assert any("a second recording named 'p6_n0_prbs1'" in line for line in complaints(path))


def test_a_german_table_and_names_with_blanks(tmp_path):
    columns = small()["p6_n0_prbs1"]
    path = write_folder(tmp_path, {"a": columns}, text=BY_TABLE, more="")
    data = path.parent / "data"
    (data / "a.npz").rename(data / "Lauf 1 früh.npz")
    text = "Versuche im März\n\nfile;kind;pressure_bar;speed_rpm\nLauf 1 früh.npz;prbs;5,5;6000\n"
    (data / "runs.csv").write_bytes(text.encode("cp1252"))
    recordings = load_experiment(path).recordings
    assert {name: dict(q.conditions) for name, q in recordings.items()} == {
        "Lauf_1_frueh": {"pressure_bar": 5.5, "speed_rpm": 6000.0}
    }
