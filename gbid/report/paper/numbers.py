"""Figures of the paper in a list for programs: `numbers.yaml` beside this file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gbid.errors import UsageError
from gbid.yaml_file import read_yaml

FILE = Path(__file__).with_name("numbers.yaml")


@dataclass(frozen=True)
class PaperNumber:
    """One figure of the paper.

    Attributes
    ----------
    id : str
        Identifier.
    where : str
        Section, table or figure.
    quantity, unit : str
        Quantity and its unit.
    value : float
        Value in the paper.
    scatter : float or None
        Scatter that the paper gives for it; None when it gives none.
    scatter_from : str
        Source of the scatter.
    at_most : bool
        Whether the figure is a size of scatter or error; a smaller value is then not a deviation.
    off : str
        Explanation of a larger deviation of our value.
    """

    id: str
    where: str
    quantity: str
    unit: str
    value: float
    scatter: float | None = None
    scatter_from: str = ""
    at_most: bool = False
    off: str = ""


def paper_numbers(path: Path = FILE) -> tuple[PaperNumber, ...]:
    """Return the figures of the paper.

    Raises
    ------
    UsageError
        When the file is faulty: a key is unknown, an explanation is missing, or an id occurs twice.
    """
    file = read_yaml(path)
    explanations: Mapping[str, str] = file.data["explanations"]
    found: dict[str, PaperNumber] = {}
    for i, row in enumerate(file.data["numbers"]):
        where = file.position(("numbers", i))
        off = row.get("off", "")
        if off and off not in explanations:
            raise UsageError(f"{where}: off: no explanation {off!r}; there is {', '.join(explanations)}")
        try:
            number = PaperNumber(**{**row, "off": " ".join(str(explanations[off]).split()) if off else ""})
        except TypeError as error:
            raise UsageError(f"{where}: {error}") from None
        if number.id in found:
            raise UsageError(f"{where}: id {number.id!r} occurs twice; remove one")
        found[number.id] = number
    return tuple(found.values())
