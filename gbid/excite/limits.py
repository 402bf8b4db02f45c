"""Limits of an excitation: peaks of signals, radius of the disc, and clearance of possible machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import ComplexArray
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive, check_options
from gbid.excite.model import KnownModel

SAFE = 0.98
"""Part of a limit that a design uses: between the samples the motion is a little larger than at them."""


@dataclass(frozen=True)
class PossibleMachine:
    """Another random draw of the machine that a model describes.

    Attributes
    ----------
    parameters : dict of str to float
        Parameters that differ from those of the model.
    taken : float
        Part of the clearance that is taken already: offset, orbit of the unbalance, run-out [m].
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    taken: float = 0.0


class ChannelLimit(NamedTuple):
    """Largest distance of chosen input or output channels from their centre.

    Attributes
    ----------
    name : str
        What is limited, for the reader.
    limit : float
        The limit.
    is_input : bool
        Whether the channels are inputs.
    columns : list of int
        The channels.
    """

    name: str
    limit: float
    is_input: bool
    columns: list[int]


@dataclass(frozen=True)
class ExcitationLimits:
    """Limits of an excitation.

    Parameters
    ----------
    peaks : dict of str to float
        Largest magnitude of each channel, by signal or channel of the model, such as ``{"r": 4.5e-6, "u": 8.4e-6}``.
        Without the inputs of the model a spectrum has no bound, so each input needs one.
    radius : dict of str to float
        Largest distance of a signal of two channels from its centre, such as ``{"p": 15e-6}`` for the disc.
    clearance : float, optional
        Clearance of the bearing [m]. The radius of `disc` plus what is taken of it stays below, in the model and in
        every machine of `machines`.
    disc : str
        Signal of the disc.
    taken : float
        Part of the clearance that is taken in the model itself [m].
    machines : sequence of PossibleMachine
        Other machines that must not rub either; those of the rig: `gbid.rig.possible_machines`.

    Raises
    ------
    UsageError
        When a limit is not positive, or nothing is left of the clearance.
    """

    peaks: Mapping[str, Positive] = field(default_factory=dict)
    radius: Mapping[str, Positive] = field(default_factory=dict)
    clearance: Positive | None = None
    disc: str = "p"
    taken: float = 0.0
    machines: Sequence[PossibleMachine] = ()

    def bounds(self, known: KnownModel) -> list[ChannelLimit]:
        """Return the bound of each limited signal of a model.

        Parameters
        ----------
        known : KnownModel
            The model.

        Raises
        ------
        UsageError
            When a limit names no signal of the model.
        """
        bounds = list[ChannelLimit]()
        for name, value in self.peaks.items():
            is_input, columns = known.channels(name)
            labels = known.model.input_names if is_input else known.model.output_names
            bounds += [ChannelLimit(labels[i], value, is_input, [i]) for i in columns]
        bounds += [
            ChannelLimit(f"radius of {name}", value, *known.channels(name)) for name, value in self.radius.items()
        ]
        if self.clearance is not None:
            bounds.append(ChannelLimit("clearance", self.clearance - self.taken, *known.channels(self.disc)))
        return bounds

    def __post_init__(self) -> None:
        check_options(self, "limits")
        if self.clearance is None:
            if self.machines:
                raise UsageError("limits: machines are used with a clearance only; give the clearance, too")
            return
        most = max([self.taken, *(machine.taken for machine in self.machines)])
        if self.clearance <= most:
            raise UsageError(
                f"limits: clearance = {self.clearance:g} m, of which run-out and unbalance take {most:g} m; there is "
                "no room to excite"
            )


@dataclass(frozen=True, eq=False)
class LimitedSignal:
    """Signal with a limit: its response to the inputs at spectral lines, divided by the limit.

    Attributes
    ----------
    name : str
        What is limited, for the reader.
    response : (n_lines, n_channels, n_inputs) array
        Response over limit. The distance from the centre over all channels must stay below one.
    """

    name: str
    response: ComplexArray


def limited_signals(
    limits: ExcitationLimits, known: KnownModel, response: ComplexArray, others: Sequence[ComplexArray] = ()
) -> list[LimitedSignal]:
    """Return the limited signals at spectral lines.

    Parameters
    ----------
    limits : ExcitationLimits
        The limits.
    known : KnownModel
        The model.
    response : (n_lines, n_outputs, n_inputs) array
        Its response.
    others : sequence of (n_lines, n_outputs, n_inputs) array
        Responses of the machines of the limits.

    Raises
    ------
    UsageError
        When a limit names no signal of the model, or an input has no limit.
    """
    n_lines, _, n_u = response.shape
    of_inputs: ComplexArray = np.repeat(np.eye(n_u, dtype=complex)[None], n_lines, axis=0)
    bounds = limits.bounds(known)
    limited = [
        LimitedSignal(b.name, (of_inputs if b.is_input else response)[:, b.columns] / (SAFE * b.limit)) for b in bounds
    ]
    for i, (machine, other) in enumerate(zip(limits.machines, others, strict=True)):
        assert limits.clearance is not None
        room = limits.clearance - machine.taken
        disc = other[:, known.channels(limits.disc)[1]]
        limited.append(LimitedSignal(f"clearance in machine {i + 1}", disc / (SAFE * room)))
    bounded = {column for b in bounds if b.is_input for column in b.columns}
    if missing := [label for i, label in enumerate(known.model.input_names) if i not in bounded]:
        raise UsageError(
            f"limits: input {missing[0]} has no limit; give its largest magnitude, such as peaks={{...: 4.5e-6}}"
        )
    return limited
