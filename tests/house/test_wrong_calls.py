"""Public names called with wrong arguments: gbid's own error names the argument, its value, and what is expected."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from fit_cases import MODE, MODE_AT, levels, simulated
from fuzzing.calls import package_calls, public_calls, try_call

import gbid
from gbid.core.errors import UsageError

PLANT = gbid.LinearModel(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)))
DATA = gbid.Recording({"u": np.arange(9.0), "y": np.ones(9)}, 1e-3, name="run")
LPV = gbid.load_model("theisen2016")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: gbid.close_loop(None, PLANT), "close_loop: plant = None; give LinearModel"),
        (lambda: gbid.cross_validate(PLANT, None), "cross_validate: result = the LinearModel 'model'; give FitResult"),
        (lambda: gbid.Recording("x", 1e-3), "Recording: signals = 'x'; give a dict by name"),
        (
            lambda: gbid.RotorBearing(pade_order=float("nan")),
            "pade_order = nan; give a whole number of at least 1 or None",
        ),
        (lambda: gbid.report.plot_campbell(LPV), "plot_campbell: models = .*theisen2016.*; give a dict by name"),
        (
            lambda: gbid.fit(gbid.RotorBearing(), DATA, prior={"k_xx": 3}),
            r"prior\['k_xx'\] = 3; give \(a number, a number",
        ),
        (lambda: gbid.check_residuals(None, DATA), "result = None; give FitResult"),
        (lambda: gbid.tune(LPV, inputs="voltage"), "inputs = 'voltage'; give a list"),
        (lambda: gbid.fit(gbid.RotorBearing, DATA), "fit: structure = the class RotorBearing; give Structure"),
        (
            lambda: gbid.fit_multistart(gbid.RotorBearing(), DATA, reach=float("nan")),
            "reach = nan; give a number above 0",
        ),
    ],
)
def test_wrong_kinds_are_refused_at_the_door(call, words):
    with pytest.raises(UsageError, match=words):
        call()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: gbid.fit(gbid.RotorBearing(), DATA, focuss="simulation"),
            r"fit\(\) .* 'focuss'; did you mean 'focus'",
        ),
        (lambda: gbid.tune(LPV, bound={}), r"tune\(\) .* 'bound'; did you mean 'bounds'"),
        (lambda: gbid.fit_multistart(gbid.RotorBearing(), DATA, fix={}), r"fit_multistart\(\) .* did you mean 'fixed'"),
        (lambda: gbid.fit(DATA), r"fit\(\) missing a required argument: 'recordings'"),
    ],
)
def test_a_call_that_does_not_fit_names_the_function_and_the_nearest_argument(call, words):
    with pytest.raises(TypeError, match=words):
        call()


def test_ranges_in_seconds_are_refused():
    data = simulated(MODE, MODE_AT, levels(60), noise=0.1)
    with pytest.raises(UsageError, match=r"left_out\[0\]\[0\] = 0.5; give a whole number"):
        gbid.cross_validate(gbid.fit(MODE, data, max_iterations=1), data, left_out=[(0.5, 1.5)])


def test_a_part_of_the_calls(tmp_path):
    for call in Random(3).sample(package_calls(), 300):
        try_call(call, tmp_path)


@pytest.mark.slow
def test_many_calls(tmp_path):
    for call in Random(4).sample(public_calls(), 3000):
        try_call(call, tmp_path)


def test_public_functions_are_found_again_by_pickle():
    assert pickle.loads(pickle.dumps(gbid.fit)) is gbid.fit
    assert gbid.fit.__module__ == "gbid"
    assert gbid.cross_validate is gbid.validate.cross_validate


def test_a_copy_with_other_values_is_checked():
    with pytest.raises(UsageError, match="LinearModel: name = 3; give a text"):
        replace(PLANT, name=3)


def test_calls_within_a_public_call_are_not_checked(monkeypatch):
    calls, data = [], simulated(MODE, MODE_AT, levels(60), noise=0.1)
    monkeypatch.setattr("gbid.core.option_types.check_call", lambda function, *_: calls.append(function.__name__))
    gbid.fit(MODE, data, max_iterations=1)
    assert calls == ["fit"]


def test_the_check_is_not_imported_before_a_call():
    code = "import sys, gbid; assert not {'numpy', 'gbid.core.option_types'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_public_function_runs_with_one_thread_of_blas_and_leaves_the_number_as_it_was():
    """Threads that wait for each other took 96 s of processor time for 14. `fit_ringdown` has no limit of its own."""
    code = """
import os
import numpy as np, scipy.linalg, threadpoolctl
import gbid
from gbid.core.arrays import one_blas_thread
from gbid.core.errors import DataError
from gbid.control.impact import ringdown
def threads():
    return {each["num_threads"] for each in threadpoolctl.threadpool_info() if each["user_api"] == "blas"}
with one_blas_thread():
    pass
before, inside = threads(), []
ringdown._check_arguments = lambda *args: inside.append(threads())
try:
    gbid.fit_ringdown(gbid.Recording({"p": np.ones((200, 2))}, 1e-3))
except DataError:
    pass
print(before == {2}, inside == [{1}], threads() == before)
"""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["True", "True", "True"]


def test_the_limit_of_blas_holds_in_every_thread():
    """With the limit of another thread unseen, a fit in a second thread took 34 ms instead of 21."""
    code = """
import threading
import numpy as np, scipy.linalg, threadpoolctl
from gbid.core.arrays import one_blas_thread
seen = []
def look():
    seen.append({each["num_threads"] for each in threadpoolctl.threadpool_info() if each["user_api"] == "blas"})
def limited(entered=None, leave=None):
    with one_blas_thread():
        look()
        if entered:
            entered.set()
            leave.wait()
def run(*events):
    thread = threading.Thread(target=limited, args=events)
    thread.start()
    return thread
limited()
run().join()  # beside the main thread, which had the limit before
entered, leave = threading.Event(), threading.Event()
with one_blas_thread():
    second = run(entered, leave)
    entered.wait()
look()  # the first has left, the second has not
leave.set()
second.join()
look()
print(seen == [{1}, {1}, {1}, {1}, {2}])
"""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["True"]
