"""Theisen et al. (2016): its figures and sentences (`theisen2016_numbers.yaml`), our values, and checked explanations.

`theisen2016_paper.py` shows and stores what this file compares.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import hypot, inf, isfinite, nan, sqrt
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import stats
from theisen2016_checks import CHECKS
from theisen2016_figures import POINT, PaperResults, published_controller
from theisen2016_impacts import LOOPS, recorded_again, ringing_without_noise, without_noise

import gbid
from gbid.control import GainResult, close_loop, p_controller, sample_controller, sensitivities, tune
from gbid.control.impact.study import ringing_modes
from gbid.control.loop.sampled import exact_plant
from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, GbidError, UsageError
from gbid.core.tables import finite_or_none
from gbid.core.yaml_file import read_yaml
from gbid.experiment.controllers import sample_time
from gbid.experiment.fields import needed
from gbid.experiment.machine import rig_run
from gbid.lpv import LPVFit, LPVModel, characteristics, fit_lpv, load_machine
from gbid.lpv.model import CHARACTERISTICS, PUBLISHED_RMS
from gbid.rig import Prbs, record
from gbid.structure import KEY_PARAMETERS, LinearModel

FILE = Path(__file__).with_name("theisen2016_numbers.yaml")
Kind = Literal["set", "found again", "independent"]
KIND_WORDS: dict[Kind, str] = {
    "independent": "independent",
    "found again": "the rig's own truth found again",
    "set": "set by the rig",
}
_MOST = 0.25
"""Largest share of a figure of the paper by which ours may lie off it."""


@dataclass(frozen=True)
class PaperNumber:
    """One figure of the paper, or one that the paper's model implies.

    Attributes
    ----------
    id : str
        Identifier.
    where : str
        Section, table or figure.
    quantity, unit : str
        Quantity and its unit.
    kind : {"set", "found again", "independent"}
        What decides our value: a setting of the rig, the truth of the rig, or neither.
    value : float or None
        Value in the paper; None where it gives none.
    scatter : float or None
        Scatter of the value by the paper's own account; None when it gives none.
    scatter_from : str
        Source of the scatter.
    samples : float or None
        Number of values behind the figure. For a mean, `scatter` is then the standard deviation of these values. For a
        standard deviation or an rms no scatter is needed.
    off : str
        Name of a setting of ours or of an explanation that may account for a deviation.
    why : str
        Its words.
    accounts : {"ours", "explained"}
        Verdict when it does: ``ours`` for a setting, ``explained`` when other code links the paper's figure with ours.
    """

    id: str
    where: str
    quantity: str
    unit: str
    kind: Kind
    value: float | None = None
    scatter: float | None = None
    scatter_from: str = ""
    samples: float | None = None
    off: str = ""
    why: str = ""
    accounts: Literal["ours", "explained"] = "ours"

    @property
    def allowed(self) -> float | None:
        """How far a value may lie off, at most 25 %: the scatter; for means and sizes of scatter two std errors."""
        if self.value is None:
            return self.scatter
        if self.samples is None:
            return None if self.scatter is None else min(self.scatter, self.most)
        if self.scatter is None:  # of a standard deviation: s / sqrt(2 (n - 1))
            return min(2 * self.value / sqrt(2 * (self.samples - 1)), self.most)
        return min(2 * self.scatter / sqrt(self.samples), self.most)

    @property
    def most(self) -> float:
        """Largest deviation that any scatter excuses; without a figure of the paper there is no bound."""
        return inf if self.value is None else _MOST * abs(self.value)


def paper_numbers(path: Path = FILE) -> tuple[PaperNumber, ...]:
    """Return the figures of the paper.

    Raises
    ------
    UsageError
        When the file is faulty: a key is unknown, an explanation or a kind is missing, or an id occurs twice.
    """
    file = read_yaml(path)
    settings: Mapping[str, str] = file.data.get("settings", {})
    accounts: Mapping[str, str] = {**settings, **file.data["explanations"]}
    known, found = _elsewhere(), dict[str, PaperNumber]()
    for i, row in enumerate(file.data["numbers"]):
        where = file.position(("numbers", i))
        off = row.get("off", "")
        if off and off not in accounts:
            raise UsageError(f"{where}: off: no setting or explanation {off!r}; there is {', '.join(accounts)}")
        row = {"value": known.get(row["id"]), **row}
        row["scatter"] = known.get(str(row.get("scatter")), row.get("scatter"))
        try:
            why = " ".join(str(accounts[off]).split()) if off else ""
            number = PaperNumber(**row, why=why, accounts="explained" if off and off not in settings else "ours")
        except TypeError as error:
            raise UsageError(f"{where}: {error}") from None
        if number.kind not in KIND_WORDS:
            raise UsageError(f"{where}: kind = {number.kind!r}; choose {', '.join(KIND_WORDS)}")
        if number.id in found:
            raise UsageError(f"{where}: id {number.id!r} occurs twice; remove one")
        found[number.id] = number
    return tuple(found.values())


def _elsewhere() -> dict[str, float]:
    """Return the figures that stand in the model file or in `PUBLISHED_RMS`, by id, in the unit of the row."""
    machine = load_machine("theisen2016")
    controller = machine.controller
    assert controller is not None
    found = {f"actuator_{name}": value for name, value in machine.model.actuators.items()}
    found |= {f"tuned_kappa_{axis}": getattr(controller, f"kappa_{axis}") for axis in "xy"}
    found |= {f"rms_{name}": (1e3 if "tau" in name else 1.0) * rms for name, rms in PUBLISHED_RMS.items()}
    found["largest_gain"] = 0.016  # Sec. 4: largest deviation of a static gain from its surface [m/m]
    for modes in machine.reference_modes:
        for word in {"expected": ("expected", "model"), "measured": ("obtained",)}.get(modes.kind, ()):
            for i, (frequency, damping) in enumerate(modes.modes, 1):
                found |= {f"{word}_{modes.loop}_frequency_{i}": frequency, f"{word}_{modes.loop}_damping_{i}": damping}
    return found


# ---- Our value of each figure, with its standard deviation.

Own = tuple[float, float]
"""Value and its standard deviation, nan without one."""
_SCALE = {"um": 1e6, "ms": 1e3}
_PAIRS = ("xx", "xy", "yx", "yy")
_ACTUATORS = ("p1_x", "p2_x", "p1_y", "p2_y", "kappa_x", "kappa_y")
_DRAWS = 200
"""Models drawn for a standard deviation, which they give to 5 %."""
_CAP = 2.6
"""Largest peak of S_o of the controllers that are tuned for each reading of a coefficient, as in the experiment."""


def _values() -> Iterator[tuple[str, Callable[[PaperResults], Own]]]:
    """Yield for each id the function that returns our value in SI units (percents as such)."""
    for k, pair in enumerate(_PAIRS):
        yield f"static_rms_{pair}", partial(_static_rms, k)
    yield "static_largest", _static_largest
    yield "recordings", _models
    for name in _ACTUATORS:
        yield f"actuator_{name}", partial(_actuator, name)
    for word, structure in (("bearing", "rotor_bearing"), ("actuator", "piezo_pair")):
        for j, axis in enumerate("xy"):
            for what in ("mean", "std"):
                yield f"{word}_{what}_{axis}", partial(_crossval, structure, what, j)
    for j, name in enumerate(CHARACTERISTICS):
        yield f"rms_{name}", partial(_rms, j)
        yield f"surface_{name}", partial(_off_published, j)
    yield "largest_gain", _largest_gain
    for loop in LOOPS:
        for i in (1, 2):
            for j, what in enumerate(("frequency", "damping")):
                yield f"expected_{loop}_{what}_{i}", partial(_expected, loop, i - 1, j)
                yield f"obtained_{loop}_{what}_{i}", partial(_obtained, loop, i - 1, j)
                yield f"model_{loop}_{what}_{i}", partial(_published_mode, loop, i - 1, j)
    for i in (1, 2):
        yield f"damping_factor_{i}", partial(_damping_factor, i - 1)
        yield f"model_damping_factor_{i}", partial(_published_factor, i - 1)
    yield "tuned_damping", lambda results: (_retuned(results).value, nan)
    for axis in "xy":
        yield f"tuned_kappa_{axis}", partial(_retuned_gain, f"kappa_{axis}")
    yield "hysteresis", _hysteresis


def _static_rms(k: int, results: PaperResults) -> Own:
    return float(results.static_map.rms.flat[k]), nan


def _static_largest(results: PaperResults) -> Own:
    return float(np.nanmax(results.static_map.largest)), nan


def _models(results: PaperResults) -> Own:
    """Return the number of recordings whose fits determine the surfaces."""
    return float(len(results.surface_fit.estimates.recordings)), nan


def _actuator(name: str, results: PaperResults) -> Own:
    """Return a parameter of the nominal actuator, and its standard deviation between recordings: it is one of them."""
    nominal = results.nominal
    return nominal.parameters[name], float(nominal.values[:, nominal.parameter_names.index(name)].std(ddof=1))


def _crossval(structure: str, what: Literal["mean", "std"], j: int, results: PaperResults) -> Own:
    """Return mean or standard deviation of the fit percent; pairs of one recording count as one value."""
    summary = results.summary(structure)
    std, n = float(summary.std[j]), summary.n_recordings
    return (float(summary.mean[j]), std / sqrt(n)) if what == "mean" else (std, std / sqrt(2 * (n - 1)))


def _rms(j: int, results: PaperResults) -> Own:
    rms = results.surface_fit.deviations[j].rms
    return rms, rms / sqrt(2 * _left_over(results))


def _left_over(results: PaperResults) -> int:
    """Return the number of recordings less the number of terms of a surface."""
    return len(results.surface_fit.estimates.recordings) - int(results.surface_fit.coefficients.shape[1])


def _largest_gain(results: PaperResults) -> Own:
    return max(d.largest for d in results.surface_fit.deviations if d.name.startswith("g_")), nan


def _of_points(model: LPVModel, points: FloatArray) -> FloatArray:
    """Return the characteristics of a model at operating points, shape (n, 10)."""
    keys = model.key_parameters(points[:, 0], points[:, 1])
    return characteristics(np.column_stack([np.broadcast_to(keys[key], len(points)) for key in KEY_PARAMETERS]))


def _points(results: PaperResults) -> FloatArray:
    return np.array(results.machine.operating_points, float)


def _off_published(j: int, results: PaperResults) -> Own:
    """Return the rms over the operating points of a characteristic of our surfaces minus that of the published ones."""
    ours, published = (_of_points(q, _points(results)) for q in (results.surface_fit.model, results.machine))
    return float(np.sqrt(np.mean((ours[:, j] - published[:, j]) ** 2))), nan


def _expected(loop: str, i: int, j: int, results: PaperResults) -> Own:
    return results.impacts_at(False)[loop].expected[i][j], float(_drawn(results)[loop][i, j])


def _obtained(loop: str, i: int, j: int, results: PaperResults) -> Own:
    """Return a mode from the ring-downs, with its standard deviation between impacts that are recorded again."""
    between = recorded_again(results, loop).std(axis=0, ddof=1)
    return float(_ringing(results, loop)[i, j]), float(between[i, j])


def _ringing(results: PaperResults, loop: str) -> FloatArray:
    """Return frequency [Hz] and damping factor of both modes, (2, 2), from the ring-downs of the run."""
    return np.array(results.impacts_at(False)[loop].ringdown.modes())


def _damping_factor(i: int, results: PaperResults) -> Own:
    """Return the factor by which the controller increases a damping factor."""
    (closed, closed_std), (opened, opened_std) = (_expected(loop, i, 1, results) for loop in ("closed", "open"))
    return closed / opened, closed / opened * hypot(closed_std / closed, opened_std / opened)


def _published_mode(loop: str, i: int, j: int, results: PaperResults) -> Own:
    """Return frequency or damping factor of a mode of the published model, with or without its controller."""
    return _modes(results.machine, results)[loop][i, j], nan


def _published_factor(i: int, results: PaperResults) -> Own:
    return _published_mode("closed", i, 1, results)[0] / _published_mode("open", i, 1, results)[0], nan


@lru_cache(maxsize=4)
def _retuned(results: PaperResults) -> GainResult:
    """Return gains tuned on the published model at the point of the paper, with the peak of S_o of its own gains."""
    machine = results.machine
    cap = sensitivities(machine.plant_at(*POINT), published_controller(results.published_machine)).peak("output").value
    return tune(machine, operating_points=[POINT], peak_sensitivity=cap)


def _retuned_gain(name: str, results: PaperResults) -> Own:
    return _retuned(results).gains[name], nan


def _hysteresis(results: PaperResults) -> Own:
    for curve, *_ in results.piezos:
        if curve.units[0] == "V":
            return curve.hysteresis, curve.hysteresis_std
    raise DataError("no piezo was characterised in open loop; add one to section 'static'")


# ---- Modes of loops: of the paper's continuous one, and of the rig's sampled one.


def _modes(model: LPVModel, results: PaperResults) -> dict[str, FloatArray]:
    """Return frequency [Hz] and damping factor of two modes, (2, 2), of the continuous loops of the paper."""
    plant = model.plant_at(*POINT)
    closed = close_loop(plant, published_controller(results.published_machine))
    return {"open": np.array(ringing_modes(plant)), "closed": np.array(ringing_modes(closed))}


def _running(model: LPVModel, results: PaperResults, computation_s: float | None = None) -> dict[str, FloatArray]:
    """Return the same of the loops with exact delays and the sampled controller; one sample of computation if None."""
    plant, rate = exact_plant(model, *POINT), sample_time(results.experiment)
    sampled = sample_controller(published_controller(results.published_machine), rate)
    closed = ringing_modes(plant, sampled, computation_s=computation_s)
    return {"open": np.array(ringing_modes(model.plant_at(*POINT))), "closed": np.array(closed)}


@lru_cache(maxsize=4)
def _drawn(results: PaperResults) -> dict[str, FloatArray]:
    """Return standard deviations of modes, (2, 2), over models drawn with the error of the surfaces."""
    models = results.surface_fit.draw(_DRAWS, seed=1)
    loops = [_modes(replace(q, actuators=results.identified.actuators), results) for q in models]
    return {loop: np.std([modes[loop] for modes in loops], axis=0, ddof=1) for loop in LOOPS}


# ---- What accounts for our values. Each computation predicts one, and its standard deviation, without that value.
# Those of the settings put what the rig was given through the rig; that of an explanation starts at the paper's figure.


def _of_plateaus(number: PaperNumber, results: PaperResults) -> Own:
    """Return the noise of the plateaus about a straight line; nothing else is left of a linear rig."""
    static = results.static_map
    shown = static.output_std[static.axis >= -1]
    if number.id == "static_largest":
        return _largest_of(float(np.sqrt(np.mean(shown**2, axis=0)).max()), shown.size)
    i, j = divmod([f"static_rms_{pair}" for pair in _PAIRS].index(number.id), 2)
    rows = static.output_std[(static.axis == j) | (static.axis == -1), i]
    predicted = float(np.sqrt(np.mean(rows**2)))
    return predicted, predicted / sqrt(2 * (len(rows) - 2))


def _largest_of(std: float, n: int) -> Own:
    """Return median and standard deviation of the largest of n absolute normal values."""
    low, middle, high = stats.norm.isf(0.5 * (1 - np.array([0.025, 0.5, 0.975]) ** (1 / n)))
    return float(std * middle), float(std * (high - low) / 4)


@lru_cache(maxsize=4)
def _quiet_actuators(results: PaperResults) -> dict[str, float]:
    """Return the actuator fitted to a recording of the rig's stacks without any noise."""
    planned = next(q for q in results.experiment.recordings.values() if q.excited)
    machine = without_noise(rig_run(results.experiment, planned)).machine
    section = results.experiment.spec.rig
    assert section is not None
    prbs = Prbs(2.0, section.prbs.amplitude_m, section.prbs.hold_s)
    quiet = record(machine, prbs, conditions=planned.conditions, seed=1, name="quiet stacks")
    return dict(gbid.fit(gbid.PiezoPair(), gbid.prefilter(quiet)[0]).parameters)


def _of_stacks(number: PaperNumber, results: PaperResults) -> Own:
    """Return the linear model of the nonlinear stacks, without noise."""
    name = number.id.removeprefix("actuator_")
    return _quiet_actuators(results)[name], _actuator(name, results)[1]


@lru_cache(maxsize=4)
def _std_of_fits(results: PaperResults) -> FloatArray:
    """Return the standard deviation of each characteristic of each fit, (n, 10), by its covariance."""
    estimates = results.surface_fit.estimates
    return np.array([_propagated(v, c) for v, c in zip(estimates.values, estimates.covariance, strict=True)])


def _propagated(values: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviations of the characteristics, (10,), from the covariance of the key parameters."""
    steps = 1e-3 * np.sqrt(np.diag(covariance))
    ends = [characteristics(values + sign * np.diag(steps)) for sign in (1.0, -1.0)]
    slopes = (ends[0] - ends[1]) / (2 * steps[:, None])
    return np.asarray(np.sqrt(np.einsum("ai,ab,bi->i", slopes, covariance, slopes)))


def _set_scatter(j: int, results: PaperResults) -> float:
    """Return the rms off a surface that the scatter of the rig and the errors of the fits make."""
    scatter = results.experiment.spec.rig.scatter if results.experiment.spec.rig else None
    if scatter is None:
        raise DataError("the rig has no scatter between recordings")
    drawn = (*scatter.delay_s, *scatter.frequency_hz, *scatter.damping, *scatter.static_gain)[j] * hypot(*scatter.sizes)
    n = len(results.surface_fit.estimates.recordings)
    return float(np.sqrt((drawn**2 + np.mean(_std_of_fits(results)[:, j] ** 2)) * _left_over(results) / n))


def _of_share(number: PaperNumber, results: PaperResults) -> Own:
    """Return the scatter that the rig draws with the errors of the fits."""
    if number.id == "largest_gain":
        gains = range(CHARACTERISTICS.index("g_xx"), len(CHARACTERISTICS))
        sizes = [_set_scatter(j, results) for j in gains]
        return _largest_of(max(sizes), sum(size > 0.9 * max(sizes) for size in sizes) * _left_over(results))
    predicted = _set_scatter(CHARACTERISTICS.index(number.id.removeprefix("rms_")), results)
    return predicted, predicted / sqrt(2 * _left_over(results))


def _of_surfaces(number: PaperNumber, results: PaperResults) -> Own:
    """Return the standard deviations that the surfaces state; six terms make about six independent errors."""
    stds = _std_of_surfaces(results)[:, CHARACTERISTICS.index(number.id.removeprefix("surface_"))]
    predicted = float(np.sqrt(np.mean(stds**2)))
    return predicted, predicted / sqrt(2 * results.surface_fit.coefficients.shape[1])


@lru_cache(maxsize=4)
def _std_of_surfaces(results: PaperResults) -> FloatArray:
    """Return the standard deviation of each characteristic of the surfaces at the operating points, (n, 10)."""
    points, fit = _points(results), results.surface_fit
    keys = fit.model.key_parameters(points[:, 0], points[:, 1])
    values = np.column_stack([np.broadcast_to(keys[key], len(points)) for key in KEY_PARAMETERS])
    return np.array([_propagated(v, c) for v, c in zip(values, fit.uncertainty_at(*points.T), strict=True)])


_EQUAL = 0.0005
"""Half of the last digit of a damping factor in Table 4."""


def _of_flat(_: PaperNumber, results: PaperResults) -> Own:
    """Return the gains whose damping is the best to its last printed digit, by eigenvalues on a grid under the cap."""
    plant, best = results.machine.plant_at(*POINT), _retuned(results)
    known = results.published_machine.controller
    assert known is not None
    cap = sensitivities(plant, published_controller(results.published_machine)).peak("output").value
    equal = []
    for gain in np.linspace(0.9, 1.1, 81) * known.kappa_x:
        law = p_controller(gain, best.gains["kappa_y"], known.lowpass_hz, known.lowpass_order)
        damping = min(zeta for _, zeta in close_loop(plant, law).modes())
        if damping > best.value - _EQUAL and sensitivities(plant, law).peak("output").value < cap * (1 + 1e-3):
            equal.append(gain)
    if not equal or not min(equal) <= known.kappa_x <= max(equal):
        return nan, nan
    return float(np.mean(equal)), (max(equal) - min(equal)) / 4


ACCOUNTS: dict[str, Callable[[PaperNumber, PaperResults], Own]] = {
    "plateaus": _of_plateaus,
    "stacks": _of_stacks,
    "share": _of_share,
    "surfaces": _of_surfaces,
    "flat": _of_flat,
}
"""Predictions of our values in SI units, by the name that `off` gives."""


# ---- The comparison.

Verdict = Literal["within", "explained", "ours", "open", "missing"]
VERDICTS: tuple[Verdict, ...] = ("within", "explained", "ours", "open", "missing")
_SAME = 0.02
"""Largest relative difference between our value and the same figure by other code."""


@dataclass(frozen=True)
class ReproductionRow:
    """Comparison of one figure of the paper with ours.

    Attributes
    ----------
    number : PaperNumber
        Figure of the paper.
    ours, std : float
        Our value and its standard deviation; nan without one.
    verdict : {"within", "explained", "ours", "open", "missing"}
        ``within``: the deviation is within the scatter of the paper and ours, and at most 25 %. ``explained``: it is
        not, and other code links the paper's figure with our value. ``ours``: it is not, or the paper gives no value,
        and a setting of ours predicts our value. ``open``: none of these, or other code gives another value for ours.
        ``missing``: there is no value of ours.
    why : str
        Setting or explanation that holds or fails, what other code gives, or what is missing.
    predicted, predicted_std : float
        Prediction of our value by the setting or explanation, and its standard deviation; nan without one.
    checked : float
        Our value by other code; nan where there is none.
    """

    number: PaperNumber
    ours: float
    std: float
    verdict: Verdict
    why: str = ""
    predicted: float = nan
    predicted_std: float = nan
    checked: float = nan

    @property
    def deviation(self) -> float:
        """Our value minus that of the paper; nan where the paper gives none."""
        return nan if self.number.value is None else self.ours - self.number.value

    def document(self) -> dict[str, Any]:
        """Return plain values; None for missing ones."""
        n = self.number
        return {
            "id": n.id,
            "where": n.where,
            "quantity": n.quantity,
            "unit": n.unit,
            "kind": n.kind,
            "paper": n.value,
            "ours": finite_or_none(self.ours),
            "ours_std": finite_or_none(self.std),
            "deviation": finite_or_none(self.deviation),
            "deviation_percent": finite_or_none(100 * self.deviation / n.value) if n.value else None,
            "allowed": n.allowed,
            "scatter_from": n.scatter_from,
            "verdict": self.verdict,
            "explanation": n.off if self.verdict in ("explained", "ours", "open") else "",
            "predicted": finite_or_none(self.predicted),
            "predicted_std": finite_or_none(self.predicted_std),
            "checked": finite_or_none(self.checked),
            "why": self.why,
        }


def reproduction(results: PaperResults) -> list[ReproductionRow]:
    """Return the comparison of an experiment with the paper.

    Parameters
    ----------
    results : PaperResults
        PaperResults for the machine of the paper.

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
    return [_compared(number, results) for number in paper_numbers()]


@lru_cache(maxsize=256)
def _compared(number: PaperNumber, results: PaperResults) -> ReproductionRow:
    """Return the row of a figure, with the check of its explanation where it is outside."""
    scale = _SCALE.get(number.unit, 1.0)
    try:
        ours, std = (scale * v for v in dict(_values())[number.id](results))
        row = judged(number, ours, std)
        if row.verdict == "open" and number.off:
            row = accounted(row, *(scale * v for v in ACCOUNTS[number.off](number, results)))
        if number.id in CHECKS and row.verdict != "missing":
            row = checked(row, scale * CHECKS[number.id](results))
    except GbidError as error:
        row = ReproductionRow(number, nan, nan, "missing", str(error))
    return row


def judged(number: PaperNumber, ours: float, std: float = nan) -> ReproductionRow:
    """Return the row of a value: within what the paper allows and two own standard deviations, or open."""
    if not isfinite(ours):
        return ReproductionRow(number, ours, std, "missing", "not a finite number")
    row = ReproductionRow(number, ours, std, "open")
    if number.value is None or number.allowed is None:
        return row
    allowed = min(hypot(number.allowed, 2 * std if isfinite(std) else 0.0), number.most)
    return replace(row, verdict="within") if abs(row.deviation) <= allowed + 1e-12 * abs(number.value) else row


def accounted(row: ReproductionRow, predicted: float, std: float) -> ReproductionRow:
    """Return a row with the prediction of its setting or explanation, which holds within two standard deviations.

    A prediction that is not finite is one that failed.
    """
    allowed = 2 * hypot(std, row.std if isfinite(row.std) else 0.0)
    verdict: Verdict = row.number.accounts if abs(row.ours - predicted) <= allowed else "open"
    return replace(row, verdict=verdict, why=row.number.why, predicted=predicted, predicted_std=std)


def checked(row: ReproductionRow, value: float) -> ReproductionRow:
    """Return a row with our value by other code; the row is open when the two differ by more than 2 %."""
    if abs(row.ours - value) <= _SAME * abs(value):
        return replace(row, checked=value)
    why = "Other code gives another value for ours (theisen2016_checks.py)."
    return replace(row, checked=value, verdict="open", why=why)


def headline(rows: Sequence[ReproductionRow]) -> list[str]:
    """Return what the comparison says, in three lines: formulas, gains, and what was measured."""

    def outside(start: str) -> str:
        of = [row for row in rows if row.number.id.startswith(start)]
        return f"{sum(row.verdict != 'within' for row in of)} of {len(of)}"

    explained = [row.number.quantity for row in rows if row.verdict == "explained"]
    return [
        f"Formulas: {outside('model_')} figures of the published model lie outside the paper's printed digits.",
        f"Gains tuned on that model under the paper's own peak of S_o: {outside('tuned_')} figures lie outside"
        + (f"; explained by other code: {', '.join(explained)}." if explained else "."),
        f"Measured on the rig: {outside('obtained_closed_')} figures of the closed loop lie outside, and "
        f"{outside('obtained_open_')} of the open loop.",
    ]


def counts(rows: Sequence[ReproductionRow]) -> dict[str, dict[str, int]]:
    """Return the number of rows by kind and verdict."""
    found = Counter((row.number.kind, row.verdict) for row in rows)
    return {kind: {verdict: found[kind, verdict] for verdict in VERDICTS} for kind in KIND_WORDS}


# ---- Sentences of the paper without a figure: yes, no, or not testable here, with the figure of ours that says so.

Answer = tuple[bool | None, str]
"""Whether the sentence holds here (None: not testable), and the figure."""


@dataclass(frozen=True)
class Sentence:
    """One sentence of the paper; `where` is its section or figure, `paper` what its own figures answer."""

    id: str
    where: str
    says: str
    kind: Kind
    paper: str = ""


def sentences(results: PaperResults, path: Path = FILE) -> list[dict[str, str]]:
    """Return the sentences of the paper as plain values: where, what it says, kind, answer, figure, its own answer."""
    documents = []
    for sentence in (Sentence(**row) for row in read_yaml(path).data["sentences"]):
        try:
            holds, figure = ANSWERS[sentence.id](results)
        except GbidError as error:
            holds, figure = None, str(error)
        paper = sentence.paper
        if sentence.id in OF_SURFACES:
            own, words = OF_SURFACES[sentence.id](results.machine, _points(results))
            paper = f"Table B.6: {_WORDS[own]}, {words}"
        documents.append({**vars(sentence), "paper": paper, "answer": _WORDS[holds], "figure": figure})
    return documents


_WORDS = {True: "yes", False: "no", None: "not testable"}


def _linear(results: PaperResults) -> Answer:
    off = 1e6 * float(np.nanmax(results.static_map.largest))
    return None, f"the rig is linear by its equations; off a line by up to {off:.2g} um, which is noise"


def _of_our_surfaces(answer: Callable[[LPVModel, FloatArray], Answer], results: PaperResults) -> Answer:
    return answer(results.surface_fit.model, _points(results))


def _coupling(model: LPVModel, points: FloatArray) -> Answer:
    g = np.abs(_of_points(model, points)[:, -4:])
    ratio = g[:, [0, 3]].min(axis=1) / g[:, [1, 2]].max(axis=1)
    n, least = int((ratio >= 10).sum()), float(ratio.min())
    return n == len(points), f"ten times at {n} of {len(points)} points, at least {least:.1f} times"


def _runout(results: PaperResults) -> Answer:
    turning = {name for name, q in results.experiment.recordings.items() if q.conditions.get("speed_rpm")}
    rows = [row for row in results.prefiltered if row["recording"] in turning]
    if not rows:
        return None, "no prefiltered recording with a turning shaft"
    before, after = (1e6 * float(np.median([row[key] for row in rows])) for key in ("rms_before", "rms_after"))
    words = f"shaft turning, piezos moving: {before:.2g} um rms before, {after:.2g} after (medians)"
    return bool(2 * after**2 < before**2), words  # what is removed has more energy than what stays


def _constant_actuators(results: PaperResults) -> Answer:
    nominal = results.nominal
    conditions = [results.experiment.recordings[name.rpartition("/")[2]].conditions for name in nominal.models]
    where = np.array([[c["pressure_bar"], c["speed_rpm"]] for c in conditions])
    if not where.std(axis=0).all():
        return None, "pressure or speed do not change"
    r = np.corrcoef(where.T, np.clip(nominal.z, -3, 3).T)[:2, 2:]
    least = float(min(stats.pearsonr(a, b).pvalue for a in where.T for b in np.clip(nominal.z, -3, 3).T))
    limit = 0.05 / r.size  # twelve comparisons
    return (
        least > limit,
        f"largest of twelve correlations {np.abs(r).max():.2f} (p = {least:.2g})",
    )


def _outliers(results: PaperResults) -> Answer:
    n = len({outlier.model for outlier in results.nominal.outliers})
    return n > 0, f"{n} of {len(results.nominal.models)} models beyond {results.nominal.limit:.1f} robust std"


def _coloured(results: PaperResults) -> Answer:
    rows = results.crossval[results.fit_with("rotor_bearing")][0]
    coloured = sum(row.residuals_white is False for row in rows)
    follow = sum(bool(row.residuals_follow) for row in rows)
    return coloured + follow > 0, f"of {len(rows)} outputs {coloured} not white, {follow} follow an input"


def _small_residuals(results: PaperResults) -> Answer:
    largest = 1e6 * results.summary("rotor_bearing").infinity_norm_max
    return None, f"the paper prints no limit; largest residual {largest[0]:.2g} um in x, {largest[1]:.2g} in y"


def _horizontal_actuators(results: PaperResults) -> Answer:
    nominal, mean = results.nominal, results.summary("piezo_pair").mean
    spread = nominal.values.std(axis=0, ddof=1) / nominal.values.mean(axis=0)
    x, y = (
        float(np.mean([s for s, q in zip(spread, nominal.parameter_names, strict=True) if q[-1] == a])) for a in "xy"
    )
    words = (
        f"fit {mean[0]:.2f} and {mean[1]:.2f} %, mean relative std of the parameters {100 * x:.2g} and {100 * y:.2g} %"
    )
    return bool(mean[0] < mean[1] and x > y), words


def _longer_delay(model: LPVModel, points: FloatArray) -> Answer:
    tau = _of_points(model, points)[:, :2]
    n = int((tau[:, 0] > tau[:, 1]).sum())
    return n == len(tau), f"at {n} of {len(tau)} points"


def _falling_delay(model: LPVModel, points: FloatArray) -> Answer:
    tau = _of_points(model, points)[:, :2]
    falls = [
        tau[b] < tau[a]
        for a in range(len(points))
        for b in range(len(points))
        if points[b, 0] == points[a, 0] + 1 and points[b, 1] == points[a, 1]
    ]
    x, y = np.sum(falls, axis=0)
    return bool(x + y == 2 * len(falls)), f"in {x} (x) and {y} (y) of {len(falls)} steps of 1 bar"


def _uncertain_damping(results: PaperResults) -> Answer:
    relative = [
        d.rms / abs(float(column.mean()))
        for d, column in zip(results.surface_fit.deviations, results.surface_fit.characteristics[1].T, strict=True)
    ]
    f, zeta = (100 * max(relative[i] for i in at) for at in ((2, 3), (4, 5)))
    return zeta > f, f"rms off the surface, relative: damping {zeta:.2g} %, frequencies {f:.2g} %"


def _small_variation(results: PaperResults) -> Answer:
    """Share of the squared deviations from a surface that lies within the operating points, for each key parameter."""
    estimates = results.surface_fit.estimates
    away = estimates.values - results.surface_fit.surface
    points, owner = np.unique(estimates.points, axis=0, return_inverse=True)
    means = np.array([away[owner.ravel() == i].mean(axis=0) for i in range(len(points))])
    shares = ((away - means[owner.ravel()]) ** 2).sum(axis=0) / (away**2).sum(axis=0)
    words = f"{100 * shares.min():.0f} to {100 * shares.max():.0f} % of the variance off the surfaces is within points"
    return bool(shares.max() < 0.5), words


def _four_krpm(results: PaperResults) -> Answer:
    estimated, surface = results.surface_fit.characteristics
    away = (estimated - surface)[:, 4:6]
    there = results.surface_fit.estimates.points[:, 1] == 4000
    ratio = float((away[there] ** 2).mean() / (away[~there] ** 2).mean())
    limit = float(stats.f.isf(0.05, 2 * int(there.sum()), 2 * int((~there).sum())))
    return (
        ratio > limit,
        f"variance of damping factors there over elsewhere {ratio:.2f}; chance: up to {limit:.2f}",
    )


def _sensitivity(results: PaperResults) -> Answer:
    machine = results.published_machine
    loop = sensitivities(machine.model.plant_at(*POINT), published_controller(machine))
    at = np.abs(loop.response("output", [1.0, *(f for f, _ in machine.model.at(*POINT).modes())]))
    low, resonances = float(at[0, 0, 0]), at[1:].diagonal(axis1=1, axis2=2).max()
    words = f"published model: |S_o,xx| at 1 Hz {low:.2f}, diagonal of S_o at the resonances up to {resonances:.2f}"
    return bool(low > 1 > resonances), words


def _peak_gain(results: PaperResults) -> Answer:
    machine = results.published_machine
    plant = machine.model.plant_at(*POINT)
    opened, closed = (
        gbid.control.peak_gain(q).value for q in (plant, close_loop(plant, published_controller(machine)))
    )
    return closed < opened / 2, f"published model: largest singular value {opened:.2f}, closed {closed:.2f} m/m"


def _more_damping(results: PaperResults) -> Answer:
    opened, closed = (float(_ringing(results, loop)[0, 1]) for loop in LOOPS)
    return closed > 2 * opened, f"damping factor 1 from the ring-downs {opened:.3f}, closed {closed:.3f}"


def _little_coupling(results: PaperResults) -> Answer:
    shares = []
    for loop in LOOPS:
        study = results.impacts_at(False)[loop]
        for v in study.validations:
            along = "xy".index(v.axis)
            rows = np.concatenate([np.arange(*w) for w in v.windows])
            rms = np.sqrt(np.mean((v.measured - v.stationary)[rows] ** 2, axis=0))
            noise = study.ringdown.residual_rms
            size = np.sqrt(np.maximum(rms**2 - noise**2, 0.0))
            shares.append(float(size[1 - along] / size[along]))
    n = len(shares) // 2
    opened, closed = max(shares[:n]), max(shares[n:])
    return closed < opened / 2, f"motion across an impact over motion along it: {opened:.2f}, closed {closed:.2f}"


def _factor_two(results: PaperResults) -> Answer:
    ratios = []
    for loop in LOOPS:
        study = results.impacts_at(False)[loop]
        ratios += [a / b for a, b in zip(np.ravel(study.ringdown.modes()), np.ravel(study.expected), strict=True)]
    worst = max(max(q, 1 / q) for q in ratios)
    return (
        bool(worst <= 2),
        f"obtained over expected, eight figures: at most a factor {worst:.2f}",
    )


def _agreement(results: PaperResults) -> Answer:
    fits = [v.along_percent for v in results.impacts_at(False)["closed"].validations]
    return None, f"the paper prints no figure; fit along the impact {', '.join(f'{q:.1f} %' for q in fits)}"


def _orbits(results: PaperResults) -> dict[str, FloatArray]:
    """Return the amplitudes in x and y of the motion synchronous with the shaft [um], by loop."""
    loops = results.impacts_at(True)
    parts = {loop: np.concatenate([v.stationary for v in loops[loop].validations]) for loop in LOOPS}
    return {loop: 1e6 * np.sqrt(2) * part.std(axis=0) for loop, part in parts.items()}


def _unbalance(results: PaperResults) -> Answer:
    x, y = _orbits(results)["open"]
    words = f"synchronous with the shaft, open loop: {x:.2f} um in x, {y:.2f} in y, run-out included"
    return bool(x > 1.1 * y), words


def _larger_orbit(results: PaperResults) -> Answer:
    orbits = _orbits(results)
    (a, b), (c, d) = orbits["open"], orbits["closed"]
    return bool(c > a and d > b), f"{a:.2f} and {b:.2f} um (x, y) without, {c:.2f} and {d:.2f} with the gains"


def _turning(results: PaperResults) -> Answer:
    loops = results.impacts_at(True)
    opened, closed = (1e3 * max(q.decay_s for q in loops[loop].figures) for loop in LOOPS)
    return closed < opened / 2, f"95 % of the energy has gone after {opened:.0f} ms, closed {closed:.0f} ms"


def _controlled_stack(results: PaperResults) -> Answer:
    curves = {curve.units[0]: curve for curve, *_ in results.piezos}
    opened, closed = curves["V"], curves["m"]
    creep = [100 * float(np.abs(c.creep[~c.saturated]).mean()) for c in (opened, closed)]
    words = (
        f"hysteresis {1e6 * opened.hysteresis:.2g} and {1e6 * closed.hysteresis:.2g} um, "
        f"creep {creep[0]:.2g} and {creep[1]:.2g} %, without and with the controller"
    )
    return bool(closed.hysteresis < opened.hysteresis / 2 and creep[1] < creep[0] / 2), words


OF_SURFACES: dict[str, Callable[[LPVModel, FloatArray], Answer]] = {
    "coupling": _coupling,
    "longer_delay": _longer_delay,
    "falling_delay": _falling_delay,
}
"""Answers of surfaces at operating points, by id of the sentence; those of Table B.6 are the paper's own."""
ANSWERS: dict[str, Callable[[PaperResults], Answer]] = {
    **{name: partial(_of_our_surfaces, answer) for name, answer in OF_SURFACES.items()},
    "linear": _linear,
    "runout": _runout,
    "constant_actuators": _constant_actuators,
    "outliers": _outliers,
    "coloured": _coloured,
    "small_residuals": _small_residuals,
    "horizontal_actuators": _horizontal_actuators,
    "small_variation": _small_variation,
    "uncertain_damping": _uncertain_damping,
    "four_krpm": _four_krpm,
    "sensitivity": _sensitivity,
    "peak_gain": _peak_gain,
    "more_damping": _more_damping,
    "little_coupling": _little_coupling,
    "factor_two": _factor_two,
    "agreement": _agreement,
    "unbalance": _unbalance,
    "larger_orbit": _larger_orbit,
    "turning": _turning,
    "controlled_stack": _controlled_stack,
}
"""Answers to the sentences, by id."""


# ---- Tables that the paper has no figures for: assumptions of ours, with what each choice gives.


def computation_rows(results: PaperResults) -> list[list[str | float]]:
    """Return the closed-loop modes at the point of the paper: printed, and of its model by time of computation."""
    rate = sample_time(results.experiment)
    machine = results.published_machine
    rows: list[list[str | float]] = []
    for kind in ("expected", "measured"):
        for modes in machine.reference_modes:
            if modes.kind == kind and modes.loop == "closed":
                rows.append([f"paper, {kind}", *np.ravel(modes.modes)])
    rows.append(["published model, continuous", *_modes(machine.model, results)["closed"].ravel()])
    for words, seconds in (("no time", 0.0), ("one sample", rate)):
        running = _running(machine.model, results, seconds)["closed"]
        rows.append([f"published model, sampled, {words} for computation", *running.ravel()])
    return rows


def repeated_rows(results: PaperResults) -> list[list[str | float]]:
    """Return the obtained modes and their standard deviations: of one ring-down fit, and between repeated impacts."""
    rows: list[list[str | float]] = []
    for loop in LOOPS:
        ring, again = results.impacts_at(False)[loop].ringdown, recorded_again(results, loop)
        stds = np.column_stack([ring.frequency_std, ring.damping_std])
        for words, modes in (
            ("obtained, one set of impacts", _ringing(results, loop)),
            ("its std by the fit", stds),
            (f"mean of {len(again)} sets", again.mean(axis=0)),
            ("std between the sets", again.std(axis=0, ddof=1)),
            ("one set without noise and scatter", ringing_without_noise(results, loop)),
            ("the rig's own modes", _running(results.machine, results)[loop]),
        ):
            rows.append([f"{loop} loop: {words}", *modes.ravel()])
    return rows


def alternative_rows(results: PaperResults) -> list[list[str | float]]:
    """Return for each reading of a coefficient points with other modes, smallest damping factors, other verdicts."""
    machine = results.published_machine
    published = published_controller(machine)
    rows: list[list[str | float]] = []
    first: FloatArray | None = None
    for name, model in machine.alternatives.items():
        plants = [model.plant_at(*point) for point in model.operating_points]
        dampings = np.array([_smallest(plant) for plant in plants])
        first = dampings if first is None else first
        differ = int((np.abs(dampings - first) > 1e-9).sum())
        closed = min(_smallest(close_loop(plant, published)) for plant in plants)
        has_surfaces = results.experiment.spec.lpv is not None
        changed = ", ".join(changed_verdicts(results, model)) or "none" if has_surfaces else "no surfaces"
        rows.append([name.partition(" = ")[2], float(differ), float(dampings.min()), closed, changed])
    return rows


def alternative_designs(results: PaperResults) -> list[list[str | float]]:
    """Return P controllers for each reading of a coefficient: gains, and smallest damping factors of the sampled loops.

    The dampings are those of the controller tuned for the reading, for the first one, and for all of them.
    """
    models = results.published_machine.alternatives
    options: dict[str, Any] = {"peak_sensitivity": _CAP, "sample_time": sample_time(results.experiment)}
    designs = [tune(model, **options) for model in models.values()]
    others = designs[0], tune(list(models.values()), **options)
    rows: list[list[str | float]] = []
    for (name, model), design in zip(models.items(), designs, strict=True):
        kept = (gbid.assess(model, other).worst["sampled_damping"][0] for other in others)
        gains = (design.gains[f"kappa_{axis}"] for axis in "xy")
        rows.append([name.partition(" = ")[2], *gains, design.value, *kept])
    return rows


_OF_SURFACES = ("rms_", "surface_")
_SAID_OF_SURFACES = ("coupling", "longer_delay", "falling_delay", "uncertain_damping", "four_krpm")


@dataclass(frozen=True, eq=False)
class _OtherRig:
    """PaperResults as a rig with another model would give them: its model and surfaces, all else of the run."""

    results: PaperResults
    machine: LPVModel
    surface_fit: LPVFit

    def __getattr__(self, name: str) -> Any:
        return getattr(self.results, name)


def changed_verdicts(results: PaperResults, model: LPVModel) -> list[str]:
    """Return the ids of rows and sentences about the surfaces whose verdict is another one with another rig.

    Each estimate moves by what the models differ by at its operating point, with its errors as they are, and the
    surfaces are fitted again. Rows at 0 rpm do not depend on a coefficient of Omega^2; those of the cross-validation
    would need other recordings.
    """
    section, estimates = needed(results.experiment.spec.lpv, "lpv"), results.surface_fit.estimates
    here, elsewhere = (q.key_parameters(*estimates.points.T) for q in (results.machine, model))
    change = np.column_stack([np.broadcast_to(elsewhere[k] - here[k], len(estimates.points)) for k in KEY_PARAMETERS])
    moved = replace(estimates, values=estimates.values + change)
    fit = fit_lpv(moved, weighting=section.weighting, order=section.order, robust=section.robust)
    other: Any = _OtherRig(results, model, fit)
    numbers = [number for number in paper_numbers() if number.id.startswith(_OF_SURFACES)]
    ids = [q.id for q in numbers if _compared(q, results).verdict != _compared(q, other).verdict]
    return ids + [name for name in _SAID_OF_SURFACES if ANSWERS[name](results)[0] != ANSWERS[name](other)[0]]


def _smallest(model: LinearModel) -> float:
    """Return the smallest damping factor of a model; negative when it is unstable."""
    poles = model.poles()
    return float((-poles.real / np.abs(poles)).min())
