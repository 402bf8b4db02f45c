"""Rotors in magnetic bearings of one and four axes: tuned, in a file, in C, levitated in a simulation by numpy."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

import gbid
from gbid.control import MaxDamping, PeakSensitivity
from gbid.core.errors import UsageError
from gbid.export import ChainInput, ChainOptions, write_chain
from gbid.export.chain import Chain, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import ChainFault, ChainMode, PythonChain

T = 1e-4
"""Sample time [s]."""
K_I, K_S = 200.0, 1.0e6
"""Force per current [N/A] and negative stiffness [N/m] of a magnetic bearing."""


def bearing(M: np.ndarray, G: np.ndarray, reach: np.ndarray, names: tuple[str, ...]) -> gbid.LinearModel:
    """Rotor ``M q'' + G q' = reach' f``, ``p = reach q``, ``f = K_I i + K_S p``; amplifiers of 2 kHz.

    The states are q, q' and the currents.
    """
    n, fast = len(names), 2 * np.pi * 2000
    inverse, none = np.linalg.inv(M), np.zeros((n, n))
    A = np.block(
        [
            [none, np.eye(n), none],
            [inverse @ reach.T @ reach * K_S, -inverse @ G, inverse @ reach.T * K_I],
            [none, none, -fast * np.eye(n)],
        ]
    )
    B, C = np.vstack([none, none, fast * np.eye(n)]), np.hstack([reach, none, none])
    currents = tuple(f"i_{name}" for name in names)
    return gbid.LinearModel(A, B, C, np.zeros((n, n)), input_names=currents, output_names=names)


def one_axis() -> gbid.LinearModel:
    """Mass of 4 kg in one bearing."""
    return bearing(np.array([[4.0]]), np.zeros((1, 1)), np.eye(1), ("z",))


def four_axes() -> gbid.LinearModel:
    """Rigid rotor of 8 kg at 6 000 rpm, in bearings 0.15 m and 0.1 m from its centre; q is x, y, and the tilts."""
    tilt = np.array([[0.0, 0.05], [-0.05, 0.0]]) * 628.0
    reach = np.array([[1, 0, 0.15, 0], [0, 1, 0, 0.15], [1, 0, -0.1, 0], [0, 1, 0, -0.1]])
    return bearing(np.diag([8.0, 8.0, 0.09, 0.09]), block_diag(np.zeros((2, 2)), tilt), reach, ("ax", "ay", "bx", "by"))


def tuned(plant: gbid.LinearModel) -> gbid.GainResult:
    """PD of every axis with negative feedback, for the sampled loop."""
    axes = tuple(plant.output_names)
    options = {"feedback": "negative", "gain_unit": "A/m", "lowpass_hz": 2000.0}
    structure = gbid.controller_structure("PD", axes=axes, lower=5e3, upper=4e4, kd_limit_ms=4e4, **options)
    start = {gain.name: 1.5e4 if gain.name.startswith("kappa") else 2e4 for gain in structure.parameters}
    goals, effort = [MaxDamping(), PeakSensitivity(3.5)], {"starts": 0, "evaluations": 100}
    return gbid.tune(plant, structure, goals=goals, sample_time=T, start=start, **effort)


def options(plant: gbid.LinearModel, **further: object) -> ChainOptions:
    """Currents of 4 A around 1.5 A; the watchdog acts 150 um from the middle."""
    n = len(plant.C)
    given = {"ramp_s": T, "fade_s": T, "limits": (4.0,) * n, "offsets": (1.5,) * n, "beyond": (150e-6,) * n}
    return ChainOptions(**{**given, "units": ("m", "A"), **further})  # type: ignore[arg-type]


def levitated(plant: gbid.LinearModel, chain: Chain, steps: int = 800, blind: range = range(0)) -> np.ndarray:
    """Motion of the axes (steps, n) from 30 um, with the currents of the chain in C one sample late; by numpy alone."""
    n, m = plant.n_states, plant.B.shape[1]
    both = expm(T * np.block([[plant.A, plant.B], [np.zeros((m, n + m))]]))
    F, G = both[:n, :n], both[:n, n:]
    x, held, motion = np.zeros(n), np.zeros(m), []
    x[: n // 3] = np.linalg.solve(plant.C[:, : n // 3], np.full(m, 30e-6))
    running = CompiledChain(chain)
    for k in range(steps):
        p = plant.C @ x
        motion.append(p)
        shown = np.full(m, np.nan) if k in blind else p
        output = running.step(ChainInput(tuple(shown), mode=ChainMode.CONTROL))
        x = F @ x + G @ held
        held = np.array(output.stack) - 1.5
    return np.array(motion)


@pytest.mark.parametrize("plant", [one_axis(), four_axes()], ids=["one", "four"])
def test_a_rotor_is_tuned_saved_exported_and_levitated(plant: gbid.LinearModel, tmp_path: Path) -> None:
    assert np.linalg.eigvals(plant.A).real.max() > 300  # it falls by itself
    result = tuned(plant)
    assert result.keeps_limits
    assert result.violation == 0
    saved = gbid.save_controller(tmp_path / "amb.yaml", result, name="amb", plant="rotor")
    design = gbid.load_controller(tmp_path / "amb.yaml")
    assert set(design.units.values()) == {"A/m", "A/m ms"}
    assert (design.sample_time, design.gains, design.structure) == (T, saved.gains, result.controller)
    law = design.at()
    assert law.input_names == tuple(f"p_{name}" for name in plant.output_names)
    assert (law.D @ np.ones(len(plant.C)) <= 0).all()  # negative feedback
    chain = chain_of(design, options=options(plant))
    assert np.abs(levitated(plant, chain)[-200:]).max() < 1e-8
    assessed = gbid.assess(plant, result)
    assert assessed.sample_time == T
    assert min(assessed.points[0].sampled_damping, 1.0) == pytest.approx(result.value, rel=1e-3)
    assert gbid.compare_designs([assessed, gbid.assess([plant], result)]).rows[0][0] == "PD"
    peak = gbid.sensitivities(plant, design.at()).peak("output").value
    assert assessed.points[0].peak_output.value == pytest.approx(peak)
    off = replace(chain, options=options(plant, limits=(1e-6,) * len(plant.C)))
    assert np.abs(levitated(plant, off, 300)).max() > 1e-3  # as good as without control


def test_the_source_of_four_axes_agrees_with_its_rows(tmp_path: Path) -> None:
    plant = four_axes()
    structure = gbid.controller_structure(
        "PD", axes=plant.output_names, feedback="negative", lower=0, upper=4e4, kd_limit_ms=4e4
    )
    gains = {p.name: 1.5e4 if p.name.startswith("kappa") else 2e4 for p in structure.parameters}
    design = gbid.control.ControllerDesign("amb", structure, gains, sample_time=T)
    chain = chain_of(design, options=options(plant, spikes=(50e-6,) * 4, zero_m=(1e-6, 0.0, -2e-6, 0.0), median=3))
    write_chain(chain, tmp_path)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-DAMB_SELFTEST_MAIN"]
    sources = [str(tmp_path / name) for name in ("amb.c", "amb_selftest.c")]
    subprocess.run(["gcc", *flags, *sources, "-o", str(tmp_path / "amb")], check=True, cwd=tmp_path)
    assert "rows agree" in subprocess.run([str(tmp_path / "amb")], check=True, capture_output=True, text=True).stdout
    random = np.random.default_rng(0)
    far = np.array([0.0, 0.0, 0.0, 200e-6])
    samples = [ChainInput(tuple(40e-6 * random.standard_normal(4) + far * (k > 200))) for k in range(300)]
    expected = PythonChain(chain).run(samples)
    assert CompiledChain(chain).run(samples) == expected
    assert any(y.saturated for y in expected)
    assert {y.fault for y in expected} == {ChainFault.NONE, ChainFault.POSITION}


def test_what_a_fault_does_is_a_choice() -> None:
    """Six samples that are no numbers: fading out drops the rotor, control with the last good sample does not."""
    plant = one_axis()
    design = tuned(plant).design()
    blind = range(10, 16)
    falls = levitated(plant, chain_of(design, name="amb", options=options(plant)), 900, blind)
    stays = levitated(plant, chain_of(design, name="amb", options=options(plant, on_fault="control")), 900, blind)
    assert np.abs(falls).max() > 1e-3
    assert np.abs(stays).max() < 100e-6
    running = CompiledChain(chain_of(design, name="amb", options=options(plant, on_fault="control")))
    outputs = [running.step(ChainInput((np.nan,))) for _ in range(8)]
    assert outputs[-1].fault is ChainFault.SIGNAL


def test_limits_of_other_machines_have_no_default() -> None:
    design = tuned(one_axis()).design()
    with pytest.raises(UsageError, match=r"1 inputs .p_z. and 1 outputs .r_z., the four stacks 2 and 2; give limits"):
        chain_of(design, name="amb")
    with pytest.raises(UsageError, match="beyond has 2 numbers for 1 channels"):
        chain_of(design, name="amb", options=ChainOptions(limits=(1.0,), beyond=(1.0, 1.0), units=("m", "A")))
    wanted = r"limits without beyond and units: give the deviation .*, and those of inputs"
    with pytest.raises(UsageError, match=wanted):
        ChainOptions(limits=(1.0,))
    with pytest.raises(UsageError, match="limits without units: give those of inputs and outputs"):
        ChainOptions(limits=(1.0,), beyond=(1.0,))
    assert ChainOptions().units == ("m", "m")


def test_the_source_of_another_machine_names_no_gas_bearing(tmp_path: Path) -> None:
    plant = one_axis()
    chain = chain_of(tuned(plant).design(), name="amb", options=options(plant))
    header = next(path for path in write_chain(chain, tmp_path) if path.name == "amb.h").read_text(encoding="utf-8")
    assert "gas bearing" not in header
    assert "stack" not in header
    assert "[A]" in header
