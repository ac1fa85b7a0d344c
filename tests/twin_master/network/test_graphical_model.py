import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from twin_master.errors import InvalidDistributionError, InvalidModelError
from twin_master.network.distributions import distribution, stochastic_matrix
from twin_master.network.graphical_model import (
    Factor,
    GraphicalModel,
    StateSpace,
    deterministic_policy,
    worsening_table,
)
from twin_master.network.transition import TransitionModel, predecessor_lists

LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8)
SPACE = StateSpace((Factor("z1", LEVELS), Factor("z2", (0.0, 0.5, 1.0))))


def test_joint_states_are_in_c_order():
    assert SPACE.shape == (5, 3)
    assert SPACE.size == 15
    np.testing.assert_array_equal(SPACE.coordinates[:4], [[0, 0], [0, 0.5], [0, 1], [0.2, 0]])
    assert SPACE.index((0.4, 0.5)) == 2 * 3 + 1
    assert SPACE.certain((0.8, 1.0))[-1] == 1.0


@given(arrays(np.float64, (4, 15), elements=st.floats(0.0, 1.0)))
def test_moments_and_marginals_of_a_belief(weights):
    weights = weights + 1e-3
    belief = weights / weights.sum(axis=1, keepdims=True)
    first = belief.reshape(4, 5, 3).sum(axis=2)
    second = belief.reshape(4, 5, 3).sum(axis=1)
    np.testing.assert_allclose(SPACE.marginal(belief, "z1"), first, rtol=1e-14)
    np.testing.assert_allclose(SPACE.marginal(belief[0], "z2"), second[0], rtol=1e-14)
    mean = first @ LEVELS
    np.testing.assert_allclose(SPACE.mean(belief)[:, 0], mean, rtol=1e-13, atol=1e-15)
    variance = first @ np.square(LEVELS) - mean**2
    np.testing.assert_allclose(SPACE.standard_deviation(belief)[:, 0] ** 2, variance, atol=1e-14)


def test_a_certain_belief_has_no_spread():
    assert np.all(SPACE.standard_deviation(SPACE.certain((0.6, 1.0))) == 0.0)


@given(
    steps=st.lists(st.floats(0.01, 1.0), min_size=0, max_size=4),
    values=st.lists(st.floats(-10.0, 10.0), min_size=5, max_size=5),
)
def test_what_a_table_changes_by_within_an_interval_is_that_of_a_quadrature(steps, values):
    """Along each factor: the straight line through the level that fits a piecewise linear table best."""
    levels = np.concatenate([[0.0], np.cumsum(steps)])
    states = StateSpace((Factor("a", tuple(levels)), Factor("b", (1.0, 2.0))))
    along = np.array(values[: len(levels)])
    table = along[:, None, None] * [[1.0, 0.0], [1.0, 3.0]]  # (a, b, sensor)
    found = states.within_interval(table.reshape(-1, 2)).reshape(len(levels), 2, 2, 2)
    half = np.concatenate([levels[:1], 0.5 * (levels[1:] + levels[:-1]), levels[-1:]])
    for k, level in enumerate(levels):
        at = half[k] + (half[k + 1] - half[k]) * (np.arange(20000) + 0.5) / 20000
        place, change = at - level, np.interp(at, levels, along) - along[k]
        expected = np.mean(place * change) / np.sqrt(np.mean(place**2)) if len(levels) > 1 else 0.0
        np.testing.assert_allclose(found[k, :, 0, 0], expected, atol=1e-4)
        # Of two levels each stands for the half of the step next to it: E[(x / 2)²] = 1 / 12.
        np.testing.assert_allclose(found[k, :, 1, 1], 3.0 * along[k] / np.sqrt(12.0), atol=1e-12)
    assert not found[:, :, 0, 1].any()


def test_a_linear_table_changes_by_its_slope_and_mirrored_levels_by_the_opposite():
    levels = np.array([0.0, 0.1, 0.4, 0.6])
    left, right = np.array([0.0, 0.05, 0.15, 0.1]), np.array([0.05, 0.15, 0.1, 0.0])
    spread = np.sqrt((left**3 + right**3) / (3.0 * (left + right)))  # of a value anywhere in the interval
    found = StateSpace((Factor("a", tuple(levels)),)).within_interval(7.0 * levels[:, None])[:, 0, 0]
    np.testing.assert_allclose(found, 7.0 * spread)
    mirrored = StateSpace((Factor("a", tuple(-levels[::-1])),))
    np.testing.assert_allclose(mirrored.within_interval(7.0 * levels[::-1, None])[::-1, 0, 0], -found)
    np.testing.assert_array_equal(StateSpace((Factor("a", (0.3,)),)).within_interval([[5.0]]), [[[0.0]]])


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ([0.5, 0.5 + 1e-11], r"T: row 1 does not sum to one"),
        ([1.5, -0.5], r"T: row 1 holds a negative probability"),
        ([float("nan"), 1.0], r"T: row 1 holds a value that is not finite"),
        ([float("inf"), 0.0], r"T: row 1 holds a value that is not finite"),
    ],
)
def test_a_row_that_is_no_distribution_is_named(bad, message):
    with pytest.raises(InvalidDistributionError, match=message):
        stochastic_matrix([[1.0, 0.0], bad], name="T")


def test_the_row_is_named_in_a_stack_of_matrices_and_in_a_vector():
    stack = np.tile(np.eye(3), (2, 1, 1))
    stack[1, 2, 2] = 0.95
    with pytest.raises(InvalidDistributionError, match=r"row \(1, 2\) does not sum to one \(sum 0.95"):
        TransitionModel((stack,))
    with pytest.raises(InvalidDistributionError, match="prior: the distribution does not sum to one"):
        distribution([0.5, 0.4], size=2, name="prior")
    with pytest.raises(InvalidDistributionError, match=r"expected prior of shape \(3,\)"):
        distribution([0.5, 0.5], size=3, name="prior")
    with pytest.raises(InvalidDistributionError, match="shape"):
        stochastic_matrix([], name="T")


def test_rounding_within_the_tolerance_passes_and_the_result_is_a_read_only_copy():
    rows = np.array([[0.1] * 10])
    checked = stochastic_matrix(rows, name="T")
    rows[0, 0] = 5.0
    assert checked[0, 0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        checked[0, 0] = 1.0


def test_the_last_level_absorbs():
    table = worsening_table(3, 0.1)
    np.testing.assert_allclose(table, [[0.9, 0.1, 0], [0, 0.9, 0.1], [0, 0, 1]], rtol=1e-15)
    np.testing.assert_array_equal(worsening_table(1, 0.3), [[1.0]])


def test_rows_at_the_damage_limit_sum_to_one():
    """The authors' published table leaves 0.95 and 0.90 in the rows with exactly one region at its limit."""
    transition = TransitionModel.from_factors([[worsening_table(5, p)] * 2 for p in (0.05, 0.10)])
    np.testing.assert_allclose(transition.matrix.sum(axis=2), 1.0, rtol=0, atol=1e-15)
    limit = StateSpace((Factor("z1", LEVELS), Factor("z2", LEVELS)))
    row = transition.matrix[1, limit.index((0.8, 0.2))]
    assert row[limit.index((0.8, 0.2))] == pytest.approx(0.9)
    assert row[limit.index((0.8, 0.4))] == pytest.approx(0.1)


def test_predecessor_lists_hold_every_non_zero_transition_and_no_other():
    matrix = TransitionModel.from_factors(
        [[worsening_table(4, p), worsening_table(3, 0.5)] for p in (0.0, 1.0)]
    )
    _, _, start, source, probability, log_probability = predecessor_lists([matrix.matrix])
    rebuilt = np.zeros_like(matrix.matrix)
    for control in range(2):
        for state in range(12):
            row = control * 12 + state
            for k in range(start[row], start[row + 1]):
                rebuilt[control, source[k], state] = probability[k]
    np.testing.assert_array_equal(rebuilt, matrix.matrix)
    np.testing.assert_allclose(np.exp(log_probability), probability, rtol=1e-15)


def test_deterministic_policy():
    np.testing.assert_array_equal(deterministic_policy([1, 0], 3), [[0, 1, 0], [1, 0, 0]])


MOVES = TransitionModel.from_factors([[worsening_table(5, 0.1), worsening_table(3, 0.1)]])
PRIOR = SPACE.certain((0.0, 0.0))
REFUSED = [
    (lambda: SPACE.index((0.3, 0.5)), r"0\.3 is no level of factor 'z1'"),
    (lambda: SPACE.index((float("nan"), 0.5)), "no level"),
    (lambda: SPACE.index((0.4,)), "one level for each"),
    (lambda: SPACE.marginal(np.full(15, 1 / 15), "z3"), "no factor is named 'z3'"),
    *(
        (lambda bad=bad: Factor("z1", bad), "'z1'")
        for bad in ((), (0.2, 0.1), (0.0, 0.0), (0.0, float("inf")))
    ),
    (lambda: StateSpace((Factor("z", LEVELS), Factor("z", LEVELS))), "different names"),
    (lambda: StateSpace(()), "different names"),
    (lambda: Factor("", LEVELS), "needs a name"),
    (lambda: worsening_table(3, 1.1), r"probability in \[0, 1\]"),
    (lambda: TransitionModel((np.full((2, 3, 4), 0.25),)), r"a transition of shape \(controls, 4, 4\)"),
    (lambda: TransitionModel.from_factors([[np.eye(2)], [np.eye(3)]]), "the same states"),
    (lambda: TransitionModel.from_factors([[[[0.5, 0.5]]]]), "square table"),
    (lambda: TransitionModel.from_factors([[]]), "square table"),
    (lambda: GraphicalModel(SPACE, ("2g", "3g"), PRIOR, MOVES), r"a transition of shape \(2, 15, 15\)"),
    (lambda: GraphicalModel(SPACE, (), PRIOR, MOVES), "different names"),
    (lambda: GraphicalModel(SPACE, ("hold",), PRIOR[:-1], MOVES), "prior"),
    (lambda: GraphicalModel(SPACE, ("hold",), 2 * PRIOR, MOVES), "prior"),
    (
        lambda: GraphicalModel(SPACE, ("hold",), PRIOR, MOVES).policy([[0.5, 0.5]] * 15),
        r"a policy of shape \(15, 1\)",
    ),
    *(
        (lambda bad=bad: deterministic_policy(bad, 3), "control index between 0 and 2")
        for bad in ([0, 3], [-1, 0], [0.0, 1.0])
    ),
]


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_what_does_not_fit_is_refused(make, sentence):
    with pytest.raises((InvalidModelError, InvalidDistributionError), match=sentence):
        make()
