"""Fit of a structure to frequency responses alone: options, start values, and tests of the errors."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import fields
from typing import NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import UsageError
from gbid.core.notes import FitNote
from gbid.identify.data import FitData, Record
from gbid.identify.frequency_data import FrequencyData
from gbid.identify.kernel.response import ResponseGroup
from gbid.identify.options import FitArguments
from gbid.identify.predictor import build_predictor
from gbid.identify.start.black_box import Target
from gbid.identify.start.start import Begin, begin_values, has_no_starts, matched
from gbid.structure import Parameter, Structure
from gbid.structure.kinds import AnyStructure, kind_of
from gbid.structure.linear import symbolic_matrices

_ACCURACY = 1e-3  # smallest relative standard deviation that a match of start values believes
_FOLLOWS = 4.0  # standard deviations of the correlation of neighbouring errors, beyond chance
_SAMPLES = (2_000, 20_000)  # of the motion for start values
USED = ("inputs", "outputs", "start", "fixed", "bounds", "prior", "max_iterations", "progress", "profile")
"""Options of `gbid.fit` that have a meaning for frequency responses alone."""


def refuse_other_options(options: FitArguments) -> None:
    """Refuse options without meaning for frequency responses; raises UsageError with the name of the option."""
    standard = FitArguments()
    for each in fields(FitArguments):
        given, default = getattr(options, each.name), getattr(standard, each.name)
        if each.name not in (*USED, "focus", "intersample") and given != default and (given or default):
            raise UsageError(
                f"{each.name} has no meaning in a fit to frequency responses alone; leave it out", each.name
            )


def check_linear(structure: AnyStructure) -> None:
    """Raise UsageError for a structure that has no frequency response."""
    kind = kind_of(structure)
    if kind.nonlinear or kind.scheduled or not isinstance(structure, Structure):
        raise UsageError(f"{structure.name}: frequency responses are for linear structures with constant parameters")


def response_start(
    structure: AnyStructure,
    parameters: Sequence[Parameter],
    data: FrequencyData,
    given: Set[str],
    *,
    from_data: bool,
) -> Begin:
    """Return the start values: stated ones, and others from a simulated steady motion with these responses.

    Those of a structure without a method of its own are matched to the responses from many random starts.

    Raises
    ------
    UsageError
        For a sampled loop, whose responses are no functions of the frequency alone.
    """
    assert isinstance(structure, Structure)
    if symbolic_matrices(structure)[1].feedback is not None:
        raise UsageError(
            f"{structure.name} is a sampled loop; fit its plant to the responses of inputs and outputs to the reference"
            " (FrequencyData.channels(..., reference=), in the YAML responses: [{file: ..., reference: r}])"
        )
    stated = {q.name: float(q.start) for q in parameters if q.start is not None and (q.fixed or not from_data)}
    if len(stated) < len(parameters) and not has_no_starts(structure):
        return begin_values(structure, parameters, steady_motion(data), "zoh", given, from_data=from_data)
    values = dict[str, float]()
    if len(stated) < len(parameters):
        fixed = {q.name: float(q.start or 0.0) for q in parameters if q.fixed}
        predictor = build_predictor(structure, fixed, 1.0, "zoh", "simulation")
        f, size = data.frequency_hz, np.abs(data.response)
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.nan_to_num(1 / np.hypot(data.std, _ACCURACY * size), posinf=0.0)
        poles = np.full(predictor.n_states, -2 * np.pi * np.sqrt(f[0] * f[-1]), complex)
        target = Target(np.asarray(2j * np.pi * f), np.nan_to_num(data.response), weight, poles, decays=False)
        values, _ = matched(structure, predictor, parameters, target, 0.5 / float(f[-1]))
    origin = {name: "user" if name in given else "structure" for name in stated}
    return Begin(values | stated, {q.name: origin.get(q.name, "data") for q in parameters}, ())


def steady_motion(data: FrequencyData) -> FitData:
    """Return a record of steady motion with given frequency responses, without noise; inputs have separate lines.

    Parameters
    ----------
    data : FrequencyData
        The responses.
    """
    f, n_u = data.frequency_hz, len(data.input_names)
    h = 1 / (5 * float(f[-1]))
    n = int(np.clip(2 / (f[0] * h), *_SAMPLES))
    lines = np.exp(1j * (2 * np.pi * h * np.outer(np.arange(n), f) + np.pi * np.arange(len(f)) ** 2 / len(f)))
    of_input = np.arange(len(f))[:, None] % n_u == np.arange(n_u)
    response = np.nan_to_num(data.response)
    outputs = sum((lines[:, of_input[:, j]] @ response[of_input[:, j], :, j]).real for j in range(n_u))
    record = Record(data.name, (lines @ of_input).real, np.ascontiguousarray(outputs))
    return FitData((record,), h, data.input_names, data.output_names, ("",) * len(data.output_names))


class ResponseResiduals(NamedTuple):
    """Residuals of frequency responses at the estimates.

    Attributes
    ----------
    mean_square : (n_y, n_y) array
        Mean of the products of the errors, in standard deviations.
    fit_percent : (n_responses, n_y) array
        ``100 (1 - |e| / |G|)``, both in standard deviations.
    p_value : (n_y,) array
        Probability of larger errors with the stated standard deviations.
    follow : bool
        Whether the errors of neighbouring frequencies follow each other: the structure is incomplete.
    loss : float
        Mean square of the errors, with the weight of correlated neighbours.
    log_likelihood : float
        Log-likelihood of the errors.
    doubtful : bool
        Whether the errors may have something in common that their standard deviations do not contain.
    """

    mean_square: FloatArray
    fit_percent: FloatArray
    p_value: FloatArray
    follow: bool
    loss: float
    log_likelihood: float
    doubtful: bool

    @classmethod
    def at(cls, groups: Sequence[ResponseGroup], theta: FloatArray) -> ResponseResiduals:
        """Return the residuals at given values of the free parameters."""
        pairs = [(each, each.errors(theta)[0]) for each in groups]
        squares = sum(np.einsum("fyu,fzu->yz", e, e.conj()).real for _, e in pairs)
        cost, count = sum(each.sums(theta).cost for each in groups), sum(each.n_numbers for each in groups)
        logs = (each.weight * np.log(2 * np.pi * each.data.std[each.measured] ** 2).sum() for each in groups)
        p_value, follow = _tests(pairs, len(theta))
        return cls(
            mean_square=squares / count,
            fit_percent=np.array([_fit_percent(*pair) for pair in pairs]),
            p_value=p_value,
            follow=follow,
            loss=2 * cost / count,
            log_likelihood=-cost - float(sum(logs)),
            doubtful=len(p_value) > 1 or any(each.data.of_loop for each in groups),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Note on residuals that are larger than the standard deviations state."""
        p = f"the standard deviations of the responses say (probability {float(self.p_value.min()):.1g})"
        if self.follow:
            what = "the structure is incomplete: errors of neighbouring frequencies follow each other"
            return (FitNote.LEFT_OUT(f"{what}, and are larger than {p}"),)
        return (FitNote.NOT_WHITE(f"errors are larger than {p}: the estimates have the robust standard deviations"),)


def _tests(groups: Sequence[tuple[ResponseGroup, ComplexArray]], n_free: int) -> tuple[FloatArray, bool]:
    """Return for each output the p-value of its errors, and whether errors of neighbouring lines are correlated."""
    n_y = len(groups[0][0].data.output_names)
    squares, freedom, products, chance = np.zeros(n_y), np.zeros(n_y), 0.0, 0.0
    for each, error in groups:
        spread = 1 + 2 * float(np.square(each.data.correlation).sum())
        squares += (np.abs(error) ** 2).sum(axis=(0, 2)) / spread
        freedom += 2 * each.measured.sum(axis=(0, 2)) / spread
        lag = len(each.data.correlation) + 1
        products += float((error[lag:] * error[:-lag].conj()).real.sum())
        mean_square = float((np.abs(error) ** 2).sum()) / max(1, each.n_numbers)
        both = int((each.measured[lag:] & each.measured[:-lag]).sum())
        chance += 2 * both * spread * mean_square**2
    freedom = np.maximum(freedom - n_free / n_y, 1.0)
    return scipy.special.chdtrc(freedom, squares), bool(products > _FOLLOWS * np.sqrt(chance))


def _fit_percent(group: ResponseGroup, error: ComplexArray) -> FloatArray:
    data, measured = group.data, group.measured
    size = np.where(measured, np.nan_to_num(data.response) / np.where(measured, data.std, 1.0), 0.0)
    return np.asarray(100 * (1 - np.linalg.norm(error, axis=(0, 2)) / np.linalg.norm(size, axis=(0, 2))))
