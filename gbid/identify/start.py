"""Start values from data, for the built-in structures.

In the frequency domain a model ``sum_i theta_i R_i(s) = 0`` is linear in its coefficients for given delays. A fit then
is a least-squares problem over some hundred frequencies. The ends of a record add a polynomial in s to the transform
of a derivative; the polynomial is estimated together with the coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch
from typing import Any

import numpy as np
from scipy.optimize import minimize

from gbid.arrays import ComplexArray, FloatArray
from gbid.errors import DataError, UsageError
from gbid.identify.data import FitData, Record
from gbid.structure import PiezoPair, Plant, RotorBearing, evaluate
from gbid.structure.rotor_bearing import AXES, PAIRS

_FREQUENCIES = 800  # largest number in the band of the resonance; modes are much wider than their distance
_ENOUGH = 50_000  # largest number of samples of a record for start values; the fit uses all


@singledispatch
def start_values(structure: Any, data: FitData, given: Mapping[str, float]) -> dict[str, float]:  # noqa: ARG001
    """Return start values of all parameters that have none.

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
    missing = [q.name for q in structure.parameters if q.name not in given]
    if missing:
        raise UsageError(f"structure {structure.name!r}: no start value for {', '.join(missing)}; give each a start")
    return dict(given)


@start_values.register
def _(structure: RotorBearing, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    _check_channels(structure, data.records, 2, 2)
    return {**_rotor_bearing(structure, data.records, data.sample_time), **given}


@start_values.register
def _(structure: PiezoPair, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    _check_channels(structure, data.records, 2, 2)
    found: dict[str, float] = {}
    for i, axis in enumerate(AXES):
        slow, fast, gain = _second_order_lag(data.records, i, data.sample_time)
        found |= {f"p1_{axis}": slow, f"p2_{axis}": fast, f"kappa_{axis}": gain}
    return {**_zero_unless_found(structure, found), **given}


@start_values.register
def _(structure: Plant, data: FitData, given: Mapping[str, float]) -> dict[str, float]:
    _check_channels(structure, data.records, 2, 2 * len(structure.outputs))
    if "u" in structure.outputs:
        actuator_records = tuple(Record(r.name, r.inputs, r.outputs[:, :2]) for r in data.records)
        bearing_records = tuple(Record(r.name, r.outputs[:, :2], r.outputs[:, 2:]) for r in data.records)
        actuators = start_values(structure.actuators, _like(data, actuator_records), {})
        found = {**actuators, **_rotor_bearing(structure.bearing, bearing_records, data.sample_time)}
        return {**found, **given}
    needed = [q.name for q in structure.actuators.parameters if q.name not in given]
    if needed:
        raise UsageError(
            f"structure {structure.name!r} from r to p alone does not determine the actuators: "
            f"fix {', '.join(needed)} (fixed=...) or add u to the outputs"
        )
    model = evaluate(structure.actuators, given)
    records = tuple(
        Record(r.name, model.simulate(r.inputs, data.sample_time, intersample="zoh"), r.outputs) for r in data.records
    )
    return {**_rotor_bearing(structure.bearing, records, data.sample_time), **given}


def _check_channels(structure: Any, records: tuple[Record, ...], n_inputs: int, n_outputs: int) -> None:
    found = records[0].inputs.shape[1], records[0].outputs.shape[1]
    if found != (n_inputs, n_outputs):
        raise UsageError(
            f"structure {structure.name!r} has {n_inputs} inputs and {n_outputs} outputs; "
            f"the recordings give {found[0]} and {found[1]}"
        )


def _like(data: FitData, records: tuple[Record, ...]) -> FitData:
    return FitData(records, data.sample_time, (), (), ())


def _zero_unless_found(structure: Any, found: Mapping[str, float]) -> dict[str, float]:
    return {q.name: found.get(q.name, 0.0) for q in structure.parameters}


def _spectrum(values: FloatArray, sample_time: float) -> tuple[FloatArray, ComplexArray]:
    """Return angular frequencies (n_f,) [rad/s] and transforms (n_f, n) of a record's samples without the mean."""
    transform = np.fft.rfft(values - values.mean(0), axis=0) * sample_time
    return np.asarray(2 * np.pi * np.fft.rfftfreq(len(values), sample_time), float), transform


def _resonance_band(records: tuple[Record, ...], sample_time: float) -> tuple[float, float]:
    """Return the band around the resonance [rad/s], which contains the two modes.

    Its centre is the peak of ``|P|^2 / |U|``, the geometric mean of power and gain. Power alone may have a peak where
    the input is strong: a PRBS has little power at the inverse of its hold time. Gain alone may have one where both are
    noise.
    """
    totals: dict[int, FloatArray] = {}
    resolution = 2.0  # Hz: smooths the spectrum, and is small compared with the frequencies of the modes
    for record in records:
        omega, U = _spectrum(record.inputs, sample_time)
        _, P = _spectrum(record.outputs, sample_time)
        bins = (omega / (2 * np.pi * resolution)).astype(int)
        binned = np.array([np.bincount(bins, (np.abs(values) ** 2).sum(1)) for values in (U, P)])
        totals[binned.shape[1]] = totals.get(binned.shape[1], np.zeros_like(binned)) + binned
    drive, response = totals[max(totals)]
    response[: int(10 / resolution)] = 0.0  # excludes drift and creep
    amplitude = np.sqrt(drive)
    strength = response / (amplitude + 1e-3 * amplitude.max())
    peak = 2 * np.pi * resolution * (int(np.argmax(strength)) + 0.5)
    return 0.3 * peak, 2.5 * peak


def _rotor_bearing(structure: RotorBearing, records: tuple[Record, ...], sample_time: float) -> dict[str, float]:
    """Return K, D and B by least squares for given delays; a grid and a simplex search find the two delays."""
    records = tuple(Record(r.name, r.inputs[:_ENOUGH], r.outputs[:_ENOUGH]) for r in records)
    low, high = _resonance_band(records, sample_time)
    known, targets, drives, omegas = [], [], [], []
    n_records = len(records)
    for i, record in enumerate(records):
        omega, U = _spectrum(record.inputs, sample_time)
        _, P = _spectrum(record.outputs, sample_time)
        band = np.flatnonzero((omega >= low) & (omega <= high))
        keep = band[:: max(1, len(band) * n_records // _FREQUENCIES)]
        s = 1j * omega[keep, None]
        ends = np.zeros((len(s), 2 * n_records), complex)
        ends[:, 2 * i : 2 * i + 2] = np.hstack([np.ones_like(s), s])
        known.append(np.hstack([P[keep], s * P[keep], ends]) / s**2)
        targets.append(P[keep])
        drives.append(U[keep] / s**2)
        omegas.append(omega[keep])
    omega = np.concatenate(omegas)
    if len(omega) < 20:
        raise DataError(
            f"recording {records[0].name!r}: only {len(omega)} frequencies around the resonance; record for longer"
        )
    base, target = (_real(np.concatenate(parts)) for parts in (known, targets))
    # Columns of s-powers differ by orders of magnitude; scaled, the projection is exact to rounding.
    size = np.linalg.norm(base, axis=0)
    basis, triangle = np.linalg.qr(base / size)
    rest = target - basis @ (basis.T @ target)
    complex_drive = np.concatenate(drives)

    def delayed(tau: FloatArray) -> FloatArray:
        return _real(complex_drive * np.exp(-1j * omega[:, None] * tau))

    def unexplained(columns: FloatArray) -> float:
        """Return the residual of two projected columns, up to a constant."""
        share = columns.T @ rest
        return -float((share * np.linalg.lstsq(columns.T @ columns, share, rcond=None)[0]).sum())

    def misfit(tau: FloatArray) -> float:
        columns = delayed(tau)
        return unexplained(columns - basis @ (basis.T @ columns))

    bounds = {q.name: (q.lower, q.upper) for q in structure.parameters}
    longest = min(0.5 * np.pi / high * 2, bounds["tau_x"][1])
    grid = np.linspace(0.0, longest, 7)
    sampled = [delayed(np.array([a, a])) for a in grid]  # both axes at once: pairs of delays share their columns
    sampled = [columns - basis @ (basis.T @ columns) for columns in sampled]
    pairs = [(i, j) for i in range(len(grid)) for j in range(len(grid))]
    scores = [unexplained(np.column_stack([sampled[i][:, 0], sampled[j][:, 1]])) for i, j in pairs]
    at = pairs[int(np.argmin(scores))]
    first = grid[at[0]], grid[at[1]]
    step = grid[1] / 2
    simplex = np.array([first, (first[0] + step, first[1]), (first[0], first[1] + step)])
    options = {"initial_simplex": simplex, "xatol": 1e-6, "fatol": np.inf, "maxiter": 200}
    tau = minimize(misfit, first, method="Nelder-Mead", options=options).x
    tau = np.array(
        [np.clip(t, 2 * bounds[f"tau_{a}"][0], bounds[f"tau_{a}"][1]) for t, a in zip(tau, AXES, strict=True)]
    )

    columns = delayed(tau)
    projected = columns - basis @ (basis.T @ columns)
    gain = np.linalg.lstsq(projected, rest, rcond=None)[0]
    rest_of_base = np.linalg.solve(triangle, basis.T @ (target - columns @ gain)) / size[:, None]
    found = {f"tau_{axis}": float(t) for axis, t in zip(AXES, tau, strict=True)}
    for letter, matrix in zip("kdb", (rest_of_base[:2].T, rest_of_base[2:4].T, gain.T), strict=True):
        found |= {f"{letter}_{pair}": float(v) for pair, v in zip(PAIRS, matrix.ravel(), strict=True)}
    return _zero_unless_found(structure, found)


def _second_order_lag(records: tuple[Record, ...], channel: int, sample_time: float) -> tuple[float, float, float]:
    """Return poles [rad/s] and gain of ``u + a1 ud + a2 udd = kappa r`` with r constant between samples."""
    rows: list[ComplexArray] = []
    targets: list[ComplexArray] = []
    laplace: list[ComplexArray] = []
    n_records = len(records)
    for i, record in enumerate(records):
        omega, R = _spectrum(record.inputs[:, [channel]], sample_time)
        _, U = _spectrum(record.outputs[:, [channel]], sample_time)
        keep = (omega > 0) & (omega < 0.4 * np.pi / sample_time)
        s = 1j * omega[keep, None]
        held = R[keep] * (1 - np.exp(-s * sample_time)) / (s * sample_time)
        ends = np.zeros((len(s), 2 * n_records), complex)
        ends[:, 2 * i : 2 * i + 2] = np.hstack([np.ones_like(s), s])
        rows.append(np.hstack([held, -s * U[keep], -(s**2) * U[keep], ends]))
        targets.append(U[keep])
        laplace.append(np.asarray(s, complex))
    base, target, s = (np.concatenate(parts) for parts in (rows, targets, laplace))
    a1 = a2 = gain = 0.0
    for _ in range(4):  # Sanathanan-Koerner: weights 1 / last denominator, for the output error
        weight = 1 / (1 + a1 * s + a2 * s**2)
        columns = _real(base * weight)
        size = np.linalg.norm(columns, axis=0)
        gain, a1, a2 = (np.linalg.lstsq(columns / size, _real(target * weight)[:, 0], rcond=None)[0] / size)[:3]
    return (*_real_poles(a1, a2, sample_time), float(gain))


def _real_poles(a1: float, a2: float, sample_time: float) -> tuple[float, float]:
    """Return slow and fast pole of ``1 + a1 s + a2 s^2``; the nearest real stable pair for other poles."""
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


def _real(values: ComplexArray) -> FloatArray:
    return np.vstack([values.real, values.imag])
