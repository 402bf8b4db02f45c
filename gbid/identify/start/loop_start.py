"""Data of the plant within a closed loop, for start values: what the controller did is known from what it measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gbid.arrays import FloatArray
from gbid.identify.data import FitData, Record
from gbid.structure import ClosedLoop


def plant_data(loop: ClosedLoop, data: FitData, gains: Mapping[str, float]) -> FitData:
    """Return the data of a loop with the inputs of its plant in place of what was injected.

    Parameters
    ----------
    loop : ClosedLoop
        The loop.
    data : FitData
        What was injected, and what was recorded.
    gains : dict of str to float
        Gains of a controller that is a structure, under their names in the loop.
    """
    return replace(data, records=tuple(_of_plant(loop, record, data.sample_time, gains) for record in data.records))


def _of_plant(loop: ClosedLoop, record: Record, sample_time: float, gains: Mapping[str, float]) -> Record:
    controller = loop.controller_model(gains)
    heard = record.outputs[:, list(loop.measured)]
    w = record.inputs if record.inputs.size else np.zeros((record.n_samples, 1))
    if loop.injected == "set point":
        heard = heard - w
    own: FloatArray = controller.simulate(heard, sample_time, intersample="foh" if controller.dt is None else "zoh")
    return replace(record, inputs=own if loop.injected == "set point" else own + w)
