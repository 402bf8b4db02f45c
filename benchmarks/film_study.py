"""What the film structure gains on the campaign of the paper: surfaces beside the rig's truth, and cross-validation.

``python -m benchmarks.film_study`` runs rig, prefilter and fits of experiments/theisen2016.yaml with a second fit,
whose film stiffens, and stores the figures in docs/film.json. Everything else of the two fits is the same. Each model
of the first recording of an operating point is tried on two seconds of the second one.
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
from gbid.arrays import FloatArray
from gbid.rig import FilmStiffening, Unbalance
from gbid.structure import KEY_PARAMETERS

ROOT = Path(__file__).parents[1]
STORED = ROOT / "docs" / "film.json"
FITS = {"linear": {}, "film": {"options": {"film": "stiffening"}}}
_HELD_OUT = 10_000  # samples of a cross-validation
_GRID = 1000  # random points of the domain
_ENOUGH = 0.95  # share of them within three standard deviations
_STEMS = ("pressure_bar", "speed_rpm")


def experiment(folder: Path) -> Path:
    """Write the experiment of the study: rig, prefilter and the two fits."""
    sections = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")
    kept = {key: sections[key] for key in ("format", "name", "rig", "prefilter")}
    kept["rig"] = {key: value for key, value in kept["rig"].items() if "staircase" not in key}
    kept["fits"] = {name: {**sections["fits"]["bearing"], **options} for name, options in FITS.items()}
    path = folder / "film_study.yaml"
    path.write_text(json.dumps(kept), encoding="utf-8")  # which is YAML
    return path


def made(folder: Path, workers: int) -> Path:
    """Make recordings and fits, and return the folder of the results; what is there already is kept."""
    path = experiment(folder)
    gbid_verb = Path(sys.executable).with_name("gbid")
    subprocess.run([gbid_verb, "batch", path, "--workers", str(workers)], check=True, stdout=subprocess.DEVNULL)
    return folder / "results" / "theisen2016"


def about_the_orbit(
    true: Mapping[str, Any], speed_rpm: FloatArray, inverse_square_length: float
) -> dict[str, FloatArray]:
    """Return the true parameters with the stiffness of small motions about the orbit of the unbalance.

    The prefilter subtracts the orbit together with the run-out: both turn with the shaft. About a steady orbit the film
    is stiffer, by the mean of its derivative over a turn.
    """
    unbalance, moved = Unbalance(), {key: np.array(value) for key, value in true.items()}
    for i, speed in enumerate(speed_rpm * (np.pi / 30)):
        K, D = (np.array([[true[f"{a}_{b}{c}"][i] for c in "xy"] for b in "xy"]) for a in "kd")
        force = unbalance.eccentricity * speed**2 * np.array([1.0, -1j])
        orbit = np.linalg.solve(-(speed**2) * np.eye(2) - 1j * speed * D - K, force)
        product = np.real(np.outer(orbit, orbit.conj())) / 2
        stiff = K + inverse_square_length * (K * np.trace(product) + 2 * K @ product)
        for row, b in enumerate("xy"):
            for column, c in enumerate("xy"):
                moved[f"k_{b}{c}"][i] = stiff[row, column]
    return moved


def surfaces(fits: Sequence[gbid.FitResult], points: Sequence[tuple[float, float]], film: float) -> dict[str, Any]:
    """Return for each key parameter the share of points within three standard deviations, and the rms error."""
    truth, lpv = gbid.load_model("theisen2016"), gbid.fit_lpv(fits, points)
    rng = np.random.default_rng(0)
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    P, Omega = (rng.uniform(a, b, _GRID) for a, b in zip(low, high, strict=True))
    std = np.sqrt(np.einsum("nii->ni", lpv.uncertainty_at(P, Omega)))
    found, true = (model.key_parameters(P, Omega) for model in (lpv.model, truth))
    rows: dict[str, Any] = {}
    for what, values in (("at_rest", true), ("about_orbit", about_the_orbit(true, Omega, film))):
        for i, key in enumerate(KEY_PARAMETERS):
            error = found[key] - values[key]
            rows.setdefault(what, {})[key] = {
                "within": float(np.mean(np.abs(error) < 3 * std[:, i])),
                "relative_error": float(np.sqrt(np.mean(error**2)) / np.mean(np.abs(values[key]))),
            }
    return rows


def stiffening(fits: Sequence[gbid.FitResult], points: Sequence[tuple[float, float]], true: float) -> dict[str, Any]:
    """Return the mean stiffening over the fits at each point, its standard deviation, and that of the surface."""
    found: dict[tuple[float, float], list[float]] = {}
    for fit, point in zip(fits, points, strict=True):
        found.setdefault(point, []).append(fit.parameters["stiffening"])
    structure = gbid.RotorBearing(film="stiffening")
    surface = gbid.fit_lpv(
        fits, points, structure=structure, scheduling=_STEMS, parameters=("stiffening",), order=0, name="film"
    )
    return {
        "true": true,
        "surface": float(surface.model.parameters_at(*points[0])["stiffening"]),
        "surface_std": float(np.sqrt(surface.covariance[0, 0])),
        "at_points": [[*point, float(np.mean(values)), len(values)] for point, values in sorted(found.items())],
    }


def across(fits: Mapping[str, gbid.FitResult], recordings: Mapping[str, gbid.Recording]) -> list[list[float]]:
    """Return the fit percent of the first model of each operating point on the second recording, (n, 2)."""
    places = sorted({name.rpartition("_")[0] for name in fits})
    pairs = [(f"{place}_prbs1", f"{place}_prbs2") for place in places]
    return [gbid.cross_validate(fits[a], recordings[b][:_HELD_OUT]).fit_percent.ravel().tolist() for a, b in pairs]


def study(results: Path) -> dict[str, Any]:
    """Return the figures of the recordings that have both fits."""
    names = sorted(
        {file.stem for file in (results / "fits" / "film").glob("*.h5")}
        & {file.stem for file in (results / "fits" / "linear").glob("*.h5")}
    )
    there = {file.stem: file for file in (results / "prefiltered").glob("*_prbs*.h5")}
    recordings = {name: gbid.load_recording(there[name]) for name in there if name in names or name.endswith("prbs2")}
    at = [tuple(recordings[name].conditions[key] for key in _STEMS) for name in names]
    film = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")["rig"]["stiffening"]
    true = FilmStiffening(film["deviation_m"]).inverse_square_length
    run: dict[str, Any] = {"recordings": len(names)}
    for kind in FITS:
        fits = {name: gbid.load_fit(results / "fits" / kind / f"{name}.h5") for name in names}
        percent = np.array(across(fits, recordings))
        run[kind] = {
            "converged": sum(fit.success for fit in fits.values()),
            "iterations": float(np.median([fit.iterations for fit in fits.values()])),
            "loss": float(np.mean([fit.loss for fit in fits.values()])),
            "crossval_percent": percent.tolist(),
            "surfaces": surfaces(list(fits.values()), at, true),
        }
        if kind == "film":
            run["stiffening"] = stiffening(list(fits.values()), at, true)
    return run


COLUMNS = (("linear", "at_rest"), ("film", "at_rest"), ("linear", "about_orbit"), ("film", "about_orbit"))


def table(run: Mapping[str, Any]) -> str:
    """Return the figures of the surfaces as a Markdown table."""
    lines = [
        "| parameter | linear, truth at rest | film, truth at rest | linear, about the orbit | film, about the orbit |",
        "|---|---|---|---|---|",
    ]
    for key in KEY_PARAMETERS:
        cells = []
        for kind, truth in COLUMNS:
            row = run[kind]["surfaces"][truth][key]
            share = f"{100 * row['within']:.0f} %"
            marked = share if row["within"] >= _ENOUGH else f"**{share}**"
            cells.append(f"{marked}, {100 * row['relative_error']:.1f} %")
        lines.append(f"| {key} | {' | '.join(cells)} |")
    return "\n".join(lines)


def summary(run: Mapping[str, Any]) -> str:
    """Return the other figures in sentences."""
    linear, film = (np.array(run[kind]["crossval_percent"]) for kind in FITS)
    gain, of = film - linear, run["stiffening"]
    missed = [
        ", ".join(key for key in KEY_PARAMETERS if run[kind]["surfaces"][truth][key]["within"] < _ENOUGH) or "none"
        for kind, truth in COLUMNS
    ]
    return "\n".join(
        [
            f"- {run['recordings']} recordings at 15 operating points; fits that converged: linear "
            f"{run['linear']['converged']}, film {run['film']['converged']}.",
            f"- Below 95 %, truth at rest: linear {missed[0]}; film {missed[1]}.",
            f"- Below 95 %, truth about the orbit: linear {missed[2]}; film {missed[3]}.",
            f"- Stiffening: true {of['true'] / 1e8:.2f}, found {of['surface'] / 1e8:.2f} ± "
            f"{of['surface_std'] / 1e8:.2f} (1e8 1/m²).",
            f"- Cross-validation on another recording of the same point, {len(linear)} pairs, x and y: linear "
            f"{_both(linear)}, film {_both(film)}, a gain of {_both(gain)}; the smallest gain in a recording is "
            f"{gain.min():.2f} %, the largest {gain.max():.2f} %. Noise, which no model explains, limits both.",
        ]
    )


def _both(percent: FloatArray) -> str:
    x, y = percent.mean(axis=0)
    return f"{x:.2f} and {y:.2f} %"


def plot_study(run: Mapping[str, Any]) -> Any:
    """Return axes with the rms error of each surface for both structures."""
    import matplotlib.pyplot as plt

    _, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
    places = np.arange(len(KEY_PARAMETERS))
    for kind, side, colour in (("linear", -0.2, "tab:blue"), ("film", 0.2, "tab:orange")):
        errors = [100 * run[kind]["surfaces"]["about_orbit"][key]["relative_error"] for key in KEY_PARAMETERS]
        ax.bar(places + side, errors, width=0.4, color=colour, label=f"{kind} structure")
    ax.set_xticks(places, KEY_PARAMETERS, rotation=45)
    ax.set(yscale="log", ylabel="rms error of the surface [%]")
    ax.legend()
    return ax


def main() -> None:
    """Run, print and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="keeps recordings and fits; a temporary folder without")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--made", action="store_true", help="takes the fits that are in the folder, and makes none")
    parser.add_argument("--output", type=Path, default=STORED)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        run = study(folder / "results" / "theisen2016" if options.made else made(folder, options.workers))
    options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(table(run), summary(run), sep="\n\n")


if __name__ == "__main__":
    main()
