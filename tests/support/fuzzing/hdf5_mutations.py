"""Mutations of the tree in an HDF5 file: entries that are missing, of another type, shape or size, or links."""

from __future__ import annotations

import io
from random import Random
from typing import Any

import h5py
import numpy as np

_VALUES: tuple[Any, ...] = (
    0, -1, 3, 1.5, np.nan, np.inf, "", "text", "\x1b[31m", b"\xff\xfe", True, "é" * 1000, 1 << 62,
    np.zeros(0), np.zeros((0, 3)), np.ones(3), np.ones((2, 2)), np.ones((1, 1, 1)), np.arange(5),
    np.array([True, False]), np.array([1 + 2j]), np.array([b"a", b"b"]), np.full(4, np.nan),
    np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]), h5py.Empty("f8"), h5py.Empty(h5py.string_dtype()),
    np.float16(1), np.ones(3, ">f4"), np.ones(2, np.longdouble),
)  # fmt: skip


def mutate_hdf5(random: Random, content: bytes) -> bytes:
    """Return the bytes of an HDF5 file with one to three entries changed."""
    memory = io.BytesIO(content)
    with h5py.File(memory, "r+") as file:
        for _ in range(random.choice((1, 1, 2, 3))):
            results: list[str] = []
            file.visit(results.append)
            _change_entry(random, file, random.choice(results) if results else "/")
        for name in ("gbid_kind", "schema_version"):
            if random.randrange(50) == 0 and name in file.attrs:
                file.attrs[name] = random.choice((1, 2, 99, "fit", "recording", -1))
    return memory.getvalue()


def _change_entry(random: Random, file: h5py.File, name: str) -> None:
    entry = file[name]
    what = random.randrange(6)
    if what <= 1 and entry.attrs:
        attribute = random.choice(sorted(entry.attrs))
        if what == 0:
            del entry.attrs[attribute]
        else:
            entry.attrs[attribute] = random.choice(_VALUES)
        return
    if name == "/":
        return
    is_small = isinstance(entry, h5py.Dataset) and entry.shape is not None and entry.nbytes < 1 << 20
    old = entry[()] if is_small else None
    del file[name]
    if what == 2:
        return
    if what == 3:
        _put_link(random, file, name)
        return
    if what == 4:
        size = random.choice(((1 << 40,), (1 << 30, 2), (1 << 20, 1 << 20, 1 << 10), (300_000_000,)))
        file.create_dataset(name, size, random.choice(("f8", "i1", "S8")), chunks=True)
        return
    if what == 5 and old is not None and np.ndim(old):
        bent = (old[:-1], old[::-1], np.concatenate([old, old]), old[None], old.ravel(), old[..., :0])
        file[name] = random.choice(bent) if old.dtype.kind != "O" else ["x"] * 3
        return
    value = random.choice(_VALUES)
    file.create_dataset(name, data=value) if random.randrange(8) else file.create_group(name)


def _put_link(random: Random, file: h5py.File, name: str) -> None:
    what = random.randrange(5)
    if what == 0:
        file[name] = h5py.SoftLink("/" + name)
    elif what == 1:
        file[name] = h5py.ExternalLink("/etc/passwd", "/")
    elif what == 2:
        file[name] = file["/"]  # a circle
    elif what == 3:
        file.create_dataset(name, (9,), "f8", external=[("/dev/zero", 0, 72)])
    else:
        layout = h5py.VirtualLayout((4,), "f8")
        layout[:] = h5py.VirtualSource("none.h5", "x", (4,))
        file.create_virtual_dataset(name, layout)
