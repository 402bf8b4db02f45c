"""Local web server: its rules, and the pages of results with campaign state and gain explorer."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import threading
import time
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from hashlib import sha256
from hmac import compare_digest
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from inspect import signature
from io import BufferedReader, RawIOBase
from math import inf, isfinite
from pathlib import Path
from secrets import token_urlsafe
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np
from markupsafe import Markup

from gbid.control.controllers.structures import controller_at
from gbid.control.loop.close import smallest_damping
from gbid.control.loop.half_sine import impact_response
from gbid.control.loop.norm import largest_singular_values
from gbid.control.loop.sampled import exact_plant, sampled_loop
from gbid.control.loop.sensitivity import sensitivities, static_amplification
from gbid.core.arrays import ComplexArray, is_real, oscillatory_modes
from gbid.core.errors import GbidError, UsageError
from gbid.core.index import load_index, version_of
from gbid.core.tables import finite_or_none
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job
from gbid.lpv.model import SCHEDULING
from gbid.report.page import environment, page_part, script, script_of_page
from gbid.report.read import AssessedDesign, Results, report_key
from gbid.report.sections import Cache, curves_script
from gbid.report.write import report_text
from gbid.structure import LinearModel

# ---- Closed loop of one design for any gains at one operating point: the numbers that the gain explorer draws.

_SHOWN_S = 0.2  # length of the impact response
_EVERY = 10  # the response has a sample each 0.02 ms; the page draws every tenth
_FREQUENCIES = 300
_RANGE = (5.0, 1000.0)  # Hz


@dataclass(frozen=True)
class Explored:
    """Settings of the gain explorer: operating point, gains, direction of the impact, and sampling.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point [bar], [rpm].
    gains : dict of str to float
        A value for every parameter of the controller.
    axis : {"x", "y"}
        Direction of the impact.
    sampled : bool
        Whether poles and sensitivity are those of the sampled loop with exact delays and computation time.
    """

    pressure_bar: float
    speed_rpm: float
    gains: Mapping[str, float]
    axis: str = "x"
    sampled: bool = False


def explored_loop(design: AssessedDesign, settings: Explored) -> dict[str, Any]:
    """Return the closed loop of a design with changed gains, as numbers for JSON.

    Parameters
    ----------
    design : AssessedDesign
        Design with plant, structure, sample time and impact.
    settings : Explored
        Operating point and gains.

    Returns
    -------
    dict
        stable, damping, peak {value, frequency_hz}, static_amplification, modes [[frequency_hz, damping, decay_per_s]],
        open_modes, real [1/s], frequency_hz, largest, xx, yy (magnitudes of S_o), time_s, closed_m, open_m (motion
        along the axis of the impact; null where it is not finite), stack_travel_m. The impact acts on the
        continuous loop. Without a moving mass the last four are empty.

    Raises
    ------
    UsageError
        When the axis or a gain is unknown, a gain is not finite, or the point lies outside the domain.
    """
    unknown = set(settings.gains) - {parameter.name for parameter in design.structure.parameters}
    if unknown or settings.axis not in ("x", "y"):
        raise UsageError(f"explorer: no gain {min(unknown)!r}" if unknown else f"explorer: axis = {settings.axis!r}")
    gains = {**design.figures.gains, **settings.gains}
    if not all(isfinite(value) for value in gains.values()):
        raise UsageError("explorer: give finite gains")
    point = settings.pressure_bar, settings.speed_rpm
    plant, controller = design.plant.plant_at(*point), controller_at(design.structure, gains, *point)
    continuous = sensitivities(plant, controller)
    if settings.sampled:
        sampled = sampled_loop(exact_plant(design.plant, *point), controller, design.sample_time, method=design.method)
        loop, closed, damping = sampled.sensitivities, sampled.closed, sampled.damping
    else:
        loop, closed = continuous, continuous.model("plant")
        damping = smallest_damping(closed)
    top = min(_RANGE[1], 0.5 / design.sample_time) if settings.sampled else _RANGE[1]
    frequency = np.geomspace(_RANGE[0], top, _FREQUENCIES)
    S = loop.response("output", frequency)
    stable = closed.is_stable()
    peak = loop.peak("output")
    place = "xy".index(settings.axis)
    impact = design.impact.towards(90.0 * place)
    known = impact.mass_kg is not None
    response, alone = (
        impact_response(plant, law, impact, duration_s=_SHOWN_S) if known else None for law in (controller, None)
    )
    rates = _rates(closed)
    return {
        "stable": stable,
        "damping": damping,
        "peak": {"value": finite_or_none(peak.value), "frequency_hz": finite_or_none(peak.frequency_hz)},
        "static_amplification": finite_or_none(static_amplification(loop) if stable else inf),
        "modes": _modes(rates),
        "open_modes": _modes(_rates(plant)),
        "real": sorted(rates[is_real(rates)].real.tolist()),
        "frequency_hz": frequency.tolist(),
        "largest": largest_singular_values(S).tolist(),
        "xx": np.abs(S[:, 0, 0]).tolist(),
        "yy": np.abs(S[:, 1, 1]).tolist(),
        "time_s": [] if alone is None else alone.time_s[::_EVERY].tolist(),
        "closed_m": [] if response is None else _drawn(response.p, place),
        "open_m": [] if alone is None else _drawn(alone.p, place),
        "stack_travel_m": None if response is None else finite_or_none(response.stack_travel_m),
    }


def _rates(model: LinearModel) -> ComplexArray:
    """Return the poles in continuous time [rad/s]; for a sampled model without poles faster than a sample."""
    rates = model.poles()
    return rates if model.dt is None else rates[-rates.real * model.dt < 1]


def _modes(rates: ComplexArray) -> list[list[float]]:
    """Return frequency [Hz], damping factor and decay rate [1/s] of the oscillatory modes, sorted by frequency."""
    return [[hz, damping, 2 * np.pi * hz * damping] for hz, damping in oscillatory_modes(rates).tolist()]


def _drawn(positions: Any, place: int) -> list[float | None]:
    return [finite_or_none(float(value)) for value in np.asarray(positions)[::_EVERY, place]]


# ---- Present results of an experiment, read again when they change.


_ELSEWHERE_S = 60.0
"""Longest time until a change is told where a poll does not look: in other folders, and in place in a result [s]."""
_REST = 3.0
"""Rest after a reading or drawing, relative to its time: a long campaign costs the server a fourth of one core."""

_Seen = dict[str, tuple[int | str, ...]]


class Live:
    """Pages of one experiment with cached results, for several server threads.

    Parameters
    ----------
    experiment : path
        The experiment YAML; it is read again with each page.
    results : path, optional
        Folder of the results, instead of the one in the YAML.
    announce : callable, optional
        See `gbid.experiment.load.load_experiment`.

    Raises
    ------
    UsageError
        When the YAML has problems.
    """

    def __init__(
        self, experiment: Path, results: Path | None = None, announce: Callable[[str], None] | None = None
    ) -> None:
        self._where, self._announce = (experiment, results), announce
        self._lock = threading.Lock()  # matplotlib draws in one thread at a time
        self._experiment = load_experiment(*self._where, announce=self._announce)
        self._results: Results | None = None
        self._key, self._page, self._stages = "", "", dict[str, Counter[str]]()
        self._look: tuple[_Seen, _Seen] = {}, {}
        self._read_s = self._free_s = 0.0  # time of the last reading, and from which on there is the next
        self._designs: dict[str, AssessedDesign] = {}
        self._cache: Cache = {}
        self.name = self._experiment.spec.name
        load_index(self._experiment.results)

    def _present(self) -> Results:
        """Return the results; read again if files have changed and the last reading is old enough."""
        begin = time.monotonic()
        if self._results is not None and begin < self._free_s:
            return self._results
        look = self._seen()  # before the reading: what is made meanwhile is seen next time
        changed_since = begin > self._read_s + _ELSEWHERE_S
        if self._results is None or changed_since or look != self._look:
            if changed_since or look[0] != self._look[0]:  # else the keys of its recordings are kept
                self._experiment = load_experiment(*self._where, announce=self._announce)
            self._results, self._look, self._read_s = Results(Job(self._experiment)), look, begin
            self._stages = {}
            for standing in self._results.standings:
                self._stages.setdefault(standing.item.stage, Counter())[standing.state] += 1
            if (key := report_key(self._results)) != self._key:
                self._key, self._page, self._designs = key, "", {}
            self._rest_since(begin)
        return self._results

    def _rest_since(self, begin: float) -> None:
        end = time.monotonic()
        self._free_s = end + _REST * (end - begin)

    def _seen(self) -> tuple[_Seen, _Seen]:
        """Return the versions of the source files of the keys, and of the results folders with their file names.

        A result is written beside its place and renamed, which changes its folder: there are thousands of results.
        """
        results = str(self._experiment.results)
        beside = [
            next(os.walk(folder), ("", [], []))
            for folder in (self._where[0].absolute().parent, f"{results}/controller")
        ]
        settings: dict[str, list[str]] = {f"{folder}/{name}": [] for folder, _, names in beside for name in names}
        return _versions(settings), _versions({folder: names for folder, _, names in os.walk(results)})

    def state(self) -> dict[str, Any]:
        """Return the progress of the campaign: key of the present results, and counts by stage and state."""
        with self._lock:
            self._present()
            return {"key": self._key, "stages": self._stages}

    def page(self) -> str:
        """Return the report of the present results, drawn again only after changes."""
        with self._lock:
            results, begin = self._present(), time.monotonic()
            if not self._page:
                self._page = report_text(results, self._key, CURVES, self._cache)
                self._rest_since(begin)
            return self._page

    def curves(self, name: str) -> str:
        """Return the curves of a fit as a script, for fits whose curves are not in the page.

        Raises
        ------
        UsageError
            When there is no such fit.
        """
        with self._lock:
            results = self._present()
            if name not in (q.name for q in results.fits):
                raise UsageError(f"no fit {name!r}")
            return curves_script(results, name)

    def designs(self) -> dict[str, AssessedDesign]:
        """Return the tuned designs and the published controllers by name.

        Raises
        ------
        UsageError
            When there is no design.
        """
        with self._lock:
            results = self._present()
            self._designs = self._designs or {
                design.name: design for design in results.assessed if design.plant.scheduling == SCHEDULING
            }
            if not self._designs:
                raise UsageError("no controller yet; run `gbid tune` or `gbid run`")
            return self._designs

    def known_designs(self) -> dict[str, AssessedDesign]:
        """Return the designs cached for the gain explorer, which requests them often."""
        return self._designs or self.designs()


def _versions(paths: Mapping[str, list[str]]) -> _Seen:
    """Return the versions of existing files and folders, each with the given names."""
    seen: _Seen = {}
    for path, names in paths.items():
        with contextlib.suppress(OSError):  # gone meanwhile
            seen[path] = (*version_of(path), *names)
    return seen


# ---- Pages of the server: the report with a line that follows the campaign, and the gain explorer.

_STEPS = 400  # of a slider
_FOLLOW = "</body>"


def report_page(live: Live) -> str:
    """Return the report with a status line of the campaign."""
    added = environment(own_part).get_template("follow.html.j2").render(script=_follow())
    return live.page().replace(_FOLLOW, f"{added}\n{_FOLLOW}")


def explorer_page(live: Live) -> str:
    """Return the gain explorer for all designs of the experiment.

    Raises
    ------
    UsageError
        When there is no design.
    """
    designs = [_described(design) for design in live.designs().values()]
    template = environment(own_part).get_template("explorer_page.html.j2")
    return template.render(
        name=live.name,
        designs=designs,
        style=Markup(page_part("style.css")),
        script=_explore(),
    )


def result_pages(live: Callable[[], Live]) -> dict[str, Answer]:
    """Return the answers of results by name: report, explorer, state of the campaign, loops and curves of fits."""
    return {
        "report": (HTML, lambda _: report_page(live())),
        "explorer": (HTML, lambda _: explorer_page(live())),
        "state": (JSON, lambda _: json.dumps(live().state())),
        "loop": (JSON, lambda query: _loop(live(), query)),
        CURVES: (_SCRIPT, lambda query: live().curves(query[BELOW].removesuffix(".js"))),
    }


def _loop(live: Live, query: dict[str, str]) -> str:
    """Return the closed loop of a design as JSON for the operating point and gains in a query."""
    designs = live.known_designs()
    del query[BELOW]
    name = query.pop("design", next(iter(designs)))
    if name not in designs:
        raise UsageError(f"no design {name!r}; choose from {', '.join(designs)}")
    axis, sampled = query.pop("axis", "x"), query.pop("sampled", "0") == "1"
    try:
        numbers = {key: float(value) for key, value in query.items()}
        point = numbers.pop("pressure_bar"), numbers.pop("speed_rpm")
    except (ValueError, KeyError) as error:
        raise UsageError(f"loop: {error}; give pressure_bar, speed_rpm and gains as numbers") from None
    return json.dumps(explored_loop(designs[name], Explored(*point, numbers, axis, sampled)))


def _follow() -> Markup:
    return script(own_part("follow.js"))


def _explore() -> Markup:
    return script(page_part("charts.js"), own_part("explorer_page.js"))


def bench_script() -> Markup:
    """Return the script of the page of `gbid open`."""
    return script(page_part("charts.js"), own_part("bench.js"))


def own_part(name: str) -> str:
    """Return the text of a template, script or style sheet of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _described(design: AssessedDesign) -> dict[str, Any]:
    """Return the data of a design for the explorer page: ranges and values of operating point and gains."""
    domain, (pressure, speed) = design.plant.domain, design.figures.points[0].tolist()
    controls = [
        _control("pressure_bar", "Injection pressure", "bar", *domain.pressure_bar, pressure),
        _control("speed_rpm", "Speed", "rpm", *domain.speed_rpm, speed),
    ]
    for parameter in design.structure.parameters:
        value = design.figures.gains[parameter.name]
        room = 3 * max(abs(value), 1e-3)
        low = parameter.lower if isfinite(parameter.lower) else value - room
        high = parameter.upper if isfinite(parameter.upper) else value + room
        controls.append(_control(parameter.name, parameter.name, parameter.unit or "-", low, high, value))
    return {
        "name": design.name,
        "structure": design.structure.name,
        "cap": design.cap,
        "sample_time_ms": 1e3 * design.sample_time,
        "impact": None
        if design.impact.mass_kg is None
        else f"{design.impact.peak_n:g} N, {1e3 * design.impact.duration_s:g} ms",
        "controls": controls,
    }


def _control(name: str, label: str, unit: str, low: float, high: float, value: float) -> dict[str, Any]:
    step = (high - low) / _STEPS or 1.0
    return {"name": name, "label": label, "unit": unit, "low": low, "high": high, "step": step, "value": value}


# ---- Server and its rules: this machine only, a token in the address, limits of time and threads.

CURVES = "report_curves"
"""Path below which the page asks for curves of fits."""
BELOW = ""
"""Key of the query with the path below the name of an answer."""
HTML, JSON, _SCRIPT = "text/html; charset=utf-8", "application/json", "text/javascript; charset=utf-8"
Answer = tuple[str, Callable[[dict[str, str]], str]]
"""Type of the content, and function from the query to the text."""
Action = Callable[..., Any]
"""Function from the keys of the JSON document that a page sends to the document that it gets."""
HOST = "127.0.0.1"
_OWN = ("127.0.0.1", "localhost")  # a request to another name comes from a page of another site
THREADS = 16
"""Requests that are answered at a time: a browser opens at most six connections to a server."""
PATIENCE_S = 10.0
"""Time for a client to send its whole request, and to take the whole answer [s]; it is on this machine."""
_LONGEST = 8 << 20  # bytes of a document that a page sends
# All of a page is in the page itself; it asks this server for data only. Scripts in a page are those of gbid, by their
# digests.
_POLICY = (
    "default-src 'none'; script-src 'self' {digests}; style-src 'unsafe-inline'; img-src 'self' data:; "
    "font-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


@cache
def _policy() -> str:
    texts = (script_of_page(), _follow(), _explore(), bench_script())
    digests = (b64encode(sha256(text.encode()).digest()).decode() for text in texts)
    return _POLICY.format(digests=" ".join(f"'sha256-{digest}'" for digest in digests))


class Server(ThreadingHTTPServer):
    """HTTP server for the pages of one folder or experiment, for those who know its token.

    Attributes
    ----------
    address : str
        Address of the first page, with the token.
    """

    daemon_threads = True
    request_queue_size = 128  # with Python's 5 the system lets a burst of connections wait for seconds

    def __init__(self, port: int, pages: Mapping[str, Answer], actions: Mapping[str, Action] | None = None) -> None:
        self._free = threading.BoundedSemaphore(THREADS)
        self._token = token_urlsafe(16)
        try:
            super().__init__((HOST, port), partial(_Handler, self._token, pages, actions or {}))
        except (OSError, OverflowError) as error:
            raise UsageError(f"port {port}: {error}; choose another with --port") from None

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a request in a new thread; beyond `THREADS` connections the client is told to retry."""
        if not self._free.acquire(blocking=False):
            with contextlib.suppress(OSError):
                request.setblocking(False)
                request.send(b"HTTP/1.0 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\n\r\n")
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system starts no more threads
            self._free.release()
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one request."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print an internal error; ignore clients that disconnect or send nothing."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """Web address of the first page."""
        return f"http://{HOST}:{self.server_address[1]}/{self._token}/"


def open_server(
    experiment: Path, results: Path | None = None, port: int = 0, announce: Callable[[str], None] | None = None
) -> Server:
    """Return a server of the results that listens on this machine only.

    Parameters
    ----------
    experiment : path
        The experiment YAML.
    results : path, optional
        Folder of the results, instead of the one in the YAML.
    port : int
        Port; 0 for any free one.
    announce : callable, optional
        See `gbid.experiment.load.load_experiment`.

    Returns
    -------
    Server
        Call ``serve_forever()``, then ``server_close()``.

    Raises
    ------
    UsageError
        When the YAML has problems, or when the port is not free.
    """
    live = Live(experiment, results, announce)
    pages = result_pages(lambda: live)
    return Server(port, {"": pages["report"], **pages})


class _UntilDeadline(RawIOBase):
    """Raw input of a connection with a deadline for all its bytes."""

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self._connection, self._deadline = connection, time.monotonic() + seconds

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Read available bytes; raise `TimeoutError` after the deadline."""
        self._connection.settimeout(max(1e-3, self._deadline - time.monotonic()))
        return self._connection.recv_into(buffer)


class _Handler(BaseHTTPRequestHandler):
    """Answers of pages and data to GET, of actions to POST, below the token. File names are not served."""

    server_version = "gbid"
    sys_version = ""
    timeout = PATIENCE_S

    def __init__(self, token: str, pages: Mapping[str, Answer], actions: Mapping[str, Action], *given: object) -> None:
        self._token, self._pages, self._actions = token, pages, actions
        super().__init__(*given)  # type: ignore[arg-type]  # request, address and server, from socketserver

    def setup(self) -> None:
        """Prepare to read the request within one deadline, which slow clients cannot extend."""
        super().setup()
        self.rfile = BufferedReader(_UntilDeadline(self.connection, self.timeout))

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        if (place := self._allowed(self._pages)) is not None:
            name, below, query = place
            kind, answer = self._pages[name]
            if kind == HTML or self._is_own():
                self._answer(kind, lambda: answer({**query, BELOW: below}))

    def do_POST(self) -> None:
        if (place := self._allowed(self._actions)) is None or not self._is_own():
            return
        length = self.headers.get("Content-Length", "")
        if self.headers.get("Content-Type") != JSON or not length.isdecimal() or int(length) > _LONGEST:
            self._send(HTTPStatus.BAD_REQUEST, _TEXT, f"expected JSON of at most {_LONGEST >> 20} MB")
            return
        try:
            document = json.loads(self.rfile.read(int(length)))
            asked = signature(self._actions[place[0]]).bind(**document)
        except (ValueError, TypeError, RecursionError) as error:
            self._send(HTTPStatus.BAD_REQUEST, _TEXT, f"not the JSON that {place[0]} takes: {error}")
            return
        self._answer(JSON, lambda: json.dumps(self._actions[place[0]](*asked.args, **asked.kwargs), default=str))

    def _allowed(self, answers: Mapping[str, object]) -> tuple[str, str, dict[str, str]] | None:
        """Return name, path below it and query of a request; None after a refusal."""
        self.connection.settimeout(self.timeout)
        parts = urlsplit(self.path)
        token, _, path = parts.path[1:].partition("/")
        name, _, below = path.partition("/")
        if self.headers.get("Host", "").rpartition(":")[0] not in _OWN:
            self._send(HTTPStatus.FORBIDDEN, _TEXT, "this server answers on this machine only")
        elif not compare_digest(token.encode(), self._token.encode()):
            self._send(HTTPStatus.FORBIDDEN, _TEXT, "open the whole address that gbid has printed, with its token")
        elif name not in answers or (below and name != CURVES):
            known = ", ".join(filter(None, answers))
            self._send(HTTPStatus.NOT_FOUND, _TEXT, f"no page {path}; choose from {known}")
        else:
            return name, unquote(below), {key: values[-1] for key, values in parse_qs(parts.query).items()}
        return None

    def _is_own(self) -> bool:
        """Return whether a page of this server asks, as far as the browser tells; refuse others."""
        own = self.headers.get("Sec-Fetch-Site", "none") in ("same-origin", "none")
        if not own:
            self._send(HTTPStatus.FORBIDDEN, _TEXT, "data of this server are for its own pages")
        return own

    def _answer(self, kind: str, answer: Callable[[], str]) -> None:
        try:
            status, text = HTTPStatus.OK, answer()
        except GbidError as error:
            status, kind, text = HTTPStatus.BAD_REQUEST, _TEXT, str(error)
        except Exception as error:
            self._send(HTTPStatus.INTERNAL_SERVER_ERROR, _TEXT, f"a defect of gbid: {error!r}; its terminal tells more")
            raise
        self._send(status, kind, text)

    def _send(self, status: HTTPStatus, kind: str, text: str) -> None:
        body = text.encode()
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"}
        self.send_response(status)
        headers |= {"X-Content-Type-Options": "nosniff", "Cross-Origin-Resource-Policy": "same-origin"}
        headers |= {"Referrer-Policy": "no-referrer", "Content-Security-Policy": _policy()}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Print nothing; the terminal shows only the address."""


_TEXT = "text/plain; charset=utf-8"
