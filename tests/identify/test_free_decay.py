"""Free decays and constant forces: fitted as they are, and refused only where a parameter is not determined."""

import numpy as np
import pytest
from scipy.linalg import expm

from gbid import LinearStructure, Parameter, Recording, RotorBearing, fit, fit_ringdown, load_model
from gbid.core.errors import DataError, UsageError
from gbid.structure import evaluate

H, N = 1e-3, 2000
TRUE = {"k": 4000.0, "d": 3.0}
NOISE = 0.01


def oscillator(inputs=(), *, gain=True, disturbance=None, name="oscillator"):
    """Mass on a spring, per unit mass; its gain b only with an input."""
    parameters = [Parameter("k", 3500.0), Parameter("d", 1.0), *([Parameter("b", 1.0)] if gain else [])]

    def matrices(p):
        results = {"A": [[0, 1], [-p.k, -p.d]], "C": [[1, 0]]}
        results |= {"B": [[0], [p.b]]} if gain else {}
        return results | ({} if disturbance is None else {"K": disturbance})

    return LinearStructure(name, parameters, matrices, inputs, "y")


ALONE = oscillator(gain=False)


def decay(start, name="decay", seed=0, force=None, gain=1.0, n=N):
    """Recording of the oscillator from a start, under a constant force."""
    F = expm(np.array([[0, 1, 0], [-TRUE["k"], -TRUE["d"], gain], [0, 0, 0]]) * H)
    x, y = np.array([*start, force or 0.0]), []
    for _ in range(n):
        y.append(x[0])
        x = F @ x
    noise = NOISE * np.random.default_rng(seed).standard_normal(n)
    signals = {"y": (np.array(y) + noise)[:, None]}
    if force is not None:
        signals["u"] = np.full((n, 1), force)
    return Recording(signals, H, name=name)


def close(result, names=("k", "d"), true=TRUE):
    away = [abs(result.parameters[name] - true[name]) / result.std[name] for name in names]
    assert result.success, result.status
    assert max(away) < 4, away


@pytest.mark.parametrize("focus", ["simulation", "prediction"])
def test_structure_without_inputs_fits_two_decays_each_from_its_own_state(focus):
    starts = [(1.0, 0.0), (0.0, 40.0)]
    result = fit(ALONE, [decay(x, f"r{i}", i) for i, x in enumerate(starts)], focus=focus)
    close(result)
    assert np.allclose(result.initial_states, starts, atol=0.1)
    assert result.options.inputs == ()
    assert result.model.B.shape == (2, 0)
    assert result.static_gain_std.shape == (1, 0)


def test_structure_without_inputs_may_give_an_empty_matrix_of_inputs():
    empty = LinearStructure("e", ALONE.parameters, lambda p: {**ALONE.matrices(p), "B": [[], []]}, (), "y")
    recording = decay((1.0, 0.0))
    assert fit(empty, recording).parameters == fit(ALONE, recording).parameters


def test_disturbance_gain_predicts_a_decay():
    result = fit(oscillator(gain=False, disturbance=[[5.0], [20.0]]), decay((1.0, 0.0)))
    assert result.success
    assert result.parameters["k"] == pytest.approx(TRUE["k"], rel=1e-3)


def test_decay_of_a_structure_with_inputs():
    """No inputs, or an input that is zero throughout: the same fit as of the structure without inputs."""
    recording = decay((1.0, 0.0), force=0.0)
    alone, none, zero = (
        fit(ALONE, recording, focus="simulation"),
        fit(oscillator("u"), recording, inputs=(), fixed={"b": 1.0}, focus="simulation"),
        fit(oscillator("u"), recording, fixed={"b": 1.0}, focus="simulation"),
    )
    for result in (none, zero):
        assert [result.parameters[name] for name in TRUE] == pytest.approx([alone.parameters[n] for n in TRUE])
        assert [result.std[name] for name in TRUE] == pytest.approx([alone.std[n] for n in TRUE], rel=1e-6)
    assert zero.notes == ("recording 'decay': input 'u' is 0 throughout, a free decay [GB115]",)


@pytest.mark.parametrize("options", [{"inputs": ()}, {}], ids=["no input", "zero input"])
def test_a_gain_without_input_is_refused_by_name(options):
    with pytest.raises(DataError, match=r"do not determine b; fix each \(fixed=\.\.\.\), or add a recording"):
        fit(oscillator("u"), decay((1.0, 0.0), force=0.0), **options)


def test_one_of_two_recordings_without_input():
    rng = np.random.default_rng(3)
    u = rng.standard_normal((N, 1)) * 400
    shaken = evaluate(oscillator("u"), {**TRUE, "b": 2.0}).simulate(u, H)
    shaken = Recording({"u": u, "y": shaken + NOISE * rng.standard_normal((N, 1))}, H, name="shaken")
    result = fit(oscillator("u"), [shaken, decay((1.0, 0.0), force=0.0)], focus="simulation")
    close(result, ("k", "d", "b"), {**TRUE, "b": 2.0})


def test_a_constant_force_determines_its_gain():
    """It moves the rest position, so that the gain follows from it; a delay would not."""
    force = 2000.0
    result = fit(oscillator("u"), decay((1.0, 0.0), force=force), focus="simulation")
    close(result, ("k", "d", "b"), {**TRUE, "b": 1.0})
    assert "a constant force" in " ".join(result.notes)
    delayed = LinearStructure(
        "late",
        [*oscillator("u").parameters, Parameter("tau", 1e-3, lower=0.0)],
        lambda p: {**ALONE.matrices(p), "B": [[0], [0]], "B_delayed": [[0], [p.b]], "delay": [p.tau]},
        "u",
        "y",
    )
    with pytest.raises(DataError, match="no recording moves u: the data do not determine tau;"):
        fit(delayed, decay((1.0, 0.0), force=force), focus="simulation")


# ---- rotor on gas bearings ----


@pytest.fixture(scope="module")
def bearing_decays():
    """Three decays of the published rotor at 6 bar, its parameters and its modes."""
    known = load_model("theisen2016").key_parameters(6.0, 0.0)
    structure = RotorBearing(delay="exact", disturbance_gain="none")
    model = evaluate(structure, known)
    rng = np.random.default_rng(1)
    records = []
    for i, start in enumerate(([2e-6, 0, 0, 0], [0, 2e-6, 0, 0], [1e-6, -1e-6, 0, 1e-3])):
        p = model.simulate(np.zeros((4000, 2)), 2e-4, initial_state=np.array(start))
        records.append(Recording({"p": p + 1e-8 * rng.standard_normal(p.shape)}, 2e-4, name=f"decay {i}"))
    return structure, records, known, model.modes()


def test_ring_down_and_fit_agree_on_the_modes_of_decays(bearing_decays):
    structure, records, known, modes = bearing_decays
    held = {name: v for name, v in known.items() if name.startswith(("b_", "tau_"))}
    fitted = fit(structure, records, inputs=(), fixed=held, focus="simulation")
    assert fitted.success
    assert {fitted.start_origin[name] for name in fitted.free} == {"data"}
    ringing = fit_ringdown(records, force=())
    assert ringing.success
    assert ringing.n_impacts == 0
    both = np.column_stack([ringing.frequency_hz, ringing.damping])
    assert both == pytest.approx(np.array(fitted.model.modes()), rel=1e-3)
    away = (np.array(fitted.model.modes()) - np.array(modes)) / fitted.modes_std
    assert np.abs(away).max() < 4


def test_ring_down_takes_a_force_of_zero_as_a_decay(bearing_decays):
    _, records, _, _ = bearing_decays
    quiet = [Recording({**r.signals, "f": np.zeros((r.n_samples, 2))}, r.sample_time, name=r.name) for r in records]
    assert np.array_equal(fit_ringdown(quiet).stiffness, fit_ringdown(records, force=()).stiffness)


def test_ring_down_refuses_lags_of_a_force_that_is_not_there(bearing_decays):
    with pytest.raises(UsageError, match="free decays have no force that acts through lags"):
        fit_ringdown(bearing_decays[1], force=(), lags=3)
