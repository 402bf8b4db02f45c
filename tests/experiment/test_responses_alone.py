"""A fit to frequency responses alone from the YAML, by every verb; the files are written by numpy and pyuff."""

import numpy as np
import pytest
from experiment_files import gbid, json_of, printed_by
from scipy import signal

from gbid import load
from gbid.core.hdf5 import read_made_with

STRUCTURE = """\
from gbid import LinearStructure, Parameter


def matrices(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}


own = [Parameter("k", 3.5e5), Parameter("d", 20.0), Parameter("b", 80.0)]
structure = LinearStructure("spring", own, matrices, "force", "y")
"""
YAML = """\
format: 1
name: shaker
results: results
fits:
  spring:
    structure: structure.py:structure
    responses: [{response}]
"""
TRUTH = {"k": 4e5, "d": 30.0, "b": 100.0}


def measured():
    """Response, standard deviation and coherence of 25 averages."""
    random, f = np.random.default_rng(2), np.linspace(40, 180, 150)
    _, exact = signal.freqs([TRUTH["b"]], [1, TRUTH["d"], TRUTH["k"]], 2 * np.pi * f)
    std = 0.02 * np.abs(exact) + 2e-6
    coherence = 1 / (1 + 2 * 25 * (std / np.abs(exact)) ** 2)
    return f, exact + std * (random.standard_normal(150) + 1j * random.standard_normal(150)), std, coherence


def write(folder, response="frf.csv", more="", yaml=YAML):
    f, G, std, _ = measured()
    table = np.column_stack([f, G.real, G.imag, std])
    np.savetxt(folder / "frf.csv", table, delimiter=",", header="frequency_hz,real,imaginary,std", comments="")
    (folder / "structure.py").write_text(STRUCTURE)
    (folder / "own.yaml").write_text(yaml.format(response=response) + more)
    return folder / "own.yaml"


def assert_true(path):
    result = load(path.parent / "results" / "fits" / "spring" / "responses.h5")
    assert result.success
    for name, value in TRUTH.items():
        assert abs(result.parameters[name] - value) < 4 * result.std[name] < 0.05 * value
    return result


def test_every_verb_works(tmp_path, capsys):
    path, results = write(tmp_path, more="    profile: [k]\nfigures: {spring: {}}\n"), tmp_path / "results"
    assert "0 recordings, 1 fit" in printed_by(capsys, "check", path).out
    assert "1 of 1 converged" in printed_by(capsys, "run", path).out
    assert_true(path)
    shown = printed_by(capsys, "show", results / "fits" / "spring" / "responses.h5").out
    assert "100.6" in shown  # Hz
    assert read_made_with(results / "fits" / "spring" / "responses.h5")["data"].keys() == {"frf.csv"}
    assert (results / "figures" / "spring_responses_response_1.png").stat().st_size > 10_000
    page = (results / "report.html").read_text()
    assert "frequency responses of frf" in page
    assert "Profile likelihoods: k identifiable" in page
    assert json_of(capsys, "fit", path)["fits"][0]["model"] == "responses"
    assert len(json_of(capsys, "export", path, "--to", "csv")["files"]) == 3
    (tmp_path / "frf.csv").write_text((tmp_path / "frf.csv").read_text().replace("4.000", "4.001", 1))
    assert gbid("fit", path) == 2  # made from other data; --overwrite replaces it


def test_coherence_of_an_analyser_and_a_stated_deviation_weigh_the_responses(tmp_path):
    pyuff = pytest.importorskip("pyuff", reason="pyuff is not installed: pip install 'gbid[uff]'")
    f, G, _, coherence = measured()
    common = {"type": 58, "rsp_node": 12, "rsp_dir": 3, "ref_node": 7, "ref_dir": -3, "x": f, "abscissa_spacing": 1}
    common |= {"load_case_id": 0, "orddenom_spec_data_type": 0}
    sets = [{**common, "func_type": kind, "data": data} for kind, data in ((4, G), (6, coherence))]
    pyuff.UFF(str(tmp_path / "frf.unv")).write_sets(sets, mode="overwrite")
    path = write(tmp_path, "{file: frf.unv, averages: 25}")
    assert gbid("fit", path) == 0
    by_coherence = assert_true(path)
    write(tmp_path, "{file: frf.unv, std: 2.0e-5}")
    assert gbid("fit", path, "--overwrite") == 0
    assert 0.8 < by_coherence.loss < 1.2 < assert_true(path).loss  # squares of errors in standard deviations


def test_it_is_validated_on_recordings_that_are_named(tmp_path):
    random = np.random.default_rng(0)
    u = np.repeat(random.choice([-1.0, 1.0], 200), 10)
    A, B = np.array([[0, 1], [-TRUTH["k"], -TRUTH["d"]]]), np.array([[0], [TRUTH["b"]]])
    sampled = signal.cont2discrete((A, B, np.eye(1, 2), np.zeros((1, 1))), 5e-4)
    y = signal.dlsim((*sampled[:4], 5e-4), u)[1][:, 0]
    np.savetxt(tmp_path / "run.csv", np.column_stack([u, y]), delimiter=",", header="force,y", comments="")
    mapping = "{force: {columns: force, unit: N}, y: {columns: y, unit: m}}"
    more = f"import:\n  recordings:\n    - {{name: run, file: run.csv, sample_time_s: 5.0e-4, signals: {mapping}}}\n"
    yaml = YAML.replace("    responses", "    recordings: []\n    responses")
    path = write(tmp_path, more=f"{more}crossval: {{spring: {{on: run, minimum_percent: 95}}}}\n", yaml=yaml)
    assert gbid("run", path, "--until", "crossval") == 0


BEARING = """\
format: 1
name: levitated
results: results
fits:
  spring:
    structure: magnetic_bearing
    options: {mass_kg: 2.0}
    inputs: [i]
    responses: [{file: loop.csv, reference: r}]
"""
OF_BEARING = {"k_s_z": 2e5, "k_i_z": 80.0, "omega_amplifier": 2400 * np.pi, "tau_amplifier": 4e-5}


def write_loop(folder, seed=0):
    """Responses of current and position to what an analyser injects; the noise of the sensor is in both."""
    random, s = np.random.default_rng(seed), 2j * np.pi * np.geomspace(5, 600, 150)
    k_s, k_i, omega, tau = OF_BEARING.values()
    plant, controller = k_i / (2.0 * s**2 - k_s) * np.exp(-s * tau) / (1 + s / omega), 6000 + 12 * s / (1 + s / 6000)
    sensor, amplifier = np.array([[3e-7], [4e-5]]) * (
        random.standard_normal((2, 150)) + 1j * random.standard_normal((2, 150))
    )
    sensitivity = 1 / (1 + plant * controller)
    current = sensitivity * (1 - controller * sensor) + amplifier
    position = sensitivity * (plant + sensor)
    std = {"i": np.abs(controller * sensitivity) * 3e-7 + 4e-5, "p": np.abs(sensitivity) * 3e-7}
    rows = [
        f"{output},r,{f!r},{value.real!r},{value.imag!r},{spread!r}"
        for output, values in (("i", current), ("p", position))
        for f, value, spread in zip((s.imag / 2 / np.pi).tolist(), values.tolist(), std[output].tolist(), strict=True)
    ]
    (folder / "loop.csv").write_text("\n".join(["output,input,frequency_hz,real,imaginary,std", *rows]) + "\n")
    (folder / "own.yaml").write_text(BEARING)
    return folder / "own.yaml"


def test_a_magnetic_bearing_in_its_loop_gives_its_stiffness_and_gain(tmp_path, capsys):
    path = write_loop(tmp_path)
    assert gbid("run", path) == 0
    result = load(tmp_path / "results" / "fits" / "spring" / "responses.h5")
    assert result.trusted == "robust"
    for name, value in OF_BEARING.items():
        assert abs(result.parameters[name] - value) < 3 * result.std[name]
    assert result.std["k_s_z"] < 3e-3 * OF_BEARING["k_s_z"]
    assert result.std["k_i_z"] < 3e-3 * OF_BEARING["k_i_z"]
    (tmp_path / "own.yaml").write_text(BEARING.replace("reference: r", "reference: [r, w]"))
    assert "no channel 'w'; it has r" in printed_by(capsys, "check", path, code=2).err
    (tmp_path / "own.yaml").write_text(BEARING.replace(", reference: r", ""))
    assert (
        "'i' is an output of the frequency response 'loop' to r; name the excitation of this loop (reference=...)"
        in printed_by(capsys, "check", path, code=2).err
    )


@pytest.mark.parametrize(
    ("response", "more", "words"),
    [
        ("no.csv", "", "No such file"),
        ("{file: frf.csv, averages: 0}", "", "above 0"),
        ("frf.csv", "    focus: simulation\n    window: 20\n", "fits.spring.window: window has no meaning"),
        ("frf.csv", "    outputs: [y, z]\n", "no channel 'z'"),
        ("frf.csv", "lpv: {fit: spring}\n", "one model for all its data; name a fit per recording"),
        ("frf.csv", "crossval: {spring: {on: cyclic}}\n", "no other recording for 'responses'"),
        ("frf.csv", "excite: {next: {fit: spring, limits: {peaks: {force: 1}}}}\n", "has no recordings"),
    ],
)
def test_what_does_not_fit_is_told_before_a_run(tmp_path, capsys, response, more, words):
    path = write(tmp_path, response, more)
    errors = printed_by(capsys, "check", path, code=2).err
    assert words in errors
