"""What closes the loop of impacts on the rig: sampled matrices, or the control chain in C as it is exported."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from gbid.experiment.experiment import Experiment
from gbid.experiment.stages.impact.plan import LoopController
from gbid.experiment.stages.target.plan import chain_options
from gbid.prefilter import identify_runout
from gbid.recording import Recording
from gbid.rig import Machine, ProgramController, SampledController, Stationary, record
from gbid.target import CompiledChain, chain_of

_ZEROING_S = 0.5
_HARMONICS = 5
_SHARE_OF_SETTLING = 0.2


def loop_settings(experiment: Experiment) -> dict[str, Any]:
    """Return the settings of the loop for content keys; empty for sampled matrices."""
    rig = experiment.spec.rig
    assert rig is not None
    return {} if rig.controller == "python" else {"compiled": asdict(chain_options(experiment))}


def loop_of(
    experiment: Experiment, controller: LoopController, machine: Machine, options: dict[str, Any]
) -> SampledController | ProgramController:
    """Return the controller of the rig for one recording.

    Sampled matrices get the zero position from a stationary run with the same shaft angle. The control chain gets the
    run-out map of this run, as on the machine; ramp and fade are shortened so that they end before the logger starts.

    Raises
    ------
    UsageError
        When there is no C compiler for the control chain.
    """
    rig = experiment.spec.rig
    assert rig is not None
    still = record(machine, Stationary(_ZEROING_S), **{**options, "faults": None})
    if rig.controller == "python":
        sampled = controller.sampled
        A, B, C, D = (np.array(m) for m in (sampled.A, sampled.B, sampled.C, sampled.D))
        zero = still.signal("p").mean(axis=0)
        return SampledController(A, B, C, D, rig.sample_time_s, offset=zero, name=sampled.name)
    return _compiled(experiment, controller, still, rig.settle_s)


def _compiled(
    experiment: Experiment, controller: LoopController, still: Recording, settle_s: float
) -> ProgramController:
    section = experiment.spec.prefilter
    harmonics = _HARMONICS if section is None or section.harmonics == "auto" else section.harmonics
    start_s = max(_SHARE_OF_SETTLING * settle_s, controller.design.sample_time)
    options = replace(chain_options(experiment), ramp_s=start_s, fade_s=start_s)
    runout_map = identify_runout([still], harmonics=harmonics)
    chain = chain_of(controller.design, name="chain", runout_maps=[runout_map], options=options)
    return ProgramController(CompiledChain(chain), chain.sample_time, f"{chain.title}, compiled")
