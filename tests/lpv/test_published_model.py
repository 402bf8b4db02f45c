"""The published machine against the paper's own figures, and an independent transcription of its tables."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from gbid.control import close_loop, p_controller
from gbid.core.files import share_folder
from gbid.core.units import conversion_factor
from gbid.lpv import LPVModel, load_machine, load_model
from gbid.lpv.model import TERMS
from gbid.lpv.model_file import ProportionalDesign

# Table B.6, taken from the paper's text by a program, not from the model file.
TABLE_B6 = """
k_xx -3.168e+08 -9.758e+07 1.790e+04 -2.192e+03 7.472e+06 -1.462e+00
k_xy 4.020e+07 -1.023e+07 6.391e+03 1.256e+03 4.305e+05 -9.054e-01
k_yx -9.321e+05 9.624e+06 -1.428e+04 2.880e+03 -1.782e+06 3.838e-01
k_yy -2.832e+08 -1.026e+08 -4.493e+02 9.310e+02 5.845e+06 -7.379e-01
d_xx -1.855e+05 4.036e+04 -3.329e+01 1.003e-02 -3.149e+03 5.819e-03
d_xy -6.016e+03 -3.643e+03 4.422e-01 3.002e-01 7.513e-02 3.918e-04
d_yx 3.087e+04 -8.330e+03 -3.198e+00 -5.626e-01 4.052e-02 -3.087e-01
d_yy -2.673e+05 6.863e+04 -7.541e+00 7.258e-01 -5.339e+03 6.750e-04
b_xx 1.326e+09 1.294e+07 -4.671e+03 6.982e+02 -1.400e+06 1.962e-01
b_xy -1.504e+07 3.229e+06 4.720e+03 -9.969e+02 -8.013e+04 2.687e-01
b_yx -5.080e+06 1.514e+06 -2.549e+03 -5.538e+01 4.262e+04 -2.298e-01
b_yy 1.099e+08 2.427e+07 -5.691e+02 -9.093e+01 -1.545e+06 2.269e-02
tau_x 1.401e-03 -2.548e-04 2.348e-09 5.497e-09 1.941e-05 -5.711e-12
tau_y 7.799e-04 -1.890e-04 3.186e-08 -3.651e-09 1.325e-05 -2.466e-12
"""
PRINTED = {row.split()[0]: [float(v) for v in row.split()[1:]] for row in TABLE_B6.strip().splitlines()}
CORRECTED = {("b_xx", 0): 1.326e8, ("d_xy", 4): 7.513e2, ("d_yx", 4): 4.052e2, ("d_yx", 5): -3.087e-4}

MACHINE = load_machine("theisen2016")
GRID = list(product((3, 4, 5, 6, 7), (0, 4000, 6000)))
OPEN = ((126.590, 0.03523), (132.110, 0.02914))
CLOSED = ((99.925, 0.31841), (105.097, 0.42442))


@pytest.fixture(scope="module")
def model() -> LPVModel:
    return load_model("theisen2016")


def closed_modes(
    model: LPVModel, pressure: float = 6, speed: float = 0, c: ProportionalDesign | None = MACHINE.controller
) -> list[tuple[float, float]]:
    assert c is not None
    controller = p_controller(c.kappa_x, c.kappa_y, c.lowpass_hz, c.lowpass_order)
    return close_loop(model.plant_at(pressure, speed), controller).modes()[:2]


def rounded(modes: list[tuple[float, float]], hz: int, zeta: int) -> tuple[tuple[float, float], ...]:
    return tuple((round(f, hz), round(z, zeta)) for f, z in modes[:2])


def test_coefficients_are_the_printed_ones_with_four_corrections(model: LPVModel) -> None:
    assert set(model.coefficients) == set(PRINTED)
    for key, row in PRINTED.items():
        scale = 1.0 if key.startswith("tau") else 1e-3
        expected = [scale * CORRECTED.get((key, i), value) for i, value in enumerate(row)]
        np.testing.assert_allclose(model.coefficients[key], expected, rtol=1e-14, atol=0)


def test_other_tables(model: LPVModel) -> None:
    assert dict(model.actuators) == {  # Table 2
        "p1_x": 3078, "p2_x": 8143, "p1_y": 2452, "p2_y": 6494, "kappa_x": 1.863, "kappa_y": 1.865,
    }  # fmt: skip
    assert MACHINE.piezo_controllers is not None
    table_a5 = [(p.gain, p.zero, p.pole) for p in MACHINE.piezo_controllers.piezos]
    assert table_a5 == [(0.926, 1996, 101), (0.927, 1983, 101), (0.220, 8349, 101), (0.640, 2945, 101)]
    table_1 = [q for q in MACHINE.rig.values() if q.source == "Table 1"]
    assert [(q.value, q.unit) for q in table_1] == [
        (40, "mm"), (40, "mm"), (500, "mm"), (2.04, "kg"), (140, "mm"), (1.5, "kg"), (2, "mm"),
    ]  # fmt: skip
    assert MACHINE.rig["clearance"].to("m") == pytest.approx(25e-6, rel=1e-15)
    assert MACHINE.rig["sample_time"].to("s") == pytest.approx(2e-4, rel=1e-15)
    assert model.domain.pressure_bar == (3, 7)
    assert model.domain.speed_rpm == (0, 6000)
    assert list(model.operating_points) == GRID
    assert model.pade_order == 1
    c = MACHINE.controller
    assert c is not None
    assert (c.kappa_x, c.kappa_y, c.lowpass_hz, c.lowpass_order) == (1.125, 0.99, 1000, 1)


def test_reference_modes_are_what_the_model_gives(model: LPVModel) -> None:
    computed = 0
    for reference in MACHINE.reference_modes:
        if reference.kind == "measured":
            continue
        at = reference.pressure_bar, reference.speed_rpm
        modes = model.at(*at).modes() if reference.loop == "open" else closed_modes(model, *at)
        digits = (1, 3) if reference.kind == "expected" else (3, 5)
        assert rounded(modes, *digits) == reference.modes
        computed += 1
    assert computed == 4


def test_modes_of_tables_3_and_4_as_transcribed(model: LPVModel) -> None:
    table = {(r.loop, r.kind): r.modes for r in MACHINE.reference_modes}
    assert table["open", "expected"] == ((126.6, 0.035), (132.1, 0.029))
    assert table["closed", "expected"] == ((99.9, 0.318), (105.1, 0.424))
    assert table["open", "measured"] == ((126.3, 0.026), (134.4, 0.016))
    assert table["closed", "measured"] == ((89.9, 0.658), (111.6, 0.446))
    assert table["open", "computed"] == OPEN
    assert table["closed", "computed"] == CLOSED


@pytest.mark.parametrize("point", [*GRID, *((p, 2050) for p in (3, 4, 5, 6, 7))])
def test_open_loop_is_stable_where_the_paper_ran_it(model: LPVModel, point: tuple[float, float]) -> None:
    plant = model.plant_at(*point)
    assert plant.is_stable()
    assert len(plant.modes()) == 2


def test_static_gain(model: LPVModel) -> None:
    gain = model.at(6, 0).static_gain()
    assert np.diag(gain).round(2).tolist() == [0.25, 0.29]
    k, b = ([[model.key_parameters(6, 0)[f"{q}_{i}{j}"] for j in "xy"] for i in "xy"] for q in "kb")
    np.testing.assert_allclose(gain, -np.linalg.inv(k) @ b, rtol=1e-10)  # C (-A)^-1 B with K p + B u = 0
    kappa = np.diag([1.863, 1.865])
    np.testing.assert_allclose(model.plant_at(6, 0).static_gain(), gain @ kappa, rtol=1e-10)


def test_delays_over_the_operating_range(model: LPVModel) -> None:
    pressure, speed = np.meshgrid(np.linspace(3, 7, 81), np.linspace(0, 6000, 121))
    parameters = model.key_parameters(pressure, speed)
    delays = 1e3 * np.stack([parameters["tau_x"], parameters["tau_y"]])
    assert delays.min() == pytest.approx(0.055, abs=5e-4)
    assert delays.max() == pytest.approx(0.83, abs=5e-3)


def broken_figures(model: LPVModel, controller: ProportionalDesign | None = MACHINE.controller) -> set[str]:
    """What of the paper a model does not reproduce."""
    broken = set()
    if rounded(model.at(6, 0).modes(), 1, 3) != ((126.6, 0.035), (132.1, 0.029)):
        broken.add("open loop")
    if rounded(closed_modes(model, c=controller), 1, 3) != ((99.9, 0.318), (105.1, 0.424)):
        broken.add("closed loop")
    if not all(model.at(*point).is_stable() for point in [*GRID, (6, 2050)]):
        broken.add("stability")
    return broken


def undone(model: LPVModel, entry: str, factor: float) -> LPVModel:
    name, term = entry.rstrip("]").split("[")
    coefficients = {key: list(values) for key, values in model.coefficients.items()}
    if name == "scale":
        for key in coefficients:
            if key.startswith(f"{term}_"):
                coefficients[key] = [factor * value for value in coefficients[key]]
    else:
        coefficients[name][TERMS.index(term)] *= factor
    return replace(model, coefficients={key: tuple(values) for key, values in coefficients.items()})


def test_nothing_is_broken_with_all_corrections(model: LPVModel) -> None:
    assert broken_figures(model) == set()
    assert len(MACHINE.corrections) == 7


@pytest.mark.parametrize(
    ("entry", "figure"),
    [
        ("scale[k]", "open loop"),
        ("scale[d]", "open loop"),
        ("scale[b]", "closed loop"),
        ("b_xx[1]", "closed loop"),
        ("d_xy[P^2]", "open loop"),
        ("d_yx[P^2]", "open loop"),
        ("d_yx[Omega^2]", "stability"),
    ],
)
def test_each_correction_is_needed(model: LPVModel, entry: str, figure: str) -> None:
    (correction,) = (c for c in MACHINE.corrections if c.entry == entry)
    assert len(correction.reason) > 20
    assert figure in broken_figures(undone(model, entry, correction.printed / correction.corrected))


def test_the_printed_scale_is_what_the_printed_unit_says() -> None:
    text = (share_folder("models") / "theisen2016.yaml").read_text(encoding="utf-8")
    assert "unit: {k: N/(g m), d: N s/(g m), b: N/(g m), tau: s}" in text
    assert "scale: {k: 1.0e+3, d: 1.0e+3, b: 1.0e+3, tau: 1.0}" in text
    assert conversion_factor("N/(g*m)", "N/(kg*m)") == pytest.approx(1e3)


def test_a_wrong_lowpass_unit_would_show(model: LPVModel) -> None:
    assert MACHINE.controller is not None
    wrong = replace(MACHINE.controller, lowpass_hz=1000 / (2 * np.pi))  # 1000 taken as rad/s
    assert "closed loop" in broken_figures(model, wrong)


def test_plant_is_equation_20(model: LPVModel) -> None:
    """The response from the paper's formulas, without any state space."""
    q = model.key_parameters(4.3, 3100)
    frequency = np.array([0.5, 40.0, 118.0, 123.0, 700.0])
    expected = []
    for s in 2j * np.pi * frequency:
        k, d, b = (np.array([[q[f"{a}_{i}{j}"] for j in "xy"] for i in "xy"]) for a in "kdb")
        bearing = np.linalg.solve(s**2 * np.eye(2) - s * d - k, b)
        delay = np.diag([(1 - q[f"tau_{j}"] / 2 * s) / (1 + q[f"tau_{j}"] / 2 * s) for j in "xy"])
        act = [1.863 / ((s / 3078 + 1) * (s / 8143 + 1)), 1.865 / ((s / 2452 + 1) * (s / 6494 + 1))]
        expected.append(bearing @ delay @ np.diag(act))
    plant = model.plant_at(4.3, 3100)
    np.testing.assert_allclose(plant.frequency_response(frequency), expected, rtol=1e-9)
    assert (plant.input_names, plant.output_names) == (("r_x", "r_y"), ("p_x", "p_y"))


def test_higher_pade_orders_come_closer_to_the_delay(model: LPVModel) -> None:
    q = model.key_parameters(3, 2000)
    s = 2j * np.pi * 300.0
    k, d, b = (np.array([[q[f"{a}_{i}{j}"] for j in "xy"] for i in "xy"]) for a in "kdb")
    delay = np.diag([np.exp(-s * q["tau_x"]), np.exp(-s * q["tau_y"])])
    exact = np.linalg.solve(s**2 * np.eye(2) - s * d - k, b) @ delay
    errors = [np.abs(model.at(3, 2000, pade_order=n).frequency_response(300.0)[0] - exact).max() for n in (1, 2, 3, 4)]
    assert all(later < 0.2 * earlier for earlier, later in pairwise(errors))
    third = replace(model, pade_order=3).at(3, 2000)
    assert third.n_states == 4 + 6
    np.testing.assert_allclose(third.static_gain(), model.at(3, 2000).static_gain(), rtol=1e-9)
