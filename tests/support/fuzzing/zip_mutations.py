"""Mutations of a zip archive of arrays: headers that declare too much, odd types, encryption, compression bombs."""

from __future__ import annotations

import io
import zipfile
from functools import cache
from random import Random

from fuzzing.byte_mutations import mutate_bytes

_SHAPES = (
    "(1000000000000,)", "(30000000, 30)", "(-1,)", "(3, 4)", "()", "(1e3,)", "('a',)", "(" * 50, "(2**70,)", "[3]"
)  # fmt: skip
_TYPES = ("'|O'", "'<U9'", "'<M8[ns]'", "'<c16'", "'>f4'", "'|V8'", "[('a', '<f8')]", "'zz'", "None", "'|b1'", "'<f2'")


def mutate_npz(random: Random, content: bytes) -> bytes:
    """Return an npz archive with changed members; one third of them change as bytes."""
    if random.randrange(3) == 0:
        return mutate_bytes(random, content)
    if random.randrange(40) == 0:
        return npz_bomb()
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = random.choice(sorted(members))
    what = random.choice((0, 0, 1, 2, 4, 5, 6, 7))
    if what == 0:
        members[name] = _header(random, members[name])
    elif what == 1:
        members[name] = mutate_bytes(random, members[name])
    elif what == 2:
        del members[name]
    elif what == 4:
        members[random.choice(("../x.npy", "/etc/x.npy", "t", "a\x1b[31m.npy", "t.npy/t.npy"))] = members[name]
    changed = io.BytesIO()
    with zipfile.ZipFile(changed, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for each, data in members.items():
            archive.writestr(each, data)
    out = bytearray(changed.getvalue())
    if what >= 5:  # a field of the central directory: flags (encrypted), method, sizes
        place = out.find(b"PK\x01\x02") + random.choice((8, 9, 10, 11, 20, 24, 28, 34, 42))
        if place < len(out):
            out[place] = random.choice((1, 9, 12, 14, 93, 99, 255))
    return bytes(out)


def _header(random: Random, member: bytes) -> bytes:
    end = member.find(b"\n") + 1
    text = member[10:end].decode("latin-1")
    start, stop = text.find("'shape': ") + 9, text.rfind(", }")
    text = text[:start] + random.choice(_SHAPES) + text[stop:]
    if random.randrange(2):
        start = text.find("'descr': ") + 9
        text = text[:start] + random.choice(_TYPES) + text[text.find(", 'fortran") :]
    text = text.rstrip("\n ").ljust(max(0, end - 11)) + "\n"
    return member[:8] + (len(text) & 0xFFFF).to_bytes(2, "little") + text.encode("latin-1") + member[end:]


@cache
def npz_bomb() -> bytes:
    """Return a small archive of an array of 2 GiB."""
    count = 1 << 28  # 2 GiB of zeros
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({count},), }}".ljust(117) + "\n"
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("t", "a"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode())
                for _ in range(count >> 17 if name == "a" else 1):
                    member.write(bytes(1 << 20))
    return packed.getvalue()
