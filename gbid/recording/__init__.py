"""Recordings: data type, HDF5 files, importers and quality checks.

The public names are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is first used.
"""

from gbid.core.public import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
