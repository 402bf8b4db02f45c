"""The chain on recorded runs: compiled and Python agree to the last bit on whatever the rig records."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from math import nan

import numpy as np
import pytest
from chain_cases import design

import gbid
from gbid.export.chain import Chain, ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain
from gbid.export.chain_python import ChainFault, ChainInput, PythonChain
from gbid.prefilter import RunoutMap
from gbid.recording import Recording
from gbid.rig import Faults, Hammer, Impact, Machine, Prbs, RunUp, Stationary, record

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
POINT = {"pressure_bar": 6.0, "speed_rpm": 3000.0}
RUNS = {
    "stationary": (Stationary(0.6), {}),
    "prbs": (Prbs(0.6), {}),
    "impact": (Hammer((Impact.along("x", 0.1), Impact.along("y", 0.35)), 0.6), {}),
    "run-up": (RunUp(600.0, 6000.0, 0.6), {}),
    "missed index": (Stationary(0.6), {"faults": Faults(missing_index=True)}),
    "spikes": (Prbs(0.6), {"faults": Faults(spikes_per_s=20.0)}),
}


@cache
def machine() -> Machine:
    model = gbid.load_model("theisen2016")
    return Machine.from_parameters(model.key_parameters(6.0, 3000.0), model.actuators)


@cache
def made_map() -> RunoutMap:
    still = record(machine(), Stationary(2.0), conditions=POINT, seed=3, name="still")
    return gbid.identify_runout([still], harmonics=6)


@cache
def run_of(what: str) -> Recording:
    experiment, options = RUNS[what]
    return record(machine(), experiment, conditions=POINT, seed=4, name="run", touch_down="flag", **options)


def samples_of(recording: Recording) -> list[ChainInput]:
    speed = 60 / (2 * np.pi) * np.gradient(np.unwrap(recording.signal("phi")[:, 0])) / recording.sample_time
    return [
        ChainInput((float(p[0]), float(p[1])), float(phi[0]), 6.0, float(s))
        for p, phi, s in zip(recording.signal("p"), recording.signal("phi"), speed, strict=True)
    ]


@cache
def without_runout(what: str) -> np.ndarray:
    online = gbid.OnlinePrefilter(made_map())
    return np.array([online.step(u.position, u.angle) for u in samples_of(run_of(what))])


def chain(kind: str, **options: object) -> Chain:
    settings = ChainOptions(ramp_s=0.01, fade_s=0.01, **options)  # type: ignore[arg-type]
    return chain_of(design(kind), runout_maps=[made_map()], options=settings)


@pytest.mark.parametrize("kind", ["P", "scheduled"])
@pytest.mark.parametrize("what", RUNS)
def test_compiled_is_python_on_a_recorded_run(what: str, kind: str) -> None:
    samples = samples_of(run_of(what))
    plan = chain(kind, disc_limit_m=30e-6)
    expected = PythonChain(plan).run(samples)
    assert CompiledChain(plan).run(samples) == expected
    e = without_runout(what)
    found = np.array([y.deviation for y in expected])
    assert not any(y.fault for y in expected)
    if what in ("stationary", "run-up", "missed index"):
        np.testing.assert_array_equal(found, e)
    if what == "spikes":
        assert np.abs(e - found).max() > 10e-6
        assert np.abs(np.diff(found, axis=0)).max() < 8e-6
    rms = found.std(axis=0)
    if what == "stationary":
        np.testing.assert_allclose(rms, 30e-9, rtol=0.1)  # the noise of the probes is left
    if what == "missed index":
        assert (rms > 1e-6).all()  # the map adds run-out: seen before the loop is closed


def test_a_number_that_is_none_and_saturation() -> None:
    samples = samples_of(run_of("prbs"))
    samples[1000] = replace(samples[1000], position=(nan, samples[1000].position[1]))
    for k in range(2000, 2003):
        samples[k] = replace(samples[k], angle=nan)
    grown = [replace(u, position=(4 * u.position[0], 4 * u.position[1])) for u in samples]
    plan = chain("P", disc_limit_m=1.0, spike_limit_m=None)
    expected = PythonChain(plan).run(grown)
    assert CompiledChain(plan).run(grown) == expected
    assert [k for k, y in enumerate(expected) if y.held] == [1000, 2000, 2001, 2002]
    assert sum(y.saturated for y in expected) > 20
    assert {y.fault for y in expected} == {ChainFault.NONE}
    assert np.isfinite([y.stack for y in expected]).all()
