"""Worker process: it runs the tasks that it receives through a pipe."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import threading
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait

READY = "ready"


def serve(connection: Connection) -> None:
    """Run tasks until the pipe is closed.

    A message is a job (pickled), which is used for the following tasks, or a task with its number. The worker answers a
    task with its number and the result of `gbid.campaign.shipping.attempt`. It ignores Ctrl-C, because the runner stops
    its workers. When the runner is gone, it ends at once, also in the middle of a task: results appear only when they
    are complete.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_runner, daemon=True).start()
    from gbid.campaign.shipping import attempt  # imports all packages, once, before the first task

    collect_less()
    connection.send(READY)
    job = None
    try:
        while True:
            message = connection.recv()
            if isinstance(message, bytes):
                job = pickle.loads(message)
            else:
                number, task = message
                assert job is not None
                connection.send((number, attempt(job, task)))
    except (EOFError, OSError):  # the runner has ended
        return


def collect_less() -> None:
    """Leave what there is, as all that was imported, out of each collection of garbage, and collect less often.

    Symbols and pictures are many objects, few of them garbage: a fit takes 6 % less.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def _end_with_runner() -> None:
    """Wait until the process that started this one has ended, and end this one."""
    runner = parent_process()
    if runner is not None:
        wait([runner.sentinel])
        os._exit(1)
