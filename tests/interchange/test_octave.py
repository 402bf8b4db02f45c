"""The lines of MATLAB in docs/export.md, run in Octave on files of gbid: the responses are those of the models."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from places import ROOT
from scipy.io import loadmat

import gbid

OCTAVE = shutil.which("octave-cli")
(LINES,) = re.findall(r"```matlab\n(.*?)```", (ROOT / "docs" / "export.md").read_text(encoding="utf-8"), re.DOTALL)
FREQUENCIES = np.array([10.0, 127.0, 400.0])
NAMES = {"input_names": ("u_x", "u_y"), "output_names": ("p_x", "p_y")}


def run_octave(folder, *lines):
    command = [OCTAVE, "--no-window-system", "--norc", "--quiet", "--eval", "\n".join(lines)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module", autouse=True)
def octave(tmp_path_factory):
    if OCTAVE is None:
        pytest.skip("Octave is not installed: apt install octave octave-control")
    if run_octave(tmp_path_factory.mktemp("octave"), "pkg load control").returncode:
        pytest.skip("Octave has no package control: apt install octave-control")


def models():
    plant = gbid.load_model("theisen2016").at(6.0, 0.0)
    bearing = plant.A[:4, :4], plant.B[2:4], plant.C[:, :4]
    A, B = bearing[0], np.array([[0.0, 0.0], [0.0, 0.0], [-1.6e5, -1.4e3], [-5.5e3, -2.0e5]])
    delays = {"B_delayed": B, "delay": np.array([1.0e-4, 1.2e-4])}
    observer = 1e-3 * np.arange(8.0).reshape(4, 2)
    yield "pade", plant
    yield "delays", gbid.LinearModel(A, 0 * B, bearing[2], plant.D, **NAMES, **delays)
    sampled = gbid.LinearModel(A, B, bearing[2], plant.D, **NAMES).discretise(2e-4)
    yield "sampled", gbid.LinearModel(sampled.A, sampled.B, sampled.C, sampled.D, observer, dt=2e-4, **NAMES)


@pytest.mark.parametrize("model", [pytest.param(model, id=name) for name, model in models()])
def test_models_in_octave_have_the_response_of_gbid(model, tmp_path):
    (tmp_path / "exported").mkdir()
    gbid.save_mat(model, tmp_path / "exported" / "bearing.mat")
    response = f"H = freqresp(sys, 2 * pi * {FREQUENCIES.tolist()});"
    done = run_octave(
        tmp_path, LINES, response, "if exist('innovations'), K = innovations.B; else, K = []; end", "save -v7 H.mat H K"
    )
    assert (tmp_path / "H.mat").is_file(), done.stderr
    told = loadmat(tmp_path / "H.mat")
    expected = model.frequency_response(FREQUENCIES)
    np.testing.assert_allclose(np.moveaxis(told["H"], -1, 0), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    for frequency, _ in model.modes()[:2]:
        assert f"{2 * np.pi * frequency:.2e}" in done.stdout
    assert told["K"].shape == ((0, 0) if model.K is None else (4, 4))
