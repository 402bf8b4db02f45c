"""Public benchmarks of nonlinear identification, from files that the user points to; none is shipped.

``python -m tests.benchmarks.public --folder FOLDER`` looks for the files of each benchmark in the folder and below it.
Candidate structures are fitted to three quarters of the training data, and simulate the last quarter. The first whose
error is within 1 % of the least is fitted to the training data and simulates the tests. Figures go to
docs/public-benchmarks.json. A benchmark without its files keeps its earlier figures. Where the files come from:
docs/public-benchmarks.md.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import scipy.io
from scipy.signal import resample, resample_poly

import gbid
from gbid import NonlinearStructure, Recording
from gbid.core.arrays import FloatArray
from gbid.core.errors import GbidError
from gbid.core.files import share_folder
from gbid.structure import load_structure, wiener_hammerstein
from tests.benchmarks.running import DOCS, about, markdown, options_of, run_study, stored, timed

STORED = DOCS / "public-benchmarks.json"
Data = tuple[Recording, dict[str, Recording]]
"""Training data, and test data by name."""

# ---- Files, and the official split into training and test data.


def arrays(folder: Path, name: str, *keys: str) -> list[FloatArray]:
    """Return variables of a MAT file, datasets of an HDF5 file or columns of a CSV file with a head, as vectors.

    The first file called `name` is taken that lies in the folder or below it; without an ending any of the three.
    """
    files = sorted(path for path in folder.rglob(f"{name}*") if path.name in (name, f"{name}.mat", f"{name}.csv"))
    if not files:
        raise FileNotFoundError(name)
    path = files[0]
    if path.suffix == ".mat":
        content = scipy.io.loadmat(path)
        return [np.ravel(content[key]).astype(float) for key in keys]
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            return [np.ravel(file[key]) for key in keys]
    with path.open(encoding="utf-8") as text:
        head = [word.strip('"') for word in text.readline().strip().split(",")]
    return list(np.genfromtxt(path, delimiter=",", skip_header=1, usecols=[head.index(key) for key in keys]).T)


def recording(
    name: str, sample_time: float, u: FloatArray, y: FloatArray, signals: tuple[str, str] = ("u", "y"), finer: int = 1
) -> Recording:
    """Return a recording of an input and an output.

    With `finer` the input, which has no power near the Nyquist frequency, is known so many times per sample. The
    outputs between the samples are missing.
    """
    outputs = np.full(len(u) * finer, np.nan)
    outputs[::finer] = y
    inputs = resample_poly(u, finer, 1, window=("kaiser", 8.0)) if finer > 1 else u
    return Recording({signals[0]: inputs[:, None], signals[1]: outputs[:, None]}, sample_time / finer, name=name)


def silverbox(folder: Path) -> Data:
    """Return three quarters of the multisine for training; its rest, and the arrow with and without extrapolation."""
    u, y = arrays(folder, "SNLS80mV", "V1", "V2")
    end = 40650 + int(0.75 * (127400 - 40650))

    def part(name: str, start: int, stop: int) -> Recording:
        return recording(name, 1 / 610.35, u[start:stop], y[start:stop], finer=2)

    tests = {"multisine": (end, 127400), "arrow": (100, 40575), "arrow without extrapolation": (100, 32100)}
    return part("silverbox", 40650, end), {name: part(name, *test) for name, test in tests.items()}


def cascaded_tanks(folder: Path) -> Data:
    """Return the two records of the tanks."""
    u, y, u_test, y_test = arrays(folder, "dataBenchmark", "uEst", "yEst", "uVal", "yVal")
    made = partial(recording, sample_time=4.0, signals=("pump", "level"))
    return made("tanks", u=u, y=y), {"test": made("test", u=u_test, y=y_test)}


def emps(folder: Path) -> Data:
    """Return the drive without pulses of force for training, with pulses for the test.

    The command of the loop is the product of its gains and the reference, and the pulses, which are added to it.
    """

    def record(name: str, file: str, *pulses: str) -> Recording:
        kp, kv, reference, voltage, position, *added = arrays(folder, file, "kp", "kv", "qg", "vir", "qm", *pulses)
        command = sum(added, kp * kv * reference)
        signals = {"command": command, "voltage": voltage, "position": position}
        return Recording({key: signal[:, None] for key, signal in signals.items()}, 1e-3, name=name)

    train = record("emps", "DATA_EMPS.mat")
    return train, {"pulses": record("pulses", "DATA_EMPS_PULSES.mat", "pulses_N"), "training record": train}


def circuit(folder: Path) -> Data:
    """Return 100 000 samples of the Wiener-Hammerstein circuit for training, 78 800 for the test."""
    u, y = arrays(folder, "WienerHammerBenchMark", "uBenchMark", "yBenchMark")
    train, test = slice(5200, 105200), slice(105200, 184000)
    return recording("circuit", 1 / 51200, u[train], y[train]), {"test": recording("test", 1 / 51200, u[test], y[test])}


def bouc_wen(folder: Path) -> Data:
    """Return a multisine simulated with noise for training, and the two official tests without noise."""
    made = partial(recording, sample_time=1 / 750, signals=("force", "position"), finer=2)
    u, y = arrays(folder, "train.h5", "multisine/u", "multisine/y")
    tests = {}
    for name in ("multisine", "sinesweep"):
        signals = [arrays(folder, f"{letter}val_{name}", f"{letter}val_{name}")[0] for letter in "uy"]
        tests[name] = made(name, u=signals[0], y=signals[1])
    return made("bouc-wen", u=u, y=y), tests


# ---- The benchmarks, and what was published about them.


class Published(NamedTuple):
    """A published root mean square error of a simulated test, in the unit of the benchmark.

    `checked` tells whether the figure was read in the source, or in `source` a figure of another one is quoted; what is
    not checked goes around without a source that could be read. `test` is the test of the figure; by default all.
    """

    value: float
    method: str
    source: str
    initial: str
    checked: bool = True
    test: str = ""


@dataclass(frozen=True)
class Benchmark:
    """A benchmark.

    Attributes
    ----------
    title, unit : str
        Name, and unit of the figures.
    factor : float, optional
        Figures are `factor` times the errors. Without it they are per cent of the effective value of the output.
    load : callable
        Training and test data of a folder.
    candidates : callable
        Candidate structures.
    published : sequence of Published
        Published figures.
    first : int
        Samples of the measured output of a test from which its initial state is estimated; they count in no figure.
        Zero: the initial state is that of the training data, as the benchmark states, and all samples count.
    chosen_on, fitted_on : int, optional
        Samples of the training data that the choice and the fit take; by default all.
    known : dict of str to float
        True values, where they are published.
    compared : bool
        Whether the chosen structure is fitted to the tests as well, to see whether its parameters are the same there.
    """

    title: str
    unit: str
    factor: float | None
    load: Callable[[Path], Data]
    candidates: Callable[[], Sequence[NonlinearStructure]]
    published: Sequence[Published]
    first: int = 50
    chosen_on: int | None = None
    fitted_on: int | None = None
    known: Mapping[str, float] | None = None
    compared: bool = False


def shipped(file: str, *names: str) -> list[NonlinearStructure]:
    """Return structures of a file in the folder ``models``."""
    return [load_structure(f"{file}:{name}", share_folder("models")) for name in names]  # type: ignore[misc]


def diode_circuits(numbers: Sequence[int] = (5, 9, 13)) -> list[NonlinearStructure]:
    """Return Wiener-Hammerstein structures with filters of third order, and so many knots within +-1.5 V."""
    return [
        wiener_hammerstein(3, 3, np.linspace(-1.5, 1.5, n), 3e3, steps=2, name=f"filters of third order, {n} knots")
        for n in numbers
    ]


DYNONET = "M. Forgione, D. Piga, dynoNet, arXiv 2006.02250"
JANOT = "A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS, Sec. 3.5"
ZERO, UNKNOWN = "zero", "not known"

BENCHMARKS: dict[str, Benchmark] = {
    "silverbox": Benchmark(
        "Silverbox",
        "mV",
        1e3,
        silverbox,
        partial(shipped, "silverbox.py", "cubic", "fifth", "structure", "both"),
        [Published(0.29, "lowest figure known for these tests", "no source", UNKNOWN, checked=False)],
    ),
    "cascaded tanks": Benchmark(
        "Cascaded tanks",
        "V",
        1.0,
        cascaded_tanks,
        partial(shipped, "cascaded_tanks.py", "straight", "structure", "cubic", "exponents"),
        [
            Published(0.18, "neural state space", "no source", UNKNOWN, checked=False),
            Published(
                0.343, "nonlinear state space", "R. Relan et al. 2017, in doi 10.1155/2021/6613425, Table 2", UNKNOWN
            ),
        ],
        first=0,
    ),
    "emps": Benchmark(
        "Electro-mechanical positioning system",
        "mm",
        1e3,
        emps,
        partial(shipped, "emps.py", "structure", "uneven", "cubic"),
        [Published(2.64, "dynoNet", DYNONET, ZERO)],
        first=20,
    ),
    "emps loop": Benchmark(
        "Electro-mechanical positioning system in its loop",
        "%",
        None,
        emps,
        partial(shipped, "emps.py", "loop", "uneven_loop", "cubic_loop"),
        [
            Published(value, "least squares of the force", JANOT, UNKNOWN, test=test)
            for test, value in {"pulses, voltage": 8.9409, "pulses, position": 0.0080248}.items()
        ],
        first=20,
        compared=True,
    ),
    "wiener-hammerstein": Benchmark(
        "Wiener-Hammerstein circuit",
        "mV",
        1e3,
        circuit,
        diode_circuits,
        [
            Published(0.28, "Wiener-Hammerstein", f"M. Schoukens et al., Automatica 50, 2014, in {DYNONET}", UNKNOWN),
            Published(1.2, "dynoNet", DYNONET, ZERO),
        ],
        chosen_on=12000,
        fitted_on=32000,
    ),
    "bouc-wen": Benchmark(
        "Bouc-Wen hysteresis",
        "um",
        1e6,
        bouc_wen,
        partial(shipped, "bouc_wen.py", "linear", "cubic", "structure"),
        [
            Published(18.7, "decoupled nonlinear state space", f"A. F. Esfahani et al. 2017, in {DYNONET}", UNKNOWN),
            Published(45.2, "dynoNet", DYNONET, ZERO),
        ],
        chosen_on=8192,
        fitted_on=32768,
        known={"m": 2.0, "c": 10.0, "k": 0.5, "a": 0.5, "g": 0.8, "d": -1.1},
    ),
}

# ---- Choice, fit and test.


def fitted(structure: NonlinearStructure, train: Recording, first: int, start: Mapping[str, float]) -> gbid.FitResult:
    """Return the fit of a structure, which minimises the error of its simulation.

    A structure with a disturbance gain, as an integrator needs it, is first fitted to predictions. Its simulation
    begins there, and at the state that the first samples give, as in the tests.
    """
    if structure.disturbance_gain is None:
        return gbid.fit(structure, train, start=start)
    predictor = gbid.fit(structure, train)
    state = gbid.cross_validate(predictor, train[:first]).initial_state.tolist()
    return gbid.fit(structure, train, focus="simulation", start=predictor.parameters, initial_state=state, window=None)


def simulated(result: gbid.FitResult, test: Recording, first: int) -> FloatArray:
    """Return the simulation of a test, (n, n_outputs); see `Benchmark.first` for its initial state."""
    state = gbid.cross_validate(result, test[:first]).initial_state if first else result.initial_states[0]
    inputs = np.column_stack([test.signal(name) for name in result.model.input_names])
    return result.model.simulate(inputs, test.sample_time, initial_state=state[: result.model.n_states])


def errors(
    test: Recording, outputs: Sequence[str], simulation: FloatArray, first: int, factor: float | None
) -> FloatArray:
    """Return the figure of each output, where it was measured, without the first samples; see `Benchmark.factor`."""
    y = np.column_stack([test.signal(name, gaps=True) for name in outputs])[first:]
    figures = np.sqrt(np.nanmean(np.square(y - simulation[first:]), axis=0))
    return np.asarray(factor * figures if factor else 100 * figures / np.sqrt(np.nanmean(np.square(y), axis=0)))


def held_out(structure: NonlinearStructure, train: Recording, benchmark: Benchmark) -> tuple[float, dict[str, float]]:
    """Return the mean error on the last quarter of the training data of a fit to the rest, and the estimates."""
    cut = 3 * len(train) // 4
    try:
        result = fitted(structure, train[:cut], benchmark.first, {})
        validation = gbid.cross_validate(result, train[cut:])
    except GbidError:
        return float("inf"), {}
    figures = errors(train[cut:], structure.outputs, validation.simulated, 0, benchmark.factor)
    return float(figures.mean()), dict(result.parameters)


def compiler_s() -> float:
    """Return the processor time of the child processes until now, which are compilers [s]."""
    times = os.times()
    return times.children_user + times.children_system


def estimates(result: gbid.FitResult) -> dict[str, list[Any]]:
    """Return value, standard deviation and unit of each estimated parameter."""
    return {name: [result.parameters[name], result.std[name], result.units[name]] for name in result.free}


def measured(benchmark: Benchmark, folder: Path) -> dict[str, Any]:
    """Return what a benchmark tells: candidates, choice, estimates with intervals, errors of the tests, times."""
    train, tests = benchmark.load(folder)
    outputs = benchmark.candidates()[0].outputs
    finer = round(len(train) / np.isfinite(train.signal(outputs[0], gaps=True)).sum())
    part = train if benchmark.chosen_on is None else train[: benchmark.chosen_on * finer]
    complete = train if benchmark.fitted_on is None else train[: benchmark.fitted_on * finer]
    compiled = compiler_s()
    candidates = benchmark.candidates()
    scores, choice_s = timed(lambda: [held_out(structure, part, benchmark) for structure in candidates])
    least = min(score for score, _ in scores)
    best = next(i for i, (score, _) in enumerate(scores) if score <= 1.01 * least)
    chosen = candidates[best]
    result, fit_s = timed(lambda: fitted(chosen, complete, benchmark.first, scores[best][1]))
    compiled = compiler_s() - compiled

    def fit_of(test: Recording) -> dict[str, list[Any]]:
        return estimates(gbid.fit(chosen, test))

    first = benchmark.first * finer
    simulations = {name: simulated(result, test, first) for name, test in tests.items()}
    figures = {
        name if len(outputs) == 1 else f"{name}, {output}": float(figure)
        for name, y in simulations.items()
        for output, figure in zip(outputs, errors(tests[name], outputs, y, first, benchmark.factor), strict=True)
    }
    shown, test = next(iter(tests.items()))
    curves = test.signal(outputs[0], gaps=True)[::finer, 0], simulations[shown][::finer, 0]
    return {
        "title": benchmark.title,
        "unit": benchmark.unit,
        "training_samples": len(train) // finer,
        "chosen_on": len(part) // finer,
        "fitted_on": len(complete) // finer,
        "first": benchmark.first,
        "candidates": [
            {"name": structure.name, "parameters": len(structure.parameters), "held_out": score}
            for structure, (score, _) in zip(candidates, scores, strict=True)
        ],
        "chosen": chosen.name,
        "status": str(result.status),
        "residuals": result.trusted,
        "parameters": estimates(result),
        "known": dict(benchmark.known or {}),
        "tests": figures,
        "fits_of_tests": {
            name: fit_of(test) for name, test in tests.items() if benchmark.compared and test is not train
        },
        "choice_cpu_s": choice_s,
        "fit_cpu_s": fit_s,
        "compiler_cpu_s": compiled,
        "published": [entry._asdict() for entry in benchmark.published],
        "picture": {"test": next(iter(figures)), **picture(*curves, test.sample_time * finer)},
    }


def picture(y: FloatArray, simulation: FloatArray, sample_time: float, points: int = 250) -> dict[str, list[float]]:
    """Return points in the middle of a test, as far apart as the output is smooth: time, measured, simulated."""
    stride = 1
    while 2 * stride * points < len(y) and np.ptp(y) > 8 * np.abs(y[2 * stride :] - y[: -2 * stride]).max():
        stride *= 2
    start = max(0, (len(y) - points * stride) // 2)
    rows = slice(start, start + points * stride, stride)
    curves = {"t": sample_time * np.arange(len(y)), "y": y, "simulated": simulation}
    return {key: [float(f"{value:.5g}") for value in curve[rows]] for key, curve in curves.items()}


# ---- F-16: modes with the bolted connection of wing and payload, beside black boxes.

TRAINED, TESTED = (1, 3, 5, 7), (2, 4, 6)
PERIODS = 9
SENSORS = ("shaker", "wing", "payload")
REN = "M. Revay, R. Wang, I. R. Manchester, Recurrent equilibrium networks, arXiv 2104.05942, Table I"
Simulator = Callable[[FloatArray], FloatArray]
"""Accelerations (n, 3) of a voltage (n, 1), both at 400 Hz."""


def aircraft(folder: Path) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Return voltage, (n, 1), and accelerations, (n, 3), of seven levels of excitation, without means."""
    levels = {}
    for level in range(1, 8):
        name = f"F16Data_FullMSine_Level{level}" + ("_Validation" if level in TESTED else "")
        voltage, y = arrays(folder, name, "Voltage", "Acceleration")
        rows = y.reshape(3, -1).T
        levels[level] = (voltage - voltage.mean())[:, None], rows - rows.mean(axis=0)
    return levels


def slower(x: FloatArray) -> FloatArray:
    """Return a periodic signal at 50 Hz in place of 400 Hz; the multisine ends at 15 Hz."""
    return np.asarray(resample(x, len(x) // 8))


def f16(
    folder: Path, orders: Sequence[int] = (20, 28), structures: Sequence[NonlinearStructure] | None = None
) -> dict[str, Any]:
    """Return what the F-16 tells; see `measured`. Errors are relative to the measured accelerations, in per cent.

    Candidates are structures and linear subspace models, fitted to the mean periods of all levels. The first period of
    each level counts in no figure, as the initial state is not known.
    """
    levels = aircraft(folder)
    period = len(levels[1][1]) // PERIODS
    means = []
    for level in TRAINED:
        u, y = (slower(x.reshape(PERIODS, period, -1)[1:].mean(axis=0)) for x in levels[level])
        signals = {"voltage": u, **dict(zip(SENSORS, np.split(y, 3, axis=1), strict=True))}
        means.append(Recording(signals, 1 / 50, name=f"level {level}"))

    def simulator(simulate: Callable[..., FloatArray], **options: Any) -> Simulator:
        return lambda u: np.asarray(resample(simulate(slower(u), 1 / 50, **options), len(u)))

    def black_box(order: int, rows: int | None) -> Simulator:
        model = gbid.subspace(
            [mean[:rows] for mean in means], order, inputs="voltage", outputs=SENSORS, feedthrough=True
        )
        if not model.is_stable():
            raise GbidError(f"order {order}: an unstable model")
        return simulator(model.simulate)

    results: dict[str, gbid.FitResult] = {}

    def grey_box(structure: NonlinearStructure, rows: int | None) -> Simulator:
        start = results[structure.name].parameters if structure.name in results else None
        result = gbid.fit(structure, [mean[:rows] for mean in means], start=start, window=None)
        results[structure.name] = result
        return simulator(result.model.simulate, intersample="foh")

    candidates: list[tuple[str, int, Callable[[int | None], Simulator]]] = [
        (structure.name, len(structure.parameters), partial(grey_box, structure))
        for structure in (shipped("f16.py", "linear", "structure") if structures is None else structures)
    ]
    candidates += [(f"linear, order {order}", 4 * order + 3, partial(black_box, order)) for order in orders]

    def left(simulate: Simulator, level: int, periods: int = PERIODS) -> list[FloatArray]:
        u, y = (x[: periods * period] for x in levels[level])
        return [y[period:], (y - simulate(u))[period:]]

    def relative(errors: Sequence[Sequence[FloatArray]]) -> float:
        y, e = (np.concatenate(each) for each in zip(*errors, strict=True))
        return float(100 * np.linalg.norm(e) / np.linalg.norm(y))

    def score(fit: Callable[[int | None], Simulator]) -> float:
        last = slice(3 * period // 4, None)
        try:
            simulate = fit(3 * len(means[0]) // 4)
            return relative([[x[last] for x in left(simulate, level, 2)] for level in TRAINED])
        except GbidError:
            return float("inf")

    compiled = compiler_s()
    scores, choice_s = timed(lambda: [score(fit) for _, _, fit in candidates])
    best = next(i for i, value in enumerate(scores) if value <= 1.01 * min(scores))
    chosen = candidates[best][0]
    simulate, fit_s = timed(lambda: candidates[best][2](None))
    compiled = compiler_s() - compiled
    errors = {level: left(simulate, level) for level in TESTED}
    y, error_y = (signal[-period:, 1] for signal in errors[TESTED[1]])
    result = results.get(chosen)
    return {
        "title": "F-16 ground vibration test",
        "unit": "%",
        "training_samples": len(TRAINED) * len(levels[1][1]),
        "candidates": [
            {"name": name, "parameters": count, "held_out": value}
            for (name, count, _), value in zip(candidates, scores, strict=True)
        ],
        "chosen": chosen,
        "status": str(result.status) if result else "not judged",
        "residuals": result.trusted if result else "not judged",
        "parameters": estimates(result) if result else {},
        "known": {},
        "tests": {
            "levels 2, 4 and 6": relative(list(errors.values())),
            **{f"level {level}": relative([each]) for level, each in errors.items()},
        },
        "choice_cpu_s": choice_s,
        "fit_cpu_s": fit_s,
        "compiler_cpu_s": compiled,
        "published": [Published(16.2, "recurrent equilibrium network", REN, UNKNOWN)._asdict()],
        "picture": {"test": "level 4, wing", **picture(y, y - error_y, 1 / 400)},
    }


# ---- Tables.


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the benchmarks whose files are there, and print their tables."""
    options = options_of(
        __doc__,
        arguments,
        STORED.name,
        folder=(str, "folder with the files of the benchmarks"),
        only=((*BENCHMARKS, "f-16"), "names of benchmarks"),
    )

    def run() -> dict[str, Any]:
        made = stored(options.output, {}) if options.output else {}
        for name in options.only:
            try:
                folder = Path(options.folder)
                entry = f16(folder) if name == "f-16" else measured(BENCHMARKS[name], folder)
                made[name] = {**entry, **about()}
            except FileNotFoundError as missing:
                print(f"{name}: no file {missing} in {options.folder} or below it", file=sys.stderr)
        return {name: made[name] for name in (*BENCHMARKS, "f-16") if name in made}

    return run_study(run, options.output, table)


def pictures(run: Mapping[str, Any]) -> None:
    """Draw a stretch of the first test of each benchmark into the current figure of pyplot."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(len(run), 1, figsize=(8, 1.9 * len(run)), layout="constrained")
    for ax, entry in zip(axes, run.values(), strict=True):
        shown = entry["picture"]
        t, y, simulation = (np.array(shown[key]) for key in ("t", "y", "simulated"))
        ax.plot(t, y, color="0.6", lw=2.5, label="measured")
        ax.plot(t, simulation, color="C0", lw=0.9, label="simulated")
        ax.plot(t, y - simulation, color="C3", lw=0.9, label="error")
        ax.set_title(f"{entry['title']}: {shown['test']}", fontsize=9, loc="left")
        ax.margins(x=0)
    axes[0].legend(ncols=3, fontsize=8, loc="upper right")
    axes[-1].set_xlabel("time [s]")


def estimates_text(run: Mapping[str, Any]) -> str:
    """Return what was chosen, the kind of the residuals, and the parameters with their standard deviations."""
    lines = []
    for entry in run.values():
        lines.append(f"{entry['title']}: {entry['chosen']}; residuals {entry['residuals']}")
        for name, (value, std, unit) in entry["parameters"].items():
            lines.append(f"    {name:5s} {value:12.6g} +- {std:8.2g} {unit}")
    return "\n".join(lines)


def friction_text(run: Mapping[str, Any]) -> str:
    """Return the friction of the drive in the training data beside that of a fit to the test."""
    entry = run["emps loop"]
    lines = []
    for name in ("m", "F_v", "F_c", "F_0", "F_a"):
        (value, std, unit), (other, other_std, _) = entry["parameters"][name], entry["fits_of_tests"]["pulses"][name]
        lines.append(f"{name:4s} training {value:8.2f} +- {std:5.2f}   test {other:8.2f} +- {other_std:5.2f} {unit}")
    return "\n".join(lines)


def least_published(entry: Mapping[str, Any], test: str) -> dict[str, Any] | None:
    """Return the least figure that was published about a test."""
    of_test = [published for published in entry["published"] if published["test"] in ("", test)]
    return min(of_test, key=lambda published: published["value"], default=None)


def table(run: Mapping[str, Any]) -> str:
    """Return the errors of all tests beside the least published one, with parameters and times, as Markdown."""
    rows = []
    for entry in run.values():
        times = " + ".join(f"{entry[key]:.1f}" for key in ("choice_cpu_s", "fit_cpu_s", "compiler_cpu_s"))
        for test, value in entry["tests"].items():
            least = least_published(entry, test)
            known = f"{least['value']:.3g} {entry['unit']}" if least else "none"
            known += "" if least is None or least["checked"] else " (no source)"
            reached = f"{value:.3g} {entry['unit']}"
            black_box = next(each["parameters"] for each in entry["candidates"] if each["name"] == entry["chosen"])
            rows.append([entry["title"], test, reached, known, len(entry["parameters"]) or black_box, times])
    head = ["benchmark", "test", "gbid", "least published", "parameters", "choice + fit + compiler [s]"]
    return markdown(head, rows)


def published_table(run: Mapping[str, Any]) -> str:
    """Return what was published, with sources, as Markdown."""
    rows = [
        [
            entry["title"],
            f"{published['value']:.3g} {entry['unit']}",
            ": ".join(filter(None, (published["method"], published["test"]))),
            published["source"] if published["checked"] else "goes around; no source that we could read",
            published["initial"],
        ]
        for entry in run.values()
        for published in entry["published"]
    ]
    return markdown(["benchmark", "error", "method", "source", "initial state of the test"], rows)


def choice_table(run: Mapping[str, Any]) -> str:
    """Return the candidates of each benchmark with their error on the last quarter, the chosen one marked."""
    rows = [
        [
            entry["title"],
            f"**{name}**" if name == entry["chosen"] else name,
            candidate["parameters"],
            f"{error:.3g} {unit}",
        ]
        for entry in run.values()
        for candidate in entry["candidates"]
        for name, error, unit in [(candidate["name"], candidate["held_out"], entry["unit"])]
    ]
    return markdown(["benchmark", "candidate", "parameters", "error on the last quarter"], rows)


if __name__ == "__main__":
    sys.exit(main())
