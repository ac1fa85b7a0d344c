"""States and transitions, filter, smoother and prediction, against enumeration and variable elimination."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.refusals import refused
from tests.twin_master.network.decision_oracles import (
    eliminate_variables,
    enumerate_trajectories,
    precise_forward_backward,
    random_model,
)
from tests.twin_master.runs import loaded_from, table_of, text_of, written
from twin_master.assets.resolution import Overrides, asset_source, check_scenario_fits, resolve_scenario
from twin_master.errors import ImpossibleObservation, InvalidModelError, InvalidObservationError
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network import transition as transition_file
from twin_master.network.graphical_model import Factor, StateSpace, build_graphical_model, worsening_table
from twin_master.network.inference import filter_many, predict, smooth
from twin_master.network.sensor_model import check_noise
from twin_master.network.transition import TransitionModel, stochastic_matrix
from twin_master.scenario.reading import parse_scenario
from uav_twin import GraphicalModel, filter_sequence, load_scenario

LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8)
SPACE = StateSpace((Factor("z1", LEVELS), Factor("z2", (0.0, 0.5, 1.0))))


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
    assert np.all(SPACE.standard_deviation(SPACE.certain_belief((0.6, 1.0))) == 0.0)


INTERVAL_CASES = {
    "steps": st.lists(st.floats(0.01, 1.0), min_size=0, max_size=4),
    "values": st.lists(st.floats(-10.0, 10.0), min_size=5, max_size=5),
}


def levels_and_changes(steps, values):
    """Return the levels of a factor a, a table's values there, and the changes (a, b, sensor, factor).

    The table is of two factors, and of one sensor that does not depend on b and one that does.
    """
    levels = np.concatenate([[0.0], np.cumsum(steps)])
    states = StateSpace((Factor("a", tuple(levels)), Factor("b", (1.0, 2.0))))
    along_a = np.array(values[: len(levels)])
    table = along_a[:, None, None] * [[1.0, 0.0], [1.0, 3.0]]
    changes = states.change_within_interval(table.reshape(-1, 2)).reshape(len(levels), 2, 2, 2)
    return levels, along_a, changes


@given(**INTERVAL_CASES)
def test_what_a_table_changes_by_within_an_interval_is_that_of_a_quadrature(steps, values):
    """Along each factor: the straight line through the level that fits a piecewise linear table best."""
    levels, along_a, changes = levels_and_changes(steps, values)
    middles = 0.5 * (levels[1:] + levels[:-1])
    edges = np.concatenate([levels[:1], middles, levels[-1:]])
    midpoints = (np.arange(20000) + 0.5) / 20000
    for number, level in enumerate(levels):
        begin, end = edges[number : number + 2]
        points = begin + (end - begin) * midpoints
        distance = points - level
        change = np.interp(points, levels, along_a) - along_a[number]
        expected = 0.0
        if len(levels) > 1:
            expected = np.mean(distance * change) / np.sqrt(np.mean(distance**2))
        np.testing.assert_allclose(changes[number, :, 0, 0], expected, atol=1e-4)


@given(**INTERVAL_CASES)
def test_of_two_levels_each_stands_for_the_half_of_the_step_next_to_it(steps, values):
    """E[(x / 2)²] = 1 / 12."""
    _, along_a, changes = levels_and_changes(steps, values)
    for value, change in zip(along_a, changes, strict=True):
        np.testing.assert_allclose(change[:, 1, 1], 3.0 * value / np.sqrt(12.0), atol=1e-12)


@given(**INTERVAL_CASES)
def test_a_sensor_does_not_change_along_a_factor_on_which_it_does_not_depend(steps, values):
    _, _, changes = levels_and_changes(steps, values)
    assert not changes[:, :, 0, 1].any()


MOVES = TransitionModel.from_factors([[worsening_table(5, 0.1), worsening_table(3, 0.1)]])
PRIOR = SPACE.certain_belief((0.0, 0.0))


@pytest.mark.parametrize("most", [transition_file.MAX_JOINT_NON_ZEROS, 0])
def test_a_model_from_tables(monkeypatch, most):
    """States are in C order, and each factor moves by its own table, as one table or as many."""
    monkeypatch.setattr(transition_file, "MAX_JOINT_NON_ZEROS", most)
    worse = [[0.9, 0.1], [0.0, 1.0]]
    three = [[0.8, 0.2, 0.0], [0.0, 0.7, 0.3], [0.0, 0.0, 1.0]]
    levels = {"a": (0.0, 0.5), "b": (0.0, 0.2, 0.4), "c": (1.0, 2.0)}
    still = {"a": np.eye(2), "b": np.eye(3), "c": np.eye(2)}
    tables = {"soft": still, "hard": {"b": three, "c": worse, "a": worse}}
    found = GraphicalModel.from_tables(levels, tables)
    assert found.controls == ("soft", "hard")
    np.testing.assert_array_equal(found.states.coordinates[[1, 2]], [[0.0, 0.0, 2.0], [0.0, 0.2, 1.0]])
    np.testing.assert_array_equal(found.prior, np.eye(12)[0])
    expected = [np.eye(12), np.kron(np.kron(worse, three), worse)]
    np.testing.assert_allclose(found.transition.matrix, expected, atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        found.transition.matrix[0, 0, 0] = 2.0
    priors = {"a": (0.25, 0.75), "b": (0.5, 0.5, 0.0), "c": (0.0, 1.0)}
    given = GraphicalModel.from_tables(levels, tables, priors)
    np.testing.assert_array_equal(given.prior, np.kron(np.kron(priors["a"], priors["b"]), priors["c"]))
    with pytest.raises(InvalidModelError, match="hard must have one table for each of the factors a, b, c"):
        GraphicalModel.from_tables(levels, {**tables, "hard": {"a": worse}})


def test_too_many_states_or_draws_are_refused_before_anything_is_built(monkeypatch):
    """Of 5^6 = 15,625 states, on a machine of 8 GB."""
    monkeypatch.setattr(transition_file, "available_memory", lambda: 8e9)
    table = table_of("level_turns")
    table["state"] = [table["state"][0] | {"name": f"z{number}"} for number in range(1, 7)]
    table["mission"]["steps"] = 60
    table["calibration"]["draws"] = 800
    loaded = loaded_from(table, "level_turns")
    tracemalloc.start()
    with refused(InvalidModelError, "15625 states") as caught:
        asset_source(resolve_scenario(loaded, Overrides()))
    assert tracemalloc.get_traced_memory()[1] < 5e7
    tracemalloc.stop()
    small = "7.2e-06 GB for the transitions of 6 state factors"
    for word in ("2 controls", "38.4 GB", small, "8 GB", "800 draws", "fewer levels"):
        assert word in str(caught.value)
    table = table_of("level_turns")
    table["calibration"]["draws"] = 1000000
    with pytest.raises(InvalidModelError, match=r"76.8 GB for 1000000 draws of 24 sensors"):
        check_scenario_fits(parse_scenario(table, "x"))
    with pytest.raises(InvalidModelError, match="15625 states under 2 controls"):
        _ = TransitionModel.from_factors([[worsening_table(5, 0.1)] * 6] * 2).matrix


@pytest.mark.parametrize(
    ("key", "number"), [("observation.standard_deviation", 125), ("truth.noise.standard_deviation", 150)]
)
def test_a_noise_whose_unit_was_forgotten_is_refused(key, number, tmp_path, library_file):
    change = (f"standard_deviation_microstrain = {number}", "standard_deviation = 0.05")
    loaded = load_scenario(written(tmp_path, text_of("level_turns", change)))
    scenario = resolve_scenario(loaded, Overrides(strain_library=library_file))
    with refused(InvalidModelError, f"`{key}` is 0.05.*sensor 1.*write `{key}_microstrain = 0.05`"):
        prepare_knowledge(scenario, asset_source(scenario), 0)


def test_only_a_noise_beyond_all_that_its_kind_of_sensor_shows_is_refused():
    """The second gauge shows nothing at all, as one on the neutral axis; the third is a thermometer."""
    predicted = np.array([[[[1e-3, 0.0, 300.0]], [[2e-3, 0.0, 300.0]]]])
    check_noise("noise", [1e-4, 1e-4, 0.5], predicted, ("1", "1", "K"))
    for *noise, named in (
        (1e-4, 3e-3, 0.5, "strain"),
        (1e-4, 1e-4, 500.0, "in K"),
        (1e-4, 125.0, 0.5, "sensor 2"),
    ):
        with pytest.raises(InvalidModelError, match=named):
            check_noise("noise", noise, predicted, ("1", "1", "K"))


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
    """The control of each step to come is a node that is marginalised."""
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
    np.testing.assert_allclose(model.transition.expected_value(1, value), matrix @ value, atol=1e-14)
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
    (lambda: SPACE.index((0.3, 0.5)), r"0\.3 is not a level of factor 'z1'"),
    (lambda: SPACE.index((np.nan, 0.5)), "not a level"),
    (lambda: SPACE.index((0.4,)), "one level for each"),
    (lambda: SPACE.marginal(np.full(15, 1 / 15), "z3"), "no factor is named 'z3'"),
    *((lambda bad=bad: Factor("z1", bad), "'z1'") for bad in ((), (0.2, 0.1), (0.0, 0.0), (0.0, np.inf))),
    (lambda: StateSpace((Factor("z", LEVELS), Factor("z", LEVELS))), "different names"),
    (lambda: StateSpace(()), "different names"),
    (lambda: Factor("", LEVELS), "needs a name"),
    (lambda: TransitionModel((np.full((2, 3, 4), 0.25),)), r"must have the shape \(controls, 4, 4\)"),
    (
        lambda: TransitionModel.from_factors([[np.eye(2)], [np.eye(3)]]),
        "one square table for each factor, of the same size",
    ),
    (lambda: TransitionModel.from_factors([[[[0.5, 0.5]]]]), "square table"),
    (lambda: TransitionModel.from_factors([[]]), "square table"),
    (lambda: GraphicalModel(SPACE, ("2g", "3g"), PRIOR, MOVES), r"must have the shape \(2, 15, 15\)"),
    (lambda: GraphicalModel(SPACE, (), PRIOR, MOVES), "different names"),
    (lambda: GraphicalModel(SPACE, ("hold",), PRIOR[:-1], MOVES), r"prior must have the shape \(15,\)"),
    (lambda: GraphicalModel(SPACE, ("hold",), 2 * PRIOR, MOVES), "prior: the distribution does not sum to"),
    (lambda: MODEL.policy([[0.5, 0.4, 0.1]] * 25), r"a policy must have the shape \(25, 2\)"),
    (lambda: TransitionModel((np.eye(2)[None], np.stack([np.eye(3)] * 2))), "same controls"),
    (lambda: stochastic_matrix([[1.0, 0.0], [0.5, 0.5 + 1e-11]], name="T"), "T: row 1 does not sum to one"),
    (lambda: stochastic_matrix([[1.0, 0.0], [1.5, -0.5]], name="T"), "T: row 1 holds a negative probability"),
    (lambda: stochastic_matrix([[1.0, 0.0], [np.nan, 1.0]], name="T"), "T: row 1 holds a value that is not"),
    (lambda: stochastic_matrix([[1.0, 0.0], [np.inf, 0.0]], name="T"), "T: row 1 holds a value that is not"),
    (
        lambda: TransitionModel((np.eye(3) * [[[1.0]], [[0.95]]],)),
        r"row \(1, 0\) does not sum .*\(sum 0.95",
    ),
    (lambda: stochastic_matrix([], name="T"), "shape"),
    (lambda: filter_sequence(MODEL, [1] * 3, np.where(AT_1_7, np.nan, 0.0)), r"likelihood at \(1, 7\)"),
    (lambda: filter_sequence(MODEL, [1] * 3, np.where(AT_1_7, np.inf, 0.0)), r"likelihood at \(1, 7\)"),
    (lambda: filter_sequence(MODEL, [1, 1], ZEROS), r"must have the shape \(2, 25\)"),
    (lambda: filter_sequence(MODEL, [1, 2], ZEROS[:2]), "from 0 to 1"),
    (lambda: filter_sequence(MODEL, [1, 0.5], ZEROS[:2]), "must be whole numbers, but one is 0.5"),
    (lambda: filter_sequence(MODEL, np.ma.masked_equal([0, 1], 1), ZEROS[:2]), "whole numbers"),
    (lambda: filter_sequence(MODEL, [1] * 3, np.ma.masked_where(AT_1_7, ZEROS)), r"likelihood at \(1, 7\)"),
    (lambda: predict(MODEL, np.ones(25), 0.5, POLICY, 1), "whole numbers"),
    (lambda: filter_sequence(MODEL, 1, ZEROS[0]), r"shape \(1,\), but the shape is \(\)"),
    (lambda: smooth(MODEL, [[1]], ZEROS[None, :1]), r"shape \(1,\), but the shape is \(1, 1\)"),
    (lambda: predict(MODEL, np.ones(3), 0, POLICY, 1), r"belief must have the shape \(25,\)"),
    (lambda: predict(MODEL, np.ones(25), 0, POLICY, -1), "the horizon must be 0 steps or more"),
]


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_what_does_not_fit_is_refused(make, sentence):
    with pytest.raises((InvalidModelError, InvalidObservationError), match=sentence):
        make()
