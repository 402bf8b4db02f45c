"""Notes on results: a code for each kind, with its meaning and remedy, as `gbid explain` prints them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple

from gbid.core.errors import UsageError


class Explanation(NamedTuple):
    """Explanation of a kind of notes.

    Attributes
    ----------
    code : str
        ``GB`` and three digits. It never changes, and is never given again.
    title : str
        What the note says, in a few words.
    meaning : str
        Where it comes from, and what it means for the result.
    remedy : str
        What one can do.
    """

    code: str
    title: str
    meaning: str
    remedy: str


class NoteKind(Enum):
    """Base of the kinds of notes. A member is called with the text of a note, and returns it with its code."""

    value: Explanation

    def __call__(self, text: str) -> str:
        """Return the text of a note with its code behind it.

        Parameters
        ----------
        text : str
            The note on this result, with its names and numbers.
        """
        return f"{text} [{self.value.code}]"


# ---- Notes on fits, GB101 to GB199.


class FitNote(NoteKind):
    """Kinds of notes on a fit."""

    ON_BOUND = Explanation(
        "GB101",
        "an estimate lies on a bound",
        "The criterion falls beyond the bound, so the estimate is the bound. It has no standard deviation.",
        "Widen the bound if physics allows it; else the data contradict the bound or do not determine the parameter.",
    )
    NOT_DETERMINED = Explanation(
        "GB102",
        "the data do not determine a parameter",
        "The information matrix is singular in the direction of the parameters named: other values fit as well.",
        "Excite the input that it acts on, fix the parameter (fixed=...), or state what is known (prior=...).",
    )
    SIGN_OPEN = Explanation(
        "GB103",
        "the sign of a parameter is open",
        "Its standard deviation for white errors exceeds its size. Of several parameters only a combination is known.",
        "Fix one of them, give a prior, or record longer with more excitation.",
    )
    FAR_BELOW_WHITE = Explanation(
        "GB104",
        "standard deviations are far below those for white errors",
        "The residuals say that the errors have little power where these parameters act. Few samples carry this.",
        "Use `std_with('white')` as the careful choice.",
    )
    MAY_COVER_LESS = Explanation(
        "GB105",
        "intervals may contain the truth less often than they state",
        "The errors have a peak at a lightly damped mode, and the recordings last few of its times of decay.",
        "Record longer, or free a disturbance gain (focus='prediction').",
    )
    NOT_WHITE = Explanation(
        "GB106",
        "the residuals are not white",
        "Something is left that the model does not explain: run-out, hum, a missing mode, or noise of a colour. "
        "Standard deviations allow for the colour, not for the error of the structure itself.",
        "Look at the residual test and at the harmonics that the prefilter left; free a disturbance gain.",
    )
    NO_MINIMUM = Explanation(
        "GB107",
        "this is not a minimum of the criterion, or it is flat",
        "The curvature of the criterion and the information matrix contradict each other.",
        "Try other start values (fit_multistart), and fix what the data do not determine.",
    )
    NOT_USED = Explanation(
        "GB108",
        "parameters without effect are set to zero",
        "In simulation the disturbance gain has no effect, so it is not estimated.",
        "Use focus='prediction' to estimate it; start values that were given are not used otherwise.",
    )
    OVERFLOWS = Explanation(
        "GB109",
        "the model overflows at some points of the search",
        "The solver tried parameters for which the simulation is not finite or far beyond the data, and stepped back.",
        "Nothing, if the fit converged. Bounds around what is possible make the search shorter.",
    )
    PREDICTOR_AT_EDGE = Explanation(
        "GB110",
        "the disturbance gain makes the predictor almost unstable",
        "The recording is too short to estimate the gain.",
        "Fix the gain (fixed=...), or use focus='simulation'.",
    )
    OTHER_MINIMUM = Explanation(
        "GB111",
        "there may be a lower minimum",
        "The criterion has several minima, another attempt ended lower without converging, or neighbouring residuals "
        "are strongly correlated, as they are at a minimum that is not the lowest.",
        "Compare several starts: fit_multistart, or multi_start in the YAML.",
    )
    BEGUN_ELSEWHERE = Explanation(
        "GB112",
        "the fit did not begin at the start values given",
        "They are unstable or did not lead to a minimum. The fit began at values of a fit with a steady observer.",
        "Give start values of a stable model if the result is not the one wanted.",
    )
    WINDOWS_CHANGED = Explanation(
        "GB113",
        "the shooting windows were chosen by the fit",
        "Windows of other lengths did not converge, or the model is unstable, so that its growth bounds them.",
        "Nothing; `window` sets a length.",
    )
    STARTS_FROM_DATA = Explanation(
        "GB114",
        "start values come from the data",
        "A subspace model of the data was matched to the structure for parameters without a start value.",
        "Nothing, if the structure explains most of its response; else give start values or use fit_multistart.",
    )
    STEADY_INPUT = Explanation(
        "GB115",
        "an input does not move in a recording",
        "The recording is fitted as a free decay, or as the answer to a constant force.",
        "Nothing, if it was meant; else look at the column that the input was imported from.",
    )
    SLOW_ENGINE = Explanation(
        "GB116",
        "the compiled pass was not used, or not from the cache",
        "There is no C compiler, the cache of kernels cannot be trusted or used, or the model is too large to compile.",
        "`gbid doctor` says what is missing. Results are the same; only the time differs.",
    )
    BEST_DID_NOT_CONVERGE = Explanation(
        "GB117",
        "the fit with the smallest loss did not converge",
        "Of several starts, the one with the smallest loss stopped before its minimum.",
        "Allow more iterations, or start from its parameters.",
    )
    JUMPS = Explanation(
        "GB118",
        "the equations have jumps or kinks",
        "Derivatives know only the pieces between them. Estimates of where they lie are rough, and so are their "
        "standard deviations.",
        "Replace a jump by a smooth step that is narrow enough, or compare several starts.",
    )
    GAIN_HELD = Explanation(
        "GB119",
        "the disturbance gain is held at its start value",
        "A free disturbance gain led to an almost unstable predictor. The other parameters are estimated with the gain "
        "fixed.",
        "Give the gain a prior or a better start value, or use focus='simulation'.",
    )
    INTEGRATION = Explanation(
        "GB120",
        "the error of the integration moves estimates",
        "With half the step of the integrator, an estimate would move by more than a tenth of its standard deviation.",
        "Take more steps in a sample (steps=... of the structure), or integrator='implicit' for a stiff one.",
    )
    FEEDBACK = Explanation(
        "GB121",
        "errors come back in the inputs",
        "The recording was made in closed loop, and the noise model is too poor for a direct fit: the input contains "
        "past errors, which are not white. The fit takes them for the response of the plant: estimates are biased.",
        "Free a disturbance gain (disturbance_gain='states', focus='prediction'), or fit gbid.ClosedLoop to what was "
        "injected.",
    )
    AT_REST = Explanation(
        "GB122",
        "delays of a loop begin at rest",
        "Filters of delays, and what acts through actuators that no output shows, soon forget their start. Noisy data "
        "do not determine these states at the first sample, and a fit that estimates them hardly converges.",
        "Nothing; `initial_state` sets each state.",
    )


# ---- Notes on designs, impacts and targets, GB401 to GB499.


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


# ---- Notes on recordings, prefilter, characterisation and files, GB201 to GB299.


class DataNote(NoteKind):
    """Kinds of notes on data and files."""

    SHAFT_STOOD_STILL = Explanation(
        "GB201",
        "the shaft stood still",
        "Without rotation the run-out map is the mean position alone.",
        "Nothing at 0 rpm; else check the angle signal.",
    )
    REST_NOT_CHECKED = Explanation(
        "GB202",
        "it was not checked that the piezos were at rest",
        "Neither references nor piezo positions are in the recording from which the run-out map is made.",
        "Record r or u as well, or make sure that the piezos did not move.",
    )
    SPIKES_LEFT = Explanation(
        "GB203",
        "spikes were found and left",
        "Single samples lie far from their neighbours.",
        "`spikes: true` in the prefilter replaces them.",
    )
    OTHER_CONDITION = Explanation(
        "GB204",
        "the run-out map was made at another operating point",
        "The conditions of map and recording differ, and any_condition was asked for.",
        "Record the rotor at rest at this operating point and make its own map.",
    )
    SATURATED = Explanation(
        "GB205",
        "a step of the staircase is saturated",
        "The position rests at the smallest or largest value there.",
        "Use a smaller range of commands; the step is left out.",
    )
    ONE_DIRECTION = Explanation(
        "GB206",
        "the staircase goes in one direction only",
        "The hysteresis shows only where the position is reached from both sides.",
        "Record a staircase up and down.",
    )
    NOT_MOVED = Explanation(
        "GB207",
        "no recording moves an input",
        "Its static gains are not known.",
        "Record a staircase of this input.",
    )
    CHANGED_BY_HAND = Explanation(
        "GB208",
        "a file was changed after gbid wrote it",
        "The checksum in the file is not that of its lines. The contents are used as they are now.",
        "Nothing, if it was you. Else write the file anew.",
    )


# ---- Notes on surfaces over pressure and speed, GB301 to GB399.


class SurfaceNote(NoteKind):
    """Kinds of notes on surfaces."""

    LEFT_OUT = Explanation(
        "GB301",
        "estimates were left out of the surfaces",
        "A fit did not converge, is missing, or has parameters that the data did not determine.",
        "Look at the fit that is named.",
    )
    LACK_OF_FIT = Explanation(
        "GB302",
        "the surfaces miss the means of operating points",
        "Deviations exceed the scatter between recordings. Standard deviations do not contain this lack of fit.",
        "Use a higher order, or smaller ranges of pressure and speed.",
    )
    NEGATIVE_DELAY = Explanation(
        "GB303",
        "a delay is negative in part of the domain",
        "The surface of the delay crosses zero between or beyond the points measured. The model cannot be used there.",
        "Use a lower order for the delays, or restrict the domain.",
    )
    NOT_SETTLED = Explanation(
        "GB304",
        "an iteration of the surfaces had not settled",
        "Scatter and coefficients are found in turn; the last round still moved them.",
        "Allow more rounds, or use a lower order.",
    )
    GAIN_HELD = Explanation(
        "GB305",
        "disturbance gains are held",
        "Free gains made a predictor unstable or did not converge, so they are fixed.",
        "Nothing for the surfaces; predictions of these recordings have errors of a colour.",
    )
    HELD_AT_MEAN = Explanation(
        "GB306",
        "parameters are held at the mean of the fits",
        "They have no surface, though they differ between fits.",
        "Give them a surface if they depend on the operating point.",
    )
    SCATTER_UNSEEN = Explanation(
        "GB307",
        "a recording alone determines the surfaces at its operating point",
        "The surfaces pass through its estimates, so no residual shows how it scatters. The scatter of the others is "
        "taken; where there are no others, standard deviations are far too small.",
        "Add recordings at this operating point, or use a lower order.",
    )


# ---- All kinds of notes by their codes.

_FAMILIES: Mapping[str, type[NoteKind]] = {
    "fits": FitNote,
    "data and files": DataNote,
    "surfaces": SurfaceNote,
    "control and impacts": ControlNote,
}


def families() -> dict[str, tuple[Explanation, ...]]:
    """Return the explanations by what the notes are about."""
    return {about: tuple(kind.value for kind in family) for about, family in _FAMILIES.items()}


def explanations() -> Mapping[str, Explanation]:
    """Return the explanations by code."""
    return MappingProxyType({found.code: found for group in families().values() for found in group})


def explain(code: str) -> Explanation:
    """Return the explanation of a code.

    Parameters
    ----------
    code : str
        As ``GB102``; small letters and brackets are accepted.

    Raises
    ------
    UsageError
        When there is no such code.
    """
    known = explanations()
    found = known.get(code.strip("[] ").upper())
    if found is None:
        raise UsageError(f"{code!r} is no code of a note; `gbid explain` lists all, from {min(known)} to {max(known)}")
    return found
