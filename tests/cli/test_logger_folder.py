"""From the folder of a logger to a controller in C: two answers, no file changed, no edit."""

import shutil
import subprocess

import numpy as np
import pytest
from experiment_files import gbid, printed_by
from rig_point import machine, modes
from scipy.io import savemat

from gbid.lpv import load_model
from gbid.rig import Prbs, Stationary, record

SPEED, STEP = 4200.0, 4e-4
STATED = {"Zeit": "s", "Winkelgeber": "°", "Temp_Lager": "°C", "Drehzahl": "U/min"}


def columns_of(pressure, kind, seed):
    """Columns as a logger in Germany names them, in micrometres and degrees, with overloads at a step and at rest."""
    what = Stationary(0.8) if kind == "Ruhe" else Prbs(0.9)
    point = {"pressure_bar": pressure, "speed_rpm": SPEED}
    rec = record(machine(pressure, SPEED), what, conditions=point, seed=seed, name=kind, sample_time=STEP)
    columns = {"Zeit": STEP * np.arange(rec.n_samples)}
    for signal, word in (("r", "Soll"), ("u", "Aktor"), ("p", "Spalt")):
        columns |= {f"{word}_{axis}": 1e6 * rec.signal(signal)[:, i] for i, axis in enumerate("AB")}
    columns["Winkelgeber"] = np.rad2deg(rec.signal("phi")[:, 0]) % 360
    columns["Temp_Lager"] = np.full(rec.n_samples, 31.5)
    columns["Drehzahl"] = SPEED + 2 * np.sin(columns["Zeit"])
    steps = np.flatnonzero(np.abs(np.diff(columns["Aktor_A"])) > 1)
    columns["Spalt_B"][700] = 9999.0
    columns["Aktor_A"][steps[len(steps) // 2] + 1 if steps.size else 800] = 9999.0
    return columns


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "Messungen"
    place.mkdir()
    measured = [(5.0, "Ruhe"), (5.0, "Rauschen"), (5.0, "Rauschen"), (7.0, "Ruhe"), (7.0, "Rauschen")]
    for number, (pressure, kind) in enumerate(measured):
        columns = columns_of(pressure, kind, number)
        name = f"V{number}_{pressure:g}bar_{SPEED:g}Umin_{kind}"
        if number == 4:
            savemat(place / f"{name}.mat", {"Mess": columns})
            continue
        rows = (
            ";".join(f"{value:.7g}" for value in row).replace(".", ",") for row in zip(*columns.values(), strict=True)
        )
        units = ";".join(STATED.get(name, "µm") for name in columns)
        text = "\r\n".join(["Messrechner 3", "Datum: 12.03.2024 10:22", "", ";".join(columns), units, *rows, ""])
        (place / f"{name}.csv").write_bytes(text.encode("cp1252"))
    (place / "Notizen.txt").write_text("Kanal 3 am Nachmittag getauscht\n")
    (place / "Auswertung.xlsx").write_bytes(b"PK\x03\x04")
    return place


def test_a_german_folder_becomes_a_controller_in_c_with_two_answers(folder, tmp_path, capsys):
    said = printed_by(capsys, "init", folder, tmp_path / "own", "--travel", 45, "--clearance", 25).err
    for words in (
        *("  Aktor_B      u y       'aktor', axis b", "  Mess.Spalt_A      p x       'spalt', axis a"),
        *("1 overload of u_x replaced, up to 0.009999 m", "kind that is not imported: Auswertung.xlsx, Notizen.txt"),
    ):
        assert words in said
    experiment = tmp_path / "own" / "experiment.yaml"
    assert "nothing wrong: 5 recordings, 2 fits" in printed_by(capsys, "check", experiment).out
    assert gbid("run", experiment, "--engine", "serial", "--quiet") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 25
    assert max(map(len, lines)) <= max(80, len(str(tmp_path)) + 40)
    page = (tmp_path / "own" / "results" / "own" / "report.html").read_text(encoding="utf-8")
    first = [page.index(words) for words in ("Modes: means over the models", "design feedback (P", 'id="data-title"')]
    assert max(first[:2]) < first[2]  # results before data
    surfaces = load_model(tmp_path / "own" / "results" / "own" / "lpv" / "bearing.yaml")
    for pressure in (5.0, 7.0):
        true = modes(machine(pressure, SPEED).rotor_bearing)
        np.testing.assert_allclose(np.transpose(surfaces.at(pressure, SPEED).modes()[:2]), true, rtol=0.02)
    assert gbid("export", experiment, "--to", "c", "--output", tmp_path / "c") == 0
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler: the controller is written, not compiled")
    (test,) = (tmp_path / "c").glob("*_selftest.c")
    sources = [test, test.with_name(test.name.replace("_selftest", ""))]
    subprocess.run(
        [
            compiler,
            "-std=c99",
            f"-D{sources[1].stem.upper()}_SELFTEST_MAIN",
            *sources,
            "-lm",
            "-o",
            tmp_path / "selftest",
        ],
        check=True,
    )
    subprocess.run([tmp_path / "selftest"], check=True, capture_output=True)
