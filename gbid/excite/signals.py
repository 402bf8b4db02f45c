"""Signals of an excitation: multisines with optimal spectrum and small peaks, and PRBS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import ComplexArray, FloatArray, IntArray
from gbid.core.errors import UsageError
from gbid.excite.excitation import ExcitationSequence
from gbid.excite.goal import DesignGoal, LineModel
from gbid.excite.limits import SAFE, ExcitationLimits, LimitedSignal, limited_signals

_PHASE_NORMS = (4.0, 10.0, 24.0)  # exponents of the norm over time, one after the other: of the phases alone,
_AMPLITUDE_NORMS = (24.0, 60.0, 150.0)  # and of amplitudes and phases together
_STARTS = 2  # phases to begin with: those of Schroeder, and random ones
_PEAK_OPTIONS = {"maxiter": 50}
_PER_CYCLE = 8  # points in a cycle of the highest line: more would see a higher peak by less than a hundredth


class Waves:
    """Limited signals over one period as functions of the amplitudes of all lines.

    Parameters
    ----------
    limited : sequence of LimitedSignal
        Signals over their limits.
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    """

    def __init__(self, limited: Sequence[LimitedSignal], bins: IntArray) -> None:
        n = int(min(8192, 2 ** np.ceil(np.log2(_PER_CYCLE * bins.max()))))
        self._turn = np.exp(2j * np.pi * np.outer(np.arange(n) / n, bins))
        self._rows = np.concatenate([each.response for each in limited], axis=1)  # (n_lines, n_channels, n_inputs)
        self._first = np.cumsum([0, *(each.response.shape[1] for each in limited)])[:-1]

    def norm(self, spectrum: ComplexArray, exponent: float) -> tuple[float, ComplexArray]:
        """Return the p-norm of all signals over time, for large p the largest peak, and its gradient in the spectrum.

        The slope g is that of ``norm(U + dU) = norm(U) + Re sum conj(g) dU``.
        """
        lines = np.einsum("fcu,fu->fc", self._rows, spectrum)
        values = np.asarray((self._turn @ lines).real)
        squares = np.add.reduceat(values**2, self._first, axis=1)
        top = squares.max()
        if np.isinf(exponent):
            return float(np.sqrt(top)), np.zeros_like(spectrum)
        powers = (squares / top) ** (exponent / 2)
        mean = float(powers.sum() / len(powers))
        size = np.sqrt(top) * mean ** (1 / exponent)
        inner = powers / np.maximum(squares, 1e-300) * (size / (mean * len(powers)))
        widths = np.diff([*self._first, values.shape[1]])
        back = self._turn.conj().T @ (values * np.repeat(inner, widths, axis=1))
        return float(size), np.einsum("fcu,fc->fu", self._rows.conj(), back)


def with_small_peaks(
    goal: DesignGoal,
    sensitivity: ComplexArray,
    limited: Sequence[LimitedSignal],
    bins: IntArray,
    spectrum: ComplexArray,
    n_samples: int,
) -> ComplexArray:
    """Return the amplitudes of a multisine scaled to a largest peak of one, with the best criterion found locally.

    First the phases alone are moved by the steepest norm of the signals (Guillaume, Schoukens, Pintelon and Kollar
    1991). Then amplitudes and phases together are moved by the criterion of the signal at its largest peak.

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    sensitivity : (n_lines, n_free, n_outputs, n_inputs) array
        Sensitivities at the lines.
    limited : sequence of LimitedSignal
        Signals over their limits.
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    spectrum : (n_lines, n_inputs) array
        Amplitudes to start from.
    n_samples : int
        Length of the recording.

    Returns
    -------
    (n_lines, n_inputs) array
    """
    waves = Waves(limited, bins)
    psi = np.sqrt(n_samples / 2) * sensitivity
    first = _schroeder(np.sum(abs(spectrum) ** 2, axis=1))
    random = np.random.default_rng(len(bins)).uniform(-np.pi, np.pi, (_STARTS - 1, len(bins)))
    tried = [_descended(goal, waves, psi, spectrum, angle) for angle in (first, *random)]
    return min(tried, key=lambda each: each[0])[1]


def _descended(
    goal: DesignGoal, waves: Waves, psi: ComplexArray, spectrum: ComplexArray, angle: FloatArray
) -> tuple[float, ComplexArray]:
    """Return criterion and amplitudes at the end of a descent from given phases."""

    def log_norm(angle: FloatArray, exponent: float) -> tuple[float, FloatArray]:
        turned: ComplexArray = spectrum * np.exp(1j * angle)[:, None]
        size, slope = waves.norm(turned, exponent)
        return np.log(size), np.sum(slope.conj() * 1j * turned, axis=1).real / size

    for exponent in _PHASE_NORMS:
        angle = scipy.optimize.minimize(
            log_norm, angle, (exponent,), jac=True, method="L-BFGS-B", options=_PEAK_OPTIONS
        ).x
    amplitudes = spectrum * np.exp(1j * angle)[:, None]

    def criterion(flat: FloatArray, exponent: float, scale: FloatArray) -> tuple[float, FloatArray]:
        trial = _complex(flat, amplitudes.shape) * scale
        size, slope = waves.norm(trial, exponent)
        driven = np.einsum("fpyu,fu->pfy", psi, trial)
        columns = driven.reshape(len(driven), -1) / size
        raw = (columns @ columns.conj().T).real
        P = goal.gradient(raw)
        pushed = np.einsum("fpyu,pfy->fu", psi.conj(), (P @ columns).reshape(driven.shape)) / size
        total = 2 * np.sum(P * raw) * slope / size - 2 * pushed
        return goal.loss(raw), np.ascontiguousarray(total * scale).view(float).ravel()

    # Scaled by their size, strong and weak lines turn alike.
    for exponent in _AMPLITUDE_NORMS:
        amplitudes = amplitudes / waves.norm(amplitudes, exponent)[0]
        scale = np.linalg.norm(amplitudes, axis=1)[:, None]
        flat = np.ascontiguousarray(amplitudes / scale).view(float).ravel()
        optimum = scipy.optimize.minimize(
            criterion, flat, (exponent, scale), jac=True, method="L-BFGS-B", options=_PEAK_OPTIONS
        )
        amplitudes = _complex(optimum.x, amplitudes.shape) * scale
    amplitudes = amplitudes / waves.norm(amplitudes, np.inf)[0]
    return goal.loss(_information(psi, amplitudes[:, :, None])), amplitudes


def _complex(flat: FloatArray, shape: tuple[int, ...]) -> ComplexArray:
    return np.ascontiguousarray(flat).view(complex).reshape(shape)


def _schroeder(power: FloatArray) -> FloatArray:
    """Return phases that spread the lines over the period (Schroeder 1970)."""
    share = np.concatenate([[0.0], np.cumsum(power / power.sum())[:-1]])
    return np.asarray(-2 * np.pi * np.cumsum(share))


# ---- Optimal spectrum of the inputs: a convex programme over the cross spectra of all lines.
#
# With the cross spectrum :math:`\Phi_f \succeq 0` of the inputs at line f the information is
# :math:`M = M_0 + \sum_f \mathrm{Re}\,\Psi_f \Phi_f \Psi_f^H`. The criterion of M is maximised while the mean squares
# of the limited signals, :math:`\sum_f \mathrm{tr}(C_{if} \Phi_f)`, stay below one.
#
# With :math:`\Phi_f = L_f L_f^H` and the limits as one norm of the mean squares, which is smooth and scales with the
# signals, this is an unconstrained problem for a quasi-Newton method. In the cross spectra it is convex, so the
# stationary point is the optimum; but this is not relied on.
#
# The equivalence theorem (Kiefer and Wolfowitz 1960) gives the certificate: with multipliers w, no spectrum within the
# limits has a criterion higher by more than :math:`\max_f \lambda_{max}(S_f; \sum_i w_i C_{if}) - \mathrm{tr}(P (M -
# M_0))`.

_NORMS = (15.0, 100.0)  # exponents of the norm of the mean squares, one after the other
_SPECTRUM_OPTIONS = {"maxiter": 400, "maxcor": 30}


class Spectrum(NamedTuple):
    """Optimal spectrum with its certificate.

    Attributes
    ----------
    cross : (n_lines, n_inputs, n_inputs) array
        Cross spectra: mean squares and mean products of the inputs at each line, for limits of one.
    gap : float
        Duality gap per counted quantity: standard deviations are on average at most half of this, as a part, above
        those of the best spectrum.
    sensitivity : (n_lines, n_inputs, n_inputs) array
        Sensitivities S at the optimum: ``tr(S Phi)`` is what a cross spectrum adds.
    """

    cross: ComplexArray
    gap: float
    sensitivity: ComplexArray


def optimal_spectrum(goal: DesignGoal, sensitivity: ComplexArray, costs: ComplexArray, n_samples: int) -> Spectrum:
    """Return the spectrum with the best criterion under limits on the mean squares.

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    sensitivity : (n_lines, n_free, n_outputs, n_inputs) array
        Sensitivities of the predictions, for errors of unit covariance.
    costs : (n_limits, n_lines, n_inputs, n_inputs) array
        Mean square of each limited signal over its limit, by the cross spectra.
    n_samples : int
        Length of the recording.

    Returns
    -------
    Spectrum
    """
    n_lines, _, _, n_u = sensitivity.shape
    psi = np.sqrt(n_samples) * sensitivity  # the mean square Phi of a line has the information Re psi Phi psi^H
    scale = costs.mean(axis=0)
    into = _root(scale, -0.5)
    psi, costs = psi @ into[:, None], into @ costs @ into
    root = np.repeat(np.eye(n_u, dtype=complex)[None], n_lines, axis=0)

    def loss(flat: FloatArray, exponent: float) -> tuple[float, FloatArray]:
        factors = _complex(flat, root.shape)
        cross = factors @ factors.conj().transpose(0, 2, 1)
        used = _mean_squares(costs, cross)
        size = float(np.linalg.norm(used, exponent))
        raw = _information(psi, factors) / size
        P = goal.gradient(raw)
        turn = np.sum(P * raw) * (used / size) ** (exponent - 1)
        slope = (np.einsum("i,ifuv->fuv", turn, costs) - _sensitivities(psi, P)) @ factors * (2 / size)
        return goal.loss(raw), np.ascontiguousarray(slope).view(float).ravel()

    for exponent in _NORMS:
        root /= np.sqrt(np.linalg.norm(_mean_squares(costs, root @ root.conj().transpose(0, 2, 1)), exponent))
        optimum = scipy.optimize.minimize(
            loss, root.view(float).ravel(), (exponent,), jac=True, method="L-BFGS-B", options=_SPECTRUM_OPTIONS
        )
        root = _complex(optimum.x, root.shape)
    used = _mean_squares(costs, root @ root.conj().transpose(0, 2, 1))
    root /= np.sqrt(used.max())
    multipliers = (used / used.max()) ** (_NORMS[-1] - 1)
    multipliers /= multipliers.sum()
    raw = _information(psi, root)
    P = goal.gradient(raw)
    S = _sensitivities(psi, P)
    dual = _root(np.einsum("i,ifuv->fuv", multipliers, costs), -0.5)
    gap = float(np.linalg.eigvalsh(dual @ S @ dual)[:, -1].max() - np.sum(P * raw))
    back, root = _root(scale, 0.5), into @ root
    return Spectrum(root @ root.conj().transpose(0, 2, 1), gap, back @ S @ back)


def _mean_squares(costs: ComplexArray, cross: ComplexArray) -> FloatArray:
    return np.asarray(np.einsum("ifuv,fvu->i", costs, cross).real)


def _information(psi: ComplexArray, root: ComplexArray) -> FloatArray:
    """Return ``sum_f Re Psi_f L_f L_f^H Psi_f^H`` of factors L (n_lines, n_u, n)."""
    columns = (psi @ root[:, None]).transpose(1, 0, 2, 3).reshape(psi.shape[1], -1)
    return np.asarray((columns @ columns.conj().T).real)


def _sensitivities(psi: ComplexArray, P: FloatArray) -> ComplexArray:
    """Return ``Psi^H P Psi`` at each line, (n_lines, n_u, n_u), positive semidefinite."""
    values, vectors = np.linalg.eigh(P)
    turned = np.einsum("pq,fpyu->fqyu", vectors * np.sqrt(np.maximum(values, 0.0)), psi, optimize=True)
    flat = turned.reshape(len(psi), -1, psi.shape[3])
    return np.asarray(flat.conj().transpose(0, 2, 1) @ flat)


def _root(matrices: ComplexArray, power: float) -> ComplexArray:
    """Return a real power of positive semidefinite Hermitian matrices."""
    values, vectors = np.linalg.eigh(matrices)
    values = np.maximum(values, np.finfo(float).tiny if power < 0 else 0.0) ** power
    return np.asarray((vectors * values[:, None, :]) @ vectors.conj().transpose(0, 2, 1))


# ---- Use of the limits: largest value of each limited signal over its limit.

_SEEN = 1e-4  # lines of the disc below this part of its largest one do not count in other machines
IN_MACHINES = "clearance in all machines"
"""Name of the limit of the other machines."""


def use_of(
    limits: ExcitationLimits, lines: LineModel, signal: FloatArray, with_machines: bool = False
) -> dict[str, float]:
    """Return the largest value of each limited signal, as a share of the usable limit.

    The signal is periodic, and its transient has passed.

    Parameters
    ----------
    limits : ExcitationLimits
        The limits.
    lines : LineModel
        The model.
    signal : (n_samples, n_inputs) array
        Inputs.
    with_machines : bool
        Whether the machines of the limits count, too.
    """
    known = lines.known
    twice = np.vstack([signal, signal])
    outputs = known.model.simulate(twice, lines.sample_time, intersample=known.intersample)[len(signal) :]
    use = dict[str, float]()
    for bound in limits.bounds(known):
        values = (signal if bound.is_input else outputs)[:, bound.columns]
        use[bound.name] = float(np.linalg.norm(values, axis=1).max() / (SAFE * bound.limit))
    if with_machines and limits.machines:
        columns = known.channels(limits.disc)[1]
        use[IN_MACHINES] = float(max(disc_in_machines(limits, lines, *_lines_of(lines, signal, columns))))
    return use


def disc_in_machines(
    limits: ExcitationLimits, lines: LineModel, bins: IntArray, spectrum: ComplexArray, period: int
) -> Iterator[float]:
    """Yield the largest disc radius in each possible machine, as a share of the remaining clearance.

    Parameters
    ----------
    limits : ExcitationLimits
        Limits with a clearance.
    lines : LineModel
        The model.
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    spectrum : (n_lines, n_inputs) array
        Their amplitudes.
    period : int
        Samples of the period.
    """
    assert limits.clearance is not None
    columns = lines.known.channels(limits.disc)[1]
    frequency = bins / (period * lines.sample_time)
    for machine in limits.machines:
        response = lines.response(frequency, dict(machine.parameters))[:, columns]
        disc = _one_period(bins, np.einsum("fcu,fu->fc", response, spectrum), period)
        yield float(np.linalg.norm(disc, axis=1).max() / (SAFE * (limits.clearance - machine.taken)))


def _one_period(bins: IntArray, spectrum: ComplexArray, period: int) -> FloatArray:
    """Return one period (period, n) of signals with amplitudes (n_lines, n) at spectral lines."""
    every_line = np.zeros((period // 2 + 1, spectrum.shape[1]), complex)
    every_line[bins] = spectrum * (period / 2)
    return np.fft.irfft(every_line, period, axis=0)


def _lines_of(lines: LineModel, signal: FloatArray, columns: list[int]) -> tuple[IntArray, ComplexArray, int]:
    """Return the spectral lines of a signal that move the disc."""
    n = len(signal)
    bins = np.arange(1, n // 2)
    spectrum = np.fft.rfft(signal, axis=0)[bins] * (2 / n)
    strong = np.abs(spectrum).max(axis=1) > _SEEN * np.abs(spectrum).max()
    bins, spectrum = bins[strong], spectrum[strong]
    response = lines.response(bins / (n * lines.sample_time))[:, columns]
    motion = np.linalg.norm(np.einsum("fcu,fu->fc", response, spectrum), axis=1)
    seen = motion > _SEEN * motion.max()
    return bins[seen].astype(np.int64), spectrum[seen], n


# ---- Multisine: lines, optimal spectrum, and amplitudes with small peaks.

PERIOD_S = 1.0
"""Longest period of a multisine [s]: lines are a multiple of its inverse apart."""
_ALONG, _NEAR = 40, 24  # lines over the whole range, and lines around each mode
_WIDTH = 5.0  # half bandwidths around a mode
_HIGHEST = 0.4  # of the sampling frequency
_LEAST = 1e-3  # part of the information of a line or direction that is left out: it would only make peaks
_ROUNDS = 2
_CREST = 1.8  # of a signal whose phases are not known yet
_HARDEST = 8  # machines that are designed for; the others are only checked


class Multisine(NamedTuple):
    """Multisine scaled to its limits.

    Attributes
    ----------
    bins : (n_lines,) integer array
        Lines as multiples of one over the period.
    period : int
        Samples of the period.
    spectrum : (n_lines, n_inputs) array
        Amplitudes: one period is ``Re sum U exp(2 pi j bin k / period)``.
    gap : float
        Certificate of the spectrum, see `Spectrum`.
    """

    bins: IntArray
    period: int
    spectrum: ComplexArray
    gap: float

    def signal(self, n_samples: int) -> FloatArray:
        """Return the inputs, (n_samples, n_inputs)."""
        return np.resize(_one_period(self.bins, self.spectrum, self.period), (n_samples, self.spectrum.shape[1]))


def design_multisine(goal: DesignGoal, lines: LineModel, limits: ExcitationLimits, n_samples: int) -> Multisine:
    """Return the multisine with the best criterion within limits.

    The spectrum is designed on every second multiple of one over the period, with the full cross spectrum of the
    inputs. A line whose inputs should not be coherent gives its second direction to the free multiple above it
    (interleaved lines). Peaks are not known before the phases are. So spectrum and phases are found in turn: the second
    spectrum knows the crest factors of the first.

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    lines : LineModel
        The model.
    limits : ExcitationLimits
        The limits.
    n_samples : int
        Length of the recording.
    """
    dt = lines.sample_time
    period = n_samples // max(1, round(n_samples * dt / PERIOD_S))
    coarse = 2 * _candidates(lines, period * dt)
    frequency = coarse / (period * dt)
    at = lines.at(frequency)
    hard: list[int] = []
    crest = dict[str, float]()
    for round_ in range(_ROUNDS):
        limited = _limited(limits, lines, frequency, at.response, hard)
        costs: ComplexArray = np.array(
            [
                crest.get(each.name, _CREST) ** 2 * each.response.conj().transpose(0, 2, 1) @ each.response
                for each in limited
            ]
        )
        best = optimal_spectrum(goal, at.sensitivity / np.sqrt(2), costs / 2, n_samples)
        bins, spectrum = _interleaved(coarse, best.cross, best.sensitivity)
        chosen = lines.at(bins / (period * dt))
        limited = _limited(limits, lines, chosen.frequency_hz, chosen.response, hard)
        spectrum = with_small_peaks(goal, chosen.sensitivity, limited, bins, spectrum, n_samples)
        multisine = Multisine(bins, period, spectrum, best.gap)
        multisine = multisine._replace(
            spectrum=spectrum / max(use_of(limits, lines, multisine.signal(period)).values())
        )
        crest = {each.name: _crest(each, multisine) for each in limited}
        if limits.machines and round_ < _ROUNDS - 1:
            use = np.array(list(disc_in_machines(limits, lines, bins, multisine.spectrum, period)))
            hard = sorted(np.argsort(-use)[:_HARDEST].tolist())
    shrunk = min(1.0, 1 / max(use_of(limits, lines, multisine.signal(period), with_machines=True).values()))
    return multisine._replace(spectrum=multisine.spectrum * shrunk)


def _crest(signal: LimitedSignal, multisine: Multisine) -> float:
    """Return the crest factor of a limited signal: largest value over root mean square."""
    values = _one_period(multisine.bins, np.einsum("fcu,fu->fc", signal.response, multisine.spectrum), multisine.period)
    way = np.linalg.norm(values, axis=1)
    return float(way.max() / np.sqrt(np.mean(way**2)))


def _limited(
    limits: ExcitationLimits, lines: LineModel, frequency_hz: FloatArray, response: ComplexArray, hard: Sequence[int]
) -> list[LimitedSignal]:
    """Return the limited signals of the model, and of the possible machines with the smallest remaining clearance."""
    chosen = replace(limits, machines=tuple(limits.machines[i] for i in hard))
    others = [lines.response(frequency_hz, dict(machine.parameters)) for machine in chosen.machines]
    return limited_signals(chosen, lines.known, response, others)


def _candidates(lines: LineModel, period_s: float) -> IntArray:
    """Return candidate lines as multiples of two over the period: over the whole range, denser around the modes."""
    top = _HIGHEST / lines.sample_time
    wanted = [np.geomspace(2 / period_s, top, _ALONG)]
    for frequency, damping in lines.known.model.modes():
        width = max(_WIDTH * damping * frequency, 4 / period_s)
        wanted.append(frequency + width * np.linspace(-1, 1, _NEAR))
    multiples = np.round(np.concatenate(wanted) * period_s / 2)
    return np.unique(multiples[(multiples >= 1) & (multiples * 2 / period_s <= top)]).astype(np.int64)


def _interleaved(bins: IntArray, cross: ComplexArray, sensitivity: ComplexArray) -> tuple[IntArray, ComplexArray]:
    """Return lines of one direction each: the first direction of a cross spectrum, the second one line higher.

    Lines with little information are left out.
    """
    values, vectors = np.linalg.eigh(cross)
    informs = values * np.einsum("fui,fuv,fvi->fi", vectors.conj(), sensitivity, vectors).real
    least = _LEAST * informs.sum()
    at, amplitude = list[int](), list[ComplexArray]()
    for line, size, direction, information in zip(bins.tolist(), values, vectors, informs, strict=True):
        for above, i in enumerate(range(len(size) - 1, max(len(size) - 3, -1), -1)):
            if information[i] > least:
                at.append(line + above)
                amplitude.append(np.sqrt(2 * size[i]) * direction[:, i])
    return np.array(at, dtype=np.int64), np.array(amplitude)


# ---- PRBS: hold, register and taps chosen by the design criterion, amplitude by the limits.

_REGISTERS = range(4, 15)
_HOLDS = 10  # tried between a sample and a half period of the slowest mode
_LINES = 160  # of the grid on which sequences are compared
_HIGHEST_ON_GRID = 0.45  # of the sampling frequency


def choose_prbs(
    goal: DesignGoal, lines: LineModel, limits: ExcitationLimits, n_samples: int
) -> tuple[ExcitationSequence, FloatArray]:
    """Return the maximal-length sequence with the best criterion within limits, and its inputs (n_samples, n_u).

    Parameters
    ----------
    goal : DesignGoal
        The criterion.
    lines : LineModel
        The model.
    limits : ExcitationLimits
        The limits.
    n_samples : int
        Length of the recording.

    Notes
    -----
    A sequence of each hold is as long as the recording allows, or half as long, with the taps of the register or their
    mirror image. All inputs have the same sequence, shifted by equal parts of its period. The information is that of
    the periodogram of the signal, summed around lines that are dense at the modes.
    """
    model = lines.known.model
    grid = _grid(lines, n_samples)
    at = lines.at(grid)
    frequency = np.fft.rfftfreq(n_samples, lines.sample_time)
    cell = np.searchsorted(np.sqrt(grid[1:] * grid[:-1]), np.maximum(frequency, 1e-9))
    n_u = model.B.shape[1]
    best, lowest = None, np.inf
    for sequence in _sequences(lines, n_samples, n_u):
        unit = _signal(sequence, n_samples, lines.sample_time)
        amplitude = 1 / max(use_of(limits, lines, unit).values())
        spectrum = np.fft.rfft(unit * amplitude, axis=0)[1:] * (2 / n_samples)
        loss = goal.loss(_information_on_grid(at.sensitivity, spectrum, cell[1:], n_samples))
        if loss < lowest:
            best, lowest = replace(sequence, amplitude=amplitude), loss
    if best is None:
        raise UsageError(
            f"no PRBS of {n_samples * lines.sample_time:g} s determines all parameters; give a longer duration, or "
            "fix some parameters"
        )
    signal = _signal(best, n_samples, lines.sample_time)
    shrunk = min(1.0, 1 / max(use_of(limits, lines, signal, with_machines=True).values()))
    return replace(best, amplitude=best.amplitude * shrunk), signal * shrunk


def _grid(lines: LineModel, n_samples: int) -> FloatArray:
    dt = lines.sample_time
    wanted = [np.geomspace(1 / (n_samples * dt), _HIGHEST_ON_GRID / dt, _LINES // 2)]
    for frequency, damping in lines.known.model.modes():
        wanted.append(frequency * (1 + 6 * max(damping, 1e-3) * np.linspace(-1, 1, _LINES // 4)))
    frequency_hz = np.unique(np.concatenate(wanted))
    return np.asarray(frequency_hz[(frequency_hz > 0) & (frequency_hz <= _HIGHEST_ON_GRID / dt)])


def _sequences(lines: LineModel, n_samples: int, n_inputs: int) -> list[ExcitationSequence]:
    dt = lines.sample_time
    slowest = min((frequency for frequency, _ in lines.known.model.modes()), default=1 / (n_samples * dt) * 20)
    longest = max(2, min(int(2.5 / (slowest * dt)), n_samples // 16))
    sequences = list[ExcitationSequence]()
    for hold in np.unique(np.round(np.geomspace(1, longest, _HOLDS)).astype(int)).tolist():
        fitting = [n for n in _REGISTERS if (2**n - 1) * hold <= n_samples]
        for register in fitting[-2:]:
            taps = tuple(int(tap) for tap in _TAPS[register])
            mirrored = tuple(sorted((register - tap for tap in taps), reverse=True))
            length = 2**register - 1
            shift = tuple(length * i // n_inputs for i in range(n_inputs))
            sequences += [ExcitationSequence(1.0, hold * dt, register, each, shift) for each in {taps, mirrored}]
    return sequences


_TAPS = {
    4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,), 11: (9,), 12: (11, 10, 4), 13: (12, 11, 8),
    14: (13, 12, 2),
}  # fmt: skip
"""Taps of registers of maximal length, as in scipy.signal.max_len_seq."""


def _signal(sequence: ExcitationSequence, n_samples: int, sample_time: float) -> FloatArray:
    bits = 2.0 * scipy.signal.max_len_seq(sequence.register, taps=np.array(sequence.taps))[0] - 1.0
    hold = round(sequence.hold_s / sample_time)
    columns = [np.resize(np.repeat(np.roll(bits, -shift), hold), n_samples) for shift in sequence.shift]
    return np.column_stack(columns) * sequence.amplitude


def _information_on_grid(
    sensitivity: ComplexArray, spectrum: ComplexArray, cell: IntArray, n_samples: int
) -> FloatArray:
    """Return the information of a signal; each of its lines is evaluated at the nearest line of a grid."""
    n_u = spectrum.shape[1]
    cross = np.zeros((len(sensitivity), n_u, n_u), complex)
    np.add.at(cross, cell, spectrum[:, :, None] * spectrum[:, None, :].conj())
    flat = np.einsum("fpyu,fuv,fqyv->pq", sensitivity, cross, sensitivity.conj(), optimize=True)
    return np.asarray(n_samples / 2 * flat.real)
