"""Notes on designs, impacts and targets, GB401 to GB499."""

from __future__ import annotations

from gbid.notes.note_kind import Explanation, NoteKind


class ControlNote(NoteKind):
    """Kinds of notes on designs of controllers, impacts and the chain on a target."""

    UNSTABLE_OPEN_LOOP = Explanation(
        "GB401",
        "the open loop is not stable",
        "The plant is unstable at the operating points named, so the controller must never be switched off there.",
        "Check the plant; start and stop elsewhere.",
    )
    PEAK_NOT_LIMITED = Explanation(
        "GB402",
        "damping alone was maximised",
        "Without a limit on a sensitivity the design may lie close to instability.",
        "Give peak_sensitivity, or a goal such as PeakSensitivity(2.0).",
    )
    SAMPLED_LOOP = Explanation(
        "GB403",
        "what the sampled loop has",
        "The design is for continuous time with a delay for sampling. The loop was checked with exact hold and delays.",
        "Nothing; `sample_time` designs in the sampled loop itself.",
    )
    NO_STABILISING_GAINS = Explanation(
        "GB404",
        "no gains within the bounds were found that stabilise a loop",
        "The worst loop and its mode are named.",
        "Widen the bounds, use another structure, or leave the operating point out.",
    )
    LIMITS_EXCEEDED = Explanation(
        "GB405",
        "no design was found that keeps all limits",
        "The design with the smallest violation is given.",
        "Loosen a limit, use a structure with more freedom, or tune for fewer operating points.",
    )
    NO_CERTIFICATE = Explanation(
        "GB406",
        "there is no certificate of optimality",
        "To first order the objective could still rise by the share named, but no method found a better design.",
        "More starts may help (starts=...).",
    )
    SOLVER_STOPPED = Explanation(
        "GB407",
        "the fit of the free response stopped early",
        "The solver of the ring-down ended without converging.",
        "Look at the figures of the impact; leave the impact out if it is a bad hit.",
    )
    DOUBLE_HIT = Explanation(
        "GB408",
        "the hammer hit twice",
        "The free response is taken from the end of the last pulse.",
        "Repeat the impact if much of the response is lost.",
    )
    MODES_ALIKE = Explanation(
        "GB409",
        "frequencies differ by less than their uncertainty",
        "Which mode is which is not certain.",
        "Use more impacts, along both axes.",
    )
    INTERPOLATED = Explanation(
        "GB410",
        "interpolation between nodes of a schedule has an error",
        "The chain on the target interpolates its table; the largest error of an entry is named.",
        "Use more nodes if the error matters.",
    )
    FURTHER_MODES = Explanation(
        "GB411",
        "the response rings in more than two modes",
        "Decays at further frequencies are fitted beside the two modes, so that they do not bias these.",
        "Nothing; a longer recording tells whether they belong to the rotor or to the rig.",
    )
    FIT_NOT_CONVERGED = Explanation(
        "GB412",
        "a plant is a fit that did not converge",
        "The design is for the model of the last iteration, which may be far from the machine.",
        "Repeat the fit from a nearer start or with more iterations, or check the design on another model.",
    )
