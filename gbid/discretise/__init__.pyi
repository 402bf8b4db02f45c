"""Public names of `gbid.discretise`, and the files that define them: the one list."""

from .exact import (
    Discrete as Discrete,
    Hold as Hold,
    delayed_taps as delayed_taps,
    discretise as discretise,
    exponentials as exponentials,
    propagate as propagate,
    squarings_for as squarings_for,
)
