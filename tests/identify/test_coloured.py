"""Fits whose errors are coloured: they converge, and a gain of full height takes the bias of a shaken rotor away."""

from dataclasses import replace

import numpy as np
import pytest
from shaken_rig import TRUE, shaken

import gbid
from gbid.core.errors import UsageError
from gbid.identify.data import gather
from gbid.identify.options import FitArguments
from gbid.identify.pose import FOUND, SUSPECTED, lower_elsewhere
from gbid.identify.problem.assemble import assemble, build_problem
from gbid.identify.problem.hessian import ExactHessian, in_one_window, in_windows
from gbid.rig import FilmStiffening, ProcessNoise
from gbid.structure import evaluate


@pytest.fixture(scope="module")
def fits():
    noisy = shaken(process_noise=ProcessNoise(0.01))
    return {
        gain: gbid.fit(gbid.RotorBearing(delay="exact", disturbance_gain=gain), noisy) for gain in ("full", "states")
    }


def off(result):
    """Distance from the truth in standard deviations."""
    return np.array([(result.parameters[name] - TRUE[name]) / result.std[name] for name in TRUE])


@pytest.mark.parametrize(
    "effect",
    [
        {"process_noise": ProcessNoise(0.003)},
        {"stiffening": FilmStiffening()},
    ],
    ids=["noise", "stiffening"],
)
def test_coloured_errors_converge_at_the_first_window_to_a_minimum(effect):
    recording = shaken(seconds=2.5, **effect)
    structure = gbid.RotorBearing()
    result = gbid.fit(structure, recording)
    assert result.success
    assert not any("did not converge" in note for note in result.notes)
    # From elsewhere, and with other windows, the same minimum.
    start = {"k_xx": 1.01 * result.parameters["k_xx"], "bd_yy": 0.9 * result.parameters["bd_yy"]}
    again = gbid.fit(structure, recording, start=start, window=100)
    assert again.loss == pytest.approx(result.loss, rel=1e-5)


def test_of_several_minima_along_the_gain_the_lower_is_found():
    """A film and little noise of the sensors: from the data's start the nearest minimum is twice as high."""
    recording, structure = shaken(0, stiffening=FilmStiffening()), gbid.RotorBearing(pade_order=1)
    result = gbid.fit(structure, recording, criterion="trace")
    assert result.success
    assert result.loss < 1.1e-13
    assert FOUND in result.notes
    start = {name: result.parameters[name] for name in result.free}
    gain = {"bd_xx": -306957.0, "bd_xy": 49399.0, "bd_yx": 43952.0, "bd_yy": 35056.0}
    held = gbid.fit(structure, recording, start={**start, **gain}, fixed=gain, criterion="trace")
    assert 2.3e-13 < held.loss < 2.4e-13  # the other minimum, which is one with its gain held, too
    assert held.iterations < result.iterations
    assert FOUND not in held.notes


def test_the_paper_gain_is_biased_by_process_noise_and_the_full_height_is_not(fits):
    assert fits["full"].success
    assert fits["states"].success
    missed = np.array([fits["full"].parameters[name] - TRUE[name] for name in TRUE])
    sure = np.array([fits["states"].std[name] for name in TRUE])
    assert np.abs(missed / sure).max() > 6
    assert np.abs(off(fits["states"])).max() < 3
    assert fits["states"].loss < 0.1 * fits["full"].loss


@pytest.mark.parametrize("delay", ["pade", "exact"])
def test_full_height_fills_the_positions_rows(delay):
    structure = gbid.RotorBearing(delay=delay, disturbance_gain="states")
    names = [q.name for q in structure.parameters][14:]
    values = {**TRUE, **{name: float(i + 1) for i, name in enumerate(names)}}
    K = evaluate(structure, values).K
    expected = np.zeros((len(K), 2))
    expected[:4] = np.arange(1.0, 9.0).reshape(4, 2)
    np.testing.assert_array_equal(K, expected)
    assert {q.name: q.unit for q in structure.parameters}["bp_xy"] == "1/s"


def test_an_unknown_gain_is_refused():
    with pytest.raises(UsageError, match="'states'"):
        gbid.RotorBearing(disturbance_gain="all")


@pytest.fixture(scope="module")
def problem():
    """Two records of which one has samples left out, in windows of 100 samples, with a gain that is not zero."""
    recordings = [shaken(seed, seconds=0.5, process_noise=ProcessNoise(0.01)) for seed in (3, 4)]
    structure = gbid.RotorBearing()
    begin = {**TRUE, "bd_xx": 2e4, "bd_xy": -3e3, "bd_yx": 5e3, "bd_yy": 1e4}
    data = gather(recordings, ("u",), ("p",), minimum=50)
    options = FitArguments(criterion="trace", left_out={"run-4": [(700, 900)]}, window=100)
    return build_problem(assemble(structure, structure.parameters, begin, data, options), data, options, begin)


def test_windows_joined_and_cut_again_are_the_same_problem(problem):
    cut_up, unknowns = problem
    joined, kept = in_one_window(cut_up)
    assert joined.n_windows == 4  # one record whole, one in three pieces: before, within and after what is left out
    assert len(joined.links) == 2
    point = unknowns[kept]
    again = in_windows(cut_up, joined, point)
    np.testing.assert_allclose(again[kept], point, rtol=1e-12)
    complete, parts = joined.at(point), cut_up.at(again)
    assert parts.cost == pytest.approx(complete.cost, rel=1e-12)
    between = np.isin(cut_up.links[:, 1], (kept[cut_up.n_theta :: cut_up.n_states] - cut_up.n_theta) // cut_up.n_states)
    gaps = parts.gaps.reshape(-1, cut_up.n_states)
    np.testing.assert_allclose(gaps[~between], 0, atol=1e-9)  # within pieces they are closed
    np.testing.assert_allclose(gaps[between].ravel(), complete.gaps, atol=1e-9)


def test_no_other_gain_is_sought_where_errors_are_white_or_gains_are_known(problem):
    cut_up, unknowns = problem
    cut_up = replace(cut_up, box=(np.full(len(unknowns), -np.inf), np.full(len(unknowns), np.inf)))
    assert lower_elsewhere(cut_up, unknowns) is not None  # far from a minimum something is lower
    gains = list(cut_up.noise)
    held = tuple(edge.copy() for edge in cut_up.box)
    held[0][gains] = held[1][gains] = unknowns[gains]
    assert lower_elsewhere(replace(cut_up, box=held), unknowns) is None
    known = cut_up.prior._replace(information=np.where(np.isin(np.arange(cut_up.n_theta), gains), 1.0, 0.0))
    assert lower_elsewhere(replace(cut_up, prior=known), unknowns) is None
    quiet = gbid.fit(gbid.RotorBearing(), shaken(seconds=1.0))
    assert FOUND not in quiet.notes
    assert SUSPECTED not in quiet.notes


def test_small_steps_of_a_wrong_hessian_are_not_taken_for_the_minimum(monkeypatch):
    right = ExactHessian.__call__

    def wrong(self, unknowns, lam_f, lam_gaps):
        return 1e10 * right(self, unknowns, lam_f, lam_gaps)

    monkeypatch.setattr(ExactHessian, "__call__", wrong)
    result = gbid.fit(gbid.RotorBearing(), shaken(seconds=2.0, process_noise=ProcessNoise(0.003)), window=391)
    assert not result.success
    assert "steps became too small" in result.status
