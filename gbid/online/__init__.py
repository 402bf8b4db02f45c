"""On-line computations beside a controller: cancellation of unbalance, and recursive estimates.

The public names are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is first used.
"""

from gbid.core.public import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
