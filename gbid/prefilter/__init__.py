"""Prefilter (paper, Sec. 3.5): map of run-out and unbalance, removal of spikes and offsets, running median.

The public names are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is first used.
"""

from gbid.core.public import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
