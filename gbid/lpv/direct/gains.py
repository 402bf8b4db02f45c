"""Start values of disturbance gains for the direct LPV fit: a small fit for each recording with fixed surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray
from gbid.discretise import Hold
from gbid.identify.fit import fit
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.stability import CLEAR, near_instability
from gbid.identify.predictor import Focus, build_predictor
from gbid.lpv.direct.setting import Setting
from gbid.recording import Recording

_ITERATIONS = 40


@dataclass(frozen=True, eq=False)
class Gains:
    """Start values of disturbance gains, and the recordings in which they are fixed.

    Attributes
    ----------
    values : list of dict of str to float
        Values by name, for each recording.
    held : (n,) boolean array
        Whether the gains of each recording are fixed.
    notes : tuple of str
        Notes for the result.
    """

    values: list[dict[str, float]]
    held: BoolArray
    notes: tuple[str, ...] = ()


def own_gains(
    setting: Setting,
    recordings: Sequence[Recording],
    focus: Focus,
    hold: Hold | Sequence[Hold] | None,
    engine: EngineName,
) -> Gains:
    """Return the disturbance gains of each recording, fitted with all other parameters fixed at the start.

    When a record does not determine a gain, the gain makes the predictor almost unstable and blocks all other
    parameters. It is then fixed at zero.
    """
    nothing = dict.fromkeys(setting.gains, 0.0)
    if not setting.gains or focus == "simulation":
        return Gains([nothing for _ in recordings], np.zeros(len(recordings), dtype=bool))
    values, held = [], []
    for recording, structure, X in zip(recordings, setting.structures, setting.X, strict=True):
        names = [q.name for q in structure.parameters]
        if not set(setting.gains).intersection(names):
            values.append(nothing)
            held.append(False)
            continue
        known = {key: value for key, value in setting.held.items() if key in names}
        behaviour = structure.intersample if hold is None else hold
        predictor = build_predictor(structure, known, recording.sample_time, behaviour, focus)
        surface = dict(zip(setting.names, (X @ setting.start).tolist(), strict=True))
        own = fit(
            structure,
            recording,
            focus=focus,
            intersample=behaviour,
            fixed={**surface, **known},
            window=None,
            max_iterations=_ITERATIONS,
            engine=engine,
        )
        found = np.array([own.parameters[q.name] for q in predictor.free])
        told = own.success and not near_instability(predictor, found, CLEAR)
        found_gains = {name: own.parameters[name] for name in setting.gains if name in names}
        values.append({**nothing, **found_gains} if told else nothing)
        held.append(not told)
    names = [r.name for r, stays in zip(recordings, held, strict=True) if stays]
    note = f"disturbance gain fixed at zero in {len(names)} of {len(held)} recordings, which do not determine it: "
    return Gains(values, np.array(held), (note + ", ".join(names),) if names else ())
