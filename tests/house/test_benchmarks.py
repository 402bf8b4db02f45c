"""The benchmarks run, their methods agree, and their table says what was measured. No time is judged here."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compilers import no_compiler
from places import DOCS

import gbid
from tests.benchmarks import campaign_speed, fit_speed, nonlinear_speed, scaling, worker
from tests.benchmarks.baselines import N_UNKNOWNS, SAMPLE_TIME, STRUCTURE, Samples, sampled

STORED = DOCS / "benchmarks.json"


@pytest.mark.whole
@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler to measure")
def test_quick_run(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    in_a_process = fit_speed._ask

    def ask(request: dict[str, Any], **variables: str) -> dict[str, Any]:
        """Only the last request starts a process, which loads the libraries; the slow method starts near the end."""
        if variables:
            return in_a_process(request, **variables)
        samples, start = Samples.load(Path(request["samples"])), request["start"]
        if request["method"] == "scipy":
            result = gbid.fit(STRUCTURE, samples.recording(), criterion="trace").parameters
            start = {name: 1.01 * result[name] for name in start}
        with no_compiler() if request["method"] == "numpy" else nullcontext():
            return worker.run(request["method"], samples, request["repeats"], start)

    monkeypatch.setattr(fit_speed, "_ask", ask)
    assert fit_speed.main(["--quick", "--output", str(tmp_path / "run.json")]) == 0
    printed = capsys.readouterr().out
    run = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert printed.strip() == fit_speed.whole(run)
    assert [fit["method"] for fit in run["fits"]] == list(fit_speed.NAMES)
    losses = [fit["loss"] for fit in run["fits"]]
    np.testing.assert_allclose(losses, losses[0], rtol=1e-6)
    assert all(fit["success"] and fit["time_s"] > 0 and fit["memory_bytes"] >= 0 for fit in run["fits"])
    assert run["n_unknowns"] == N_UNKNOWNS == 24


@pytest.mark.whole
def test_campaign_of_a_few_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored = tmp_path / "speed.json"
    other = {"fits": 5000}
    stored.write_text(json.dumps([other, {"fits": 12}]))
    assert campaign_speed.main(["--fits", "12", "--engines", "serial", "--json", "--output", str(stored)]) == 0
    run = json.loads(capsys.readouterr().out)
    assert json.loads(stored.read_text()) == [run, other]
    assert "| 12 fits of 1000 samples | serial |" in campaign_speed.campaign_table(run)
    (row,) = run["engines"]
    assert (row["engine"], row["fits"]) == ("serial", 12)
    assert row["cpu_per_fit_ms"] > 0
    assert row["runner_mb"] > 0


def test_sampling_of_an_integrator() -> None:
    F, G = sampled(np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1)))
    np.testing.assert_allclose(F, [[1.0]])
    np.testing.assert_allclose(G, SAMPLE_TIME * np.array([[0.5, 0.5, 1.0]]))


def test_stored_run_is_whole_and_names_no_machine() -> None:
    text = STORED.read_text(encoding="utf-8")
    run = json.loads(text)
    assert set(fit_speed.figures(run)) == set(fit_speed.TARGETS)
    assert not re.search(r"/(home|root|tmp|work|Users)\b|hostname", text)
    gbid_loss = {fit["n_samples"]: fit["loss"] for fit in run["fits"] if fit["method"] == "compiled"}
    assert all(abs(fit["loss"] / gbid_loss[fit["n_samples"]] - 1) < 1e-6 for fit in run["fits"])


@pytest.mark.whole
def test_growth_with_size_has_all_sizes_and_the_exponents_of_its_times(monkeypatch: pytest.MonkeyPatch) -> None:
    run = json.loads((DOCS / "scaling.json").read_text(encoding="utf-8"))
    assert {name: tuple(map(int, times)) for name, times in run["times_s"].items()} == scaling.SIZES
    assert run["passes"]["fit_s"] > run["passes"]["passes_s"] > 0
    assert scaling.exponent({"10": 3.0, "100": 1.0, "1000": 100.0}) == pytest.approx(2.0)
    monkeypatch.setattr(
        scaling, "SIZES", {"recordings": (1, 2, 4), "states": (2, 4, 6), "report": (4, 5), "poll": (4, 5)}
    )
    monkeypatch.setattr(scaling, "_VERBS", {"report": ("report",)})
    monkeypatch.setattr(scaling, "_AT", 1000)
    quick = scaling.measure(quick=True)
    assert {name: list(times) for name, times in quick["times_s"].items()} == {
        "recordings": ["1", "2"],
        "states": ["2", "4"],
        "report": ["4", "5"],
        "poll": ["4", "5"],
    }
    assert "| exponent |" in scaling.scaling_table(quick)


def test_ratios_of_the_film() -> None:
    """Each comparison counts the same kind of time on both sides, and only for the same estimates."""

    def stage(build: float, solve: float) -> dict[str, Any]:
        return {"build_cpu_s": build, "solve_cpu_s": solve, "status": "ok", "iterations": 1, "mean_square": 2.0}

    stages = {"film": stage(4, 6), "linear_before": stage(2, 3), "film_after": stage(4, 7)}
    run = json.loads(nonlinear_speed.STORED.read_text())
    assert nonlinear_speed.agrees(run)
    run["film"] |= {"cpu_s": 0.1, "linear_cpu_s": 0.06, "mean_square": 2.0}
    run["mapaccum"] = stages | {"linear_off_std": 0.001}
    assert nonlinear_speed.agrees(run)
    ratios = re.findall(r"(\d+) times \|", nonlinear_speed.table(run))
    assert ratios == ["100", "100", "63"]  # 10 / 0.1, 16 / 0.16, 10.06 / 0.16
    stages["film_after"]["mean_square"] = 2.01
    assert not nonlinear_speed.agrees(run)
