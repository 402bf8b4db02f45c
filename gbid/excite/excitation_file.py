"""Excitation as a CSV file, for the signal generator and for the rig."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.atomic import atomic_path
from gbid.errors import DataError
from gbid.excite.excitation import Excitation
from gbid.files.text_checksum import add_text_checksum, is_changed
from gbid.naming.paths import given_path
from gbid.tables.csv import write_csv
from gbid.tables.table import plain_table
from gbid.units import SIGNALS

_TIME = "time_s"


class PlayedFile(NamedTuple):
    """Contents of the file of an excitation.

    Attributes
    ----------
    columns : dict of str to (n_samples,) array
        Channels by heading, such as ``r_x_m``.
    sample_time : float
        Time between samples [s].
    """

    columns: dict[str, FloatArray]
    sample_time: float


def save_excitation(excitation: Excitation, path: str | Path, overwrite: bool = False, comment: str = "") -> Path:
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
    comment : str
        Further comment line.

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
        write_csv(
            plain_table(heads, np.column_stack(columns).tolist()), part, [*notes, *([comment] if comment else [])]
        )
        add_text_checksum(part, ".csv")
    return path


def read_excitation(path: str | Path) -> PlayedFile:
    """Return the channels in the file of an excitation.

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
