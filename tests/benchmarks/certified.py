"""Certified cases of NIST (StRD, nonlinear regression) that are free decays of lags and oscillators."""

import json
from functools import partial
from math import log10, pi

import casadi as ca
import numpy as np

import gbid
from tests.benchmarks.running import DOCS


def decays(amplitudes, rates, first):
    """Lags in parallel from their values at the first sample; a rate of zero is a constant."""
    begin = [a * ca.exp(-rate * first) for a, rate in zip(amplitudes, rates, strict=True)]
    return {"A": -ca.diag(ca.vertcat(*rates)), "C": ca.SX.ones(1, len(rates)), "x0": begin}


def oscillators(p, first):
    """ENSO: a constant and three oscillators without damping, of a year and of two unknown periods in months."""
    A, begin = ca.SX(7, 7), [p.b1]
    for i, (cos, sin, period) in enumerate([(p.b2, p.b3, 12), (p.b5, p.b6, p.b4), (p.b8, p.b9, p.b7)]):
        w = 2 * pi / period
        A[2 * i + 1, 2 * i + 2], A[2 * i + 2, 2 * i + 1] = w, -w
        c, s = ca.cos(w * first), ca.sin(w * first)
        begin += [cos * c + sin * s, sin * c - cos * s]
    return {"A": A, "C": [1, *[1, 0] * 3], "x0": begin}


def saturation(p, first):
    return decays([p.b1, -p.b1], [0, p.b2], first)


CASES = {
    "Misra1a": saturation,
    "BoxBOD": saturation,
    "Lanczos3": lambda p, first: decays([p.b1, p.b3, p.b5], [p.b2, p.b4, p.b6], first),
    "MGH17": lambda p, first: decays([p.b1, p.b2, p.b3], [0, p.b4, p.b5], first),
    "ENSO": oscillators,
}


def table():
    """Digits, distance in standard deviations, and ratio of standard deviations, as text of Markdown."""
    certified = json.loads((DOCS / "certified.json").read_text(encoding="utf-8"))
    rows = [
        "| case | samples | parameters | digits, least | off [std] | std over certified |",
        "|---|---|---|---|---|---|",
    ]
    for name, equations in CASES.items():
        values, (x, y) = certified[name]["parameters"], np.array(certified[name]["data"]).T
        start = [gbid.Parameter(key, begin) for key, (begin, _, _) in values.items()]
        structure = gbid.LinearStructure(name, start, partial(equations, first=x[0]), inputs=())
        recording = gbid.Recording({"y": y}, stamps=x, name=name)
        result = gbid.fit(structure, recording, focus="simulation", max_iterations=300)
        off = {key: abs(result.parameters[key] - value) for key, (_, value, _) in values.items()}
        digits = min(-log10(off[key] / abs(value)) for key, (_, value, _) in values.items())
        away = max(off[key] / std for key, (_, _, std) in values.items())
        ratio = [result.std[key] / std for key, (_, _, std) in values.items()]
        assert result.success, name
        assert away < 1e-3, name
        assert np.allclose(ratio, 1, atol=1e-3), name
        shown = f"{digits:.1f} | {away:.0e} | {min(ratio):.4f} to {max(ratio):.4f}"
        rows.append(f"| {name} | {len(x)} | {len(values)} | {shown} |")
    return "\n".join(rows)
