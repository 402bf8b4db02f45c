"""What a user says about a folder of measured files, and what must be asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gbid.errors import UsageError

ASKED = {
    "p": "columns of the disc position, x then y, with a comma between",
    "u": "columns of the piezo positions, x then y, with a comma between",
    "time": "column of the sample times",
    "unit": "unit of the positions in the files, such as um",
    "pressure_bar": "injection pressure of all files [bar]",
    "speed_rpm": "rotational speed of all files [rpm]",
}
"""Questions by option."""


class UnansweredError(UsageError):
    """Something that the files do not say and that must be given."""

    def __init__(self, option: str, reason: str) -> None:
        flag = f"--signal {option}=X,Y" if option in ("p", "u") else f"--{option.split('_')[0]} ..."
        super().__init__(f"{reason}; give the {ASKED[option]}: {flag}")
        self.option = option


@dataclass(frozen=True)
class DraftOptions:
    """Answers about a folder of measured files; what is not given is found in the files.

    Attributes
    ----------
    folder : pathlib.Path
        Folder of the files.
    signals : dict of str to tuple of str
        Columns of ``r``, ``u``, ``p`` and ``phi``.
    time : str or None
        Column of the sample times.
    sample_time_s : float or None
        Time between samples [s].
    unit : str or None
        Unit of positions in files that state none.
    pattern : str or None
        Pattern of the file names.
    from_s, to_s : float or None
        Part of each file to use [s].
    pressure_bar, speed_rpm : float or None
        Operating point of all files, where the names do not contain it.
    controller : str
        Structure of the controller.
    """

    folder: Path
    signals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    time: str | None = None
    sample_time_s: float | None = None
    unit: str | None = None
    pattern: str | None = None
    from_s: float | None = None
    to_s: float | None = None
    pressure_bar: float | None = None
    speed_rpm: float | None = None
    controller: str = "P"

    def answered(self, option: str, text: str) -> DraftOptions:
        """Return the options with one more answer.

        Raises
        ------
        UsageError
            When a number was expected.
        """
        if option in ("p", "u"):
            return replace(self, signals={**self.signals, option: tuple(word.strip() for word in text.split(","))})
        if option in ("time", "unit"):
            words: dict[str, Any] = {option: text.strip()}
            return replace(self, **words)
        try:
            numbers: dict[str, Any] = {option: float(text.replace(",", "."))}
            return replace(self, **numbers)
        except ValueError:
            raise UsageError(f"{option}: expected a number, found {text!r}") from None
