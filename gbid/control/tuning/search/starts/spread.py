"""Random points that fill a box evenly."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray


def spread_points(n: int, d: int, seed: int) -> FloatArray:
    """Return n points (n, d) that fill the unit cube evenly, with a random shift.

    They are multiples of the square roots of primes (R. D. Richtmyer, "The evaluation of definite integrals, and a
    quasi-Monte-Carlo method based on the properties of algebraic numbers", Los Alamos report LA-1342, 1951). The
    package for such points in scipy takes a second to load.
    """
    primes = [k for k in range(2, 12 * (d + 1)) if all(k % i for i in range(2, int(k**0.5) + 1))]
    shift = np.random.default_rng(seed).random(d)
    return np.asarray((shift + np.arange(n)[:, None] * np.sqrt(primes[:d])) % 1.0)
