"""Choice of the runner of a nonlinear predictor: compiled, or by CasADi's map without a compiler."""

from __future__ import annotations

from functools import partial

import casadi as ca

from gbid.compiling import CompilerMissingError
from gbid.errors import UsageError
from gbid.identify.kernel.engine import EngineName, RunEngine
from gbid.identify.nonlinear.lanes import LanesRunner
from gbid.identify.nonlinear.mapped import MappedRunner
from gbid.identify.nonlinear.mean_predictor import mean_predictor
from gbid.identify.nonlinear.nonlinear_kernel import NonlinearKernel
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearPredictor

MOST_INSTRUCTIONS = 60_000
"""Largest number of operations of all functions of a sample that are compiled: 10 000 take about 3 s."""


def choose_runner(wanted: EngineName, predictor: NonlinearPredictor) -> tuple[NonlinearKernel, RunEngine, str]:
    """Return the kernel, the name of its engine, and why it is not the compiled one if that was wanted.

    Raises
    ------
    UsageError
        When the compiled engine is required and there is no compiler.
    """
    if wanted not in ("auto", "compiled", "numpy"):
        raise UsageError(f"engine = {wanted!r}; choose 'auto', 'compiled' or 'numpy'")
    portable = MappedRunner(predictor.functions)
    linear = partial(mean_predictor, portable)
    mapped = NonlinearKernel(portable, linear)
    if wanted == "numpy":
        return mapped, "numpy", ""
    count = sum(f.n_instructions() for f in predictor.functions if isinstance(f, ca.Function))
    if wanted == "auto" and count > MOST_INSTRUCTIONS:
        return (
            mapped,
            "numpy",
            f"a compiled pass of {count} operations would take minutes to build: CasADi's map was used",
        )
    try:
        run = LanesRunner(predictor.functions)
    except (CompilerMissingError, NotImplementedError) as missing:
        if wanted == "compiled":
            raise UsageError(f"engine = 'compiled': {missing}") from None
        return mapped, "numpy", f"{missing}: CasADi's map was used, which is slower"
    return NonlinearKernel(run, linear), "compiled", run.note
