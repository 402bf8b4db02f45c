"""How a field of a dataclass stands in an HDF5 file, declared beside the field."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stored:
    """Unit, name in words, shape and place of a field: ``mean: Annotated[FloatArray, Stored("m", "mean position")]``.

    Numbers that are declared stand in a dataset, single ones that are not in an attribute.

    Attributes
    ----------
    unit : str
        Attribute ``units`` of the dataset; "1" for ratios, "" where it follows from the structure.
    long_name : str
        Attribute ``long_name``: what it is, in words; the name of the field when not given.
    shape : str
        Its lengths, e.g. ``"n 2"``; a word stands for the same length wherever it occurs in the dataclass.
    at : str
        Its place below the group of the dataclass, e.g. ``"parameters/estimate"``, or ``"parameters@units"`` for an
        attribute; the name of the field when not given.
    keys : str
        Of a mapping: the attribute with its keys; mappings that name the same one share them. The attribute ``names``
        of the dataset when not given.
    """

    unit: str = ""
    long_name: str = ""
    shape: str = ""
    at: str = ""
    keys: str = ""


NOT_STORED = Stored(at="nowhere")
"""Marks a field that does not stand in the file; reading gives it, or it has a default."""
