"""Choice of a run-out map: cross-validation of methods and sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief
from gbid.errors import DataError, UsageError
from gbid.prefilter.identify_runout import identify_runout
from gbid.prefilter.runout import RunoutMap
from gbid.prefilter.shaft import shaft_motion
from gbid.recording import Recording

HARMONICS = (1, 2, 3, 5, 7, 10, 15, 20)
BINS = (25, 50, 100, 200)


@dataclass(frozen=True, eq=False)
class RunoutTrial(Brief):
    """Cross-validation result of one method and size.

    Attributes
    ----------
    method : str
        ``"harmonics"``, ``"bins"``, or ``"mean"`` for a shaft at rest.
    size : int
        Number of harmonics or bins.
    residual_rms : (n_channels,) array
        Root mean square of the residuals over all validation parts [m]; NaN when no map could be made.
    fold_rms : (n_folds, n_channels) array
        Root mean square of the residuals on each validation part [m].
    chosen : bool
        Whether this trial is the recommended one.
    note : str
        Reason why no map could be made.
    """

    method: str
    size: int
    residual_rms: FloatArray
    fold_rms: FloatArray
    chosen: bool = False
    note: str = ""

    @property
    def n_parameters(self) -> int:
        """Number of parameters of the map for each channel, without the mean."""
        return 2 * self.size if self.method == "harmonics" else self.size


@dataclass(frozen=True, eq=False)
class RunoutComparison(Brief):
    """Trials of a cross-validation, and the map of the chosen trial.

    Attributes
    ----------
    trials : tuple of RunoutTrial
        In the requested order: harmonics by size, then bins by size.
    runout_map : RunoutMap
        Map of the chosen method and size, made from all recordings.
    held_out : tuple of str
        Validation parts: names of recordings, or sample ranges of the single recording, ``"name[0:6250]"``.
    """

    trials: tuple[RunoutTrial, ...]
    runout_map: RunoutMap
    held_out: tuple[str, ...]

    @property
    def chosen(self) -> RunoutTrial:
        """The recommended trial."""
        return next(trial for trial in self.trials if trial.chosen)

    def rows(self) -> list[dict[str, Any]]:
        """Return the trials as a table: method, size, residual_rms_<channel> [m], chosen, note."""
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
    """Return a cross-validation of run-out maps by harmonics and by angle bins, with the recommended one.

    With several recordings, each is the validation part once. A single recording is cut into `folds` stretches of equal
    length. Each map is made from the other parts and evaluated by the residuals on the validation part, about their own
    mean. Another recording starts at another shaft angle. But stretches of one recording visit the same angles when a
    turn is a whole number of samples. Then they cannot judge bins well, and a second recording is better.

    Among the maps that are not worse than the best by more than one standard error of the difference (of the mean
    squares, summed over the channels, over the validation parts), the map with the fewest parameters is chosen. A
    larger size fits noise, a smaller one leaves run-out.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        As for `identify_runout`: p and phi, piezos at rest, one operating point.
    harmonics : sequence of int
        Numbers of harmonics to try; may be empty.
    bins : sequence of int
        Numbers of bins to try; may be empty.
    folds : int
        Number of stretches of a single recording, at least 2.
    still : float
        Largest movement of the piezos, as for `identify_runout` [m].

    Returns
    -------
    RunoutComparison

    Raises
    ------
    UsageError
        When there is nothing to try, or when `folds` is below 2.
    DataError
        As for `identify_runout`; also when a validation part is shorter than two turns, or when no trial gives a map.
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
    size: dict[str, Any] = {best.method: best.size}
    return RunoutComparison(
        tuple(replace(trial, chosen=trial is best) for trial in trials),
        identify_runout(group, method=best.method, still=still, **size),
        tuple(rec.name for rec in parts),
    )


def _stretches(rec: Recording, folds: int) -> list[Recording]:
    """Return parts of equal length, each of two turns or more."""
    motion = shaft_motion(rec)
    if motion.turns and motion.turns < 2 * folds:
        raise DataError(
            f"recording {rec.name!r}: {motion.turns:.1f} turns are too few for {folds} stretches of two turns each; "
            "record longer or hold out fewer"
        )
    edges = np.linspace(0, rec.n_samples, folds + 1).astype(int)
    return [rec.slice(a, b, f"{rec.name}[{a}:{b}]") for a, b in pairwise(edges)]


def _tried(method: str, size: int, parts: list[Recording], still: float) -> RunoutTrial:
    """Return the trial of one method and size, with each part as validation part once."""
    n_channels = parts[0].signal("p").shape[1]
    rms = []
    sized: dict[str, Any] = {method: size}
    for i, held_out in enumerate(parts):
        others = [part for j, part in enumerate(parts) if j != i]
        try:
            made = identify_runout(others, method=method, still=still, **sized)
        except DataError as error:
            no_folds = np.full((0, n_channels), np.nan)
            return RunoutTrial(method, size, np.full(n_channels, np.nan), no_folds, note=str(error))
        rest = held_out.signal("p") - made.evaluate(shaft_motion(held_out).angle)
        rms.append(rest.std(axis=0))
    return _trial(method, size, np.array(rms))


def _trial(method: str, size: int, fold_rms: FloatArray, chosen: bool = False) -> RunoutTrial:
    return RunoutTrial(method, size, np.sqrt(np.mean(fold_rms**2, axis=0)), fold_rms, chosen)


def _simplest_of_the_best(trials: list[RunoutTrial]) -> RunoutTrial:
    """Return the simplest trial within one standard error of the best, on paired differences of the mean squares."""
    squares = [np.sum(trial.fold_rms**2, axis=1) for trial in trials]
    best = min(squares, key=lambda m: float(m.mean()))
    alike = []
    for trial, own in zip(trials, squares, strict=True):
        worse = own - best
        if worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)):
            alike.append((trial.n_parameters, float(own.mean()), trial))
    return min(alike, key=lambda entry: entry[:2])[2]
