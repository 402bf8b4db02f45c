"""The prefilter advises itself: harmonics by held-out data, what is left over, and suspects for coloured residuals."""

import re

import numpy as np
import pytest
from experiment_files import gbid as call
from experiment_files import printed_by
from own_files import BY_NAME, CLOCK, SIGNALS, columns_of, write_file
from study_rig import machine_at

import gbid
from gbid.prefilter import identify_runout
from gbid.prefilter.filtering import prefilter
from gbid.prefilter.runout import turns_per_second
from gbid.prefilter.runout_identification import leftover_words
from gbid.rig import Prbs, Stationary, record
from gbid.validate.residuals import shaft_lines

POINT = (5.0, 4000.0)
FITS = "prefilter: {{harmonics: {}}}\nfits: {{bearing: {{structure: rotor_bearing}}}}\n"


def recorded(what, name, order=13, size=60e-9):
    """A recording with one more harmonic of run-out in x."""
    conditions = dict(zip(("pressure_bar", "speed_rpm"), POINT, strict=True))
    rec = record(machine_at(*POINT), what, conditions=conditions, seed=4, name=name)
    p = rec.signal("p").copy()
    p[:, 0] += size * np.sqrt(2) * np.cos(order * np.unwrap(rec.signal("phi")[:, 0]))
    return rec.with_signals(p=p)


@pytest.fixture(scope="module")
def recordings():
    whats = {"still1": Stationary(0.6), "still2": Stationary(0.6), "prbs1": Prbs(1.0)}
    return [recorded(what, f"p5_n4000_{name}") for name, what in whats.items()]


def test_what_a_map_leaves_is_named_with_order_and_size(recordings):
    still = recordings[:2]
    words = leftover_words(identify_runout(still, harmonics=10), still)
    for rec, text in zip(still, words, strict=True):
        size = re.match(rf"{rec.name}: left over in p_x: (\d+) nm rms of order 13 ", text)
        assert 57 <= int(size[1]) <= 63  # 60 nm and noise
    assert all("866.7 Hz" in text and "harmonics: 13 or auto removes it" in text for text in words)
    assert leftover_words(identify_runout(still, harmonics=13), still) == ()
    odd = recorded(Stationary(0.6), "odd", order=0.5)
    assert "of order 0.50" in leftover_words(identify_runout(odd, harmonics=10), [odd])[0]
    assert "so no map removes it" in leftover_words(identify_runout(odd, harmonics=10), [odd])[0]


def test_lines_of_the_shaft_in_residuals(recordings):
    *still, prbs = recordings
    for harmonics, orders in ((10, [("p_x", 13)]), (13, [])):
        filtered, _ = prefilter(prbs, identify_runout(still, harmonics=harmonics))
        result = gbid.fit(gbid.RotorBearing(), filtered)
        lines = shaft_lines(result, filtered)
        assert [(line.output, line.order) for line in lines] == orders
        assert (result.trusted == "robust") == bool(orders)
        for line in lines:
            assert line.frequency_hz == pytest.approx(13 * turns_per_second(prbs))
            assert 30e-9 < line.rms < 90e-9
        assert shaft_lines(result, filtered.with_signals(phi=np.zeros((filtered.n_samples, 1)))) == []


@pytest.mark.parametrize(("harmonics", "advised"), [("10", True), ("auto", False)])
def test_an_experiment_says_so(recordings, harmonics, advised, tmp_path, capsys):
    (tmp_path / "data").mkdir()
    for rec in recordings:
        write_file(tmp_path / "data" / f"{rec.name}.npz", columns_of(rec))
    path = tmp_path / "own.yaml"
    text = BY_NAME.format(ending="npz", clock=CLOCK, signals=SIGNALS.rstrip())
    path.write_text(text + FITS.format(harmonics), encoding="utf-8")
    assert call("import", path, "--engine", "serial") == 0
    said = printed_by(capsys, "fit", path, "--engine", "serial").err
    result = gbid.load(tmp_path / "results" / "own" / "fits" / "bearing" / "p5_n4000_prbs1.h5")
    suspects = [note for note in result.notes if note.startswith("suspect")]
    assert bool(re.search(r"left over in p_x: \d+ nm rms of order 13", said)) == advised
    assert ("harmonics auto: harmonics, 15; rms residual on test data" in said) != advised
    assert len(suspects) == advised
    if advised:
        assert "p_x has a line of" in suspects[0]
        assert "at 866.7 Hz, order 13 of the shaft; the prefilter removes 10 harmonics" in suspects[0]
