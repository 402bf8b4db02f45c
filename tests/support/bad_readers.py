"""Readers that fail in the ways of libraries, for the process that runs them."""

import os
import re
import sys
import time

import numpy as np


def good(path, factor):
    sys.stdout.write("a library that prints\n")
    os.write(1, b"and one that writes to the standard output\n")
    return factor * len(path.read_bytes())


def crashing(path):
    os.abort()


def endless(path):
    while True:
        pass


def sleeping(path):
    time.sleep(60)


def waiting(path, seconds):
    time.sleep(seconds)
    return len(path.read_bytes())


def holding(path):
    """Compute for ever within one call of C, which lets no other thread of Python run."""
    return re.fullmatch("(a+)+", "a" * 64 + "b")


def hungry(path):
    return np.ones(1 << 33).sum()  # 64 GiB


def raising(path):
    raise NotImplementedError("compression type 9\nsecond line")


def ending(path):
    os._exit(7)
