"""The compiled chain gives the bits of the chain in Python; float stays within its tolerance."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from chain_cases import design, eventful_samples, grid_of_maps, runout_map

from gbid.control import ControllerDesign, controller_structure
from gbid.control.controllers.built_in import built_in_structures
from gbid.export.chain import ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain, render_source
from gbid.export.chain_python import FLOAT_TOLERANCE, ChainFault, ChainInput, PythonChain
from gbid.prefilter.runout import cos_sin

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
SHORT = {"stroke_m": 45e-6, "ramp_s": 0.02, "fade_s": 0.01, "zero_m": (1e-7, 2e-7), "disc_limit_m": 30e-6}
MAPS = {
    "none": (),
    "mean": (runout_map("mean"),),
    "harmonics": (runout_map(),),
    "bins": (runout_map("bins"),),
    "grid": grid_of_maps(),
}
SAMPLES = eventful_samples()


@pytest.mark.parametrize(
    ("kind", "maps", "guards"),
    [
        ("P", "none", {}),
        ("P", "mean", {"median": 3}),
        ("biquad", "harmonics", {"spike_limit_m": None}),
        ("biquad", "bins", {"median": 3, "spike_limit_m": None}),
        ("biquad", "grid", {"median": 3, "spike_limit_m": 8e-6}),
        ("scheduled", "grid", {"spike_limit_m": 8e-6}),
    ],
)
def test_double_is_exact_and_float_within_tolerance(kind: str, maps: str, guards: dict[str, object]) -> None:
    options = ChainOptions(**SHORT, **guards)  # type: ignore[arg-type]
    chain = chain_of(design(kind), runout_maps=MAPS[maps], options=options)
    expected = PythonChain(chain).run(SAMPLES)
    outputs = CompiledChain(chain).run(SAMPLES)
    assert outputs == expected
    assert {int(each.fault) for each in expected} >= {0, ChainFault.SIGNAL, ChainFault.STUCK}
    assert any(each.held for each in expected)
    assert max(abs(each.reference[0]) for each in expected) > 5e-6

    single = ChainOptions(**SHORT, **guards, number="float")  # type: ignore[arg-type]
    rounded = CompiledChain(chain_of(design(kind), runout_maps=MAPS[maps], options=single)).run(SAMPLES)
    miss = np.array([each.stack for each in rounded]) - np.array([each.stack for each in expected])
    assert np.abs(miss).max() < FLOAT_TOLERANCE * chain.options.limit_m
    assert [each.fault for each in rounded] == [each.fault for each in expected]


@pytest.mark.parametrize("kind", built_in_structures())
def test_every_built_in_structure_exports_with_anti_windup(kind: str) -> None:
    random = np.random.default_rng(1)
    structure = controller_structure(kind)
    gains = {}
    for parameter in structure.parameters:
        room = min(parameter.upper - parameter.lower, 1.0)
        value = (parameter.start or 0.0) + 0.2 * random.uniform(0.2, 1.0) * room
        gains[parameter.name] = float(np.clip(value, parameter.lower, parameter.upper))
    options = ChainOptions(**SHORT)  # type: ignore[arg-type]
    chain = chain_of(
        ControllerDesign("damper", structure, gains, sample_time=2e-4), runout_maps=MAPS["harmonics"], options=options
    )
    expected = PythonChain(chain).run(SAMPLES[:1200])
    assert CompiledChain(chain).run(SAMPLES[:1200]) == expected
    assert max(abs(y.reference[0]) for y in expected) > 0
    assert any(term.kind == "d" for terms in chain.states for term in terms)


@pytest.mark.parametrize("number", ["double", "float"])
@pytest.mark.parametrize("method", ["harmonics", "bins"])
def test_an_encoder_may_count_turns(number: str, method: str) -> None:
    """Ten turns on, a table over the angle was off by 261 um; 1e6 rad ended in a fault; a float lost the angle."""
    given, options = runout_map(method), ChainOptions(number=number, spike_limit_m=None)  # type: ignore[arg-type]
    chain = chain_of(design("P"), runout_maps=(given,), options=options)
    angle = np.linspace(0.1, 6.1, 25)
    if method == "bins":
        value = np.stack([np.interp(angle, given.angles, column, period=2 * np.pi) for column in given.table.T], axis=1)
    else:
        waves = np.outer(angle, given.orders)
        value = np.cos(waves) @ given.cosine + np.sin(waves) @ given.sine
    for turns in (0, 10, -10, 300_000, 10**9):  # 10^9 turns: 116 days at 6 000 rpm
        samples = [ChainInput((5e-6, 5e-6), phi + turns * 2 * np.pi, 6.0, 6000.0) for phi in angle]
        outputs = CompiledChain(chain).run(samples)
        assert not any(y.held or y.fault for y in outputs)
        error = 5e-6 - (given.mean + value) - [y.deviation for y in outputs]
        assert np.abs(error).max() < (2e-11 if turns == 10**9 or number == "float" else 1e-14)


def test_saturation_is_exact_too() -> None:
    chain = chain_of(design("P"), options=ChainOptions(ramp_s=0.01, fade_s=0.01, disc_limit_m=1e-3, spike_limit_m=None))
    samples = [ChainInput((40e-6 * np.sin(0.1 * k), 30e-6 * np.cos(0.07 * k))) for k in range(500)]
    expected = PythonChain(chain).run(samples)
    assert CompiledChain(chain).run(samples) == expected
    assert sum(each.saturated for each in expected) > 100
    assert max(abs(r) for each in expected for r in each.reference) == chain.options.limit_m


def test_the_state_is_as_large_as_the_header_says() -> None:
    for number, kind in (("double", "P"), ("float", "biquad"), ("double", "scheduled")):
        chain = chain_of(design(kind), options=ChainOptions(number=number))  # type: ignore[arg-type]
        compiled = CompiledChain(chain)
        assert f"State: {compiled.state_bytes} bytes." in render_source("chain.h.j2", chain, measured=())


def test_cosine_and_sine() -> None:
    angle = np.concatenate([np.linspace(-7, 7, 20001), np.random.default_rng(1).uniform(-1e6, 1e6, 20000)])
    cosine, sine = cos_sin(angle)
    assert np.abs(cosine - np.cos(angle)).max() < 2.5e-16
    assert np.abs(sine - np.sin(angle)).max() < 2.5e-16
    one = [cos_sin(angle[k : k + 1]) for k in range(0, 20001, 97)]
    assert all(c[0] == cosine[97 * i] and s[0] == sine[97 * i] for i, (c, s) in enumerate(one))


def test_a_map_is_the_sum_of_its_harmonics() -> None:
    phi = np.linspace(-7, 7, 300)
    each = runout_map()
    waves = np.outer(phi, each.orders)
    expected = each.mean + np.cos(waves) @ each.cosine + np.sin(waves) @ each.sine
    np.testing.assert_allclose(each.evaluate(phi), expected, rtol=0, atol=1e-20)
