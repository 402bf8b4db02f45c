"""`gbid init FOLDER`: an experiment drafted from measured files, by what they say and by what is given."""

from pathlib import Path

import numpy as np
import pytest
from experiment_files import gbid, printed_by
from scipy.io import savemat

from gbid import load, load_recording
from gbid.cli import files as new
from gbid.experiment.load import load_experiment
from gbid.experiment.schema import read_names
from gbid.recording.readers import FileChannel
from gbid.recording.roles import find_roles

N, DT = 900, 4e-4


def write(path: Path, moving: bool, rpm: float = 4000.0, names="t [s];r_x;r_y;u_x;u_y;p_x;p_y;phi [deg]", still_s=0.0):
    random = np.random.default_rng(len(path.name))
    t = DT * np.arange(N)
    r = np.repeat(random.choice([-4.0, 4.0], (N // 10, 2)), 10, axis=0) * moving
    turning = np.clip((t - still_s) / max(still_s, DT), 0, 1)
    phi = np.mod(np.cumsum(6 * rpm * DT * turning), 360)
    runout = np.column_stack([2 * np.cos(np.deg2rad(phi)), np.sin(np.deg2rad(3 * phi))])
    p = runout + 0.02 * random.standard_normal((N, 2)) + 0.5 * r
    columns = np.column_stack([t, r, 0.9 * r + 0.01 * random.standard_normal((N, 2)), p, phi])
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, columns[:, : names.count(";") + 1], "%.7g", ";", header=names, comments="", encoding="cp1252")


@pytest.fixture
def measured(tmp_path):
    for pressure in (5, 6, 7):
        for word, moving in (("ruhe", False), ("rauschen", True)):
            names = "t [s];r_x [µm];r_y [µm];u_x [µm];u_y [µm];p_x [µm];p_y [µm];phi [deg]"
            write(tmp_path / "runs" / f"P{pressure}_N4000_{word}1.csv", moving, names=names)
    (tmp_path / "runs" / "notes.md").write_text("one speed")
    return tmp_path / "runs"


def test_one_speed_is_drafted_and_can_be_checked(measured, tmp_path, capsys):
    said = printed_by(capsys, "init", measured, tmp_path / "own", "--controller", "biquad")
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    assert 'pattern: "P{pressure_bar:g}_N{speed_rpm:d}_{kind}1.csv"' in text
    assert 'kinds: {"rauschen": excited, "ruhe": stationary}' in text
    assert 'order: ["1", "P", "P^2"]' in text
    assert "harmonics: 3" in text
    assert "structure: biquad" in text
    assert "sample_time_s: 0.0004}" in text
    assert "3 harmonics leave" in said.err
    assert "of a kind that is not imported: notes.md" in said.err
    assert f"next: gbid check {tmp_path / 'own' / 'experiment.yaml'}" in said.err
    experiment = load_experiment(tmp_path / "own" / "experiment.yaml")
    assert [(q.point, q.excited) for q in experiment.recordings.values()] == [
        (f"p{p}_n4000", moving) for p in (5, 6, 7) for moving in (True, False)
    ]


def test_a_run_up_is_cut_away_and_one_point_has_order_0(tmp_path, capsys):
    full = "t [s];r_x [um];r_y [um];u_x [um];u_y [um];p_x [um];p_y [um];phi [deg]"
    write(tmp_path / "a" / "5,5 bar 4000 rpm PRBS 1.csv", True, names=full, still_s=0.05)
    assert gbid("init", tmp_path / "a", tmp_path / "own") == 0
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    assert "from_s: 0.2" in text
    assert "method: none" in text
    assert "order: 0" in text
    assert 'pattern: "{pressure_bar:g} bar {speed_rpm:d} rpm PRBS 1.csv"' in text
    (planned,) = load_experiment(tmp_path / "own" / "experiment.yaml").recordings.values()
    assert dict(planned.conditions) == {"pressure_bar": 5.5, "speed_rpm": 4000.0}


def test_what_files_do_not_say_is_given_or_asked(tmp_path, capsys, monkeypatch):
    write(tmp_path / "a" / "run1.csv", True, names="clock;c1;c2;c3;c4;c5;c6;angle [deg]")
    flags: list[str] = []
    for option, more in (
        ("--signal u=X,Y", ["--signal", "u=c3,c4"]),
        ("--signal p=X,Y", ["--signal", "p=c5,c6", "--signal", "r=c1,c2"]),
        ("--unit", ["--unit", "um"]),
        ("--pressure", ["--pressure", "5"]),
    ):
        said = printed_by(capsys, "init", tmp_path / "a", tmp_path / "own", *flags, code=2).err
        assert option in said
        assert "for another machine: gbid new DIR --template own-recordings" in said
        flags += more
    flags += ["--moving-mass", "2.5", "--clearance", "40"]
    left_out = printed_by(capsys, "init", tmp_path / "a", tmp_path / "own", *flags).err
    assert "not known, so left out: limits of the stacks in the control chain in C. Give --travel UM" in left_out
    assert "speed_rpm of 1 file is measured, by column angle: 4000" in left_out
    known = load_experiment(tmp_path / "own" / "experiment.yaml").spec.machine
    assert (known.moving_mass_kg, known.piezo_travel_m, known.clearance_m) == (2.5, None, 40e-6)
    given = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    answers = iter(["c3,c4", "c5, c6", "um", "5", "2,5", "", "40"])
    monkeypatch.setattr(new.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(new.typer, "prompt", lambda *_, **__: next(answers))
    assert gbid("init", tmp_path / "a", tmp_path / "asked", "--signal", "r=c1,c2") == 0
    draft = (tmp_path / "asked" / "experiment.yaml").read_text(encoding="utf-8")
    assert draft == given.replace("name: own", "name: asked")
    assert gbid("init", tmp_path / "a", tmp_path / "third", "--signal", "u=c1") == 2
    assert "u: expected the columns of the piezo positions, x then y" in capsys.readouterr().err
    assert "no folder" in printed_by(capsys, "init", tmp_path / "none", tmp_path / "third", code=2).err
    write(tmp_path / "still" / "p5_n4000.csv", False, names="t;u_x [um];u_y [um];p_x [um];p_y [um]")
    assert gbid("init", tmp_path / "still", tmp_path / "third") == 3
    assert "r and u move in no file" in capsys.readouterr().err


def test_a_text_without_a_table_beside_files_of_any_ending_is_left_out_with_the_reason(measured, tmp_path, capsys):
    for path in measured.glob("*.csv"):
        path.rename(path.with_suffix(".log"))
    (measured / "README").write_text(
        "Readme of this folder\n\nThese are runs of the rig, made in 2024.\nContact: someone\n"
    )
    said = printed_by(capsys, "init", measured, tmp_path / "own")
    assert "left out: " in said.err
    assert "README: no" in said.err
    assert len(load_experiment(tmp_path / "own" / "experiment.yaml").recordings) == 6
    for path in measured.glob("*.log"):
        path.unlink()
    assert "README: no" in printed_by(capsys, "init", measured, tmp_path / "none", code=3).err


@pytest.mark.parametrize(
    ("names", "roles"),
    [
        ("Zeit;Soll x;Soll y;Piezo x;Piezo y;Weg x;Weg y;Drehwinkel", {"r": "Soll", "u": "Piezo", "p": "Weg"}),
        ("t;rx;ry;ux;uy;px;py;phi", {"r": "r", "u": "u", "p": "p"}),
        ("Zeit;Soll_A;Soll_B;Aktor_A;Aktor_B;Spalt_A;Spalt_B;Winkelgeber", {"r": "Soll", "u": "Aktor", "p": "Spalt"}),
        ("t;CmdH;CmdV;ActuatorH;ActuatorV;GapH;GapV;ShaftEncoder", {"r": "Cmd", "u": "Actuator", "p": "Gap"}),
        ("t;Soll hor;Soll vert;Piezo hor;Piezo vert;Lage hor;Lage vert;Drehgeber", {"r": "Soll", "p": "Lage"}),
        ("t;set left;set right;act left;act right;prox left;prox right;enc", {"r": "set", "u": "act", "p": "prox"}),
        (
            "tempo;Rif. X;Rif. Y;Attuatore X;Attuatore Y;Spostamento X;Spostamento Y;Forza;Velocità;Angolo",
            {"r": "Rif", "u": "Attuatore", "p": "Spostamento"},
        ),
        (
            "temps;Consigne horizontale;Consigne verticale;Actionneur horizontale;Actionneur verticale;"
            "Déplacement horizontale;Déplacement verticale;Pression;Vitesse;Codeur",
            {"r": "Consigne", "u": "Actionneur", "p": "Déplacement"},
        ),
        (
            "tiempo;Consigna x;Consigna y;Actuador x;Actuador y;Desplazamiento x;Desplazamiento y;Presión;Ángulo",
            {"r": "Consigna", "u": "Actuador", "p": "Desplazamiento"},
        ),
        ("time;data.r[0];data.r[1];data.u[0];data.u[1];y;x;encoder", {"r": "data.r", "u": "data.u", "p": ""}),
    ],
)
def test_roles_of_channels(names, roles):
    columns = names.split(";")
    channels = [FileChannel(name, N, step=DT if i == 0 else None) for i, name in enumerate(columns)]
    time, signals, _ = find_roles(channels, {}, None)
    assert time == columns[0]
    assert signals["phi"] == (columns[-1],)
    for role, stem in roles.items():
        pair = signals[role]
        assert sorted(pair) == list(pair)
        assert all(column.startswith(stem) for column in pair)


def test_names_of_several_forms_have_no_pattern():
    for names, pattern in (
        (["p5_n0_a1.csv", "p6_n4000_b2.csv"], "p{pressure_bar:g}_n{speed_rpm:d}_{kind}{nr:d}.csv"),
        (["5.5 bar, 0 rpm.csv", "6 bar, 0 rpm.csv"], "{pressure_bar:g} bar, {speed_rpm:d} rpm.csv"),
    ):
        assert read_names(names).pattern.text == pattern
    assert read_names(["p5.csv", "q_5.csv"]) is None
    assert read_names(["p5,5.csv", "p6.csv"]).read("p5,5.csv") == {"pressure_bar": 5.5}


@pytest.mark.parametrize(
    "name",
    ["6bar_4200Umin_a", "6bar_4200_U-min", "6 bar 4200 1-min", "6bar_4200 min^-1", "6bar_4200UpM", "6bar_4200rpm_5min",
     "5min_6bar_4200rpm", "6bar_4200_rev_min", "6bar_4200tr_min", "6bar n=4200", "V1_rpm4200_bar6", "V1 rpm 4200 bar 6",
     "V1_6_bar_4200_rpm_3", "Druck_6_4200_Umdrehungen", "6bar_4.2krpm", "0.6MPa_70rps",
     "600kPa_4200U_per_min", "6,0bar_4200U"],
)  # fmt: skip
def test_pressure_and_speed_in_any_spelling(name):
    assert read_names([f"{name}.csv"]).read(f"{name}.csv") == {"pressure_bar": 6.0, "speed_rpm": 4200.0}


@pytest.mark.parametrize(
    "name", ["6bar_4.200Umin", "6bar_4,200rpm", "6bar_70Hz", "6bar_4200", "run1_u_6bar", "6bar_5min"]
)
def test_a_number_that_may_be_another_is_no_speed(name):
    assert read_names([f"{name}.csv"]).read(f"{name}.csv") == {"pressure_bar": 6.0}


def test_an_operating_point_that_no_name_tells_is_measured(tmp_path, capsys):
    names = "t [s];r_x [um];r_y [um];u_x [um];u_y [um];p_x [um];p_y [um];phi [deg]"
    for number, rpm, more in ((1, 4200.0, "Drehzahl [U/min];Druck [bar]"), (2, 3000.0, "Druck [bar]")):
        path = tmp_path / "m" / f"run{number}.csv"
        write(path, True, rpm, names, still_s=0.05 * (number == 2))  # a run-up does not decide
        lines = path.read_text(encoding="cp1252").splitlines()
        point = {"Drehzahl [U/min]": rpm + 3, "Druck [bar]": 4.98}
        cells = "".join(f";{point[column]:g}" for column in more.split(";"))
        rows = [f"{lines[0]};{more}", *(line + cells for line in lines[1:])]
        path.write_text("\n".join(rows), encoding="cp1252")
    said = printed_by(capsys, "init", tmp_path / "m", tmp_path / "own").err
    for words in ("speed_rpm of 1 file is measured, by column Drehzahl: 4200", "by column phi: 3000", "Druck: 5\n"):
        assert words in said
    recordings = load_experiment(tmp_path / "own" / "experiment.yaml").recordings
    assert [dict(q.conditions) for q in recordings.values()] == [
        {"pressure_bar": 5.0, "speed_rpm": 4200.0}, {"pressure_bar": 5.0, "speed_rpm": 3000.0}
    ]  # fmt: skip


def test_kinds_that_signals_do_not_show_are_given_by_words(tmp_path, capsys):
    names = "t [s];r_x [um];r_y [um];u_x [um];u_y [um];p_x [um];p_y [um];phi [deg]"
    for word in ("scala", "rumore"):
        write(tmp_path / "m" / f"6bar_4000giri_{word}.csv", True, names=names)
    assert gbid("init", tmp_path / "m", tmp_path / "own", "--kind", "scala=staircase") == 0
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    assert 'kinds: {"rumore": excited, "scala": staircase}' in text


@pytest.mark.parametrize(
    ("change", "words", "flags"),
    [
        (("phi [deg]", "phi [grad]"), "may be deg or gon: write the intended one (--unit phi=...)", ("phi=deg",)),
        (("phi [deg]\n", "phi [deg]\n0;1;2\n"), "is the file truncated", None),
        (("t [s];r_x", "0;0;r_x"), "name it with --header-line (--header-line 0 numbers", None),
        (("p_x [um]", "p_x [V]"), "--calibration 'X=0:0 10:125 um'", ("um", "--calibration", "p_x=0:0 1:1 um")),
    ],
)
def test_every_remedy_is_an_option(tmp_path, capsys, change, words, flags):
    names = "t [s];r_x [um];r_y [um];u_x [um];u_y [um];p_x [um];p_y [um];phi [deg]"
    path = tmp_path / "m" / "6bar_4000rpm.csv"
    write(path, True, names=names)
    path.write_text(path.read_text(encoding="cp1252").replace(*change))
    assert gbid("init", path.parent, tmp_path / "own") in (2, 3)
    assert words in capsys.readouterr().err
    if flags:
        assert gbid("init", path.parent, tmp_path / "own", "--unit", *flags) == 0
        load_experiment(tmp_path / "own" / "experiment.yaml")


def test_columns_given_once_are_those_of_csv_and_mat(tmp_path):
    names = "Zeit;Kanal 1;Kanal 2;Kanal 3;Kanal 4;Kanal 5;Kanal 6;Kanal 7"
    write(tmp_path / "m" / "6bar_4200rpm_a.csv", True, 4200.0, names)
    columns = np.genfromtxt(tmp_path / "m" / "6bar_4200rpm_a.csv", delimiter=";", skip_header=1).T
    fields = dict(zip(names.replace(" ", "_").split(";"), columns, strict=True))
    savemat(tmp_path / "m" / "7bar_4200rpm_b.mat", {"Mess": fields})
    given = {"r": (1, 2), "u": (3, 4), "p": (5, 6), "phi": (7,)}
    flags = [f"--signal={q}={','.join(f'Kanal {i}' for i in on)}" for q, on in given.items()]
    assert gbid("init", tmp_path / "m", tmp_path / "own", *flags, "--unit", "um") == 0
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    assert '["Kanal 5", "Kanal 6"]' in text
    assert '["Mess.Kanal_5", "Mess.Kanal_6"]' in text


GERMAN = "Zeit;Soll_A;Soll_B;Aktor_A;Aktor_B;Spalt_A;Spalt_B;Winkelgeber"


def test_a_german_folder_with_a_mat_file_needs_one_answer(tmp_path, capsys):
    for word, moving in (("Ruhe", False), ("Rauschen", True)):
        write(tmp_path / "m" / f"6bar_4200Umin_{word}.csv", moving, 4200.0, GERMAN)
    columns = np.genfromtxt(tmp_path / "m" / "6bar_4200Umin_Rauschen.csv", delimiter=";", names=True)
    savemat(tmp_path / "m" / "7bar_4200Umin_Probe.mat", {"Mess": {name: columns[name] for name in columns.dtype.names}})
    folders = (tmp_path / "m", tmp_path / "own")
    assert gbid("init", *folders) == 2
    said = capsys.readouterr().err
    assert said.count("; give the ") == 1
    assert "--unit" in said
    said = printed_by(capsys, "init", *folders, "--unit", "um").err
    assert "  Mess.Soll_A       r x       'soll', axis a" in said
    assert "phi: its numbers reach 3" in said  # the file states no unit, and radians fall back at 6.28
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    for words in (
        '["Mess.Spalt_A", "Mess.Spalt_B"]',
        "speed_rpm: 4200.0",
        'phi: {columns: ["Winkelgeber"], unit: "deg"}',
    ):
        assert words in text
    load_experiment(tmp_path / "own" / "experiment.yaml")


def test_all_open_roles_are_asked_at_once_and_unused_columns_are_told(tmp_path, capsys):
    write(tmp_path / "m" / "6bar_4200Umin.csv", True, 4200.0, "Zeit;K1;K2;K3;K4;K5;K6;K7")
    assert gbid("init", tmp_path / "m", tmp_path / "own") == 2
    said = capsys.readouterr().err
    for option in ("u=X,Y", "p=X,Y", "r=X,Y", "phi=X"):
        assert f"--signal {option}" in said
    flags = ("--signal", "u=K3,K4", "--signal", "p=K5,K6", "--unit", "um")
    said = printed_by(capsys, "init", tmp_path / "m", tmp_path / "own", *flags).err
    assert "  K1    not used  no known name of a signal" in said
    assert "no controller: --signal r=X,Y" in said
    assert "no run-up is cut away: --signal phi=X" in said
    assert gbid("init", tmp_path / "m", tmp_path / "wrong", *flags, "--signal", "r=K1,K9") == 2
    assert "no file has the channels K1, K9" in capsys.readouterr().err


def test_a_signal_without_its_second_axis_is_asked_for(tmp_path, capsys):
    write(tmp_path / "m" / "6bar_4200rpm.csv", True, 4200.0, "Zeit;Soll_x;Soll_q;u_x;u_y;p_x;p_y;phi")
    said = printed_by(capsys, "init", tmp_path / "m", tmp_path / "own", "--unit", "um").err
    assert "  Soll_x  not used  r by 'soll', axis x" in said
    assert "no controller: --signal r=X,Y" in said
    assert "phi=X" not in said


def test_files_of_two_kinds_take_two_sets_of_names(tmp_path):
    folder = tmp_path / "m"
    write(folder / "6bar_4200Umin_a.csv", True, 4200.0, "Zeit;K1;K2;K3;K4;K5;K6;K7")
    write(folder / "7bar_4200Umin_bc.csv", True, 4200.0, "Zeit;M1;M2;M3;M4;M5;M6;M7")
    flags = [f"{s}={','.join(c + n for n in on)}" for c in "KM" for s, on in (("u", "34"), ("p", "56"), ("r", "12"))]
    options = [word for flag in (*flags, "phi=K7", "phi=M7") for word in ("--signal", flag)]
    assert gbid("init", folder, tmp_path / "own", *options, "--unit", "um") == 0
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    for columns in ('"K1", "K2"', '"M1", "M2"', '"K7"', '"M7"'):
        assert columns in text


@pytest.mark.parametrize("overload", ["9999", "1e37", "100"])
def test_one_overload_decides_neither_check_nor_harmonics(tmp_path, capsys, overload):
    names = "t [s];r_x [um];r_y [um];u_x [um];u_y [um];p_x [um];p_y [um];phi [deg]"
    for word, moving in (("ruhe", False), ("rauschen", True)):
        path = tmp_path / "m" / f"6bar_4000rpm_{word}.csv"
        write(path, moving, names=names)
        lines = path.read_text(encoding="cp1252").splitlines()
        cells = lines[496].split(";")
        cells[5] = overload
        lines[496] = ";".join(cells)
        path.write_text("\n".join(lines), encoding="cp1252")
    said = printed_by(capsys, "init", tmp_path / "m", tmp_path / "own").err
    assert "1 overload of p_x replaced" in said
    assert "harmonics: 3" in (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    assert gbid("check", tmp_path / "own" / "experiment.yaml") == 0
    assert gbid("import", tmp_path / "own" / "experiment.yaml", "--engine", "serial") == 0
    rec = load_recording(next((tmp_path / "own").rglob("*rauschen.h5")))
    assert "1 overload of p_x replaced" in rec.provenance["import_remarks"]
    assert np.abs(rec.signal("p")).max() < 10e-6


def test_the_magnetic_bearing_of_the_template_is_identified(tmp_path):
    experiment = tmp_path / "held" / "experiment.yaml"
    assert gbid("new", experiment.parent, "--template", "magnetic-bearing") == 0
    assert gbid("import", experiment, "--engine", "serial") == 0
    assert gbid("fit", experiment, "--engine", "serial") == 0
    for path in (f"{fit}/{run}.h5" for fit in ("bearing", "position_loop") for run in ("run1", "run2")):
        fit = load(experiment.parent / "results" / "magnetic_bearing" / "fits" / path)
        for name, true in (("k_s", 4e4), ("k_i", 60.0)):
            assert abs(fit.parameters[name] - true) < 4 * fit.std[name] < 0.1 * true
    assert gbid("report", experiment) == 0
    page = (experiment.parent / "results" / "magnetic_bearing" / "report.html").read_text(encoding="utf-8")
    assert "rms about the mean of each channel" in page
    assert "correlation x, y" not in page  # of one axis
