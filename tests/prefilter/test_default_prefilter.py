"""The default of the prefilter: spikes are found, replaced and named; every other sample stays as it is."""

from dataclasses import fields, replace

import numpy as np
import pytest
from study_rig import machine_at, truth_at

import gbid
from gbid import load, save
from gbid.core import hdf5
from gbid.core.errors import DataError
from gbid.prefilter import identify_runout, prefilter
from gbid.prefilter.filtering import PrefilterFile, PrefilterReport, correction_rows
from gbid.prefilter.runout import shaft_motion
from gbid.rig import Faults, Prbs, Stationary, record

POINT = (5.0, 6000.0)
CONDITIONS = {"pressure_bar": POINT[0], "speed_rpm": POINT[1]}


def rig(seed, duration_s=2.0, **faults):
    return record(
        machine_at(*POINT), Prbs(duration_s), conditions=CONDITIONS, seed=seed, name="run", faults=Faults(**faults)
    )


@pytest.fixture(scope="module")
def runout():
    return identify_runout(record(machine_at(*POINT), Stationary(2.0), conditions=CONDITIONS, seed=9, name="still"))


def wrong_samples(clean, spiked):
    return tuple(tuple(np.flatnonzero(column)) for column in (spiked.signal("p") - clean.signal("p")).T)


def test_clean_data_keep_every_bit_but_map_and_means(runout):
    for seed in range(3):
        raw = rig(seed)
        filtered, report = prefilter(raw, runout)
        without = raw.signal("p") - runout.evaluate(shaft_motion(raw).angle)
        np.testing.assert_array_equal(filtered.signal("p"), without - without.mean(axis=0))
        assert (report.spikes, report.spike_samples, report.median) == ((0, 0), ((), ()), 1)
        assert "spike" not in filtered.provenance["prefilter"]


@pytest.mark.parametrize("size", [1e-6, 20e-6])
def test_spikes_are_named_and_fits_are_those_of_clean_data(runout, size):
    clean, spiked = rig(1), rig(1, spikes_per_s=5.0, spike_size_m=size)
    filtered, report = prefilter(spiked, runout)
    assert report.spike_samples == wrong_samples(clean, spiked)
    assert report.spikes == tuple(map(len, report.spike_samples))
    assert min(report.spikes) > 2
    assert f"{sum(report.spikes)} spikes of p replaced" in filtered.provenance["prefilter"]

    ours, theirs = (gbid.fit(gbid.RotorBearing(), prefilter(rec, runout)[0]) for rec in (spiked, clean))
    for name in theirs.free:
        assert abs(ours.parameters[name] - theirs.parameters[name]) < 0.3 * theirs.std[name]
        assert ours.std[name] == pytest.approx(theirs.std[name], rel=0.03)
    left = gbid.fit(gbid.RotorBearing(), prefilter(spiked, runout, spikes=False)[0])
    assert left.loss > 2 * ours.loss


def test_spikes_that_are_left_are_reported_and_noted(runout):
    clean, spiked = rig(2), rig(2, spikes_per_s=5.0)
    filtered, report = prefilter(spiked, runout, spikes=False)
    assert report.spike_samples == wrong_samples(clean, spiked)
    assert (
        f"{sum(report.spikes)} spikes of p were found and not replaced; spikes: true replaces them [GB203]"
        in report.notes
    )
    np.testing.assert_allclose(np.abs(filtered.signal("p")[report.spike_samples[0], 0]), 20e-6, atol=10e-6)
    by_median, report = prefilter(spiked, runout, spikes=False, median=3)  # the paper's way takes them out
    assert report.notes == ()
    assert np.abs(by_median.signal("p")).max() < 15e-6


def test_places_are_stored_and_shown(runout, tmp_path):
    report = prefilter(rig(3, spikes_per_s=40.0), runout)[1]
    assert max(report.spikes) > 10
    path = tmp_path / "prefilter.h5"
    save(PrefilterFile(runout, (report, replace(report, spike_samples=()))), path)
    loaded, old = load(path, PrefilterFile).reports
    for field in fields(PrefilterReport):
        np.testing.assert_equal(getattr(loaded, field.name), getattr(report, field.name))
    assert (old.spikes, old.spike_samples) == (report.spikes, ())  # spikes were not sought
    for i, row in enumerate(correction_rows([loaded])):
        assert (row["spikes"], row["first_spikes"]) == (report.spikes[i], list(report.spike_samples[i][:10]))
    assert [row["first_spikes"] for row in correction_rows([old])] == [[], []]
    with hdf5.changing(path) as file:
        del file["reports/0000/spike_samples"]
        file["reports/0000/spike_samples"] = [1, 2]
    with pytest.raises(DataError, match=r"spike_samples has shape \(2,\), expected"):
        load(path, PrefilterFile)


@pytest.mark.slow
def test_intervals_keep_their_coverage_with_spikes_replaced_and_lose_it_with_the_median():
    """Forty recordings of 5 s at rest, joint fits with exact delays; the figures stand in docs/prefilter.md."""
    point = (6.0, 0.0)
    truth, machine = truth_at(*point), machine_at(*point)
    structure = gbid.Plant(gbid.RotorBearing(delay="exact"))
    ways = {"default": {}, "median": {"spikes": False, "median": 3}}
    inside = {(spikes, way): [] for spikes in (0.0, 4.0) for way in ways}
    for seed in range(40):
        for spikes, way in inside:
            conditions = {"pressure_bar": point[0], "speed_rpm": point[1]}
            faults = Faults(spikes_per_s=spikes, spike_size_m=2e-6)
            raw = record(machine, Prbs(5.0), conditions=conditions, seed=seed, name="run", faults=faults)
            result = gbid.fit(structure, prefilter(raw, **ways[way])[0], trend="offset")
            errors = [(result.parameters[name] - true) / result.std[name] for name, true in truth.items()]
            inside[spikes, way].append(np.abs(errors) < 1.96)
    coverage = {key: np.mean(hits, axis=0) for key, hits in inside.items()}
    for (spikes, way), values in coverage.items():
        each = ", ".join(f"{name} {100 * value:.0f}" for name, value in zip(truth, values, strict=True))
        print(f"{spikes:g} spikes/s, {way}: {100 * values.mean():.1f} % of all, {each}")  # noqa: T201
    for spikes in (0.0, 4.0):
        assert 0.92 < coverage[spikes, "default"].mean() < 0.98
        assert coverage[spikes, "default"].min() > 0.8
        assert coverage[spikes, "median"].mean() < 0.75
