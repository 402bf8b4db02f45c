"""What the film structure gains on the campaign of the paper: surfaces beside the rig's truth, and cross-validation.

``python -m benchmarks.film_study`` runs rig, prefilter and fits of experiments/theisen2016.yaml with a second fit,
whose film stiffens, and stores the figures in docs/film.json. Everything else of the two fits is the same.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

import gbid
from gbid.rig import FilmStiffening
from gbid.structure import KEY_PARAMETERS

ROOT = Path(__file__).parents[1]
STORED = ROOT / "docs" / "film.json"
FITS = {"linear": {}, "film": {"options": {"film": "stiffening"}}}
_GRID = 1000  # random points of the domain
_STEMS = ("pressure_bar", "speed_rpm")


def experiment(folder: Path, points: int | None) -> Path:
    """Write the experiment of the study: rig, prefilter and the two fits, at the first operating points or at all."""
    sections = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")
    kept = {key: sections[key] for key in ("format", "name", "rig", "prefilter")}
    kept["rig"] = {key: value for key, value in kept["rig"].items() if "staircase" not in key}
    if points is not None:
        kept["rig"]["operating_points"] = kept["rig"]["operating_points"][:points]
    kept["fits"] = {name: {**sections["fits"]["bearing"], **options} for name, options in FITS.items()}
    path = folder / "film_study.yaml"
    path.write_text(json.dumps(kept), encoding="utf-8")  # which is YAML
    return path


def made(folder: Path, points: int | None, workers: int) -> Path:
    """Make recordings and fits, and return the folder of the results; what is there already is kept."""
    path = experiment(folder, points)
    gbid_verb = Path(sys.executable).with_name("gbid")
    subprocess.run([gbid_verb, "batch", path, "--workers", str(workers)], check=True, stdout=subprocess.DEVNULL)
    return folder / "results" / "theisen2016"


def surfaces(fits: Sequence[gbid.FitResult], points: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Return for each key parameter the share of points within three standard deviations, and the rms error."""
    truth, lpv = gbid.load_model("theisen2016"), gbid.fit_lpv(fits, points)
    rng = np.random.default_rng(0)
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    P, Omega = (rng.uniform(a, b, _GRID) for a, b in zip(low, high, strict=True))
    std = np.sqrt(np.einsum("nii->ni", lpv.uncertainty_at(P, Omega)))
    found, true = (model.key_parameters(P, Omega) for model in (lpv.model, truth))
    rows = {}
    for i, key in enumerate(KEY_PARAMETERS):
        error = found[key] - true[key]
        rows[key] = {
            "within": float(np.mean(np.abs(error) < 3 * std[:, i])),
            "relative_error": float(np.sqrt(np.mean(error**2)) / np.mean(np.abs(true[key]))),
        }
    return rows


def across(fits: Mapping[str, gbid.FitResult], recordings: Mapping[str, gbid.Recording]) -> list[list[float]]:
    """Return the fit percent of each model on the next recording of its operating point, cyclic: (n, 2)."""
    places: dict[str, list[str]] = {}
    for name in fits:
        places.setdefault(name.rpartition("_")[0], []).append(name)
    pairs = [(a, b) for names in places.values() for a, b in zip(names, [*names[1:], names[0]], strict=True)]
    return [gbid.cross_validate(fits[a], recordings[b]).fit_percent.ravel().tolist() for a, b in pairs]


def study(folder: Path, points: int | None, workers: int) -> dict[str, Any]:
    """Return the figures of all fits."""
    results = made(folder, points, workers)
    names = sorted(file.stem for file in (results / "fits" / "film").glob("*.h5"))
    recordings = {name: gbid.load_recording(results / "prefiltered" / f"{name}.h5") for name in names}
    at = [tuple(recordings[name].conditions[key] for key in _STEMS) for name in names]
    film = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")["rig"]["stiffening"]
    run: dict[str, Any] = {
        "recordings": len(names),
        "true_stiffening": FilmStiffening(film["deviation_m"]).inverse_square_length,
    }
    for kind in FITS:
        fits = {name: gbid.load_fit(results / "fits" / kind / f"{name}.h5") for name in names}
        percent = np.array(across(fits, recordings))
        run[kind] = {
            "converged": sum(fit.success for fit in fits.values()),
            "white": sum(fit.trusted == "white" for fit in fits.values()),
            "wall_time_s": float(np.median([fit.wall_time_s for fit in fits.values()])),
            "iterations": float(np.median([fit.iterations for fit in fits.values()])),
            "crossval_percent": percent.mean(axis=0).tolist(),
            "crossval_std": percent.std(axis=0, ddof=1).tolist(),
        }
        if points is None or points > 6:
            run[kind]["surfaces"] = surfaces(list(fits.values()), at)
        if kind == "film":
            run["stiffening"] = [
                [*point, fit.parameters["stiffening"], fit.std["stiffening"]]
                for point, fit in zip(at, fits.values(), strict=True)
            ]
    return run


def table(run: Mapping[str, Any]) -> str:
    """Return the figures of the surfaces as a Markdown table."""
    kinds = [kind for kind in FITS if "surfaces" in run[kind]]
    lines = ["| | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for key in KEY_PARAMETERS:
        cells = []
        for kind in kinds:
            row = run[kind]["surfaces"][key]
            share = f"{100 * row['within']:.0f} %"
            cells.append(f"{share if row['within'] >= 0.95 else f'**{share}**'}, {100 * row['relative_error']:.1f} %")
        lines.append(f"| {key} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run, print and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="keeps recordings and fits; a temporary folder without")
    parser.add_argument("--points", type=int, help="only the first operating points")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--output", type=Path, default=STORED)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        run = study(options.folder or Path(scratch), options.points, options.workers)
    options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(table(run))


if __name__ == "__main__":
    main()
