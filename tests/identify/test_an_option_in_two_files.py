"""A new option of `fit` is a field of `FitOptions` and the code that uses it: tried in a copy of the package."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from places import SUPPORT

import gbid

CHANGES = {
    "identify/options.py": [
        ("    stop : {", "    loudness : float\n        Words of the first note.\n    stop : {"),
        ("    max_iterations: Count = 100\n", "    loudness: Positive = 1.0\n    max_iterations: Count = 100\n"),
    ],
    "identify/judge.py": [("(*optimum.notes, ", '(f"loudness {task.options.loudness:g}", *optimum.notes, ')],
}

SCRIPT = """
import inspect, sys
from pathlib import Path
sys.path.insert(0, {support!r})
import gbid
from gbid.core.errors import UsageError
from fit_cases import MODE, MODE_AT, levels, simulated
from gbid.experiment.load import experiment_json_schema, load_experiment
from gbid.experiment.stages.fit import fit_arguments, fit_result
from experiment_files import write_spring

assert Path(gbid.__file__).is_relative_to(Path.cwd())
assert inspect.signature(gbid.fit).parameters["loudness"].default == 1.0
assert "loudness : float\\n    Words of the first note." in gbid.fit.__doc__
recording = simulated(MODE, MODE_AT, levels(200), noise=0.3)
result = gbid.fit(MODE, recording, loudness=2.5)
assert "loudness 2.5" in result.notes
gbid.save(result, "fit.h5")
assert gbid.load("fit.h5").options.loudness == 2.5
try:
    gbid.fit(MODE, recording, loudness=-1)
except UsageError as error:
    assert str(error) == "fit: loudness = -1; give a number above 0"
assert experiment_json_schema()["$defs"]["FitSection"]["properties"]["loudness"]["exclusiveMinimum"] == 0
path = write_spring(Path.cwd())
plain, keys = path.read_text(), set()
wrong = {{"loud": "expected a number, found 'loud'", "0": "must be above 0, found 0"}}
for value in ("", "2.5", *wrong):
    path.write_text(plain.replace("focus:", f"loudness: {{value}}, focus:" if value else "focus:"))
    try:
        experiment = load_experiment(path)
    except UsageError as error:
        assert f"loudness: {{wrong[value]}}" in str(error), error
        continue
    name = next(iter(experiment.spec.fits))
    assert fit_arguments(experiment, name, ())["loudness"] == float(value or 1)
    keys.add(fit_result(experiment, name, "run1").key)
assert len(keys) == 2
"""


def test_a_new_option_touches_its_definition_and_what_uses_it(tmp_path):
    shutil.copytree(Path(gbid.__file__).parent, tmp_path / "gbid")  # with what is compiled
    for folder in ("models", "experiments"):
        (tmp_path / folder).symlink_to(Path(gbid.__file__).parents[1] / folder)
    for name, changes in CHANGES.items():
        path = tmp_path / "gbid" / name
        text = path.read_text()
        for old, new in changes:
            assert text.count(old) == 1
            text = text.replace(old, new)
        path.write_text(text)
    script = SCRIPT.format(support=str(SUPPORT))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
