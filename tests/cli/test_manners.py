"""Manners of the command line: -h, --quiet, -v, --dry-run, next steps, NO_COLOR, `gbid clean` and `gbid doctor`."""

import contextlib
import errno
import io
import os
import shlex
import signal
import subprocess
import sys
import textwrap
import time
import weakref
from functools import partial
from pathlib import Path

import casadi as ca
import pytest
import typer
from experiment_files import files_in, gbid, json_of, printed_by, write_spring
from places import ROOT

from gbid.cli.guard import guarded
from gbid.cli.progress import LiveBar
from gbid.core.errors import NoSpaceError
from gbid.core.files import atomic_path, share_folder
from gbid.experiment import user_code
from gbid.experiment.load import load_experiment


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    path = write_spring(tmp_path_factory.mktemp("spring"))
    assert gbid("import", path) == 0
    return path


def assert_interrupted(body, capsys):
    """It ends as an interrupted command does."""
    with pytest.raises(typer.Exit) as end, guarded():
        body()
    assert end.value.exit_code == 130
    assert capsys.readouterr().err == "gbid: interrupted; complete results are kept\n"


def test_code_that_ends_the_program_is_an_error(capsys):
    with pytest.raises(typer.Exit) as end, guarded():
        sys.exit(0)
    assert end.value.exit_code == 2
    assert "ended gbid by sys.exit(0)" in capsys.readouterr().err


def test_the_package_runs_as_a_module():
    words = [sys.executable, "-m", "gbid", "--version"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.startswith("gbid ")


@pytest.mark.parametrize("command", [["schema"], ["explain"], ["show", "{fit}"]])
def test_a_reader_that_has_enough_is_no_error(spring, command):
    fit = next((spring.parent / "results").rglob("*.h5"))
    words = " ".join(shlex.quote(str(fit)) if word == "{fit}" else word for word in command)
    line = f"{shlex.quote(sys.executable)} -P -m gbid {words} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_quiet_says_nothing_beside_the_results(spring, capsys):
    loud = printed_by(capsys, "import", spring)
    assert loud.err.splitlines() == ["import run1: kept", "import run2: kept", f"next: gbid fit {spring}"]
    quiet = printed_by(capsys, "import", spring, "--quiet")
    assert (quiet.out, quiet.err) == (loud.out, "")
    assert "no section 'rig'" in printed_by(capsys, "rig", spring, "-q", code=2).err


def test_a_dry_run_counts_and_makes_nothing(spring, capsys):
    before = files_in(spring.parent)
    plan = json_of(capsys, "run", spring, "--dry-run")["plan"]
    assert [(row["stage"], row["to_make"], row["there"]) for row in plan] == [
        ("import", 0, 2),
        ("fit", 2, 0),
        ("crossval", None, None),
    ]
    assert "nothing is made" in printed_by(capsys, "fit", spring, "--dry-run").out
    assert gbid("rig", spring, "--dry-run") == 2
    assert files_in(spring.parent) == before


def test_verbose_shows_each_iteration(spring, capsys):
    assert gbid("import", spring, "--results", spring.parent / "loud") == 0
    capsys.readouterr()
    assert gbid("fit", spring, "--verbose", "--results", spring.parent / "loud") == 0
    assert "fit spring/run1: iteration 1, cost " in capsys.readouterr().err


def test_clean_removes_what_killed_runs_left_and_on_request_all(tmp_path, capsys):
    path = write_spring(tmp_path)
    assert gbid("import", path) == 0
    results = tmp_path / "results/spring"
    (results / "failed/fit").mkdir(parents=True)
    (results / "failed/fit/x.json").write_text("{}")
    stale = results / "recordings/.run1.h5.elsewhere~1.x.part"
    stale.write_text("")
    os.utime(stale, (1e9, 1e9))
    (results / "mine.txt").write_text("mine")
    before = files_in(tmp_path)
    assert "2 files would be removed" in printed_by(capsys, "clean", path, "--dry-run").out
    assert files_in(tmp_path) == before
    assert len(json_of(capsys, "clean", path)["removed"]) == 2
    gone = {str(stale.relative_to(tmp_path)), "results/spring/failed/fit/x.json"}
    assert set(before) - set(files_in(tmp_path)) == gone
    assert gbid("clean", path, "--everything", "--quiet") == 0
    assert [p.name for p in results.rglob("*")] == ["mine.txt"]


def test_a_limit_on_the_size_of_files_is_told_and_not_remembered(tmp_path, capsys):
    resource = pytest.importorskip("resource")
    path = write_spring(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, before[1]))
    try:
        assert gbid("import", path) == 3
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "larger than this process may write (ulimit -f); raise the limit" in capsys.readouterr().err
    assert [p.name for p in (tmp_path / "results").rglob("*") if p.is_file()] == []
    assert gbid("import", path) == 0


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EFBIG, "ulimit -f"),
        (errno.ENOSPC, "No space left in"),
        (errno.EDQUOT, "No space left in"),
        (errno.EROFS, "mount the drive"),
    ],
)
def test_a_full_disk_behind_the_failure_of_a_library_is_one(tmp_path, number, words):
    def write():
        with atomic_path(tmp_path / "figure.pdf", overwrite=False):
            try:
                raise OSError(number, os.strerror(number))
            finally:
                None.pos  # noqa: B018  # as a library that ends what was not begun

    with pytest.raises(NoSpaceError, match=words):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_temporary_file_that_cannot_be_removed_hides_no_error(tmp_path, monkeypatch):
    def refuse(path, **_):
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with (
        pytest.raises(NoSpaceError, match=r"figure\.pdf: cannot be written: Input/output error; repair"),
        atomic_path(tmp_path / "figure.pdf", overwrite=False) as part,
    ):
        refuse(part)


@pytest.mark.parametrize("system", ["with interval timers", "Windows"])
def test_an_interruption_that_python_ignores_comes_again(system, capsys, monkeypatch):
    if system == "Windows":
        monkeypatch.delattr(signal, "setitimer")

    class Thing:
        pass

    def interrupted(_):
        raise KeyboardInterrupt

    def body():
        thing = Thing()
        weak = weakref.ref(thing, interrupted)
        del thing  # the callback runs here, and what it raises is ignored
        for _ in range(2000):  # between two of them Python looks for signals on each system
            time.sleep(0.01)
        return weak

    assert_interrupted(body, capsys)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_casadi_forgets_comes_again(number, capsys, request):
    if signal.getsignal(number) == signal.SIG_IGN:  # as under nohup, which gbid respects
        request.addfinalizer(partial(signal.signal, number, signal.signal(number, signal.SIG_DFL)))

    class Sent:
        @property
        def shape(self):
            signal.raise_signal(number)

    def body():
        with contextlib.suppress(NotImplementedError):  # CasADi's word for an argument of no use
            ca.densify(Sent())
        time.sleep(20)

    assert_interrupted(body, capsys)
    assert signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)


def test_an_interruption_while_a_dataclass_is_made_is_one(tmp_path):
    """Python marks an interruption within code from text, and would end a module that was run as killed by SIGINT."""
    program = """
        import gbid.cli.main as command

        def app(prog_name):
            try:
                exec("raise KeyboardInterrupt")
            except KeyboardInterrupt:
                raise SystemExit(130)

        app.registered_commands = []
        command.app = app
        command.main()
    """
    (tmp_path / "interrupted.py").write_text(textwrap.dedent(program))
    path = os.pathsep.join([str(tmp_path), *sys.path])
    ended = subprocess.run([sys.executable, "-m", "interrupted"], env=os.environ | {"PYTHONPATH": path}, check=False)
    assert ended.returncode == 130


def test_the_command_line_runs_twice_in_one_process(monkeypatch, capsys):
    from gbid.cli.main import main

    for verb in ("explain", "doctor"):
        monkeypatch.setattr(sys, "argv", ["gbid", verb])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0
        assert capsys.readouterr().out


def test_a_failure_in_the_place_of_an_interruption_is_one(capsys):
    def body():
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        raise ValueError("Invalid affine transformation matrix")  # as matplotlib on its way to a picture

    assert_interrupted(body, capsys)


def test_an_interruption_behind_the_failure_of_a_library_is_one(capsys):
    def body():
        try:
            raise KeyboardInterrupt
        finally:
            None.pos  # noqa: B018  # as a library that closes a file that was not begun

    assert_interrupted(body, capsys)


def test_doctor_has_a_verdict_on_everything(capsys, monkeypatch, tmp_path):
    from gbid.core.compiled import find_compiler

    results = {row["what"]: row for row in json_of(capsys, "doctor")["findings"]}
    assert {"gbid", "packages", "C compiler", "compiled kernels", "this folder", "processors", "BLAS"} <= set(results)
    assert results["packages"]["verdict"] == "good"
    assert "casadi" in results["packages"]["found"]
    monkeypatch.setenv("CC", "no-such-compiler")
    find_compiler.cache_clear()
    try:
        captured = printed_by(capsys, "doctor")
    finally:
        find_compiler.cache_clear()
    assert "gbid: note: C compiler: fits run with the portable pass" in captured.err


def test_no_color_takes_the_colours_out(monkeypatch):
    from rich.console import Console

    written = {}
    for name in ("", "1"):
        monkeypatch.setenv("NO_COLOR", name)
        console = Console(file=io.StringIO(), force_terminal=True, width=80)
        bar = LiveBar(console)
        with bar.progress:
            bar.begin(4)
            bar.show("fit spring", 2)
        written[name] = console.file.getvalue()
    assert "fit spring" in written["1"]
    assert "\x1b[38;" in written[""] or "\x1b[3" in written[""]
    assert "\x1b[38;" not in written["1"]


def test_a_python_file_is_executed_once_by_a_verb_and_never_by_clean(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GBID_CACHE_DIR", str(tmp_path / "cache"))
    path, count = write_spring(tmp_path / "spring"), tmp_path / "count.txt"
    code, lines = path.parent / "spring.py", []
    code.write_text(code.read_text() + f"with open({str(count)!r}, 'a') as file:\n    file.write('x')\n")
    for verb, expected in (("check", 1), ("import", 1), ("fit", 1), ("fit", 1), ("export", 1), ("clean", 0)):
        user_code._made.clear()  # as another process
        assert gbid(verb, path) == 0
        assert len(count.read_text() if count.exists() else "") == expected, verb
        count.unlink(missing_ok=True)
        lines += [line for line in capsys.readouterr().err.splitlines() if "is executed with your rights" in line]
    assert len(lines) == 1
    assert "spring.py" in lines[0]
    assert not list(path.parent.rglob("__pycache__"))
    code.write_text(code.read_text() + "raise OSError('no licence')\n")
    assert gbid("clean", path, "--everything") == 0
    assert not count.exists()
    assert gbid("check", path) == 2
    assert len(count.read_text()) == 1  # also when it fails
    words = capsys.readouterr().err
    assert words.index("is executed with your rights") < words.index("no licence")


def test_a_structure_of_the_models_is_told_of_by_its_path(tmp_path, monkeypatch):
    monkeypatch.setenv("GBID_CACHE_DIR", str(tmp_path / "cache"))
    path = write_spring(tmp_path / "spring", ("spring.py:structure", "rigid_rotor.py:structure"))
    (text,) = user_code.new_code(load_experiment(path, form_only=True))
    assert text.startswith(f"{share_folder('models') / 'rigid_rotor.py'}: ")


def test_what_a_failed_python_file_imports_may_appear_later(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    path = write_spring(tmp_path / "spring")
    code = path.parent / "spring.py"
    code.write_text("import helper_of_spring\n" + code.read_text())
    assert gbid("check", path) == 2
    (tmp_path / "helper_of_spring.py").touch()
    assert gbid("check", path) == 0
    capsys.readouterr()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files")
def test_a_memory_that_others_may_write_is_not_believed(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GBID_CACHE_DIR", str(tmp_path / "cache"))
    path = write_spring(tmp_path / "spring")
    for said in (1, 0, 1):
        assert gbid("check", path) == 0
        assert capsys.readouterr().err.count("is executed with your rights") == said
        if not said:
            (tmp_path / "cache" / "seen-code").chmod(0o777)


def test_an_error_is_one_line_of_at_most_500_characters_without_control_characters(capsys):
    (line,) = printed_by(capsys, "explain", "\x1b[31m" + "x" * 5000 + "\n", code=2).err.splitlines()
    assert len(line) <= 500
    assert line.isprintable()
    assert "`gbid explain` lists all" in line
