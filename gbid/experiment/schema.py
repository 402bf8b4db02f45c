"""What an experiment YAML may say: keys, types and ranges. What the parts mean together is in `checks`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Strict

from gbid.experiment.fields import (
    Count,
    CountOrZero,
    Name,
    Names,
    NotNegative,
    Number,
    Pair,
    Positive,
    Section,
    Switch,
    Text,
    TwoRows,
)
from gbid.experiment.schema_fits import FitSection
from gbid.rig import Prbs, SensorChain, Unbalance

_PRBS, _SENSORS, _UNBALANCE = Prbs(), SensorChain(), Unbalance()


def _given(value: Any) -> Any:
    if value is None:
        raise ValueError("is empty; write {} for the defaults, or leave the key out")
    return value


def _rows(array: Any) -> Any:
    return tuple(tuple(row) for row in array.tolist())


class OperatingPoint(Section):
    """Where the machine runs."""

    pressure_bar: Positive
    speed_rpm: NotNegative


class PrbsSection(Section):
    """Recordings with moving piezos (paper, Sec. 3.4); see `gbid.rig.Prbs`."""

    recordings: CountOrZero = 2
    amplitude_m: Positive = _PRBS.amplitude
    hold_s: Positive = _PRBS.hold_s


class StationarySection(Section):
    """Recordings with still piezos (paper, Sec. 3.5)."""

    recordings: CountOrZero = 1
    duration_s: Positive | None = None


class SensorSection(Section):
    """What the rig's sensors add; see `gbid.rig.SensorChain`."""

    noise_p_m: NotNegative = _SENSORS.noise_p
    noise_u_m: NotNegative = _SENSORS.noise_u
    runout_amplitude_m: TwoRows = Field(default=_rows(_SENSORS.runout_amplitude))
    runout_phase_rad: TwoRows = Field(default=_rows(_SENSORS.runout_phase))
    offset_p_m: Pair = _SENSORS.offset_p
    offset_u_m: Pair = _SENSORS.offset_u
    encoder_counts: Annotated[int, Strict(), Field(ge=2)] | None = _SENSORS.encoder_counts


class UnbalanceSection(Section):
    """Mass unbalance of the rotor; see `gbid.rig.Unbalance`."""

    eccentricity_m: NotNegative = _UNBALANCE.eccentricity
    phase_rad: Number = _UNBALANCE.phase


class RigSection(Section):
    """Recordings of the virtual rig."""

    model: Text = "theisen2016"
    seed: CountOrZero = 1
    operating_points: Annotated[tuple[OperatingPoint, ...], Field(min_length=1)]
    duration_s: Positive = _PRBS.duration_s
    sample_time_s: Positive = 2e-4
    prbs: PrbsSection = PrbsSection()
    stationary: StationarySection = StationarySection()
    sensors: SensorSection = SensorSection()
    unbalance: UnbalanceSection = UnbalanceSection()


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


class ImportedSection(Section):
    """One recording from a file; see `gbid.recording.ImportMapping`.

    `remove_mean` takes the mean of each signal off the samples that are kept; a linear model has no offset.
    """

    name: Name
    file: Text
    kind: Literal["excited", "stationary"] = "excited"
    sample_time_s: Positive | None = None
    time: Text | None = None
    time_unit: Text | None = None
    samples: tuple[CountOrZero, Count | None] | None = None
    remove_mean: Switch = False
    conditions: dict[Text, Number] = Field(default_factory=dict)
    signals: Annotated[dict[Text, ColumnsSection], Field(min_length=1)]


class ImportSection(Section):
    """Recordings from files of one's own."""

    data_folder: Text = "."
    recordings: Annotated[tuple[ImportedSection, ...], Field(min_length=1)]


class PrefilterSection(Section):
    """What is taken out of the excited recordings before the fits (paper, Sec. 3.5)."""

    method: Literal["harmonics", "bins", "none"] = "harmonics"
    harmonics: Count = 10
    bins: Annotated[int, Strict(), Field(ge=4)] = 100
    median: Count = 3
    remove_mean: Switch = True


class CrossvalSection(Section):
    """On which recordings the models of a fit are validated (paper, Sec. 3.8)."""

    on: Names = ("cyclic",)
    minimum_percent: Number | None = None


class FigureSection(Section):
    """The part of the recording that the picture shows, and whether one of the residuals is drawn beside it."""

    from_s: NotNegative | None = None
    to_s: Positive | None = None
    residuals: Switch = False


class ExperimentFile(Section):
    """A whole experiment."""

    format: Literal[1]
    name: Name
    title: str = ""
    results: Text | None = None
    rig: Annotated[RigSection | None, BeforeValidator(_given)] = None
    imported: Annotated[ImportSection | None, BeforeValidator(_given)] = Field(default=None, alias="import")
    prefilter: Annotated[PrefilterSection | None, BeforeValidator(_given)] = None
    fits: dict[Name, FitSection] = Field(default_factory=dict)
    crossval: dict[Text, CrossvalSection] = Field(default_factory=dict)
    figures: dict[Text, FigureSection] = Field(default_factory=dict)
