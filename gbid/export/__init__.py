"""Export to other programs: tables, data files, MATLAB, ROSS, C, FMU.

The public names are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is first used, so
that `gbid --help`, which names the targets of an export, imports nothing heavy.
"""

from gbid.core.public import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
