"""The public benchmarks on twins that scipy makes: loaders, shipped structures, choice, tables; the stored figures."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from places import DOCS
from scipy.integrate import solve_ivp
from scipy.io import savemat

import gbid
from gbid.structure import nonlinear_model
from tests.benchmarks import public

pytestmark = pytest.mark.whole
STORED = json.loads((DOCS / "public-benchmarks.json").read_text(encoding="utf-8"))


def solved(derivatives: object, start: list[float], u: np.ndarray, sample_time: float, *, line: bool) -> np.ndarray:
    """First state at the samples, of an input that is held or on straight lines between them."""
    time = sample_time * np.arange(len(u))

    def between(t: float, x: np.ndarray) -> list[float]:
        held = u[min(int(t / sample_time + 1e-9), len(u) - 1)]
        return derivatives(x, np.interp(t, time, u) if line else held)  # type: ignore[operator]

    return solve_ivp(between, (0, time[-1]), start, "LSODA", time, rtol=1e-8, atol=1e-12, max_step=sample_time).y


def duffing(x: np.ndarray, u: float) -> list[float]:
    return [x[1], 1.8e5 * u - (40 + 100 * x[0] ** 2) * x[1] - 1.8e5 * x[0] - 7e5 * x[0] ** 3 - 1000.0]


def drive(x: np.ndarray, u: float) -> list[float]:
    return [x[1], (35.15065188 * u + 3.0 - 20.0 * np.tanh(x[1] / 1e-3) - 200.0 * x[1]) / 95.0]


def hysteresis(x: np.ndarray, u: float) -> list[float]:
    rate = 5e4 * x[1] - 1e3 * (0.8 * abs(x[1]) * x[2] - 1.1 * x[1] * abs(x[2]))
    return [x[1], (u - 10 * x[1] - 5e4 * x[0] - x[2]) / 2.0, rate]


def above(level: np.ndarray, rim: float = 0.0) -> np.ndarray:
    return (level - rim + np.hypot(level - rim, 0.1)) / 2


def tanks(x: np.ndarray, u: float) -> list[float]:
    over, root = above(x[0], 10.0), np.sqrt(above(x[0]))
    outflow = 0.04 * np.sqrt(above(x[1])) + above(x[1], 10.0)
    return [0.05 * (u - 1.0) - 0.035 * root - over, 0.038 * root + 0.6 * over - outflow]


@pytest.mark.parametrize(
    ("file", "derivatives", "values", "scale", "sample_time", "tolerance"),
    [
        (
            "silverbox.py",
            duffing,
            {"k": 1.8e5, "b": 1.8e5, "d": 40, "d_2": 100, "k_3": 7e5, "k_0": 1000},
            0.1,
            1 / 610,
            3e-4,
        ),
        ("emps.py", drive, {"m": 95, "F_v": 200, "F_c": 20, "F_0": -3}, 2.0, 1e-3, 1e-3),
        ("bouc_wen.py", hysteresis, {"m": 2, "c": 10, "k": 0.5, "a": 0.5, "g": 0.8, "d": -1.1}, 50.0, 1 / 750, 2e-3),
    ],
)
def test_shipped_structures_are_the_equations(
    file: str, derivatives: object, values: dict[str, float], scale: float, sample_time: float, tolerance: float
) -> None:
    (structure,) = public.shipped(file, "structure")
    rough = np.random.default_rng(1).normal(size=200)
    u = scale * np.convolve(rough, np.ones(5) / 2, "same")
    zero = {parameter.name: 0.0 for parameter in structure.parameters}
    model = nonlinear_model(structure, {**zero, **values}, steps=8)
    begin = [0.0] * len(structure.states)
    expected = solved(derivatives, begin, u, sample_time, line=structure.intersample == "foh")[0]
    simulated = model.simulate(u[:, None], sample_time, intersample=structure.intersample)[:, 0]
    np.testing.assert_allclose(simulated, expected, atol=tolerance * np.ptp(expected))


def test_twin_of_the_tanks_from_file_to_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    two = partial(public.shipped, "cascaded_tanks.py", "straight", "structure")
    benchmark = replace(public.BENCHMARKS["cascaded tanks"], candidates=two)
    monkeypatch.setitem(public.BENCHMARKS, "cascaded tanks", benchmark)
    rng = np.random.default_rng(3)
    columns = []
    for _ in range(2):
        u = np.repeat(rng.uniform(1.5, 6.5, 20), 20)
        level = solved(tanks, [6.0, 5.0], u, 4.0, line=False)[1]
        sensed = 10.0 - above(10.0, level + 0.07 * (level - 5) ** 2)
        columns += [u, sensed + 0.02 * rng.normal(size=len(u))]
    head = '"uEst","yEst","uVal","yVal","Ts",'
    table = np.column_stack(columns)
    rows = [",".join(map(repr, row.tolist())) + (",4," if i == 0 else ",,") for i, row in enumerate(table)]
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "dataBenchmark.csv").write_text("\n".join([head, *rows]) + "\n")
    stored = tmp_path / "run.json"
    words = ["--folder", str(tmp_path), "--only", "cascaded tanks", "emps", "--output", str(stored)]
    assert public.main(words) == 0
    out, err = capsys.readouterr()
    (entry,) = json.loads(stored.read_text()).values()
    assert "emps: no file DATA_EMPS.mat" in err
    assert entry["chosen"] == "sensor curve of second degree"
    assert entry["tests"]["test"] < 0.1
    assert "| Cascaded tanks | test |" in out
    for name, true in {
        "k_1": 0.035,
        "k_2": 0.038,
        "k_3": 0.04,
        "k_4": 0.05,
        "k_5": 0.6,
        "u_0": 1.0,
        "s_2": 0.07,
    }.items():
        value, std, _ = entry["parameters"][name]
        assert abs(value - true) < 4 * std, name


def sampled_drive(reference: np.ndarray, pulses: np.ndarray) -> dict[str, np.ndarray]:
    """Drive with friction by direction under the sampled controller of the benchmark, by steps of Heun."""

    def acceleration(v: float, voltage: float) -> float:
        return drive(np.array([0.0, v]), voltage)[1] + 37.0 / 95.0 * np.hypot(v, 1e-3)

    q, v, steps = 0.0, 0.0, 10
    before = [q, q]
    rows = []
    for r, pulse in zip(reference, pulses, strict=True):
        voltage = 243.45 * (160.18 * (r - q) - (q - before[0]) / 2e-3) + pulse
        rows.append([q, voltage])
        before = [before[1], q]
        for _ in range(steps):
            slope = acceleration(v, voltage)
            moved = v + 1e-3 / steps * (slope + acceleration(v + 1e-3 / steps * slope, voltage)) / 2
            q, v = q + 1e-3 / steps * (v + moved) / 2, moved
    q, voltage = np.array(rows).T
    return {"qg": reference, "qm": q, "vir": voltage, "kp": 160.18, "kv": 243.45, "pulses_N": pulses}


def test_twin_of_the_drive_from_files_to_table(tmp_path: Path) -> None:
    """The drive is simulated alone, and with the loop that its sampled controller closes."""
    rng = np.random.default_rng(7)
    speeds = np.repeat(rng.uniform(-0.12, 0.12, 24), 250)
    reference = 1e-3 * np.cumsum(np.convolve(speeds, np.ones(60) / 60, "same"))
    pulses = 2.0 * (np.arange(6000) % 1000 > 700)
    for name, added in {"DATA_EMPS": 0 * pulses, "DATA_EMPS_PULSES": pulses}.items():
        content = sampled_drive(reference, added)
        content["qm"] = content["qm"] + 1e-8 * rng.normal(size=6000)
        content["vir"] = content["vir"] + 1e-3 * rng.normal(size=6000)
        savemat(tmp_path / f"{name}.mat", content)
    alone, loop = (public.measured(public.BENCHMARKS[name], tmp_path) for name in ("emps", "emps loop"))
    assert alone["chosen"] == loop["chosen"] == "friction by direction"
    assert alone["tests"]["pulses"] < 0.3
    assert loop["tests"]["pulses, voltage"] < 2
    assert loop["tests"]["pulses, position"] < 0.01
    for entry in (alone, loop):
        for name, true in {"m": 95, "F_v": 200, "F_c": 20, "F_a": -37}.items():
            assert entry["parameters"][name][0] == pytest.approx(true, rel=0.02), name
    assert set(loop["fits_of_tests"]) == {"pulses"}
    assert "| pulses, voltage |" in public.table({"emps loop": loop})
    assert "training" in public.friction_text({"emps loop": loop})


def test_official_splits(tmp_path: Path) -> None:
    count = np.arange(131072.0)
    savemat(tmp_path / "SNLS80mV.mat", {"V1": 0 * count, "V2": count})
    savemat(
        tmp_path / "WienerHammerBenchMark.mat", {"uBenchMark": np.arange(188000.0), "yBenchMark": np.arange(188000.0)}
    )
    train, tests = public.silverbox(tmp_path)
    ends = {name: [*test.signal("y", gaps=True)[[0, -2], 0]] for name, test in tests.items()}
    assert [*train.signal("y", gaps=True)[[0, -2], 0]] == [40650, 105711]
    assert ends == {"multisine": [105712, 127399], "arrow": [100, 40574], "arrow without extrapolation": [100, 32099]}
    train, tests = public.circuit(tmp_path)
    assert [*train.signal("y")[[0, -1], 0], *tests["test"].signal("u")[[0, -1], 0]] == [5200, 105199, 105200, 183999]


def test_twin_of_the_aircraft_from_files_to_table(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    period, f = 4096, 400 * np.arange(2049) / 4096
    phases = np.where((f > 1) & (f < 15), np.exp(2j * np.pi * rng.random(2049)), 0)
    sums = [[1, 1], [1, -2], [-1, 0.5]]
    for level in range(1, 8):
        voltage = np.fft.irfft(level * phases, period)
        modes = [w**2 - (2 * np.pi * f) ** 2 + 2j * np.pi * f * 0.1 * w for w in (60.0, 40.0)]
        responses = [sum(-a * (2 * np.pi * f) ** 2 / m for a, m in zip(row, modes, strict=True)) for row in sums]
        y = np.array([np.fft.irfft(level * phases * g, period) for g in responses])
        u = np.tile(voltage, 9)[None]
        noise = 0.02 * y.std() * rng.normal(size=(3, 9 * period))
        name = f"F16Data_FullMSine_Level{level}" + ("" if level % 2 else "_Validation")
        content = {"Voltage": u + 0.3, "Acceleration": np.tile(y, 9) + noise}
        savemat(tmp_path / f"{name}.mat", content)
    third = content["Acceleration"][2]
    np.testing.assert_allclose(public.aircraft(tmp_path)[7][1][:, 2], third - third.mean(), atol=1e-12)
    entry = public.f16(tmp_path, (4, 8), [one_mode()])
    scores = {each["name"]: each["held_out"] for each in entry["candidates"]}
    assert entry["chosen"] == "linear, order 8"
    assert 4 * scores[entry["chosen"]] < scores["one mode"] < 100
    assert entry["tests"]["levels 2, 4 and 6"] < 8
    assert "| F-16 ground vibration test | level 4 |" in public.table({"f-16": entry})
    alone = public.f16(tmp_path, (), [one_mode()])
    assert alone["chosen"] == "one mode"
    assert alone["parameters"]["f"][0] == pytest.approx(40 / 2 / np.pi, rel=0.2)


def one_mode() -> gbid.NonlinearStructure:
    """Structure of one mode between the voltage and the accelerations of the aircraft."""

    def acceleration(x: object, u: object, p: object) -> object:
        return u[0] - (2 * np.pi * p.f) ** 2 * x[0] - p.c * x[1]

    return gbid.NonlinearStructure(
        "one mode",
        [gbid.Parameter("f", 6.5), gbid.Parameter("c", 4.0), *(gbid.Parameter(name, -1.0) for name in "pqr")],
        ["position", "velocity"],
        lambda x, u, p: [x[1], acceleration(x, u, p)],
        lambda x, u, p: [p[name] * acceleration(x, u, p) for name in "pqr"],
        inputs="voltage",
        outputs=public.SENSORS,
        intersample="foh",
        steps=2,
    )


def test_the_wing_is_modes_with_a_force_between_wing_and_payload() -> None:
    (structure,) = public.shipped("f16.py", "structure")
    values = {parameter.name: parameter.start for parameter in structure.parameters} | {"d_q": 0.7}
    f, damping, *shapes = (np.array([values[f"{row}_{i}"] for i in range(6)]) for row in "fzpqr")
    w, across = 2 * np.pi * f, shapes[1] - shapes[2]

    def modal(x: np.ndarray, u: float) -> np.ndarray:
        z, v = across @ x[:6] / 1e-4, across @ x[6:] / 5e-3
        force = (values["k"] * z + values["g"] * v) * np.sqrt(z**2 + v**2 + 0.01)
        return -(w**2) * x[:6] - 2 * damping * w * x[6:] - shapes[0] * u - across * force

    u = 0.3 * np.convolve(np.random.default_rng(1).normal(size=300), np.ones(5) / 2, "same")
    x = solved(lambda x, v: [*x[6:], *modal(x, v)], [0.0] * 12, u, 0.02, line=True)
    expected = [np.array(shapes) @ modal(state, v) + [0, 0.7 * v, 0] for state, v in zip(x.T, u, strict=True)]
    model = nonlinear_model(structure, values, steps=8)
    simulated = model.simulate(u[:, None], 0.02, intersample="foh")
    np.testing.assert_allclose(simulated, expected, atol=1e-3 * np.ptp(expected))


def test_a_test_begins_at_its_first_samples_and_counts_only_measured_ones() -> None:
    structure = gbid.NonlinearStructure(
        "lag", [gbid.Parameter("a", 2.0)], ["x"], lambda x, u, p: [u[0] - p.a * x[0]], lambda x, _u, _p: x[0]
    )
    u = np.random.default_rng(1).normal(size=400)
    y = solved(lambda x, v: [v - 2.0 * x[0]], [1.0], u, 0.1, line=False)[0]
    train = gbid.Recording({"u": u[:, None], "y": y[:, None]}, 0.1, name="train")
    holes = y.copy()
    holes[100:200] = np.nan
    test = gbid.Recording({"u": u[:, None], "y": holes[:, None]}, 0.1, name="test")
    result = gbid.fit(structure, train)
    simulation = public.simulated(result, test, 20)
    other = simulation + np.where(np.isnan(holes), 9.0, 0.5)[:, None]
    assert public.errors(test, ["y"], simulation, 20, 1.0) < 1e-5
    assert public.errors(test, ["y"], other, 20, 3.0) == pytest.approx([1.5], rel=1e-3)
    size = np.sqrt(np.nanmean(np.square(holes[20:])))
    assert public.errors(test, ["y"], other, 20, None) == pytest.approx([50 / size], rel=1e-3)


def test_stored_figures_keep_what_the_page_says() -> None:
    for name in ("silverbox", "wiener-hammerstein", "bouc-wen", "emps loop"):
        test, figure = next(iter(STORED[name]["tests"].items()))
        least = public.least_published(STORED[name], test)
        assert least is not None, name
        assert figure <= least["value"], name
    assert all(run["choice_cpu_s"] + run["fit_cpu_s"] < 10 for run in STORED.values())
    for name, true in STORED["bouc-wen"]["known"].items():
        value, std, _ = STORED["bouc-wen"]["parameters"][name]
        assert abs(value - true) < 1.96 * std, name
