"""Speed of nonlinear fits: linear equations as nonlinear ones, a bearing with a cubic film, memory of long recordings.

``python -m tests.benchmarks.nonlinear_speed`` measures each in one run on one core, and stores the figures in
docs/nonlinear-speed.json. The baseline is the pattern of CasADi's documentation for identification (its example
``sysid``): `mapaccum` over the samples, Gauss-Newton Hessian from the Jacobian of all errors, IPOPT.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median
from typing import Any

import casadi as ca
import numpy as np

import gbid
from gbid import NonlinearStructure, Parameter, Recording
from gbid.core.arrays import FloatArray
from gbid.structure import nonlinear_model
from gbid.structure.kinds import equations_of
from gbid.structure.linear import symbolic_matrices
from tests.benchmarks.baselines import gauss_newton
from tests.benchmarks.running import DOCS, about, markdown, options_of, run_study, stored, timed, under

# ---- Fits of a bearing with a cubic film by the pattern of CasADi's documentation for identification (its ``sysid``).

STEPS = 2
"""Runge-Kutta steps in a sample, as many as gbid takes for the same data."""
_GAIN = {"c": 1e14, "g": 1e3}
"""Sizes of cubic stiffness and disturbance gains that begin at zero."""
_INPUT = 1e-6
_DELAY = 1e-9


def fit_with_mapaccum(
    equations: ca.Function,
    recording: Recording,
    start: Mapping[str, float],
    free: Sequence[str],
    initial_state: FloatArray | None = None,
    **limits: float,
) -> tuple[dict[str, float], FloatArray, dict[str, Any]]:
    """Return the fit of some of the parameters; the others keep their start values, as constants in the step.

    Parameters
    ----------
    equations : casadi.Function
        ``f(x, u, p)``, the derivatives of the six states, with all parameters in the order of `start`.
    recording : Recording
        Signals ``u`` and ``p`` of two channels each.
    start : dict of str to float
        Start values of all parameters, the four disturbance gains last.
    free : sequence of str
        Names of those to fit.
    initial_state : (6,) array, optional
        Where the first state begins; zero by default.
    **limits : float
        Options of IPOPT.

    Returns
    -------
    dict of str to float
        All parameters of the last iterate, also when the time was not enough.
    (6,) array
        Its initial state, in SI units.
    dict
        Processor times to construct the functions and to solve, iterations and status of IPOPT, and the mean squared
        error, summed over the outputs [m^2].
    """
    began = time.process_time()
    u, y = recording.signal("u"), recording.signal("p")
    n, h = len(y), recording.sample_time
    size_y = float(y.std())
    velocity = float(np.diff(y[:, 0]).std() / h)
    x_scale = np.array([size_y, size_y, velocity, velocity, _DELAY, _DELAY])
    scale = np.array([abs(start[name]) or _GAIN[name[0]] for name in free])
    x, z, theta = ca.SX.sym("x", 6), ca.SX.sym("z", 6), ca.SX.sym("theta", len(free))
    by_name = dict(zip(free, ca.vertsplit(theta * scale), strict=True))
    p = ca.vertcat(*(by_name.get(name, value) for name, value in start.items()))
    step = ca.Function("step", [x, z, theta], [_sample(equations, h, x * x_scale, z, p, size_y) / x_scale])

    z_all = np.hstack([u / _INPUT, np.vstack([u[1:], u[-1:]]) / _INPUT, y / size_y]).T
    V = ca.MX.sym("V", len(free) + 6)
    every = step.mapaccum(n - 1)
    states = ca.horzcat(V[-6:], every(V[-6:], z_all[:, :-1], ca.repmat(V[:-6], 1, n - 1)))
    e = ca.vec(y.T / size_y - states[:2, :] * (x_scale[:2] / size_y))
    solver = gauss_newton(V, e, n, max_iter=50, **limits)
    built = time.process_time()
    first = np.zeros(6) if initial_state is None else initial_state / x_scale
    solution = solver(x0=np.concatenate([np.array([start[name] for name in free]) / scale, first]))
    solved = time.process_time()
    stats, values = solver.stats(), np.asarray(solution["x"])[:, 0]
    figures = {
        "build_cpu_s": built - began,
        "solve_cpu_s": solved - built,
        "iterations": int(stats["iter_count"]),
        "status": str(stats["return_status"]),
        "mean_square": 2 * float(solution["f"]) * size_y**2,
    }
    parameters = {**start, **dict(zip(free, (values[:-6] * scale).tolist(), strict=True))}
    return parameters, values[-6:] * x_scale, figures


def _sample(equations: ca.Function, h: float, x: ca.SX, z: ca.SX, p: ca.SX, size_y: float) -> ca.SX:
    """Return the state one sample later: inputs linear between samples, the prediction error held."""
    now, last, y = z[:2] * _INPUT, z[2:4] * _INPUT, z[4:] * size_y
    held = ca.vertcat(ca.SX(2, 2), ca.reshape(p[-4:], 2, 2).T, ca.SX(2, 2)) @ (y - x[:2])
    s = h / STEPS

    def f(state: ca.SX, drive: ca.SX) -> ca.SX:
        return equations(state, drive, p)[0] + held

    for i in range(STEPS):
        a, c = now + (last - now) * (i / STEPS), now + (last - now) * ((i + 1) / STEPS)
        m = (a + c) / 2
        k1 = f(x, a)
        k2 = f(x + s / 2 * k1, m)
        k3 = f(x + s / 2 * k2, m)
        x = x + s / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + s * k3, c))
    return x


# ---- The study.

STORED = DOCS / "nonlinear-speed.json"
SAMPLE_TIME = 2e-4
_TIMES = 7
TRUTH = {
    **{"k_xx": -6.3e5, "k_xy": 4e4, "k_yx": 1.7e4, "k_yy": -6.5e5, "d_xx": -52.0, "d_xy": 20.0, "d_yx": -48.0},
    **{"d_yy": -57.0, "b_xx": 1.6e5, "b_xy": 7e3, "b_yx": -2e4, "b_yy": 1.9e5, "tau_x": 5.8e-4, "tau_y": 2.5e-4},
    **{"c_x": 5e14, "c_y": 4e14, "g_xx": 0.0, "g_xy": 0.0, "g_yx": 0.0, "g_yy": 0.0},
}
"""A bearing whose film stiffens: cubic stiffness c [1/(m s)^2], and four disturbance gains g."""
LINEAR = gbid.RotorBearing(pade_order=1, disturbance_gain="none")
FILM = 1.3e9
"""Stiffening of the built-in structure [1/m^2]: 2 % more stiffness at 4 um."""


def film(start: Mapping[str, float]) -> NonlinearStructure:
    """Return the structure of a bearing with a cubic film: 6 states, 16 parameters, 4 disturbance gains."""

    def dynamics(x: Any, u: Any, p: Any) -> list[Any]:
        ux, uy = 4 / p.tau_x * x[4] - u[0], 4 / p.tau_y * x[5] - u[1]
        force_x = p.k_xx * x[0] + p.k_xy * x[1] - p.c_x * x[0] ** 3 + p.d_xx * x[2] + p.d_xy * x[3]
        force_y = p.k_yx * x[0] + p.k_yy * x[1] - p.c_y * x[1] ** 3 + p.d_yx * x[2] + p.d_yy * x[3]
        delayed = [u[0] - 2 / p.tau_x * x[4], u[1] - 2 / p.tau_y * x[5]]
        return [x[2], x[3], force_x + p.b_xx * ux + p.b_xy * uy, force_y + p.b_yx * ux + p.b_yy * uy, *delayed]

    return NonlinearStructure(
        "cubic_film",
        [Parameter(name, start[name]) for name in TRUTH],
        ["p_x", "p_y", "v_x", "v_y", "a_x", "a_y"],
        dynamics,
        lambda x, _u, _p: x[:2],
        ["u.x", "u.y"],
        ["p.x", "p.y"],
        intersample="foh",
        disturbance_gain=lambda p: [[0, 0], [0, 0], [p.g_xx, p.g_xy], [p.g_yx, p.g_yy], [0, 0], [0, 0]],
    )


def film_recording(n: int, **changes: float) -> Recording:
    """Return a recording of the bearing with measurement noise; `changes` replace true parameters."""
    return recorded(nonlinear_model(film(TRUTH), {**TRUTH, **changes}, steps=8), n)


def recorded(model: Any, n: int) -> Recording:
    """Return a recording of a model from u to p, with measurement noise."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (n // 25 + 1, 2)), 25, axis=0)[:n] * 4e-6
    y = model.simulate(u, SAMPLE_TIME, intersample="foh") + 1e-7 * rng.normal(size=u.shape)
    return Recording({"u": u, "p": y}, SAMPLE_TIME, name="film", channels={"u": ("x", "y"), "p": ("x", "y")})


def linear_start(recording: Recording) -> dict[str, float]:
    """Return start values from a fit of the linear bearing, without cubic stiffness and gains.

    A start need not be exact: the paper's stopping rule will do, and no disturbance gain that cannot whiten the errors.
    """
    linear = gbid.fit(LINEAR, recording, stop="paper")
    return {**dict.fromkeys(TRUTH, 0.0), **{k: v for k, v in linear.parameters.items() if k in TRUTH}}


def medians(*calls: Callable[[], Any]) -> tuple[list[Any], list[float]]:
    """Return the last results of calls in turn, and the medians of their times without the first, which compiles."""
    rounds = [[timed(call) for call in calls] for _ in range(_TIMES + 1)]
    return [value for value, _ in rounds[-1]], [median(q[i][1] for q in rounds[1:]) for i in range(len(calls))]


def figures_of(result: gbid.FitResult, truth: Mapping[str, float], cpu_s: float) -> dict[str, Any]:
    """Return time, iterations and status of a fit, and how far its estimates are from the truth."""
    off = [(result.parameters[name] - truth[name]) / result.std[name] for name in result.free]
    rms = float(np.sqrt(np.mean(np.square(off))))
    return {"cpu_s": cpu_s, "iterations": result.iterations, "rms_off_std": rms, "status": str(result.status)}


def film_fit(n: int) -> dict[str, Any]:
    """Return the time of a fit from data alone, once compiled, and how far its estimates are from the truth."""
    recording = film_recording(n)
    structure = film(linear_start(recording))
    calls = partial(linear_start, recording), partial(gbid.fit, structure, recording)
    (_, result), (linear_s, film_s) = medians(*calls)
    return {
        "samples": n,
        "linear_cpu_s": linear_s,
        **figures_of(result, TRUTH, film_s),
        "steps": result.model.steps,
        "mean_square": float(np.trace(result.error_covariance)),
    }


def built_in_fit(n: int) -> dict[str, Any]:
    """Return the time of a fit of ``RotorBearing(film="stiffening")`` from data alone, once compiled."""
    structure = gbid.RotorBearing(film="stiffening")
    truth = {q.name: TRUTH.get(q.name, 0.0) for q in structure.parameters} | {"stiffening": FILM}
    recording = recorded(nonlinear_model(equations_of(structure), truth, steps=8), n)  # type: ignore[arg-type]  # of a film
    (result,), (spent,) = medians(partial(gbid.fit, structure, recording))
    return figures_of(result, truth, spent)


def with_mapaccum(n: int, most_s: float) -> dict[str, Any]:
    """Return the times of CasADi's own pattern for the same data: the film from the same linear fit, and both stages.

    A user of the pattern alone has no linear fit before it. He fits the linear equations by the pattern, too, and the
    film from there. The start values that gbid finds in the data are given to him.
    """
    recording = film_recording(n)
    linear = gbid.fit(LINEAR, recording, criterion="trace")  # as the pattern weighs the outputs
    results = {**dict.fromkeys(TRUTH, 0.0), **{k: v for k, v in linear.start.items() if k in TRUTH}}
    free = [name for name in TRUTH if name in linear.free]
    start = linear_start(recording)
    by_pattern = partial(fit_with_mapaccum, nonlinear_model(film(start), start, steps=STEPS).function, recording)
    *_, film_alone = by_pattern(start, list(TRUTH), max_cpu_time=most_s)
    # A start need not be exact: the solver may stop earlier, as gbid's linear fit does by the paper's rule.
    parameters, state, before = by_pattern(results, free, tol=1e-4, max_cpu_time=most_s)
    *_, after = by_pattern(parameters, list(TRUTH), state, max_cpu_time=most_s)
    off = [(parameters[name] - linear.parameters[name]) / linear.std[name] for name in free]
    stages = {"film": film_alone, "linear_before": before, "film_after": after}
    return {**stages, "linear_off_std": float(np.abs(off).max())}


def as_nonlinear(n: int) -> dict[str, Any]:
    """Return the times of the linear bearing as it is, and of the same equations as a nonlinear structure."""
    recording, bearing = film_recording(n, c_x=0.0, c_y=0.0), gbid.RotorBearing(pade_order=1)
    p, m = symbolic_matrices(bearing)
    start = gbid.fit(bearing, recording).parameters
    function = ca.Function("m", [p], [m.A, m.B, m.K])
    names = [q.name for q in bearing.parameters]

    def matrices(values: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
        return tuple(function(ca.vertcat(*(values[name] for name in names))))  # type: ignore[return-value]

    def dynamics(x: Any, u: Any, values: Any) -> Any:
        A, B, _ = matrices(values)
        return A @ x + B @ u

    other = NonlinearStructure(
        "bearing",
        [Parameter(name, start[name]) for name in names],
        [f"x{i}" for i in range(m.A.shape[0])],
        dynamics,
        lambda x, _u, _p: x[:2],
        ["u.x", "u.y"],
        ["p.x", "p.y"],
        intersample="foh",
        disturbance_gain=lambda values: matrices(values)[2],
        steps=2,
    )
    begin = {name: 1.01 * start[name] for name in names}
    fits = [partial(gbid.fit, q, recording, start=begin, intersample="foh") for q in (bearing, other)]
    results, (linear_s, nonlinear_s) = medians(*fits)
    for result in results:
        if not result.success:
            raise SystemExit(f"the fit of {result.structure} ended with: {result.status}")
    times = {"linear_cpu_s": linear_s, "nonlinear_cpu_s": nonlinear_s, "ratio": nonlinear_s / linear_s}
    return {"samples": n, "steps": 2, **times}


def memory(n: int) -> dict[str, Any]:
    """Return the largest memory of a process that fits a recording of so many samples [MB]."""
    code = f"from tests.benchmarks.nonlinear_speed import own_memory; own_memory({n})"
    text = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    return dict(json.loads(text))


def own_memory(n: int) -> None:
    """Print the time of a fit and the memory of this process as JSON."""
    recording = film_recording(n)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    result, spent = timed(lambda: gbid.fit(film({**TRUTH, "c_x": 0.0, "c_y": 0.0}), recording))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures = {"samples": n, "before_mb": before, "peak_mb": peak, "cpu_s": spent, "status": str(result.status)}
    sys.stdout.write(json.dumps(figures))


def table(run: Mapping[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    own, built_in, same = run["film"], run["built_in"], run["as_nonlinear"]
    film_s, linear_s = own["cpu_s"], own["linear_cpu_s"]
    theirs = {name: _whole(run["mapaccum"][name]) for name in ("film", "linear_before", "film_after")}
    path = theirs["linear_before"] + theirs["film_after"]
    status, iterations = (run["mapaccum"]["film"][name] for name in ("status", "iterations"))
    rows = [
        ("linear bearing as a nonlinear structure", f"{same['ratio']:.1f} times the linear fit"),
        ("cubic film, from the linear fit", f"{film_s:.3f} s ({own['iterations']} iterations)"),
        ("the same from data alone: with the linear fit before it", f"{film_s + linear_s:.3f} s"),
        (
            '`RotorBearing(film="stiffening")`, from data alone',
            f"{built_in['cpu_s']:.3f} s ({built_in['iterations']} iterations)",
        ),
        (
            f"mapaccum: cubic film, from gbid's linear fit ({status}, {iterations} iterations)",
            f"{theirs['film']:.1f} s, {theirs['film'] / film_s:.0f} times",
        ),
        (
            "mapaccum: from gbid's start values of the data, linear fit and film",
            f"{theirs['linear_before']:.1f} s + {theirs['film_after']:.1f} s, {path / (film_s + linear_s):.0f} times",
        ),
        (
            "mapaccum: cubic film, with gbid's linear fit before both",
            f"{theirs['film'] + linear_s:.1f} s, {(theirs['film'] + linear_s) / (film_s + linear_s):.0f} times",
        ),
    ]
    rows += [
        (f"memory, {each['samples']:,} samples", f"{each['peak_mb']:.0f} MB, {each['cpu_s']:.1f} s")
        for each in run["memory"]
    ]
    return markdown(("what", "processor time"), rows, *([under(dict(run))] if "processor" in run else []))


def agrees(run: Mapping[str, Any]) -> bool:
    """Return whether both ways ended at the same estimates: same linear fit, same errors of the film."""
    mean_square = run["film"]["mean_square"]
    stages = [run["mapaccum"][name]["mean_square"] for name in ("film", "film_after")]
    return bool(run["mapaccum"]["linear_off_std"] < 0.05 and np.allclose(stages, mean_square, rtol=1e-6, atol=0))


def _whole(stage: Mapping[str, float]) -> float:
    return stage["build_cpu_s"] + stage["solve_cpu_s"]


def main() -> None:
    """Measure, print and store."""
    options = options_of(
        __doc__,
        output=STORED.name,
        samples=(25_000, "samples of a recording"),
        longest=(1_000_000, "samples of the longest recording; 0 for none"),
        most=(600.0, "time limit of the baseline's solver [s]"),
    )
    n, longest = options.samples, options.longest
    run: dict[str, Any] = about()

    def measured() -> dict[str, Any]:
        # The kernel counts what the parent held before a process began as its own: the baseline comes last.
        run["memory"] = [memory(m) for m in (longest // 4, longest // 2, longest) if m]
        run.update(film=film_fit(n), built_in=built_in_fit(n), as_nonlinear=as_nonlinear(n))
        return run | {"mapaccum": with_mapaccum(n, options.most)}

    run_study(measured, options.output, table)
    if not agrees(stored(options.output, {})):
        raise SystemExit("the baseline ended at other estimates: its time says nothing")


if __name__ == "__main__":
    main()
