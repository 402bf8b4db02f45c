"""Summary of a fit in words."""

from __future__ import annotations

from collections.abc import Iterator

from gbid.report.tables.fit_document import Row
from gbid.tables.numbers import probability

Line = tuple[str, str]
"""Heading and text of a line."""

_MINIMA = 6  # largest number of minima that are listed
_FAR = 5.0  # smallest deviation from the truth, in standard deviations, that noise does not explain


def summary_lines(document: Row) -> Iterator[Line]:
    """Yield the lines of the summary: fit percent, weights, residuals, start, status of the solver, and notes.

    Parameters
    ----------
    document : dict
        Document of `gbid.report.tables.fit_document.fit_document`.

    Yields
    ------
    (word, text)
        Heading and text of each line.
    """
    own = "one step ahead" if document["options"].get("focus") == "prediction" else "simulated"
    horizon = int(document["options"].get("horizon", "1"))
    own = f"{horizon} steps ahead" if horizon > 1 else own
    for recording in document["recordings"]:
        fits = [row for row in document["fit_percent"] if row["recording"] == recording]
        text = ", ".join(f"{row['output']} {row['fit_percent']:.2f} %" for row in fits)
        yield "fit", f"{text} ({own}, on {recording})"
    if len(document["whiteness"]) > 1:
        det = document["options"].get("criterion") == "det"
        yield "outputs", "weighted by the covariance of their errors (det)" if det else "squared errors summed (trace)"
    yield "residuals", residuals_line(document)
    yield "start", start_line(document)
    if document["multi_start"]:
        yield "starts", starts_line(document["multi_start"])
    condition = "" if document["condition"] is None else f", condition {document['condition']:.1g}"
    text = f"{document['status']}; {document['iterations']} iterations, {document['wall_time_s']:.2f} s{condition}"
    yield "solver", text
    yield from (("note", note) for note in document["notes"])
    far = [row for row in document["parameters"] if abs(row["deviation_std"] or 0.0) > _FAR]
    if far:
        names = ", ".join(f"{row['parameter']} ({row['deviation_std']:+.0f})" for row in far)
        text = f"many standard deviations from the truth: {names}; a bias of structure, hold or prefilter, not noise"
        yield "note", text


def residuals_line(document: Row) -> str:
    """Return the whiteness of each output with its p-value, as text."""
    words = []
    level = 0.01 / max(1, len(document["whiteness"]))  # shared by the outputs, as the fit shares it
    for row in document["whiteness"]:
        p = row["p_value"]
        if p is None:
            words.append(f"{row['output']} unknown")
        else:
            words.append(f"{row['output']} {'white' if p >= level else 'not white'} ({probability(p)})")
    return ", ".join(words)


def start_line(document: Row) -> str:
    """Return the numbers of start values by origin; those of the user are listed by name."""
    rows = [row for row in document["parameters"] if not row["fixed"]]
    words = {"data": "from the data", "structure": "from the structure", "user": "given"}
    parts = []
    for origin, word in words.items():
        names = [row["parameter"] for row in rows if row["start_origin"] == origin]
        if names:
            listed = f" ({', '.join(names)})" if origin == "user" or len(names) <= 4 else ""
            parts.append(f"{len(names)} {word}{listed}")
    return ", ".join(parts)


def starts_line(row: Row) -> str:
    """Return the number of starts that led to the best loss, and the minima with their losses, as text."""
    spread = "-" if row["spread"] is None else f"{row['spread']:.4g}"
    text = (
        f"{row['starts']} (seed {row['seed']}): {row['converged']} converged, {row['agreed']} ended at the best; "
        f"largest over smallest loss {spread}"
    )
    minima = list(zip(row["minima"], row["minima_starts"], strict=True))
    if len(minima) < 2:
        return text
    shown = ", ".join(f"{loss:.5g} ({count})" for loss, count in minima[:_MINIMA])
    more = f", {len(minima) - _MINIMA} more" if len(minima) > _MINIMA else ""
    return f"{text}; {len(minima)} minima, loss (starts): {shown}{more}"
