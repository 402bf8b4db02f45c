"""Web server of the results, for this machine only."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from gbid.errors import GbidError, UsageError
from gbid.serve.explored_loop import Explored, explored_loop
from gbid.serve.live import Live
from gbid.serve.pages import explorer_page, report_page

HOST = "127.0.0.1"
_OWN = (
    "127.0.0.1",
    "localhost",
)  # another name in the request is a page of another site that asks in the reader's name
_HTML, _JSON = "text/html; charset=utf-8", "application/json"


class Server(ThreadingHTTPServer):
    """Server of the pages of one experiment.

    Attributes
    ----------
    address : str
        Address of the report.
    """

    daemon_threads = True

    @property
    def address(self) -> str:
        """Address of the report."""
        return f"http://{HOST}:{self.server_address[1]}/"


def open_server(experiment: Path, results: Path | None = None, port: int = 0) -> Server:
    """Return a server of the results, which listens on this machine only.

    Parameters
    ----------
    experiment : path
        The experiment YAML.
    results : path, optional
        Folder of the results, instead of the one in the YAML.
    port : int
        Port; 0 for any free one.

    Returns
    -------
    Server
        Call ``serve_forever()``, then ``server_close()``.

    Raises
    ------
    UsageError
        When the YAML has problems, or when the port is not free.
    """
    live = Live(experiment, results)
    try:
        return Server((HOST, port), partial(_Handler, live))
    except (OSError, OverflowError) as error:
        raise UsageError(f"port {port}: {error}; choose another with --port") from None


class _Handler(BaseHTTPRequestHandler):
    """Answers to GET: report, explorer, state and loops. Nothing is written, and no file is served by its name."""

    server_version = "gbid"
    sys_version = ""

    def __init__(self, live: Live, *given: object) -> None:
        self._live = live
        super().__init__(*given)  # type: ignore[arg-type]  # request, address and server, from socketserver

    def do_GET(self) -> None:
        host = self.headers.get("Host", "").rpartition(":")[0]
        if host not in _OWN:
            self._send(HTTPStatus.FORBIDDEN, "text/plain", "this server answers on this machine only")
            return
        parts = urlsplit(self.path)
        answers: dict[str, tuple[str, Callable[[dict[str, str]], str]]] = {
            "/": (_HTML, lambda _: report_page(self._live)),
            "/explorer": (_HTML, lambda _: explorer_page(self._live)),
            "/state": (_JSON, lambda _: json.dumps(self._live.state())),
            "/loop": (_JSON, self._loop),
        }
        if parts.path not in answers:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", f"no page {parts.path}; there are {', '.join(answers)}")
            return
        kind, answer = answers[parts.path]
        asked = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        try:
            self._send(HTTPStatus.OK, kind, answer(asked))
        except GbidError as error:
            self._send(HTTPStatus.BAD_REQUEST, "text/plain", str(error))

    def _loop(self, asked: dict[str, str]) -> str:
        """Return the loop of a design as JSON; numbers in the query are operating point and gains."""
        designs = self._live.known_designs()
        name = asked.pop("design", next(iter(designs)))
        if name not in designs:
            raise UsageError(f"no design {name!r}; there are {', '.join(designs)}")
        axis, sampled = asked.pop("axis", "x"), asked.pop("sampled", "0") == "1"
        try:
            numbers = {key: float(value) for key, value in asked.items()}
            point = numbers.pop("pressure_bar"), numbers.pop("speed_rpm")
        except (ValueError, KeyError) as error:
            raise UsageError(f"loop: {error}; give pressure_bar, speed_rpm and gains as numbers") from None
        return json.dumps(explored_loop(designs[name], Explored(*point, numbers, axis, sampled)))

    def _send(self, status: HTTPStatus, kind: str, text: str) -> None:
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Print nothing: the terminal shows the address only."""
