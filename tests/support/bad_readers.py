"""Readers that fail in the ways of libraries, for the process that runs them."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
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


def unlocked(path, has_folder):
    """Return what this process can do beyond reading, of what a hostile library would try."""
    trials = {
        "write": lambda: path.write_bytes(b"x"),
        "create": lambda: path.with_name("new").touch(),
        "remove": path.unlink,
        "rename": lambda: path.rename(path.with_name("new")),
        "link": lambda: path.with_name("new").symlink_to(path),
        "folder": lambda: path.with_name("new").mkdir(),
        "truncate": lambda: os.truncate(path, 0),
        "rights": lambda: path.chmod(0),
        "connect": socket.socket,
        "program": lambda: subprocess.run(["/bin/true"], check=True),
        "parent": lambda: os.kill(os.getppid(), signal.SIGCONT),
        "memory": lambda: os.open(f"/proc/{os.getppid()}/mem", os.O_RDWR),
    }
    done = []
    for name, trial in trials.items():
        with contextlib.suppress(OSError):
            trial()
            done.append(name)
    if not has_folder:
        return done
    with tempfile.TemporaryFile() as own:
        own.write(b"x")
    return done


class Attack:
    def __reduce__(self):
        return os.abort, ()


def attacking(path):
    return [Attack()]


def forging(path, answer):
    """Write an answer of its own to all open files."""
    for number in range(3, 20):
        with contextlib.suppress(OSError):
            os.write(number, answer)
    os._exit(0)


def returning(path, value):
    return value
