"""Comparison with the paper, row by row: its figures, ours, the deviation, and the reason of a large one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from math import isfinite, nan
from typing import Any, Literal

import numpy as np

from gbid.control import GainResult, close_loop, sensitivities, tune
from gbid.errors import DataError, GbidError
from gbid.lpv import CHARACTERISTICS, characteristics
from gbid.report.paper.numbers import PaperNumber, paper_numbers
from gbid.report.reader import Results
from gbid.report.reader.published import POINT, published_controller
from gbid.structure import KEY_PARAMETERS
from gbid.tables.numbers import finite_or_none

Verdict = Literal["within", "explained", "off", "missing"]
Own = tuple[float, float]
"""Value and its standard deviation, nan without one."""
_SCALE = {"um": 1e6, "ms": 1e3}
_PAIRS = ("xx", "xy", "yx", "yy")


@dataclass(frozen=True)
class ReproductionRow:
    """Comparison of one figure of the paper with ours.

    Attributes
    ----------
    number : PaperNumber
        Figure of the paper.
    ours, std : float
        Our value and its standard deviation; nan without one.
    verdict : {"within", "explained", "off", "missing"}
        ``within``: the deviation is within the scatter of the paper. ``explained`` and ``off``: it is larger, with or
        without explanation. ``missing``: there is no value of ours.
    why : str
        Explanation, or what is missing.
    """

    number: PaperNumber
    ours: float
    std: float
    verdict: Verdict
    why: str = ""

    @property
    def deviation(self) -> float:
        """Our value minus that of the paper."""
        return self.ours - self.number.value

    def document(self) -> dict[str, Any]:
        """Return plain values; None for missing ones."""
        n = self.number
        return {
            "id": n.id,
            "where": n.where,
            "quantity": n.quantity,
            "unit": n.unit,
            "paper": n.value,
            "ours": finite_or_none(self.ours),
            "ours_std": finite_or_none(self.std),
            "deviation": finite_or_none(self.deviation),
            "deviation_percent": finite_or_none(100 * self.deviation / n.value) if n.value else None,
            "scatter": n.scatter,
            "scatter_from": n.scatter_from,
            "at_most": n.at_most,
            "verdict": self.verdict,
            "why": self.why,
        }


def reproduction(results: Results) -> list[ReproductionRow]:
    """Return the comparison of an experiment with the paper.

    Parameters
    ----------
    results : Results
        Results for the machine of the paper.

    Returns
    -------
    list of ReproductionRow
        Rows in the order of the paper.

    Raises
    ------
    DataError
        When the machine is another.
    """
    if not results.published:
        raise DataError("the paper's figures are for its own machine: an experiment with rig: {model: theisen2016}")
    own = dict(_values())
    rows = []
    for number in paper_numbers():
        try:
            ours, std = own[number.id](results)
        except GbidError as error:
            rows.append(ReproductionRow(number, nan, nan, "missing", str(error)))
            continue
        scale = _SCALE.get(number.unit, 1.0)
        rows.append(judged(number, scale * ours, scale * std))
    return rows


def judged(number: PaperNumber, ours: float, std: float = nan) -> ReproductionRow:
    """Return the row of a value; its verdict allows the scatter of the paper plus up to two own standard deviations."""
    if not isfinite(ours):
        return ReproductionRow(number, ours, std, "missing", "not a finite number")
    over = ours - number.value if number.at_most else abs(ours - number.value)
    allowed = (number.scatter or 0.0) + (2 * std if isfinite(std) else 0.0)
    if over <= allowed + 1e-12 * abs(number.value):
        return ReproductionRow(number, ours, std, "within")
    return ReproductionRow(number, ours, std, "explained" if number.off else "off", number.off)


def _values() -> Iterator[tuple[str, Callable[[Results], Own]]]:
    """Yield for each id the function that returns our value in SI units (percents as such)."""
    for k, pair in enumerate(_PAIRS):
        yield f"static_rms_{pair}", partial(_static_rms, k)
    yield "static_largest", _static_largest
    yield "recordings", _models
    for name in ("p1_x", "p2_x", "p1_y", "p2_y", "kappa_x", "kappa_y"):
        yield f"actuator_{name}", partial(_actuator, name)
    for word, structure in (("bearing", "rotor_bearing"), ("actuator", "piezo_pair")):
        for j, axis in enumerate("xy"):
            for what in ("mean", "std"):
                yield f"{word}_{what}_{axis}", partial(_crossval, structure, what, j)
    for j, name in enumerate(CHARACTERISTICS):
        yield f"rms_{name}", partial(_rms, j)
        yield f"surface_{name}", partial(_off_published, j)
    yield "largest_gain", _largest_gain
    for loop in ("open", "closed"):
        for i in (1, 2):
            for j, what in enumerate(("frequency", "damping")):
                yield f"expected_{loop}_{what}_{i}", partial(_expected, loop, i - 1, j)
                yield f"obtained_{loop}_{what}_{i}", partial(_obtained, loop, i - 1, what)
    for i in (1, 2):
        yield f"damping_factor_{i}", partial(_damping_factor, i - 1)
    for loop in ("open", "closed"):
        for i in (1, 2):
            for j, what in enumerate(("frequency", "damping")):
                yield f"model_{loop}_{what}_{i}", partial(_published_mode, loop, i - 1, j)
    for i in (1, 2):
        yield f"model_damping_factor_{i}", partial(_published_factor, i - 1)
    tuned = lru_cache(maxsize=1)(_retuned)  # one search for all three rows
    yield "tuned_damping", lambda results: (tuned(results).value, nan)
    for axis in "xy":
        yield f"tuned_kappa_{axis}", partial(_retuned_gain, tuned, f"kappa_{axis}")
    yield "hysteresis", _hysteresis


def _static_rms(k: int, results: Results) -> Own:
    return float(results.static_map.rms.flat[k]), nan


def _static_largest(results: Results) -> Own:
    return float(np.nanmax(results.static_map.largest)), nan


def _models(results: Results) -> Own:
    """Return the number of recordings whose fits determine the surfaces."""
    return float(len(results.surface_fit.estimates.recordings)), nan


def _actuator(name: str, results: Results) -> Own:
    return results.nominal.parameters[name], results.nominal.std[name]


def _crossval(structure: str, what: Literal["mean", "std"], j: int, results: Results) -> Own:
    summary = results.summary(structure)
    return float((summary.mean if what == "mean" else summary.std)[j]), nan


def _rms(j: int, results: Results) -> Own:
    return results.surface_fit.deviations[j].rms, nan


def _largest_gain(results: Results) -> Own:
    return max(d.largest for d in results.surface_fit.deviations if d.name.startswith("g_")), nan


def _off_published(j: int, results: Results) -> Own:
    """Return the rms over the operating points of a characteristic of our surfaces minus that of the published ones."""
    points = np.array(results.machine.operating_points, float)
    ours, published = (
        characteristics(np.column_stack([np.broadcast_to(p[key], len(points)) for key in KEY_PARAMETERS]))
        for p in (
            model.key_parameters(points[:, 0], points[:, 1]) for model in (results.surface_fit.model, results.machine)
        )
    )
    return float(np.sqrt(np.mean((ours[:, j] - published[:, j]) ** 2))), nan


def _expected(loop: str, i: int, j: int, results: Results) -> Own:
    return results.impacts_at(False)[loop].expected[i][j], nan


def _obtained(loop: str, i: int, what: str, results: Results) -> Own:
    ring = results.impacts_at(False)[loop].ringdown
    value, std = (ring.frequency_hz, ring.frequency_std) if what == "frequency" else (ring.damping, ring.damping_std)
    return float(value[i]), float(std[i])


def _damping_factor(i: int, results: Results) -> Own:
    """Return the factor by which the controller increases a damping factor."""
    return _expected("closed", i, 1, results)[0] / _expected("open", i, 1, results)[0], nan


def _published_mode(loop: str, i: int, j: int, results: Results) -> Own:
    """Return frequency or damping factor of a mode of the published model, with or without its controller."""
    plant = results.machine.plant_at(*POINT)
    return (close_loop(plant, published_controller(results.machine)) if loop == "closed" else plant).modes()[i][j], nan


def _published_factor(i: int, results: Results) -> Own:
    return _published_mode("closed", i, 1, results)[0] / _published_mode("open", i, 1, results)[0], nan


def _retuned(results: Results) -> GainResult:
    """Return gains tuned on the published model at the point of the paper, with the peak of S_o of its own gains."""
    machine = results.machine
    cap = sensitivities(machine.plant_at(*POINT), published_controller(machine)).peak("output").value
    return tune(machine, operating_points=[POINT], peak_sensitivity=cap)


def _retuned_gain(tuned: Callable[[Results], GainResult], name: str, results: Results) -> Own:
    return tuned(results).gains[name], nan


def _hysteresis(results: Results) -> Own:
    for curve, *_ in results.piezos:
        if curve.units[0] == "V":
            return curve.hysteresis, curve.hysteresis_std
    raise DataError("no piezo was characterised in open loop; add one to section 'static'")


def counts(rows: list[ReproductionRow]) -> Mapping[str, int]:
    """Return the number of rows by verdict."""
    return {
        verdict: sum(row.verdict == verdict for row in rows) for verdict in ("within", "explained", "off", "missing")
    }
