"""`gbid open FOLDER`: plots, choices as YAML, saving and running, by the answers of the server and in a browser."""

import json
import re
import subprocess
import threading
import time
import urllib.error
import urllib.request
from http.client import HTTPConnection
from urllib.parse import urljoin, urlsplit

import numpy as np
import pytest
from browser import find_chromium
from devtools import Browser
from ruamel.yaml import YAML

from gbid import load
from gbid.experiment.load import load_experiment
from gbid.lpv import load_model
from gbid.recording.importing import import_recording, list_channels
from gbid.serve import open_bench
from gbid.serve.plots import plots_of

N, DT = 3000, 4e-4
NAMES = "t [s];r_x [um];r_y [um];u_x [um];u_y [um];p_x [um];p_y [um];phi [deg]"


def write(path, moving, names=NAMES, still_s=0.0, spike=0.0):
    """Write a file with a PRBS or at rest, after a time without turning, with one spike of p_x."""
    random = np.random.default_rng(list(path.name.encode()))
    t = DT * np.arange(N)
    r = np.repeat(random.choice([-4.0, 4.0], (N // 10, 2)), 10, axis=0) * moving
    phi = np.mod(np.cumsum(6 * 4000 * DT * np.clip((t - still_s) / DT, 0, 1)), 360)
    p = np.column_stack([2 * np.cos(np.deg2rad(phi)), np.sin(np.deg2rad(phi))]) + 0.5 * np.roll(r, 3, axis=0)
    p += 0.02 * random.standard_normal((N, 2))
    p[1234, 0] += spike
    columns = np.column_stack([t, r, 0.9 * r + 0.01 * random.standard_normal((N, 2)), p, phi])
    np.savetxt(path, columns, "%.7g", ";", header=names, comments="", encoding="utf-8")


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "runs"
    place.mkdir()
    for pressure in (5, 6):
        for word, moving in (("still", False), ("prbs", True)):
            write(place / f"P{pressure}_N4000_{word}1.csv", moving)
    (place / "notes.md").write_text("one speed")
    return place


@pytest.fixture
def served(folder, tmp_path):
    server, bench = open_bench(folder, tmp_path / "own", 0, lambda _: None)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server, bench
    server.shutdown()
    server.server_close()
    bench.close()
    thread.join()


def loaded(text):
    return YAML(typ="safe").load(text)


def until(is_so, seconds=60):
    ends = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < ends
        time.sleep(0.02)


def post(server, name, **document):
    request = urllib.request.Request(
        server.address + name, json.dumps(document).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=120) as answer:
        return json.load(answer)


def refused(server, name, **document):
    with pytest.raises(urllib.error.HTTPError) as caught:
        post(server, name, **document)
    return caught.value.read().decode()


EXCITED = "P5_N4000_prbs1.csv"


def test_plots_keep_spikes_and_follow_the_mapping(served, folder):
    server, _ = served
    write(folder / EXCITED, True, spike=3.0)
    shown = post(server, "plots", file=EXCITED)
    lines = {line["name"]: line for line in shown["lines"]}
    raw = np.loadtxt(folder / EXCITED, delimiter=";", skiprows=1)
    assert max(lines["p_x"]["high"]) == pytest.approx(raw[:, 5].max(), rel=1e-5)
    assert min(lines["u_y"]["low"]) == pytest.approx(raw[:, 4].min(), rel=1e-5)
    assert len(lines["p_x"]["low"]) <= 500
    assert {c["name"]: c["role"] for c in shown["channels"]}["r_y"] == "r y"
    text = post(server, "draft", answers=[])["text"]
    shown = post(server, "plots", file=EXCITED, text=text)
    (p_x,) = (line for line in shown["lines"] if line["name"] == "p.x")
    rec = import_recording(folder / EXCITED, {"time": "t", "signals": {"p": {"columns": ["p_x", "p_y"]}}})
    assert p_x["unit"] == "m"
    assert max(p_x["high"]) == pytest.approx(rec.signal("p")[:, 0].max(), rel=1e-5)
    assert shown["speed_rpm"][5] == pytest.approx(4000, rel=0.01)
    spectrum = np.array(next(s["y"] for s in shown["spectra"] if s["name"] == "p.y"), float)
    peak = (np.argmax(spectrum) + 0.5) / len(spectrum) * 0.5 / DT
    assert peak == pytest.approx(4000 / 60, abs=1.5 / (N * DT) + 0.5 / DT / len(spectrum))
    wrong = post(server, "change", text=text, file=EXCITED, key=["signals", "p", "unit"], value="V")["text"]
    assert "'V'" in post(server, "plots", file=EXCITED, text=wrong)["fault"]


def test_what_is_wrong_in_a_file_is_said_in_the_words_of_check(served, folder):
    server, _ = served
    rows = np.loadtxt(folder / EXCITED, delimiter=";", skiprows=1)
    rows[:, 6] = 1.0
    np.savetxt(folder / EXCITED, rows, "%.7g", ";", header=NAMES, comments="")
    assert "is constant: all 3000 samples" in post(server, "plots", file=EXCITED)["problems"][0]
    write(folder / "P6_N4000_prbs1.csv", True, still_s=0.3)
    text = post(server, "draft", answers=[], skip_broken=True)["text"]
    assert "from_s" in text
    whole = post(server, "change", text=text, file="P6_N4000_prbs1.csv", key=["from_s"], value=None)["text"]
    assert "the speed changes" in " ".join(post(server, "plots", file="P6_N4000_prbs1.csv", text=whole)["problems"])
    (folder / EXCITED).unlink()
    assert "cannot be read: No such file" in refused(server, "plots", file=EXCITED)
    assert "cannot be read" in refused(server, "plots", file="../runs/../secret.csv")  # only names of this folder


def test_a_file_with_a_faulty_clock_is_shown_over_its_samples(folder):
    channels = list_channels(folder / EXCITED)  # of a long text its first rows decide
    rows = np.loadtxt(folder / EXCITED, delimiter=";", skiprows=1)
    rows[2000:, 0] = rows[2000, 0]
    np.savetxt(folder / EXCITED, rows, "%.7g", ";", header=NAMES, comments="")
    shown = plots_of(folder / EXCITED, channels, None)
    assert "time column 't' does not rise at sample" in shown["fault"]
    assert (shown["timed"], shown["n_samples"]) == (False, N)


def test_open_questions_are_asked_and_answers_go_on(served, folder):
    server, _ = served
    for path in folder.glob("*.csv"):
        write(path, "prbs" in path.name, NAMES.replace("[um]", ""))
    asked = post(server, "draft", answers=[])
    assert "states no unit of" in asked["open"]["unit"]
    assert 'unit: "um"' in post(server, "draft", answers=[["unit", "um"]])["text"]
    assert "expected a number" in refused(server, "draft", answers=[["pressure_bar", "much"]])
    assert "no question 'folder'" in refused(server, "draft", answers=[["folder", "/"]])


def test_a_choice_changes_its_value_in_all_mappings_alike_and_nothing_else(served):
    server, _ = served
    text = post(server, "draft", answers=[])["text"].replace("fits:", "fits:  # ours\n# two of them")
    changed = post(server, "change", text=text, file=EXCITED, key=["from_s"], value=0.25)["text"]
    assert [line for line in changed.splitlines() if line not in text.splitlines()] == ["    from_s: 0.25"]
    assert post(server, "plots", file=EXCITED, text=changed)["section"]["from_s"] == 0.25
    back = post(server, "change", text=changed, file=EXCITED, key=["from_s"], value=None)["text"]
    assert loaded(back) == loaded(text)
    sheet = [{"points": [[0, 0], [10, 125]]}]
    changed = post(server, "change", text=text, file=EXCITED, key=["signals", "p", "calibration"], value=sheet)["text"]
    assert loaded(changed)["import"]["folder"]["signals"]["p"]["calibration"] == sheet
    machine = post(server, "change", text=text, key=["machine", "clearance_m"], value=25e-6)["text"]
    assert loaded(machine)["machine"] == {"clearance_m": 25e-6}
    said = post(server, "check", text=machine)
    assert (said["problems"], said["recordings"]) == ([], 4)
    assert "leads through a value" in refused(server, "change", text=text, key=["name", "x"], value=1)
    assert "not valid YAML" in refused(server, "change", text="a: [", key=["name"], value=1)
    assert "no mapping for" in refused(server, "change", text="import: 3\n", file=EXCITED, key=["from_s"], value=1)
    wrong = post(server, "check", text=text.replace("format: 1", "format: 1\nfits: 3"))
    assert "experiment.yaml:" in wrong["problems"][0]


def test_the_file_is_the_only_state_and_two_pages_do_not_overwrite_each_other(served, tmp_path):
    server, bench = served
    first = post(server, "draft", answers=[])["text"]
    empty = bench.now()
    assert empty["text"] == ""
    saved = post(server, "save", text=first, saved=empty["saved"])["saved"]
    assert "changed since this page has read it" in refused(server, "save", text="format: 1\n", saved=empty["saved"])
    (tmp_path / "own" / "experiment.yaml").write_text(first + "# by hand\n", encoding="utf-8")
    now = bench.now()
    assert now["text"].endswith("# by hand\n")
    assert now["saved"] != saved
    assert list(now["files"]) == sorted(now["files"])
    assert "notes.md" not in now["files"]


def test_only_those_with_the_token_and_only_own_pages_act(served):
    server, _ = served
    path, port = urlsplit(server.address).path, server.server_address[1]
    json_type = {"Content-Type": "application/json"}
    for name, headers, body, status in (
        ("now", {"Host": "elsewhere.example:1"}, None, 403),
        ("now", {"Sec-Fetch-Site": "cross-site"}, None, 403),
        ("check", {"Sec-Fetch-Site": "cross-site", **json_type}, "{}", 403),
        ("check", {"Content-Type": "text/plain"}, "{}", 400),
        ("check", json_type, "{", 400),
        ("check", json_type, "[]", 400),
        ("check", {**json_type, "Content-Length": str(9 << 20)}, "{}", 400),
        ("now", json_type, "{}", 404),
        ("/other-token/now", {}, None, 403),
        ("../now", {}, None, 404),
        ("none", {}, None, 404),
        ("", {}, None, 200),
    ):
        connection = HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request(
            "GET" if body is None else "POST", urljoin(path, name) if name[:1] == "/" else path + name, body, headers
        )
        answer = connection.getresponse()
        answer.read()
        assert (answer.status, name, headers) == (status, name, headers)
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        connection.close()
    assert "missing a required argument: 'file'" in refused(server, "plots")


def test_a_defect_is_told_to_the_page_and_the_terminal(served, monkeypatch, capfd):
    server, _ = served
    monkeypatch.setattr("gbid.serve.bench.check_experiment", lambda *_: 1 / 0)
    text = post(server, "draft", answers=[])["text"]
    assert "a defect of gbid: ZeroDivisionError" in refused(server, "check", text=text)
    until(lambda: "Traceback" in capfd.readouterr().err)


def test_a_run_is_followed_cancelled_and_resumed(served, monkeypatch):
    server, bench = served
    text = post(server, "draft", answers=[])["text"]
    post(server, "save", text=text, saved=bench.now()["saved"])
    started = []
    command = "import sys, time; print('begun', flush=True); time.sleep(60)"

    def popen(arguments, **more):
        started.append(arguments)
        return original([arguments[0], "-c", command], **more)

    original = subprocess.Popen
    monkeypatch.setattr("gbid.serve.bench.subprocess.Popen", popen)
    assert post(server, "run")["running"]
    post(server, "run")
    assert len(started) == 1  # two pages start one run
    assert started[0][2:4] == ["gbid", "run"]
    until(lambda: "begun" in bench.now()["run"]["said"])
    post(server, "cancel")
    until(lambda: not bench.now()["run"]["running"])
    assert bench.now()["run"]["code"] != 0
    assert post(server, "run")["running"]
    assert len(started) == 2


@pytest.fixture
def browser(tmp_path):
    if find_chromium() is None:
        pytest.skip("no Chromium for the tests in the browser")
    made = Browser(tmp_path / "profile")
    yield made
    made.close()


def by_id(name):
    return f"document.getElementById('{name}')"


SETTLED = "/nothing wrong: .* fits$/.test(document.getElementById('verdict').textContent)"


def test_a_folder_becomes_an_experiment_by_clicks(served, browser, folder, tmp_path):
    server, _ = served
    page = browser.page(server.address)
    page.until(f"document.body?.dataset.shown === '{EXCITED}'")
    page.click(by_id("draft"))
    page.until(SETTLED)
    page.click("[...document.querySelectorAll('#files button')].find(q => q.textContent.includes('P6_N4000_still1'))")
    page.until("document.body.dataset.shown === 'P6_N4000_still1.csv'")
    page.drag_over("document.querySelector('#mapped .chart > svg')", 0.5, 1.0)
    page.until(f"/from_s: 0[.][4-8]/.test({by_id('text')}.value)")
    page.until(SETTLED)
    page.click(by_id("save"))
    path = tmp_path / "own" / "experiment.yaml"
    until(path.exists)
    page.until(f"{by_id('told')}.textContent === 'Saved.'")
    other = browser.page(server.address, 400, dark=True)  # it shows what the file says
    other.until(f"{by_id('text')}?.value === {json.dumps(path.read_text(encoding='utf-8'))}")
    assert other.value("document.documentElement.scrollWidth") <= 400
    path.write_text(path.read_text(encoding="utf-8").replace("order: 0", "order: 1"), encoding="utf-8")
    page.until(f"{by_id('text')}.value.includes('order: ')")
    (folder / EXCITED).unlink()
    page.until(f"![...document.querySelectorAll('#files button')].some(q => q.textContent === '{EXCITED}')")
    write(folder / "P6_N4000_still1.csv", False, spike=7.0)
    page.until("document.getElementById('problems').textContent.includes('overload')")
    server.shutdown()
    server.server_close()
    page.until(f"{by_id('page-errors')}.textContent.startsWith('The server does not answer')")


def write_german(place):
    """Write files of a German logger, at two pressures."""
    from tests.cli.test_logger_folder import STATED, columns_of

    place.mkdir()
    for number, (pressure, kind) in enumerate([(p, q) for p in (5.0, 7.0) for q in ("Ruhe", "Rauschen", "Rauschen")]):
        columns = columns_of(pressure, kind, number)
        units = ";".join(STATED.get(name, "µm") for name in columns)
        rows = (";".join(f"{v:.7g}".replace(".", ",") for v in row) for row in zip(*columns.values(), strict=True))
        text = "\r\n".join(["Messrechner 3", ";".join(columns), units, *rows, ""])
        (place / f"V{number}_{pressure:g}bar_4200Umin_{kind}.csv").write_bytes(text.encode("cp1252"))


def write_american(place):
    from tests.cli.test_foreign_folders import POINTS, write_american

    place.mkdir()
    for seed, (pressure, moving) in enumerate(POINTS):
        write_american(place, moving, pressure, seed, 1.6)


def write_italian(place):
    from tests.cli.test_foreign_folders import write_italian_folder

    write_italian_folder(place, {4.5: (1, 1), 5.0: (1, 3), 6.0: (1, 2)}, 1.6)


SHEET = "-6.5:-40 -2.3:-15 0:0 2.1:15 5.4:40"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write_folder", "answers", "clicks"),
    [
        (write_german, {}, 3),
        (write_american, {"f-unit-of-p": "mil", "f-unit-of-r": "mil", "f-unit-of-u": "mil"}, 3),
        (write_italian, {"f-unit-of-p": "um", "f-calibration-of-p-x-as-0-0-10-125": SHEET}, 4),
    ],
)
def test_a_folder_becomes_compiled_c_by_clicks(write_folder, answers, clicks, browser, tmp_path):
    """Draft, run, export; for the Italian folder also to leave out broken files."""
    write_folder(tmp_path / "runs")
    server, bench = open_bench(tmp_path / "runs", tmp_path / "own", 0, lambda _: None)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        page = browser.page(server.address)
        page.until("document.body?.dataset.shown")
        for name, text in answers.items():
            page.fill(name, text)
        if clicks == 4:
            page.click(by_id("skip"))
        page.click(by_id("draft"))
        page.until(SETTLED)
        for name, text in (("f-travel-of-a-piezo-stack-m-", "45"), ("f-radial-clearance-m-", "25")):
            page.fill(name, text)
        page.until(f"{by_id('text')}.value.includes('clearance_m: 2') && {SETTLED}")
        page.click(by_id("run"))
        page.until(f"{by_id('progress')}.textContent.startsWith('Done')", 900)
        page.click(by_id("export"))
        page.until(f"{by_id('told')}.textContent.startsWith('Export')")
        page.until(f"{by_id('exported')}.children.length", 900)
        assert re.search("compiled; its test says: .*all .* rows agree", page.text("exported"))
        assert page.clicks == clicks
    finally:
        server.shutdown()
        server.server_close()
        bench.close()
    experiment = load_experiment(tmp_path / "own" / "experiment.yaml")
    fits = sorted((experiment.results / "fits" / "bearing").glob("*.h5"))
    assert len(fits) >= 4
    for path in fits:
        fit, point = load(path), experiment.recordings[path.stem].conditions
        true = load_model("theisen2016").at(point["pressure_bar"], point["speed_rpm"]).modes()
        assert np.abs((np.array(fit.model.modes()[:2]) - true) / fit.modes_std[:2]).max() < 4
