"""Excitation: signals, expected standard deviations, reached limits, and its CSV file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief, Description, brief, estimates
from gbid.core.errors import DataError
from gbid.core.files import add_text_checksum, atomic_path, is_changed
from gbid.core.names import given_path
from gbid.core.tables import Column, Entry, Table, plain_table, write_csv
from gbid.core.units import SIGNALS

ExcitationKind = Literal["prbs", "multisine"]
_REACHED = 0.97


@dataclass(frozen=True, eq=False)
class ExcitationLines(Brief):
    """Spectral lines of a multisine.

    Attributes
    ----------
    frequency_hz : (n_lines,) array
        Frequencies [Hz].
    amplitude : (n_lines, n_inputs) array
        Complex amplitudes: the inputs are ``Re sum A exp(2 pi j f t)``.
    period_s : float
        Period [s].
    """

    frequency_hz: FloatArray
    amplitude: ComplexArray
    period_s: float


@dataclass(frozen=True)
class ExcitationSequence(Brief):
    """Pseudo-random binary sequence of maximal length.

    Attributes
    ----------
    amplitude : float
        The levels are plus and minus this value.
    hold_s : float
        Time between possible changes [s].
    register : int
        Length n of the shift register; the sequence has ``2^n - 1`` bits.
    taps : tuple of int
        Taps of the register.
    shift : tuple of int
        Bits by which the sequence of each input is shifted, so that inputs are almost uncorrelated.
    """

    amplitude: float
    hold_s: float
    register: int
    taps: tuple[int, ...]
    shift: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Excitation(Brief):
    """Designed excitation with its expected accuracy.

    Attributes
    ----------
    kind : {"prbs", "multisine"}
        Kind of signal.
    signals : dict of str to (n_samples, n_channels) array
        Input signals by name, in the units of the model's inputs (SI).
    sample_time : float
        Time between samples [s].
    values : dict of str to float
        Free parameters of the coming fit, and ``frequency_1`` [Hz], ``damping_1`` and so on of its modes.
    std : dict of str to float
        Standard deviations to be expected of these from one recording with this excitation: those that the result of
        the fit will contain. NaN where the recording does not determine them.
    std_together : dict of str to float or None
        The same from the earlier recordings and this one together; None without earlier ones.
    counted : tuple of str
        Quantities for which the excitation was designed.
    use : dict of str to float
        Largest value of each limited signal over its limit.
    gap : float or None
        Certificate of the spectrum of a multisine: twice the part by which the standard deviations, in the mean over
        those that count, lie at most above those of the best spectrum with the same crest factors (equivalence
        theorem). None for a PRBS.
    lines : ExcitationLines or None
        Lines of a multisine.
    sequence : ExcitationSequence or None
        Sequence of a PRBS.
    units : dict of str to str
        Units of the parameters.
    """

    kind: ExcitationKind
    signals: Mapping[str, FloatArray]
    sample_time: float
    values: Mapping[str, float]
    std: Mapping[str, float]
    std_together: Mapping[str, float] | None
    counted: tuple[str, ...]
    use: Mapping[str, float]
    gap: float | None = None
    lines: ExcitationLines | None = None
    sequence: ExcitationSequence | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(next(iter(self.signals.values())))

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return self.n_samples * self.sample_time

    @property
    def reached(self) -> tuple[str, ...]:
        """Names of the limits that the excitation reaches within three percent."""
        return tuple(name for name, share in self.use.items() if share >= _REACHED)

    def _brief(self) -> Description:
        return brief(
            self,
            f"{self.kind}, {self.duration_s:g} s",
            signals=list(self.signals),
            limits_reached=list(self.reached),
            expected=estimates(self.values, self.std, tuple(self.values)),
        )

    def table(self) -> Table:
        """Return a table of the quantities: value, expected standard deviation, and relative standard deviation."""
        together = self.std_together
        heads = [Column("quantity"), Column("value", format=5), Column("expected std", format=2)]
        heads += [Column("with earlier recordings", format=2)] if together is not None else []
        rows = list[list[Entry]]()
        for name, value in self.values.items():
            std = self.std[name]
            of_value = 100 * std / abs(value) if value else None
            more = [together[name]] if together is not None else []
            rows.append([name, value, std, *more, of_value, self.units.get(name, ""), name in self.counted])
        heads += [Column("% of value", format=2), Column("unit"), Column("counts")]
        return Table("", heads, rows)


# ---- Excitation as a CSV file, for the signal generator and for the rig.

_TIME = "time_s"


class PlayedFile(NamedTuple):
    """Contents of an excitation file.

    Attributes
    ----------
    columns : dict of str to (n_samples,) array
        Channels by heading, such as ``r_x_m``.
    sample_time : float
        Time between samples [s].
    """

    columns: dict[str, FloatArray]
    sample_time: float


def save_excitation(excitation: Excitation, path: str | Path, overwrite: bool = False) -> Path:
    """Write an excitation as a CSV file, and return its path.

    Comment lines say what it is and which standard deviations are to be expected. The headings are time [s], then
    each channel, with its unit where it is a signal of the test rig. The first line is the checksum of the others.

    Parameters
    ----------
    excitation : Excitation
        The excitation.
    path : path
        The new file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    heads, columns = [_TIME], [np.arange(excitation.n_samples) * excitation.sample_time]
    for name, values in excitation.signals.items():
        known = SIGNALS.get(name)
        if known and len(known.channels) == values.shape[1]:
            heads += [f"{name}_{channel}_{known.unit}" for channel in known.channels]
        else:  # a signal of the user, in the unit of the model
            heads += [name] if values.shape[1] == 1 else [f"{name}_{i + 1}" for i in range(values.shape[1])]
        columns += list(values.T)
    expected = ", ".join(f"{name} {std:.3g}" for name, std in excitation.std.items())
    notes = [
        f"gbid excitation: {excitation.kind}, {excitation.duration_s:g} s",
        f"limits reached: {', '.join(excitation.reached) or 'none'}",
        f"standard deviations to be expected: {expected}",
    ]
    with atomic_path(path, overwrite) as part:
        write_csv(plain_table(heads, np.column_stack(columns).tolist()), part, notes)
        add_text_checksum(part, ".csv")
    return path


def read_excitation(path: str | Path) -> PlayedFile:
    """Return the channels of an excitation file.

    Parameters
    ----------
    path : path
        CSV file whose first column is ``time_s``.

    Raises
    ------
    DataError
        When the file is missing, was changed after it was made, or has no equally spaced numbers.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
        lines = [line for line in content.decode().splitlines() if not line.startswith("#")]
        heads = lines[0].split(",")
        values = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise DataError(f"{path}: cannot be read as an excitation: {error}") from None
    if is_changed(content):
        raise DataError(f"{path}: the file was changed after it was made; make it anew with `gbid excite`")
    if heads[0] != _TIME or values.ndim != 2 or len(values) < 2 or values.shape[1] != len(heads):
        raise DataError(f"{path}: the first column must be {_TIME}, and all lines as long as the first")
    steps = np.diff(values[:, 0])
    if not np.isfinite(values).all() or not np.allclose(steps, steps[0], rtol=1e-6) or steps[0] <= 0:
        raise DataError(f"{path}: {_TIME} must rise in equal steps, and all values be finite")
    return PlayedFile(dict(zip(heads[1:], values.T[1:], strict=True)), float(values[-1, 0] / (len(values) - 1)))
