"""Notes on surfaces over pressure and speed, GB301 to GB399."""

from __future__ import annotations

from gbid.notes.note_kind import Explanation, NoteKind


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
