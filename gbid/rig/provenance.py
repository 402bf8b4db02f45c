"""Provenance of a rig recording: how it was made, written as texts and read back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.recording import Recording
from gbid.rig.machine.controller import ProgramController, SampledController
from gbid.rig.machine.machine import Machine
from gbid.rig.machine.scatter import Scatter

Span = tuple[float, float]


def provenance_of(
    machine: Machine,
    experiment: Any,
    *,
    seed: int,
    how: str,
    oversampling: int,
    settle_s: float,
    controller: SampledController | ProgramController | None,
    scatter: Scatter | None,
    thrown: int,
    touched: Sequence[Span],
    saturated: Mapping[str, Sequence[Span]],
    constant: bool,
) -> dict[str, str]:
    """Return the texts that are stored with a recording; values are JSON."""
    effects = {"effects": {effect.name: asdict(effect) for effect in machine.effects}} if machine.effects else {}
    rig = {key: value for key, value in asdict(machine).items() if key != "effects"}
    texts = {
        "source": "gbid virtual rig",
        "seed": str(seed),
        "simulation": how,
        "experiment": as_json({type(experiment).__name__: asdict(experiment)}),
        "rig": as_json({"oversampling": oversampling, "settle_s": settle_s, **rig, **effects}),
    }
    if constant:  # along a course there is no one truth
        texts["truth"] = as_json(machine.rotor_bearing.key_parameters())
    if controller is not None:
        texts["controller"] = as_json(
            asdict(controller)
            if isinstance(controller, SampledController)
            else {"program": controller.name, "sample_time": controller.sample_time}
        )
    if scatter is not None:
        texts["scatter"] = as_json({**asdict(scatter), "draws_thrown_away": thrown})
    if touched:
        texts["touch_down"] = as_json(touched)
    if saturated:
        texts["saturated"] = as_json(saturated)
    return texts


def spans(time: FloatArray, inside: np.ndarray, sample_time: float) -> list[Span]:
    """Return the time intervals (first, end) [s] of consecutive samples that are marked as inside."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return [(float(time[a]), float(time[b - 1] + sample_time)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def touch_downs(recording: Recording) -> list[Span]:
    """Return the time intervals (first, end) [s] in which the disc touched the bearing; empty when it never did.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    return [(float(a), float(b)) for a, b in json.loads(recording.provenance.get("touch_down", "[]"))]


def saturations(recording: Recording) -> dict[str, list[Span]]:
    """Return the time intervals (first, end) [s] in which a stack was saturated, by the number of the stack.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    stored = json.loads(recording.provenance.get("saturated", "{}"))
    return {stack: [(float(a), float(b)) for a, b in times] for stack, times in stored.items()}


def drawn_truth(recording: Recording) -> dict[str, float]:
    """Return the fourteen true key parameters of a recording by name; empty when the recording does not store them.

    Parameters
    ----------
    recording : Recording
        Recording of the rig.
    """
    return {name: float(v) for name, v in json.loads(recording.provenance.get("truth", "{}")).items()}


def as_json(value: Any) -> str:
    """Return values and arrays as one line of JSON with sorted keys."""
    return json.dumps(value, default=lambda array: np.asarray(array).tolist(), sort_keys=True)
