"""What gbid reads of files of other projects beside what the projects' own readers give.

`python -m tests.benchmarks.public_files FOLDER` takes every file of a known ending in a folder and below it. The test
files of npTDMS, asammdf, pyuff, mat-io, mat73 and scipy are good ones; they are fetched, not stored. A column that gbid
lists is compared number by number; what gbid refuses is printed with its reason.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import GbidError
from gbid.recording.columns import split_reference
from gbid.recording.importing import file_format, list_channels

_ONE = re.compile(r"one number: (.+)")
_NUMERIC = "fiub"


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of nested structs by dotted names, as peers return them."""
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), each)
    elif type(value).__name__ == "DataFrame":
        yield from ((f"{name}.{key}", value[key].to_numpy()) for key in value.columns)
        if value.index.dtype.kind in "mM":
            yield f"{name}.{value.index.name or 'Time'}", value.index.to_numpy()
    elif isinstance(getattr(value, "properties", None), Mapping):
        yield from _leaves(name, value.properties)
    elif isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
        for key in value.dtype.names:
            yield from _leaves(f"{name}.{key}", value[key].flat[0])
    else:
        yield name, value


def _tdms(path: Path) -> dict[str, Any]:
    import nptdms

    file = nptdms.TdmsFile.read(path)
    return {f"{group.name}/{channel.name}": channel[:] for group in file.groups() for channel in group.channels()}


def _mdf(path: Path) -> dict[str, Any]:
    import asammdf

    values: dict[str, list[Any]] = {}
    with asammdf.MDF(path) as file:
        for g, group in enumerate(file.groups):
            for c, channel in enumerate(group.channels):
                signal = file.get(group=g, index=c, ignore_invalidation_bits=True)
                samples, bits = signal.samples, signal.invalidation_bits
                if bits is not None and np.any(bits) and samples.dtype.kind in _NUMERIC:
                    samples = np.where(bits, np.nan, samples)
                for prefix in ("", f"{g}/", f"{group.channel_group.acq_name}/"):
                    values.setdefault(f"{prefix}{channel.name}", []).append(samples)
    return {name: each[0] for name, each in values.items() if len(each) == 1}


def _uff(path: Path) -> dict[str, Any]:
    import pyuff

    file = pyuff.UFF(str(path))
    kinds = file.get_set_types().tolist()
    return {str(k): file.read_sets(i)["data"] for k, i in enumerate(i for i, kind in enumerate(kinds) if kind == 58)}


def _mat(path: Path) -> dict[str, Any]:
    """Return the arrays by scipy or mat73, and those of objects, which these do not read, by mat-io."""
    import h5py
    import matio
    import scipy.io

    if h5py.is_hdf5(path):
        import mat73

        loaded = mat73.loadmat(str(path))
    else:
        loaded = scipy.io.loadmat(str(path), chars_as_strings=True)
    objects = dict(_leaves("", matio.load_from_mat(str(path))))
    plain = _leaves("", {key: value for key, value in loaded.items() if f"{key}"[:2] != "__"})
    return objects | {key: value for key, value in plain if getattr(value, "dtype", np.dtype("O")).kind in _NUMERIC}


PEERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".tdms": _tdms, ".mf4": _mdf, ".mdf": _mdf, ".uff": _uff, ".unv": _uff, ".mat": _mat,
}  # fmt: skip


def _columns(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what gbid reads, by the name of the column, and what it lists without reading it, with the reason."""
    read, left, names = {}, {}, []
    reader = file_format(path).read
    for channel in list_channels(path):
        one = _ONE.fullmatch(channel.remark)
        if one:
            read[channel.name] = np.array([float(one[1])])
        elif channel.remark:
            left[channel.name] = channel.remark
        else:
            names.append(channel.name)
    try:
        read |= {name: column.values for name, column in reader(path, names).items()}
    except GbidError:
        for name in names:
            try:
                read[name] = reader(path, [name])[name].values
            except GbidError as error:
                left[name] = str(error).removeprefix(f"{path}: ")
    return read, left


def _of_peer(values: Mapping[str, Any], reference: str) -> Any:
    """Return the numbers of a column in what a peer read; None where it has no such numbers."""
    name, index = split_reference(reference)
    array = values.get(reference, values.get(name))
    if array is None:
        return None
    array = np.asarray(array)
    if array.dtype.kind in "mM":
        array = (
            (array - array.flat[0]) / np.timedelta64(1, "s")
            if array.dtype.kind == "M"
            else array / np.timedelta64(1, "s")
        )
    if array.dtype.kind not in _NUMERIC:
        return None
    array = np.atleast_1d(np.squeeze(array)) if index is None or reference in values else array
    return array if array.ndim == 1 else array[:, index] if index is not None else None


def _compare(path: Path) -> tuple[Counter[str], list[str]]:
    """Return how many columns are of each outcome, and lines about what differs."""
    counts: Counter[str] = Counter()
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        try:
            peer = PEERS[path.suffix.lower()](path)
        except Exception as error:  # a peer can raise anything on its own files
            counts["the peer fails"], peer = 1, {}
            failed = f"{type(error).__name__}: {str(error)[:80]}"
        else:
            failed = ""
        try:
            read, left = _columns(path)
        except GbidError as error:
            counts["refused"] += 1
            return counts, [
                f"refused: {str(error).removeprefix(str(path) + ': ')[:160]}{failed and f' (peer: {failed})'}"
            ]
    lines = [f"peer: {failed}"] if failed else []
    ordered = list(peer.values()) if path.suffix.lower() in (".uff", ".unv") else []
    timed = [values for values in ordered if np.isrealobj(values)]
    for name, values in read.items():
        expected = _of_peer(peer, name)
        if ordered:
            same = any(len(each) == len(values) and np.array_equal(each, values, equal_nan=True) for each in timed)
            kind = "equal" if same or name == "time" else "different"
        elif expected is None:
            kind = "only gbid"
        else:
            fits = expected.shape == values.shape
            same = fits and np.allclose(
                values, expected.astype(float), rtol=1e-5 if len(values) == 1 else 0, atol=0, equal_nan=True
            )
            kind = "equal" if same else "different"
        counts[kind] += 1
        if kind in ("different", "only gbid"):
            lines.append(
                f"{kind}: {name}: {values[:3]} ({len(values)}), peer {None if expected is None else expected[:3]}"
            )
    counts["left out, said"] = len(left)
    lines += [f"left: {name}: {reason[:110]}" for name, reason in list(left.items())[:4]]
    if not ordered:
        roots = {split_reference(name)[0] for name in (*read, *left)}
        shorts = {name.rpartition("/")[2] for name in roots} | roots
        numeric = [n for n, v in peer.items() if isinstance(v, np.ndarray) and v.dtype.kind in _NUMERIC and v.size]
        unseen = [n for n in numeric if not {n, n.rpartition("/")[2], n.partition(".")[0]} & shorts]
        counts["only the peer"] = len(unseen)
        lines += [f"only the peer: {name}" for name in unseen[:4]]
    return counts, lines


def main() -> int:
    """Print a table of the files and what differs; return 1 where a number does."""
    total, compared, logging.root.disabled = Counter[str](), 0, True
    folder = Path(sys.argv[1])
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PEERS and path.is_file())
    for path in files:
        began = time.perf_counter()
        counts, lines = _compare(path)
        total += counts
        compared += counts["equal"] > 0
        figures = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        print(f"{path.relative_to(folder)}: {figures or 'nothing'}; {time.perf_counter() - began:.1f} s")
        for line in lines[:12]:
            print(f"    {line}")
    print(f"{len(files)} files, {compared} with columns that are equal, {total['refused']} refused: {dict(total)}")
    return int(bool(total["different"]))


if __name__ == "__main__":
    sys.exit(main())
