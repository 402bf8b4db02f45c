"""Schema of the import section: recordings listed one by one, found by file name, or listed in a table."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from gbid.experiment.fields import (
    Count,
    CountOrZero,
    Name,
    Names,
    NotNegative,
    Number,
    Positive,
    Section,
    Switch,
    Text,
)

Kind = Literal["excited", "stationary", "staircase"]
KINDS: dict[str, Kind] = {
    "excited": "excited",
    "prbs": "excited",
    "stationary": "stationary",
    "still": "stationary",
    "staircase": "staircase",
}
"""Words for the kind of a recording in file names and tables."""


class ColumnsSection(Section):
    """Columns of one signal in a file; see `gbid.recording.SignalMapping`.

    `rests_at_limits`: the signal stays at its largest or smallest value by design, as an input may. It is then not
    reported as saturated.
    """

    columns: Names
    unit: str | None = None
    stored_unit: str | None = None
    channels: Names | None = None
    rests_at_limits: Switch = False


class FileSection(Section):
    """Mapping of a file; see `gbid.recording.ImportMapping`.

    `remove_mean` subtracts the mean of each signal over the samples used; a linear model has no offset.
    """

    sample_time_s: Positive | None = None
    time: Text | None = None
    time_unit: Text | None = None
    samples: tuple[CountOrZero, Count | None] | None = None
    from_s: NotNegative | None = None
    to_s: Positive | None = None
    piece: Count | None = None
    encoding: Text | None = None
    decimal: Literal[".", ","] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    header_line: Count | None = None
    remove_mean: Switch = False
    conditions: dict[Text, Number] = Field(default_factory=dict)
    signals: Annotated[dict[Text, ColumnsSection], Field(min_length=1)]


class ImportedSection(FileSection):
    """One recording from a file; see `gbid.recording.ImportMapping`.

    `remove_mean` subtracts the mean of each signal over the samples used; a linear model has no offset.
    """

    name: Name
    file: Text
    kind: Kind = "excited"


class FolderSection(FileSection):
    """All files of the data folder whose names match a pattern; see `gbid.recording.ImportMapping`.

    `pattern` is a file name with fields: ``{name}`` and ``{kind}``, ``{pressure_bar:g}`` (a number),
    ``{speed_rpm:d}`` (a whole number), and any other word for a part that is ignored. With a ``/`` in it, subfolders
    are searched. `more_conditions` names further fields to store as conditions. `kinds` gives the meaning of the words
    of ``{kind}``, `kind` that of a recording without this field. `ignore` lists patterns of files, with ``*`` and
    ``?``, that do not belong to the experiment. `operating_point` may be false for rigs without pressure and speed.
    """

    pattern: Text
    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    ignore: Names | None = None
    more_conditions: Names | None = None
    operating_point: Switch = True


class TableSection(FileSection):
    """Recordings listed in a CSV table in the data folder; see `gbid.recording.ImportMapping`.

    Each recording has a row with the columns ``file``, ``pressure_bar``, ``speed_rpm``, and optionally ``name`` and
    ``kind``. `more_conditions` names further columns to store as conditions. `operating_point` may be false for rigs
    without pressure and speed.
    """

    file: Text
    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    more_conditions: Names | None = None
    operating_point: Switch = True


class ImportSection(Section):
    """Recordings from measured files: listed one by one, found by file name, or listed in a table."""

    data_folder: Text = "."
    recordings: Annotated[tuple[ImportedSection, ...], Field(min_length=1)] | None = None
    folder: FolderSection | None = None
    table: TableSection | None = None
