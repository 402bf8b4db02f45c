"""Declaration of a stored field, written beside the field: unit, long name, shape and place in the HDF5 file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stored:
    """Unit, long name, shape and place of a field: ``mean: Annotated[FloatArray, Stored("m", "mean position")]``.

    Numbers with a declaration are stored in a dataset, single numbers without one in an attribute.

    Attributes
    ----------
    unit : str
        Attribute ``units`` of the dataset; "1" for ratios, "" when the structure determines the unit.
    long_name : str
        Attribute ``long_name``: meaning in words; by default the name of the field.
    shape : str
        Lengths, e.g. ``"n 2"``; a word stands for the same length in all fields of the dataclass.
    at : str
        Place below the group of the dataclass, e.g. ``"parameters/estimate"``, or ``"parameters@units"`` for an
        attribute; by default the name of the field.
    keys : str
        For a mapping, the attribute with its keys; mappings with the same attribute share their keys. By default the
        attribute ``names`` of the dataset.
    """

    unit: str = ""
    long_name: str = ""
    shape: str = ""
    at: str = ""
    keys: str = ""


NOT_STORED = Stored(at="nowhere")
"""Mark of a field that is not stored; the reader passes it, or it has a default."""
