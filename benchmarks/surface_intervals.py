"""Whether standard deviations of surfaces are right at every operating point, over many campaigns without recordings.

The estimates are drawn: the machines as the rig draws them, with errors of the fits of a tenth of a percent. Each
campaign has three covariances of its coefficients: that of the model, with one scatter for all points; that of the
residuals (HC3); and the one of `gbid.fit_lpv`, which tempers the residuals with the model. ``alike``: the scatter is
normal and the same at all points, so that the model is right.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

import gbid
from gbid.core.arrays import FloatArray
from gbid.lpv.estimates import Order, chosen_exponents, orthonormal
from gbid.lpv.regression import kron_designs, sandwich, tempered_sandwich, with_scatter
from gbid.rig import RotorBearingTruth, Scatter, scattered
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduling import monomials

CAMPAIGNS = 200
POINTS = [(float(p), n) for p in range(3, 8) for n in (0.0, 4000.0, 6000.0)]
CORNERS = [(3.0, 0.0), (3.0, 6000.0), (7.0, 0.0), (7.0, 6000.0)]
_WAYS = ("model", "HC3", "fit_lpv")
_GRID = 300


class Plan(NamedTuple):
    """Operating point of each recording, terms of the surfaces, and whether all points scatter alike."""

    points: Sequence[tuple[float, float]]
    order: Sequence[str] | int
    alike: bool = False


PLANS = {
    "86 recordings, 15 points": Plan([p for i, p in enumerate(POINTS) for _ in range(6 if i < 11 else 5)], 2),
    "the same, alike": Plan([p for i, p in enumerate(POINTS) for _ in range(6 if i < 11 else 5)], 2, True),
    "2 at each of 15": Plan([p for p in POINTS for _ in range(2)], 2),
    "the same 30, alike": Plan([p for p in POINTS for _ in range(2)], 2, True),
    "1 at each of 15": Plan(POINTS, 2),
    "2 at each of 4, 3 terms": Plan([p for p in CORNERS for _ in range(2)], 1),
    "2 at each of 4, 4 terms": Plan([p for p in CORNERS for _ in range(2)], ("1", "P", "Omega", "Omega P")),
}


def deviations(points: FloatArray, alike: bool, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield the deviations of the machines of campaigns from their surfaces, (n, 14)."""
    truth, scatter = gbid.load_model("theisen2016"), Scatter(share=0.35)
    known = [{key: float(v) for key, v in truth.key_parameters(*point).items()} for point in points]
    machines = [RotorBearingTruth.from_parameters(parameters) for parameters in known]
    mean = np.array([[parameters[key] for key in KEY_PARAMETERS] for parameters in known])

    def drawn() -> FloatArray:
        parameters = [scattered(machine, scatter, rng)[0].key_parameters() for machine in machines]
        return np.array([[one[key] for key in KEY_PARAMETERS] for one in parameters]) - mean

    if not alike:
        while True:
            yield drawn()
    every = np.concatenate([drawn() for _ in range(20)])
    size = every.std(axis=0)
    root = np.linalg.cholesky(np.cov((every / size).T)) * size[:, None]
    while True:
        yield rng.normal(size=mean.shape) @ root.T


def errors(plan: Plan, campaigns: int, seed: int = 1) -> FloatArray:
    """Return errors over standard deviations: ways, campaigns, places (those of the recordings first), parameters."""
    rng, points, k = np.random.default_rng(seed), np.array(plan.points), len(KEY_PARAMETERS)
    order: Order = plan.order
    exponents = chosen_exponents(order)
    design = orthonormal(points, exponents)
    X, m = kron_designs(design.columns, k), len(exponents)
    inside = rng.uniform(points.min(axis=0), points.max(axis=0), (_GRID, 2))
    terms = monomials(np.concatenate([np.unique(points, axis=0), inside]), exponents) @ design.back
    size = np.mean([np.abs(v) for v in gbid.load_model("theisen2016").key_parameters(*points.T).values()], axis=1)
    own = np.broadcast_to(1e-6 * np.eye(k), (len(points), k, k))
    results: list[list[FloatArray]] = []
    for _, off in zip(range(campaigns), deviations(points, plan.alike, rng), strict=False):
        y = off / size + 1e-3 * rng.normal(size=off.shape)
        mixed = with_scatter(y, X, own)
        V = own + mixed.scatter
        covariances = (
            mixed.covariance,
            sandwich(y, X, V, mixed.coefficients),
            tempered_sandwich(y, X, V, mixed.coefficients)[0],
        )
        error = terms @ mixed.coefficients.reshape(k, m).T
        blocks = [c.reshape(k, m, k, m)[np.arange(k), :, np.arange(k)] for c in covariances]
        results.append([error / np.sqrt(np.einsum("gi,kij,gj->gk", terms, b, terms, optimize=True)) for b in blocks])
    return np.array(results).swapaxes(0, 1)


def main() -> None:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=CAMPAIGNS)
    campaigns = parser.parse_args().campaigns
    print("| campaign | covariance | within 1.96 std: mean, worst surface | within 3 std | rms(error/std) at places |")
    print("|---|---|---|---|---|")
    for name, plan in PLANS.items():
        for way, z in zip(_WAYS, np.abs(errors(plan, campaigns)), strict=True):
            near, far = (100 * (z < limit).mean(axis=(0, 1)) for limit in (1.96, 3))
            rms = np.sqrt(np.mean(z**2, axis=0))
            print(
                f"| {name} | {way} | {near.mean():.1f}, {near.min():.1f} % | {far.mean():.2f}, {far.min():.2f} % | "
                f"{rms.min():.2f} to {rms.max():.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
