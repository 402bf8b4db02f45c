"""Readers that fail in the ways of libraries, for the process that runs them."""

import os
import sys

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
    import time

    time.sleep(60)


def hungry(path):
    return np.ones(1 << 33).sum()  # 64 GiB


def raising(path):
    raise NotImplementedError("compression type 9\nsecond line")


def ending(path):
    os._exit(7)
