"""Identification: start values, predictor, shooting windows, solver, covariance, result.

The public names are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is first used; the
function ``fit`` at once, for its file of the same name would else take its place.
"""

from gbid.core.public import attach
from gbid.identify.fit import fit as fit

__getattr__, __dir__, __all__ = attach(__name__, __file__)
