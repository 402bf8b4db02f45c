"""Order of surfaces where the operating points allow few terms: found, or named in the message."""

import numpy as np
import pytest

from gbid.core.errors import DataError
from gbid.lpv.estimates import check_points, chosen_exponents, order_words, possible_order

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
