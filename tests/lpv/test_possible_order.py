"""Order of surfaces where the operating points allow few terms: found, or named in the message."""

import numpy as np
import pytest

from gbid.core.errors import DataError
from gbid.lpv.estimates import check_points, chosen_exponents, order_words, possible_order, varying_exponents
from gbid.lpv.regression import best_order, compare_orders

GRID = [(p, n) for p in (4.0, 5.0, 6.0) for n in (0.0, 4000.0, 6000.0)]


@pytest.mark.parametrize(
    ("points", "order"),
    [
        (GRID, 2),
        ([(p, n) for p in (5.0, 6.0) for n in (4000.0, 6000.0)], 1),
        ([(p, 6000.0) for p in (4.0, 5.0, 6.0, 6.0)], ("1", "P", "P^2")),
        ([(5.0, n) for n in (0.0, 6000.0)], ("1", "Omega")),
        ([(5.0, 6000.0)] * 3, 0),
    ],
)
def test_the_highest_order_that_points_allow(points, order):
    points = np.array(points)
    assert possible_order(points) == order
    check_points(points, chosen_exponents(order))
    if order != 2:
        with pytest.raises(DataError) as caught:
            check_points(points, chosen_exponents(2))
        assert str(caught.value).endswith(f"or choose a lower order, such as order: {order_words(order)}")


def test_auto_at_one_speed_and_at_one_point():
    pressure = np.repeat([3.0, 4.0, 5.0, 6.0, 7.0], 2)
    points = np.column_stack([pressure, np.full(10, 6000.0)])
    noise = 0.01 * np.random.default_rng(1).standard_normal(10)
    assert best_order(compare_orders(points, (1 + 2 * pressure + noise)[:, None])) == 1
    assert best_order(compare_orders(points, (1 + pressure**2 + noise)[:, None])) == 2
    assert varying_exponents(points, 2) == ((0, 0), (1, 0), (2, 0))
    assert best_order(compare_orders(points[:2], noise[:2, None])) == 0
