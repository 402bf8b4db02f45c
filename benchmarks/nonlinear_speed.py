"""Speed of nonlinear fits: linear equations as nonlinear ones, a bearing with a cubic film, memory of long recordings.

``python -m benchmarks.nonlinear_speed`` measures each in one run on one core, and stores the figures in
docs/nonlinear-speed.json. The baseline is the pattern of CasADi's documentation for identification (its example
``sysid``): `mapaccum` over the samples, Gauss-Newton Hessian from the Jacobian of all errors, IPOPT.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import gbid
from gbid import NonlinearStructure, Parameter, Recording
from gbid.structure import equations_of, nonlinear_model
from gbid.structure.linear import symbolic_matrices
from gbid.threads import one_blas_thread

STORED = Path(__file__).parents[1] / "docs" / "nonlinear-speed.json"
SAMPLE_TIME = 2e-4
SAMPLES = 25_000
_TIMES = 3
TRUTH = {
    **{"k_xx": -6.3e5, "k_xy": 4e4, "k_yx": 1.7e4, "k_yy": -6.5e5, "d_xx": -52.0, "d_xy": 20.0, "d_yx": -48.0},
    **{"d_yy": -57.0, "b_xx": 1.6e5, "b_xy": 7e3, "b_yx": -2e4, "b_yy": 1.9e5, "tau_x": 5.8e-4, "tau_y": 2.5e-4},
    **{"c_x": 5e14, "c_y": 4e14, "g_xx": 0.0, "g_xy": 0.0, "g_yx": 0.0, "g_yy": 0.0},
}
"""A bearing whose film stiffens: cubic stiffness c [1/(m s)^2], and four disturbance gains g."""
FILM = 1.3e9
"""Stiffening of the built-in structure [1/m^2]: 2 % more stiffness at 4 um."""


def film(start: Mapping[str, float]) -> NonlinearStructure:
    """Return the structure of a bearing with a cubic film: 6 states, 16 parameters, 4 disturbance gains."""

    def dynamics(x: Any, u: Any, p: Any) -> list[Any]:
        ux, uy = 4 / p.tau_x * x[4] - u[0], 4 / p.tau_y * x[5] - u[1]
        force_x = p.k_xx * x[0] + p.k_xy * x[1] - p.c_x * x[0] ** 3 + p.d_xx * x[2] + p.d_xy * x[3]
        force_y = p.k_yx * x[0] + p.k_yy * x[1] - p.c_y * x[1] ** 3 + p.d_yx * x[2] + p.d_yy * x[3]
        late = [u[0] - 2 / p.tau_x * x[4], u[1] - 2 / p.tau_y * x[5]]
        return [x[2], x[3], force_x + p.b_xx * ux + p.b_xy * uy, force_y + p.b_yx * ux + p.b_yy * uy, *late]

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
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (n // 25 + 1, 2)), 25, axis=0)[:n] * 4e-6
    truth = {**TRUTH, **changes}
    y = nonlinear_model(film(TRUTH), truth, steps=8).simulate(u, SAMPLE_TIME, intersample="foh")
    y = y + 1e-7 * rng.normal(size=y.shape)
    return Recording({"u": u, "p": y}, SAMPLE_TIME, name="film", channels={"u": ("x", "y"), "p": ("x", "y")})


def linear_start(recording: Recording) -> tuple[dict[str, float], float]:
    """Return start values from a fit of the linear bearing, without cubic stiffness and gains, and its time [s].

    A start need not be exact: the paper's stopping rule will do, and no disturbance gain that cannot whiten the errors.
    """
    began = time.process_time()
    linear = gbid.fit(gbid.RotorBearing(disturbance_gain="none"), recording, stop="paper")
    return {**dict.fromkeys(TRUTH, 0.0), **{k: v for k, v in linear.parameters.items() if k in TRUTH}}, (
        time.process_time() - began
    )


def film_fit(n: int) -> dict[str, Any]:
    """Return the time of a fit from data alone, once compiled, and how far its estimates are from the truth."""
    recording = film_recording(n)
    linear_start(recording)  # compiles
    start, first = linear_start(recording)
    gbid.fit(film(start), recording)
    times = []
    for _ in range(_TIMES):
        began = time.process_time()
        result = gbid.fit(film(start), recording)
        times.append(time.process_time() - began)
    off = [(result.parameters[name] - TRUTH[name]) / result.std[name] for name in result.free]
    return {
        "samples": n,
        "linear_cpu_s": first,
        "cpu_s": min(times),
        "iterations": result.iterations,
        "steps": result.model.steps,  # type: ignore[union-attr]  # of a nonlinear structure
        "loss": result.loss,
        "rms_off_std": float(np.sqrt(np.mean(np.square(off)))),
        "status": str(result.status),
    }


def built_in_fit(n: int) -> dict[str, Any]:
    """Return the time of a fit of ``RotorBearing(film="stiffening")`` from data alone, once compiled."""
    structure = gbid.RotorBearing(film="stiffening")
    truth = {q.name: TRUTH.get(q.name, 0.0) for q in structure.parameters} | {"stiffening": FILM}
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (n // 25 + 1, 2)), 25, axis=0)[:n] * 4e-6
    model = nonlinear_model(equations_of(structure), truth, steps=8)  # type: ignore[arg-type]  # of a film
    y = model.simulate(u, SAMPLE_TIME, intersample="foh") + 1e-7 * rng.normal(size=u.shape)
    recording = Recording({"u": u, "p": y}, SAMPLE_TIME, name="film", channels={"u": ("x", "y"), "p": ("x", "y")})
    times = []
    for _ in range(_TIMES + 1):
        began = time.process_time()
        result = gbid.fit(structure, recording)
        times.append(time.process_time() - began)
    off = [(result.parameters[name] - truth[name]) / result.std[name] for name in result.free]
    return {
        "cpu_s": min(times[1:]),  # the first one compiles
        "iterations": result.iterations,
        "rms_off_std": float(np.sqrt(np.mean(np.square(off)))),
        "status": str(result.status),
    }


def with_mapaccum(n: int, most_s: float) -> dict[str, Any]:
    """Return the time of CasADi's own pattern for the same data and start: build, and solution up to a time limit."""
    recording, start = film_recording(n), dict(TRUTH)
    start = linear_start(recording)[0]
    structure = film(start)
    began = time.process_time()
    model = nonlinear_model(structure, start, steps=2)
    function, names = model.function, list(TRUTH)
    size_y = float(recording.signal("p").std())
    velocity = float(np.diff(recording.signal("p")[:, 0]).std() / SAMPLE_TIME)
    x_scale = np.array([size_y, size_y, velocity, velocity, 1e-9, 1e-9])
    scale = np.array([abs(start[name]) or {"c": 1e14, "g": 1e3}[name[0]] for name in names])
    x, z, theta = ca.SX.sym("x", 6), ca.SX.sym("z", 6), ca.SX.sym("theta", len(names))
    p, at = theta * scale, x * x_scale
    u, last, y = z[:2] * 1e-6, z[2:4] * 1e-6, z[4:] * size_y
    K = ca.vertcat(ca.SX(2, 2), ca.reshape(p[16:20], 2, 2).T, ca.SX(2, 2)) @ (y - at[:2])
    for i in range(2):
        a, c = u + (last - u) * (i / 2), u + (last - u) * ((i + 1) / 2)
        s, m = SAMPLE_TIME / 2, (a + c) / 2

        def f(state: ca.SX, drive: ca.SX) -> ca.SX:
            return function(state, drive, p)[0] + K

        k1 = f(at, a)
        k2 = f(at + s / 2 * k1, m)
        k3 = f(at + s / 2 * k2, m)
        at = at + s / 6 * (k1 + 2 * k2 + 2 * k3 + f(at + s * k3, c))
    step = ca.Function("step", [x, z, theta], [at / x_scale])
    u_all, y_all = recording.signal("u") / 1e-6, recording.signal("p") / size_y
    z_all = np.hstack([u_all, np.vstack([u_all[1:], u_all[-1:]]), y_all]).T
    V = ca.MX.sym("V", len(names) + 6)
    every = step.mapaccum(n - 1)
    states = ca.horzcat(V[-6:], every(V[-6:], z_all[:, :-1], ca.repmat(V[:-6], 1, n - 1)))
    e = ca.vec(y_all.T - states[:2, :] * (x_scale[:2] / size_y))
    J = ca.jacobian(e, V)
    none, sigma, multipliers = ca.MX.sym("p", 0), ca.MX.sym("sigma"), ca.MX.sym("lam_g", 0)
    hessian = ca.Function(
        "nlp_hess_l",
        [V, none, sigma, multipliers],
        [sigma * ca.triu(J.T @ J) / n],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
    limits = {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 50, "max_cpu_time": most_s}
    nlp = {"x": V, "f": 0.5 * ca.dot(e, e) / n, "g": ca.MX(0, 1)}
    solver = ca.nlpsol("solver", "ipopt", nlp, {"hess_lag": hessian, "print_time": False, "ipopt": limits})
    built = time.process_time()
    begin = np.concatenate([np.array([start[name] for name in names]) / scale, np.zeros(6)])
    found = solver(x0=begin)
    stats = solver.stats()
    return {
        "build_cpu_s": built - began,
        "solve_cpu_s": time.process_time() - built,
        "iterations": int(stats["iter_count"]),
        "status": str(stats["return_status"]),
        "mean_square": 2 * float(found["f"]) * size_y**2,
    }


def as_nonlinear(n: int) -> dict[str, Any]:
    """Return the times of the linear bearing as it is, and of the same equations as a nonlinear structure."""
    recording, bearing = film_recording(n, c_x=0.0, c_y=0.0), gbid.RotorBearing()
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
    times: dict[str, list[float]] = {"linear": [], "nonlinear": []}
    for structure, kind in ((bearing, "linear"), (other, "nonlinear")) * (_TIMES + 1):
        began = time.process_time()
        result = gbid.fit(structure, recording, start=begin, intersample="foh")  # type: ignore[arg-type]
        times[kind].append(time.process_time() - began)
        if not result.success:
            raise SystemExit(f"the {kind} fit ended with: {result.status}")
    found = {f"{kind}_cpu_s": min(own[1:]) for kind, own in times.items()}  # the first one compiles
    return {"samples": n, "steps": 2, **found, "ratio": found["nonlinear_cpu_s"] / found["linear_cpu_s"]}


def memory(n: int) -> dict[str, Any]:
    """Return the largest memory of a process that fits a recording of so many samples [MB]."""
    code = f"from benchmarks.nonlinear_speed import own_memory; own_memory({n})"
    text = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    return dict(json.loads(text))


def own_memory(n: int) -> None:
    """Print the time of a fit and the memory of this process as JSON."""
    recording = film_recording(n)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began = time.process_time()
    result = gbid.fit(film({**TRUTH, "c_x": 0.0, "c_y": 0.0}), recording)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    spent = time.process_time() - began
    figures = {"samples": n, "before_mb": before, "peak_mb": peak, "cpu_s": spent, "status": str(result.status)}
    sys.stdout.write(json.dumps(figures))


def table(run: Mapping[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    film_run, own, baseline, same = (run[key] for key in ("film", "built_in", "mapaccum", "as_nonlinear"))
    whole = baseline["build_cpu_s"] + baseline["solve_cpu_s"]
    rows = [
        ("linear bearing as a nonlinear structure", f"{same['ratio']:.1f} times the linear fit"),
        ("cubic film, from the linear fit", f"{film_run['cpu_s']:.2f} s ({film_run['iterations']} iterations)"),
        (
            "the same from data alone: with the linear fit before it",
            f"{film_run['cpu_s'] + film_run['linear_cpu_s']:.2f} s",
        ),
        (
            '`RotorBearing(film="stiffening")`, from data alone',
            f"{own['cpu_s']:.2f} s ({own['iterations']} iterations)",
        ),
        (
            f"CasADi's mapaccum pattern, from the same linear fit ({baseline['status']})",
            f"{whole:.0f} s, {whole / film_run['cpu_s']:.0f} times; with the linear fit before both "
            f"{(whole + film_run['linear_cpu_s']) / (film_run['cpu_s'] + film_run['linear_cpu_s']):.0f} times",
        ),
    ]
    rows += [
        (f"memory, {each['samples']:,} samples", f"{each['peak_mb']:.0f} MB, {each['cpu_s']:.1f} s")
        for each in run["memory"]
    ]
    lines = ["| what | processor time |", "|---|---|", *(f"| {a} | {b} |" for a, b in rows)]
    return "\n".join(lines)


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--longest", type=int, default=1_000_000, help="samples of the longest recording; 0 for none")
    parser.add_argument("--most", type=float, default=600.0, help="time limit of the baseline's solver [s]")
    parser.add_argument("--output", type=Path, default=STORED)
    options = parser.parse_args()
    with one_blas_thread():
        # The kernel counts what the parent held before a process began as its own: the baseline comes last.
        lengths = [options.longest // 4, options.longest // 2, options.longest] if options.longest else []
        run: dict[str, Any] = {"memory": [memory(n) for n in lengths], "film": film_fit(options.samples)}
        run["built_in"] = built_in_fit(options.samples)
        run["as_nonlinear"] = as_nonlinear(options.samples)
        run["mapaccum"] = with_mapaccum(options.samples, options.most)
    options.output.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(table(run))


if __name__ == "__main__":
    main()
