"""The figures of the paper by name, in the modules that are shipped beside its experiment."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gbid.report.named import paper


@pytest.mark.parametrize(
    "module",
    [f"theisen2016_{word}" for word in ("checks", "comparison", "figures", "impacts", "paper")],
)
def test_a_new_worker_finds_each_module_beside_the_experiment(module, tmp_path):
    """A worker that is spawned has loaded none of them; their functions get the job and the file."""
    task = f"from gbid.report.named import write_shipped; write_shipped(1, 2, module={module!r}, function='__name__')"
    run = subprocess.run([sys.executable, "-c", task], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "'str' object is not callable" in run.stderr  # loaded, and its name is no function


def test_each_figure_of_the_paper_has_a_name():
    names = list(paper().FIGURES)
    assert names == sorted(names)
    numbers = {name[3:5] for name in names if name.startswith("fig") and name[3:5].isdigit()}
    assert numbers == {f"{n:02d}" for n in range(3, 28)}
    assert {"figA28_piezo_hysteresis", "figA29_piezo_staircase", "designs_pareto"} < set(names)
