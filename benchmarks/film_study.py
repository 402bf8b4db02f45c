"""What the film structure gains on the campaign of the paper: surfaces beside the rig's truth, and cross-validation.

``python -m benchmarks.film_study`` makes the recordings of experiments/theisen2016.yaml with a film, fits each with the
linear structure and with that of the film, and stores the figures in docs/film.json. All else of the two fits is equal.
Delays are exact. The run-out is that of a slow roll, and the unbalance is in the fit: the paper's map takes the orbit
of the unbalance away with the run-out, and about an orbit the film is stiffer. Spikes are removed one by one, because
the paper's median reduces crests. Errors are those of the output alone.

Each model of the first recording of an operating point is tried on two seconds of the second one. The machine scatters
between recordings: ``--seeds`` are campaigns with other draws. Whether the standard deviations of surfaces hold over
many campaigns is tried by `benchmarks.surface_intervals`, without recordings.
"""

from __future__ import annotations

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
from benchmarks.running import markdown, options_of, store
from gbid.core.arrays import FloatArray
from gbid.lpv import Estimates
from gbid.rig import FilmStiffening
from gbid.structure import KEY_PARAMETERS
from gbid.structure.built_in import Film

ENOUGH = 0.95  # share of the points within three standard deviations
ROOT = Path(__file__).parents[1]
RESULTS = Path("results") / "theisen2016"
SLOW_ROLL = "p5_n200_still1"
FITS: dict[str, Film] = {"linear": "linear", "film": "stiffening"}
CAMPAIGN: dict[str, dict[str, float]] = {"stiffening": {"deviation_m": 0.3e-6}, "scatter": {"share": 0.35}}
"""What differs from the campaign of the paper."""
_HELD_OUT = 10_000  # samples of a cross-validation
_GRID = 1000  # random points of the domain
_STEMS = ("pressure_bar", "speed_rpm")


def recorded(folder: Path, seed: int, workers: int) -> None:
    """Make the recordings of the experiment, with a film and a slow roll; keep those that are there."""
    sections = YAML(typ="safe").load(ROOT / "experiments" / "theisen2016.yaml")
    kept = {key: sections[key] for key in ("format", "name", "rig")}
    kept["rig"] = {key: value for key, value in kept["rig"].items() if "staircase" not in key} | {
        "seed": seed,
        **CAMPAIGN,
    }
    slow = {"pressure_bar": 5.0, "speed_rpm": 200, "prbs_recordings": 0}
    kept["rig"]["operating_points"] = [*kept["rig"]["operating_points"], slow]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "film_study.yaml"
    path.write_text(json.dumps(kept), encoding="utf-8")  # which is YAML
    verb = [Path(sys.executable).with_name("gbid"), "rig", path, "--workers", str(workers)]
    subprocess.run(verb, check=True, stdout=subprocess.DEVNULL)


def prefiltered(results: Path) -> dict[str, gbid.Recording]:
    """Return the excited recordings without run-out, with the signal of the unbalance, by name."""
    runout = gbid.identify_runout(gbid.load_recording(results / "recordings" / f"{SLOW_ROLL}.h5"))
    by_name = {}
    for file in sorted((results / "recordings").glob("*_prbs*.h5")):
        filtered, _ = gbid.prefilter(gbid.load_recording(file), runout, any_condition=True)
        by_name[file.stem] = gbid.with_unbalance(filtered)
    return by_name


def fitted(recordings: Mapping[str, gbid.Recording], folder: Path) -> None:
    """Fit both structures to all recordings; what is there already is kept."""
    for name, recording in recordings.items():
        for kind, film in FITS.items():
            file = folder / kind / f"{name}.h5"
            if file.exists():
                continue
            turns = recording.conditions["speed_rpm"] > 0
            structure = gbid.RotorBearing(film=film, delay="exact", disturbance_gain="none", unbalance=turns)
            file.parent.mkdir(parents=True, exist_ok=True)
            gbid.save_fit(gbid.fit(structure, recording, criterion="trace"), file)


def own_machines(recordings: Sequence[gbid.Recording]) -> FloatArray:
    """Return the key parameters of the machine of each recording, (n, 14)."""
    machines = [json.loads(recording.provenance["truth"]) for recording in recordings]
    return np.array([[one[key] for key in KEY_PARAMETERS] for one in machines])


def surfaces(
    fits: Sequence[gbid.FitResult], points: Sequence[tuple[float, float]], machines: FloatArray
) -> dict[str, Any]:
    """Return for each key parameter the share of points within three standard deviations, and the rms error.

    There are two truths: the surfaces of the rig, and those through the machines that it drew for the recordings.
    """
    truth, lpv, rng = gbid.load_model("theisen2016"), gbid.fit_lpv(fits, points), np.random.default_rng(0)
    P, Omega = (rng.uniform(min(ends), max(ends), _GRID) for ends in zip(*points, strict=True))
    std = np.sqrt(np.einsum("nii->ni", lpv.uncertainty_at(P, Omega)))
    drawn = gbid.fit_lpv(Estimates(lpv.estimates.recordings, lpv.estimates.points, machines, lpv.estimates.covariance))
    computed, true, mean = (model.key_parameters(P, Omega) for model in (lpv.model, truth, drawn.model))
    rows: dict[str, Any] = {}
    for what, values in (("of_rig", true), ("of_recordings", mean)):
        for i, key in enumerate(KEY_PARAMETERS):
            error = computed[key] - values[key]
            rows.setdefault(what, {})[key] = {
                "within": float(np.mean(np.abs(error) < 3 * std[:, i])),
                "relative_error": float(np.sqrt(np.mean(error**2)) / np.mean(np.abs(values[key]))),
            }
    return rows


def stiffening(fits: Sequence[gbid.FitResult], points: Sequence[tuple[float, float]], true: float) -> dict[str, Any]:
    """Return the mean stiffening over the fits at each point, its standard deviation, and that of the surface."""
    results: dict[tuple[float, float], list[float]] = {}
    for fit, point in zip(fits, points, strict=True):
        results.setdefault(point, []).append(fit.parameters["stiffening"])
    structure = gbid.RotorBearing(film="stiffening", delay="exact", disturbance_gain="none")
    surface = gbid.fit_lpv(
        fits, points, structure=structure, scheduling=_STEMS, parameters=("stiffening",), order=0, name="film"
    )
    return {
        "true": true,
        "surface": float(surface.model.key_parameters(*points[0])["stiffening"]),
        "surface_std": float(np.sqrt(surface.covariance[0, 0])),
        "at_points": [[*point, float(np.mean(values)), len(values)] for point, values in sorted(results.items())],
    }


def across(fits: Mapping[str, gbid.FitResult], recordings: Mapping[str, gbid.Recording]) -> list[list[float]]:
    """Return the fit percent of the first model of each operating point on the second recording, (n, 2)."""
    places = sorted({name.rpartition("_")[0] for name in fits})
    pairs = [(f"{place}_prbs1", f"{place}_prbs2") for place in places]
    return [gbid.cross_validate(fits[a], recordings[b][:_HELD_OUT]).fit_percent.ravel().tolist() for a, b in pairs]


def study(results: Path) -> dict[str, Any]:
    """Fit the recordings and return the figures."""
    recordings = prefiltered(results)
    fitted(recordings, results / "fits")
    at = [tuple(recording.conditions[key] for key in _STEMS) for recording in recordings.values()]
    true = FilmStiffening(CAMPAIGN["stiffening"]["deviation_m"]).inverse_square_length
    run: dict[str, Any] = {"recordings": len(recordings)}
    machines = own_machines(list(recordings.values()))
    for kind in FITS:
        fits = {name: gbid.load_fit(results / "fits" / kind / f"{name}.h5") for name in recordings}
        percent = np.array(across(fits, recordings))
        run[kind] = {
            "converged": sum(fit.success for fit in fits.values()),
            "iterations": float(np.median([fit.iterations for fit in fits.values()])),
            "loss": float(np.mean([fit.loss for fit in fits.values()])),
            "crossval_percent": percent.tolist(),
            "surfaces": surfaces(list(fits.values()), at, machines),
        }
        values, std = (
            np.array([[numbers[key] for key in KEY_PARAMETERS] for numbers in each])
            for each in zip(*((fit.parameters, fit.std) for fit in fits.values()), strict=True)
        )
        size = np.sqrt(np.mean(((values - machines) / std) ** 2, axis=0))
        run[kind]["error_of_a_fit"] = dict(zip(KEY_PARAMETERS, size.tolist(), strict=True))
        if kind == "film":
            run["stiffening"] = stiffening(list(fits.values()), at, true)
    return run


COLUMNS = tuple((kind, truth) for truth in ("of_rig", "of_recordings") for kind in ("linear", "film"))


def table(run: Mapping[str, Any]) -> str:
    """Return the figures of the surfaces as a Markdown table."""
    lines = [[key, *(shown(run[kind]["surfaces"][truth][key]) for kind, truth in COLUMNS)] for key in KEY_PARAMETERS]
    head = ("parameter", "linear, rig", "film, rig", "linear, machines drawn", "film, machines drawn")
    return markdown(head, lines)


def summary(run: Mapping[str, Any]) -> str:
    """Return the other figures in sentences."""
    linear, film = (np.array(run[kind]["crossval_percent"]) for kind in FITS)
    gain, of = film - linear, run["stiffening"]
    missed = [_missed(run, kind, truth) for kind, truth in COLUMNS]
    others = [
        f"- The same with seed {seed} of the rig, other draws of scatter and noise: linear "
        f"{_missed(other, 'linear', 'of_rig')}; film {_missed(other, 'film', 'of_rig')}; about the machines drawn film "
        f"{_missed(other, 'film', 'of_recordings')}."
        for seed, other in run["other_campaigns"].items()
    ]
    return "\n".join(
        [
            f"- {run['recordings']} recordings at 15 operating points; fits that converged: linear "
            f"{run['linear']['converged']}, film {run['film']['converged']}.",
            f"- Below 95 %, surfaces of the rig: linear {missed[0]}; film {missed[1]}.",
            f"- Below 95 %, surfaces through the machines drawn: linear {missed[2]}; film {missed[3]}.",
            *others,
            f"- Stiffening: true {of['true'] / 1e8:.2f}, found {of['surface'] / 1e8:.2f} ± "
            f"{of['surface_std'] / 1e8:.2f} (1e8 1/m²): {100 * (of['surface'] / of['true'] - 1):+.1f} %, "
            f"{(of['surface'] - of['true']) / of['surface_std']:+.1f} standard deviations.",
            f"- Cross-validation on another recording of the same point, {len(linear)} pairs, x and y: linear "
            f"{_both(linear)}, film {_both(film)}, a gain of {_both(gain)}; the smallest gain in a recording is "
            f"{gain.min():.2f} %, the largest {gain.max():.2f} %. Noise, which no model explains, limits both.",
        ]
    )


def _missed(run: Mapping[str, Any], kind: str, truth: str) -> str:
    """Return the parameters within three standard deviations at too few points."""
    rows = run[kind]["surfaces"][truth]
    return (
        ", ".join(f"{key} ({_percent(rows[key]['within'])})" for key in KEY_PARAMETERS if rows[key]["within"] < ENOUGH)
        or "none"
    )


def shown(row: Mapping[str, float]) -> str:
    """Return the share of points within three standard deviations, bold where it is too small, and the rms error."""
    share = _percent(row["within"])
    return f"{share if row['within'] >= ENOUGH else f'**{share}**'}, {100 * row['relative_error']:.1f} %"


def _percent(share: float) -> str:
    """Return whole percents, rounded down: 94.9 % are not 95 %."""
    return f"{int(100 * share + 1e-9)} %"


def _both(percent: FloatArray) -> str:
    x, y = percent.mean(axis=0)
    return f"{x:.2f} and {y:.2f} %"


def plot_study(run: Mapping[str, Any]) -> Any:
    """Return axes with the rms error of each surface: both structures, and the film without the chance of draws."""
    import matplotlib.pyplot as plt

    _, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
    places = np.arange(len(KEY_PARAMETERS))
    bars = (
        ("linear", "of_rig", "tab:blue", "linear structure"),
        ("film", "of_rig", "tab:orange", "film structure"),
        ("film", "of_recordings", "tab:green", "film structure, about the machines drawn"),
    )
    for i, (kind, truth, colour, label) in enumerate(bars):
        errors = [100 * run[kind]["surfaces"][truth][key]["relative_error"] for key in KEY_PARAMETERS]
        ax.bar(places + 0.28 * (i - 1), errors, width=0.28, color=colour, label=label)
    ax.set_xticks(places, KEY_PARAMETERS, rotation=45)
    ax.set(yscale="log", ylabel="rms error of the surface [%]")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    return ax


def main() -> None:
    """Run, print and store."""
    options = options_of(
        __doc__,
        output="film.json",
        folder=(Path, "keeps recordings and fits; a temporary folder without"),
        workers=(1, "processes of the recordings"),
        seeds=((2016, 2017), "of the rig; the first, that of the experiment, is shown in full"),
    )
    with tempfile.TemporaryDirectory() as scratch:
        folders = [(options.folder or Path(scratch)) / str(seed) for seed in options.seeds]
        for folder, seed in zip(folders, options.seeds, strict=True):
            recorded(folder, seed, options.workers)
        run, *others = (study(folder / RESULTS) for folder in folders)
    run["other_campaigns"] = {str(seed): other for seed, other in zip(options.seeds[1:], others, strict=True)}
    store(run, options.output)
    print(table(run), summary(run), sep="\n\n")


if __name__ == "__main__":
    main()
