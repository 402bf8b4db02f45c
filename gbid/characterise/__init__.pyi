"""Public names of `gbid.characterise`, and the files that define them: the one list."""

from .piezo import (
    PiezoCurve as PiezoCurve,
    characterise_piezo as characterise_piezo,
    static_rows as static_rows,
)
from .staircase import (
    StaticMap as StaticMap,
    characterise_staircase as characterise_staircase,
)
