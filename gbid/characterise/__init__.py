"""Static characterisation: staircases of the rotor-bearing system (Sec. 3.1) and of the piezos (Appendix A)."""

from gbid.characterise.piezo import PiezoCurve, characterise_piezo
from gbid.characterise.staircase import characterise_staircase
from gbid.characterise.static_map import StaticMap
from gbid.characterise.static_store import load_static, save_static, static_rows

__all__ = [
    "PiezoCurve",
    "StaticMap",
    "characterise_piezo",
    "characterise_staircase",
    "load_static",
    "save_static",
    "static_rows",
]
