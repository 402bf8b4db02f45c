"""Folders of loggers in Italy, France and the United States: raw files to an experiment, and to compiled C."""

import shutil
import subprocess

import numpy as np
import pytest
from experiment_files import gbid, printed_by
from rig_point import machine

from gbid import load
from gbid.experiment.load import load_experiment
from gbid.lpv import load_model
from gbid.rig import Prbs, Stationary, record

STEP, SPEED = 4e-4, 2000.0
SHEET = ((-40.0, -6.5), (-15.0, -2.3), (0.0, 0.0), (15.0, 2.1), (40.0, 5.4))
"""Points of a sensor's sheet: position [um] and voltage [V]."""


def measured(pressure, moving, seed, run_up_s=0.0, seconds=1.6):
    """Return columns of a file in SI units, after a run-up with noise in all positions."""
    point = {"pressure_bar": pressure, "speed_rpm": SPEED}
    what = Prbs(seconds) if moving else Stationary(seconds)
    rec = record(machine(pressure, SPEED), what, conditions=point, seed=seed, name="a", sample_time=STEP)
    n, angle = round(run_up_s / STEP), np.unwrap(rec.signal("phi")[:, 0])
    rest = run_up_s - STEP * np.arange(n)
    turned = angle[0] - 2 * np.pi * SPEED / 60 * (rest - rest**2 / (2 * max(run_up_s, STEP)))
    noise = 1e-7 * np.random.default_rng(seed).standard_normal((n, 2))
    signals = {q: np.vstack([noise * (q != "r"), rec.signal(q)]) for q in "rup"}
    return {**signals, "phi": np.mod(np.concatenate([turned, angle]), 2 * np.pi)}


def write(path, names, columns, stamp, decimal=",", delimiter=";", top=""):
    """Write a table with a stamp and six digits of each number."""
    rows = []
    for k, row in enumerate(zip(*columns, strict=True)):
        numbers = [f"{value:.7g}".replace(".", decimal) for value in row]
        rows.append(delimiter.join([stamp(k * STEP), *numbers]))
    path.write_text(top + "\n".join([delimiter.join(names), *rows, ""]), encoding="cp1252")


ITALIAN = (
    *("Data e ora", "Riferimento x [mm]", "Riferimento y [mm]", "Attuatore x [mm]", "Attuatore y [mm]"),
    *("Sonda x [V]", "Sonda y [mil]", "Encoder [gradi]"),
)


def write_italian(path, pressure, moving, seed, seconds):
    """Write a file with positions in mm, p in V by a sheet and in mil, and a run-up of one second."""
    made = measured(pressure, moving, seed, run_up_s=1.0, seconds=seconds)
    p_x, p_y = 1e6 * made["p"].T
    volts = np.interp(p_x, *zip(*SHEET, strict=True))
    positions = [1e3 * made[q][:, i] for q in "ru" for i in (0, 1)]
    columns = [*positions, volts, p_y / 25.4, np.rad2deg(made["phi"])]
    write(path, ITALIAN, columns, lambda t: f"05/03/2026 10:22:{t:09.6f}".replace(".", ","))


ROLES = ("r=Riferimento x,Riferimento y", "u=Attuatore x,Attuatore y", "p=Sonda x,Sonda y", "phi=Encoder")
SHEET_TEXT = "Sonda x=" + " ".join(f"{volts:g}:{um:g}".replace(".", ",") for um, volts in SHEET) + " um"


def write_italian_folder(place, counts, seconds):
    """Write a folder; return the names of a file with a dead sensor and of a truncated one.

    `counts` has the numbers of files at rest and with excitation by pressure. macOS has left a file, too.
    """
    place.mkdir()
    runs = [(p, moving) for p, numbers in counts.items() for moving, n in enumerate(numbers) for _ in range(n)]
    for k, (pressure, moving) in enumerate(runs):
        name = f"V{k:02d}_{pressure:.1f}bar_{SPEED:g}giri_{'rumore' if moving else 'riposo'}.csv"
        write_italian(place / name.replace(".", ",", 1), pressure, moving, k, seconds)
    dead, cut = sorted(place.glob("*5,0bar*rumore.csv"))[-1], sorted(place.glob("*rumore.csv"))[-1]
    head, *rows = dead.read_text(encoding="cp1252").splitlines()
    cells = (row.split(";") for row in rows)
    dead.write_text("\n".join([head, *(";".join([*row[:6], "9999", row[7]]) for row in cells), ""]))
    cut.write_bytes(cut.read_bytes()[:-30])
    (place / f"._{cut.name}").write_bytes(b"\0\x05\x16\x07\0\2\0\0Mac OS X")
    return dead.name, cut.name


def init_italian(folder, target, *more):
    roles = [word for text in ROLES for word in ("--signal", text)]
    return ("init", folder, target, *roles, "--calibration", SHEET_TEXT, "--travel", 45, "--clearance", 25, *more)


def test_an_italian_folder_tells_all_its_problems_at_once_and_goes_on_without_them(tmp_path, capsys):
    folder = tmp_path / "Prove"
    dead, cut = write_italian_folder(folder, {4.5: (1, 1), 5.0: (1, 3), 6.0: (0, 1)}, 0.6)
    said = printed_by(capsys, *init_italian(folder, tmp_path / "own"), code=3).err
    for words in (
        f"{dead}: column 'Sonda y' is dead: 100% of its",
        cut,
        "2 of these files can be left out: --skip-broken",
    ):
        assert words in said
    said = printed_by(capsys, *init_italian(folder, tmp_path / "own", "--skip-broken")).err
    assert said.count("note: left out: ") == 2
    assert f"of a kind that is not imported: ._{cut}" in said
    text = (tmp_path / "own" / "experiment.yaml").read_text(encoding="utf-8")
    assert "from_s: 1" in text
    assert 'kinds: {"riposo": stationary, "rumore": excited}' in text
    experiment = load_experiment(tmp_path / "own" / "experiment.yaml")
    assert len(experiment.recordings) == 5
    assert {q.conditions["speed_rpm"] for q in experiment.recordings.values()} == {SPEED}
    assert "bearing: {on: cyclic}" in text  # one recording at 4.5 bar has no partner
    assert gbid("check", tmp_path / "own" / "experiment.yaml", "--quick") == 0


@pytest.mark.slow
def test_an_italian_folder_becomes_a_controller_in_c(tmp_path):
    """17 files; one pressure has one excited recording, the others four and five that are sound."""
    own = tmp_path / "own"
    write_italian_folder(tmp_path / "Prove", {4.5: (1, 1), 5.0: (2, 5), 6.0: (2, 6)}, 1.6)
    assert gbid(*init_italian(tmp_path / "Prove", own, "--skip-broken")) == 0
    assert_becomes_a_controller_in_c(own, 10)


def assert_becomes_a_controller_in_c(own, count):
    """Run an experiment, compare the modes of its fits with the true ones, export the controller and run its test."""
    assert gbid("run", own / "experiment.yaml", "--engine", "serial", "--quiet") == 0
    experiment = load_experiment(own / "experiment.yaml")
    fits = sorted((experiment.results / "fits" / "bearing").glob("*.h5"))
    assert len(fits) == count
    for path in fits:
        fit, point = load(path), experiment.recordings[path.stem].conditions
        true = load_model("theisen2016").at(point["pressure_bar"], point["speed_rpm"]).modes()
        assert np.abs((np.array(fit.model.modes()[:2]) - true) / fit.modes_std[:2]).max() < 4
    assert gbid("export", own / "experiment.yaml", "--to", "c", "--output", own / "c") == 0
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler: the controller is written, not compiled")
    (test,) = (own / "c").glob("*_selftest.c")
    source = test.with_name(test.name.replace("_selftest", ""))
    main = f"-D{source.stem.upper()}_SELFTEST_MAIN"
    subprocess.run([compiler, "-std=c99", main, test, source, "-lm", "-o", own / "selftest"], check=True)
    subprocess.run([own / "selftest"], check=True, capture_output=True)


PSI = 0.0689475729  # bar
POINTS = [(pressure, moving) for pressure in (4.5, 5.0, 6.0) for moving in (False, True, True)]


def write_short(path, names, scale, stamp, moving, pressure, seed, seconds, **layout):
    made = measured(pressure, moving, seed, seconds=seconds)
    columns = [scale * made[q][:, i] for q in "rup" for i in (0, 1)]
    write(path, names, [*columns, np.rad2deg(made["phi"])], stamp, **layout)


def write_french(folder, moving, pressure=6.0, seed=0, seconds=0.8):
    """Write a file with `tr/min` in its name, stamps of a day, degrees in French, and a count in the header."""
    signals = (f"{word} {axis} (µm)" for word in ("Consigne", "Actionneur", "Capteur") for axis in "xy")
    name = f"Palier {pressure:.1f} bar".replace(".", ",") + f" 2000 tr-min {'bruit' if moving else 'repos'} {seed}.csv"
    top = f"Enregistreur 12\nNombre de points;{round(seconds / STEP)}\n"
    stamp = "28/11/2026 09:15:{:09.6f}".format
    names = ("Temps", *signals, "Codeur (degrés)")
    write_short(folder / name, names, 1e6, stamp, moving, pressure, seed, seconds, top=top)


def write_american(folder, moving, pressure=6.0, seed=0, seconds=0.8):
    """Write a file with psi in its name, AM/PM, the month first, and `mil pp`."""
    signals = (f"{word} {axis} (mil pp)" for word in ("Cmd", "Act", "Prox") for axis in "xy")
    psi = round(pressure / PSI)
    name = f"{psi}psi_2000rpm_{'prbs' if moving else 'still'}{seed}.csv"
    stamp = lambda t: f"11/28/2026 1:59:{59 + t:.6f} PM" if t < 1 else f"11/28/2026 2:00:{t - 1:09.6f} PM"  # noqa: E731
    layout = {"delimiter": ",", "decimal": "."}
    names = ("Time", *signals, "Encoder (deg)")
    write_short(folder / name, names, 1 / 25.4e-6, stamp, moving, psi * PSI, seed, seconds, **layout)


FRENCH_ROLES = ("r=Consigne x,Consigne y", "u=Actionneur x,Actionneur y", "p=Capteur x,Capteur y", "phi=Codeur")
FRENCH = [word for text in FRENCH_ROLES for word in ("--signal", text)]
AMERICAN = ["--unit", "mil"]


def test_a_french_folder(tmp_path, capsys):
    folder = tmp_path / "Essais"
    folder.mkdir()
    for moving in (False, True):
        write_french(folder, moving)
    assert gbid("init", folder, tmp_path / "own", *FRENCH) == 0
    experiment = load_experiment(tmp_path / "own" / "experiment.yaml")
    assert [dict(q.conditions) for q in experiment.recordings.values()] == [
        {"pressure_bar": 6.0, "speed_rpm": 2000.0}
    ] * 2
    capsys.readouterr()
    assert gbid("check", tmp_path / "own" / "experiment.yaml") == 0


def test_an_american_folder(tmp_path, capsys):
    """`mil pp` is refused, and `--unit` says what it is."""
    folder = tmp_path / "runs"
    folder.mkdir()
    for moving in (False, True):
        write_american(folder, moving)
    said = printed_by(capsys, "init", folder, tmp_path / "own", code=2).err
    assert "states 'mil pp', which is no unit" in said
    assert "--unit" in said
    assert gbid("init", folder, tmp_path / "own", *AMERICAN) == 0
    experiment = load_experiment(tmp_path / "own" / "experiment.yaml")
    for planned in experiment.recordings.values():
        assert planned.conditions == pytest.approx({"pressure_bar": 87 * PSI, "speed_rpm": 2000.0})
    capsys.readouterr()
    assert gbid("check", tmp_path / "own" / "experiment.yaml") == 0


@pytest.mark.slow
@pytest.mark.parametrize(("write_file", "flags"), [(write_french, FRENCH), (write_american, AMERICAN)])
def test_a_french_and_an_american_folder_become_controllers_in_c(write_file, flags, tmp_path):
    (tmp_path / "runs").mkdir()
    for seed, (pressure, moving) in enumerate(POINTS):
        write_file(tmp_path / "runs", moving, pressure, seed, 1.6)
    more = ("--travel", 45, "--clearance", 25)
    assert gbid("init", tmp_path / "runs", tmp_path / "own", *flags, *more) == 0
    assert_becomes_a_controller_in_c(tmp_path / "own", 6)


def test_what_is_wrong_in_an_option_is_said(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    for flags, words in (
        (("--calibration", "x=0:0 1:2"), "its points and their unit, X=0:0 10:125 um"),
        (("--calibration", "x=0:0 0:2 um"), "different numbers"),
        (("--calibration", "x=0 1:2 um"), "--calibration: 'x=0 1:2 um'"),
        (("--kind", "riposo=quiet"), "'quiet' is no kind; choose from excited"),
        (("--kind", "riposo"), "--kind: expected NAME=VALUE"),
        (("--decimal", ";"), "decimal = ';'"),
    ):
        assert words in printed_by(capsys, "init", tmp_path / "a", tmp_path / "own", *flags, code=2).err
