"""The paper's figures as a list that a program can read: `numbers.yaml` beside this file."""

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
    where : str
        Section, table or figure.
    quantity, unit : str
    value : float
    scatter : float or None
        How far a value may lie off by the paper's own account; None where it does not say.
    scatter_from : str
        Where that is from.
    at_most : bool
        Whether the figure is itself a size of scatter or error, where less is no deviation.
    off : str
        Why ours may lie further off, in words.
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
    """Read the paper's figures.

    Raises
    ------
    UsageError
        When the file is broken: a key is unknown, an explanation is not there, an id stands twice.
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
            raise UsageError(f"{where}: id {number.id!r} is there twice; remove one")
        found[number.id] = number
    return tuple(found.values())
