"""Which run-out map to take: methods and sizes held against each other on data they were not made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.errors import DataError, UsageError
from gbid.prefilter.identify_runout import identify_runout
from gbid.prefilter.runout import RunoutMap
from gbid.prefilter.shaft import shaft_motion
from gbid.recording import Recording

HARMONICS = (1, 2, 3, 5, 7, 10, 15, 20)
BINS = (25, 50, 100, 200)


@dataclass(frozen=True, eq=False)
class RunoutTrial:
    """One method and size of a comparison.

    Attributes
    ----------
    method : str
        ``"harmonics"``, ``"bins"``, or ``"mean"`` for a shaft at rest.
    size : int
        Number of harmonics or bins.
    residual_rms : (n_channels,) array
        Root mean square left on the parts held out, over all of them [m]; NaN when no map could be made.
    fold_rms : (n_folds, n_channels) array
        The same on each part.
    chosen : bool
        Whether it is the one to take.
    note : str
        Why no map could be made.
    """

    method: str
    size: int
    residual_rms: FloatArray
    fold_rms: FloatArray
    chosen: bool = False
    note: str = ""

    @property
    def n_parameters(self) -> int:
        """Numbers that the map has for each channel, the mean aside."""
        return 2 * self.size if self.method == "harmonics" else self.size


@dataclass(frozen=True, eq=False)
class RunoutComparison:
    """Trials of a comparison and the map of the chosen one.

    Attributes
    ----------
    trials : tuple of RunoutTrial
        In the order asked for: harmonics by size, then bins by size.
    runout_map : RunoutMap
        Of the chosen method and size, made from all the recordings.
    held_out : tuple of str
        What was held out in turn: names of recordings, or stretches of the single one, ``"name[0:6250]"``.
    """

    trials: tuple[RunoutTrial, ...]
    runout_map: RunoutMap
    held_out: tuple[str, ...]

    @property
    def chosen(self) -> RunoutTrial:
        """The trial to take."""
        return next(trial for trial in self.trials if trial.chosen)

    def rows(self) -> list[dict[str, Any]]:
        """Trials as a table: method, size, residual_rms_<channel> [m], chosen, note."""
        return [
            {
                "method": trial.method,
                "size": trial.size,
                **{
                    f"residual_rms_{channel}": float(rms)
                    for channel, rms in zip(self.runout_map.channels, trial.residual_rms, strict=True)
                },
                "chosen": trial.chosen,
                "note": trial.note,
            }
            for trial in self.trials
        ]


def compare_runout(
    recordings: Recording | Sequence[Recording],
    *,
    harmonics: Sequence[int] = HARMONICS,
    bins: Sequence[int] = BINS,
    folds: int = 4,
    still: float = 0.5e-6,
) -> RunoutComparison:
    r"""Cross-validate run-out maps by harmonics and by angle bins, and choose one.

    Of several recordings each is held out in turn; of a single one, `folds` stretches of equal length. Each map is made
    from the rest, and judged by what it leaves of the part held out, whose own mean does not count. The part held out
    starts at another shaft angle when it is another recording; stretches of one recording at a speed that makes a turn
    a whole number of samples all visit the same angles, and then say little about bins: record twice.

    Of the maps that are not worse than the best by more than one standard error of the difference
    (of the mean squares, summed over the channels, over the parts held out), the one with the fewest numbers is chosen.
    A size more than needed fits noise, a size less leaves run-out.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        As for `identify_runout`: p and phi, piezos still, one operating point.
    harmonics : sequence of int
        Numbers of harmonics to try; may be empty.
    bins : sequence of int
        Numbers of bins to try; may be empty.
    folds : int
        Stretches of a single recording, at least 2.
    still : float
        As for `identify_runout` [m].

    Returns
    -------
    RunoutComparison

    Raises
    ------
    UsageError
        When there is nothing to try, or `folds` is below 2.
    DataError
        As for `identify_runout`; when a stretch held out is shorter than two turns; when no trial gives a map.
    """
    group = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if folds < 2:
        raise UsageError(f"folds = {folds}; give at least 2")
    wanted = [("harmonics", int(n)) for n in harmonics] + [("bins", int(n)) for n in bins]
    if not wanted:
        raise UsageError("nothing to compare: give numbers of harmonics or of bins")
    if not group:
        raise UsageError("no stationary recording given; the comparison needs at least one")
    parts = group if len(group) > 1 else _stretches(group[0], folds)
    if not any(shaft_motion(rec).turns for rec in group):
        only = identify_runout(group, still=still)
        rms = np.array([rec.signal("p").std(axis=0) for rec in parts])
        return RunoutComparison((_trial("mean", 1, rms, chosen=True),), only, tuple(rec.name for rec in parts))
    trials = [_tried(method, size, parts, still) for method, size in wanted]
    usable = [trial for trial in trials if not trial.note]
    if not usable:
        raise DataError(f"no run-out map can be made: {trials[0].note}")
    best = _simplest_of_the_best(usable)
    size = {best.method: best.size}
    return RunoutComparison(
        tuple(replace(trial, chosen=trial is best) for trial in trials),
        identify_runout(group, method=best.method, still=still, **size),
        tuple(rec.name for rec in parts),
    )


def _stretches(rec: Recording, folds: int) -> list[Recording]:
    """Parts of equal length, each of two turns or more."""
    motion = shaft_motion(rec)
    if motion.turns and motion.turns < 2 * folds:
        raise DataError(
            f"recording {rec.name!r}: {motion.turns:.1f} turns are too few for {folds} stretches of two turns each; "
            "record longer or hold out fewer"
        )
    edges = np.linspace(0, rec.n_samples, folds + 1).astype(int)
    return [rec.slice(a, b, f"{rec.name}[{a}:{b}]") for a, b in pairwise(edges)]


def _tried(method: str, size: int, parts: list[Recording], still: float) -> RunoutTrial:
    """Hold each part out once."""
    n_channels = parts[0].signal("p").shape[1]
    rms = []
    for i, held_out in enumerate(parts):
        others = [part for j, part in enumerate(parts) if j != i]
        try:
            made = identify_runout(others, method=method, still=still, **{method: size})
        except DataError as error:
            nothing = np.full((0, n_channels), np.nan)
            return RunoutTrial(method, size, np.full(n_channels, np.nan), nothing, note=str(error))
        rest = held_out.signal("p") - made.evaluate(shaft_motion(held_out).angle)
        rms.append(rest.std(axis=0))
    return _trial(method, size, np.array(rms))


def _trial(method: str, size: int, fold_rms: FloatArray, chosen: bool = False) -> RunoutTrial:
    return RunoutTrial(method, size, np.sqrt(np.mean(fold_rms**2, axis=0)), fold_rms, chosen)


def _simplest_of_the_best(trials: list[RunoutTrial]) -> RunoutTrial:
    """Rule of one standard error, on paired differences of the mean squares."""
    squares = [np.sum(trial.fold_rms**2, axis=1) for trial in trials]
    best = min(squares, key=lambda m: float(m.mean()))
    alike = []
    for trial, own in zip(trials, squares, strict=True):
        worse = own - best
        if worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)):
            alike.append((trial.n_parameters, float(own.mean()), trial))
    return min(alike, key=lambda entry: entry[:2])[2]
