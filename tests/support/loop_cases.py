"""The published machine, the controller of the paper, and loops without dynamics."""

from __future__ import annotations

import numpy as np

import gbid
from gbid.control import p_controller
from gbid.structure import LinearModel

MACHINE = gbid.load_model("theisen2016")
PAPER = p_controller(1.125, 0.99)


def static(D: object) -> LinearModel:
    D = np.atleast_2d(np.asarray(D, float))
    n_r, n_p = D.shape
    return LinearModel(np.zeros((0, 0)), np.zeros((0, n_p)), np.zeros((n_r, 0)), D)
