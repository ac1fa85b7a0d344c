"""The twin: one online step, a whole history, a thousand twins, planning, quantities of interest.

The model is that of the mission: two regions of five levels, two controls, 24 gauges, 30 draws of
Young's modulus, 50 steps. The strains come from a closed form, so that nothing needs to be read.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from benchmarks.measurement import (
    Measurement,
    NotAvailableError,
    compared,
    least_processor_seconds,
    least_seconds_of,
    peer_version,
)
from benchmarks.peer_networks import eliminate_variables, plan_by_toolbox, smooth_by_dynamax
from twin_master.network.graphical_model import (
    Factor,
    GraphicalModel,
    StateSpace,
    worsening_table,
)
from twin_master.network.inference import (
    filter_many,
    filter_sequence,
    known_control,
    predict,
    smooth,
    smooth_many,
)
from twin_master.network.planner import value_iteration
from twin_master.network.quantity import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import TransitionModel

Float = NDArray[np.float64]

STEPS = 50
HORIZON = 10
TWINS = 1000


def mission_model() -> tuple[GraphicalModel, GaussianSensorModel, RewardModel]:
    levels = (0.0, 0.2, 0.4, 0.6, 0.8)
    states = StateSpace((Factor("z1", levels), Factor("z2", levels)))
    tables = [[worsening_table(5, p)] * 2 for p in (0.05, 0.10)]
    model = GraphicalModel(
        states,
        ("2g", "3g"),
        states.certain_belief((0.0, 0.0)),
        TransitionModel.from_factors(tables),
    )
    z1, z2 = states.coordinates.T[:, None, :, None, None]
    span = np.linspace(0.0, 1.0, 24)
    load = np.array([2.0, 3.0])[:, None]
    draws = np.linspace(0.98, 1.03, 30)[:, None, None, None]
    shape = 1e-3 * (1.0 - 0.7 * span)
    strain = shape * load / draws * (1.0 + 0.7 * z1 * np.exp(-3 * span)) * (1.0 + 0.5 * z2 * span)
    sensors = GaussianSensorModel(strain, 125e-6)
    return model, sensors, RewardModel(sensors, 2500e-6, (-0.1, 0.1), 125e-6, (2.0, 3.0))


def many_states() -> list[Measurement]:
    """Six regions of five levels, 15,625 states, as blocks of regions."""
    levels = (0.0, 0.2, 0.4, 0.6, 0.8)
    regions = [f"z{number}" for number in range(1, 7)]
    tables = {
        name: {region: worsening_table(5, p) for region in regions}
        for name, p in (("2g", 0.05), ("3g", 0.1))
    }
    model = GraphicalModel.from_tables(dict.fromkeys(regions, levels), tables)
    rng = np.random.default_rng(3)
    span = np.linspace(0.0, 1.0, 24)
    place = np.exp(-(((span[:, None] - np.linspace(0.05, 0.8, 6)) / 0.15) ** 2))
    strain = (
        1e-3
        * (1.0 - 0.7 * span)
        / np.prod(1.0 - 0.6 * model.states.coordinates[:, None, :] * place, axis=2)
    )
    sensors = GaussianSensorModel(np.stack([2.0 * strain, 3.0 * strain], axis=1)[None], 125e-6)
    control = np.where(np.arange(STEPS) < 30, 1, 0)
    truth = model.states.index((0.2, 0.0, 0.4, 0.0, 0.0, 0.2))
    observations = sensors.mean[truth, control] + 150e-6 * rng.normal(size=(STEPS, 24))
    rows = sensors.log_likelihood_sequence(observations, control)
    history = filter_sequence(model, control, rows)

    def step() -> None:
        filter_sequence(
            model, control[-1:], rows[-1:], (history.log_filtered[-2], int(control[-2]))
        )

    def likelihood() -> None:
        sensors.log_likelihood(observations[-1], int(control[-1]))

    def mission() -> None:
        smooth(model, control, filter_sequence(model, control, rows).log_filtered)

    joint = []
    for name in model.controls:
        moves = sparse.csr_array(np.ones((1, 1)))
        for region in regions:
            moves = sparse.csr_array(sparse.kron(moves, tables[name][region]))
        joint.append(sparse.csr_array(moves.T))
    belief = history.filtered[-2]
    lists = 1e3 * least_seconds_of(lambda: joint[0] @ belief, repeats=15)
    alone = "forecast of the joint transitions, scipy.sparse, linear domain"
    return [
        Measurement(
            "filter step, 15,625 states",
            1e3 * least_seconds_of(step, repeats=25),
            "ms",
            1.0,
            alone,
            lists,
        ),
        Measurement(
            "likelihood of 24 sensors, 15,625 states",
            1e3 * least_seconds_of(likelihood, repeats=25),
            "ms",
        ),
        Measurement(
            "filter and smooth 50 steps, 15,625 states",
            least_seconds_of(mission, repeats=5),
            "s",
            10.0,
        ),
    ]


def run() -> Iterator[Measurement]:
    model, sensors, rewards = mission_model()
    rng = np.random.default_rng(1)
    control = np.where(np.arange(STEPS) < 30, 1, 0)
    state = model.states.index((0.4, 0.4))
    noise = rng.normal(size=(TWINS, STEPS, 24)) * 150e-6
    observations = sensors.mean[state, control] + noise
    reward = rewards.planning_reward(1.0, 2.5)
    plan = value_iteration(model.transition, reward, 0.6)
    log_likelihood = sensors.log_likelihood_sequence(observations[0], control)
    history = filter_sequence(model, control, log_likelihood)

    def online_step() -> None:
        likelihood = sensors.log_likelihood(observations[0, -1], int(control[-1]))
        before = history.log_filtered[-2], int(control[-2])
        step = filter_sequence(model, control[-1:], likelihood[None], before)[0]
        smooth(model, control, history.log_filtered)
        predict(model, step.filtered, int(control[-1]), plan.policy, HORIZON)

    def whole_history() -> None:
        filtered = filter_sequence(model, control, log_likelihood)
        smooth(model, control, filtered.log_filtered)
        predict(model, filtered.filtered[-1], int(control[-1]), plan.policy, HORIZON)

    many_controls = np.tile(control, (TWINS, 1))
    many = np.stack(
        [sensors.log_likelihood_sequence(observation, control) for observation in observations]
    )

    def one_by_one() -> None:
        for likelihood in many:
            smooth(model, control, filter_sequence(model, control, likelihood).log_filtered)

    known_controls = known_control(history.filtered, control, 2)
    ahead = [
        predict(model, b, int(u), plan.policy, HORIZON).joint
        for b, u in zip(history.filtered, control, strict=True)
    ]
    beliefs = np.concatenate([known_controls[:, None], np.stack(ahead)], axis=1)

    def quantities() -> None:
        sensors.moments(beliefs)
        sensors.quantiles(beliefs, (0.025, 0.975))

    online = least_seconds_of(online_step, repeats=25, inner=20)
    history_seconds = least_seconds_of(whole_history, repeats=25, inner=20)
    elimination = eliminate_variables(model, control, log_likelihood, plan.policy, HORIZON)
    smoothed = smooth(model, control, history.log_filtered)
    predicted = predict(model, history.filtered[-1], int(control[-1]), plan.policy, HORIZON)
    ours = np.concatenate([smoothed, predicted.predicted])
    agreement = compared("beliefs", ours, elimination.beliefs, 1e-9)
    for figure in (
        Measurement("online step at step 50", 1e3 * online, "ms", 1.0),
        Measurement("smooth and predict 50 steps", 1e3 * history_seconds, "ms", 0.5),
    ):
        yield figure.beside(
            "variable elimination",
            1e3 * elimination.seconds,
            peer=peer_version("pgmpy"),
            agreement=agreement,
        )

    planning = least_seconds_of(lambda: value_iteration(model.transition, reward, 0.6), inner=20)
    toolbox = plan_by_toolbox(model, reward, 0.6)
    yield Measurement(
        "value iteration",
        1e3 * planning,
        "ms",
        0.5,
        "value iteration",
        1e3 * toolbox.seconds,
        peer=peer_version("pymdptoolbox"),
        agreement=compared("values", plan.value, toolbox.value, 1e-9),
    )

    def side_by_side() -> Float:
        beliefs, _ = filter_many(model.transition, many_controls, many, model.log_prior)
        return smooth_many(model.transition, many_controls, beliefs.filtered, beliefs.log_filtered)

    batch = least_seconds_of(side_by_side, repeats=9)
    single = least_seconds_of(one_by_one, repeats=3)
    yield Measurement(
        "smooth 1,000 twins of 50 steps", 1e3 * batch, "ms", 60.0, "one by one", 1e3 * single
    )
    mixture = least_seconds_of(quantities, repeats=5)
    yield Measurement("quantities of 550 beliefs x 24 sensors, 95 % bands", 1e3 * mixture, "ms")
    yield beside_dynamax(model, control, many)
    yield from many_states()


def beside_dynamax(
    model: GraphicalModel, control: NDArray[np.int64], log_likelihoods: Float
) -> Measurement:
    """Measure the processor time of our smoother of many twins beside that of dynamax.

    Each twin may begin in any state. From the certain state with which a mission begins, the wing
    has to jump within one step, and dynamax, which adds 1e-15 to probabilities, is wrong by 0.1 in
    the beliefs of the first steps.
    """
    prior = np.full(model.states.size, 1.0 / model.states.size)
    any_state = GraphicalModel(model.states, model.controls, prior, model.transition)
    controls = np.tile(control, (len(log_likelihoods), 1))

    def smooth_ours() -> Float:
        beliefs, _ = filter_many(
            any_state.transition, controls, log_likelihoods, any_state.log_prior
        )
        return smooth_many(any_state.transition, controls, beliefs.filtered, beliefs.log_filtered)

    with threadpool_limits(1):
        milliseconds = 1e3 * least_processor_seconds(smooth_ours, repeats=9)
    figure = Measurement("smooth 1,000 twins of 50 steps, processor", milliseconds, "ms")
    try:
        theirs = smooth_by_dynamax(any_state, control, log_likelihoods)
    except NotAvailableError as error:
        return replace(figure, peer="dynamax", remark=str(error))
    return figure.beside(
        "two-filter smoother of JAX",
        1e3 * theirs.seconds,
        peer=theirs.peer,
        agreement=compared("beliefs", smooth_ours(), theirs.smoothed, 1e-8),
    )
