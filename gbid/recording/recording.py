"""Recording: sampled signals of one experiment; HDF5 files, data frames, xarray, and the unbalance signal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import h5py
import numpy as np
import numpy.typing as npt

from gbid.core import hdf5
from gbid.core.arrays import BoolArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.extras import data_frame, extra_package
from gbid.core.figures import Pictured
from gbid.core.option_types import Own, check_options, checks_arguments, short_text
from gbid.core.units import SIGNALS, conversion_factor
from gbid.recording.clock import MAX_JITTER
from gbid.recording.columns import seconds


def signal_columns(
    frame: Any, signals: Mapping[str, str | Sequence[str]] | None, time: str | None
) -> tuple[dict[str, FloatArray], dict[str, tuple[str, ...]]]:
    """Return signals and channel names from a data frame's columns.

    Parameters
    ----------
    frame : pandas.DataFrame
        The data frame; only names and values of its columns are used.
    signals : dict of str to str or sequence of str, optional
        Columns of each signal. By default each column is a channel: ``"p.x"`` is channel x of signal p, and a name
        without a dot is a signal of one channel.
    time : str, optional
        Column of the time, which is no signal.

    Raises
    ------
    UsageError
        When the frame has no such column.
    """
    names = [str(name) for name in frame.columns]
    if signals is None:
        grouped: dict[str, list[str]] = {}
        for name in names:
            if name != time:
                grouped.setdefault(name.partition(".")[0], []).append(name)
        signals = grouped
        channels = {key: tuple(name.partition(".")[2] for name in columns) for key, columns in grouped.items()}
        named = {key: each for key, each in channels.items() if all(each)}
    else:
        named = {}
    values = {}
    for key, chosen in signals.items():
        columns = [chosen] if isinstance(chosen, str) else list(chosen)
        if missing := [name for name in columns or [""] if name not in names]:
            raise UsageError(f"signal {key!r}: the frame has no column {missing[0]!r}; it has {', '.join(names)}")
        values[key] = np.column_stack([np.asarray(frame.iloc[:, names.index(name)]) for name in columns])
    return values, named


def frame_sample_time(frame: Any, time: str | None) -> float:
    """Return the sample time of a data frame [s], from a column or its index.

    Parameters
    ----------
    frame : pandas.DataFrame
        The data frame.
    time : str, optional
        Column of the time; the index when left out. Numbers are seconds; dates and time differences work, too.

    Raises
    ------
    DataError
        When the times are not evenly spaced.
    UsageError
        When the frame has no such column, or when its index only numbers the rows.
    """
    if time is not None and time not in list(frame.columns):
        raise UsageError(f"time = {time!r}: the frame has no such column; it has {', '.join(map(str, frame.columns))}")
    index = frame.index if time is None else frame[time]
    if time is None and type(index).__name__ == "RangeIndex":
        raise UsageError("the frame has no times: its index numbers the rows; give sample_time, or the column: time=")
    return _even_step(np.asarray(index))


def _even_step(times: npt.NDArray[Any]) -> float:
    if times.dtype.kind not in "mMfiu":
        raise DataError("the times of the frame are neither numbers nor dates; give sample_time")
    if len(times) < 2:
        raise DataError("the frame has fewer than two rows, so its times give no sample time; give sample_time")
    steps = np.diff(seconds(times) if times.dtype.kind in "mM" else times)
    median = float(np.median(steps))
    uneven = np.flatnonzero(~(np.abs(steps - median) <= MAX_JITTER * abs(median)))
    if not median > 0 or len(uneven):
        at = int(uneven[0]) if len(uneven) else 0
        raise DataError(
            f"the times of the frame are not evenly spaced: step {steps[at]:g} s at row {at + 1}, median step "
            f"{median:g} s; give sample_time, or keep these times: Recording(signals, stamps=times)"
        )
    return float(f"{steps.mean():.12g}")  # as an import rounds it


def _xarray_times(dataset: Any, time: str) -> tuple[FloatArray | None, float | None]:
    """Return irregular times, or the sample time, of an xarray dataset [s]; the other value is None."""
    if time not in dataset.coords:
        raise UsageError(f"the dataset has no times: no coordinate {time!r}; give sample_time, or its name: time=")
    axis = dataset.coords[time]
    times, unit = np.asarray(axis.values), axis.attrs.get("units", "s")
    if not isinstance(unit, str):
        raise UsageError(f"coordinate {time!r}: units is of type {type(unit).__name__}; give a text, such as 's'")
    if times.dtype.kind in "fiu":
        times = times * conversion_factor(unit, "s")
    if axis.attrs.get("irregular"):
        return times, None
    stated = axis.attrs.get("sample_time")
    return None, float(stated) if _is_finite(stated) else _even_step(times)


_Range = slice  # within the class, `slice` is its method
CONDITION_UNITS = {"pressure_bar": "bar", "speed_rpm": "rpm"}
"""Units of the conditions that gbid uses; other conditions have ``""``."""


_Key = Annotated[str, Own()]


@dataclass(frozen=True, eq=False)
class Recording(Brief, Pictured, hdf5.InFile):
    """Sampled signals of one experiment, in SI units.

    Parameters
    ----------
    signals : dict of str to (n_samples, n_channels) or (n_samples,) array
        Names are free. Rows are samples, columns are channels; arrays are never transposed. An array of one dimension
        is one channel. NaN is a missing sample; the outputs of a fit may have such gaps.
    sample_time : float
        Time between samples [s]; with `stamps` it is left out, and becomes their mean step.
    conditions : dict of str to float, optional
        Operating point and other constants of the experiment, e.g. ``{"pressure_bar": 6.0, "speed_rpm": 0.0}``.
    name : str, optional
        Name of the recording, used in files, tables and messages.
    units : dict of str to str, optional
        Unit of each signal, ``""`` where none is given. No unit is taken from a name: u may be metres or volts.
    channels : dict of str to tuple of str, optional
        Channel names of each signal. Signals of the rig with their usual number of channels have their own, others
        default to ``"1", "2", ...``.
    provenance : dict of str to str, optional
        Texts about the origin of the data, stored with the file.
    stamps : (n_samples,) array, optional
        Irregular times of the samples [s]; they are stored from the first one. Even ones become None. A fit goes from
        each to the next exactly; what needs even samples refuses them.

    Raises
    ------
    DataError
        When a signal is not an array of one or two dimensions of numbers that are finite or NaN, when the lengths
        differ, when the sample time is not positive, or when the stamps do not rise.
    """

    signals: Mapping[_Key, Annotated[FloatArray, Own()]]
    sample_time: Annotated[float, Own()] = math.nan
    conditions: Mapping[_Key, Annotated[float, Own()]] = field(default_factory=dict)
    name: str = "recording"
    units: Mapping[str, str] = field(default_factory=dict)
    channels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    stamps: Annotated[FloatArray | None, Own()] = None

    drawn_by = "plot_recording"

    def __post_init__(self) -> None:
        check_options(self, "Recording")
        for key in (*self.signals, *self.conditions):
            _check_key(self.name, key)
        signals = {name: _checked(self.name, name, values) for name, values in self.signals.items()}
        if not signals:
            raise DataError(f"recording {self.name!r}: no signals; give at least one (n_samples, n_channels) array")
        lengths = {name: len(values) for name, values in signals.items()}
        if len(set(lengths.values())) > 1:
            text = ", ".join(f"{name} {n}" for name, n in lengths.items())
            raise DataError(f"recording {self.name!r}: signals have different numbers of samples: {text}")
        stamps, sample_time = self.stamps, self.sample_time
        if stamps is not None:
            stamps, sample_time = _irregular(self.name, stamps, self.n_samples)
        if not (_is_finite(sample_time) and sample_time > 0):
            raise DataError(
                f"recording {self.name!r}: sample_time = {short_text(sample_time)} s; it must be a positive number"
            )
        for key, value in self.conditions.items():
            if not _is_finite(value):
                raise DataError(
                    f"recording {self.name!r}: condition {key} = {short_text(value)} is not a finite number"
                )
        units, channels = {}, {}
        for name, values in signals.items():
            known, n = SIGNALS.get(name), values.shape[1]
            default = known.channels if known and len(known.channels) == n else tuple(str(i + 1) for i in range(n))
            units[name] = self.units.get(name, "")
            channels[name] = tuple(self.channels.get(name, default))
            if len(channels[name]) != n:
                names = ", ".join(channels[name])
                raise DataError(
                    f"recording {self.name!r}: signal {name!r} has {n} channels, "
                    f"expected {len(channels[name])} ({names}); arrays are (n_samples, n_channels)"
                )
        freeze = object.__setattr__
        freeze(self, "signals", MappingProxyType(signals))
        freeze(self, "sample_time", float(sample_time))
        freeze(self, "stamps", stamps)
        freeze(self, "conditions", MappingProxyType({k: float(v) for k, v in self.conditions.items()}))
        freeze(self, "units", MappingProxyType(units))
        freeze(self, "channels", MappingProxyType(channels))
        freeze(self, "provenance", MappingProxyType({k: str(v) for k, v in self.provenance.items()}))

    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("recording", "record or import it again")

    def to_hdf5(self, group: h5py.Group) -> None:
        """Write this recording to a `group`, with attributes for NeXus readers."""
        group.attrs["name"] = self.name
        group.attrs["default"] = "signals"
        hdf5.add_dataset(group, "sample_time", self.sample_time, "s", "time between samples")
        signals = group.create_group("signals", track_order=True)
        first, *others = self.signals
        signals.attrs["NX_class"] = "NXdata"
        signals.attrs["signal"] = first
        hdf5.add_texts(signals, "auxiliary_signals", others)
        hdf5.add_texts(signals, "axes", ["time", "."])
        time = hdf5.add_dataset(signals, "time", self.time, "s", "time from the first sample")
        if self.stamps is not None:
            time.attrs["irregular"] = True
        for name, values in self.signals.items():
            known = SIGNALS.get(name)
            long_name = known.long_name if known and known.unit == self.units[name] else name  # else another rig's
            dataset = hdf5.add_dataset(signals, name, values, self.units[name], long_name)
            hdf5.add_texts(dataset, "channels", self.channels[name])
        conditions = group.create_group("conditions", track_order=True)
        for key, value in self.conditions.items():
            hdf5.add_dataset(conditions, key, value, CONDITION_UNITS.get(key, ""), key.replace("_", " "))
        group.create_group("provenance").attrs.update(self.provenance)

    @classmethod
    def from_hdf5(cls, group: h5py.Group) -> Recording:
        """Return the recording from a `group` written by `to_hdf5`; times must agree with the sample time."""
        signals, units, channels, irregular = {}, {}, {}, False
        entries, known = hdf5.read_group(group, "signals"), hdf5.read_group(group, "conditions")
        for name in entries:
            signals[name] = hdf5.read_dataset(entries, name)
            if name == "time":
                irregular = "irregular" in entries[name].attrs
            else:
                units[name] = hdf5.read_text(entries, "units", name)
                channels[name] = hdf5.read_texts(entries, "channels", name)
        if "time" not in signals:
            raise hdf5.DamagedError("/signals/time is missing")
        time = signals.pop("time")
        conditions = {key: _one_number(known, key) for key in known}
        source = hdf5.read_group(group, "provenance")
        provenance = {key: hdf5.read_text(source, key) for key in source.attrs}
        sample_time, name = _one_number(group, "sample_time"), hdf5.read_text(group, "name")
        rec = cls(signals, sample_time, conditions, name, units, channels, provenance, time if irregular else None)
        if time.shape != (rec.n_samples,):
            raise DataError(f"/signals/time has shape {time.shape}, expected ({rec.n_samples},)")
        wrong = np.flatnonzero(~(np.abs(time - rec.time) <= 1e-3 * rec.sample_time))
        if wrong.size:
            k = wrong[0]
            raise DataError(
                f"/signals/time is {time[k]} s at sample {k}, but sample_time = {rec.sample_time} s "
                f"gives {rec.time[k]} s; make them agree"
            )
        return rec

    def _brief(self) -> Description:
        irregular = " at irregular times, on average" if self.stamps is not None else ""
        about = f"{self.name}, {self.n_samples} samples{irregular} of {self.sample_time:g} s, {self.duration:g} s"
        signals = {
            name: f"{', '.join(self.channels[name])} [{self.units[name]}] "
            f"{np.nanmin(values):.4g} to {np.nanmax(values):.4g}"
            + (f", {self.missing[name]} missing" if name in self.missing else "")
            for name, values in self.signals.items()
        }
        return brief(self, about, **signals, conditions=self.conditions)

    @classmethod
    @checks_arguments
    def from_frame(
        cls,
        frame: Any,
        signals: Mapping[str, str | Sequence[str]] | None = None,
        *,
        sample_time: float | None = None,
        time: str | None = None,
        units: Mapping[str, str] | None = None,
        conditions: Mapping[str, float] | None = None,
        name: str = "recording",
    ) -> Recording:
        """Return a recording from the columns of a data frame with values in SI units.

        Parameters
        ----------
        frame : pandas.DataFrame
            A row for each sample.
        signals : dict of str to str or sequence of str, optional
            Columns of each signal, as ``{"u": ["ux", "uy"]}``. By default every column is a channel: ``"p.x"`` is
            channel x of signal p, and a column without a dot is a signal of its own.
        sample_time : float, optional
            Time between samples [s]; by default from the column `time` or from the index.
        time : str, optional
            Column of the time [s], which is then no signal.
        units, conditions, name
            As for `Recording`.

        Returns
        -------
        Recording

        Raises
        ------
        DataError
            When the times are not evenly spaced, or as for `Recording`.
        UsageError
            When the frame has no such column, or no times.
        """
        values, channels = signal_columns(frame, signals, time)
        if sample_time is None:
            sample_time = frame_sample_time(frame, time)
        return cls(values, sample_time, conditions or {}, name, units or {}, channels)

    def to_frame(self) -> Any:
        """Return a data frame with a column for each channel (``"p.x"``), indexed by time [s].

        Returns
        -------
        pandas.DataFrame
            ``frame.attrs`` holds the units, the conditions and the name.

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        columns = {
            f"{name}.{channel}": values[:, i]
            for name, values in self.signals.items()
            for i, channel in enumerate(self.channels[name])
        }
        units = {column: self.units[column.partition(".")[0]] for column in columns}
        frame = data_frame({"time_s": self.time, **columns}, index="time_s", units=units)
        frame.attrs |= {"name": self.name, "conditions": dict(self.conditions)}
        return frame

    @classmethod
    @checks_arguments
    def from_xarray(
        cls,
        dataset: Any,
        signals: Sequence[str] | None = None,
        *,
        time: str = "time",
        sample_time: float | None = None,
        units: Mapping[str, str] | None = None,
        conditions: Mapping[str, float] | None = None,
        name: str | None = None,
    ) -> Recording:
        """Return a recording from variables of an xarray dataset with values in SI units.

        Parameters
        ----------
        dataset : xarray.Dataset
            Variables over the time alone, (n_samples,), or over time and channels, (n_samples, n_channels).
        signals : sequence of str, optional
            Variables that become signals; by default all.
        time : str
            Dimension of the time, whose coordinate has seconds, the unit of its attribute ``units``, or dates.
        sample_time : float, optional
            Time between samples [s]; by default from the coordinate.
        units : dict of str to str, optional
            Units of signals whose variables have no attribute ``units``, or another one.
        conditions : dict of str to float, optional
            Constants of the experiment, beside the attributes of the dataset that are numbers. Those that are texts
            become the provenance.
        name : str, optional
            Name of the recording; by default the attribute ``name``.

        Returns
        -------
        Recording

        Raises
        ------
        DataError
            When the times are not evenly spaced, or as for `Recording`.
        UsageError
            When the dataset has no such variable, a variable has other dimensions, or there are no times.
        """
        chosen = list(map(str, dataset.data_vars)) if signals is None else list(signals)
        values, stated, channels = {}, dict[str, Any](), dict[str, tuple[str, ...]]()
        for key in chosen:
            if key not in dataset.data_vars:
                raise UsageError(
                    f"the dataset has no variable {key!r}; it has {', '.join(map(str, dataset.data_vars))}"
                )
            variable = dataset[key]
            if variable.dims[:1] != (time,) or variable.ndim > 2:
                text = (
                    f"variable {key!r} has the dimensions {variable.dims}, expected ({time!r},) or ({time!r}, channels)"
                )
                raise UsageError(f"{text}; transpose it, or name others in signals")
            values[key], stated[key] = np.asarray(variable.values), variable.attrs.get("units", "")
            if variable.dims[1:] and variable.dims[1] in variable.coords:
                channels[key] = tuple(map(str, variable.coords[variable.dims[1]].values))
        known = {str(key): value for key, value in dataset.attrs.items()}
        numbers = {key: float(value) for key, value in known.items() if _is_finite(value)}
        texts = {key: value for key, value in known.items() if isinstance(value, str) and key != "name"}
        stamps, step = (None, sample_time) if sample_time is not None else _xarray_times(dataset, time)
        return cls(
            values,
            math.nan if step is None else step,
            numbers | dict(conditions or {}),
            name or known.get("name", "recording"),
            stated | dict(units or {}),
            channels,
            texts,
            stamps,
        )

    def to_xarray(self) -> Any:
        """Return an xarray dataset with a variable (time, channels) for each signal, ready for netCDF.

        Returns
        -------
        xarray.Dataset
            Variables have the attributes ``units`` and ``long_name``. Attributes of the dataset are the name, the
            conditions (numbers) and the provenance (texts).

        Raises
        ------
        UsageError
            When xarray is not installed, or when a condition and a text of the provenance have one name.
        """
        xarray = extra_package("xarray", "xarray", "a dataset of xarray")
        about: dict[str, Any] = {"name": self.name}
        for key, value in (*self.conditions.items(), *self.provenance.items()):
            if key in about:
                raise UsageError(f"recording {self.name!r}: two attributes of the dataset are {key!r}; rename one")
            about[key] = value
        even = {"irregular": 1} if self.stamps is not None else {"sample_time": self.sample_time}
        coords: dict[str, Any] = {"time": ("time", self.time, {"units": "s"} | even)}
        variables = {}
        for name, values in self.signals.items():
            kind = SIGNALS.get(name)
            long_name = kind.long_name if kind and kind.unit == self.units[name] else name
            coords[f"{name}_channel"] = list(self.channels[name])
            attributes = {"units": self.units[name], "long_name": long_name}
            variables[name] = (("time", f"{name}_channel"), values, attributes)
        return xarray.Dataset(variables, coords, about)

    def __len__(self) -> int:
        return self.n_samples

    def __getitem__(self, samples: _Range) -> Recording:
        """Return a part of the recording: ``recording[100:200]``; see `slice`."""
        if not isinstance(samples, slice):
            raise UsageError(
                f"recording[{samples!r}]: give a range of samples, as [100:200]; recording.signal(name) gives a signal"
            )
        if samples.step not in (None, 1):
            raise UsageError(
                f"recording[::{samples.step}]: leaving out samples without a filter folds high frequencies down; "
                "filter first (scipy.signal.decimate), then make a Recording"
            )
        start, stop, _ = samples.indices(self.n_samples)
        return self.slice(start, stop)

    __iter__ = None  # a recording is neither its signals nor its samples: name them

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(next(iter(self.signals.values())))

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        return self.n_samples * self.sample_time

    @property
    def time(self) -> FloatArray:
        """Sample times, from zero [s], shape (n_samples,)."""
        if self.stamps is not None:
            return self.stamps
        return np.asarray(self.sample_time * np.arange(self.n_samples), dtype=np.float64)

    def signal(self, name: str, *, gaps: bool = False, irregular: bool = False) -> FloatArray:
        """Return the values of one signal, shape (n_samples, n_channels).

        Parameters
        ----------
        name : str
            Name of the signal.
        gaps : bool
            Whether samples may be missing (NaN). By default a signal with missing samples is refused.
        irregular : bool
            Whether the times of the samples may be irregular. By default they are refused.

        Raises
        ------
        DataError
            When the recording has no such signal, when samples of it are missing, or when its times are irregular.
        """
        if name not in self.signals:
            raise DataError(f"recording {self.name!r} has no signal {name!r}; it has {', '.join(self.signals)}")
        values = self.signals[name]
        if not irregular and self.stamps is not None:
            raise DataError(
                f"recording {self.name!r} has samples at irregular times; this function needs even times: interpolate "
                "its signals before (numpy.interp). Fits, simulations and residual tests accept irregular times"
            )
        if not gaps and self.missing.get(name):
            raise DataError(
                f"recording {self.name!r}: {self.missing[name]} samples of signal {name!r} are missing, the first "
                f"{_first_missing(values)}; only the outputs of a fit may have gaps: hold the last value of an input "
                f"with recording.held({name!r}), draw lines with recording.interpolated, or take a stretch without gaps"
            )
        return values

    @cached_property
    def missing(self) -> Mapping[str, int]:
        """Number of missing samples (NaN), over all channels, of each signal with missing samples."""
        counts = {name: int(np.isnan(values).sum()) for name, values in self.signals.items()}
        return MappingProxyType({name: count for name, count in counts.items() if count})

    def held(self, *names: str) -> Recording:
        """Return a copy in which missing samples repeat the last value before them.

        That is what a command is between its samples; it is no repair of a measured signal.

        Parameters
        ----------
        *names : str
            The signals.

        Raises
        ------
        DataError
            When there is no such signal, or when its first sample is missing.
        """
        signals = {}
        for name in names:
            values = self.signal(name, gaps=True, irregular=True)
            if np.isnan(values[0]).any():
                raise DataError(f"recording {self.name!r}: the first sample of signal {name!r} is missing; begin later")
            last = np.maximum.accumulate(np.where(np.isnan(values), 0, np.arange(len(values))[:, None]))
            signals[name] = np.take_along_axis(values, last, axis=0)
        return replace(self, signals={**self.signals, **signals})

    def interpolated(self, *names: str) -> Recording:
        """Return a copy in which missing samples are interpolated linearly in time.

        That is what an input with first-order hold is between its samples; it is no repair of a measured output.

        Parameters
        ----------
        *names : str
            The signals.

        Raises
        ------
        DataError
            When there is no such signal, or when its first or last sample is missing.
        """
        signals = {}
        for name in names:
            values, time = self.signal(name, gaps=True, irregular=True).copy(), self.time
            for column in values.T:
                missing = np.isnan(column)
                if missing[0] or missing[-1]:
                    at = "first" if missing[0] else "last"
                    raise DataError(
                        f"recording {self.name!r}: the {at} sample of signal {name!r} is missing; cut it off there"
                    )
                column[missing] = np.interp(time[missing], time[~missing], column[~missing])
            signals[name] = values
        return replace(self, signals={**self.signals, **signals})

    def with_signals(self, **signals: npt.ArrayLike) -> Recording:
        """Return a copy with some signals replaced or added.

        Parameters
        ----------
        **signals : (n_samples, n_channels) array
            New signals by name; an existing signal of that name is replaced.
        """
        return replace(self, signals={**self.signals, **{k: np.asarray(v, float) for k, v in signals.items()}})

    def slice(self, start: int, stop: int | None = None, name: str | None = None) -> Recording:
        """Return samples `start` to `stop` (exclusive) as a new recording.

        Parameters
        ----------
        start, stop : int
            Sample numbers from 0; `stop` is the end when not given.
        name : str, optional
            Name of the new recording; by default the name of this one.

        Raises
        ------
        DataError
            When the range is empty or outside the recording.
        """
        stop = self.n_samples if stop is None else stop
        if not 0 <= start < stop <= self.n_samples:
            raise DataError(
                f"recording {self.name!r}: samples {start} to {stop} are not within its {self.n_samples} samples"
            )
        signals = {key: values[start:stop] for key, values in self.signals.items()}
        stamps = None if self.stamps is None else self.stamps[start:stop]
        return replace(self, signals=signals, name=name or self.name, stamps=stamps)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)  # arrays come from another process writable
        for values in self.signals.values():
            values.setflags(write=False)


_EVEN = 1e-9  # largest deviation of a step from the mean step, relative, that is rounding


def _irregular(recording: str, stamps: npt.ArrayLike, n: int) -> tuple[FloatArray | None, float]:
    """Return irregular times counted from the first (None if evenly spaced), and their mean step."""
    time = _real(f"recording {recording!r}: stamps", stamps)
    if time.shape != (n,) or n < 2:
        raise DataError(f"recording {recording!r}: stamps have shape {time.shape}; give a time for each of {n} samples")
    steps = np.diff(time)
    if not (steps > 0).all():
        k = int(np.flatnonzero(~(steps > 0))[0])
        raise DataError(
            f"recording {recording!r}: the stamps do not rise at sample {k + 1}: {time[k]:g} s, {time[k + 1]:g} s"
        )
    mean, time = float(time[-1] - time[0]) / (n - 1), time - time[0]
    if np.abs(steps / mean - 1).max() <= _EVEN:
        return None, float(f"{mean:.12g}")
    time.setflags(write=False)
    return time, mean


def without_gaps(values: FloatArray) -> tuple[FloatArray, BoolArray | None]:
    """Return samples (n, n_columns) with missing ones interpolated, and which are missing (None if none)."""
    missing = np.isnan(values)
    if not missing.any():
        return values, None
    every, values = np.arange(len(values)), values.copy()
    for column, gone in zip(values.T, missing.T, strict=True):
        column[gone] = np.interp(every[gone], every[~gone], column[~gone])
    return values, missing


def _first_missing(values: FloatArray) -> str:
    """Return a text on the first missing sample."""
    row, column = np.argwhere(np.isnan(values))[0]
    return f"at sample {row}, channel {column}"


def _is_finite(value: object) -> bool:
    """Return whether a value is one finite number: float, int, numpy scalar or 0-d array."""
    if isinstance(value, Sequence | Mapping) or np.ndim(value) or np.asarray(value).dtype.kind not in "fiu":  # type: ignore[arg-type]
        return False
    return bool(np.isfinite(value))  # type: ignore[call-overload]


def _check_key(recording: str, key: object) -> None:
    """Refuse names that cannot be stored in a file."""
    if not isinstance(key, str) or not key or "/" in key or key in (".", "time"):
        raise DataError(
            f"recording {recording!r}: {key!r} cannot name a signal or condition; give a word without '/', "
            "other than 'time'"
        )


def _real(where: str, values: npt.ArrayLike) -> FloatArray:
    """Return a copy of an array of real numbers as floats; masked ones become NaN."""
    try:
        # numpy would silently drop a mask or an imaginary part and read text as numbers
        raw = np.ma.filled(values.astype(float), np.nan) if isinstance(values, np.ma.MaskedArray) else values
        raw = np.asarray(raw)
        if raw.dtype.kind not in "fiub":
            raise TypeError(raw.dtype)
        return np.array(raw, dtype=float, order="C")  # a copy: the caller's array stays writable
    except (TypeError, ValueError, MemoryError):
        raise DataError(f"{where} is not an array of real numbers") from None


def _checked(recording: str, signal: str, values: npt.ArrayLike) -> FloatArray:
    """Return a checked signal as a read-only float array."""
    where = f"recording {recording!r}: signal {signal!r}"
    array = _real(where, values)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise DataError(f"{where} has shape {array.shape}; give (n_samples, n_channels)")
    if 0 in array.shape:
        raise DataError(f"{where} is empty: shape {array.shape}")
    if array.shape[0] < array.shape[1]:
        raise DataError(
            f"{where} has shape {array.shape}: more channels than samples; "
            "arrays are (n_samples, n_channels), transpose it yourself if it is stored the other way"
        )
    is_complete = bool(np.isfinite(array).all())
    if not is_complete and np.isinf(array).any():
        row, column = np.argwhere(np.isinf(array))[0]
        count = int(np.isinf(array).sum())
        raise DataError(
            f"{where} holds {count} values that are not finite, the first {array[row, column]} "
            f"at sample {row}, channel {column}; leave those samples out, or make missing ones NaN"
        )
    if not is_complete and np.isnan(array).all(axis=0).any():
        raise DataError(f"{where}: all samples of channel {int(np.isnan(array).all(axis=0).argmax())} are missing")
    array.setflags(write=False)
    return array


# ---- Unbalance signal, for structures with an unbalance.

_RPM = np.pi / 30


def with_unbalance(recording: Recording) -> Recording:
    """Return a recording with the signal ``unbalance``: Omega^2 cos(phi) and Omega^2 sin(phi) [rad^2/s^2].

    An unbalance of eccentricity e and angle theta accelerates the rotor by e Omega^2 in the direction phi + theta. With
    this signal as input, `gbid.RotorBearing` (``unbalance=True``) estimates e and theta along. The tangential force of
    the angular acceleration is left out: it is smaller by the angular acceleration over Omega^2.

    Parameters
    ----------
    recording : Recording
        Recording with phi [rad], and with speed_rpm as a signal or condition.

    Returns
    -------
    Recording

    Raises
    ------
    DataError
        When the shaft angle or the speed is missing.
    """
    if "phi" not in recording.signals or recording.signal("phi").shape[1] != 1:
        raise DataError(f"recording {recording.name!r} has no signal 'phi' of one channel; the unbalance turns with it")
    if "speed_rpm" in recording.signals:
        speed = recording.signal("speed_rpm")[:, 0]
    elif "speed_rpm" in recording.conditions:
        speed = np.full(recording.n_samples, float(recording.conditions["speed_rpm"]))
    else:
        raise DataError(f"recording {recording.name!r} has no speed_rpm; the force grows with its square")
    phi, size = recording.signal("phi")[:, 0], (speed * _RPM) ** 2
    turned = np.column_stack([size * np.cos(phi), size * np.sin(phi)])
    kind = SIGNALS["unbalance"]
    return replace(
        recording,
        signals={**recording.signals, "unbalance": turned},
        units={**recording.units, "unbalance": kind.unit},
        channels={**recording.channels, "unbalance": kind.channels},
    )


def _one_number(group: h5py.Group, name: str) -> float:
    values = hdf5.read_dataset(group, name)
    if values.shape != ():
        raise DataError(f"{name} has shape {values.shape}, expected one number")
    return float(values)


def save_recording(rec: Recording, path: str | Path, overwrite: bool = False) -> None:
    """Write the recording `rec` to the HDF5 file `path`, bit for bit; `overwrite` as for `gbid.save`."""
    hdf5.save(rec, path, overwrite)


def load_recording(path: str | Path) -> Recording:
    """Return the recording in the HDF5 file `path`, as `gbid.load` does.

    Returns
    -------
    Recording
    """
    return hdf5.load(path, Recording, apart=True)
