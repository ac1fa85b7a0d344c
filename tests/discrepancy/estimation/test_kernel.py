"""The filter and the smoother of the estimator beside the joint Gaussian of all states and readings."""

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from discrepancy.estimation.kernel import (
    filter_record,
    respond_to_drift,
    smooth_record,
    smoothed_variances,
    substep_matrices_with_laws,
)
from discrepancy.trials_in_motion.steps import respond_to_inputs

PARTS, SAMPLES, STATES, CHANNELS, WIDTH = 2, 6, 3, 2, 3
STAMPS = PARTS * (SAMPLES - 1) + 1


@pytest.fixture
def record():
    """Return a random record: transition, noise, drift, rows, columns, used, covariance and mean."""
    random = np.random.default_rng(5)
    transition = 0.5 * random.standard_normal((STAMPS - 1, STATES, STATES))
    roots = random.standard_normal((STAMPS - 1, STATES, STATES))
    drift = random.standard_normal((STAMPS - 1, STATES, WIDTH))
    rows = random.standard_normal((SAMPLES, CHANNELS, STATES))
    columns = random.standard_normal((SAMPLES, CHANNELS, WIDTH))
    used = np.ones((SAMPLES, CHANNELS), dtype=bool)
    used[2, 1] = used[4, 0] = False
    root = random.standard_normal((STATES, STATES))
    mean = random.standard_normal((STATES, WIDTH))
    return transition, roots @ roots.mT, drift, rows, columns, used, root @ root.T, mean


def joint(record):
    """Return mean (F n, W) and covariance of all states, matrix (R, F n) and columns of the readings."""
    transition, noise, drift, rows, columns, used, covariance, mean = record
    size = STAMPS * STATES
    carried = np.eye(size)
    forcing = np.zeros((size, WIDTH))
    forcing[:STATES] = mean
    for j in range(STAMPS - 1):
        here, there = slice(j * STATES, (j + 1) * STATES), slice((j + 1) * STATES, (j + 2) * STATES)
        carried[there] += transition[j] @ carried[here]
        forcing[there] = drift[j] + transition[j] @ forcing[here]
    whole = carried @ block_diag(covariance, *noise) @ carried.T
    matrix, left = [], []
    for k, c in np.argwhere(used):
        row = np.zeros(size)
        row[k * PARTS * STATES : (k * PARTS + 1) * STATES] = rows[k, c]
        matrix.append(row)
        left.append(columns[k, c])
    return forcing, whole, np.array(matrix), np.array(left)


KINDS = np.arange(-1, STAMPS - 1)
"""Each step is of its own kind; no step leads to the first stamp."""


def filtered(record, *, keeps_states):
    """Return what the filter gives for a record, and the part of the state that the weights determine."""
    transition, noise, drift, rows, columns, used, covariance, mean = record
    known = respond_to_drift(KINDS, transition, drift, mean)
    random_part = columns - np.einsum("kcn,knw->kcw", rows, known[::PARTS])
    start = np.zeros((STATES, WIDTH))
    result = filter_record(
        PARTS, KINDS, transition, noise, rows, random_part, used, covariance, start, keeps_states
    )
    return known, result


def test_innovations_give_the_density_of_all_readings(record):
    used = record[5]
    _, (innovations, _, variances, _, _) = filtered(record, keeps_states=False)
    forcing, whole, matrix, left = joint(record)
    readings = matrix @ whole @ matrix.T + np.eye(len(matrix))
    residual = left - matrix @ forcing
    expected = residual.T @ np.linalg.solve(readings, residual)
    white = (innovations / np.sqrt(variances)[:, :, None])[used]
    np.testing.assert_allclose(white.T @ white, expected, rtol=1e-9)
    assert np.sum(np.log(variances[used])) == pytest.approx(np.linalg.slogdet(readings)[1], rel=1e-9)


def test_the_smoother_gives_mean_and_variance_of_all_states(record):
    transition, _, _, rows, _, used, *_ = record
    weights = np.array([1.0, -0.4, 0.7])
    known, (innovations, gains, variances, means, covariances) = filtered(record, keeps_states=True)
    steps = (PARTS, KINDS, transition, rows, used)
    smoothed = smooth_record(*steps, innovations @ weights, gains, variances, means @ weights, covariances)
    variance = smoothed_variances(*steps, gains, variances, covariances)
    forcing, whole, matrix, left = joint(record)
    gain = whole @ matrix.T @ np.linalg.inv(matrix @ whole @ matrix.T + np.eye(len(matrix)))
    expected = forcing @ weights + gain @ (left - matrix @ forcing) @ weights
    np.testing.assert_allclose((known @ weights + smoothed).ravel(), expected, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(variance.ravel(), np.diag(whole - gain @ matrix @ whole), rtol=1e-7, atol=1e-9)


def test_a_linear_law_in_the_steps_is_of_second_order_in_their_length():
    """A spring and a damper at a port, as a law: the exact answer has them in the generator."""
    generator = np.array([[0.0, 1.0], [-4.0, -0.1]])
    direction, tangent = np.array([[0.0], [-1.0]]), np.array([[1.5, 0.3]])
    exact = expm(generator + direction @ tangent)
    errors = []
    for count in (8, 16):
        length = np.array([1.0 / count])
        _, begin, end = respond_to_inputs(generator, length)
        transition, _ = substep_matrices_with_laws(
            count,
            np.zeros(2, dtype=np.int64),
            expm(generator * length)[None],
            np.zeros((1, 2, 2)),
            begin @ direction,
            end @ direction,
            np.repeat(tangent[None], count + 1, axis=0),
            np.zeros((count + 1, 1, 1)),
            np.zeros((count, 2, 1)),
        )
        errors.append(np.abs(np.linalg.multi_dot(transition[::-1]) - exact).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


def test_a_stiff_law_reverses_no_motion_within_a_substep():
    """Dry friction of a body that sticks: a damper that stops the motion far within a substep."""
    generator = np.zeros((2, 2))
    generator[0, 1] = 1.0
    direction = np.array([[0.0], [-1.0]])
    length = np.array([1.0])
    _, begin, end = respond_to_inputs(generator, length)
    for damping, fastest in ((0.5, 0.7), (30.0, 0.05)):
        transition, _ = substep_matrices_with_laws(
            1,
            np.zeros(2, dtype=np.int64),
            expm(generator)[None],
            np.zeros((1, 2, 2)),
            begin @ direction,
            end @ direction,
            np.repeat(np.array([[[0.0, damping]]]), 2, axis=0),
            np.zeros((2, 1, 1)),
            np.zeros((1, 2, 1)),
        )
        assert 0.0 <= transition[0, 1, 1] < fastest


@pytest.mark.parametrize("states", [1, 3, 8])
def test_responses_to_inputs_are_those_of_a_matrix_exponential(states):
    """Van Loan's exponential of the system with the input and its rate as further states."""
    generator = 30.0 * np.random.default_rng(states).standard_normal((states, states)) - 20.0 * np.eye(states)
    length = 0.13
    blocks = np.zeros((3 * states, 3 * states))
    blocks[:states, :states] = generator * length
    blocks[:states, states : 2 * states] = np.eye(states) * length
    blocks[states : 2 * states, 2 * states :] = np.eye(states)
    exponential = expm(blocks)[:states]
    constant, rising = exponential[:, states : 2 * states], exponential[:, 2 * states :]

    transition, begin, end = respond_to_inputs(generator, np.array([length]))

    for computed, expected in (
        (transition, exponential[:, :states]),
        (begin, constant - rising),
        (end, rising),
    ):
        np.testing.assert_allclose(computed[0], expected, atol=1e-11 * np.abs(expected).max())
