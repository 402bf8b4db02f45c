"""Design of an excitation for a model within limits, and of the length of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbid.core.arrays import one_blas_thread
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive
from gbid.excite.excitation import Excitation, ExcitationKind, ExcitationLines
from gbid.excite.goal import Focused, LineModel, expected_covariance, goal_of, quantities_of
from gbid.excite.limits import SAFE, ExcitationLimits
from gbid.excite.model import KnownModel, known_model
from gbid.excite.signals import choose_prbs, design_multisine, use_of
from gbid.identify import FitResult

_SHORTEST = 200  # samples


def design_excitation(
    model: FitResult | KnownModel,
    *,
    duration: Positive,
    sample_time: Positive,
    limits: ExcitationLimits | Mapping[str, float],
    kind: ExcitationKind = "multisine",
    focus: Focused = None,
) -> Excitation:
    """Return the excitation that determines the parameters best, with the expected standard deviations.

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
    recording, see `expected_covariance`.
    """
    known = known_model(model)
    n_samples = round(duration / sample_time)
    if n_samples < _SHORTEST:
        raise UsageError(f"duration = {duration:g} s is {n_samples} samples; give at least {_SHORTEST}")
    limits = limits if isinstance(limits, ExcitationLimits) else ExcitationLimits(peaks=dict(limits))
    with one_blas_thread():
        lines = LineModel.of(known, sample_time)
        quantities = quantities_of(lines)
        earlier = known.earlier_of(lines.free)
        goal = goal_of(lines, quantities, focus)
        goal = replace(goal, earlier=lines.noise_information(n_samples) + (0.0 if earlier is None else earlier))
        parts: dict[str, Any]
        if kind == "multisine":
            multisine = design_multisine(goal, lines, limits, n_samples)
            signal, period_s = multisine.signal(n_samples), multisine.period * sample_time
            parts = {
                "gap": multisine.gap,
                "lines": ExcitationLines(multisine.bins / period_s, multisine.spectrum, period_s),
            }
        else:
            sequence, signal = choose_prbs(goal, lines, limits, n_samples)
            parts = {"sequence": sequence}
        expected = expected_covariance(known, signal, sample_time).covariance
        together = None
        if earlier is not None:
            determined = np.ix_(*[np.isfinite(np.diag(expected))] * 2)
            joined = earlier.copy()
            joined[determined] += np.linalg.inv(expected[determined])
            together = quantities.std(np.asarray(np.linalg.inv(joined), float))
        use = use_of(limits, lines, signal, with_machines=True)
    units = {q.name: q.unit for q in known.structure.parameters}
    units |= {name: "Hz" if name.startswith("frequency_") else "" for name in quantities.names if name not in units}
    return Excitation(
        kind=kind,
        signals={name: signal[:, known.channels(name)[1]] for name in known.inputs},
        sample_time=sample_time,
        values=dict(zip(quantities.names, quantities.values.tolist(), strict=True)),
        std=quantities.std(expected),
        std_together=together,
        counted=goal.names,
        use={name: SAFE * share for name, share in use.items()},
        units=units,
        **parts,
    )


# ---- Length of the recording that reaches given standard deviations.

_FIRST_S, _SHORTEST_S = 2.0, 0.5
_ROUNDS = 4
_SHARES = (1.0, 0.7, 0.5, 0.25)


@dataclass(frozen=True, eq=False)
class RecordingLength(Brief):
    """Shortest recording that reaches given standard deviations within limits.

    Attributes
    ----------
    duration_s : float
        Length of the recording at the full amplitude [s].
    excitation : Excitation
        The excitation of this length, with the standard deviations to be expected.
    targets : dict of str to float
        Standard deviation wanted of each quantity.
    decisive : str
        Quantity that needs this length.
    by_amplitude : dict of float to float
        Length [s] by the part of the amplitude that is used: half the amplitude needs four times the length.
    """

    duration_s: float
    excitation: Excitation
    targets: Mapping[str, float]
    decisive: str
    by_amplitude: Mapping[float, float]


def recording_length(
    model: FitResult | KnownModel,
    *,
    sample_time: Positive,
    limits: ExcitationLimits | Mapping[str, float],
    absolute: Mapping[str, Positive] | None = None,
    relative: Mapping[str, Positive] | None = None,
    kind: ExcitationKind = "multisine",
    longest_s: float = 600.0,
) -> RecordingLength:
    """Return the length of a recording that reaches given standard deviations.

    The excitation is designed for the targets (A-criterion). Variances fall as one over the length, so a short design
    gives the length. It is designed again at that length, which must then reach the targets.

    Parameters
    ----------
    model : FitResult or KnownModel
        What is known of the machine, with its noise. Earlier recordings do not count here.
    sample_time : float
        Time between samples [s].
    limits : ExcitationLimits or dict of str to float
        Limits, as of `gbid.design_excitation`.
    absolute : dict of str to float, optional
        Standard deviations wanted, by name or pattern of parameters and modes, such as ``{"tau_*": 5e-6}``.
    relative : dict of str to float, optional
        The same as parts of the values, such as ``{"damping_*": 0.01}``.
    kind : {"multisine", "prbs"}
        Kind of signal.
    longest_s : float
        Longest recording to consider [s].

    Returns
    -------
    RecordingLength

    Raises
    ------
    UsageError
        When there are no targets, a name is unknown, or even the longest recording does not reach them.
    """
    known = known_model(model, earlier=False)
    quantities = quantities_of(LineModel.of(known, sample_time))
    targets = dict[str, float]()
    for given, of_value in ((absolute or {}, False), (relative or {}, True)):
        for pattern, wanted in given.items():
            for i in quantities.matching((pattern,), "targets"):
                std = wanted * abs(quantities.values[i]) if of_value else wanted
                if not std > 0:
                    raise UsageError(f"{quantities.names[i]} is 0 and has no relative target; give an absolute one")
                targets[quantities.names[i]] = min(std, targets.get(quantities.names[i], np.inf))
    if not targets:
        raise UsageError("no targets; give absolute or relative standard deviations by name")
    duration = _FIRST_S
    for _ in range(_ROUNDS):
        excitation = design_excitation(
            known, duration=duration, sample_time=sample_time, limits=limits, kind=kind, focus=targets
        )
        over = {name: excitation.std[name] / wanted for name, wanted in targets.items()}
        decisive = max(over, key=lambda name: over[name])
        needed = excitation.duration_s * over[decisive] ** 2
        if not needed <= longest_s:
            raise UsageError(
                f"a standard deviation of {targets[decisive]:.3g} for {decisive} needs {needed:.3g} s, "
                f"longer than longest_s = {longest_s:g} s; allow more amplitude, time or deviation"
            )
        if over[decisive] <= 1.0 and (duration > _FIRST_S or needed > 0.7 * duration or duration <= _SHORTEST_S):
            break
        # A little more than needed: the next design differs slightly.
        duration = max(_SHORTEST_S, np.ceil(1.02 * needed / _SHORTEST_S) * _SHORTEST_S)
    else:
        raise UsageError(f"no length up to {duration:g} s was found that reaches the targets")
    by_amplitude = {share: excitation.duration_s / share**2 for share in _SHARES}
    return RecordingLength(excitation.duration_s, excitation, targets, decisive, by_amplitude)
