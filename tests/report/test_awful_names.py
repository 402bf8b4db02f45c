"""Names and units are free text: twenty awful ones go through every output, and act on none."""

import csv
import io
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from matplotlib.figure import Figure
from rich.console import Console
from ruamel.yaml import YAML
from scipy.io import loadmat

import gbid
from gbid.cli.progress import LiveBar, ProgressReporter
from gbid.core.errors import DataError
from gbid.core.names import file_stem, printable
from gbid.core.tables import csv_text, html_table, markdown_table, terminal_table, titled
from gbid.experiment.fields import Item
from gbid.experiment.run import Outcome
from gbid.export.chain import c_comment
from gbid.export.matlab import save_mat
from gbid.export.tables import save_csv, save_yaml
from gbid.identify.table import TableEntry, csv_table, tabulate
from gbid.report.canvas import plain_label, save_figure, symbol
from gbid.report.measured_pictures import plot_residuals, plot_response

AWFUL = (
    "[/]",
    "[bold]x[/bold]",
    "two\nlines",
    "a\rb\tc",
    300 * "long ",
    "$\\frac{",
    "$_",
    "p_}",
    "=HYPERLINK(A1)",
    "+cmd|' /C calc'!A0",
    "*/ int x; /*",
    "??/ trigraph \\",
    "<script>alert(1)</script>",
    "\x1b[31mred\x1b[0m",
    "\u202etfel",
    'a,b;"c"|`d`',
    "'; system('x'); %{",
    "{0} %s %n {{ x }}",
    "# comment, \u2028 and line",
    "\N{CJK UNIFIED IDEOGRAPH-6F22} \N{SLIGHTLY SMILING FACE} \xb5",
    " blank ",
    "nul\0 and \x07",
)


@pytest.fixture(scope="module")
def plain():
    recording = simulated(MODE, MODE_AT, levels(300), noise=0.3, name="run")
    result = gbid.fit(MODE, recording)
    return result, gbid.cross_validate(result, recording), gbid.check_residuals(result, recording)


def named(result, name):
    """The result as if structure, recording, signals and units were called so."""
    model = replace(result.model, name=name, input_names=(name,), output_names=(f"y{name}",))
    units = dict.fromkeys(result.units, name)
    return result.changed(structure=name, recordings=(name,), units=units, model=model, notes=(name,))


def acts_on_a_terminal(text):
    return [c for c in text if not c.isprintable() and c != "\n"]


class Tags(HTMLParser):
    def __init__(self, page):
        super().__init__()
        self.tags = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)


def tables_of(result):
    return titled(result.structure, result.tables())


@pytest.mark.parametrize("name", AWFUL, ids=lambda name: ascii(name)[:20])
def test_tables_keep_their_form(name, plain):
    computed = named(plain[0], name)
    for table, usual in zip(tables_of(computed), tables_of(plain[0]), strict=True):
        console = Console(file=io.StringIO(), width=200, force_terminal=False)
        console.print(terminal_table(table))
        assert not acts_on_a_terminal(console.file.getvalue())
        assert Tags(html_table(table)).tags[:12] == Tags(html_table(usual)).tags[:12]
        assert "<script" not in html_table(table)
        text = markdown_table(table)
        assert not acts_on_a_terminal(text)
    given = csv_table(tabulate([TableEntry(name, "m", (name,), {}, computed)]))
    text = csv_text(given, [name])
    lines = [line for line in text.split("\n") if not line.startswith("# ")]
    rows = list(csv.reader(lines[:-1]))
    assert len(rows) == 2
    assert len(rows[0]) == len(rows[1]) == len(given.columns)
    assert not any(cell.startswith(("=", "+", "@")) for row in rows for cell in row)
    assert not acts_on_a_terminal(text)
    assert not acts_on_a_terminal(repr(computed))


@pytest.mark.parametrize("name", AWFUL, ids=lambda name: ascii(name)[:20])
def test_files_for_other_programs(name, plain, tmp_path):
    result = plain[0]
    computed = named(result, name)
    numbers = save_mat(computed, tmp_path / "awful.mat")
    assert loadmat(numbers)["InputName"][0, 0].item() == name.replace("\0", " ")
    table = save_csv(computed, tmp_path / "awful.csv")
    assert len({len(row) for row in csv.reader(table.read_text(encoding="utf-8").split("\n")[:-1])}) == 1
    text = save_yaml(computed, tmp_path / "awful.yaml").read_text(encoding="utf-8")
    assert YAML(typ="safe").load(text)["structure"] == name
    recording = gbid.Recording(
        {"u": np.zeros((3, 1))}, 1.0, {}, name, units={"u": name}, channels={"u": (name,)}, provenance={"by": name}
    )
    path = tmp_path / f"{file_stem(name.replace('/', '|').replace(chr(0), ''))}.h5"
    if "\0" in name:
        with pytest.raises(DataError, match="contains a NUL"):
            gbid.save_recording(recording, path)
        return
    gbid.save_recording(recording, path)
    again = gbid.load_recording(path)
    assert (again.name, again.units, again.channels) == (recording.name, recording.units, recording.channels)


def test_a_comment_in_c_ends_where_it_should():
    for name in AWFUL:
        text = c_comment(name)
        assert re.fullmatch(r"[ -~]*", text)
        assert "*/" not in text
        assert "/*" not in text
        assert not text.endswith("\\")


def test_figures_draw_names_as_they_are(plain, tmp_path):
    _, validation, residuals = plain
    figure = Figure()
    for name in AWFUL:
        figure.text(0, 0, f"{symbol(name)} to $p_x$ [{plain_label(name)}]")
        figure.text(0, 0, f"{symbol(name)}")
    save_figure(figure, tmp_path / "names.svg")
    assert symbol("p_x") == "$p_{x}$"
    name = "$\\frac{"
    awful = replace(
        validation, recording=name, fitted_to=(name,), input_names=(name,), output_names=(name,), output_units=(name,)
    )
    save_figure(plot_response(awful), tmp_path / "response.svg")
    save_figure(plot_residuals(replace(residuals, recording=300 * "x")), tmp_path / "residuals.svg")


def test_progress_shows_names_as_they_are(capsys):
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    bar = LiveBar(console)
    with bar.progress:
        for reporter in (ProgressReporter(), ProgressReporter(bar=bar)):
            for name in AWFUL:
                reporter.expect("fit", 1, 0, 0)
                reporter.begin(Item("fit", name))
                reporter.end(Outcome(Item("fit", name), None, "failed", name))
    assert not acts_on_a_terminal(capsys.readouterr().err)
    assert "\x1b[31mred" not in console.file.getvalue()


def test_a_description_of_a_unit_is_xml():
    from gbid.export.fmu import model_description, unit_plant, unit_variables

    for name in AWFUL:
        awful = gbid.LinearModel([[-1]], [[1]], [[1]], [[0]], input_names=(name,), name=name)
        variables = unit_variables(unit_plant(awful, "exact", None), None, None)
        root = ET.fromstring(model_description("unit", name, variables, "g", (), 1e-4, name))
        shown = " ".join(printable(name).split())
        assert root.attrib["description"] == root.find(".//ScalarVariable").attrib["name"] == shown
