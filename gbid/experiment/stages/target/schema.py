"""Schema of the target section; names, units and defaults are those of `gbid.target.ChainOptions`."""

from __future__ import annotations

from typing import Literal

from gbid.experiment.fields import Count, NotNegative, Pair, Positive, Section
from gbid.target import ChainOptions

_DEFAULT = ChainOptions()


class TargetSection(Section):
    """Limits, ramps, guards and watchdog of the control chain in C; see `gbid.target.ChainOptions`.

    `disc_limit_m`: 0.8 of the clearance of the rig when left out, else 20 um.
    """

    number: Literal["double", "float"] = _DEFAULT.number
    limit_m: Positive = _DEFAULT.limit_m
    offset_m: Positive = _DEFAULT.offset_m
    stroke_m: Positive = _DEFAULT.stroke_m
    zero_m: Pair = _DEFAULT.zero_m
    median: Literal[1, 3] = 1
    spike_limit_m: Positive | None = _DEFAULT.spike_limit_m
    disc_limit_m: Positive | None = None
    beyond_samples: Count = _DEFAULT.beyond_samples
    bad_samples: Count = _DEFAULT.bad_samples
    stuck_samples: Count = _DEFAULT.stuck_samples
    stuck_speed_rpm: NotNegative = _DEFAULT.stuck_speed_rpm
    ramp_s: Positive = _DEFAULT.ramp_s
    fade_s: Positive = _DEFAULT.fade_s
    pressure_rate: Positive = _DEFAULT.pressure_rate
    speed_rate: Positive = _DEFAULT.speed_rate
