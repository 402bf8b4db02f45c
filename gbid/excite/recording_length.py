"""Length of the recording that reaches given standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gbid.brief import Brief
from gbid.errors import UsageError
from gbid.excite.design import design_excitation
from gbid.excite.design_goal import quantities_of
from gbid.excite.excitation import Excitation, ExcitationKind
from gbid.excite.excitation_limits import ExcitationLimits
from gbid.excite.information.line_model import LineModel
from gbid.excite.known_model import KnownModel, known_model
from gbid.identify import FitResult

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
    sample_time: float,
    limits: ExcitationLimits | Mapping[str, float],
    absolute: Mapping[str, float] | None = None,
    relative: Mapping[str, float] | None = None,
    kind: ExcitationKind = "multisine",
    longest_s: float = 600.0,
) -> RecordingLength:
    """Return how long a recording must be for given standard deviations.

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
            if not (np.isfinite(wanted) and wanted > 0):
                raise UsageError(f"target of {pattern} = {wanted}; give a positive standard deviation")
            for i in quantities.matching((pattern,), "targets"):
                one = wanted * abs(quantities.values[i]) if of_value else wanted
                if not one > 0:
                    raise UsageError(f"target of {quantities.names[i]}: its value is 0; give an absolute target")
                targets[quantities.names[i]] = min(one, targets.get(quantities.names[i], np.inf))
    if not targets:
        raise UsageError("no targets; give absolute or relative standard deviations by name")
    duration = _FIRST_S
    for _ in range(_ROUNDS):
        made = design_excitation(
            known, duration=duration, sample_time=sample_time, limits=limits, kind=kind, focus=targets
        )
        over = {name: made.std[name] / wanted for name, wanted in targets.items()}
        decisive = max(over, key=lambda name: over[name])
        needed = made.duration_s * over[decisive] ** 2
        if not needed <= longest_s:
            raise UsageError(
                f"{decisive} to {targets[decisive]:.3g} needs {needed:.3g} s, longer than longest_s = {longest_s:g} s; "
                "allow more amplitude or time, or less certainty"
            )
        if over[decisive] <= 1.0 and (duration > _FIRST_S or needed > 0.7 * duration or duration <= _SHORTEST_S):
            break
        # A little more than needed: the next design differs slightly.
        duration = max(_SHORTEST_S, np.ceil(1.02 * needed / _SHORTEST_S) * _SHORTEST_S)
    else:
        raise UsageError(f"no length up to {duration:g} s was found that reaches the targets")
    by_amplitude = {share: made.duration_s / share**2 for share in _SHARES}
    return RecordingLength(made.duration_s, made, targets, decisive, by_amplitude)
