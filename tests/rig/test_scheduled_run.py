"""Recordings along a course of pressure and speed, against an adaptive integration, and from the YAML."""

import numpy as np
import pytest
from rig_point import BARE, machine
from scipy.integrate import solve_ivp

import gbid
from gbid.core.errors import UsageError
from gbid.rig import Course, Prbs, Scatter, ScheduledRun, Stationary, Unbalance, record

TS = 2e-4
LPV = gbid.load_model("theisen2016")


def test_rotor_follows_the_surfaces():
    """Unbalance alone drives it, while the pressure halves and the speed rises tenfold within a tenth of a second."""
    run = ScheduledRun(Course((0.0, 0.02, 0.1), (7.0, 7.0, 3.5), (600.0, 600.0, 6000.0)), Stationary(0.1))
    unbalance = Unbalance(3e-6, 0.7)
    rig = machine(sensors=BARE, unbalance=unbalance)
    made = record(rig, run, conditions={}, seed=2, name="a", settle_s=0, surfaces=LPV.key_parameters)
    turning, first = run.turning(), made.signal("phi")[0, 0]

    def rates(t, s):
        pressure, speed = (float(v) for v in run.course.at(np.array(t)))
        p = LPV.key_parameters(pressure, speed)
        K, D = (np.reshape([p[f"{letter}_{pair}"] for pair in ("xx", "xy", "yx", "yy")], (2, 2)) for letter in "kd")
        angle = first + float(turning.angle(np.array(t))) + unbalance.phase_rad
        omega, alpha = (float(f(np.array(t))) for f in (turning.speed_at, turning.acceleration_at))
        radial, along = np.array([np.cos(angle), np.sin(angle)]), np.array([np.sin(angle), -np.cos(angle)])
        return np.concatenate(
            [s[2:], K @ s[:2] + D @ s[2:] + unbalance.eccentricity_m * (omega**2 * radial + alpha * along)]
        )

    p = made.signal("p")
    begin = np.concatenate([p[0], (-3 * p[0] + 4 * p[1] - p[2]) / (2 * TS)])
    t = np.arange(0, len(p), 25) * TS
    solution = solve_ivp(rates, (0, t[-1]), begin, t_eval=t, rtol=1e-6, atol=1e-12).y[:2].T
    np.testing.assert_allclose(p[::25], solution, rtol=0, atol=0.003 * np.abs(p).max())


def test_constant_course_is_a_constant_point():
    point = {"pressure_bar": 5.0, "speed_rpm": 3000.0}
    options = dict(conditions=point, seed=1, name="b", settle_s=0.02)
    still = record(machine(5.0, 3000.0), Prbs(0.1), simulation="stepping", **options)
    run = ScheduledRun(Course.ramp(0.1, 5.0, 3000.0), Prbs(0.1))
    made = record(machine(3.0, 0.0), run, surfaces=LPV.key_parameters, **options)
    for signal in still.signals:
        np.testing.assert_allclose(made.signal(signal), still.signal(signal), rtol=1e-9, atol=1e-15)
    assert (made.signal("speed_rpm") == 3000.0).all()
    assert made.units["pressure_bar"] == "bar"
    drawn = [record(machine(), run, surfaces=LPV.key_parameters, scatter=Scatter(), **options) for _ in range(2)]
    np.testing.assert_array_equal(drawn[0].signal("p"), drawn[1].signal("p"))
    assert (drawn[0].signal("p") != made.signal("p")).any()


def test_coast_down_is_exponential_and_its_angle_the_integral():
    course = Course.coast_down(3.0, 4.0, 6000.0, 500.0)
    time = np.linspace(0.0, 3.0, 50)
    np.testing.assert_allclose(course.at(time)[1], 6000 * np.exp(-time * np.log(12) / 3), rtol=2e-4)
    turning = ScheduledRun(course).turning()
    sum_of_speeds = np.trapezoid(turning.speed_at(fine := np.linspace(0, 2.2, 100001)), fine)
    assert float(turning.angle(np.array(2.2))) == pytest.approx(sum_of_speeds, rel=1e-7)


@pytest.mark.parametrize(
    ("times", "pressure", "speed", "word"),
    [((0.0,), 3.0, 0.0, "two times"), ((0.5, 1.0), 3.0, 0.0, "ascend from 0"), ((0, 1), (3, 4, 5), 0, "pressure_bar"),
     ((0, 1), 3.0, (0, -1), "speed_rpm")],
)  # fmt: skip
def test_wrong_courses_are_refused(times, pressure, speed, word):
    with pytest.raises(UsageError, match=word):
        Course(times, pressure, speed)
