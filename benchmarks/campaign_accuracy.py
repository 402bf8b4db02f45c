"""How accurate the surfaces of a whole campaign are, and what cross-validation the scatter of the rig leaves.

``python -m benchmarks.campaign_accuracy`` runs parts of experiments/theisen2016.yaml and stores their figures in
docs/campaign-accuracy.json. Surfaces: all recordings of the campaign with linear actuators, fitted from the references
with exact delays and as in the paper, beside the surfaces of the rig. Cross-validation: the recordings of five
operating points as they are, for several shares of the paper's scatter.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

import gbid
from benchmarks.film_study import own_machines, shown, surfaces
from benchmarks.running import about, markdown, options_of, run_study
from gbid.report.named import comparison
from gbid.structure import KEY_PARAMETERS

ROOT = Path(__file__).parents[1]
SHARES = (0.35, 0.5, 1.0)
FIVE = ((3.0, 0), (4.0, 4000), (5.0, 6000), (6.0, 0), (7.0, 6000))
FITS: dict[str, dict[str, Any]] = {
    "joint": {"structure": "plant", "options": {"disturbance_gain": "none"}, "trend": "offset"},
    "paper": {"structure": "rotor_bearing", "options": {"pade_order": 1}, "criterion": "trace"},
}


def ran(folder: Path, sections: Mapping[str, Any], verbs: Sequence[str], workers: int) -> Path:
    """Write an experiment, run some verbs of the command line, and return the folder of its results."""
    folder.mkdir(parents=True)
    path = folder / "campaign.yaml"
    path.write_text(json.dumps(sections), encoding="utf-8")  # which is YAML
    for verb in verbs:
        words = [Path(sys.executable).with_name("gbid"), verb, path, "--workers", str(workers)]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    return folder / "results" / str(sections["name"])


def study(folder: Path, workers: int) -> dict[str, Any]:
    """Run the experiments and return the figures."""
    complete = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")
    rig = {key: value for key, value in complete["rig"].items() if "staircase" not in key}
    kept = {key: complete[key] for key in ("format", "name", "prefilter")}
    run: dict[str, Any] = {**about(), "share": rig["scatter"]["share"], "surfaces": {}, "converged": {}, "crossval": []}

    linear = {key: value for key, value in rig.items() if key != "actuators"}
    results = ran(folder / "surfaces", {**kept, "rig": linear, "fits": FITS}, ["batch"], workers)
    for kind in FITS:
        fits = {file.stem: gbid.load_fit(file) for file in sorted((results / "fits" / kind).glob("*.h5"))}
        recordings = [gbid.load_recording(results / "recordings" / f"{name}.h5") for name in fits]
        points = [(r.conditions["pressure_bar"], r.conditions["speed_rpm"]) for r in recordings]
        run["surfaces"][kind] = surfaces(list(fits.values()), points, own_machines(recordings))["of_rig"]
        run["converged"][kind] = [sum(fit.success for fit in fits.values()), len(fits)]

    five = [q for q in rig["operating_points"] if (q["pressure_bar"], q["speed_rpm"]) in FIVE]
    for share in SHARES:
        scattering = {**rig, "operating_points": five, "scatter": {"share": share}}
        scored = {"fits": {"bearing": FITS["paper"]}, "crossval": {"bearing": {"on": "cyclic"}}}
        sections = {**kept, "rig": scattering, **scored}
        results = ran(folder / f"share {share}", sections, ["batch", "crossval"], workers)
        summary = gbid.load(results / "crossval" / "bearing_summary.h5")
        scores = {"mean": summary.mean.tolist(), "std": summary.std.tolist(), "n": summary.n_recordings}
        run["crossval"].append({"share": share, **scores})
    return run


def surface_table(run: Mapping[str, Any], film: Mapping[str, Any]) -> str:
    """Return share within three standard deviations and rms error of each surface, beside those with a film."""
    columns = (run["surfaces"]["joint"], run["surfaces"]["paper"], film["linear"]["surfaces"]["of_rig"])
    rows = [[key, *(shown(column[key]) for column in columns)] for key in KEY_PARAMETERS]
    return markdown(("", "joint fits from r", "fits from u as in the paper", "fits from u, a film that stiffens"), rows)


def crossval_table(run: Mapping[str, Any]) -> str:
    """Return mean and standard deviation of the cross-validation for each share of the scatter, and the paper's."""
    rows = [[row["share"], *_both(row["mean"], row["std"])] for row in run["crossval"]]
    of = {number.id: number.value for number in comparison().paper_numbers()}
    mean, std = ([of[f"bearing_{what}_{axis}"] for axis in "xy"] for what in ("mean", "std"))
    rows.append(["paper", *_both(mean, std)])
    return markdown(("share", "fit in x [%]", "fit in y [%]"), rows)


def _both(mean: Sequence[float], std: Sequence[float]) -> list[str]:
    return [f"{m:.1f} ± {s:.1f}" for m, s in zip(mean, std, strict=True)]


def main() -> int:
    """Run, store and print."""
    options = options_of(__doc__, output="campaign-accuracy.json", workers=(1, "processes"))
    with tempfile.TemporaryDirectory() as scratch:
        return run_study(lambda: study(Path(scratch), options.workers), options.output, crossval_table)


if __name__ == "__main__":
    sys.exit(main())
