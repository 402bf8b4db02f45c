"""A controller structure of one's own."""

from __future__ import annotations

import casadi as ca
import numpy as np

import gbid


def lead(p: dict[str, ca.SX]) -> dict[str, object]:
    pole = 2 * np.pi * 800.0
    eye = ca.SX.eye(2)
    return {"A": -pole * eye, "B": pole * eye, "C": -p["high"] * eye, "D": (p["low"] + p["high"]) * eye}


def own() -> gbid.LinearStructure:
    return gbid.LinearStructure(
        "lead", [gbid.Parameter("low", 1.0, 0, 3), gbid.Parameter("high", 0.5, -3, 3)], lead, "p", "r"
    )
