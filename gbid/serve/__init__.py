"""Local web pages of results that follow a running campaign, with a gain explorer for every controller."""

from gbid.serve.server import Server, open_server

__all__ = ["Server", "open_server"]
