"""Time stamps in text files, such as ``28.11.2026 10:00:00,0002`` or ``11:59:59.5 PM``, as seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date

import numpy as np

from gbid.core.arrays import FloatArray

_STAMP = re.compile(
    r"(?:(?P<date>\d{4}[-/]\d\d?[-/]\d\d?|\d\d?(?P<sign>[-/.])(?:\d\d?|[a-z]{3})(?P=sign)(?:\d{4}|\d\d))(?:T|,?\s+))?"
    r"(?P<hour>[01]?\d|2[0-3]):(?P<minute>[0-5]\d):(?P<second>[0-5]\d)(?:[.,](?P<part>\d{1,9}))?"
    r"(?:\s*(?P<half>[ap])\.?\s?m\.?)?(?P<zone>Z|[-+]\d\d:?\d\d)?",
    re.IGNORECASE,
)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")

_DAY_NS, _PAUSE_NS = 86400 * 10**9, 60 * 10**9
_ORDERS = ("dmy", "mdy", "ymd")  # of day, month and year in a date


class StampError(Exception):
    """Error raised when a column of time stamps cannot be read; `row` is the index of the cell."""

    def __init__(self, row: int, text: str) -> None:
        super().__init__(text)
        self.row = row


def is_stamp(cell: str) -> bool:
    """Return whether a cell is a time of day, alone or after a date."""
    return bool(_STAMP.fullmatch(cell.strip()))


def date_of(cell: str) -> str:
    """Return the text of the date in a time stamp; empty without a date, and for other cells."""
    return _parts(cell.strip())[1]


def times_of_day(column: Sequence[str]) -> FloatArray:
    """Return time stamps in seconds since the midnight before the first one.

    Raises
    ------
    StampError
        When a cell is no stamp of the form of the first one, or when the order of day and month decides.
    """
    stamps = [_parts(cell.strip()) for cell in column]
    orders: dict[str, dict[str, int]] = {order: {} for order in _ORDERS}  # days by date
    for k, (form, date_text, _) in enumerate(stamps):
        for order, days in list(orders.items()):
            if date_text not in days and (day := _day_of(date_text, order)) is None:
                del orders[order]
            elif date_text not in days:
                days[date_text] = day or 0
        if not form or form != stamps[0][0] or not orders:
            of = f" of the form of {column[0]!r} in the first row" if form and k else ""
            raise StampError(k, f"{column[k]!r} is no time stamp{of}")
    first = stamps[0][1]
    offsets = {tuple(day - days[first] for day in days.values()): days for days in orders.values()}
    read = [
        np.array([_DAY_NS * (days[date_text] - days[first]) + time for _, date_text, time in stamps])
        for days in offsets.values()
    ]
    if len(read) > 1:  # at midnight one order goes on, and the other one leaves out days
        read = [each for each in read if np.abs(np.diff(each)).max() < _PAUSE_NS]
    if len(read) != 1:
        text = f"{column[0]!r} may begin with the day or the month, and the date changes within the file; write dates"
        raise StampError(0, f"{text} as 2026-11-22, or leave time out and give sample_time_s")
    times = read[0]
    if not first:  # without a date, a time of day that starts anew is that of the next day
        times += _DAY_NS * np.cumsum(np.diff(times, prepend=times[0]) < -_DAY_NS // 2)
    return times * 1e-9


def _parts(cell: str) -> tuple[str, str, int]:
    """Return a time stamp's form (empty for other cells), date, and time of day in nanoseconds."""
    match = _STAMP.fullmatch(cell)
    if match is None:
        return "", "", 0
    hour, half = int(match["hour"]), (match["half"] or "").lower()
    if half and not 1 <= hour <= 12:
        return "", "", 0
    hour = hour % 12 + 12 * (half == "p") if half else hour
    second = 60 * (60 * hour + int(match["minute"])) + int(match["second"])
    if (zone := match["zone"] or "Z").upper() != "Z":
        second -= int(f"{zone[0]}60") * (60 * int(zone[1:3]) + int(zone[-2:]))
    form = f"{re.sub(r'[^-/.]+', '0', match['date'] or '')} {'m' * bool(half)} {'zone' * bool(match['zone'])}"
    return form, match["date"] or "", 10**9 * second + int((match["part"] or "").ljust(9, "0"))


def _day_of(text: str, order: str) -> int | None:
    """Return the day number of a date with parts in a given order; None if the order does not fit."""
    if not text:
        return 0
    parts = re.split("[-/.]", text.lower())
    if (len(parts[0]) == 4 and order != "ymd") or (len(parts[2]) == 4 and order == "ymd"):
        return None
    if order != "dmy" and ("." in text or parts[1].isalpha()):
        return None
    if parts[1].isalpha():
        parts[1] = str(_MONTHS.index(parts[1]) + 1) if parts[1] in _MONTHS else "0"
    numbers = dict(zip(order, map(int, parts), strict=True))
    try:
        return date(numbers["y"] + 2000 * (numbers["y"] < 100), numbers["m"], numbers["d"]).toordinal()
    except ValueError:
        return None
