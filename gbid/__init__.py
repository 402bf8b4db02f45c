"""Grey-box identification and damping control of rotors on controllable gas bearings.

The public names and packages are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is
first used, so that ``import gbid`` costs next to nothing.
"""

import sys
from itertools import pairwise
from os.path import dirname

if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:  # Python is looking for the module of `python -m MODULE`
    _is_gbid = any(a[:1] == "-" and a[-1] == "m" and b.split(".")[0] == "gbid" for a, b in pairwise(sys.orig_argv))
    # The current folder stands first then. Data may lie there, and a file such as json.py would be executed.
    if _is_gbid and sys.path[0] != dirname(dirname(__file__)):  # noqa: PTH120  (pathlib would be looked up there)
        del sys.path[0]

from .core.figures import Pictured
from .core.public import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)


def _draw(*value: object, **options: object) -> object:
    """Draw the first figure of a value; matplotlib is imported at the first call."""
    from .report.pictures import shown

    return shown(*value, **options)


Pictured.renderer = staticmethod(_draw)
