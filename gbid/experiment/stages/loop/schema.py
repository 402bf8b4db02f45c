"""Schema of the keys loop: the controller of recordings in closed loop, on the rig and in fits."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from gbid.experiment.fields import Count, CountOrZero, NotNegative, Number, Pair, Positive, Section, Switch, Text


class ControllerChoice(Section):
    """Controller of a loop: one that exists (`controller`), or a structure with its gains (`structure`, `gains`).

    `controller`: ``paper`` is the controller in the model file of the rig, ``tuned`` or ``tuned:NAME`` a design of the
    section controller for a named model, else a controller file, or ``file.py:name`` of a model or structure of your
    own. `structure`, `lowpass_hz`, `order` and `options` are those of a design. The sign is that of `gbid.close_loop`:
    positive gains are positive feedback.
    """

    controller: Text | None = None
    structure: Text | None = None
    gains: dict[Text, Number] = Field(default_factory=dict)
    lowpass_hz: Positive | None = None
    order: CountOrZero | None = None
    options: dict[Text, Number | Pair] = Field(default_factory=dict)


class RigLoopSection(ControllerChoice):
    """Recordings of the rig under a controller, ``<point>_loop1`` and so on; all its gains must be known.

    The references of a PRBS are added to the output of the controller and recorded as w. `amplitude_m`, `hold_s`: those
    of the section prbs when left out. `runout`: ``online``, the controller subtracts the run-out map of the rotor
    without controller; ``offline``, the controller answers to the run-out, and the prefilter subtracts the answers that
    `stationary` recordings under the controller show; ``none`` for sensors without run-out.
    """

    recordings: Count = 2
    stationary: CountOrZero | None = None
    amplitude_m: Positive | None = None
    hold_s: Positive | None = None
    runout: Literal["online", "offline", "none"] = "online"


class LoopSection(ControllerChoice):
    """Loop in which the recordings of a fit were made; see `gbid.ClosedLoop`. Empty: the loop of the section rig.

    ``focus: prediction`` is then the direct method, ``focus: simulation`` the indirect one. Gains of a structure that
    `gains` does not name are estimated along, as ``controller_<gain>``. `sampled`: the controller as it runs, with
    `sample_time_s` and `computation_samples` from the measurement to the action; else a continuous one whose output is
    late by `delay_s`, by default the computation and half a sample. `beside`: a fit of the same structure to recordings
    without controller, whose standard deviations are shown beside those of this fit.
    """

    sampled: Switch = True
    sample_time_s: Positive | None = None
    computation_samples: CountOrZero = 1
    delay_s: NotNegative | None = None
    measured: Annotated[tuple[Annotated[int, Strict(), Field(ge=0)], ...], Field(min_length=1)] | None = None
    injected: Literal["plant input", "set point"] = "plant input"
    pade_order: Count = 3
    beside: Text | None = None
