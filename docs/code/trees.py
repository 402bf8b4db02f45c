"""Trees of the HDF5 files of results, from the types of the results."""

from gbid.control import ImpactStudy
from gbid.control.assessment import TunedDesign
from gbid.core.hdf5.types import Attributes, Columns, DataclassGroup, Inline, Keyed, Leaf, Numbered, OneOf, record
from gbid.identify import FitResult, FitTable
from gbid.lpv import LPVFit
from gbid.prefilter import PiezoCurve, StaticMap
from gbid.prefilter.filtering import PrefilterFile
from gbid.validate import ValidationSummary

KINDS = {"f": "float", "i": "integer", "b": "boolean", "U": "text"}


def tree(place, codec, indent=""):
    """Print what is stored at a place: name, type, shape, unit and meaning."""
    if isinstance(codec, OneOf):
        codec = codec.codecs[0]
    if isinstance(codec, Keyed):
        place, codec = f"{place} (keys: {codec.keys or 'names'})", codec.values
    if isinstance(codec, Leaf):
        shape = "" if codec.shape == () else f"({', '.join(codec.shape or '?')})"
        stored = codec.stored
        print(f"{indent}{place:34} {KINDS[codec.kind]:8} {shape:12} {stored.unit:8} {stored.long_name}".rstrip())
        return
    inside = [(key, leaf) for key, leaf in codec.fields] if isinstance(codec, Columns) else []
    if isinstance(codec, DataclassGroup):
        parts = [
            each.record.fields if isinstance(each, Inline) else [(key, key, each)] for _, key, each in codec.fields
        ]
        inside = [(key, leaf) for part in parts for _, key, leaf in part]
    print(f"{indent}{place}/" + (" one attribute for each entry" if isinstance(codec, Attributes) else ""))
    if isinstance(codec, Numbered):
        inside = [("0000, 0001, ...", codec.each)]
    for key, each in inside:
        tree(key, each, indent + "  ")


def print_trees():
    for kind in (
        FitResult,
        FitTable,
        LPVFit,
        ValidationSummary,
        PrefilterFile,
        StaticMap,
        PiezoCurve,
        ImpactStudy,
        TunedDesign,
    ):
        tree(f"{kind.__name__}", record(kind))
        print()
