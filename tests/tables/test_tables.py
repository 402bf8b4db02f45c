import csv
import io
import json
from dataclasses import FrozenInstanceError
from html.parser import HTMLParser

import pytest
from rich.console import Console

from gbid.core.tables import Cell, Column, Table, csv_text, html_table, markdown_table, table_of_records, terminal_table

AWKWARD = ["[bold]my u[/bold]", "a,b", 'say "x"', "one\ntwo", "p|q", "<b>&amp;", "# not a comment", "_u_ *x* `y`"]
SHOWN = [name.replace("\n", " ") for name in AWKWARD]
STIFFNESS = Table(
    "bearing",
    [Column("parameter"), Column("estimate\n", "N/m", 5), Column("std", format=".1f"), Column("recording")],
    [
        ["k_xx", -633314.2, 1 / 3, Cell("run 1", href="#fit&run%201")],
        ["tau", 3, None, ""],
        ["d_xx", float("nan"), Cell(None, "fixed"), "run 2"],
    ],
    ["two fits"],
)


def printed(table: Table, width: int = 100) -> str:
    console = Console(width=width, highlight=False, file=io.StringIO(), record=True)
    console.print(terminal_table(table))
    return console.export_text()


class Texts(HTMLParser):
    """Cells of an HTML table, with the tags that stand in them."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.inside = False

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.inside = True

    def handle_endtag(self, tag):
        self.inside = self.inside and tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.rows[-1][-1] += data


def read_html(table: Table) -> Texts:
    parser = Texts()
    parser.feed(html_table(table))
    return parser


def test_format_of_the_column_makes_the_words():
    assert STIFFNESS.texts() == [
        ["k_xx", "-633.31e3", "0.3", "run 1"],
        ["tau", "3", "-", ""],
        ["d_xx", "-", "fixed", "run 2"],
    ]
    assert [column.left for column in STIFFNESS.columns] == [True, False, False, True]
    assert [column.heading for column in STIFFNESS.columns] == ["parameter", "estimate [N/m]", "std", "recording"]
    assert Column("white", format="s").show(True) == "yes"
    assert Column("", missing="").show(None) == ""


def test_a_table_is_frozen_and_refuses_rows_of_another_length():
    with pytest.raises(FrozenInstanceError):
        STIFFNESS.title = "other"
    with pytest.raises(ValueError, match="table 'fits': row 1 has 1 cells for 2 columns"):
        Table("fits", [Column("a"), Column("b")], [["1", "2"], ["3"]])


def test_document_holds_values():
    document = STIFFNESS.document()
    assert document["columns"] == ["parameter", "estimate [N/m]", "std", "recording"]
    assert document["rows"][0] == ["k_xx", -633314.2, 1 / 3, "run 1"]
    assert document["rows"][2][1] is None
    assert json.loads(json.dumps(document, allow_nan=False))["title"] == "bearing"


def test_terminal():
    lines = [line.rstrip() for line in printed(STIFFNESS).splitlines()]
    assert lines[0] == "bearing"
    assert lines[1].split() == ["estimate"]
    assert lines[2].split() == ["parameter", "[N/m]", "std", "recording"]
    assert lines[4].split() == ["k_xx", "-633.31e3", "0.3", "run", "1"]
    assert lines[-1] == "two fits"


def test_terminal_without_headings_folds_what_may_wrap():
    words = Table("", [Column(""), Column("", wrap=True)], [["note", "far " * 20]])
    lines = printed(words, 40).splitlines()
    assert lines[0].startswith("note  far far")
    assert lines[1].startswith("      far far")
    assert sum(line.count("far") for line in lines) == 20


def test_html():
    table = read_html(STIFFNESS)
    assert table.rows[0] == ["parameter", "estimate [N/m]", "std", "recording"]
    assert table.rows[1] == ["k_xx", "-633.31e3", "0.3", "run 1"]
    assert ("a", {"href": "#fit&run%201"}) in table.tags
    assert [attrs for tag, attrs in table.tags if tag == "th"][:2] == [
        {"scope": "col", "class": "left"},
        {"scope": "col"},
    ]
    assert '<p class="words">two fits</p>' in html_table(STIFFNESS)


def test_markdown():
    assert markdown_table(STIFFNESS) == (
        "**bearing**\n\n"
        "| parameter | estimate [N/m] | std | recording |\n"
        "| --- | ---: | ---: | --- |\n"
        "| k_xx | -633.31e3 | 0.3 | run 1 |\n"
        "| tau | 3 | - |  |\n"
        "| d_xx | - | fixed | run 2 |\n\n"
        "two fits\n"
    )


def test_csv_holds_every_digit_and_units_in_its_header():
    lines = csv_text(STIFFNESS, ["content_key: 12"]).splitlines()
    assert lines[:3] == ["# two fits", "# content_key: 12", "parameter,estimate [N/m],std,recording"]
    assert lines[3] == "k_xx,-633314.2,0.3333333333333333,run 1"
    assert lines[4:] == ["tau,3,,", "d_xx,nan,,run 2"]


def test_csv_of_records():
    table = table_of_records([{"name": "a", "gain [1/kg]": 0.1, "converged": True}])
    assert csv_text(table) == "name,gain [1/kg],converged\na,0.1,true\n"


def awkward_table() -> Table:
    return Table("<i>[red]a|b", [Column(f"{name} {i}") for i, name in enumerate(AWKWARD)], [AWKWARD, AWKWARD])


def test_awkward_names_on_a_terminal():
    text = printed(awkward_table(), 200)
    assert "<i>[red]a|b" in text
    assert text.count("[bold]my u[/bold]") == 3
    assert text.count("one two") == 2
    assert "\x1b" not in printed(Table("", [Column("a")], [["\x1b[31mred"]]))


def test_awkward_names_in_html():
    table = read_html(awkward_table())
    assert table.rows[1] == SHOWN
    assert {tag for tag, _ in table.tags} == {"p", "div", "table", "thead", "tbody", "tr", "th", "td"}
    link = Table("", [Column("a")], [[Cell("x", href='"><script>')]])
    assert "<script>" not in html_table(link)


def test_awkward_names_in_markdown():
    lines = markdown_table(awkward_table()).splitlines()
    assert len(lines) == 6
    assert lines[0] == r"**\<i>[red]a\|b**"
    cells = lines[4].removeprefix("| ").removesuffix(" |").split(" | ")
    assert cells[3:] == ["one two", r"p\|q", r"\<b>\&amp;", "# not a comment", r"\_u\_ \*x\* \`y\`"]


def test_awkward_names_in_csv():
    rows = list(csv.reader(io.StringIO(csv_text(awkward_table()))))
    assert rows[1:] == [SHOWN, SHOWN]
    hashed = csv_text(Table("", [Column("a"), Column("b")], [["# one", 1]]), ["two\nlines"])
    assert hashed == '# two lines\na,b\n"# one",1\n'
