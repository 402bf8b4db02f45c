"""Table of many fits, with a row for each: the result of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Annotated, Any, ClassVar, get_type_hints

import numpy as np
import numpy.typing as npt

from gbid.core import hdf5
from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.brief import Brief, Description, brief, counted
from gbid.core.errors import UsageError
from gbid.core.extras import data_frame
from gbid.core.hdf5 import Stored
from gbid.core.tables import Table, plain_table
from gbid.identify.result import FitResult

TextArray = npt.NDArray[np.str_]

MODE_BLOCKS = ("mode_frequency_hz", "mode_frequency_std_hz", "mode_damping", "mode_damping_std")


@dataclass(frozen=True, eq=False)
class FitTable(Brief, hdf5.InFile):
    """Table with one row for each fit of a campaign, including failed fits.

    n rows, k parameters, m modes, g static gains, q outputs. The columns are those of all fits in the table. Values
    that a fit does not have are nan. A failed fit has nan in all columns and its reason in `status`.

    Attributes
    ----------
    fit : (n,) array of str
        Name of the fit in the experiment, e.g. ``"bearing"``.
    model : (n,) array of str
        Name of the model: that of its recording, or ``"together"``.
    structure : (n,) array of str
        Name of the structure; empty for a failed fit.
    recordings : tuple of tuple of str
        Recordings of each row.
    pressure_bar, speed_rpm : (n,) array
        Operating point [bar], [rpm]; nan when it is unknown or the recordings have several.
    parameter_names : tuple of str, k
        Names of the parameters.
    units : tuple of str, k
        Units of the parameters.
    values : (n, k) array
        Estimates and fixed values, with the delays (``tau_x`` [s]).
    std : (n, k) array
        Standard deviations as in `gbid.FitResult.std`: 0 fixed, nan none.
    covariance : (n, k, k) array
        Covariance to use (`gbid.FitResult.covariance`); rows and columns of fixed parameters are 0.
    mode_frequency_hz, mode_frequency_std_hz : (n, m) array
        Natural frequencies in rising order, and their standard deviations [Hz].
    mode_damping, mode_damping_std : (n, m) array
        Damping factors, and their standard deviations.
    gain_names : tuple of str, g
        Names of the static gains: ``"u_x to p_x"`` and so on.
    static_gain, static_gain_std : (n, g) array
        Static gains, and their standard deviations.
    output_names : tuple of str, q
        Names of the outputs.
    fit_percent : (n, q) array
        Fit percent; for a fit to several recordings the smallest of them.
    success : (n,) array of bool
        Whether the fit exists and converged.
    status : (n,) array of str
        Status of the fit, or reason of its failure.
    notes : tuple of tuple of str
        Notes of each fit.
    iterations : (n,) array of int
        Numbers of iterations.
    wall_time_s : (n,) array
        Computing times [s].
    """

    fit: Annotated[TextArray, Stored("", "name of the fit", "n")]
    model: Annotated[TextArray, Stored("", "which model of the fit", "n")]
    structure: Annotated[TextArray, Stored("", "name of the structure", "n")]
    recordings: Annotated[tuple[tuple[str, ...], ...], Stored("", "recordings fitted to, one a line", "n")]
    pressure_bar: Annotated[FloatArray, Stored("bar", "supply pressure", "n")]
    speed_rpm: Annotated[FloatArray, Stored("rpm", "shaft speed", "n")]
    parameter_names: Annotated[tuple[str, ...], Stored(shape="k")]
    units: Annotated[tuple[str, ...], Stored(shape="k")]
    values: Annotated[FloatArray, Stored("as attribute units of the root", "estimates, fits by parameters", "n k")]
    std: Annotated[
        FloatArray, Stored("as attribute units of the root", "standard deviations; 0 fixed, nan none", "n k")
    ]
    covariance: Annotated[
        FloatArray,
        Stored("as attribute units of the root", "covariance to trust, fits by parameters by parameters", "n k k"),
    ]
    mode_frequency_hz: Annotated[FloatArray, Stored("Hz", "natural frequencies", "n m")]
    mode_frequency_std_hz: Annotated[FloatArray, Stored("Hz", "standard deviations of the natural frequencies", "n m")]
    mode_damping: Annotated[FloatArray, Stored("1", "damping factors", "n m")]
    mode_damping_std: Annotated[FloatArray, Stored("1", "standard deviations of the damping factors", "n m")]
    gain_names: Annotated[tuple[str, ...], Stored(shape="g")]
    static_gain: Annotated[FloatArray, Stored("", "static gains, fits by gains", "n g")]
    static_gain_std: Annotated[FloatArray, Stored("", "standard deviations of the static gains", "n g")]
    output_names: Annotated[tuple[str, ...], Stored(shape="q")]
    fit_percent: Annotated[FloatArray, Stored("%", "fit, fits by outputs", "n q")]
    success: Annotated[BoolArray, Stored("1", "whether the fit is there and converged", "n")]
    status: Annotated[TextArray, Stored("", "status of the fit, or why it failed", "n")]
    notes: Annotated[tuple[tuple[str, ...], ...], Stored("", "what a reader should know, one a line", "n")]
    iterations: Annotated[IntArray, Stored("1", "iterations of the solver", "n")]
    wall_time_s: Annotated[FloatArray, Stored("s", "time that the fit took", "n")]
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("table", "make the table anew with `gbid batch` or `gbid run`")

    def _brief(self) -> Description:
        converged = [name for name, success in zip(self.fit.tolist(), self.success, strict=True) if success]
        return brief(
            self,
            f"{len(self)} fits, {len(converged)} converged",
            fit=counted(self.fit.tolist()),
            success=counted(converged),
            pressure_bar=self.pressure_bar,
            speed_rpm=self.speed_rpm,
            parameter_names=", ".join(self.parameter_names),
            output_names=self.output_names,
            fit_percent=self.fit_percent,
        )

    def __len__(self) -> int:
        return len(self.fit)

    def parameter(self, name: str) -> FloatArray:
        """Return the estimates of one parameter over all fits, (n,).

        Parameters
        ----------
        name : str
            Name of the parameter.

        Raises
        ------
        UsageError
            When no fit of the table has the parameter.
        """
        if name not in self.parameter_names:
            raise UsageError(f"no parameter {name!r} in the table; choose from {', '.join(self.parameter_names)}")
        return self.values[:, self.parameter_names.index(name)]

    def covariance_of(self, names: Sequence[str]) -> FloatArray:
        """Return covariances of selected parameters, in the given order, (n, len(names), len(names)).

        Parameters
        ----------
        names : sequence of str
            Names of the parameters.

        Raises
        ------
        UsageError
            When no fit of the table has one of the parameters.
        """
        for name in names:
            self.parameter(name)
        at = [self.parameter_names.index(name) for name in names]
        return self.covariance[:, at][:, :, at]

    def select(
        self,
        mask: npt.ArrayLike | None = None,
        *,
        fit: str | None = None,
        pressure_bar: float | None = None,
        speed_rpm: float | None = None,
        success: bool | None = None,
    ) -> FitTable:
        """Return a table of selected rows, with the columns that these rows use.

        Parameters
        ----------
        mask : (n,) array of bool, optional
            Rows to keep.
        fit : str, optional
            Name of a fit of the experiment.
        pressure_bar, speed_rpm : float, optional
            Pressure [bar] or speed [rpm] of the rows.
        success : bool, optional
            True for fits that converged, False for the others.

        Returns
        -------
        FitTable
            The selected rows.

        Raises
        ------
        UsageError
            When the fit is not in the table, or the mask has another length.
        """
        keep = np.ones(len(self), dtype=bool) if mask is None else np.asarray(mask)
        if keep.dtype != bool or keep.shape != (len(self),):
            raise UsageError(f"mask: expected {len(self)} values true or false, found {keep.dtype} {keep.shape}")
        if fit is not None:
            if fit not in self.fit:
                raise UsageError(f"no fit {fit!r} in the table; choose from {', '.join(dict.fromkeys(self.fit))}")
            keep = keep & (self.fit == fit)
        for name, value in {"pressure_bar": pressure_bar, "speed_rpm": speed_rpm, "success": success}.items():
            if value is not None:
                keep = keep & np.isclose(getattr(self, name), value)
        chosen = self._taken(n=np.flatnonzero(keep))
        blocks = {"k": chosen.values, "m": chosen.mode_frequency_hz, "g": chosen.static_gain, "q": chosen.fit_percent}
        known = {letter: np.flatnonzero(np.isfinite(block).any(axis=0)) for letter, block in blocks.items()}
        return chosen._taken(**known)

    def _taken(self, **kept: IntArray) -> FitTable:
        """Return a table with selected indices along the dimensions n, k, m, g and q."""
        taken: dict[str, Any] = {}
        for name, letters in _dimensions().items():
            taken[name] = getattr(self, name)
            for axis, places in ((i, kept[letter]) for i, letter in enumerate(letters) if letter in kept):
                if isinstance(taken[name], np.ndarray):
                    taken[name] = np.take(taken[name], places, axis)
                else:
                    taken[name] = tuple(taken[name][i] for i in places)
        return replace(self, **taken)

    def row(self, fit: str, model: str) -> dict[str, Any]:
        """Return one row as a dict by the names of `columns`.

        Parameters
        ----------
        fit : str
            Name of the fit in the experiment.
        model : str
            Name of the recording, or of the group that was fitted together.

        Raises
        ------
        UsageError
            When there is no such row.
        """
        rows = np.flatnonzero((self.fit == fit) & (self.model == model))
        if not rows.size:
            raise UsageError(f"no model {model!r} of fit {fit!r} in the table")
        return {name: values[rows[0]] for name, (values, _) in self.columns().items()}

    def columns(self) -> Mapping[str, tuple[npt.NDArray[Any], str]]:
        """Return all columns of the CSV file in order, each with its unit.

        Returns
        -------
        dict of str to (array, str)
            ``k_xx`` and ``k_xx_std``, ``mode1_frequency_hz``, ``gain_u_x_to_p_x``, ``fit_percent_p_x`` and so on.
        """
        return {
            "fit": (self.fit, ""),
            "model": (self.model, ""),
            "structure": (self.structure, ""),
            "recordings": (_joined(self.recordings, " "), ""),
            "pressure_bar": (self.pressure_bar, "bar"),
            "speed_rpm": (self.speed_rpm, "rpm"),
            "success": (self.success, ""),
            "status": (self.status, ""),
            "iterations": (self.iterations, ""),
            **{f"fit_percent_{name}": (self.fit_percent[:, j], "%") for j, name in enumerate(self.output_names)},
            **{
                f"{name}{ending}": (values[:, j], unit)
                for j, (name, unit) in enumerate(zip(self.parameter_names, self.units, strict=True))
                for ending, values in (("", self.values), ("_std", self.std))
            },
            **{
                name.replace("mode_", f"mode{j + 1}_"): (getattr(self, name)[:, j], "Hz" if "_hz" in name else "1")
                for j in range(self.mode_frequency_hz.shape[1])
                for name in MODE_BLOCKS
            },
            **{
                f"gain_{name.replace(' ', '_')}{ending}": (values[:, j], "")
                for j, name in enumerate(self.gain_names)
                for ending, values in (("", self.static_gain), ("_std", self.static_gain_std))
            },
            "notes": (_joined(self.notes, "; "), ""),
            "wall_time_s": (self.wall_time_s, "s"),
        }

    def to_frame(self) -> Any:
        """Return the table as a data frame, with the columns of the CSV file.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        columns = self.columns()
        units = {name: unit for name, (_, unit) in columns.items()}
        return data_frame({name: values for name, (values, _) in columns.items()}, units=units)


@cache
def _dimensions() -> dict[str, list[str]]:
    """Return the dimension letters of each field, from its storage declaration."""
    hints = get_type_hints(FitTable, include_extras=True)
    return {field.name: hints[field.name].__metadata__[0].shape.split() for field in fields(FitTable)}


def _joined(texts: Sequence[Sequence[str]], by: str) -> TextArray:
    return np.array([by.join(each) for each in texts], dtype=str)


def csv_table(fits: FitTable) -> Table:
    """Return the CSV columns of a table of fits, with a note on units; nan becomes a missing value."""
    columns = fits.columns()
    units = ", ".join(f"{name} [{unit}]" for name, (_, unit) in columns.items() if unit)
    values = [[None if value != value else value for value in array.tolist()] for array, _ in columns.values()]
    rows = list(zip(*values, strict=True))
    return plain_table(list(columns), rows, [f"units, SI where none is given: {units}"])


@dataclass(frozen=True, eq=False)
class FitRow(Brief):
    """One fit as a row of a table; fields as in `gbid.FitResult`.

    Attributes
    ----------
    numbers : dict of str to dict
        Numbers of each block of columns of `FitTable`, by name; those of modes by their place.
    """

    structure: str
    success: bool
    status: str
    notes: tuple[str, ...]
    iterations: int
    wall_time_s: float
    units: Mapping[str, str]
    free: tuple[str, ...]
    covariance: FloatArray
    numbers: Mapping[str, Mapping[Any, float]]

    @classmethod
    def of(cls, result: FitResult) -> FitRow:
        """Return the row of a fit result."""
        shared = (field.name for field in fields(cls) if field.name != "numbers")
        return cls(**{name: getattr(result, name) for name in shared}, numbers=_numbers(result))


@dataclass(frozen=True, eq=False)
class TableEntry(Brief):
    """Source of one row of a table of fits: a result, or a failure.

    Attributes
    ----------
    fit, model : str
        Names of the fit and of its model.
    recordings : tuple of str
        Recordings of the model.
    conditions : dict of str to float
        Operating point: ``pressure_bar`` [bar] and ``speed_rpm`` [rpm], if they are known.
    result : FitResult or None
        The result; None for a fit without one.
    failure : str
        Reason of a missing result, which becomes the status.
    row : FitRow, optional
        The numbers of the result alone, in place of the result.
    """

    fit: str
    model: str
    recordings: tuple[str, ...]
    conditions: Mapping[str, float] = field(default_factory=dict)
    result: FitResult | None = None
    failure: str = ""
    row: FitRow | None = None


def tabulate(entries: Sequence[TableEntry]) -> FitTable:
    """Return a table of fits with a row for each entry, in the given order.

    Parameters
    ----------
    entries : sequence of TableEntry
        Sources of the rows.

    Returns
    -------
    FitTable
        The table.
    """
    rows = [entry.row or (None if entry.result is None else FitRow.of(entry.result)) for entry in entries]
    numbers = [row.numbers if row else {} for row in rows]
    names, outputs, gains, modes = (
        tuple(dict.fromkeys(name for each in numbers for name in each.get(block, ())))
        for block in ("values", "fit_percent", "static_gain", "mode_frequency_hz")
    )
    units = {name: unit for row in reversed(rows) if row for name, unit in row.units.items()}
    covariance = np.full((len(entries), len(names), len(names)), np.nan)
    for matrix, row in zip(covariance, rows, strict=True):
        if row is not None:
            known, free = ([names.index(name) for name in each] for each in (row.numbers["values"], row.free))
            matrix[np.ix_(known, known)] = 0.0
            matrix[np.ix_(free, free)] = row.covariance
    labels = {"values": names, "std": names, "fit_percent": outputs, "static_gain": gains, "static_gain_std": gains}
    blocks: dict[str, Any] = {
        block: np.array(
            [[each.get(block, {}).get(label, np.nan) for label in of_block] for each in numbers], float
        ).reshape(len(entries), len(of_block))
        for block, of_block in {**labels, **dict.fromkeys(MODE_BLOCKS, modes)}.items()
    }
    for name in ("pressure_bar", "speed_rpm"):
        blocks[name] = np.array([entry.conditions.get(name, np.nan) for entry in entries], float)
    return FitTable(
        fit=np.array([entry.fit for entry in entries], dtype=str),
        model=np.array([entry.model for entry in entries], dtype=str),
        structure=np.array([r.structure if r else "" for r in rows], dtype=str),
        recordings=tuple(tuple(entry.recordings) for entry in entries),
        parameter_names=names,
        units=tuple(units[name] for name in names),
        covariance=covariance,
        gain_names=gains,
        output_names=outputs,
        success=np.array([r is not None and r.success for r in rows], dtype=bool),
        status=np.array([r.status if r else e.failure for r, e in zip(rows, entries, strict=True)], dtype=str),
        notes=tuple(r.notes if r else () for r in rows),
        iterations=np.array([r.iterations if r else 0 for r in rows], dtype=np.int64),
        wall_time_s=np.array([r.wall_time_s if r else np.nan for r in rows], dtype=float),
        **blocks,
    )


def _numbers(result: FitResult) -> dict[str, Mapping[Any, float]]:
    model = result.model
    modes = np.reshape(model.modes(), (-1, 2))
    modes_std = result.modes_std if result.modes_std.shape == modes.shape else np.full(modes.shape, np.nan)
    gains = [f"{source} to {output}" for output in model.output_names for source in model.input_names]
    try:
        static_gain = model.static_gain().ravel()
    except UsageError:  # a pole at zero
        gains, static_gain = [], np.zeros(0)
    return {
        "values": result.parameters,
        "std": result.std,
        "fit_percent": dict(zip(model.output_names, result.fit_percent.min(axis=0), strict=True)),
        "static_gain": dict(zip(gains, static_gain, strict=True)),
        "static_gain_std": dict(zip(gains, result.static_gain_std.ravel(), strict=False)),
        **{block: dict(enumerate((modes, modes_std)[i % 2][:, i // 2])) for i, block in enumerate(MODE_BLOCKS)},
    }
