"""Disturbance gains to start the direct LPV fit from: a small fit for each recording with the surfaces held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray
from gbid.discretise import Hold
from gbid.identify.fit import fit
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.shooting import spectral_radius
from gbid.identify.predictor import Focus, Predictor, build_predictor
from gbid.lpv.direct.setting import Setting
from gbid.recording import Recording
from gbid.structure import LinearModel

_ITERATIONS = 40
_CLEAR = 0.2  # of the model's own margin of stability


@dataclass(frozen=True, eq=False)
class Gains:
    """Where disturbance gains start, and which of them stay there.

    Attributes
    ----------
    values : list of dict of str to float
        For each recording.
    held : (n,) boolean array
    notes : tuple of str
    """

    values: list[dict[str, float]]
    held: BoolArray
    notes: tuple[str, ...] = ()


def own_gains(
    setting: Setting,
    recordings: Sequence[Recording],
    focus: Focus,
    hold: Hold | Sequence[Hold],
    engine: EngineName,
) -> Gains:
    """Fit each recording's disturbance gain with all else held at the start.

    One that a record cannot tell runs to the edge of an unstable predictor, where it would keep all others from
    moving: it is held at zero.
    """
    nothing = dict.fromkeys(setting.gains, 0.0)
    if not setting.gains or focus == "simulation":
        return Gains([nothing for _ in recordings], np.zeros(len(recordings), dtype=bool))
    predictor = build_predictor(setting.structure, setting.held, recordings[0].sample_time, hold, focus)
    values, held = [], []
    for recording, X in zip(recordings, setting.X, strict=True):
        surface = dict(zip(setting.names, (X @ setting.start).tolist(), strict=True))
        own = fit(
            setting.structure,
            recording,
            focus=focus,
            intersample=hold,
            fixed={**surface, **setting.held},
            window=None,
            max_iterations=_ITERATIONS,
            engine=engine,
        )
        told = own.success and _well_inside(predictor, own.parameters, own.model)
        values.append({name: own.parameters[name] for name in setting.gains} if told else nothing)
        held.append(not told)
    names = [r.name for r, stays in zip(recordings, held, strict=True) if stays]
    note = f"disturbance gain held at zero in {len(names)} of {len(held)} recordings, which cannot tell it: "
    return Gains(values, np.array(held), (note + ", ".join(names),) if names else ())


def _well_inside(predictor: Predictor, parameters: Mapping[str, float], model: LinearModel) -> bool:
    """Whether a predictor keeps clear of instability by a good part of the model's own margin."""
    values = predictor.at(np.array([parameters[q.name] for q in predictor.free]))
    own = 1 - float(np.exp(predictor.sample_time * model.poles().real.max()))
    return 1 - spectral_radius([values]) > _CLEAR * own
