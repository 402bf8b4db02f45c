"""The compiled kernel against the portable one, its cache, and machines without a compiler."""

import multiprocessing
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from compilers import COMPILER, NEEDS_COMPILER, SOURCE, forget_libraries, load_in_a_process, no_compiler, value_of
from fit_cases import (
    ACTUATORS,
    EVERY,
    EVERY_AT,
    KEY,
    MODE,
    MODE_AT,
    TS,
    H,
    levels,
    simulated,
    smooth,
)
from places import SUPPORT

import gbid
from gbid.core import compiled as compiling
from gbid.identify import fit
from gbid.identify.disturbances import Disturbances, Trend
from gbid.identify.kernel import linear
from gbid.identify.kernel.blocks import Segment, cut
from gbid.identify.kernel.linear import CompiledLinearKernel, KernelPattern, PortableLinearKernel, filled
from gbid.identify.kernel.sums import Lagrangian, Moved
from gbid.identify.predictor import build_predictor
from gbid.structure import PiezoPair, Plant, RotorBearing

PORTABLE = PortableLinearKernel()
GAINS = {"bd_xx": 3e4, "bd_xy": -4e3, "bd_yx": 2e3, "bd_yy": 5e4}


@pytest.fixture(scope="module", autouse=True)
def _flags_of_users():
    """Compile as users do; other tests compile in less time."""
    with pytest.MonkeyPatch.context() as environment:
        environment.delenv("GBID_CFLAGS", raising=False)
        forget_libraries()
        yield
    forget_libraries()


@pytest.fixture
def fresh(monkeypatch):
    """Forget what this process has loaded, before and after."""
    forget_libraries()
    yield monkeypatch
    monkeypatch.undo()
    forget_libraries()


# ---- one result, two kernels ----

DISTURBED = Disturbances(("a", "b"), (Trend(2), Trend(0, random_walk=True)), (1.3,))
PLANT = Plant(RotorBearing(delay="exact"))
CASES = {
    "every": (EVERY, EVERY_AT, H, ("zoh", "foh"), {}),
    "every, disturbed": (EVERY, EVERY_AT, H, "zoh", {"disturbances": DISTURBED}),
    "every, simulation": (EVERY, EVERY_AT, H, "foh", {"focus": "simulation"}),
    "one output": (MODE, {**MODE_AT, "l1": 0.3, "l2": -0.2}, H, "zoh", {}),
    "rotor": (RotorBearing(), {**KEY, **GAINS}, TS, "foh", {}),
    "piezo": (PiezoPair(), ACTUATORS, TS, "zoh", {}),
    "plant": (PLANT, {**ACTUATORS, **KEY, **GAINS}, TS, "zoh", {"fixed": [q for q in KEY if q[0] in "db"]}),
}


def problem(case, lengths=(300,), window=50, left_out=None):
    structure, values, h, hold, more = CASES[case]
    more = dict(more)
    fixed = {name: values[name] for name in more.pop("fixed", ())}
    predictor = build_predictor(structure, fixed, h, hold, more.pop("focus", "prediction"), **more)
    theta = np.array([values.get(q.name, 0.1) for q in predictor.free])
    scale, n_y = 1e-6 if h == TS else 1.0, predictor.n_outputs
    pieces = []
    for i, n in enumerate(lengths):
        counts = np.ones(n)
        counts[slice(*left_out or (0, 0))] = 0.0
        inputs = 4 * scale * smooth(n, predictor.n_inputs, seed=i)
        pieces.append(Segment(inputs, scale * smooth(n, n_y, seed=30 + i), None if counts.all() else counts))
    blocks = cut(pieces, predictor, window)
    starts = scale * np.random.default_rng(5).normal(size=(blocks.n_windows, predictor.n_states))
    weight = (np.eye(n_y) + 0.3 * np.ones((n_y, n_y))) / scale**2
    return predictor, theta, blocks, starts, weight


def assert_same_sums(computed, expected, rtol=1e-10):
    """Entry by entry in units of each row's own size: rows and columns of parameters differ by orders."""
    for name in type(expected)._fields if hasattr(expected, "_fields") else expected.__dataclass_fields__:
        a, b = getattr(computed, name), getattr(expected, name)
        assert a.shape == b.shape, name
        assert np.isfinite(a).all(), name
        if name == "hessian":
            size = np.sqrt(np.outer(np.diag(b), np.diag(b)))
        else:  # each parameter and state has a size of its own; windows share it
            size = np.abs(b).max(axis=0, keepdims=True) if b.ndim > 1 else np.abs(b)
            size = np.broadcast_to(size, b.shape)
        wrong = np.abs(a - b) > rtol * size + 1e-300
        assert not wrong.any(), f"{name}: {np.abs(a - b)[wrong][:3]} of {size[wrong][:3]}"


SHAPES = {
    "one window": ((120,), None, None),
    "one group, full": ((80,), 10, None),
    "two groups, full": ((160,), 10, None),
    "last window of one sample": ((101,), 10, None),
    "ragged, padded": ((97, 41, 12), 10, None),
    "records shorter than a window": ((40, 9, 15), 30, None),
    "windows of several blocks": ((1400, 700), 600, None),
    "windows longer than the buffer": ((400,), 333, None),
    "windows of two": ((33,), 2, None),
    "left out": ((130, 64), 20, (37, 58)),
    "left out from the first sample": ((130,), 20, (0, 25)),
    "a whole block left out": ((160,), 10, (20, 40)),
}


SAME_PASSES = [("every", shape) for shape in SHAPES.values()]
SAME_PASSES += [("one output", SHAPES[name]) for name in ("one window", "ragged, padded", "left out")]
SAME_PASSES += [(case, ((300, 131), 50)) for case in CASES]


@NEEDS_COMPILER
def test_numpy_takes_the_place_of_a_second_pass_that_is_not_compiled(fresh, caplog):
    data = simulated(MODE, MODE_AT, levels(300), noise=0.1)
    expected = fit(MODE, data)
    fresh.setattr(linear, "second_source", lambda _: "no C")
    result = fit(MODE, data)
    assert result.std == pytest.approx(expected.std, rel=1e-6)
    assert caplog.text.count("failed on the kernel") == caplog.text.count("from the slower portable pass") > 0


@NEEDS_COMPILER
@pytest.mark.parametrize(("case", "shape"), SAME_PASSES)
def test_the_compiled_kernel_is_the_portable_one(case, shape, fresh):
    """All that a kernel answers, compiled and portable."""
    if not case.startswith("every"):
        fresh.setenv("GBID_CFLAGS", "-O1")
    predictor, theta, blocks, starts, weight = problem(case, *shape)
    v = predictor.at(theta)
    kernels = CompiledLinearKernel(KernelPattern.of(v)), PORTABLE
    (computed,), (expected,) = (kernel.trace(v, blocks, starts, [weight]) for kernel in kernels)
    assert_same_sums(computed.sums, expected.sums)
    np.testing.assert_allclose(computed.begin, expected.begin, rtol=1e-9, atol=1e-12 * np.abs(expected.begin).max())
    live = slice(blocks.n_blocks)
    for a, b in zip(computed.linked[:2], expected.linked[:2], strict=True):  # the ends are in the sums
        np.testing.assert_allclose(a[live], b[live], rtol=1e-9, atol=1e-12 * np.abs(b).max())
    random = np.random.default_rng(8)
    at = Lagrangian(starts, random.normal(size=starts.shape), weight)
    shifted = []
    for column in range(len(theta)):
        other = theta.copy()
        other[column] += (step := 1e-6 * (abs(theta[column]) or 1.0))
        shifted.append(Moved(column, step, predictor.at(other)))
    for a, b in zip(*(kernel.gradient(v, blocks, at) for kernel in kernels), strict=True):
        assert (np.abs(a - b) <= 1e-9 * np.abs(b) + 1e-11 * np.abs(b).max(axis=0)).all()
    second, reference = (kernel.left_out(v, blocks, at, shifted) for kernel in kernels)
    size = np.sqrt(np.diag(expected.sums.hessian))  # of each parameter; the portable ones are differences of gradients
    assert (np.abs(second[0] - reference[0]) <= 1e-4 * np.outer(size, size)).all()
    start = np.sqrt(np.diagonal(expected.sums.hessian_start, axis1=1, axis2=2).max(axis=0))
    assert (np.abs(second[1] - reference[1]) <= 1e-4 * np.outer(size, start)).all()
    some = slice(blocks.n_blocks // 3, blocks.n_blocks)
    prediction = kernels[1].passed(v, blocks, expected.begin)
    for a, b in zip(kernels[0].passed(v, blocks, expected.begin), prediction, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(b).max())
    a, b = (kernel.products(v, blocks, starts) for kernel in kernels)
    np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12 * np.abs(b).max())
    a, b = (kernel.sensitivities(v, blocks, prediction, expected.linked, some) for kernel in kernels)
    assert (np.abs(a - b) <= 1e-12 * np.abs(b).max(axis=(1, 2), keepdims=True)).all()


@NEEDS_COMPILER
@pytest.mark.parametrize("width", [2, 4, 8])
def test_vectors_of_every_width_give_the_same_sums(width, fresh):
    """The vectors of SSE2, AVX2 and AVX-512 on any processor, against those of the target."""
    predictor, theta, blocks, starts, weight = problem("every", *SHAPES["ragged, padded"])
    v, random = predictor.at(theta), np.random.default_rng(8)
    at, results = Lagrangian(starts, random.normal(size=starts.shape), weight), []
    for flags in ("-O1", f"-O1 -DWIDTH={width}"):
        fresh.setenv("GBID_CFLAGS", flags)
        forget_libraries()
        kernel = CompiledLinearKernel(KernelPattern.of(v))
        (traced,) = kernel.trace(v, blocks, starts, [weight])
        assert_same_sums(traced.sums, results[0][0] if results else traced.sums, 1e-13)
        prediction = kernel.passed(v, blocks, traced.begin)
        psi = kernel.sensitivities(v, blocks, prediction, traced.linked, slice(0, blocks.n_blocks))
        second = kernel.left_out(v, blocks, at, [Moved(0, 0.1, predictor.at(theta + 0.1))])
        results.append((traced.sums, *prediction, psi, *second))
    for a, b in zip(*(result[1:] for result in results), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * np.abs(b).max())


@NEEDS_COMPILER
def test_an_entry_that_was_zero_at_first_is_not_forgotten(fresh):
    predictor, theta, blocks, starts, weight = problem("every", (100,), 20)
    zero = theta.copy()
    zero[[q.name for q in predictor.free].index("d")] = 0.0
    zero[[q.name for q in predictor.free].index("k")] = 0.0
    zero[[q.name for q in predictor.free].index("w")] = 0.0
    at_zero, at = predictor.at(zero), predictor.at(theta)
    patterns = zip(KernelPattern.of(at_zero), KernelPattern.of(at), strict=True)
    assert any((now & ~before).any() for before, now in patterns)
    kernel = CompiledLinearKernel(KernelPattern.of(at_zero))
    for v in (at_zero, at, at_zero):  # also back again, with the grown pattern
        assert_same_sums(kernel.sweep(v, blocks, starts, weight), PORTABLE.sweep(v, blocks, starts, weight))


@NEEDS_COMPILER
@pytest.mark.parametrize("focus", ["prediction", "simulation"])
def test_both_engines_fit_alike(focus, fresh):
    rec = simulated(MODE, MODE_AT, levels(700), noise=0.3)
    a = fit(MODE, rec, focus=focus)
    with no_compiler():
        b = fit(MODE, rec, focus=focus)
    assert (a.engine, b.engine) == ("compiled", "numpy")
    assert a.notes == tuple(note for note in b.notes if "portable" not in note)
    assert a.loss == pytest.approx(b.loss, rel=1e-9)
    for name in a.free:
        assert abs(a.parameters[name] - b.parameters[name]) < 1e-4 * a.std_with("white")[name]
    np.testing.assert_allclose(a.covariance_white, b.covariance_white, rtol=1e-5, atol=1e-9 * a.covariance_white.max())


# ---- the cache ----


@NEEDS_COMPILER
def test_variables_of_a_thread_are_looked_up_in_a_function_of_their_own():
    """Clang keeps arguments in registers that the first look-up of a thread may change: fits with zig crashed."""
    heads = []
    for source in Path(gbid.identify.__file__).parent.glob("kernel/*.c"):
        lines = filled(source.name, {}).splitlines()
        for i in (i for i, line in enumerate(lines) if "__thread" in line):
            heads.append(lines[i - 1])
            assert lines[i + 1 : i + 3] == ["  return &w;", "}"], source.name
    assert len(heads) == 3
    assert all("noinline" in head for head in heads)


def test_the_second_load_does_not_compile(fresh, tmp_path):
    fresh.setenv("GBID_CACHE_DIR", str(tmp_path / "new" / "folder"))
    source = SOURCE.format(name="twice", value=2.5)
    assert value_of(compiling.load_library(source), "twice") == 2.5
    (built,) = (tmp_path / "new" / "folder").glob("*.so")
    compiling.load_library.cache_clear()  # as another process would find it

    def never(*_):
        raise AssertionError("compiled again")

    fresh.setattr(compiling, "compile_source", never)
    assert value_of(compiling.load_library(source), "twice") == 2.5
    assert list((tmp_path / "new" / "folder").glob("*.so")) == [built]
    # Another source has another name.
    with pytest.raises(AssertionError, match="compiled again"):
        compiling.load_library(SOURCE.format(name="twice", value=3.5))


@NEEDS_COMPILER
def test_two_processes_at_once_compile_once(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, results = context.Barrier(2), context.Queue()
    source, log = SOURCE.format(name="race", value=11.0), tmp_path / "log"
    arguments = (str(tmp_path / "cache"), source, str(log), ready, results)
    processes = [context.Process(target=load_in_a_process, args=arguments) for _ in range(2)]
    for process in processes:
        process.start()
    assert [results.get(timeout=60) for _ in processes] == [11.0, 11.0]
    for process in processes:
        process.join(30)
        assert process.exitcode == 0
    assert log.read_text() == "compiled\n"
    assert len(list((tmp_path / "cache").glob("*.so"))) == 1


# ---- machines without a compiler ----


DATA = simulated(MODE, MODE_AT, levels(300), noise=0.3)


def assert_portable(words):
    """A fit succeeds without the compiled kernel, and says why."""
    result = fit(MODE, DATA, focus="simulation")
    assert result.success
    assert result.engine == "numpy"
    assert len([note for note in result.notes if words in note]) == 1


def test_without_a_compiler_the_portable_pass_is_used_and_said(fresh, tmp_path):
    fresh.setenv("GBID_CACHE_DIR", str(tmp_path))
    fresh.setenv("CC", "/nonexistent/cc")
    assert_portable(
        "no C compiler found (/nonexistent/cc): the slower portable pass was used; "
        "install gcc, clang or gbid[compiler], or set CC [GB116]"
    )
    assert list(tmp_path.iterdir()) == []


def test_a_compiler_that_fails_is_none(fresh, tmp_path):
    compiler = tmp_path / "broken-cc"
    compiler.write_text('#!/bin/sh\n[ "$1" = --version ] && echo broken 1.0 && exit 0\necho "no luck" >&2\nexit 1\n')
    compiler.chmod(compiler.stat().st_mode | stat.S_IXUSR)
    fresh.setenv("GBID_CACHE_DIR", str(tmp_path / "cache"))
    fresh.setenv("CC", str(compiler))
    assert_portable("failed on the kernel: no luck: the slower portable pass was used")
    assert not list((tmp_path / "cache").glob("*.so"))


def test_a_cache_that_cannot_be_written_is_said(fresh, tmp_path):
    """A file where the folder should be: also for root, who may write anywhere else."""
    (tmp_path / "file").write_text("mine")
    fresh.setenv("GBID_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    if COMPILER is None:
        pytest.skip("no C compiler on this machine: it is missed first")
    assert_portable("cache of compiled kernels cannot be used")
    assert (tmp_path / "file").read_text() == "mine"


# ---- the rest of the process ----

SUBNORMAL = """
import sys
sys.path.insert(0, {tests!r})
import numpy as np
from fit_cases import MODE, MODE_AT, levels, simulated
from gbid.identify import fit

result = fit(MODE, simulated(MODE, MODE_AT, levels(300), noise=0.3), focus="simulation")
smallest = np.array([5e-324, 1e-310])
print(result.engine, (smallest * 1.0).tolist() == [5e-324, 1e-310], 5e-324 / 1.0 > 0, 1e-308 / 4 > 0)
"""


@NEEDS_COMPILER
def test_loading_a_kernel_leaves_small_numbers_alone():
    """A library linked for fast mathematics would make the process flush subnormal numbers to zero."""
    script = SUBNORMAL.format(tests=str(SUPPORT))
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert run.stdout.split() == ["compiled", "True", "True", "True"], run.stderr
