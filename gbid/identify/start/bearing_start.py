"""Start values of a rotor bearing from data, by least squares in the frequency domain.

A model ``sum_i theta_i R_i(s) = 0`` is linear in its coefficients for given delays. A fit then is a least-squares
problem over some hundred frequencies. The ends of a record add a polynomial in s to the transform of a derivative; the
polynomial is estimated together with the coefficients.
"""

from __future__ import annotations

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray
from gbid.errors import DataError
from gbid.identify.data import Record, moves
from gbid.identify.start.spectra import as_real, spectrum_of
from gbid.structure import RotorBearing
from gbid.structure.rotor_bearing import AXES, PAIRS

_REGULAR = 1e-10  # determinant of two columns, as a part of that of orthogonal ones, above which they are told apart
_FREQUENCIES = 800  # largest number in the band of the resonance; modes are much wider than their distance
_ENOUGH = 50_000  # largest number of samples of a record for start values; the fit uses all


def _resonance_band(spectra: list[tuple[FloatArray, ComplexArray, ComplexArray]]) -> tuple[float, float]:
    """Return the band around the resonance [rad/s], which contains the two modes, from frequencies and transforms.

    Its centre is the peak of ``|P|^2 / |U|``, the geometric mean of power and gain. Power alone may have a peak where
    the input is strong: a PRBS has little power at the inverse of its hold time. Gain alone may have one where both are
    noise.
    """
    totals: dict[int, FloatArray] = {}
    resolution = 2.0  # Hz: smooths the spectrum, and is small compared with the frequencies of the modes
    for omega, U, P in spectra:
        bins = (omega / (2 * np.pi * resolution)).astype(int)
        binned = np.array([np.bincount(bins, (np.abs(values) ** 2).sum(1)) for values in (U, P)])
        totals[binned.shape[1]] = totals.get(binned.shape[1], np.zeros_like(binned)) + binned
    drive, response = totals[max(totals)]
    response[: int(10 / resolution)] = 0.0  # excludes drift and creep
    amplitude = np.sqrt(drive)
    strength = response / (amplitude + 1e-3 * amplitude.max()) if amplitude.any() else response  # a free decay has none
    peak = 2 * np.pi * resolution * (int(np.argmax(strength)) + 0.5)
    return 0.3 * peak, 2.5 * peak


def bearing_start(structure: RotorBearing, records: tuple[Record, ...], sample_time: float) -> dict[str, float]:
    """Return K, D and B by least squares for given delays; a grid and a simplex search find the two delays."""
    records = tuple(Record(r.name, r.inputs[:_ENOUGH], r.outputs[:_ENOUGH]) for r in records)
    spectra = [(*spectrum_of(r.inputs, sample_time), spectrum_of(r.outputs, sample_time)[1]) for r in records]
    low, high = _resonance_band(spectra)
    known, targets, drives, omegas = [], [], [], []
    n_records = len(records)
    for i, (omega, U, P) in enumerate(spectra):
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
    base, target = (as_real(np.concatenate(parts)) for parts in (known, targets))
    # Columns of s-powers differ by orders of magnitude; scaled, the projection is exact to rounding.
    size = np.linalg.norm(base, axis=0)
    basis, triangle = np.linalg.qr(base / size)
    rest = target - basis @ (basis.T @ target)
    if not any(moves(record.inputs).any() for record in records):  # free decays: no delays, no gains
        rest_of_base = np.linalg.lstsq(base / size, target, rcond=None)[0] / size[:, None]
        return _named(structure, rest_of_base)
    complex_drive = np.concatenate(drives)

    def delayed(tau: FloatArray) -> FloatArray:
        return as_real(complex_drive * np.exp(-1j * omega[:, None] * tau))

    def unexplained(columns: FloatArray) -> float:
        """Return the residual of two projected columns, up to a constant."""
        share, own = columns.T @ rest, columns.T @ columns
        (a, b), (_, c) = own
        regular = a * c - b * b > _REGULAR * a * c
        gain = np.array([[c, -b], [-b, a]]) @ share / (a * c - b * b) if regular else np.linalg.lstsq(own, share)[0]
        return -float((share * gain).sum())

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
    tau = scipy.optimize.minimize(misfit, first, method="Nelder-Mead", options=options).x
    tau = np.array(
        [np.clip(t, 2 * bounds[f"tau_{a}"][0], bounds[f"tau_{a}"][1]) for t, a in zip(tau, AXES, strict=True)]
    )

    columns = delayed(tau)
    projected = columns - basis @ (basis.T @ columns)
    gain = np.asarray(np.linalg.lstsq(projected, rest, rcond=None)[0])
    rest_of_base = np.linalg.solve(triangle, basis.T @ (target - columns @ gain)) / size[:, None]
    delays = {f"tau_{axis}": float(t) for axis, t in zip(AXES, tau, strict=True)}
    return {**_named(structure, rest_of_base, gain), **delays}


def _named(structure: RotorBearing, motion: FloatArray, gain: FloatArray | None = None) -> dict[str, float]:
    """Return all parameters by name, zero for those not found, from coefficients of displacement, speed and input."""
    found = dict.fromkeys((q.name for q in structure.parameters), 0.0)
    matrices = {"k": motion[:2].T, "d": motion[2:4].T} | ({} if gain is None else {"b": gain.T})
    for letter, matrix in matrices.items():
        found |= {f"{letter}_{pair}": float(v) for pair, v in zip(PAIRS, matrix.ravel(), strict=True)}
    return found
