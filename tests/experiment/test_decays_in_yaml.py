"""Free decays in an experiment: `inputs: []`, or an input that is zero throughout."""

import numpy as np
import pytest
from experiment_files import gbid, printed_by

from gbid import load

STRUCTURE = """\
from gbid import LinearStructure, Parameter


def matrices(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}


own = [Parameter("k", 3500.0), Parameter("d", 1.0), Parameter("b", 1.0)]
structure = LinearStructure("spring", own, matrices, "force")
"""
YAML = """\
format: 1
name: decays
results: results
import:
  data_folder: data
  recordings:
    - {{name: one, file: one.csv, sample_time_s: 1.0e-3, signals: {{{signals}}}}}
    - {{name: two, file: two.csv, sample_time_s: 1.0e-3, signals: {{{signals}}}}}
fits:
  spring:
    structure: structure.py:structure
    recordings: [one, two]
    focus: simulation
    together: true
    {options}
crossval:
  spring: {{on: [one, two]}}
"""
OUTPUT = "y: {columns: y, unit: m}"
INPUT = "force: {columns: u, unit: N}"
GIVEN = {
    "no input": (OUTPUT, "inputs: []\n    fixed: {b: 1.0}"),
    "input of zero": (f"{OUTPUT}, {INPUT}", "fixed: {b: 1.0}"),
}


def write(folder, signals, options):
    (folder / "data").mkdir()
    rng = np.random.default_rng(0)
    t = 1e-3 * np.arange(1500)
    for name, phase in (("one", 0.0), ("two", 1.0)):
        y = np.exp(-1.5 * t) * np.cos(np.sqrt(4000 - 1.5**2) * t + phase) + 0.01 * rng.standard_normal(len(t))
        columns = np.column_stack([y, np.zeros_like(t)])
        np.savetxt(folder / "data" / f"{name}.csv", columns, delimiter=",", header="y,u", comments="")
    (folder / "structure.py").write_text(STRUCTURE)
    (folder / "own.yaml").write_text(YAML.format(signals=signals, options=options))
    return folder / "own.yaml"


@pytest.mark.parametrize("how", GIVEN)
def test_decays_are_fitted_from_the_yaml(tmp_path, how):
    path = write(tmp_path, *GIVEN[how])
    fitted(path, k=4000.0, d=3.0)
    assert gbid("crossval", path) == 0


def fitted(path, **true):
    """The fit to both decays, whose parameters are the true ones."""
    assert gbid("import", path) == gbid("fit", path) == 0
    result = load(path.parent / "results" / "fits" / "spring" / "together.h5")
    assert result.success
    for name, value in true.items():
        assert abs(result.parameters[name] - value) < 4 * result.std[name]
    return result


def test_initial_states_of_the_structure_and_of_the_data(tmp_path):
    states = "initial_state: {one: structure, two: [0.5403, estimated]}\n    inputs: []"
    path = write(tmp_path, OUTPUT, states)
    released = STRUCTURE.replace('"B": [[0], [p.b]]', '"x0": [p.a, -p.d / 2 * p.a]').replace('"b", 1.0', '"a", 0.5')
    (tmp_path / "structure.py").write_text(released.replace('"force")', '(), "y")'))
    result = fitted(path, k=4000.0, d=3.0, a=1.0)
    assert result.initial_states[0, 0] == pytest.approx(result.parameters["a"])
    assert result.initial_states[1, 0] == pytest.approx(0.5403)
    assert result.initial_states[1, 1] == pytest.approx(-np.sqrt(4000) * np.sin(1), rel=0.02)


def test_a_gain_without_input_is_named(tmp_path, capsys):
    path = write(tmp_path, OUTPUT, "inputs: []")
    assert gbid("import", path) == 0
    assert "do not determine b" in "".join(printed_by(capsys, "fit", path, code=3))


def test_frequency_responses_are_fitted_with_the_decays(tmp_path, capsys):
    path = write(tmp_path, GIVEN["input of zero"][0], "responses: [frf.csv]")
    f = np.linspace(2, 30, 40)
    s = 2j * np.pi * f
    rows = [f"{hz},{g.real},{g.imag},1e-6" for hz, g in zip(f, 7.0 / (s**2 + 3.0 * s + 4000.0), strict=True)]
    (tmp_path / "frf.csv").write_text("\n".join(["frequency_hz,real,imaginary,std", *rows]))
    assert gbid("run", str(path)) == 0
    result = load(tmp_path / "results/fits/spring/together.h5")
    for name, value in (("d", 3.0), ("b", 7.0)):  # the decays alone do not determine b
        assert abs(result.parameters[name] - value) < 5 * result.std[name]
    assert result.std["d"] < 0.01
    (tmp_path / "frf.csv").write_text("frequency_hz\n1\n")
    assert "magnitude_std, std or coherence" in printed_by(capsys, "check", str(path), code=2).err
