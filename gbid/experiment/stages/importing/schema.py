"""What an experiment YAML may say of recordings from files of one's own: one by one, by file name, or by table."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from gbid.experiment.fields import Count, CountOrZero, Name, Names, Number, Positive, Section, Switch, Text

Kind = Literal["excited", "stationary", "staircase"]
KINDS: dict[str, Kind] = {
    "excited": "excited",
    "prbs": "excited",
    "stationary": "stationary",
    "still": "stationary",
    "staircase": "staircase",
}
"""Words for the kind of a recording, in file names and tables."""


class ColumnsSection(Section):
    """Where one signal stands in a file; see `gbid.recording.SignalMapping`.

    `rests_at_limits` says that the signal stays at its largest or smallest value by design, as an input may, so
    that it is not taken for saturated.
    """

    columns: Names
    unit: str | None = None
    stored_unit: str | None = None
    channels: Names | None = None
    rests_at_limits: Switch = False


class FileSection(Section):
    """How a file is read; see `gbid.recording.ImportMapping`.

    `remove_mean` takes the mean of each signal off the samples that are kept; a linear model has no offset.
    """

    sample_time_s: Positive | None = None
    time: Text | None = None
    time_unit: Text | None = None
    samples: tuple[CountOrZero, Count | None] | None = None
    remove_mean: Switch = False
    conditions: dict[Text, Number] = Field(default_factory=dict)
    signals: Annotated[dict[Text, ColumnsSection], Field(min_length=1)]


class ImportedSection(FileSection):
    """One recording from a file; see `gbid.recording.ImportMapping`.

    `remove_mean` takes the mean of each signal off the samples that are kept; a linear model has no offset.
    """

    name: Name
    file: Text
    kind: Kind = "excited"


class FolderSection(FileSection):
    """All files of the data folder whose names fit a pattern; see `gbid.recording.ImportMapping`.

    `pattern` is a file name with fields: ``{name}`` and ``{kind}``, ``{pressure_bar:g}`` (a number) and
    ``{speed_rpm:d}`` (a whole number), and any other word for a part that does not matter. A ``/`` in it looks into
    subfolders. `more_conditions` names further fields to keep as conditions. `kinds` says what the words of
    ``{kind}`` mean, `kind` what a recording is without that field. `ignore` names files, with ``*`` and ``?``, that
    do not belong to the experiment. `operating_point` may be false for rigs without pressure and speed.
    """

    pattern: Text
    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    ignore: Names | None = None
    more_conditions: Names | None = None
    operating_point: Switch = True


class TableSection(FileSection):
    """Recordings listed in a CSV table in the data folder; see `gbid.recording.ImportMapping`.

    A row for each, with the columns ``file``, ``pressure_bar``, ``speed_rpm`` and, where wanted, ``name`` and ``kind``.
    `more_conditions` names further columns to keep as conditions. `operating_point` may be false for rigs without
    pressure and speed.
    """

    file: Text
    kind: Kind = "excited"
    kinds: dict[Text, Kind] = Field(default_factory=lambda: dict(KINDS))
    more_conditions: Names | None = None
    operating_point: Switch = True


class ImportSection(Section):
    """Recordings from files of one's own: listed one by one, found by their names, or listed in a table."""

    data_folder: Text = "."
    recordings: Annotated[tuple[ImportedSection, ...], Field(min_length=1)] | None = None
    folder: FolderSection | None = None
    table: TableSection | None = None
