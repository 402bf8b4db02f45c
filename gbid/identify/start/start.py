"""Start values of a fit: from the caller, the structure, or data (least squares in the frequency domain, subspace)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import casadi as ca
import numpy as np
import scipy

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.notes import FitNote
from gbid.discretise import Hold
from gbid.discretise.exact import check_holds, hold_response
from gbid.identify.data import FitData, Record, centred_rows, moves
from gbid.identify.predictor import Predictor, build_predictor
from gbid.identify.start.black_box import BlackBox, Target, black_box, match
from gbid.structure import ClosedLoop, Parameter, PiezoPair, Plant, RotorBearing, Structure
from gbid.structure.built_in import AXES, PAIRS
from gbid.structure.kinds import kind_of
from gbid.structure.linear import evaluate, symbolic_matrices


def spectrum_of(values: FloatArray, sample_time: float) -> tuple[FloatArray, ComplexArray]:
    """Return angular frequencies (n_f,) [rad/s] and Fourier transforms (n_f, n) of a record without means."""
    transform = np.fft.rfft(centred_rows(values)).T * sample_time
    return np.asarray(2 * np.pi * np.fft.rfftfreq(len(values), sample_time), float), transform


def as_real(values: ComplexArray) -> FloatArray:
    """Return complex equations (n, n_columns) as real ones, (2 n, n_columns): real parts above imaginary parts."""
    return np.vstack([values.real, values.imag])


def record_ends(s: ComplexArray, record: int, n_records: int) -> ComplexArray:
    """Return regressors for the end effects of records, (n, 2 n_records): polynomials in s (n, 1)."""
    ends = np.zeros((len(s), 2 * n_records), complex)
    ends[:, 2 * record : 2 * record + 2] = np.hstack([np.ones_like(s), s])
    return ends


def lag_start(records: tuple[Record, ...], channel: int, sample_time: float) -> tuple[float, float, float]:
    """Return poles [rad/s] and gain of ``u + a1 ud + a2 udd = kappa r`` with r constant between samples."""
    equations: list[tuple[ComplexArray, ComplexArray, ComplexArray]] = []
    for i, record in enumerate(records):
        omega, R = spectrum_of(record.inputs[:, [channel]], sample_time)
        _, U = spectrum_of(record.outputs[:, [channel]], sample_time)
        keep = (omega > 0) & (omega < 0.4 * np.pi / sample_time)
        s = np.asarray(1j * omega[keep, None], complex)
        held = R[keep] * (1 - np.exp(-s * sample_time)) / (s * sample_time)
        row = np.hstack([held, -s * U[keep], -(s**2) * U[keep], record_ends(s, i, len(records))])
        equations.append((row, U[keep], s))
    base, target, s = (np.asarray(np.concatenate(parts), complex) for parts in zip(*equations, strict=True))
    a1 = a2 = gain = 0.0
    for _ in range(4):  # Sanathanan-Koerner: weights 1 / last denominator, for the output error
        weight = np.asarray(1 / (1 + a1 * s + a2 * s**2), complex)
        columns = as_real(base * weight)
        size = np.linalg.norm(columns, axis=0)
        gain, a1, a2 = (np.linalg.lstsq(columns / size, as_real(target * weight)[:, 0], rcond=None)[0] / size)[:3]
    return (*_real_poles(a1, a2, sample_time), float(gain))


def _real_poles(a1: float, a2: float, sample_time: float) -> tuple[float, float]:
    """Return slow and fast pole of ``1 + a1 s + a2 s^2``; for other poles the nearest real stable pair."""
    fastest = 10 / sample_time
    a1 = max(a1, 2 / fastest)
    if a2 <= 0:
        return float(np.clip(1 / a1, 1.0, fastest)), fastest
    root = a1**2 - 4 * a2
    if root <= 0:
        middle = 1 / np.sqrt(a2)
        return float(0.8 * middle), float(1.25 * middle)
    slow, fast = 2 / (a1 + np.sqrt(root)), (a1 + np.sqrt(root)) / (2 * a2)
    return float(min(slow, fastest)), float(min(fast, fastest))


# Start values of a rotor bearing: a model ``sum_i theta_i R_i(s) = 0`` is linear in its coefficients for given
# delays. A fit then is a least-squares problem over some hundred frequencies. The ends of a record add a polynomial in
# s to the transform of a derivative; the polynomial is estimated together with the coefficients.

_REGULAR = 1e-10  # determinant of two columns, as a part of that of orthogonal ones, above which they are told apart
_FREQUENCIES = 800  # largest number in the band of the resonance; modes are much wider than their distance
_ENOUGH = 50_000  # largest number of samples of a record for start values; the fit uses all


def _resonance_band(spectra: list[tuple[FloatArray, ComplexArray, ComplexArray]]) -> tuple[float, float]:
    """Return the band around the resonance [rad/s] that contains both modes, from spectra.

    Its centre is the peak of ``|P|^2 / |U|``, the geometric mean of power and gain. Power alone may have a peak where
    the input is strong: a PRBS has little power at the inverse of its hold time. Gain alone may have one where both are
    noise.
    """
    totals: dict[int, FloatArray] = {}
    resolution = 2.0  # Hz: smooths the spectrum, and is small compared with the frequencies of the modes
    for omega, U, P in spectra:
        bins = (omega / (2 * np.pi * resolution)).astype(int)
        binned = np.array([np.bincount(bins, (values.real**2 + values.imag**2).sum(1)) for values in (U, P)])
        totals[binned.shape[1]] = totals.get(binned.shape[1], np.zeros_like(binned)) + binned
    drive, response = totals[max(totals)]
    response[: int(10 / resolution)] = 0.0  # excludes drift and creep
    amplitude = np.sqrt(drive)
    strength = response / (amplitude + 1e-3 * amplitude.max()) if amplitude.any() else response  # a free decay has none
    peak = 2 * np.pi * resolution * (int(np.argmax(strength)) + 0.5)
    return 0.3 * peak, 2.5 * peak


def bearing_start(structure: RotorBearing, records: tuple[Record, ...], sample_time: float) -> dict[str, float]:
    """Return K, D and B by least squares, and the two delays by a grid and a simplex search."""
    records = tuple(Record(r.name, r.inputs[:_ENOUGH], r.outputs[:_ENOUGH]) for r in records)
    spectra = [(*spectrum_of(r.inputs, sample_time), spectrum_of(r.outputs, sample_time)[1]) for r in records]
    low, high = _resonance_band(spectra)
    equations = []
    for i, (omega, U, P) in enumerate(spectra):
        band = np.flatnonzero((omega >= low) & (omega <= high))
        keep = band[:: max(1, len(band) * len(records) // _FREQUENCIES)]
        s = np.asarray(1j * omega[keep, None], complex)
        motion = np.hstack([P[keep], s * P[keep], record_ends(s, i, len(records))]) / s**2
        equations.append((motion, P[keep], U[keep] / s**2, omega[keep]))
    known, targets, complex_drive, omega = (np.concatenate(parts) for parts in zip(*equations, strict=True))
    if len(omega) < 20:
        raise DataError(
            f"recording {records[0].name!r}: only {len(omega)} frequencies around the resonance; record for longer"
        )
    base, target = as_real(known), as_real(targets)
    # Columns of s-powers differ by orders of magnitude; scaled, the projection is exact to rounding.
    size = np.linalg.norm(base, axis=0)
    basis, triangle = np.linalg.qr(base / size)
    rest = target - basis @ (basis.T @ target)
    if not any(moves(record.inputs).any() for record in records):  # free decays: no delays, no gains
        return _named(structure, np.linalg.lstsq(base / size, target, rcond=None)[0] / size[:, None])

    onto, frequencies = basis.T.copy(), [each[-1] for each in equations]

    def delayed(tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return delayed inputs as rows (real before imaginary parts), and their part not explained by the motion."""
        columns = complex_drive.T * np.hstack([_turned(tau, omega) for omega in frequencies])
        rows = np.hstack([columns.real, columns.imag])
        return rows, rows - (rows @ basis) @ onto

    def unexplained(rows: FloatArray) -> float:
        """Return the residual for two projected rows, up to a constant."""
        products, share = rows @ rows.T, rows @ rest
        shares = share @ share.T
        ((a, b), (_, c)), ((d, e), (_, f)) = products.tolist(), shares.tolist()
        if a * c - b * b > _REGULAR * a * c:
            return float((2 * b * e - c * d - a * f) / (a * c - b * b))
        return -float(np.vdot(np.linalg.pinv(products), shares))

    bounds = {q.name: (q.lower, q.upper) for q in structure.parameters}
    longest = min(0.5 * np.pi / high * 2, bounds["tau_x"][1])
    grid = np.linspace(0.0, longest, 7)
    sampled = [delayed(np.array([a, a]))[1] for a in grid]  # both axes at once: pairs of delays share their columns
    pairs = list(itertools.product(range(len(grid)), repeat=2))
    scores = [unexplained(np.stack([sampled[i][0], sampled[j][1]])) for i, j in pairs]
    first = grid[list(pairs[int(np.argmin(scores))])]
    simplex = first + grid[1] / 2 * np.array([[0, 0], [1, 0], [0, 1]])
    options = {"initial_simplex": simplex, "xatol": 1e-6, "fatol": np.inf, "maxiter": 200}
    tau = scipy.optimize.minimize(
        lambda tau: unexplained(delayed(tau)[1]), first, method="Nelder-Mead", options=options
    ).x
    lower, upper = np.array([bounds[f"tau_{axis}"] for axis in AXES]).T
    tau = np.clip(tau, 2 * lower, upper)
    columns, projected = (rows.T for rows in delayed(tau))
    gain = np.asarray(np.linalg.lstsq(projected, rest, rcond=None)[0])
    motion = np.linalg.solve(triangle, basis.T @ (target - columns @ gain)) / size[:, None]
    delays = {f"tau_{axis}": float(t) for axis, t in zip(AXES, tau, strict=True)}
    return {**_named(structure, motion, gain), **delays}


def _turned(tau: FloatArray, omega: FloatArray) -> ComplexArray:
    """Return ``exp(-1j tau omega)``, (n_tau, n_f), for evenly spaced frequencies, from few exponentials."""
    few = max(1, int(np.sqrt(len(omega))))
    coarse, fine = (np.exp(-1j * tau[:, None] * part) for part in (omega[::few], omega[:few] - omega[:1]))
    return np.asarray((coarse[:, :, None] * fine[:, None]).reshape(len(tau), -1)[:, : len(omega)])


def _named(structure: RotorBearing, motion: FloatArray, gain: FloatArray | None = None) -> dict[str, float]:
    """Return parameters by name from coefficients of displacement, velocity and input; zero for others."""
    values = dict.fromkeys((q.name for q in structure.parameters), 0.0)
    matrices = {"k": motion[:2].T, "d": motion[2:4].T} | ({} if gain is None else {"b": gain.T})
    for letter, matrix in matrices.items():
        values |= {f"{letter}_{pair}": float(v) for pair, v in zip(PAIRS, matrix.ravel(), strict=True)}
    return values


@singledispatch
def start_values(structure: Any, data: FitData, given: Mapping[str, float]) -> dict[str, float]:  # noqa: ARG001
    """Return start values of all parameters that have none, from data.

    Parameters
    ----------
    structure : Structure
        A built-in structure; a user's structure must state its start values.
    data : FitData
        Data of the fit.
    given : dict of str to float
        Known values (fixed, or start values of the user).

    Returns
    -------
    dict of str to float
        Values by name, with those of `given`.

    Raises
    ------
    UsageError
        When there is no method to find start values for the structure.
    """
    return _as_given(structure, given)


@start_values.register
def _(structure: RotorBearing, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    data = _without_unbalance(structure, data)
    _check_channels(structure, data.records, 2, 2)
    return {**bearing_start(structure, data.records, data.sample_time), **given}


@start_values.register
def _(structure: PiezoPair, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    if not data.records[0].inputs.size:
        return _as_given(structure, given)
    _check_channels(structure, data.records, 2, 2)
    values = dict.fromkeys((q.name for q in structure.parameters), 0.0)
    for i, axis in enumerate(AXES):
        slow, fast, kappa = lag_start(data.records, i, data.sample_time)
        if structure.poles == "any":
            omega = float(np.sqrt(slow * fast))
            values |= {f"omega_{axis}": omega, f"zeta_{axis}": (slow + fast) / (2 * omega)}
        else:
            values |= {f"p1_{axis}": slow, f"p2_{axis}": fast}
        values[f"kappa_{axis}"] = kappa
    return {**values, **given}


@start_values.register
def _(structure: Plant, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    if not data.records[0].inputs.size:
        return _as_given(structure, given)
    data = _without_unbalance(structure.bearing, data)
    _check_channels(structure, data.records, 2, 2 * len(structure.outputs))
    if "u" in structure.outputs:
        actuator_records = tuple(Record(r.name, r.inputs, r.outputs[:, :2]) for r in data.records)
        records = tuple(Record(r.name, r.outputs[:, :2], r.outputs[:, 2:]) for r in data.records)
        actuators = start_values(structure.actuators, replace(data, records=actuator_records), {})
    else:
        if needed := [q.name for q in structure.actuators.parameters if q.name not in given]:
            raise UsageError(
                f"structure {structure.name!r} from r to p alone does not determine the actuators: "
                f"fix {', '.join(needed)} (fixed=...) or add u to the outputs"
            )
        model, actuators = evaluate(structure.actuators, given), {}
        forces = (model.simulate(r.inputs, data.sample_time, intersample="zoh") for r in data.records)
        records = tuple(Record(r.name, u, r.outputs) for r, u in zip(data.records, forces, strict=True))
    return {**actuators, **bearing_start(structure.bearing, records, data.sample_time), **given}


def _as_given(structure: Any, given: Mapping[str, float]) -> dict[str, float]:
    if missing := [q.name for q in structure.parameters if q.name not in given]:
        nonlinear = kind_of(structure).nonlinear
        why = ": nonlinear structures have no search for start values in the data" if nonlinear else ""
        raise UsageError(
            f"structure {structure.name!r}: no start value for {', '.join(missing)}; give each a start{why}"
        )
    return dict(given)


def _check_channels(structure: Any, records: tuple[Record, ...], n_inputs: int, n_outputs: int) -> None:
    given = records[0].inputs.shape[1], records[0].outputs.shape[1]
    if given not in {(n_inputs, n_outputs), (0, n_outputs)}:  # none: a free decay
        raise UsageError(
            f"structure {structure.name!r} has {n_inputs} inputs and {n_outputs} outputs; "
            f"the recordings give {given[0]} and {given[1]}"
        )


def _without_unbalance(bearing: RotorBearing, data: FitData) -> FitData:
    """Return the data without the two unbalance inputs, if they are present."""
    if not (bearing.unbalance and data.records[0].inputs.shape[1] == 4):
        return data
    return replace(data, records=tuple(replace(r, inputs=r.inputs[:, :2]) for r in data.records))


def plant_data(loop: ClosedLoop, data: FitData, gains: Mapping[str, float]) -> FitData:
    """Return the data of a closed loop with the plant's inputs in place of the injected signals.

    Parameters
    ----------
    loop : ClosedLoop
        The loop.
    data : FitData
        What was injected, and what was recorded.
    gains : dict of str to float
        Gains of a controller that is a structure, under their names in the loop.
    """
    controller, records = loop.controller_model(gains), []
    set_point = loop.injected == "set point"
    for record in data.records:
        measured = record.outputs[:, list(loop.measured)]
        w = record.inputs if record.inputs.size else np.zeros((record.n_samples, 1))
        hold = "foh" if controller.dt is None else "zoh"
        r = controller.simulate(measured - w if set_point else measured, data.sample_time, intersample=hold)
        records.append(replace(record, inputs=r if set_point else r + w))
    return replace(data, records=tuple(records))


# ---- Start values of a linear structure: a subspace model, matched by the structure.


@dataclass(frozen=True)
class MatchOptions:
    """Options of the search for parameters that match a black-box model's response.

    Attributes
    ----------
    frequencies : int
        Frequencies with logarithmic spacing; more lie around the poles.
    highest : float
        Highest frequency, as a part of the sampling frequency.
    starts : int
        Largest number of starts.
    decades : float
        Range of the random starts of a parameter without bounds, to both sides of its scale.
    longest_delay : int
        Range of the random starts of a delay without a bound, in samples.
    accuracy : float
        Smallest relative standard deviation that is believed.
    poor : float
        Smallest misfit of a match that may lead to a wrong minimum.
    """

    frequencies: int = 80
    highest: float = 0.4
    starts: int = 30
    decades: float = 3.0
    longest_delay: int = 30
    accuracy: float = 1e-3
    poor: float = 0.3


MATCH = MatchOptions()


def subspace_start(
    structure: Structure,
    data: FitData,
    parameters: Sequence[Parameter],
    intersample: Hold | Sequence[Hold],
) -> tuple[dict[str, float], str]:
    """Return start values of a linear structure from data, and the quality of their match to a black-box model.

    Parameters
    ----------
    structure : Structure
        The structure.
    data : FitData
        Data of the fit: recordings with inputs that move, in open or closed loop, or free decays.
    parameters : sequence of Parameter
        Parameters of the structure, with fixed values and bounds. A stated start is one of many starts of the match.
    intersample : {"zoh", "foh"} or sequence of these
        Hold of the inputs.

    Returns
    -------
    dict of str to float
        Start values of the parameters that were not fixed. Those of the disturbance gain alone start at zero, or at the
        bound next to it.
    str
        States of the black-box model, and the part of its response that the structure explains.

    Raises
    ------
    DataError
        When the recordings are too short.

    Notes
    -----
    A black-box model takes no start values. The structure is matched to its response, which has no noise and costs no
    pass over the samples, so that many starts are cheap.
    """
    fixed = {q.name: float(q.start) for q in parameters if q.fixed and q.start is not None}
    predictor = build_predictor(structure, fixed, data.sample_time, intersample, "simulation")
    holds = check_holds(intersample, predictor.n_inputs)
    decays = not any(moves(r.inputs).any() for r in data.records)
    records = [Record(r.name, r.inputs[:, :0], r.outputs) for r in data.records] if decays else data.records
    _, m = symbolic_matrices(structure)
    at_once = "foh" in holds or m.D.nnz() > 0  # inputs act on the outputs of the same sample
    model = black_box(records, predictor.n_states, feedthrough=not decays and at_once)
    target = _target(model, data, holds, decays)
    values, misfit = matched(structure, predictor, parameters, target, data.sample_time)
    doubt = "; that is little: try fit_multistart" if misfit > MATCH.poor else ""
    explained = f"the structure explains {100 * (1 - misfit):.1f} % of its response{doubt}"
    return values, f"from the data, by a subspace model with {len(model.A)} states; {explained}"


def matched(
    structure: Structure,
    predictor: Predictor,
    parameters: Sequence[Parameter],
    target: Target,
    sample_time: float,
) -> tuple[dict[str, float], float]:
    """Return parameters whose response approximates a target, and the unexplained part."""
    known = {q.name: q for q in parameters}
    free = [known[q.name] for q in predictor.free]
    bounds = np.array([(q.lower, q.upper) for q in free], float).reshape(-1, 2)
    delays = {symbol.name() for symbol in ca.symvar(symbolic_matrices(structure)[1].delay)}
    best = match(predictor, target, _draw(free, bounds, delays, target, sample_time), *bounds.T)
    unused = {name: float(np.clip(0.0, known[name].lower, known[name].upper)) for name in predictor.unused}
    return unused | {q.name: float(v) for q, v in zip(free, best.theta, strict=True)}, min(best.misfit, 1.0)


def _target(model: BlackBox, data: FitData, holds: Sequence[Hold], decays: bool) -> Target:
    h = data.sample_time
    values, vectors = np.linalg.eig(model.A.astype(complex))
    with np.errstate(divide="ignore"):
        poles = np.log(values) / h
    poles = np.where(np.isfinite(poles), poles, -np.pi / h)  # a pole at zero: faster than the samples
    f = _frequencies(poles, data)
    s = 2j * np.pi * f
    if decays:
        amplitudes = np.linalg.solve(vectors, model.first_states.T)
        response = np.einsum("yn,fn,nr->fyr", model.C @ vectors, 1 / (s[:, None] - poles), amplitudes)
        std = np.zeros(response.shape)
    else:
        response, std = model.response(np.exp(s * h))
        held = hold_response(f * h, holds)[:, None, :]
        response, std = response / held, std / np.abs(held)
    size = np.sqrt((np.abs(response) ** 2).mean(0, keepdims=True))
    # An accuracy that is not believed: else the most accurate frequencies would be all that is matched.
    weight = 1 / np.sqrt(std**2 + (MATCH.accuracy * np.abs(response)) ** 2 + (MATCH.accuracy**2 * size) ** 2)
    return Target(np.asarray(s, complex), np.asarray(response, complex), weight, poles, decays)


def _frequencies(poles: ComplexArray, data: FitData) -> FloatArray:
    """Return logarithmically spaced frequencies [Hz], denser around the poles of the black-box model."""
    high = MATCH.highest / data.sample_time
    longest = max(r.n_samples for r in data.records) * data.sample_time
    low = min(max(1 / longest, 0.05 * float(np.abs(poles).min()) / (2 * np.pi)), 0.1 * high)
    pairs = poles[poles.imag > 0]
    spread = np.array([-3.0, -1.5, -0.7, -0.3, 0.0, 0.3, 0.7, 1.5, 3.0])
    around = (pairs.imag[:, None] + np.abs(pairs.real)[:, None] * spread).ravel() / (2 * np.pi)
    inside = around[(around > low) & (around < high)]
    return np.unique(np.concatenate([np.geomspace(low, high, MATCH.frequencies), inside]))


def _draw(
    free: Sequence[Parameter], bounds: FloatArray, delays: set[str], target: Target, sample_time: float
) -> Iterator[FloatArray]:
    """Yield starts of the match: the stated values, then random values between bounds or over many decades."""
    random = np.random.default_rng(0)
    lower, upper = bounds.T
    stated = np.array([np.nan if q.start is None else q.start for q in free], float)
    is_delay = np.array([q.name in delays for q in free], bool)
    low = np.where(is_delay, np.maximum(lower, 0.0), lower)
    high = np.where(is_delay, np.minimum(upper, MATCH.longest_delay * sample_time), upper)
    between = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(between, low, 0.0), np.where(between, high, 1.0)
    scale = np.where(np.isfinite(stated) & (stated != 0), np.abs(stated), 1.0)
    rate = float(np.exp(np.log(np.maximum(np.abs(target.poles), 1e-12)).mean()))
    first = np.where(between, 0.5 * (low + high), np.where(upper <= 0, -1.0, 1.0))
    yield np.clip(np.where(np.isfinite(stated), stated, first), lower, upper)
    for _ in range(MATCH.starts - 1):
        powers = rate ** random.choice([0, 1, 2], len(scale))  # a damping is like the rate, a stiffness like its square
        size = np.where(random.random(len(scale)) < 0.5, scale, powers)
        size = size * 10.0 ** random.uniform(-MATCH.decades, MATCH.decades, len(scale))
        sign = np.where(lower >= 0, 1.0, np.where(upper <= 0, -1.0, random.choice([-1.0, 1.0], len(scale))))
        yield np.clip(np.where(between, random.uniform(low, high), sign * size), lower, upper)


@dataclass(frozen=True)
class Begin:
    """Start values of a fit, with origins and notes.

    Attributes
    ----------
    values : dict of str to float
        Start values of all parameters, within their bounds.
    origin : dict of str to str
        Origin of each: ``"data"``, ``"user"`` or ``"structure"``.
    notes : tuple of str
        How values were found in the data, where a structure has no method of its own.
    """

    values: dict[str, float]
    origin: dict[str, str]
    notes: tuple[str, ...]


def has_no_starts(structure: Any) -> bool:
    """Return whether a linear structure lacks a specific method for start values from data."""
    unknown = start_values.dispatch(type(structure)) is start_values.dispatch(object)
    return unknown and hasattr(structure, "matrices") and kind_of(structure).plant is structure


def begin_values(
    structure: Any,
    parameters: Sequence[Parameter],
    data: FitData,
    intersample: Hold | Sequence[Hold],
    given: Set[str],
    *,
    from_data: bool,
) -> Begin:
    """Return the start values of a fit, with origins and notes.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
    parameters : sequence of Parameter
        Parameters, with the starts, fixed values and bounds of the caller.
    data : FitData
        Data of the fit.
    intersample : {"zoh", "foh"} or sequence of these
        Hold of the inputs.
    given : set of str
        Parameters whose value comes from the caller.
    from_data : bool
        Whether all start values are found in the data, also those that are stated.

    Returns
    -------
    Begin

    Raises
    ------
    UsageError, DataError
        When start values are missing and cannot be found in the data.
    """
    if kind_of(structure).plant is not structure:
        return _of_loop(structure, parameters, data, given, from_data=from_data)
    stated = {q.name: q.start for q in parameters if q.start is not None and (q.fixed or not from_data)}
    notes: tuple[str, ...] = ()
    missing = [q.name for q in parameters if q.name not in stated]
    if missing and has_no_starts(structure):
        driven: Any = structure if data.input_names else kind_of(structure).without_inputs()
        found, how = subspace_start(driven, data, parameters, intersample)
        values = {**found, **stated}
        listed = ", ".join(missing) if len(missing) <= 8 else f"{len(missing)} parameters"
        notes = (FitNote.STARTS_FROM_DATA(f"start values of {listed}: {how}"),)
    else:
        values = start_values(structure, data, stated) if missing else stated
    within = {
        q.name: values[q.name] if q.name in stated else float(np.clip(values[q.name], q.lower, q.upper))
        for q in parameters
    }
    origin = {name: "user" if name in given else "structure" for name in stated}
    return Begin(within, {q.name: origin.get(q.name, "data") for q in parameters}, notes)


def _of_loop(
    loop: ClosedLoop, parameters: Sequence[Parameter], data: FitData, given: Set[str], *, from_data: bool
) -> Begin:
    """Return the start values of a loop: plant values, from inputs that the controller computed."""
    names = {gain.name for gain in loop.gains}
    gains = {q.name: q.start for q in parameters if q.name in names and q.start is not None}
    if missing := sorted(names - gains.keys()):
        raise UsageError(f"{loop.name}: no start value for {', '.join(missing)}; give each a start")
    rest = [q for q in parameters if q.name not in names]
    plant = loop.structure
    if from_data or any(q.start is None for q in rest):
        data = plant_data(loop, data, gains)
    begin = begin_values(plant, rest, data, plant.intersample, given, from_data=from_data)
    origin = {name: "user" if name in given else "structure" for name in gains}
    return Begin({**begin.values, **gains}, {**begin.origin, **origin}, begin.notes)
