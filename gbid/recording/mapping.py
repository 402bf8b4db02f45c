"""Import mapping: columns, units and sample time of each signal, and layout of the file."""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError, nearest
from gbid.core.option_types import Count, CountOrZero, Finite, NotNegative, Positive, check_options, plain

DELIMITERS = (",", ";", "\t", " ")
"""Delimiters that are tried, in this order; the blank stands for any number of blanks and tabs."""
DECIMALS = (".", ",")
"""Decimal signs that are tried, in this order."""


@dataclass(frozen=True)
class TextOptions:
    r"""Layout of a text file; missing options are detected.

    Parameters
    ----------
    encoding : str, optional
        Encoding as Python names it: ``"utf-8"``, ``"cp1252"``, ``"utf-16"``.
    decimal : str, optional
        Decimal sign, ``"."`` or ``","``.
    delimiter : str, optional
        Character between the cells: ``","``, ``";"``, ``"\t"``, or ``" "`` for any number of blanks.
    header_line : int, optional
        Number of the line with the names of the columns, counted from 1; 0 numbers the columns (``"column 1"``).

    Raises
    ------
    UsageError
        When a value is not possible.
    """

    encoding: str | None = None
    decimal: Literal[".", ","] | None = None
    delimiter: str | None = None
    header_line: CountOrZero | None = None

    def __post_init__(self) -> None:
        check_options(self)
        if self.encoding is not None:
            try:
                codecs.lookup(self.encoding)
            except LookupError:
                raise UsageError(
                    f"encoding: {self.encoding!r} is not known; write utf-8, cp1252 or utf-16, for example"
                ) from None
        if self.delimiter is not None and len(self.delimiter) != 1:
            raise UsageError(f"delimiter = {self.delimiter!r}; give one character such as ';'", "delimiter")

    def given(self) -> list[str]:
        """Return the names of the given options."""
        return [each.name for each in fields(self) if getattr(self, each.name) is not None]


class FilePart(NamedTuple):
    """Selected axis and samples of the arrays in a file.

    Attributes
    ----------
    axis : int
        Axis of time in arrays with two dimensions.
    samples : tuple of int, optional
        First sample and the one after the last; all when not given.
    """

    axis: int = 0
    samples: tuple[int, int] | None = None


@dataclass(frozen=True)
class Calibration:
    """Calibration of a column: conversion of numbers to values in the signal's unit.

    Parameters
    ----------
    points : tuple of (float, float)
        Numbers in the file and values, from a calibration sheet; straight lines between them, which go on beyond the
        first and the last point.

    Raises
    ------
    UsageError
        When there are fewer than two points, or when two have the same number.
    """

    points: tuple[tuple[Finite, Finite], ...]

    def __post_init__(self) -> None:
        check_options(self)
        rising = tuple(sorted((float(number), float(value)) for number, value in self.points))
        object.__setattr__(self, "points", rising)
        if len({number for number, _ in rising}) < max(2, len(rising)):
            raise UsageError(
                "calibration: points: give at least two pairs [number in the file, value], with different numbers"
            )

    def apply(self, numbers: FloatArray) -> FloatArray:
        """Return calibrated values of numbers (n_samples,)."""
        x, y = np.array(self.points).T
        slopes = np.diff(y) / np.diff(x)
        k = np.clip(np.searchsorted(x, numbers) - 1, 0, len(slopes) - 1)
        return np.asarray(y[k] + slopes[k] * (numbers - x[k]))

    def beyond(self, numbers: FloatArray) -> int:
        """Return how many numbers lie outside the calibration points."""
        return int(np.sum((numbers < self.points[0][0]) | (numbers > self.points[-1][0])))


@dataclass(frozen=True)
class SignalMapping:
    """Columns of a file that form one signal of a recording.

    Parameters
    ----------
    columns : tuple of str
        Columns in the order of the channels, one for each channel. In a csv file these are names in the header line.
        In an npz or mat file they are variables (``"u_x"``) or columns of an (n_samples, n_channels) array
        (``"noise[0]"``, counted from 0). Fields of a MATLAB struct or object have dotted names (``"data.u[0]"``).
        `gbid peek FILE` shows the names of any file.
    unit : str, optional
        Unit of the numbers in the file, after their calibration where there is one. When it is not given, the unit in
        the csv header is used.
    stored_unit : str, optional
        Unit in the recording. When it is not given, it is the SI unit of a signal of the rig
        (`gbid.core.units.SIGNALS`), otherwise the unit of the file.
    channels : tuple of str, optional
        Names of the channels; when not given, the default names of `Recording`.
    hold : bool
        Whether missing samples have the last value before them, as a command has between its samples.
    interpolate : bool
        Whether missing samples lie on a straight line in time between those around them, as an input with first-order
        hold does.
    scale, offset : float or tuple of float, optional
        Calibration of each column, ``scale * number + offset`` in `unit`, which must be given; one number for all
        columns, or one for each.
    calibration : Calibration or tuple of Calibration, optional
        The same from the points of a calibration sheet: ``{"points": [[0.0, 0.0], [10.0, 125.0]]}``.

    Raises
    ------
    UsageError
        When an entry has the wrong type.
    """

    columns: tuple[str, ...]
    unit: str | None = None
    stored_unit: str | None = None
    channels: tuple[str, ...] | None = None
    hold: bool = False
    interpolate: bool = False
    scale: Finite | tuple[Finite, ...] | None = None
    offset: Finite | tuple[Finite, ...] | None = None
    calibration: Calibration | tuple[Calibration, ...] | None = None

    def __post_init__(self) -> None:
        plain(vars(self))  # refuses values that contain themselves
        object.__setattr__(self, "columns", _words("columns", self.columns))
        given: Any = self.calibration
        is_list = isinstance(given, list | tuple)
        object.__setattr__(self, "calibration", tuple(map(_calibration, given)) if is_list else _calibration(given))
        if self.channels is not None:
            object.__setattr__(self, "channels", _words("channels", self.channels))
            if len(self.channels) != len(self.columns):
                raise UsageError(f"{len(self.columns)} columns but {len(self.channels)} channels; give one name each")
        check_options(self)
        if self.hold and self.interpolate:
            raise UsageError("hold and interpolate are both true; an input is one of them between its samples")
        _ = self.calibrations  # its checks

    @property
    def calibrations(self) -> tuple[Calibration | None, ...]:
        """Calibration of each column; None for a column without calibration."""
        given = [key for key in ("scale", "offset", "calibration") if getattr(self, key) is not None]
        if not given:
            return (None,) * len(self.columns)
        if self.unit is None:
            raise UsageError(f"{given[0]}: give unit, too: that of the calibrated values")
        if len(given) > 1 and "calibration" in given:
            raise UsageError(f"{given[0]} and calibration are both given; keep one")
        if self.calibration is not None:
            return tuple(_each("calibration", self.calibration, len(self.columns)))
        scales = _each("scale", 1.0 if self.scale is None else self.scale, len(self.columns))
        offsets = _each("offset", 0.0 if self.offset is None else self.offset, len(self.columns))
        if 0 in scales:
            raise UsageError("scale = 0; give what one unit of the numbers in the file is in the unit of the signal")
        return tuple(Calibration(((0.0, b), (1.0, a + b))) for a, b in zip(scales, offsets, strict=True))

    @classmethod
    def from_dict(cls, entries: Mapping[str, Any]) -> SignalMapping:
        """Return the mapping from a plain dict with the field names as keys; an unknown key raises UsageError.

        Parameters
        ----------
        entries : dict
            Keys and values as in the YAML.
        """
        _check_keys(entries, [f.name for f in fields(cls)], needed=["columns"])
        return cls(**entries)


@dataclass(frozen=True)
class ImportMapping:
    """Mapping from columns of a file to signals of a recording, for `import_recording`.

    Parameters
    ----------
    signals : dict of str to SignalMapping
        Signals of the recording by name. Plain dicts of the same form are accepted.
    sample_time : float, optional
        Time between samples [s].
    time : str, optional
        Column of the sample times, named as in `SignalMapping.columns`. One of `sample_time` and `time` must be given,
        unless the file itself states the sample time of its channels (TDMS, MDF). Where several give it, they must
        agree within 0.1 %, and `sample_time` is stored.
    time_unit : str, optional
        Unit of the time column. When it is not given, it is the unit in the csv header, otherwise ``"s"``.
    conditions : dict of str to float, optional
        Operating point and other constants of the experiment.
    name : str, optional
        Name of the recording; by default the name of the file without its ending.
    samples : tuple of int and (int or None), optional
        First sample and the one after the last, counted from 0; None is the end of the file.
    axis : {0, 1}
        Axis of time in arrays with two dimensions: 1 where channels are rows. The axis of time is never
        the shorter one.
    from_s, to_s : float, optional
        The same as times [s] after the first sample of the file, instead of `samples`.
    piece : int, optional
        Number of the piece to take, from 1, where gaps of the time column cut the file into pieces; by default the
        longest.
    gaps : {"pieces", "missing"}
        What gaps of the time column are. "pieces" cut the file. "missing" makes samples NaN where the times are those
        of an even grid, whose step is `sample_time`, else the median step. Other times are kept as they are
        (`Recording.stamps`): a fit goes on from one to the next exactly.
    encoding, decimal, delimiter, header_line : optional
        Layout of a text file, where it is not to be found in the file; see `TextOptions`.

    Raises
    ------
    UsageError
        When an entry is missing, has the wrong type, or contradicts another one.
    """

    signals: Mapping[str, SignalMapping]
    sample_time: Positive | None = None
    time: str | None = None
    time_unit: str | None = None
    conditions: Mapping[str, Finite] = field(default_factory=dict)
    name: str | None = None
    samples: tuple[CountOrZero, CountOrZero | None] | None = None
    axis: Literal[0, 1] = 0
    from_s: NotNegative | None = None
    to_s: NotNegative | None = None
    piece: Count | None = None
    gaps: Literal["pieces", "missing"] = "pieces"
    encoding: str | None = None
    decimal: Literal[".", ","] | None = None
    delimiter: str | None = None
    header_line: CountOrZero | None = None

    def __post_init__(self) -> None:
        plain(vars(self))
        object.__setattr__(self, "signals", _signals(self.signals))
        check_options(self)
        object.__setattr__(self, "conditions", dict(self.conditions))
        if self.time == "":
            raise UsageError("time is empty; name the time column or leave the key out", "time")
        if self.time is None and self.time_unit is not None:
            raise UsageError("time_unit is given without time; name the time column or leave the unit out")
        if self.samples is not None:
            start, stop = self.samples
            object.__setattr__(self, "samples", (start, stop))
            if stop is not None and stop <= start:
                raise UsageError(
                    f"samples = {self.samples}; give the first and the end, which lies after it", "samples"
                )
            if self.from_s is not None or self.to_s is not None:
                raise UsageError("samples is given beside from_s or to_s; keep one way")
        if self.to_s is not None and self.to_s <= (self.from_s or 0.0):
            raise UsageError(f"to_s = {self.to_s}; give a time after from_s", "to_s")
        _ = self.text_options  # its checks

    @property
    def text_options(self) -> TextOptions:
        """Layout of a text file, as far as the mapping states it."""
        return TextOptions(self.encoding, self.decimal, self.delimiter, self.header_line)

    @property
    def part(self) -> FilePart:
        """Selected axis and samples of the arrays in the file."""
        start, stop = self.samples or (0, None)
        return FilePart(self.axis, None if stop is None else (start, stop))

    @classmethod
    def from_dict(cls, entries: Mapping[str, Any]) -> ImportMapping:
        """Return the mapping from a plain dict, as in an experiment YAML.

        Parameters
        ----------
        entries : dict
            Arguments of `ImportMapping` by name; ``sample_time_s`` is accepted for ``sample_time``.

        Raises
        ------
        UsageError
            When a key is unknown, given twice or missing, or when a value has the wrong type.
        """
        known = [f.name for f in fields(cls)]
        plain(entries)
        _check_keys(entries, [*known, "sample_time_s"], needed=["signals"])
        entries = dict(entries)
        if "sample_time_s" in entries:
            if "sample_time" in entries:
                raise UsageError("sample_time and sample_time_s are both given; keep one")
            entries["sample_time"] = entries.pop("sample_time_s")
        if entries.get("conditions", {}) is None:
            del entries["conditions"]  # an empty block in YAML
        return cls(**entries)

    def all_columns(self) -> list[str]:
        """Return the names of all columns without repetition, the time column first."""
        named = [column for signal in self.signals.values() for column in signal.columns]
        return list(dict.fromkeys([*([self.time] if self.time else []), *named]))


def _signals(signals: object) -> dict[str, SignalMapping]:
    if not isinstance(signals, Mapping) or not signals:
        raise UsageError(f"signals: expected at least one signal with its columns, found {signals!r}")
    result = {}
    for name, entry in signals.items():
        if not isinstance(entry, SignalMapping | Mapping):
            raise UsageError(f"signals: {name}: expected columns and unit, found {entry!r}")
        try:
            result[name] = entry if isinstance(entry, SignalMapping) else SignalMapping.from_dict(entry)
        except UsageError as error:
            raise UsageError(f"signals: {name}: {error}") from None
    return result


def _calibration(value: Any) -> Any:
    """Return a calibration in a plain dict as `Calibration`; other values are unchanged."""
    if not isinstance(value, Mapping):
        return value
    _check_keys(value, ["points"], needed=["points"])
    points = value["points"]
    is_list = isinstance(points, list | tuple) and all(isinstance(each, list | tuple) for each in points)
    return Calibration(tuple(map(tuple, points)) if is_list else points)


def _each(key: str, value: Any, count: int) -> tuple[Any, ...]:
    """Return a value for each column, from one value or from a list."""
    values = tuple(value) if isinstance(value, list | tuple | np.ndarray) else (value,) * count
    if len(values) != count:
        raise UsageError(f"{key}: {len(values)} for {count} columns; give one for all columns, or one for each")
    return values


def _words(key: str, value: object) -> tuple[str, ...]:
    words = (value,) if isinstance(value, str) else value
    if not isinstance(words, list | tuple) or not words or not all(isinstance(w, str) and w for w in words):
        raise UsageError(f"{key}: expected a list of names, found {value!r}")
    return tuple(words)


def _check_keys(entries: object, known: list[str], needed: list[str]) -> None:
    if not isinstance(entries, Mapping):
        raise UsageError(f"expected keys and values, found {entries!r}")
    for key in entries:
        if key not in known:
            raise UsageError(f"unknown key {key!r}; {nearest(str(key), known)}")
    for key in needed:
        if key not in entries:
            raise UsageError(f"key {key!r} is missing")
