"""The polynomial basis, the guard of the domain, and model files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from gbid.core.errors import ExtrapolationWarning, UsageError
from gbid.core.files import share_folder
from gbid.lpv import Domain, LPVModel, load_machine, load_model, save_model
from gbid.lpv.model import TERMS, basis, polynomial
from gbid.structure import KEY_PARAMETERS

POINTS = st.tuples(st.floats(3, 7), st.floats(0, 6000))


@pytest.fixture(scope="module")
def model() -> LPVModel:
    return load_model("theisen2016")


@pytest.fixture
def text() -> str:
    return (share_folder("models") / "theisen2016.yaml").read_text(encoding="utf-8")


def broken(tmp_path: Path, text: str, old: str, new: str) -> str:
    """Return the message for the published file with one text replaced."""
    assert text.count(old) == 1
    path = tmp_path / "broken.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(UsageError) as caught:
        load_model(path)
    return str(caught.value).replace(f"{path}", "FILE")


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


# The basis


def test_terms_are_in_the_order_of_equation_16() -> None:
    assert basis(2.0, 10.0) == (1.0, 2.0, 10.0, 20.0, 4.0, 100.0)
    assert polynomial([1, 20, 300, 4000, 50000, 600000], basis(2.0, 10.0)) == 60283041.0
    assert TERMS == ("1", "P", "Omega", "Omega P", "P^2", "Omega^2")


# The model


@settings(max_examples=50, deadline=None)
@given(point=POINTS)
def test_key_parameters_are_the_written_out_polynomial(model: LPVModel, point: tuple[float, float]) -> None:
    P, W = point
    values = model.key_parameters(P, W)
    assert tuple(values) == KEY_PARAMETERS
    for key, c in model.coefficients.items():
        expected = c[0] + c[1] * P + c[2] * W + c[3] * W * P + c[4] * P**2 + c[5] * W**2
        size = sum(abs(v) for v in np.multiply(c, basis(P, W)))
        assert abs(values[key] - expected) <= 1e-14 * size


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_symbols_give_the_numbers(model: LPVModel, kind: type) -> None:
    P, Omega = kind.sym("P"), kind.sym("Omega")
    function = ca.Function("key", [P, Omega], list(model.key_parameters(P, Omega).values()))
    for point in ((3, 0), (5, 6000), (6.3, 2050.0)):
        symbolic = [float(v) for v in function(*point)]
        np.testing.assert_allclose(symbolic, list(model.key_parameters(*point).values()), rtol=1e-13)


def test_a_symbol_beside_a_number_is_half_guarded(model: LPVModel) -> None:
    model.key_parameters(5, ca.SX.sym("Omega"))
    with pytest.raises(UsageError, match="pressure_bar = 8"):
        model.key_parameters(8, ca.SX.sym("Omega"))


def test_arrays_broadcast(model: LPVModel) -> None:
    table = model.key_parameters([[3], [5], [7]], np.array([0, 6000], dtype=np.int16))
    assert table["k_xx"].shape == (3, 2)
    assert table["tau_y"][2, 1] == model.key_parameters(7, 6000)["tau_y"]


def test_at_holds_the_key_parameters(model: LPVModel) -> None:
    q, at = model.key_parameters(4, 1000), model.at(4, 1000)
    np.testing.assert_array_equal(at.A[2:4, :2], [[q["k_xx"], q["k_xy"]], [q["k_yx"], q["k_yy"]]])
    np.testing.assert_array_equal(at.A[2:4, 2:4], [[q["d_xx"], q["d_xy"]], [q["d_yx"], q["d_yy"]]])
    assert at.input_names == ("u_x", "u_y")
    assert at.output_names == ("p_x", "p_y")
    assert at.dt is None
    assert at.K is None
    assert at.name == "theisen2016 at 4 bar, 1000 rpm"


def test_at_has_the_hold_of_its_structure(model: LPVModel) -> None:
    linear, u = model.at(3.0, 0.0), np.random.default_rng(1).normal(size=(400, 2)) * 1e-5
    A, B, C, D = (np.array(each) for each in (linear.A, linear.B, linear.C, linear.D))
    _, expected, _ = scipy.signal.lsim((A, B, C, D), u, np.arange(400) / 5000, interp=True)
    np.testing.assert_allclose(linear.simulate(u, 1 / 5000), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ((2.9, 0), r"model 'theisen2016': pressure_bar = 2.9 lies outside its domain \[3, 7\]"),
        ((7.1, 0), "pressure_bar = 7.1"),
        ((5, -1), r"speed_rpm = -1 lies outside its domain \[0, 6000\]"),
        ((5, 6001), "speed_rpm = 6001 .* set extrapolate=True"),
    ],
)
def test_domain_guard(model: LPVModel, point: tuple[float, float], message: str) -> None:
    for verb in (model.at, model.plant_at, model.key_parameters):
        with pytest.raises(UsageError, match=message):
            verb(*point)
        with pytest.warns(ExtrapolationWarning, match="lies outside its domain") as caught:
            verb(*point, extrapolate=True)
        assert [w.filename for w in caught] == [__file__]


def test_extrapolation_inside_warns_not(model: LPVModel) -> None:
    for corner in ((3, 0), (7, 6000), (3, 6000), (7, 0)):
        model.at(*corner, extrapolate=True)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, "5", None, True, 5 + 1j])
def test_values_that_are_no_numbers(model: LPVModel, bad: object) -> None:
    for extrapolate in (False, True):
        for verb in (model.at, model.plant_at, model.key_parameters):
            with pytest.raises(UsageError, match=r"pressure_bar = .* (is not finite|is not a number)"):
                verb(bad, 0, extrapolate=extrapolate)
            with pytest.raises(UsageError, match=r"speed_rpm = .* (is not finite|is not a number)"):
                verb(5, bad, extrapolate=extrapolate)


def test_one_point_outside_an_array(model: LPVModel) -> None:
    with pytest.raises(UsageError, match="speed_rpm = 7000"):
        model.key_parameters(5, np.array([0, 7000.0]))
    with pytest.raises(UsageError, match="is not finite"):
        model.key_parameters(5, np.array([0, np.nan]))
    with pytest.raises(UsageError, match="give one operating point"):
        model.at(5, np.array([0.0, 1.0]))


def test_no_delay_below_zero(model: LPVModel) -> None:
    with (
        pytest.warns(ExtrapolationWarning, match="speed_rpm = 10000"),
        pytest.raises(UsageError, match=r"tau_y = -.* s at 7 bar, 10000 rpm"),
    ):
        model.at(7, 10_000, extrapolate=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: {"coefficients": {}}, "k_xx, k_xy.* missing"),
        (lambda m: {"coefficients": {**m.coefficients, "d_xy": (1.0,) * 5}}, "d_xy = .* give 6 finite numbers"),
        (lambda m: {"coefficients": {**m.coefficients, "d_xy": (np.nan,) * 6}}, "d_xy = .* give 6 finite numbers"),
        (lambda m: {"coefficients": {**m.coefficients, "k_zz": (0.0,) * 6}}, "k_zz unknown; choose from k_xx"),
        (lambda m: {"actuators": {"p1_x": 1.0}}, "actuators: p2_x, .* missing"),
        (lambda m: {"actuators": {**m.actuators, "p1_y": -1.0}}, r"p1_y = -1\.0; give a finite number, poles positive"),
        (lambda m: {"pade_order": 0}, "pade_order = 0"),
    ],
)
def test_models_that_are_not_whole(model: LPVModel, change, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        replace(model, **change(model))


def test_a_model_without_actuators(model: LPVModel) -> None:
    bare = replace(model, actuators={})
    assert bare.at(6, 0).n_states == 6
    with pytest.raises(UsageError, match="has no actuators"):
        bare.plant_at(6, 0)


def test_domain_checks_itself() -> None:
    with pytest.raises(UsageError, match=r"speed_rpm = \[5, 1\]; give two finite numbers, lower first"):
        Domain((3, 7), (5, 1))
    assert Domain((3, 7), (0, 0)).contains(3, [0, 0])
    assert not Domain((3, 7), (0, 0)).contains([3, np.nan], 0)
    wide = Domain((3, 7), (0, 6000))
    assert wide.contains([3, 5, 7], [0, 3000, 6000])
    assert [wide.contains(P, n) for P, n in ((2.9, 3000), (7.1, 3000), (5, -1), (5, 6001))] == [False] * 4


# Files


def test_round_trip(model: LPVModel, tmp_path: Path) -> None:
    path = tmp_path / "deeper" / "mine.yaml"
    save_model(model, path)
    assert load_model(path) == model
    assert load_model(str(path)) == model
    with pytest.raises(UsageError, match="exists already"):
        save_model(replace(model, name="other"), path)
    assert load_model(path).name == "theisen2016"
    save_model(replace(model, name="other"), path, overwrite=True)
    assert load_model(path).name == "other"
    assert [p.name for p in path.parent.iterdir()] == ["mine.yaml"]


@settings(max_examples=10, deadline=None)
@given(values=st.lists(st.floats(-1e300, 1e300), min_size=6, max_size=6), order=st.integers(1, 4))
def test_round_trip_of_any_numbers(tmp_path_factory: pytest.TempPathFactory, values: list[float], order: int) -> None:
    coefficients = {key: tuple(values) for key in KEY_PARAMETERS}
    model = LPVModel("bare", coefficients, Domain((0.1, 1e-7 + 0.1), (0, 1e5)), pade_order=order)
    path = tmp_path_factory.mktemp("any") / "m.yaml"
    save_model(model, path)
    assert load_model(path) == model


def test_names_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no model 'theisen' comes with gbid; there are: .*theisen2016"):
        load_model("theisen")
    with pytest.raises(UsageError, match=r"none\.yaml: no such file"):
        load_model(tmp_path / "none.yaml")
    with pytest.raises(UsageError, match=r"a model file ends in \.yaml"):
        save_model(load_model("theisen2016"), tmp_path / "m.txt")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: [1, 2\nb: 3\n", r":2:\d+: not valid YAML"),
        (b"a: 1\na: 2\n", r":2:1: not valid YAML: found duplicate key"),
        (b"- 1\n", ":1:1: expected keys with values, found list"),
        (b"\xff\xfe\x00", "not a text file in UTF-8"),
        (b"1: 2\n", "Keys should be strings"),
        (b"name: x\n", "'kind' is missing"),
        (b"x: !!python/object:os.system {}\n", "unknown key 'x'"),
    ],
)
def test_files_that_are_no_models(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "m.yaml"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=message) as caught:
        load_model(path)
    assert str(path) in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  p1_x: 3078", "  p1_x: fast", "actuators.p1_x = 'fast'"),
        ("  p1_x: 3078", "  p1_x: .nan", "actuators.p1_x = nan"),
        ("  p1_x: 3078", "  p1_w: 3078", "unknown key 'actuators.p1_w'"),
        ("kind: lpv_model", "kind: recording", "kind = 'recording'"),
        ("schema_version: 1", "schema_version: 2", "schema_version = 2"),
        ("    loop: open, kind: measured", "    loop: half, kind: measured", "loop = 'half'"),
        ("  speed_rpm: [0, 6000]", "  speed_rpm: [0]", "domain.speed_rpm"),
        ("    tau_y: [7.799e-04,", "    tau_y: [", "key_parameters.coefficients.tau_y"),
        ("    tau_y: [7.799e-04,", "    tau_z: [7.799e-04,", "coefficients: tau_z unknown; expected k_xx"),
        ("  scale: {k: 1.0e+3,", "  scale: {", "scale: k missing; expected k, d, b, tau"),
        ("Omega, Omega P, P^2", "Omega, P^2, Omega P", "the order must be [1, P, Omega, Omega P, P^2, Omega^2]"),
        ("    printed: 1.326e+09", "    printed: 1.3e+09",
         "b_xx[1] is corrected from 1.3e+09, but the table has 1.326e+09"),
        ("  - entry: d_yx[Omega^2]", "  - entry: d_yx[Omga^2]",
         "no entry 'd_yx[Omga^2]' to correct; did you mean 'd_yx[Omega^2]'?"),
        ("  - entry: d_yx[P^2]", "  - entry: d_xy[P^2]", "entry 'd_xy[P^2]' is corrected twice"),
        ("  - entry: d_yx[P^2]", "  - entry: zzz", "no entry 'zzz' to correct; write name[term]"),
    ],
)  # fmt: skip
def test_broken_files_are_told_with_their_line(tmp_path: Path, text: str, old: str, new: str, message: str) -> None:
    if "loop" in old:
        old, new = old.lstrip(), new.lstrip()
        old, new = (
            part.replace("loop: ", "speed_rpm: 0, loop: ") + ", source: Tables 3 and 4,\n     modes: [[126.3"
            for part in (old, new)
        )
    told = broken(tmp_path, text, old, new)
    (told,) = (problem for problem in told.splitlines() if message in problem)
    assert told.startswith("FILE:")
    line = int(told.split(":")[1])
    expected = line_of(text, old)
    assert expected <= line <= expected + 1


def test_all_problems_are_told_at_once(tmp_path: Path, text: str) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(text.replace("p2_x: 8143", "p2_x: x").replace("value: 2.04", "value: [1]"), encoding="utf-8")
    with pytest.raises(UsageError) as caught:
        load_model(path)
    told = str(caught.value).splitlines()
    assert len(told) == 2
    assert all(line.startswith(f"{path}:") for line in told)


def test_corrections_are_optional_and_units_default_to_si(model: LPVModel, tmp_path: Path) -> None:
    rows = "\n".join(f"    {key}: {list(c)}" for key, c in model.coefficients.items())
    path = tmp_path / "own.yaml"
    path.write_text(
        "kind: lpv_model\nschema_version: 1\nname: own\n"
        "domain: {pressure_bar: [3, 7], speed_rpm: [0, 6000]}\n"
        f'key_parameters:\n  terms: ["1", P, Omega, Omega P, P^2, Omega^2]\n  coefficients:\n{rows}\n',
        encoding="utf-8",
    )
    own = load_model(path)
    assert load_machine(path).corrections == ()
    assert own.at(6, 0).modes() == model.at(6, 0).modes()
