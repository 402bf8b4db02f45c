"""Design over a whole rectangle of operating points by an exchange method: worst points are added."""

from __future__ import annotations

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.tuning.plants.plant_set import PlantSet
from gbid.control.tuning.search.global_search import Effort, Progress
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.search.step import SearchStep
from gbid.control.tuning.solving import solve
from gbid.lpv import Domain

TOLERANCE = 5e-5
_GRID = 33
_MOST_ROUNDS = 20


def add_worst_points(
    problem: GainProblem, found: LocalOptimum, plants: PlantSet, domain: Domain, progress: Progress | None
) -> tuple[LocalOptimum, GainProblem, tuple[SearchStep, ...], str]:
    """Return a design over the whole domain: find points that are worse, add them, optimise again.

    Parameters
    ----------
    problem : GainProblem
        Problem over the first points.
    found : LocalOptimum
        Its optimum.
    plants : PlantSet
        Loops at any operating points.
    domain : Domain
        Rectangle of operating points.
    progress : callable, optional
        Called with a `SearchStep` after each round.

    Returns
    -------
    LocalOptimum
        Final design.
    GainProblem
        Problem over all points.
    tuple of SearchStep
        History.
    str
        How the design was verified.
    """
    points = problem.families[0].points
    assert points is not None
    points = np.unique(points, axis=0)
    history: list[SearchStep] = []
    for _ in range(_MOST_ROUNDS):
        worse = _worse_points(problem, found, plants, domain)
        if not len(worse):
            break
        points = np.vstack([points, worse])
        problem.families = (plants.family(points),)
        problem.linear = plants.gain_limits(points)
        problem.cuts.clear()
        evaluated = problem.evaluations
        found, _ = solve(problem, found.x, Effort(), found=found)
        assert problem.evaluations > evaluated
        score = found.score
        history.append(SearchStep("points", problem.evaluations, problem.in_units(score.value), score.violation))
        if progress is not None:
            progress(history[-1])
    else:
        found = LocalOptimum(found.x, found.score, found.iterations, False)
    text = (
        f"eigenvalues and exact H-infinity norms of {len(problem.families[0])} loops; no point of the rectangle worse "
        f"by more than {TOLERANCE:g}, by a {_GRID} x {_GRID} grid with a zoom into its worst places"
    )
    return found, problem, tuple(history), text


def _worse_points(problem: GainProblem, found: LocalOptimum, plants: PlantSet, domain: Domain) -> FloatArray:
    """Return points at which the design is worse than at its own points, each refined to the worst nearby: (k, 2)."""
    axes = [np.linspace(low, high, _GRID if low < high else 1) for low, high in (domain.pressure_bar, domain.speed_rpm)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    step = np.array([axis[1] - axis[0] if len(axis) > 1 else 0.0 for axis in axes])
    tables = measure(problem, found.x, plants, grid.reshape(-1, 2)).reshape(-1, *grid.shape[:2])
    worse: list[FloatArray] = []
    for which, table in enumerate(tables):
        allowed = -found.score.value if which == 0 else max(found.score.violation, 0.0)
        padded = np.pad(table, 1, constant_values=-np.inf)
        top = table > allowed - 0.02
        for a, b in np.ndindex(3, 3):
            top &= table >= padded[a : a + table.shape[0], b : b + table.shape[1]]
        places = sorted(zip(*np.nonzero(top), strict=True), key=lambda place: -table[place])[:4]
        for place in places:
            point, value = _zoom(problem, found.x, plants, grid[place], step, domain, which)
            if value > allowed + TOLERANCE:
                worse.append(point)
    return np.unique(np.array(worse), axis=0) if worse else np.zeros((0, 2))


def measure(problem: GainProblem, x: FloatArray, plants: PlantSet, points: FloatArray) -> FloatArray:
    """Return measures of a design at points over all plants, larger is worse: minus objective, then limits (n, m)."""
    parts = []
    for block in np.array_split(points, max(1, len(points) // 128)):
        values = problem.by_loop(plants.family(block), x)
        parts.append(values.reshape(len(values), -1, len(block)).max(axis=1))
    return np.concatenate(parts, axis=1)


def _zoom(
    problem: GainProblem,
    x: FloatArray,
    plants: PlantSet,
    point: FloatArray,
    step: FloatArray,
    domain: Domain,
    which: int,
) -> tuple[FloatArray, float]:
    """Return the largest value of one measure near a point, by grids that shrink around the best."""
    low = np.array([domain.pressure_bar[0], domain.speed_rpm[0]])
    high = np.array([domain.pressure_bar[1], domain.speed_rpm[1]])
    offsets = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    value = -np.inf
    for _ in range(5):
        points = np.clip(point + offsets * step, low, high)
        values = measure(problem, x, plants, points)[which]
        if values.max() > value:
            point, value = points[values.argmax()], float(values.max())
        step = step / 3
    return point, value
