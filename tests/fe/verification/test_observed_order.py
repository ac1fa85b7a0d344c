import math

import pytest

from fe.verification.known_answers import observed_order


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.7])
@pytest.mark.parametrize("refinements", [(0.5, 1.0, 2.0), (1.0, 1.5, 2.25), (0.25, 0.5, 1.5, 4.5)])
def test_the_order_of_a_power_law_is_found(refinements, order):
    values = [7.0 - 0.3 * refinement**-order for refinement in refinements]
    assert observed_order(refinements[-1] / refinements[-2], values) == pytest.approx(order, abs=1e-6)


def test_no_order_where_values_do_not_settle():
    assert math.isnan(observed_order(2.0, (1.0, 2.0, 1.5)))  # to and fro
    assert math.isnan(observed_order(2.0, (1.0, 2.0, 4.0)))  # runs away
    assert math.isnan(observed_order(2.0, (1.0, 1.0, 1.0)))
