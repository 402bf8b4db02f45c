"""The report: one file, everything in it, and an explorer that computes what the library computes."""

import base64
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from browser import find_chromium
from hypothesis import given
from hypothesis import strategies as st
from json_keys import assert_keys
from matplotlib.figure import Figure
from typer.testing import CliRunner

from gbid.cli.main import app
from gbid.control import close_loop, p_controller, sensitivities
from gbid.core.errors import UsageError
from gbid.experiment.campaign import run_campaign
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.crossval import CROSSVAL, NOMINAL, validate_pair
from gbid.experiment.stages.fit import load_made_fit
from gbid.experiment.stages.lpv import LPV
from gbid.report import sections
from gbid.report import write as report_file
from gbid.report.canvas import figure_of
from gbid.report.explorer import GAINS
from gbid.report.page import Pictures, packed
from gbid.report.read import Results
from gbid.report.sections import SAMPLES, fit_data, trace, warnings
from gbid.report.views import view_of

CHROMIUM = find_chromium()
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium for the tests in the browser; on Debian `apt-get install chromium` brings one"
)
ARGUMENTS = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3000")

CAMPAIGN = """
format: 1
name: small
title: "Four points <script>alert(1)</script>"
rig:
  model: theisen2016
  seed: 1
  operating_points:
    - {pressure_bar: 3.0, speed_rpm: 0}
    - {pressure_bar: 3.0, speed_rpm: 6000}
    - {pressure_bar: 7.0, speed_rpm: 0}
    - {pressure_bar: 7.0, speed_rpm: 6000}
  duration_s: 1.0
  prbs: {recordings: 1, amplitude_m: 4.5e-6, hold_s: 20e-3}
  stationary: {recordings: 1, duration_s: 0.5}
  sensors: {noise_p_m: 100e-9, noise_u_m: 10e-9}
prefilter: {method: harmonics, harmonics: 5, median: 3}
fits:
  bearing: {structure: rotor_bearing}
  piezos: {structure: piezo_pair}
crossval:
  piezos: {on: others, minimum_percent: 99.9}
nominal: {fit: piezos}
lpv: {fit: bearing, order: 1, actuators: nominal}
"""


class FirstPictures(Pictures):
    """The first three pictures as they are; the others, which take their time, empty and of their size."""

    count = 0

    def picture(self, figure, alt, caption=""):
        self.count += 1
        shown = figure if self.count <= 3 else Figure(figure_of(figure).get_size_inches())
        return super().picture(shown, alt, caption)


EMPTIED = 10 * 170_000
"""Length of the others: a surface has 170 kB."""


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A campaign with everything but a controller of its own."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "small.yaml").write_text(CAMPAIGN, encoding="utf-8")
    job = Job(load_experiment(folder / "small.yaml"))
    run_campaign(job)
    run_stage(job, CROSSVAL)
    made = run_stage(job, NOMINAL)
    assert_keys("nominal", view_of(NOMINAL).document(job, made))
    run_stage(job, LPV)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_file, "Pictures", FirstPictures)
        patch.setattr(sections, "CURVES", 1)
        outcome = report_file.write_report(job)
        beside = report_file.write_curves(job, outcome.path)
        assert {made.state for made in beside} == {"made"}
        assert {made.state for made in report_file.write_curves(job, outcome.path)} == {"kept"}
    return job


@pytest.fixture(scope="module")
def page(job):
    return (job.experiment.results / "report.html").read_text(encoding="utf-8")


class Outline(HTMLParser):
    """Elements with their attributes, and the text of headings."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.headings, self._open = [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if re.fullmatch("h[1-6]", tag):
            self.headings.append([tag, ""])
            self._open = tag

    def handle_endtag(self, tag):
        self._open = None if tag == self._open else self._open

    def handle_data(self, data):
        if self._open:
            self.headings[-1][1] += data

    def of(self, *tags):
        return [attributes for tag, attributes in self.elements if tag in tags]


def embedded(page, name):
    solution = re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', page, re.DOTALL)
    return json.loads(solution[1])


def test_page_needs_nothing_from_outside(page):
    outside = [url for url in re.findall(r"https?://[^\s\"'<>)]+", page) if not url.startswith("http://www.w3.org/")]
    assert outside == []
    outline = Outline(page)
    assert [a["src"] for a in outline.of("script", "img", "iframe") if "src" in a] == []
    assert {a["href"] for a in outline.of("link")} == {"data:,"}
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    assert "fetch(" not in page
    assert "XMLHttpRequest" not in page


def test_page_of_86_recordings_stays_below_ten_megabytes(page, job):
    fits = embedded(page, "fit-data")["fits"]
    # five-second recordings show as many points as these do; only the range of the error has a few more
    each = max(len(json.dumps(fit)) for fit in fits.values()) * 1.5
    rest = EMPTIED + len(page) - sum(len(json.dumps(fit)) for fit in fits.values())
    assert rest + 2 * 86 * each + 86 * 2000 < 10e6
    assert len(page) + EMPTIED < 2.5e6


def test_headings_links_and_ids_hang_together(page):
    outline = Outline(page)
    levels = [int(tag[1]) for tag, _ in outline.headings]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b - a <= 1 for a, b in pairwise(levels))
    titles = [text for tag, text in outline.headings if tag == "h2"]
    expected = ["At a glance", "Data quality", "Fits", "Cross-validation", "Nominal actuator"]
    assert titles[:5] == expected
    assert titles[5:] == [
        "Surfaces over pressure and speed",
        "Controller",
        "Made with",
        "What was not done in this experiment",
    ]
    ids = [a["id"] for _, a in outline.elements if "id" in a]
    assert len(ids) == len(set(ids))
    named = embedded(page, "fit-data")["fits"]
    for a in outline.of("a"):
        place, _, fit = a["href"].removeprefix("#").partition("&")
        assert a["href"].startswith("#")
        assert place in ids
        assert not fit or fit.replace("%2F", "/") in named


def test_everything_has_words_for_those_who_do_not_see_it(page):
    outline = Outline(page)
    labelled = {a.get("for") for a in outline.of("label")}
    for a in outline.of("input", "select"):
        assert a.get("id") in labelled or a.get("aria-label")
    pictures = [a for a in outline.of("svg") if "picture" in a.get("class", "")]
    assert len(pictures) >= 8
    assert all(a["role"] == "img" and len(a["aria-label"]) > 20 for a in pictures)
    assert all(a.get("tabindex", "0") == "0" for _, a in outline.elements)
    assert not any("onclick" in a for _, a in outline.elements)
    assert {a["name"] for a in outline.of("meta") if "name" in a} >= {"viewport"}


def test_text_of_the_experiment_stays_text(page):
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page


def test_every_fit_can_be_reached_and_shows_what_the_library_computes(page, job):
    fits = embedded(page, "fit-data")["fits"]
    wanted = {f"{fit}/{q.name}" for fit in ("bearing", "piezos") for q in job.experiment.fit_recordings(fit)}
    assert len(wanted) == 8
    options = {a["value"] for a in Outline(page).of("option") if "/" in a["value"]}
    assert options == set(fits) == wanted
    name = next(key.removeprefix("bearing/") for key, fit in fits.items() if "traces" in fit)
    validation = validate_pair(job, "bearing", name, name)
    (shown,) = fits[f"bearing/{name}"]["traces"]
    first = round(shown["start"] / 2e-4)
    every = round(shown["step"] / 2e-4)
    for i, output in enumerate(shown["outputs"]):
        for word, values in (("measured", validation.measured), ("simulated", validation.simulated)):
            raw = np.frombuffer(base64.b64decode(output[word]["values"]), "<i2") * output[word]["scale"]
            expected = 1e6 * values[first::every, i][: len(raw)]
            assert np.abs(raw - expected).max() <= output[word]["scale"] / 2 * (1 + 1e-9)
    result = load_made_fit(job, "bearing", name)
    rows = {row[0]: row for row in fits[f"bearing/{name}"]["tables"][0]["rows"]}
    assert float(rows["k_xx"][1]) == pytest.approx(result.parameters["k_xx"], rel=1e-4)
    assert float(rows["k_xx"][2]) == pytest.approx(result.std["k_xx"], rel=0.05)


def test_curves_of_the_worst_and_the_best_fit_are_in_the_page_and_the_others_beside_it(page, job):
    fits, results = embedded(page, "fit-data")["fits"], Results(job)
    for fit in ("bearing", "piezos"):
        percents = {q.name: load_made_fit(job, fit, q.model).fit_percent.min() for q in results.fits if q.fit == fit}
        drawn = {name for name in percents if "traces" in fits[name]}
        assert drawn == {min(percents, key=percents.get), max(percents, key=percents.get)}
        for name in set(percents) - drawn:
            text = (job.experiment.results / "report_curves" / f"{name}.js").read_text(encoding="utf-8")
            begin = f"Fits.add({json.dumps(name)},"
            assert json.loads(text[text.index(begin) + len(begin) : -3]) == sections.curves_of(results, name)


def test_warnings_name_what_fell_short(page):
    glance = page[page.index('id="summary"') : page.index('id="data"')]
    assert re.search(r"piezos: \d+ validations below the minimum asked for", glance)
    assert "the residuals are not white [GB106" in glance
    assert "start values come from the data" not in glance  # a note that does not question the result
    assert "no controller was designed" in page[page.index('id="left-out"') :]


def test_notes_of_the_prefilter_tell_how_many_recordings_carry_them(page):
    assert "2 of 4 recordings: the shaft stood still" in page


def test_lost_fits_are_named_with_reasons(job, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(job.experiment.results, results)
    (results / "fits" / "bearing" / "p3_n0_prbs1.h5").unlink()
    changed = tmp_path / "changed.yaml"
    text = CAMPAIGN.replace("piezos: {structure: piezo_pair}", "piezos: {structure: piezo_pair, focus: simulation}")
    changed.write_text(text, encoding="utf-8")
    results = Results(Job(load_experiment(changed, results)))
    fits = fit_data(results, {})["fits"]
    assert fits["bearing/p3_n0_prbs1"]["status"] == "missing: not made yet"
    assert fits["piezos/p3_n0_prbs1"]["status"].startswith("stale: made with other settings")
    assert fits["bearing/p3_n6000_prbs1"]["state"] in ("good", "warn")
    glance = [link.text for link in warnings(results)]
    assert "1 fit not made yet" in glance
    assert "4 fits made with other settings or data" in glance
    assert "piezos: not validated with the present fits" in glance
    assert "no surfaces were drawn with the present fits" in glance


def test_report_is_written_anew_only_when_something_changed(job, tmp_path):
    assert report_file.write_report(job).state == "kept"
    path = tmp_path / "own.html"
    path.write_text("<p>mine</p>", encoding="utf-8")
    outcome = report_file.write_report(job, path)
    assert outcome.state == "failed"
    assert "not made by an experiment" in outcome.text
    assert path.read_text(encoding="utf-8") == "<p>mine</p>"


def test_command_prints_the_path(job, tmp_path):
    result = CliRunner().invoke(app, ["report", str(job.experiment.file.path)])
    assert result.exit_code == 0
    assert f"report: {job.experiment.results / 'report.html'}" in result.output
    nothing = CliRunner().invoke(app, ["report", str(job.experiment.file.path), "--results", str(tmp_path / "none")])
    assert nothing.exit_code == UsageError.exit_code
    assert "no results yet" in nothing.output


@given(st.lists(st.floats(-1e-3, 1e-3) | st.just(float("nan")), min_size=1, max_size=50))
def test_packed_curves_keep_four_digits(values):
    given_values = np.array(values)
    curve = packed(given_values)
    integers = np.frombuffer(base64.b64decode(curve["values"]), "<i2")
    missing = np.isnan(given_values)
    np.testing.assert_array_equal(integers == -32768, missing)
    off = np.abs(integers * curve["scale"] - given_values)[~missing]
    assert off.max(initial=0.0) <= np.abs(given_values[~missing]).max(initial=0.0) * 1.6e-5 + 1e-300


def test_trace_covers_short_recordings(job):
    validation = validate_pair(job, "piezos", "p3_n0_prbs1", "p3_n0_prbs1")
    delayed = trace(validation, from_s=0.99)
    assert delayed["start"] + delayed["outputs"][0]["n"] * delayed["step"] <= 1.0 + 1e-9
    error = 1e6 * (validation.measured - validation.simulated)[:, 0]
    low = delayed["outputs"][0]["error_low"]
    raw = np.frombuffer(base64.b64decode(low["values"]), "<i2") * low["scale"]
    assert raw.min() == pytest.approx(error.min(), abs=low["scale"])


def test_trace_has_the_times_of_irregular_samples(job):
    validation = validate_pair(job, "piezos", "p3_n0_prbs1", "p3_n0_prbs1")
    times = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, len(validation.time)))
    made = trace(replace(validation, time=times - times[0]))
    times, first = times - times[0], len(times) // 3
    first = max(0, min(first, len(times) - SAMPLES))
    shown = np.frombuffer(base64.b64decode(made["times"]["values"]), "<i2") * made["times"]["scale"]
    every = max(1, min(SAMPLES, len(times)) // 600)
    part = times[first : first + SAMPLES : every]
    np.testing.assert_allclose(shown, part - part[0], atol=2 * made["times"]["scale"])
    assert made["duration"] == times[-1]


# ---------------------------------------------------------------- in the browser


@pytest.fixture(scope="module")
def opened(job, tmp_path_factory):
    """What became of the page at each address; one browser opens them all."""
    page = (job.experiment.results / "report.html").as_uri()
    (beside, *_) = sorted((job.experiment.results / "report_curves" / "piezos").glob("*.js"))
    addresses = {"phone": "", "fit": f"fit&piezos%2F{beside.stem}"}
    frames = [
        f'<iframe src="{page}#{html.escape(address)}" width="390" height="800"></iframe><pre></pre>'
        for address in addresses.values()
    ]
    outer = tmp_path_factory.mktemp("opened") / "frames.html"
    outer.write_text(
        f"""{"".join(frames)}<script>addEventListener("load", () => setTimeout(() => {{
          for (const frame of document.querySelectorAll("iframe")) {{
            const there = id => frame.contentDocument.getElementById(id), root = frame.contentDocument.documentElement;
            frame.nextSibling.textContent = JSON.stringify({{
              faultless: there("page-errors").hidden, title: there("fit-title").outerHTML,
              curves: there("fit-curves").innerHTML, map: there("explore-map").innerHTML,
              verdict: there("explore-verdict").textContent, needed: root.scrollWidth, width: root.clientWidth }});
          }}
        }}, 500))</script>""",
        encoding="utf-8",
    )
    command = [CHROMIUM, *ARGUMENTS, "--allow-file-access-from-files", "--dump-dom", outer.as_uri()]
    text = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    answers = [json.loads(html.unescape(computed)) for computed in re.findall(r"<pre>(.*?)</pre>", text, re.DOTALL)]
    assert [answer["faultless"] for answer in answers] == [True] * len(addresses)
    return dict(zip(addresses, answers, strict=True))


@needs_chromium
def test_page_shows_the_fit_of_its_address_with_curves_from_beside_the_page(opened):
    assert re.search(r">piezos, p\d_n\d+_prbs1: \d bar, \d+ rpm</h4>", opened["fit"]["title"])
    curves = opened["fit"]["curves"]
    assert curves.count("<svg") - curves.count('aria-hidden="true"') == 4  # two outputs: curve and error
    assert "NaN" not in curves


@needs_chromium
def test_page_fits_a_phone(opened):
    assert 300 < opened["phone"]["width"] <= 390
    assert opened["phone"]["needed"] <= opened["phone"]["width"]


def unpacked(curve):
    values = np.frombuffer(base64.b64decode(curve["values"]), "<i2")
    return np.where(values == -32768, np.nan, values * curve["scale"]).reshape(len(GAINS), -1)


def test_explorer_has_the_loops_that_the_library_computes(page, job):
    data, model = embedded(page, "explorer-data"), Results(job).loop_model
    assert model.name == "small"  # the surfaces of this experiment, not the rig's
    assert data["gains"] == GAINS.tolist()
    assert len(data["points"]) == len(model.operating_points) == 4
    for point, (i, j) in zip(data["points"], ((5, 5), (12, 9), (14, 14), (30, 30)), strict=True):
        place = [float(word.split()[0]) for word in point["label"].split(", ")]
        plant, controller = model.plant_at(*place), p_controller(GAINS[i], GAINS[j])
        loop, closed = sensitivities(plant, controller), close_loop(plant, controller)
        damping, peak, static = (unpacked(point[name])[i, j] for name in ("damping", "peak", "static"))
        if not closed.is_stable():
            assert np.isnan([peak, static]).all()
            continue
        assert damping == pytest.approx(min(zeta for _, zeta in closed.modes()), abs=1e-4)
        assert peak == pytest.approx(min(loop.peak("output").value, 20.0), rel=5e-3)
        at_rest = np.linalg.svd(loop.response("output", [0.0])[0], compute_uv=False)[0]
        assert static == pytest.approx(at_rest, rel=5e-3)


@needs_chromium
def test_explorer_draws_its_map_and_interpolates(page, job, opened):
    data, model = embedded(page, "explorer-data"), Results(job).loop_model
    *_, (_, x, y) = data["designs"]  # where it begins
    point, plant = data["points"][0], model.plant_at(*model.operating_points[0])
    shown = re.search(r"damping factor ([\d.]+); peak of S_o ([\d.]+);", opened["phone"]["verdict"])
    damping, peak = map(float, shown.groups())
    assert damping == pytest.approx(min(zeta for _, zeta in close_loop(plant, p_controller(x, y)).modes()), abs=0.02)
    assert peak == pytest.approx(sensitivities(plant, p_controller(x, y)).peak("output").value, rel=0.03)
    stable = np.isfinite(unpacked(point["peak"])) & (unpacked(point["damping"]) > 0)
    assert opened["phone"]["map"].count('class="cell"') == stable.sum()
