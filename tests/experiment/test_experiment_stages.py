import csv
import inspect
from dataclasses import replace

import numpy as np
import pytest
from experiment_files import SPRING, copy_results, write_quick, write_spring, write_spring_data
from places import EXPERIMENTS
from places import MEASURED as SHARED

from gbid import load
from gbid.core.errors import DataError, UsageError
from gbid.experiment.fields import content_key
from gbid.experiment.load import load_experiment
from gbid.experiment.machine import true_model, true_values
from gbid.experiment.run import Job, run_stage
from gbid.experiment.stages.crossval import CROSSVAL, crossval_rows
from gbid.experiment.stages.fit import FIT, fit_arguments, load_made_fit, samples_of
from gbid.experiment.stages.importing import IMPORT
from gbid.experiment.stages.prefilter import PREFILTER
from gbid.experiment.stages.rig import RIG
from gbid.experiment.structures import make_structure
from gbid.identify import fit
from gbid.lpv import load_model
from gbid.prefilter.filtering import PrefilterFile
from gbid.recording import Recording, load_recording


class Log:
    def __init__(self):
        self.begun, self.ended, self.iterations = [], [], 0

    def expect(self, stage, todo, there, failed):
        pass

    def begin(self, item):
        self.begun.append((item.stage, str(item)))

    def iteration(self, progress):
        self.iterations += 1

    def end(self, outcome):
        self.ended.append((outcome.item.stage, str(outcome.item), outcome.state))


SUMMARIES = ("bearing_summary.csv", "bearing_summary.h5")


def all_stages(job):
    outcomes = []
    for stage in (RIG, IMPORT, PREFILTER, FIT, CROSSVAL):
        outcomes += run_stage(job, stage)
    return outcomes, crossval_rows(job)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The quick experiment with all its results."""
    folder = tmp_path_factory.mktemp("quick")
    log = Log()
    job = Job(load_experiment(write_quick(folder)), reporter=log)
    outcomes, rows = all_stages(job)
    return folder, job, outcomes, rows, log


@pytest.fixture
def again(made, tmp_path):
    """A copy of these results, to be run again."""
    copy_results(made[0], tmp_path / "copy")
    return tmp_path / "copy"


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_results_tree(made):
    folder, _, outcomes, _, log = made
    assert {o.state for o in outcomes} == {"made"}
    assert all(o.converged for o in outcomes)
    assert sorted(tree(folder / "results" / "quick")) == [
        "crossval/bearing.csv",
        "crossval/bearing_summary.csv",
        "crossval/bearing_summary.h5",
        "fits/bearing/p5_n6000_prbs1.h5",
        "fits/bearing/p5_n6000_prbs2.h5",
        "fits/piezos/p5_n6000_prbs1.h5",
        "fits/piezos/p5_n6000_prbs2.h5",
        "prefilter/p5_n6000.h5",
        "prefiltered/p5_n6000_prbs1.h5",
        "prefiltered/p5_n6000_prbs2.h5",
        "recordings/p5_n6000_prbs1.h5",
        "recordings/p5_n6000_prbs2.h5",
        "recordings/p5_n6000_still1.h5",
    ]
    assert log.iterations > 4
    assert len(log.begun) == len(log.ended) == len(outcomes)


def test_recordings_are_those_of_the_yaml(made):
    folder = made[0] / "results" / "quick"
    raw = load_recording(folder / "recordings" / "p5_n6000_prbs1.h5")
    assert raw.n_samples == 5000
    assert dict(raw.conditions) == {"pressure_bar": 5.0, "speed_rpm": 6000.0}
    assert set(np.unique(raw.signal("r"))) == {-4.5e-6, 4.5e-6}
    stored = load(folder / "prefilter" / "p5_n6000.h5", PrefilterFile)
    runout_map, reports = stored.runout_map, stored.reports
    assert len(runout_map.orders) == 6
    assert [report.name for report in reports] == ["p5_n6000_prbs1", "p5_n6000_prbs2"]
    filtered = load_recording(folder / "prefiltered" / "p5_n6000_prbs1.h5")
    assert np.abs(filtered.signal("p").mean(axis=0)).max() < 5e-8
    assert np.ptp(raw.signal("p")) > np.ptp(filtered.signal("p"))


def test_fits_find_the_truth_of_the_rig(made):
    job = made[1]
    result, structure = load_made_fit(job, "bearing", "p5_n6000_prbs1"), make_structure(job.experiment, "bearing")
    truth = true_values(job.experiment, result.recordings, structure)
    assert truth == {k: float(v) for k, v in load_model("theisen2016").key_parameters(5.0, 6000.0).items()}
    for name in ("k_xx", "k_yy", "b_xx", "b_yy", "d_xx", "d_yy"):
        assert result.parameters[name] == pytest.approx(truth[name], rel=0.1)
    modes, true = result.model.modes(), true_model(structure, truth, result.model).modes()
    np.testing.assert_allclose([m[0] for m in modes], [m[0] for m in true], atol=0.3)
    piezos = load_made_fit(job, "piezos", "p5_n6000_prbs2")
    assert piezos.parameters["kappa_x"] == pytest.approx(1.863, rel=0.01)
    assert "bd_xy" not in result.parameters  # options: disturbance_gain diagonal


def test_crossval_table_is_that_of_the_rows(made):
    folder, _, _, rows, _ = made
    lines = (folder / "results" / "quick" / "crossval" / "bearing.csv").read_text().splitlines()
    read = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert len(read) == len(rows) == 4
    for computed, row in zip(read, rows, strict=True):
        assert float(computed["fit_percent"]) == row.fit_percent > 90
        assert (computed["model"], computed["recording"], computed["output"]) == (row.model, row.recording, row.output)
        assert computed["model"] != computed["recording"]
        assert (float(computed["residual_p"]), tuple(computed["residuals_follow"].split())) == (
            row.residual_p,
            row.residuals_follow,
        )
        assert row.residuals_white == (row.residual_p >= 0.01)
        assert not row.missed


def test_rerun_keeps_everything(made, again):
    before = tree(again)
    log = Log()
    outcomes, rows = all_stages(Job(load_experiment(again / "experiment.yaml"), reporter=log))
    assert {o.state for o in outcomes} == {"kept"}
    assert tree(again) == before
    assert log.begun == []
    assert [r.fit_percent for r in rows] == [r.fit_percent for r in made[3]]


def test_a_missing_result_alone_is_made_again(again):
    (again / "results/quick/fits/piezos/p5_n6000_prbs1.h5").unlink()
    outcomes, _ = all_stages(Job(load_experiment(again / "experiment.yaml")))
    assert [str(o.item) for o in outcomes if o.state == "made"] == ["piezos/p5_n6000_prbs1"]


@pytest.mark.parametrize(
    ("old", "new", "first_refused"),
    [
        ("seed: 3", "seed: 4", "recordings/p5_n6000_still1.h5"),
        ("harmonics: 6", "harmonics: 5", "prefiltered/p5_n6000_prbs1.h5"),
        ("stop: paper", "stop: paper, window: 250", "fits/bearing/p5_n6000_prbs1.h5"),
    ],
)
def test_other_settings_are_refused_and_nothing_changes(again, old, new, first_refused):
    path = write_quick(again, (old, new))
    before = tree(again)
    with pytest.raises(UsageError, match="other settings") as caught:
        all_stages(Job(load_experiment(path)))
    assert str(again / "results" / "quick" / first_refused) in str(caught.value)
    assert tree(again) == before


def test_overwrite_replaces_only_what_differs(again):
    path = write_quick(again, ("stop: paper", "stop: paper, window: 250"))
    outcomes, _ = all_stages(Job(load_experiment(path), overwrite=True))
    made = {str(o.item) for o in outcomes if o.state == "made"}
    assert made == {"bearing/p5_n6000_prbs1", "bearing/p5_n6000_prbs2", "bearing", *SUMMARIES}


def test_titles_and_thresholds_do_not_make_results_stale(again):
    path = write_quick(
        again, ("name: quick", "name: quick\ntitle: New"), ("minimum_percent: 90", "minimum_percent: 99.9")
    )
    outcomes, rows = all_stages(Job(load_experiment(path)))
    assert {o.state for o in outcomes} == {"kept"}
    assert all(row.missed for row in rows)


def test_a_truncated_recording_fails_its_own_items_only(again):
    path = again / "results/quick/recordings/p5_n6000_prbs1.h5"
    path.write_bytes(path.read_bytes()[:5000])
    outcomes = run_stage(Job(load_experiment(again / "experiment.yaml")), RIG)
    assert [o.state for o in outcomes] == ["kept", "failed", "kept"]
    assert "truncated" in outcomes[1].text
    for folder in ("prefiltered", "prefilter", "fits", "crossval"):
        for file in (again / "results/quick" / folder).rglob("*.*"):
            file.unlink()
    job = Job(load_experiment(again / "experiment.yaml"))
    outcomes = [*run_stage(job, PREFILTER), *run_stage(job, FIT)]
    assert {str(o.item): o.state for o in outcomes} == {
        "p5_n6000_prbs1": "failed",
        "p5_n6000_prbs2": "made",
        "map p5_n6000": "made",
        "bearing/p5_n6000_prbs1": "failed",
        "bearing/p5_n6000_prbs2": "made",
        "piezos/p5_n6000_prbs1": "failed",
        "piezos/p5_n6000_prbs2": "made",
    }
    assert "p5_n6000_prbs1.h5" in outcomes[0].text
    outcomes, rows = run_stage(job, CROSSVAL), crossval_rows(job)
    assert [o.state for o in outcomes] == ["failed", "failed"]
    assert rows == []


def test_later_stages_name_what_is_missing(tmp_path):
    job = Job(load_experiment(write_quick(tmp_path)))
    outcomes = run_stage(job, PREFILTER)
    assert {o.state for o in outcomes} == {"failed"}
    assert "`gbid rig` makes it" in outcomes[0].text
    with pytest.raises(DataError, match="`gbid fit` makes it"):
        load_made_fit(job, "bearing", "p5_n6000_prbs1")
    assert not [path for path in (tmp_path / "results").rglob("*") if path.is_file()]


OPTIONS = (
    "{structure: piezo_pair, output_weights: [1.0, 2.0], prior: {p1_x: {value: 3000, std: 1.0e4}}, "
    "options: {disturbance_gain: none}, trend: {u_x: 2, u_y: linear}, hum: 50, robust: student, robust_threshold: 5, "
    "initial_state: zero, "
    "window: 400, ipopt: {max_iter: 30, linear_solver: mumps}, "
    "left_out: {p5_n6000_prbs1: [[0.1, 0.1503], [0.5, 0.6]]}, bounds: {p2_x: [null, 2.0e4]}}"
)


def test_every_option_of_a_fit_reaches_it(tmp_path):
    """The keyword arguments are those that a user would write in Python; nothing of `fit` is out of reach."""
    experiment = load_experiment(write_quick(tmp_path, ("{structure: piezo_pair}", OPTIONS)))
    names = ("p5_n6000_prbs1", "p5_n6000_prbs2")
    data = [Recording({"r": np.zeros((5000, 2))}, 2e-4, name=name) for name in names]
    arguments = fit_arguments(experiment, "piezos", data)
    functions = {"progress", "extra_cost", "constraints"}  # of Python
    known = set(inspect.signature(fit).parameters) - {"structure", "recordings", "scaling"} - functions
    assert set(arguments) == known
    assert {key: arguments[key] for key in ("output_weights", "prior", "initial_state")} == {
        "output_weights": [1.0, 2.0],
        "prior": {"p1_x": (3000.0, 1e4)},
        "initial_state": "zero",
    }
    assert (arguments["window"], arguments["bounds"]) == (400, {"p2_x": (-np.inf, 2e4)})
    # a sample at the end counts again: 0.1503 s lies between samples 751 and 752
    assert arguments["left_out"] == {"p5_n6000_prbs1": [(500, 752), (2500, 3000)]}
    assert (arguments["robust"], arguments["robust_threshold"]) == ("student", 5.0)
    assert (arguments["trend"], arguments["hum"]) == ({"u_x": 2, "u_y": "linear"}, 50.0)
    assert arguments["ipopt"] == {"max_iter": 30, "linear_solver": "mumps"}
    alone = fit_arguments(experiment, "piezos", data[1:])
    assert alone["left_out"] == {}


@pytest.mark.parametrize(("window", "expected"), [("auto", "auto"), ("one", None), ("300", 300)])
def test_words_for_the_window(tmp_path, window, expected):
    path = write_quick(tmp_path, ("stop: paper", f"stop: paper, window: {window}"))
    assert fit_arguments(load_experiment(path), "bearing", [])["window"] == expected


def test_what_is_left_out_lies_within_the_recording():
    recording = Recording({"y": np.zeros((100, 1))}, 0.01, name="run")
    assert samples_of(recording, 0.0, 0.05) == (0, 5)
    assert samples_of(recording, 0.9, 1.0) == (90, 100)
    with pytest.raises(DataError, match="'run' ends at 1 s, before"):
        samples_of(recording, 0.9, 1.02)
    with pytest.raises(DataError, match=r"no sample from 0\.301 s to before 0\.309 s"):
        samples_of(recording, 0.301, 0.309)


def test_local_parameters_are_validated_with_those_of_the_recording(tmp_path):
    """One spring, two amplifiers: the gain is local, each recording is simulated with its own, and a third has none."""

    def weaker(columns):
        columns["drive [V]"] *= 2.0

    second = SPRING[SPRING.index("    - name: run2") : SPRING.index("fits:")]
    path = write_spring(
        tmp_path,
        (second, second + second.replace("run2", "run3")),
        ("focus: simulation", "focus: simulation, together: true, recordings: [run1, run2], local: {b: recording}"),
        ("on: cyclic", 'on: "run*"'),
    )
    write_spring_data(tmp_path / "data" / "run2.csv", 2, damage=weaker)
    write_spring_data(tmp_path / "data" / "run3.csv", 3)
    outcomes, rows = all_stages(Job(load_experiment(path)))
    (failed,) = (outcome for outcome in outcomes if outcome.state != "made")
    assert "there are none for recording 'run3'" in failed.text
    result = load_made_fit(Job(load_experiment(path)), "spring", "together")
    assert result.parameters["b[run1]"] / result.parameters["b[run2]"] == pytest.approx(2.0, rel=0.01)
    assert [row.recording for row in rows] == ["run1", "run2"]
    assert min(row.fit_percent for row in rows) > 95


def test_changed_data_or_a_changed_structure_file_make_results_stale(tmp_path):
    path, structure = write_spring(tmp_path), tmp_path / "spring.py"
    all_stages(Job(load_experiment(path)))
    structure.write_text(structure.read_text() + "# changed\n")
    with pytest.raises(UsageError, match=r"fits/spring/run1\.h5"):
        all_stages(Job(load_experiment(path)))
    write_spring_data(tmp_path / "data" / "run2.csv", seed=5)
    with pytest.raises(UsageError, match=r"recordings/run2\.h5 was made with other settings or data"):
        all_stages(Job(load_experiment(path)))


def saturated(columns):
    columns["position [um]"][:] = np.clip(columns["position [um]"], -8, 8)


def test_a_signal_may_rest_at_its_limits_when_the_yaml_says_so(tmp_path):
    path = write_spring(tmp_path)
    write_spring_data(tmp_path / "data" / "run1.csv", 1, damage=saturated)
    job = Job(load_experiment(path))
    first, second = run_stage(job, IMPORT)
    assert (first.state, second.state) == ("failed", "made")
    for word in ("run1", "'y'", "is saturated", "rests_at_limits"):
        assert word in first.text
    assert [outcome.state for outcome in run_stage(job, FIT)] == ["failed", "made"]
    text = path.read_text().replace("stored_unit: um}", "stored_unit: um, rests_at_limits: true}")
    path.write_text(text)
    assert [o.state for o in run_stage(Job(load_experiment(path, tmp_path / "other")), IMPORT)] == ["made", "made"]


def test_means_are_removed_when_asked(tmp_path):
    path = write_spring(tmp_path, ("      time: time\n", "      time: time\n      remove_mean: true\n"))
    run_stage(Job(load_experiment(path)), IMPORT)
    rec = load_recording(tmp_path / "results/spring/recordings/run1.h5")
    assert np.abs(rec.signal("y").mean()) < 1e-12
    assert "mean" in rec.provenance["remove_mean"]


def test_keys_follow_the_numbers_of_a_model():
    model = load_model("theisen2016")
    changed = replace(model, coefficients={**model.coefficients, "k_xx": (1.0, *model.coefficients["k_xx"][1:])})
    assert content_key("design", {"model": model}) == content_key("design", {"model": load_model("theisen2016")})
    assert content_key("design", {"model": model}) != content_key("design", {"model": changed})


def test_prefilter_without_a_map(tmp_path):
    path = write_quick(
        tmp_path, ("harmonics: 6", "method: none"), ("stationary: {recordings: 1}", "stationary: {recordings: 0}")
    )
    job = Job(load_experiment(path))
    run_stage(job, RIG)
    outcomes = run_stage(job, PREFILTER)
    assert {o.state for o in outcomes} == {"made"}
    assert load(tmp_path / "results/quick/prefilter/p5_n6000.h5", PrefilterFile).runout_map is None


@pytest.mark.skipif(not (SHARED / "rotary_arm.npz").is_file(), reason="shared/data is not beside this checkout")
def test_rotary_arm(tmp_path):
    job = Job(load_experiment(EXPERIMENTS / "rotary_arm.yaml", tmp_path))
    all_stages(job)
    result = load_made_fit(job, "arm", "together")
    assert result.loss <= 0.05441221
    assert result.parameters["b1"] == pytest.approx(19.78595, rel=1e-3)
    assert result.parameters["K2"] == pytest.approx(-138.18086, rel=1e-3)


@pytest.mark.skipif(not (SHARED / "twin_mode_rig.npz").is_file(), reason="shared/data is not beside this checkout")
def test_twin_mode_rig(tmp_path):
    job = Job(load_experiment(EXPERIMENTS / "twin_mode_rig.yaml", tmp_path))
    _, rows = all_stages(job)
    assert [row.recording for row in rows] == ["validation", "validation"]
    assert min(row.fit_percent for row in rows) >= 93.5
