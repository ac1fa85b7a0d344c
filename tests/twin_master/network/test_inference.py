import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.twin_master.network.decision_oracles import (
    eliminate_variables,
    enumerate_trajectories,
    precise_forward_backward,
    random_model,
)
from twin_master.errors import ImpossibleObservation, InvalidModelError, InvalidObservationError
from twin_master.network.inference import filter_many, predict, smooth
from twin_master.network.twin import build_graphical_model
from uav_twin import filter_sequence, load_scenario

EXACT = {"rtol": 1e-10, "atol": 1e-12}


MODEL = build_graphical_model(load_scenario("level_turns").scenario)


def infer(model, control, log_likelihood):
    filtered = filter_sequence(model, control, log_likelihood)
    return filtered, smooth(model, control, filtered.log_filtered)


@pytest.mark.parametrize("seed", range(12))
def test_filter_smoother_and_evidence_equal_enumeration(seed):
    """Transitions with zeros, products too; steps that show nothing, or rule states out; every trajectory."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, (2, 2) if seed % 2 else (5,), 0.4 * (seed != 3), product=seed % 4 == 1)
    steps = 5
    control = rng.integers(0, 2, steps)
    log_likelihood = rng.normal(size=(steps, model.states.size)) * 4
    log_likelihood[rng.random(steps) < 0.3] = 0.0
    if seed == 3:  # whose transitions have no zeros
        log_likelihood[0, 1] = log_likelihood[2, 1:] = -np.inf
    filtered, smoothed = infer(model, control, log_likelihood)
    oracle = enumerate_trajectories(model, control, log_likelihood)
    np.testing.assert_allclose(filtered.forecast, oracle[0], **EXACT)
    np.testing.assert_allclose(filtered.filtered, oracle[1], **EXACT)
    np.testing.assert_allclose(smoothed, oracle[2], **EXACT)
    np.testing.assert_allclose(filtered.log_evidence, oracle[3], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(np.exp(filtered.log_filtered) == 0, oracle[1] == 0)


@pytest.mark.parametrize("product", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_smoothing_and_prediction_equal_variable_elimination(seed, product):
    """The control of each turn to come is a node that is marginalised."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, (2, 3), product=product)
    control = rng.integers(0, 2, 6)
    log_likelihood = rng.normal(size=(6, 6)) * 3
    log_likelihood[2] = 0.0
    policy = model.policy(rng.dirichlet(np.ones(2), 6) if seed else np.eye(2)[rng.integers(0, 2, 6)])
    filtered, smoothed = infer(model, control, log_likelihood)
    predicted = predict(model, filtered.filtered[-1], control[-1], policy, 3)
    expected, joint = eliminate_variables(model, control, log_likelihood, policy, 3)
    np.testing.assert_allclose(smoothed, expected, **EXACT)
    np.testing.assert_allclose(predicted.joint, joint, **EXACT)
    np.testing.assert_allclose(predicted.predicted, joint.sum(axis=2), **EXACT)
    np.testing.assert_allclose(predicted.control_probability, joint.sum(axis=1), **EXACT)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.sampled_from([1.0, 300.0, 1e4, 1e6]),
    steps=st.integers(1, 40),
    shift=st.sampled_from([0.0, -1e5, 1e5]),
    product=st.booleans(),
    ruled_out=st.booleans(),
)
def test_filter_and_smoother_equal_arbitrary_precision(seed, scale, steps, shift, product, ruled_out):
    """Differences of thousands of nats and more: entries that are zero in double precision come back.

    Transitions with zeros, products too; steps that show nothing, or rule states out.
    """
    rng = np.random.default_rng(seed)
    model = random_model(rng, shape=(2, 3), zeros=0.0 if ruled_out else 0.6, product=product)
    assert model.transition.is_product is product
    value, matrix = rng.normal(size=6), model.transition.matrix[1]
    np.testing.assert_allclose(model.transition.expected(1, value), matrix @ value, atol=1e-14)
    control = rng.integers(0, 2, steps)
    log_likelihood = rng.normal(size=(steps, 6)) * scale + shift
    log_likelihood[rng.random(steps) < 0.3] = 0.0
    log_likelihood[:, 1:][ruled_out & (rng.random((steps, 5)) < 0.2)] = -np.inf
    filtered, smoothed = infer(model, control, log_likelihood)
    oracle = precise_forward_backward(model, control, log_likelihood)
    # A log-likelihood of size L is itself only known to L * 1e-16.
    known = max(1e-10, 1e-15 * steps * (scale + abs(shift)) * 5)
    np.testing.assert_allclose(filtered.forecast, oracle[0], rtol=known, atol=1e-300)
    np.testing.assert_allclose(filtered.filtered, oracle[1], rtol=known, atol=1e-300)
    np.testing.assert_allclose(smoothed, oracle[2], rtol=known, atol=1e-290)
    finite = np.isfinite(oracle[3])
    np.testing.assert_array_equal(np.isfinite(filtered.log_filtered), finite)
    np.testing.assert_allclose(filtered.log_filtered[finite], oracle[3][finite], rtol=1e-13, atol=known)
    np.testing.assert_allclose(filtered.log_evidence, oracle[4], rtol=1e-13, atol=known)


def test_an_impossible_observation_names_its_step():
    log_likelihood = np.zeros((5, 25))
    log_likelihood[3] = -np.inf
    log_likelihood[3, 24] = 0.0  # cannot be reached from no damage in three steps
    with pytest.raises(ImpossibleObservation, match="step 3:"):
        filter_sequence(MODEL, [1] * 5, log_likelihood)
    many = np.stack([np.zeros((5, 25)), log_likelihood, log_likelihood])
    _, failed = filter_many(MODEL.transition, np.ones((3, 5), dtype=int), many, MODEL.log_prior)
    np.testing.assert_array_equal(failed, [-1, 3, 3])


POLICY = np.eye(2)[[0] * 25]
ZEROS = np.zeros((3, 25))
AT_1_7 = np.arange(75).reshape(3, 25) == 32
REFUSED = [
    *(
        (
            lambda bad=bad: filter_sequence(MODEL, [1] * 3, np.where(AT_1_7, bad, 0.0)),
            r"likelihood at \(1, 7\)",
        )
        for bad in (np.nan, np.inf)
    ),
    (lambda: filter_sequence(MODEL, [1, 1], ZEROS), r"of shape \(2, 25\)"),
    (lambda: filter_sequence(MODEL, [1, 2], ZEROS[:2]), "between 0 and 1"),
    (lambda: filter_sequence(MODEL, 1, ZEROS[0]), r"controls of shape \(1,\), got \(\)"),
    (lambda: smooth(MODEL, [[1]], ZEROS[None, :1]), r"controls of shape \(1,\), got \(1, 1\)"),
    (lambda: predict(MODEL, np.ones(3), 0, POLICY, 1), r"belief of shape \(25,\)"),
    (lambda: predict(MODEL, np.ones(25), 0, POLICY, -1), "horizon of 0 or more"),
]


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_what_does_not_fit_is_refused(make, sentence):
    with pytest.raises((InvalidModelError, InvalidObservationError), match=sentence):
        make()
