"""Excitation: signals to play, the standard deviations to be expected, and the limits that they reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from gbid.arrays import ComplexArray, FloatArray
from gbid.brief import Brief, Description, brief, estimates
from gbid.tables.table import Column, Entry, Table

ExcitationKind = Literal["prbs", "multisine"]
_REACHED = 0.97


@dataclass(frozen=True, eq=False)
class ExcitationLines(Brief):
    """Lines of a multisine.

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
    """Designed excitation.

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
        """Limits that the excitation reaches, within three percent."""
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
        """Return the quantities as a table: value, standard deviation to be expected, and its part of the value."""
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
