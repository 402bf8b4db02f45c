"""The method on a rig whose bearing is not of the fitted structure, beside the rig of the paper's polynomials.

``python -m benchmarks.independent_rig`` runs experiments/independent-rig.yaml twice: as it is, with a gas film by the
Reynolds equation, and without its key ``film``, with the polynomials of the paper. All else is the same. The figures go
to docs/independent-rig.json. The judge is the rig itself: the poles of its film, linearised numerically with all its
cells, or those of its fourteen parameters; in closed loop with the actuators of Table 2 and the controller as it runs.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from benchmarks.running import about, markdown, options_of, store
from gbid.control import close_loop, exact_plant, sample_plant
from gbid.core.arrays import FloatArray, frequencies_and_dampings, one_blas_thread
from gbid.experiment.controllers import controller_at
from gbid.experiment.load import load_experiment
from gbid.experiment.machine import rig_model, rig_run
from gbid.experiment.rig_schema import Place
from gbid.experiment.run import Job
from gbid.identify import FitResult
from gbid.report.read import Results
from gbid.rig import FilmPoint, GasFilm
from gbid.rig.film import equilibrium, linearised, rotor_modes
from gbid.structure import LinearModel, PiezoPair, evaluate

ROOT = Path(__file__).parents[1]
EXPERIMENT = ROOT / "experiments" / "independent-rig.yaml"
GRIDS = ((48, 8), (72, 12), (96, 16))
RIGS = {"film": "gas film (Reynolds)", "polynomials": "polynomials (paper)"}
_MODES = ("truth", "fit", "std", "surface")
_DRAWS = 200


def run_rig(folder: Path, film: bool) -> Results:
    """Return the results of the experiment, with or without its film; what is there already is kept."""
    sections = YAML(typ="safe").load(EXPERIMENT)
    if not film:
        del sections["rig"]["film"]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / EXPERIMENT.name
    with path.open("w", encoding="utf-8") as file:
        YAML().dump(sections, file)
    verb = [Path(sys.executable).with_name("gbid"), "run", path, "--workers", "1", "--quiet"]
    subprocess.run(verb, check=False, stdout=subprocess.DEVNULL)  # refused recordings are counted below
    return Results(Job(load_experiment(path)))


def film_plant(point: FilmPoint, actuators: Mapping[str, float]) -> LinearModel:
    """Return the plant from r to p of linear actuators and the film with all its cells, about its state of rest."""
    A, B = linearised(point)
    piezo = evaluate(PiezoPair(), actuators, ("r_x", "r_y"), ("u_x", "u_y"))
    n, m = len(A), len(piezo.A)
    complete = np.block([[piezo.A, np.zeros((m, n))], [B @ piezo.C, A]])
    inputs = np.vstack([piezo.B, B @ piezo.D])
    outputs = np.zeros((2, m + n))
    outputs[:, m : m + 2] = np.eye(2)
    return LinearModel(
        complete, inputs, outputs, np.zeros((2, 2)), input_names=("r_x", "r_y"), output_names=("p_x", "p_y")
    )


def spread_of_modes(fit: FitResult) -> tuple[FloatArray, FloatArray]:
    """Return frequency [Hz] and damping factor of the two modes of a fit and their standard deviations, (2, 2)."""
    names, random = list(fit.free), np.random.default_rng(0)

    def modes(values: Mapping[str, float]) -> FloatArray:
        K, D = (np.reshape([values[f"{a}_{pair}"] for pair in ("xx", "xy", "yx", "yy")], (2, 2)) for a in "kd")
        poles = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [K, D]]))
        rows = frequencies_and_dampings(poles[poles.imag > 0])
        return _two(rows)

    best = modes(fit.parameters)
    draws = random.multivariate_normal([fit.parameters[name] for name in names], fit.covariance, _DRAWS)
    spread = [matched(modes({**fit.parameters, **dict(zip(names, draw, strict=True))}), best) for draw in draws]
    return best, np.nanstd(spread, axis=0)


def matched(modes: FloatArray, reference: FloatArray) -> FloatArray:
    """Return two modes in the order that is nearer to the reference, by their poles: frequencies alone may cross."""

    def poles(rows: FloatArray) -> np.ndarray:
        f, zeta = rows.T
        return np.asarray(f * (-zeta + 1j * np.sqrt(np.maximum(1 - zeta**2, 0))))

    direct, swapped = (np.sum(np.abs(poles(rows) - poles(reference))) for rows in (modes, modes[::-1]))
    return modes[::-1] if swapped < direct else modes


def _two(computed: FloatArray) -> FloatArray:
    """Return two rows by rising frequency; nan where a mode does not oscillate."""
    computed = np.reshape(computed, (-1, 2))[:2]
    computed = computed[np.argsort(computed[:, 0])]
    return np.vstack([computed, np.full((2 - len(computed), 2), np.nan)])


def figures(results: Results) -> dict[str, Any]:
    """Return the figures of one rig."""
    experiment, fits, model = (
        results.experiment,
        [fit for fit in results.fits if fit.fit == "bearing"],
        results.identified,
    )
    truths, plants = {}, {}
    for fit in fits:
        planned = experiment.recordings[fit.model]
        machine, pressure, speed = rig_run(experiment, planned).machine, *planned.conditions.values()
        film = machine.film
        truths[pressure, speed] = rotor_modes(_poles(machine.rotor_bearing)) if film is None else film.modes()
        actual = rig_model(experiment)
        at = exact_plant(actual, pressure, speed) if film is None else film_plant(film, actual.actuators)
        plants[pressure, speed] = sample_plant(at, 2e-4, 2e-4)
    points = []
    for fit in fits:
        place = tuple(experiment.recordings[fit.model].conditions.values())
        truth, (modes, std) = truths[place], spread_of_modes(fit.result)
        best = matched(modes, truth)
        std = std if best is modes else std[::-1]
        surface = matched(_two(np.array(model.at(*place).modes())), truth)
        row = {"point": place, "truth": truth, "fit": best, "std": std, "surface": surface}
        points.append({**row, "status": str(fit.result.status), "fit_percent": fit.result.fit_percent[0]})
    summary = results.summary("rotor_bearing")
    designs = {}
    for name, design in results.tuned.items():
        kept = {}
        for place, plant in plants.items():
            running = controller_at(experiment, Place(pressure_bar=place[0], speed_rpm=place[1]), _loop(name)).sampled
            kept[place] = _smallest(close_loop(plant, running))
        worst = min(kept, key=lambda place: kept[place])
        designs[name] = {
            "promised": design.result.value,
            "gains": design.result.gains,
            "kept": kept[worst],
            "at": worst,
            "open": float(min(rows[:, 1].min() for rows in truths.values())),
        }
    impacts = []
    for study in results.studies.made.values():
        place = (study.conditions["pressure_bar"], study.conditions["speed_rpm"])
        judge = truths[place]
        if study.loop != "open":
            running = controller_at(experiment, Place(pressure_bar=place[0], speed_rpm=place[1]), study.loop).sampled
            judge = _slow_modes(close_loop(plants[place], running))
        impacts.append(
            {
                "point": place,
                "loop": study.loop,
                "expected": study.expected_sampled[:2],
                "ringdown": np.column_stack([study.ringdown.frequency_hz, study.ringdown.damping]),
                "std": np.column_stack([study.ringdown.frequency_std, study.ringdown.damping_std]),
                "status": str(study.ringdown.status),
                "judge": judge,
                "along_percent": [v.along_percent for v in study.validations],
            }
        )
    return _plain(
        {
            "recordings": sum(q.excited for q in experiment.recordings.values()),
            "points": points,
            "crossval": {"mean": summary.mean, "std": summary.std, "least": summary.least},
            "designs": designs,
            "impacts": impacts,
        }
    )


def _loop(design: str) -> str:
    return "closed" if design == "feedback" else design


def _poles(rotor: Any) -> np.ndarray:
    return np.asarray(np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [rotor.stiffness, rotor.damping]])))


def _logs(loop: LinearModel) -> np.ndarray:
    values = np.linalg.eigvals(loop.A)
    values = values[(np.abs(values) > np.exp(-1)) & (values.imag > 1e-9)]  # that last longer than a sample
    return np.asarray(np.log(values) / 2e-4)


def _smallest(loop: LinearModel) -> float:
    return float(frequencies_and_dampings(_logs(loop))[:, 1].min())


def _slow_modes(loop: LinearModel) -> FloatArray:
    rows = frequencies_and_dampings(_logs(loop))
    rows = rows[np.argsort(rows[:, 1])][:4]
    return np.asarray(rows[np.argsort(rows[:, 0])])


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value


def grids() -> list[dict[str, Any]]:
    """Return sag [m] and modes of the film at 6 bar and 6000 rpm for finer and finer cells."""
    rows = []
    for around, along in GRIDS:
        point = FilmPoint(GasFilm(around=around, along=along), 6.0, 200 * np.pi, 25e-6, 2.18)
        rest = equilibrium(point)[:2]
        rows.append({"around": around, "along": along, "rest": rest, "modes": point.modes()})
    return list(_plain(rows))


def table(run: Mapping[str, Any]) -> str:
    """Return what models, surfaces and designs miss on both rigs, as a Markdown table."""
    columns = [dict(rows(run, rig)) for rig in RIGS]
    return markdown(("figure", *RIGS.values()), [(name, *(column[name] for column in columns)) for name in columns[0]])


def rows(run: Mapping[str, Any], rig: str) -> list[tuple[str, str]]:
    """Return the rows of the table for one rig: name and value."""
    one = run[rig]
    points = [p for p in one["points"] if p["status"].startswith("converged")]
    truth, fit, std, surface = (np.array([p[key] for p in points], float) for key in _MODES)
    results: list[tuple[str, str]] = [
        ("recordings that gave a fit that converged", f"{len(points)} of {one['recordings']}"),
        ("models on their own recording, x and y [%]", _pair(np.mean([p["fit_percent"] for p in points], axis=0))),
        ("cross-validation, mean of x and y [%]", _pair(one["crossval"]["mean"])),
        ("cross-validation, least of x and y [%]", _pair(one["crossval"]["least"])),
    ]
    for i, (what, form) in enumerate((("frequency", "{:.2f} Hz"), ("damping factor", "{:.4f}"))):
        error, by_surface = fit[..., i] - truth[..., i], surface[..., i] - truth[..., i]
        results += [
            (f"{what} of the models against the rig, rms", form.format(np.sqrt(np.nanmean(error**2)))),
            (f"{what}, rms of error over stated std", f"{np.sqrt(np.nanmean((error / std[..., i]) ** 2)):.1f}"),
            (f"{what} of the surfaces against the rig, rms", form.format(np.sqrt(np.nanmean(by_surface**2)))),
            (f"{what} of the surfaces against the rig, largest", form.format(np.nanmax(np.abs(by_surface)))),
        ]
    results.append(("smallest damping without control", f"{truth[..., 1].min():.3f}"))
    for name, design in one["designs"].items():
        at = "{:g} bar, {:g} rpm".format(*design["at"])
        results.append((f"{name}: smallest damping promised", f"{design['promised']:.3f}"))
        results.append((f"{name}: smallest damping of the rig itself", f"{design['kept']:.3f} ({at})"))
    return results


def conclusion(run: Mapping[str, Any]) -> str:
    """Return the answer in three sentences, from the figures."""
    film, known = (dict(rows(run, rig)) for rig in RIGS)
    kept, same = (
        "; ".join(f"{name} {d['promised']:.2f}, kept {d['kept']:.2f}" for name, d in run[rig]["designs"].items())
        for rig in RIGS
    )
    rms, ratio = "frequency of the models against the rig, rms", "frequency, rms of error over stated std"
    cross, free = "cross-validation, mean of x and y [%]", "smallest damping without control"
    return (
        f"Fourteen parameters miss the frequencies of the film by {film[rms]} rms, {film[ratio]} of their stated "
        f"standard deviations, where they find those of the polynomials to {known[rms]} ({known[ratio]}): intervals "
        f"hold chance, not what the structure leaves out. The cross-validation shows it, {film[cross]} % beside "
        f"{known[cross]} %. The smallest damping that the designs promise over the "
        f"points and that the rig itself then has is on the film: {kept} ({film[free]} without control); on the "
        f"polynomials: {same} ({known[free]} without control)."
    )


def grids_table(run: Mapping[str, Any]) -> str:
    """Return position of rest and modes of the film for finer and finer cells, as a Markdown table."""
    head = ("cells around, along", "rest x, y [um]", "mode 1", "mode 2")
    lines = [
        (
            f"{g['around']} by {g['along']}",
            ", ".join(f"{1e6 * x:.2f}" for x in g["rest"]),
            *(f"{f:.1f} Hz, {z:.3f}" for f, z in g["modes"]),
        )
        for g in run["grids"]
    ]
    return markdown(head, lines, "At 6 bar and 6000 rpm.")


def impacts_table(run: Mapping[str, Any]) -> str:
    """Return damping factors expected and obtained from impacts on both rigs, as a Markdown table."""
    lines = []
    for rig, words in RIGS.items():
        for hit in run[rig]["impacts"]:
            measured, std = np.array(hit["ringdown"])[:, 1], np.array(hit["std"])[:, 1]
            lines.append(
                (
                    words,
                    "{:g} bar, {:g} rpm".format(*hit["point"]),
                    hit["loop"],
                    "; ".join(f"{f:.1f} Hz, {z:.3f}" for f, z in hit["expected"]),
                    "; ".join(f"{f:.1f} Hz, {z:.3f} ± {s:.3f}" for (f, z), s in zip(hit["ringdown"], std, strict=True))
                    if np.isfinite(measured).all() and hit["status"].startswith("converged")
                    else hit["status"],
                    "; ".join(f"{f:.1f} Hz, {z:.3f}" for f, z in hit["judge"]),
                    " / ".join(f"{v:.0f}" for v in hit["along_percent"]),
                )
            )
    head = (
        "rig",
        "point",
        "loop",
        "expected from the surfaces",
        "ring-down",
        "the rig itself",
        "response explained, x / y [%]",
    )
    return markdown(head, lines)


def _pair(values: Any) -> str:
    return ", ".join(f"{value:.1f}" for value in values)


def main() -> None:
    """Run both rigs, print and store."""
    options = options_of(
        __doc__, output="independent-rig.json", folder=(Path, "keeps the results; else a temporary one")
    )
    with tempfile.TemporaryDirectory() as scratch, one_blas_thread():
        folder = options.folder or Path(scratch)
        run = {**about(), "grids": grids()}
        for rig in RIGS:
            run[rig] = figures(run_rig(folder / rig, rig == "film"))
    store(run, options.output)
    print(table(run), impacts_table(run), sep="\n\n")


if __name__ == "__main__":
    main()
