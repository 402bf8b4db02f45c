"""Recordings and frequency responses as Parquet, MDF and universal files for other programs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.core.extras import extra_package
from gbid.core.files import atomic_path
from gbid.core.names import given_path
from gbid.identify import FrequencyData
from gbid.recording import Recording
from gbid.recording.formats import UNIVERSAL
from gbid.recording.readers import SPREAD


def save_data(
    what: Recording | FrequencyData | Sequence[Recording], path: str | Path, *, overwrite: bool = False
) -> Path:
    """Write recordings or frequency responses for another program, and return the path of the file.

    Parameters
    ----------
    what : Recording, sequence of Recording, or FrequencyData
        The data. A channel is named ``p_x``, or by its signal where that has one channel. Several recordings are for
        ``.mf4``: a group for each, by the name of the recording, whose channels are ``run 1/p_x``.
    path : path
        The new file. Its ending decides the format: ``.parquet`` (extra ``arrow``) and ``.mf4`` (extra ``mdf``) for
        recordings, ``.uff`` or ``.unv`` (extra ``uff``) for both.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    pathlib.Path
        The file, which `gbid.import_recording` or `FrequencyData.read` reads again.

    Raises
    ------
    UsageError
        When the ending is unknown, the package is not installed, the file exists and `overwrite` is not set, recordings
        have one name, or the format cannot hold the data: universal files have no missing samples and names of at most
        10 characters.
    DataError
        When the file cannot be written.

    Notes
    -----
    Universal files have the values with twelve digits, but sample times and frequencies with six.
    """
    path = given_path(path)
    writers: dict[str, Callable[[Any, Path], None]] = dict.fromkeys(UNIVERSAL.endings, _write_universal)
    if isinstance(what, Recording):
        writers |= {".parquet": _write_parquet, ".mf4": lambda recording, part: _write_mdf([recording], part)}
    elif not isinstance(what, FrequencyData):
        writers = {".mf4": _write_mdf}
        names = [recording.name for recording in what]
        if twice := [name for name in names if names.count(name) > 1]:
            raise UsageError(
                f"two recordings have the name {twice[0]!r}; rename one, as in replace(recording, name=...)"
            )
    if path.suffix.lower() not in writers:
        raise UsageError(f"{path}: unknown ending {path.suffix!r}; choose from {', '.join(writers)}")
    with atomic_path(path, overwrite) as part:
        writers[path.suffix.lower()](what, part)
    return path


class _NamedChannel(NamedTuple):
    name: str
    unit: str
    values: FloatArray


def _columns(recording: Recording) -> list[_NamedChannel]:
    columns = [
        _NamedChannel(signal if len(names) == 1 else f"{signal}_{name}", recording.units[signal], values[:, i])
        for signal, values in recording.signals.items()
        for names in [recording.channels[signal]]
        for i, name in enumerate(names)
    ]
    names = [column.name for column in columns]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"recording {recording.name!r}: two channels would be named {twice[0]!r}; rename a signal")
    return columns


def _about(recording: Recording) -> str:
    return json.dumps({"name": recording.name, "conditions": dict(recording.conditions)}, ensure_ascii=False)


def _write_parquet(recording: Recording, path: Path) -> None:
    pyarrow = extra_package("pyarrow", "arrow", f"{path}: a Parquet file")
    parquet = extra_package("pyarrow.parquet", "arrow", f"{path}: a Parquet file")
    columns = [_NamedChannel("time", "s", recording.time), *_columns(recording)]
    fields = [
        pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit} if unit else None) for name, unit, _ in columns
    ]
    schema = pyarrow.schema(fields, metadata={"recording": _about(recording)})
    table = pyarrow.table([column.values for column in columns], schema=schema)
    parquet.write_table(table, path, write_page_checksum=True)


def _write_mdf(recordings: Sequence[Recording], path: Path) -> None:
    asammdf = extra_package("asammdf", "mdf", f"{path}: an MDF file")
    with asammdf.MDF() as file, path.open("w+b") as handle:
        for recording in recordings:
            time, columns = recording.time, _columns(recording)
            signals = [asammdf.Signal(values, time, unit=unit, name=name) for name, unit, values in columns]
            file.append(signals, acq_name=recording.name, comment=_about(recording), common_timebase=True)
        file.save(handle)


_DIRECTIONS = {"_x": 1, "_y": 2, "_z": 3}


def _write_universal(what: Recording | FrequencyData, path: Path) -> None:
    pyuff = extra_package("pyuff", "uff", f"{path}: a universal file")
    sets = [
        {
            "type": 58,
            "load_case_id": 0,
            "ref_node": 0,
            "ref_dir": 0,
            "orddenom_spec_data_type": 0,
            "abscissa_spec_data_type": 17 if isinstance(what, Recording) else 18,
            "abscissa_axis_lab": "Time" if isinstance(what, Recording) else "Frequency",
            "abscissa_axis_units_lab": "s" if isinstance(what, Recording) else "Hz",
            **each,
        }
        for each in (_functions(what) if isinstance(what, Recording) else _response_functions(what))
    ]
    pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")


def _functions(recording: Recording) -> list[dict[str, Any]]:
    if recording.missing or recording.stamps is not None:
        what = "missing samples" if recording.missing else "irregular times"
        raise UsageError(f"recording {recording.name!r} has {what}, which universal files do not have; write .parquet")
    evenly = {"func_type": 1, "abscissa_spacing": 1, "x": recording.time, "id1": f"{recording.name[:80]}"}
    return [
        {**evenly, **_point("rsp", name, i), "data": values, "ordinate_axis_units_lab": unit[:20] or "NONE"}
        for i, (name, unit, values) in enumerate(_columns(recording), start=1)
    ]


def _response_functions(data: FrequencyData) -> list[dict[str, Any]]:
    functions: list[dict[str, Any]] = []
    for (i, output), (j, source) in product(enumerate(data.output_names), enumerate(data.input_names)):
        measured = np.isfinite(data.response[:, i, j]) & np.isfinite(data.std[:, i, j])
        f = data.frequency_hz[measured]
        if len(f) < 2:
            continue
        even = bool(np.allclose(np.diff(f), f[1] - f[0], rtol=1e-6))
        at = {**_point("rsp", output, i + 1), **_point("ref", source, j + 1), "x": f, "abscissa_spacing": int(even)}
        functions += [
            {**at, "func_type": 4, "id1": data.name[:80], "data": data.response[measured, i, j]},
            {**at, "func_type": 0, "id1": SPREAD, "data": data.std[measured, i, j]},
        ]
    return functions


def _point(role: str, name: str, node: int) -> dict[str, Any]:
    if len(name) > 10 or not name.isascii():
        raise UsageError(f"universal files have names of at most 10 ASCII characters, not {name!r}; rename the signal")
    return {f"{role}_ent_name": name, f"{role}_node": node, f"{role}_dir": _DIRECTIONS.get(name[-2:], 0)}
