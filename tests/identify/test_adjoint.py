"""The gradient by the adjoint against the one that comes with sensitivities, and the scan against a loop."""

import shutil

import numpy as np
import pytest
from fit_cases import KEY, TS, levels, smooth

import gbid
from gbid.identify.data import gather
from gbid.identify.kernel.sweep import scan
from gbid.identify.nlp.adjoint import lagrangian_gradient
from gbid.identify.nlp.assembly import assemble
from gbid.identify.nlp.hessian import entries_of, noise_columns
from gbid.identify.nlp.nlp_problem import build_problem
from gbid.identify.nlp.one_window import in_one_window

BEGIN = {**KEY, "bd_xx": 2e4, "bd_xy": -3e3, "bd_yx": 5e3, "bd_yy": 1e4}


def recording(name, n, seed):
    u = 4e-6 * levels(n, 2, seed=seed)
    p = 1e-6 * smooth(n, 2, seed=seed + 50)  # no answer to u: the errors are as large as can be
    channels = {"u": ("x", "y"), "p": ("x", "y")}
    return gbid.Recording({"u": u, "p": p}, TS, name=name, units={"u": "m", "p": "m"}, channels=channels)


def problem(engine="numpy", criterion="trace", **options):
    recordings = [recording("a", 900, 1), recording("b", 1300, 2)]
    structure = gbid.RotorBearing()
    data = gather(recordings, ("u",), ("p",), minimum=50)
    settings = {"offsets": False, "local": {}, "left_out": {"b": [(700, 900)]}, "window": 100, **options}
    assembly = assemble(
        structure,
        structure.parameters,
        BEGIN,
        data,
        intersample="foh",
        focus="prediction",
        horizon=1,
        engine=engine,
        **settings,
    )
    begin = {q.name: BEGIN.get(q.name.partition("[")[0], 1e-7) for q in assembly.free}
    return build_problem(assembly, data, criterion, [1.0, 2.0], begin, {"k_xx": (-6e5, 1e3)}, scaling=True)


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"criterion": "det"},
        {"window": 600},
        {"left_out": {}, "local": {"tau_x": "recording"}, "offsets": True},
    ],
    ids=["windows", "det", "long windows", "local and offsets"],
)
@pytest.mark.parametrize("joined", [False, True], ids=["cut", "joined"])
def test_the_adjoint_gives_the_gradient_of_the_pass(engine, options, joined):
    if engine == "compiled" and not shutil.which("cc"):
        pytest.skip("no C compiler on this machine")
    shooting, unknowns = problem(engine, **options)
    if joined:
        shooting, kept = in_one_window(shooting)
        unknowns = unknowns[kept]
    lam = np.random.default_rng(4).normal(size=shooting.n_gaps)
    expected = shooting.lagrangian_gradient(shooting.at(unknowns), 1.0, lam)
    assert np.isfinite(expected).all()
    found = lagrangian_gradient(shooting, unknowns, lam)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-11 * np.abs(expected).max())


def test_the_adjoint_has_no_value_where_the_pass_has_none():
    shooting, unknowns = problem()
    lam = np.zeros(shooting.n_gaps)
    assert shooting.stable_only
    unstable = unknowns.copy()
    unstable[list(shooting.noise)] = 1e4
    assert np.isnan(shooting.at(unstable).cost)
    assert np.isnan(lagrangian_gradient(shooting, unstable, lam)).all()


@pytest.mark.parametrize("steps", [1, 2, 3, 8, 49])
def test_the_scan_is_the_loop(steps):
    random = np.random.default_rng(steps)
    transition = 0.3 * random.normal(size=(3, 3))
    values = random.normal(size=(3, 4, steps, 2))
    expected = values.copy()
    for i in range(1, steps):
        expected[:, :, i] += np.einsum("ij,jwm->iwm", transition, expected[:, :, i - 1])
    np.testing.assert_allclose(scan(transition, values), expected, rtol=1e-12, atol=1e-12)


GAINS = ("bd_xx", "bd_xy", "bd_yx", "bd_yy")


@pytest.mark.parametrize("joined", [False, True], ids=["cut", "joined"])
@pytest.mark.parametrize(
    "local", [{}, dict.fromkeys(GAINS, "recording"), {"bd_xx": "recording"}], ids=["shared", "local", "one of four"]
)
def test_columns_for_gains_are_second_derivatives(local, joined):
    """Against differences of the pass's own gradient, and what the logarithm adds where parts share passes."""
    shooting, unknowns = problem(local=local)
    if joined:
        shooting, kept = in_one_window(shooting)
        unknowns = unknowns[kept]
    lam = np.random.default_rng(4).normal(size=shooting.n_gaps)
    noise = shooting.noise
    assert len(noise) == 4 + len(local)
    pattern = shooting.hessian_pattern
    found = shooting.at(unknowns).hessian + entries_of(shooting, noise_columns(shooting, unknowns, lam))

    def gradient(x, multipliers):
        return shooting.lagrangian_gradient(shooting.at(x), 1.0, multipliers)

    theta, _ = shooting.unpack(unknowns)
    known = shooting.prior.information / shooting.likelihood_size * (theta - shooting.prior.mean) * shooting.theta_scale
    slope = gradient(unknowns, 0 * lam)
    slope[: shooting.n_theta] -= known
    for j in noise:
        ahead, behind = unknowns.copy(), unknowns.copy()
        ahead[j] += 1e-6
        behind[j] -= 1e-6
        column = (gradient(ahead, lam) - gradient(behind, lam)) / 2e-6
        if local:
            column += 2 * slope * slope[j]
        for own, other in ((pattern.columns, pattern.rows), (pattern.rows, pattern.columns)):
            places = np.flatnonzero(own == j)
            places = places[~np.isin(other[places], noise)]  # two gains meet in two columns; the last counts
            assert len(places) > 3
            off = np.abs(found[places] - column[other[places]])
            assert off.max() < 1e-3 * np.abs(column).max()
