"""Exact discretisation: matrix exponential, zero-order and first-order hold, linear recursion, integrator steps.

The public names are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is first used.
"""

from gbid.core.public import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
