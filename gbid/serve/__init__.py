"""Local web pages: a folder of recordings that becomes an experiment, and results that follow a running campaign."""

from gbid.serve.bench import open_bench
from gbid.serve.server import Server, open_server

__all__ = ["Server", "open_bench", "open_server"]
