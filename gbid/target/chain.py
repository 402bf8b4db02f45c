"""Control chain: everything between the samples of the sensors and the references of the piezo stacks."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Literal

from gbid._version import __version__
from gbid.brief import Brief
from gbid.prefilter import RunoutMap
from gbid.target.chain_options import STACKS, ChainOptions
from gbid.target.grid_table import GridTable

Kind = Literal["x", "e", "d"]


@dataclass(frozen=True)
class SumTerm:
    """Product in a sum of the controller: entry of the row times a state x, an input e or a cut-off d.

    Attributes
    ----------
    entry : int
        Place of the factor in the row of the controller.
    kind : {"x", "e", "d"}
        What it is multiplied by: state, deviation of the disc, or what saturation took from an output.
    index : int
        Which one.
    """

    entry: int
    kind: Kind
    index: int


@dataclass(frozen=True, eq=False)
class Chain(Brief):
    """Control chain, from `chain_of`.

    Attributes
    ----------
    name : str
        Name and prefix of all names in the source.
    title : str
        Controller and plant in words.
    sample_time : float
        T_s [s].
    controller : GridTable
        Rows with the entries of the sampled controller that are not zero.
    outputs, states : tuple of tuple of SumTerm
        Sums that make each output from the row, and each next state.
    maps : tuple of RunoutMap
        Run-out maps; empty for none, one, or several of one set of harmonics.
    harmonics : GridTable or None
        Rows with the mean and the harmonics of the maps: mean of x and y, then cosine of x and y, sine of x and y for
        the orders 1, 2, ...; None when there is no map of harmonics.
    options : ChainOptions
        Limits, ramps, guards and watchdog.
    notes : tuple of str
        Remarks for the reader of the source.
    """

    name: str
    title: str
    sample_time: float
    controller: GridTable
    outputs: tuple[tuple[SumTerm, ...], ...]
    states: tuple[tuple[SumTerm, ...], ...]
    maps: tuple[RunoutMap, ...]
    harmonics: GridTable | None
    options: ChainOptions
    notes: tuple[str, ...] = ()

    @property
    def n_orders(self) -> int:
        """Number of harmonics, the missing orders between them included."""
        return 0 if self.harmonics is None else (self.harmonics.rows.shape[1] - 2) // 4

    @property
    def bins(self) -> RunoutMap | None:
        """The map when it is a table over the angle."""
        return next((each for each in self.maps if each.method == "bins"), None)

    @property
    def needs_angle(self) -> bool:
        """Whether the shaft angle is used."""
        return any(each.needs_angle for each in self.maps)

    @property
    def is_scheduled(self) -> bool:
        """Whether pressure and speed are used."""
        return self.controller.is_scheduled or (self.harmonics is not None and self.harmonics.is_scheduled)

    @property
    def allocation(self) -> tuple[tuple[float, float], ...]:
        """Factors of r_x and r_y in the references of the stacks."""
        return STACKS

    @property
    def ramp_samples(self) -> int:
        """Length of the start-up ramp in samples."""
        return self.options.samples(self.options.ramp_s, self.sample_time)

    @property
    def fade_samples(self) -> int:
        """Length of the fade of the control in samples."""
        return self.options.samples(self.options.fade_s, self.sample_time)

    @property
    def point_bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of pressure and speed that the schedules cover."""
        tables = [t for t in (self.controller, self.harmonics) if t is not None and t.is_scheduled]
        if not tables:
            return (0.0, 0.0), (0.0, 0.0)
        low_high = [
            (min(getattr(t, axis)[0] for t in tables), max(getattr(t, axis)[-1] for t in tables))
            for axis in ("pressure_bar", "speed_rpm")
        ]
        return low_high[0], low_high[1]

    @property
    def point_steps(self) -> tuple[float, float]:
        """Largest change of pressure and speed per sample that the schedules follow."""
        return self.options.pressure_rate * self.sample_time, self.options.speed_rate * self.sample_time

    @cached_property
    def content_key(self) -> str:
        """Digest of all numbers of the chain, 64 hexadecimal digits."""
        tables = [t for t in (self.controller, self.harmonics) if t is not None]
        document = {
            "gbid": __version__,
            "name": self.name,
            "sample_time": self.sample_time,
            "tables": [[t.pressure_bar, t.speed_rpm, t.rows.tolist()] for t in tables],
            "sums": [[asdict(term) for term in terms] for terms in (*self.outputs, *self.states)],
            "bins": [] if self.bins is None else [self.bins.angles.tolist(), self.bins.table.tolist()],
            "means": [each.mean.tolist() for each in self.maps],
            "options": asdict(self.options),
        }
        return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
