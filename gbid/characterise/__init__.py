"""Static characterisation: staircases of the rotor-bearing system (Sec. 3.1) and of the piezos (Appendix A)."""

from gbid.characterise.piezo import PiezoCurve, characterise_piezo, static_rows
from gbid.characterise.staircase import StaticMap, characterise_staircase

__all__ = [
    "PiezoCurve",
    "StaticMap",
    "characterise_piezo",
    "characterise_staircase",
    "static_rows",
]
