"""A fit to frequency responses alone from the YAML, by every verb; the files are written by numpy and pyuff."""

import numpy as np
import pytest
from experiment_files import gbid, json_of, printed_by
from scipy import signal

from gbid.core.hdf5 import read_made_with
from gbid.identify import load_fit

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
    result = load_fit(path.parent / "results" / "fits" / "spring" / "responses.h5")
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
