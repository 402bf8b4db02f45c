"""Server of the results: pages, loops by the library, and only for this machine."""

import base64
import contextlib
import hashlib
import json
import re
import socket
import struct
import subprocess
import threading
import time
import urllib.error
import urllib.request
from http.client import HTTPConnection
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import find_chromium
from figure_cases import BlankPictures

import gbid
from gbid.control import controller_model, controller_structure, sampled_loop, sensitivities
from gbid.control.assessment import DesignFigures, assess
from gbid.control.loop.half_sine import HalfSine, impact_response
from gbid.control.loop.sampled import exact_plant
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.fit import FIT
from gbid.experiment.stages.rig import RIG
from gbid.report.read import AssessedDesign, Results, report_key
from gbid.report.sections import curves_script
from gbid.serve import open_server
from gbid.serve.server import THREADS, Explored, Live, explored_loop

PAPER = gbid.load_model("theisen2016")
CHROMIUM = find_chromium()

EXPERIMENT = """
format: 1
name: served
rig:
  model: theisen2016
  operating_points: [{pressure_bar: 6.0, speed_rpm: 0}]
  duration_s: 0.6
  prbs: {recordings: 1, amplitude_m: 4.5e-6, hold_s: 20e-3}
fits:
  piezos: {structure: piezo_pair}
"""


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    (folder / "e.yaml").write_text(EXPERIMENT, encoding="utf-8")
    server = open_server(folder / "e.yaml")
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server, folder
    server.shutdown()
    server.server_close()
    thread.join()


def path_of(server):
    """Path of the first page, with the token."""
    return urlsplit(server.address).path


def get(server, path):
    with urllib.request.urlopen(server.address + path, timeout=60) as answer:
        return answer.read().decode()


def refused(server, path):
    with pytest.raises(urllib.error.HTTPError) as caught:
        get(server, path)
    return caught.value.code, caught.value.read().decode()


def test_the_state_and_the_page_follow_what_is_made(served, monkeypatch):
    monkeypatch.setattr("gbid.report.write.Pictures", BlankPictures)
    monkeypatch.setattr("gbid.serve.server._REST", 0.0)
    server, folder = served
    before = json.loads(get(server, "state"))
    assert before["stages"]["rig"] == {"missing": 2}
    page = get(server, "")
    assert f"content_key: {before['key']} " in page
    assert 'id="follow-words"' in page
    run_stage(Job(load_experiment(folder / "e.yaml")), RIG)
    after = json.loads(get(server, "state"))
    assert after["stages"]["rig"] == {"kept": 2}
    assert after["key"] != before["key"]
    run_stage(Job(load_experiment(folder / "e.yaml")), FIT)
    assert json.loads(get(server, "state"))["stages"]["fit"] == {"kept": 1}
    name = "piezos/p6_n0_prbs1"
    drawn = []
    monkeypatch.setattr("gbid.report.control_sections.design_pictures", lambda *_: drawn.append(1) or [])
    assert f"content_key: {after['key']} " not in get(server, "")
    assert drawn == []  # what the pictures of controllers stand on is the same
    (folder / "results" / "served" / "recordings" / "p6_n0_prbs1.h5").rename(folder / "aside.h5")
    tables = []
    monkeypatch.setattr("gbid.report.sections.fit_tables", lambda *_: tables.append(1) or [[]])
    assert f"piezos, {name.partition('/')[2]}" in get(server, "")
    assert tables == []  # those of a fit that is there are the same
    (folder / "aside.h5").rename(folder / "results" / "served" / "recordings" / "p6_n0_prbs1.h5")
    results = Results(Job(load_experiment(folder / "e.yaml")))
    assert get(server, f"report_curves/{name}.js") == curves_script(results, name)
    assert refused(server, "report_curves/piezos/none.js") == (400, "no fit 'piezos/none'")


def test_a_reading_is_followed_by_a_rest_three_times_as_long(served, monkeypatch):
    _, folder = served
    run_stage(Job(load_experiment(folder / "e.yaml")), RIG)
    now = [100.0]
    monkeypatch.setattr("gbid.serve.server.time.monotonic", lambda: now[0])
    live, key = Live(folder / "e.yaml"), report_key

    def slow(results):
        now[0] += 2.0
        return key(results)

    monkeypatch.setattr("gbid.serve.server.report_key", slow)
    before = live.state()["stages"]
    (folder / "results" / "served" / "recordings" / "p6_n0_prbs1.h5").unlink()
    now[0] = 107.9  # read until 102 s
    assert live.state()["stages"] == before
    now[0] = 108.0
    assert live.state()["stages"]["rig"] == {"kept": 1, "missing": 1}


def test_a_poll_looks_at_folders_and_once_a_minute_into_each_file(served, monkeypatch):
    _, folder = served
    run_stage(Job(load_experiment(folder / "e.yaml")), RIG)
    now = [100.0]
    monkeypatch.setattr("gbid.serve.server.time.monotonic", lambda: now[0])
    live = Live(folder / "e.yaml")
    assert live.state()["stages"]["rig"] == {"kept": 2}
    file = folder / "results" / "served" / "recordings" / "p6_n0_prbs1.h5"
    content = file.read_bytes()
    file.write_bytes(content[:-1])  # in place, as gbid never writes
    assert live.state()["stages"]["rig"] == {"kept": 2}
    now[0] += 61
    assert live.state()["stages"]["rig"] == {"kept": 1, "failed": 1}
    with atomic_path(file, overwrite=True) as part:
        part.write_bytes(content)
    assert live.state()["stages"]["rig"] == {"kept": 2}


def test_only_this_machine_and_only_these_pages(served):
    server, _ = served
    assert server.server_address[0] == "127.0.0.1"
    connection = HTTPConnection("127.0.0.1", server.server_address[1])
    connection.request(
        "GET", f"{path_of(server)}state", headers={"Host": f"elsewhere.example:{server.server_address[1]}"}
    )
    assert connection.getresponse().status == 403
    connection.close()
    assert refused(server, "../e.yaml")[0] == 404
    assert "published" in get(server, "explorer")  # without a controller of its own it has that of the machine
    assert refused(server, "loop?pressure_bar=6")[1].startswith("loop: 'speed_rpm'; give pressure_bar, speed_rpm")
    assert refused(server, "loop?design=none") == (400, "no design 'none'; choose from published")
    with pytest.raises(UsageError, match=f"port {server.server_address[1]}: .*; choose another with --port"):
        open_server(served[1] / "e.yaml", port=server.server_address[1])


def test_a_poll_reads_results_only_when_a_file_has_changed(served, monkeypatch):
    server, folder = served
    monkeypatch.setattr("gbid.serve.server._REST", 0.0)
    before = json.loads(get(server, "state"))
    reads = []
    monkeypatch.setattr("gbid.serve.server.report_key", lambda results: reads.append(1) or report_key(results))
    assert json.loads(get(server, "state")) == before
    assert not reads
    many = folder / "results" / "served" / "many"
    many.mkdir(parents=True)
    for number in range(1000):
        (many / f"{number}.txt").touch()
    get(server, "state")
    assert len(reads) == 1
    live, took = Live(folder / "e.yaml"), []
    live.state()
    for _ in range(5):
        began = time.thread_time()
        live.state()
        took.append(time.thread_time() - began)
    assert len(reads) == 2
    assert min(took) < 0.02


def test_half_open_requests_hold_few_threads_for_a_short_time(served, monkeypatch, capfd):
    server, _ = served
    monkeypatch.setattr(server.RequestHandlerClass.func, "timeout", 0.5)
    before = threading.active_count()
    half_open = [socket.create_connection(server.server_address) for _ in range(60)]
    for connection in half_open:
        with contextlib.suppress(OSError):
            connection.sendall(b"GET / HTTP/1.1\r\n")
    assert threading.active_count() - before <= THREADS
    time.sleep(0.8)
    assert json.loads(get(server, "state"))["key"]
    for connection in half_open:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, as of a crash
        connection.close()
    for _ in range(3):  # clients that leave before their answer
        with socket.create_connection(server.server_address) as leaving:
            leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            leaving.sendall(b"GET /explorer HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
    time.sleep(0.3)
    assert "Traceback" not in capfd.readouterr().err
    with urllib.request.urlopen(server.address + "state", timeout=60) as answer:
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]


def test_a_dripping_request_ends_and_a_full_server_says_so(served, monkeypatch):
    server, _ = served
    monkeypatch.setattr(server.RequestHandlerClass.func, "timeout", 1.5)
    dripping = [socket.create_connection(server.server_address) for _ in range(THREADS)]
    time.sleep(0.3)
    with socket.create_connection(server.server_address) as further:
        assert further.recv(100).startswith(b"HTTP/1.0 503 ")
    ends = time.monotonic() + 10
    while dripping and time.monotonic() < ends:  # each sends a byte more often than the time-out
        for connection in list(dripping):
            try:
                connection.sendall(b"G")
            except OSError:
                dripping.remove(connection)
                connection.close()
        time.sleep(0.2)
    assert not dripping
    assert json.loads(get(server, "state"))["key"]


def test_other_sites_read_nothing_and_pages_run_scripts_of_gbid_only(served):
    server, _ = served
    for path, site, status in (
        ("state", "cross-site", 403), ("state", "same-site", 403), ("state", "same-origin", 200),
        ("report_curves/piezos/p6_n0_prbs1.js", "cross-site", 403), ("", "cross-site", 200), ("", "none", 200),
    ):  # fmt: skip
        connection = HTTPConnection("127.0.0.1", server.server_address[1])
        connection.request("HEAD", path_of(server) + path, headers={"Sec-Fetch-Site": site})
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (status, b"")
        connection.close()
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert int(answer.headers["Content-Length"]) == len(get(server, "").encode())
    policy = answer.headers["Content-Security-Policy"]
    assert "'unsafe-inline'" not in re.search(r"script-src[^;]*", policy)[0]
    for page in ("", "explorer"):
        for text in re.findall(r"<script>(.*?)</script>", get(server, page), re.DOTALL):
            assert f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" in policy


def test_a_defect_of_an_answer_is_printed_and_a_client_that_left_is_not(served, capfd):
    server, _ = served
    for error, printed in ((ValueError("a defect"), True), (ConnectionResetError(), False), (TimeoutError(), False)):
        try:
            raise error
        except type(error):
            server.handle_error(None, ("127.0.0.1", 1))
        assert ("Traceback" in capfd.readouterr().err) == printed


def design_of(kind, gains):
    structure = controller_structure(kind)
    figures = DesignFigures.of(assess(PAPER, structure, gains, [(6.0, 0.0)]))
    return AssessedDesign(kind, kind, figures, structure, PAPER, HalfSine(mass_kg=2.18), 2e-4, "tustin", 2.0)


GAINS = {"kappa_x": 0.9, "kappa_y": 0.7, "kd_x": 0.2, "kd_y": -0.1}


@pytest.mark.parametrize("sampled", [False, True])
def test_explored_loops_are_those_of_the_library(sampled):
    design = design_of("PD", dict.fromkeys(GAINS, 0.0))
    result = explored_loop(design, Explored(5.0, 3000.0, GAINS, "y", sampled))
    controller = controller_model(design.structure, GAINS)
    plant = PAPER.plant_at(5.0, 3000.0)
    if sampled:
        loop = sampled_loop(exact_plant(PAPER, 5.0, 3000.0), controller, 2e-4)
        damping, peak, curves = loop.damping, loop.peak_output, loop.sensitivities
    else:
        curves = sensitivities(plant, controller)
        modes = curves.model("plant").modes()
        damping, peak = min(z for _, z in modes), curves.peak("output")
        np.testing.assert_allclose([(f, z) for f, z, _ in result["modes"]], modes)
    assert result["damping"] == pytest.approx(damping)
    assert result["peak"]["value"] == pytest.approx(peak.value)
    assert result["modes"][0][2] == pytest.approx(2 * np.pi * result["modes"][0][0] * result["modes"][0][1])
    k = 140
    S = curves.response("output", [result["frequency_hz"][k]])[0]
    assert result["largest"][k] == pytest.approx(np.linalg.norm(S, 2))
    assert result["yy"][k] == pytest.approx(abs(S[1, 1]))
    response = impact_response(plant, controller, HalfSine(mass_kg=2.18).towards(90.0), duration_s=0.2)
    np.testing.assert_allclose(result["closed_m"], response.p[::10, 1])
    json.dumps(result, allow_nan=False)


def test_explored_loop_that_is_unstable_and_wrong_questions():
    design = design_of("P", {"kappa_x": 0.5, "kappa_y": 0.5})
    loop = explored_loop(design, Explored(6.0, 0.0, {"kappa_x": 2.9}))
    assert not loop["stable"]
    assert loop["peak"]["value"] is None
    json.dumps(loop, allow_nan=False)
    for question, text in (
        (Explored(6.0, 0.0, {"kappa": 1.0}), "no gain 'kappa'"),
        (Explored(6.0, 0.0, {}, "z"), "axis = 'z'"),
        (Explored(6.0, 0.0, {"kappa_x": np.inf}), "finite"),
        (Explored(9.0, 0.0, {}), "outside its domain"),
    ):
        with pytest.raises(UsageError, match=text):
            explored_loop(design, question)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium for the tests in the browser")
def test_the_explorer_in_a_browser(served, monkeypatch):
    server, _ = served
    designs = {"PD": design_of("PD", GAINS), "biquad": design_of("biquad", biquad_gains())}
    for name in ("designs", "known_designs"):
        monkeypatch.setattr(f"gbid.serve.server.Live.{name}", lambda self: designs)
    arguments = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=8000", "--dump-dom")
    made = subprocess.run(
        [CHROMIUM, *arguments, f"{server.address}explorer"], capture_output=True, text=True, timeout=120
    )
    text = made.stdout
    assert re.search(r'<ul id="page-errors"[^>]*hidden=""></ul>', text), re.search(r'<ul id="page-errors".*', text)[0]
    shown = json.loads(re.search(r'data-shown="([^"]*)"', text)[1].replace("&quot;", '"'))
    expected = explored_loop(designs["PD"], Explored(6.0, 0.0, {}))
    assert shown == {"damping": expected["damping"], "peak": expected["peak"]["value"]}
    assert text.count("<svg") >= 3
    assert 'id="c-kd_x"' in text
    assert "biquad (biquad)" in text
    loop = json.loads(get(server, "loop?design=biquad&pressure_bar=6&speed_rpm=0&sampled=1"))
    assert loop["stable"]


def biquad_gains():
    return {parameter.name: parameter.start for parameter in controller_structure("biquad").parameters}
