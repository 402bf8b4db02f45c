"""Notes on fits, GB101 to GB199."""

from __future__ import annotations

from gbid.notes.note_kind import Explanation, NoteKind


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
