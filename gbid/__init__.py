"""Grey-box identification and damping control of rotors on controllable gas bearings.

The public names and packages are those of the stub beside this file, ``__init__.pyi``. Each is imported when it is
first used, so that ``import gbid`` costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
