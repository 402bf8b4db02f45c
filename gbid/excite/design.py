"""Design of an excitation for a model, within limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import UsageError
from gbid.excite.design_goal import Focused, Quantities, goal_of, quantities_of
from gbid.excite.excitation import Excitation, ExcitationKind, ExcitationLines, ExcitationSequence
from gbid.excite.excitation_limits import SAFE, ExcitationLimits
from gbid.excite.information.expected import expected_covariance
from gbid.excite.information.line_model import LineModel
from gbid.excite.known_model import KnownModel, known_model
from gbid.excite.signals.multisine import design_multisine
from gbid.excite.signals.prbs_choice import choose_prbs
from gbid.excite.signals.use_of_limits import use_of
from gbid.identify import FitResult
from gbid.threads import one_blas_thread

_SHORTEST = 200  # samples


def design_excitation(
    model: FitResult | KnownModel,
    *,
    duration: float,
    sample_time: float,
    limits: ExcitationLimits | Mapping[str, float],
    kind: ExcitationKind = "multisine",
    focus: Focused = None,
) -> Excitation:
    """Return the excitation of one recording that determines the parameters best, with the deviations to be expected.

    Parameters
    ----------
    model : FitResult or KnownModel
        What is known of the machine. Of a fit, the information of its recordings counts as well: the result is the
        next recording that serves best after them. A `KnownModel` is a structure with parameters, such as those of
        `gbid.LPVModel.key_parameters`, and the noise of its outputs.
    duration : float
        Length of the recording [s].
    sample_time : float
        Time between samples [s].
    limits : ExcitationLimits or dict of str to float
        Limits; a dict has the largest magnitude of each channel by signal or channel.
    kind : {"multisine", "prbs"}
        Multisine: spectrum by convex design with a certificate, phases and amplitudes by descent at equal peaks. PRBS:
        hold, register, taps and amplitude by the same criterion.
    focus : str, sequence of str, dict of str to float, optional
        What counts: names or patterns of parameters, and of ``frequency_1``, ``damping_1`` and so on of the modes, such
        as ``"damping_*"`` or ``("k_*", "tau_*")`` (D-criterion of these). A dict gives the standard deviation that
        counts as one (A-criterion). By default all parameters, without those of the disturbance gain alone.

    Returns
    -------
    Excitation
        Signals, standard deviations to be expected, and the limits that are reached.

    Raises
    ------
    UsageError
        When an option is wrong, an input has no limit, or no excitation determines the parameters.

    Notes
    -----
    The information matrix of a spectrum follows from the derivatives of the predictor by the parameters at each line
    (Ljung, System Identification, Secs. 9.4 and 13.3; Goodwin and Payne, Dynamic System Identification, 1977). The
    standard deviations of the result are not taken from it: they come from the sums of a fit over a simulated
    recording, see `gbid.excite.expected_covariance`.
    """
    if kind not in ("prbs", "multisine"):
        raise UsageError(f"kind = {kind!r}; choose 'prbs' or 'multisine'")
    known = known_model(model)
    n_samples = _samples(duration, sample_time)
    limits = limits if isinstance(limits, ExcitationLimits) else ExcitationLimits(peaks=dict(limits))
    with one_blas_thread():
        lines = LineModel.of(known, sample_time)
        quantities = quantities_of(lines)
        goal = goal_of(lines, quantities, focus)
        earlier = known.earlier_of(lines.free)
        before = lines.noise_information(n_samples) + (0.0 if earlier is None else earlier)
        gap, of_lines, sequence = None, None, None
        if kind == "multisine":
            made = design_multisine(goal, lines, limits, n_samples, before)
            signal, gap = made.signal(n_samples), made.gap
            period_s = made.period * sample_time
            of_lines = ExcitationLines(made.bins / period_s, made.spectrum, period_s)
        else:
            chosen = choose_prbs(goal, lines, limits, n_samples, before)
            signal, sequence = chosen.signal, chosen.sequence
        return as_excitation(lines, quantities, limits, signal, goal.names, gap, of_lines, sequence)


def as_excitation(
    lines: LineModel,
    quantities: Quantities,
    limits: ExcitationLimits,
    signal: FloatArray,
    counted: tuple[str, ...],
    gap: float | None = None,
    of_lines: ExcitationLines | None = None,
    sequence: ExcitationSequence | None = None,
) -> Excitation:
    """Return a signal with the standard deviations to be expected, and its use of the limits."""
    known = lines.known
    expected = expected_covariance(known, signal, lines.sample_time)
    earlier = known.earlier_of(lines.free)
    together = None
    if earlier is not None:
        own = np.isfinite(np.diag(expected.covariance))
        joined = earlier.copy()
        joined[np.ix_(own, own)] += np.linalg.inv(expected.covariance[np.ix_(own, own)])
        together = quantities.std(np.asarray(np.linalg.inv(joined), float))
    use = use_of(limits, lines, signal, with_machines=True)
    units = {q.name: q.unit for q in known.structure.parameters}
    units |= {name: "Hz" if name.startswith("frequency_") else "" for name in quantities.names if name not in units}
    return Excitation(
        kind="prbs" if of_lines is None else "multisine",
        signals={name: signal[:, known.channels(name)[1]] for name in known.inputs},
        sample_time=lines.sample_time,
        values=dict(zip(quantities.names, quantities.values.tolist(), strict=True)),
        std=quantities.std(expected.covariance),
        std_together=together,
        counted=counted,
        use={name: SAFE * share for name, share in use.items()},
        gap=gap,
        lines=of_lines,
        sequence=sequence,
        units=units,
    )


def _samples(duration: float, sample_time: float) -> int:
    for name, value in (("duration", duration), ("sample_time", sample_time)):
        if not (np.isfinite(value) and value > 0):
            raise UsageError(f"{name} = {value} s; it must be positive")
    n_samples = round(duration / sample_time)
    if n_samples < _SHORTEST:
        raise UsageError(f"duration = {duration:g} s is {n_samples} samples; give at least {_SHORTEST}")
    return n_samples
