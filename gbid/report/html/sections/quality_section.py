"""Section on the data: excitation, problems of signals, corrections of the prefilter."""

from __future__ import annotations

from gbid.report.html.page import Block, Fold, Listed, PageSection, Words, in_units, point_words
from gbid.report.reader import Results
from gbid.report.tables.recording_tables import position_unit
from gbid.tables.table import Column, Table

ALIKE = 0.5
"""Correlation of the two excitations above which their effects can hardly be separated."""
WORSE = 1e-3
"""Share of the variance by which a run-out map may increase the position before the page lists it."""


def quality_section(results: Results) -> PageSection:
    """Return the section with the recordings, their problems, and the corrections by the prefilter."""
    blocks: list[Block] = []
    recordings = results.recordings
    if not recordings:
        blocks.append(Words("There is no excited recording yet."))
        return PageSection("data", "Data quality", blocks)
    problems = [text for q in recordings for text in q.problems]
    if problems:
        blocks += [Words(f"{len(problems)} problems found in {len(recordings)} recordings:", "bad"), Listed(problems)]
    else:
        text = f"{len(recordings)} excited recordings checked: no dead, saturated or swapped channel, no rub."
        blocks.append(Words(text, "good"))
    alike = [q for q in recordings if q.alike is not None and abs(q.alike) > ALIKE]
    for q in alike:
        blocks.append(Words(f"{q.name}: the excitations of x and y are correlated ({q.alike:+.2f})", "warn"))
    rows = []
    for q in recordings:
        spread = [
            ", ".join(f"{channel} {in_units(rms, q.units[signal])}" for channel, rms, _ in q.signals[signal])
            if signal in q.signals
            else None
            for signal in _signals(results)
        ]
        length = f"{q.duration:g} s, {q.n_samples}"
        rows.append((q.name, point_words(results.experiment, q.name), length, *spread, q.alike))
    headings = [f"{name}, rms" for name in _signals(results)]
    table = Table(
        "Excited recordings: rms about the mean of each channel, correlation of the two excitations",
        [
            *map(Column, ("recording", "operating point", "length, samples", *headings)),
            Column("correlation x, y", format="+.3f"),
        ],
        rows,
    )
    blocks.append(Fold(f"Excitation of {len(rows)} recordings", [table]) if len(rows) > 12 else table)
    blocks += _prefilter(results)
    return PageSection("data", "Data quality", blocks)


def _signals(results: Results) -> list[str]:
    return list(dict.fromkeys(signal for q in results.recordings for signal in q.signals))


def _prefilter(results: Results) -> list[Block]:
    section = results.experiment.spec.prefilter
    if section is None:
        return [Words("No prefilter: the recordings were fitted as they are.")]
    rows = results.prefiltered
    if not rows:
        return [Words("The prefilter has not run yet.", "warn")]
    worse = [row for row in rows if row["runout_share"] < -WORSE]
    median = "none" if section.median == 1 else f"{section.median} samples"
    spikes, mean = ("replaced" if section.spikes else "kept"), ("removed" if section.remove_mean else "kept")
    words = f"Run-out map: {section.method}; spikes: {spikes}; median: {median}; mean {mean}."
    factor, unit = position_unit(rows)
    table = Table(
        "What the prefilter took out of the disc position",
        [
            Column("recording"),
            Column("channel"),
            Column("rms before", unit, 4),
            Column("rms after", unit, 4),
            Column("offset", unit, 4),
            Column("run-out share", "%", ".2f"),
            Column("spikes", format="d"),
        ],
        [
            (
                row["recording"],
                row["channel"],
                *(factor * row[key] for key in ("rms_before", "rms_after", "offset")),
                100 * row["runout_share"],
                row["spikes"],
            )
            for row in rows
        ],
    )
    blocks: list[Block] = [Words(words)]
    if worse:
        names = ", ".join(dict.fromkeys(row["recording"] for row in worse))
        blocks.append(Words(f"The run-out map made the position larger in {names}: it may not belong to them.", "warn"))
    carried: dict[str, set[str]] = {}
    for row in rows:
        for note in row["notes"]:
            carried.setdefault(note, set()).add(row["recording"])
    every = len({row["recording"] for row in rows})
    if carried:
        blocks.append(Listed([f"{len(names)} of {every} recordings: {note}" for note, names in carried.items()]))
    blocks.append(Fold(f"Prefilter, {len(rows)} channels", [table]) if len(rows) > 12 else table)
    return blocks
