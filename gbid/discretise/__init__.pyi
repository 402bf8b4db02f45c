"""Public names of `gbid.discretise`, and the files that define them: the one list."""

from .exact import (
    Discrete as Discrete,
    Exponentials as Exponentials,
    Hold as Hold,
    Taps as Taps,
    check_holds as check_holds,
    delayed_taps as delayed_taps,
    discretise as discretise,
    distinct_steps as distinct_steps,
    exponentials as exponentials,
    hold_response as hold_response,
    over_sample as over_sample,
    propagate as propagate,
    squarings_for as squarings_for,
    step_numbers as step_numbers,
)
from .steps import (
    IntegratorName as IntegratorName,
    one_step as one_step,
    step_inputs as step_inputs,
)
