"""Mutations of bytes: flips, cuts, copies and numbers at their limits."""

from __future__ import annotations

import struct
from random import Random

_EXTREMES = (
    0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1
)  # fmt: skip


def flip_bits(random: Random, content: bytes) -> bytes:
    """Flip one bit, or a few."""
    out = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 2, 8))):
        out[random.randrange(len(out))] ^= 1 << random.randrange(8)
    return bytes(out)


def overwrite(random: Random, content: bytes) -> bytes:
    """Overwrite a piece with bytes of one kind or of any kind."""
    start = random.randrange(len(content))
    length = random.choice((1, 2, 4, 8, 16, 64, 512))
    fill = random.choice((b"\0", b"\xff", b" ", None))
    new = bytes(random.randrange(256) for _ in range(length)) if fill is None else fill * length
    return content[:start] + new + content[start + length :]


def extreme_number(random: Random, content: bytes) -> bytes:
    """Put a number at its limit where a number may stand: a size, an address, a count."""
    size, form = random.choice(((2, "H"), (4, "I"), (8, "Q")))
    place = random.randrange(max(1, len(content) // size)) * size
    value = random.choice(_EXTREMES) & ((1 << (8 * size)) - 1)
    return content[:place] + struct.pack(random.choice("<>") + form, value) + content[place + size :]


def truncate(random: Random, content: bytes) -> bytes:
    """Cut off the end, as a full disk or a lost connection does."""
    return content[: random.randrange(len(content))]


def insert(random: Random, content: bytes) -> bytes:
    """Insert a piece of the file elsewhere."""
    start, place = random.randrange(len(content)), random.randrange(len(content))
    piece = content[start : start + random.choice((1, 4, 16, 100, 1000))]
    return content[:place] + piece + content[place:]


def delete(random: Random, content: bytes) -> bytes:
    """Leave out a piece."""
    start = random.randrange(len(content))
    return content[:start] + content[start + random.choice((1, 2, 8, 100, 1000)) :]


def swap(random: Random, content: bytes) -> bytes:
    """Exchange two blocks, as a disk may."""
    size = random.choice((64, 512))
    a, b = sorted(random.randrange(max(1, len(content) // size)) * size for _ in range(2))
    if a == b:
        return content[:a] + content[a + size :]
    first, second = content[a : a + size], content[b : b + size]
    return content[:a] + second + content[a + size : b] + first + content[b + size :]


def odd_file(random: Random, content: bytes) -> bytes:
    """Return something else under the name."""
    marks = (b"", b"\0", b"\x89HDF\r\n\x1a\n", b"PK\x05\x06" + bytes(18))
    return random.choice((*marks, content + content, b"MATLAB 5.0 MAT-file" + content))


BYTE_MUTATIONS = (
    flip_bits, flip_bits, flip_bits, overwrite, extreme_number, extreme_number, truncate, insert, delete, swap
)  # fmt: skip


def mutate_bytes(random: Random, content: bytes) -> bytes:
    """Return bytes with one to three mutations."""
    if random.randrange(200) == 0:
        return odd_file(random, content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        content = random.choice(BYTE_MUTATIONS)(random, content or b"\0")
    return content
