import json
import re
import signal
import subprocess
import sys
import time

import pytest
from campaign_files import ENVIRONMENT, command
from experiment_files import files_in, gbid, json_of, printed_by, write_quick, write_spring, write_spring_data
from figure_cases import BlankPictures
from json_keys import KEYS, assert_keys

from gbid import load
from gbid.experiment.campaign import locked
from gbid.experiment.load import disk_space, load_experiment, peek_recordings


@pytest.fixture(scope="module", autouse=True)
def blank_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbid.report.write.Pictures", BlankPictures)
        yield


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """An experiment that has been run."""
    folder = tmp_path_factory.mktemp("spring")
    path = write_spring(folder)
    assert gbid("run", path) == 0
    return path


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """The quick experiment with recordings and fits, one of them of the whole plant."""
    piezos = "{structure: piezo_pair}"
    plant = (piezos, piezos + "\n  plant: {structure: plant, trend: offset, recordings: p5_n6000_prbs1}")
    path = write_quick(tmp_path_factory.mktemp("quick"), plant, ("figures:\n  bearing: {from_s: 0.2, to_s: 0.4}\n", ""))
    assert gbid("run", path, "--quiet") == 0
    return path


def test_importing_gbid_is_cheap_and_gives_all_names_and_help_and_commands_load_what_they_need():
    code = (
        "import sys, gbid\n"
        "assert not {'casadi', 'numpy', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        "from gbid.cli.main import app\n"
        "try:\n    app(['--help'], prog_name='gbid')\n"
        "except SystemExit:\n    pass\n"
        "heavy = ['casadi', 'numpy', 'scipy', 'matplotlib', 'h5py', 'pydantic', 'ruamel', 'rich']\n"
        "found = [name for name in heavy if name in sys.modules]\n"
        "assert not found, found\n"
        "import gbid.experiment.campaign\n"  # what every command and worker imports
        "heavy = ['matplotlib', *(f'scipy.{part}' for part in ('optimize', 'signal', 'stats', 'ndimage'))]\n"
        "found = [name for name in heavy if name in sys.modules]\n"
        "assert not found, found\n"
        "for name in gbid.__all__: assert getattr(gbid, name), name\n"
        "import gbid.report\n"
        "assert 'matplotlib' not in sys.modules\n"
        "for name in gbid.report.__all__: assert callable(getattr(gbid.report, name)), name\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert dir(gbid) == gbid.__all__\n"
        "import gbid.prefilter.filtering\n"
        "from gbid.prefilter import RunoutMap, prefilter\n"
        "assert gbid.prefilter is prefilter\n"
        "from gbid import *\n"
        "assert prefilter is gbid.prefilter and control is gbid.control\n"
        "try:\n    gbid.nothing\nexcept AttributeError as error:\n    assert 'nothing' in str(error)\n"
    )
    words = [sys.executable, "-W", "error", "-c", code]
    subprocess.run(words, env=ENVIRONMENT, check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("arguments", [["fits"], ["run"], ["run", "a.yaml", "--jsn"], ["new", "x", "--template", "y"]])
def test_wrong_command_lines_end_with_2(arguments, capsys):
    captured = printed_by(capsys, *arguments, code=2)
    assert captured.out == ""
    assert captured.err


def test_run_prints_data_on_stdout_and_progress_on_stderr(spring, capsys):
    captured = printed_by(capsys, "run", spring)
    shown = captured.out.splitlines()
    assert len(shown) <= 24
    assert all(len(line) <= 80 for line in shown if not line.startswith(("results: ", "report: ")))
    assert re.search(r"^  spring run1: (39\.9|40\.0)\d* ± 0\.\d+ Hz, damping 0\.\d+ ± ", captured.out, re.MULTILINE)
    assert re.search(r"worst output \[%\]: spring 99\.", captured.out)
    captured = printed_by(capsys, "run", spring, "-v")
    for word in ("spring, run1", "k ", "frequency", "[Hz]", "cross-validation", "99.", "results: "):
        assert word in captured.out
    assert re.search(r"^1 +(39\.9|40\.0)\d* ", captured.out, re.MULTILINE)
    assert "fit spring/run1: kept" in captured.err
    assert "kept" not in captured.out


def test_json_of_every_verb_is_one_document(spring, tmp_path, capsys):
    assert json_of(capsys, "check", spring)["recordings"] == ["run1", "run2"]
    document = json_of(capsys, "import", spring)["recordings"]
    assert [(r["name"], r["samples"], r["sample_time_s"], r["state"]) for r in document] == [
        ("run1", 1500, 5e-4, "kept"),
        ("run2", 1500, 5e-4, "kept"),
    ]
    document = json_of(capsys, "fit", spring)
    assert_keys("fits", document)
    fits = document["fits"]
    rows = {row["parameter"]: row for row in fits[0]["parameters"]}
    for row in rows.values():
        assert row["std"] == row[f"std_{fits[0]['trusted']}"]
        assert row["std_white"] == pytest.approx(row["std_robust"])  # the residuals are white
        assert row["start_origin"] == "structure"
    assert rows["k"]["start"] == 6e4
    mode, gain = fits[0]["modes"][0], fits[0]["static_gain"][0]
    # f = sqrt(k) / 2 pi, so its relative deviation is half that of k; the gain is b / k
    assert mode["frequency_std_hz"] == pytest.approx(40 * rows["k"]["std"] / rows["k"]["estimate"] / 2, rel=1e-3)
    assert 0 < mode["damping_std"] < 1e-2
    assert 0 < gain["std"] < 0.01 * abs(gain["gain"])
    assert [row["output"] for row in fits[0]["whiteness"]] == ["y"]
    assert fits[0]["condition"] > 1
    assert fits[0]["multi_start"] is None
    assert rows["b"]["estimate"] == pytest.approx(2e6, rel=0.01)
    assert rows["b"]["truth"] is None
    assert fits[0]["modes"][0]["frequency_hz"] == pytest.approx(40.0, abs=0.05)
    printed = json_of(capsys, "crossval", spring)
    assert_keys("crossval", printed)
    assert_keys("crossval_summary", printed)
    document = printed["crossval"]
    assert [r["model"] for r in document] == ["run1", "run2"]
    assert all(r["residuals_white"] and r["residuals_follow"] == [] for r in document)
    assert set(json_of(capsys, "run", spring)) == set(KEYS["run"])


def test_rig_fit_table_has_truth_units_and_readable_numbers(quick, capsys):
    captured = printed_by(capsys, "rig", quick)
    assert "p5_n6000_still1" in captured.out
    assert "rig p5_n6000_prbs1: kept" in captured.err
    out = printed_by(capsys, "fit", quick).out
    k_xx = next(line for line in out.splitlines() if line.strip().startswith("k_xx")).split()
    assert k_xx[1].startswith("-62")
    assert k_xx[1].endswith("e3")
    assert k_xx[3] == "-628.89e3"
    assert re.search(r"^parameter +estimate +\((white|robust)\) +truth", out, re.MULTILINE)
    for word in ("residuals  p_x ", "start      14 from the data, 2 from the structure", ", condition "):
        assert word in out
    assert len(re.findall(r"^d_.*N s/\(kg m\) *$", out, re.MULTILINE)) == 12
    tau_x = next(line for line in out.splitlines() if line.strip().startswith("tau_x")).split()
    assert tau_x[-1] == "ms"
    assert tau_x[3] == "0.58565"
    assert "3078.0" in out  # the piezos' truth
    assert "u_x to p_x" in out
    assert "run-out" in out
    document = json_of(capsys, "fit", quick, "--only", "piezos")
    assert {f["fit"] for f in document["fits"]} == {"piezos"}
    assert_keys("prefilter", document)
    x_of_first = document["prefilter"][0]
    assert x_of_first["channel"] == "p_x"
    assert 0 < x_of_first["runout_share"] < 1
    assert x_of_first["rms_after"] < x_of_first["rms_before"]
    assert "did you mean 'piezos'" in printed_by(capsys, "fit", quick, "--only", "piezo", code=2).err


def test_tables_fit_a_terminal_of_80_columns(quick, capsys):
    """All that the experiment prints, notes wrapped below their own beginning."""
    from rich.console import Console

    from gbid.core.tables import terminal_table
    from gbid.experiment.run import Job, run_stage
    from gbid.experiment.stages.crossval import CROSSVAL
    from gbid.experiment.stages.fit import FIT
    from gbid.experiment.stages.prefilter import PREFILTER
    from gbid.identify.fit_tables import fit_document, summary_lines
    from gbid.report.views import view_of

    job = Job(load_experiment(quick))
    tables = []
    for stage in (PREFILTER, FIT, CROSSVAL):
        view = view_of(stage)
        tables += view.tables(job, run_stage(job, stage))
    console = Console(width=80, highlight=False)
    for table in tables:
        console.print(terminal_table(table))
    out = capsys.readouterr().out
    assert "…" not in out
    assert max(len(line) for line in out.splitlines()) <= 80
    for unit in ("N s/(kg m)", "rad/s", "1/s^2"):
        assert unit in out
    assert len(re.findall(r"^note       the inputs are known .*\n           \S", out, re.MULTILINE)) == 2
    result = load(next((job.experiment.results / "fits" / "bearing").glob("*.h5")))
    lines = dict(summary_lines(fit_document(result, {"tau_x": 0.9 * result.parameters["tau_x"]})))
    assert re.match(r"many standard deviations from the truth: tau_x \(\+\d\d+\)", lines["note"])


def test_the_estimate_of_the_size_is_about_right(quick):
    experiment = load_experiment(quick)
    needed, _ = disk_space(experiment, peek_recordings(experiment)[0])
    taken = sum(path.stat().st_size for path in experiment.results.rglob("*") if path.is_file())
    assert 0.7 * taken < needed < 1.6 * taken


def test_progress_says_where_the_solver_is(capsys):
    from gbid.cli.progress import ProgressReporter
    from gbid.experiment.fields import Item
    from gbid.identify import Progress

    reporter = ProgressReporter()
    reporter.begin(Item("fit", "bearing", "run1"))
    for which in range(2):
        for iteration in (0, 10):
            sigma = float("inf") if iteration == 0 else 0.25 + which
            reporter.iteration(Progress(iteration, -4.77994, 2e-7, 1e-3, sigma))
    assert capsys.readouterr().err.splitlines() == [
        "fit bearing/run1: iteration 10, cost -4.7799, gap 2e-07, step 0.2 std",
        "fit bearing/run1, try 2: iteration 10, cost -4.7799, gap 2e-07, step 1 std",
    ]


def test_several_starts_are_told(tmp_path, capsys):
    path = write_spring(tmp_path, ("focus: simulation", "focus: simulation, multi_start: {starts: 3, reach: 0.1}"))
    assert gbid("import", path) == 0
    assert gbid("fit", path) == 0
    assert re.search(r"^starts     3 \(seed 0\): \d converged, \d ended at the best", capsys.readouterr().out, re.M)
    told = json_of(capsys, "fit", path)["fits"][0]["multi_start"]
    assert (told["starts"], told["seed"]) == (3, 0)
    assert 1 <= told["agreed"] <= told["converged"] <= 3
    assert told["spread"] >= 1


def test_yaml_problems_end_with_2_one_line_each_and_write_nothing(tmp_path, capsys):
    path = write_quick(tmp_path, ("seed: 3", "sed: 3"), ("harmonics: 6", "median: 2.5"))
    for verb in ("check", "rig", "fit", "crossval", "run"):
        captured = printed_by(capsys, verb, path, code=2)
        assert captured.out == ""
        lines = captured.err.splitlines()
        assert len(lines) == 2
        assert lines[0].startswith(f"gbid: error: {path}:4:3: rig.sed: unknown key; did you mean 'seed'?")
    error = json_of(capsys, "run", path, code=2)["error"]
    assert error["exit_code"] == 2
    assert len(error["messages"]) == 2
    assert files_in(tmp_path) == ["experiment.yaml"]


def test_bad_data_end_with_3_and_do_not_stop_the_others(tmp_path, capsys):
    path = write_spring(tmp_path)

    def damage(columns):
        columns["position [um]"][3] = float("inf")

    write_spring_data(tmp_path / "data" / "run1.csv", 1, damage=damage)
    captured = printed_by(capsys, "check", path, code=3)
    assert captured.err.startswith(f"gbid: error: {path}:6:")
    assert "sample 3" in captured.err
    assert files_in(tmp_path / "results") == []
    captured = printed_by(capsys, "import", path, code=3)
    assert "run2" in captured.out
    assert "run1" not in captured.out
    assert captured.err.splitlines()[-1].startswith("gbid: error: import run1: ")
    captured = printed_by(capsys, "run", path, "--json", code=3)
    document = json.loads(captured.out)
    assert [f["model"] for f in document["fits"]] == ["run2"]
    assert any(o["state"] == "failed" and "sample 3" in o["text"] for o in document["outcomes"])


def test_truncated_result_ends_with_3(tmp_path, capsys):
    path = write_spring(tmp_path)
    assert gbid("import", path) == 0
    stored = tmp_path / "results/spring/recordings/run1.h5"
    stored.write_bytes(stored.read_bytes()[:3000])
    assert f"{stored}: damaged, changed after it was made" in printed_by(capsys, "run", path, code=3).err
    assert gbid("run", path, "--overwrite") == 0


def test_no_convergence_ends_with_4_and_is_written(tmp_path, capsys):
    path = write_spring(tmp_path, ("focus: simulation", "focus: simulation, max_iterations: 1"))
    captured = printed_by(capsys, "run", path, "-v", code=4)
    assert "solver     not converged: iteration limit reached" in captured.out
    assert "fit spring/run1: made" in captured.err
    assert "s): not converged: iteration limit reached" in captured.err  # in the progress as well
    assert re.search(r"gbid: error: fit spring/run1: not converged: iteration limit.*\(written to ", captured.err)
    assert "fits/spring/run1.h5" in files_in(tmp_path / "results" / "spring")
    assert gbid("run", path) == 4  # kept, and said again


def test_a_missed_threshold_ends_with_5_and_is_written(spring, tmp_path, capsys):
    spring = spring.parent / "strict.yaml"
    spring.write_text((spring.parent / "experiment.yaml").read_text().replace("percent: 90", "percent: 99.99"))
    captured = printed_by(capsys, "crossval", spring, "--json", code=5)
    assert all(row["missed"] for row in json.loads(captured.out)["crossval"])
    assert "below the minimum of 99.99 %" in captured.err
    assert gbid("run", spring) == 5


def test_a_defect_of_ours_ends_with_1(spring, monkeypatch, capsys):
    import gbid.experiment.load as load

    def broken(*_, **__):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(load, "load_experiment", broken)
    captured = printed_by(capsys, "check", spring, code=1)
    assert captured.err.count("\n") == 1
    assert "gbid: defect: ZeroDivisionError: oh (a defect of gbid" in captured.err
    captured = printed_by(capsys, "check", spring, "--debug", "--json", code=1)
    assert "Traceback" in captured.err
    assert json.loads(captured.out)["error"]["exit_code"] == 1


def test_own_recordings_template_runs_as_it_is(tmp_path, capsys):
    folder = tmp_path / "mine"
    folder.mkdir()  # an empty folder will do
    assert gbid("new", folder, "--template", "own-recordings") == 0
    written = files_in(folder)
    assert capsys.readouterr().out.splitlines() == [str(folder / name) for name in written]
    assert "not empty" in printed_by(capsys, "new", folder, code=2).err
    assert files_in(folder) == written
    document = json_of(capsys, "run", folder / "experiment.yaml")
    for fit in document["fits"]:
        assert fit["modes"][0]["frequency_hz"] == pytest.approx(40.0, abs=0.05)
        assert fit["modes"][0]["damping"] == pytest.approx(0.05, abs=1e-3)
    assert min(row["fit_percent"] for row in document["crossval"]) > 99


def test_ctrl_c_ends_with_130_and_leaves_nothing_half_written(tmp_path):
    path = write_spring(tmp_path, ("focus: simulation", "multi_start: {starts: 3000}"))  # under way for long
    process = command("run", path)
    for text in process.stderr:
        if text.startswith("import run2: made"):
            break
    time.sleep(0.15)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err.splitlines()[-1].startswith("gbid: interrupted")
    assert "Traceback" not in err
    assert out == ""
    left = files_in(tmp_path)
    assert not [name for name in left if name.endswith(".part")]
    assert "results/spring/recordings/run2.h5" in left
    assert not [name for name in left if "/fits/" in name]


def test_verbs_that_look_need_no_lock_and_write_elsewhere(spring, tmp_path):
    results = spring.parent / "results/spring"
    with locked(results):
        before = {path: path.stat().st_mtime_ns for path in spring.parent.rglob("*")}
        assert gbid("check", spring) == 0
        assert gbid("report", spring, "--output", tmp_path / "report.html") == 0
        assert gbid("export", spring, "--to", "csv", "--output", tmp_path / "tables") == 0
        assert {path: path.stat().st_mtime_ns for path in spring.parent.rglob("*")} == before
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert len(list((tmp_path / "tables").iterdir())) == 6


def test_the_verb_of_the_paper_writes_results_and_needs_the_lock(spring, capsys):
    with locked(spring.parent / "results/spring"):
        assert gbid("paper", spring) == 2
    assert "another gbid is working in this folder" in capsys.readouterr().err


def test_without_a_home_folder_there_are_no_lines_of_other_libraries(tmp_path, monkeypatch):
    path = write_spring(tmp_path)
    assert gbid("import", path) == 0  # the page shows the recordings alone
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"):
        monkeypatch.setitem(ENVIRONMENT, name, str(path))  # a file
    process = command("report", path, "--output", tmp_path / "report.html")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0
    said = [line.partition(" (")[0] for line in err.splitlines()]
    executed = f"gbid: {path.with_name('spring.py')}: this Python file is executed with your rights"
    assert said == [executed, "report report.html: made", f"next: gbid export {path} --to matlab"]
