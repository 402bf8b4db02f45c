"""Tables of pages from the stored figures of studies: damaged files, coverage, reproduction of the paper."""

import json
from collections import Counter

from IPython.display import Markdown

from gbid.report.named import paper
from tests.benchmarks.coverage import coverage_table, missed
from tests.benchmarks.running import DOCS, markdown


def stored(name):
    """Figures of a study, docs/NAME.json."""
    return json.loads((DOCS / f"{name}.json").read_text(encoding="utf-8"))


def shown(name, table):
    """Table of a study on its page, from the stored figures docs/NAME.json."""
    return Markdown(table(stored(name)))


def fuzz_table():
    """Outcomes of reading damaged files, by the origin of the files."""
    run, origins = stored("fuzz"), {}
    for target in run["targets"].values():
        counts = origins.setdefault(target["origin"], Counter())
        counts.update({name: target.get(name, 0) for name in run["outcomes"]})
    rows = [[origin, counts.total(), *counts.values()] for origin, counts in origins.items()]
    rows.append(["all", run["inputs"], *run["outcomes"].values()])
    return markdown(["files of", "inputs", *run["outcomes"]], rows)


def fuzz_text():
    run = stored("fuzz")
    lines = [f"largest growth of memory {run['largest_growth_mb']} MB, seed {run['seed']}"]
    for mended in run.get("mended", ()):
        lines.append(f"found in this run and mended: {mended['target']}, {mended['was']}; read again: {mended['is']}")
    return "\n".join(lines)


def coverage_text():
    """Coverage of the standard deviations, and the cells that miss the target."""
    run = stored("coverage")
    spread = 100 * (0.95 * 0.05 / (3 * run["seeds"])) ** 0.5
    return "\n".join(
        [
            coverage_table(run),
            "",
            f"With {run['seeds']} recordings a cell has a standard deviation of {spread:.1f} percent or more, so some "
            "cells miss the target by chance. These miss it, without the note GB105 in 95 % of their fits:",
            "",
            *(f"- {line}" for line in missed(run)),
        ]
    )


def counts_table():
    """Numbers of the paper by verdict."""
    words = {"within": "within the paper's scatter", "explained": "explained", "ours": "ours by setting"}
    words |= {"open": "open", "missing": "missing"}
    rows = ["| rows | " + " | ".join(words.values()) + " |", "|---|" + "---:|" * len(words)]
    for kind, n in stored("reproduction")["counts"].items():
        rows.append(f"| {kind} ({sum(n.values())}) | " + " | ".join(str(n[w]) for w in words) + " |")
    return "\n".join(rows)


def headline_text():
    """What the comparison with the paper says, in a list."""
    return "\n".join(f"- **{line}**" for line in stored("reproduction")["headline"])


def reproduction_text():
    return paper().reproduction_markdown(stored("reproduction"))
