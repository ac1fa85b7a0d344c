"""The twin: one online step, a whole history, a thousand twins, planning, quantities of interest.

The model is that of the mission: two regions of five levels, two controls, 24 gauges, 30 draws of
Young's modulus, 50 steps. The strains come from a closed form, so that nothing needs to be read.
"""

import logging
import time
import warnings

import numpy as np
from scipy import sparse

from benchmarks.measurement import Measurement, median_seconds
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

STEPS = 50
HORIZON = 10
TWINS = 1000


def mission_model() -> tuple[GraphicalModel, GaussianSensorModel, RewardModel]:
    levels = (0.0, 0.2, 0.4, 0.6, 0.8)
    states = StateSpace((Factor("z1", levels), Factor("z2", levels)))
    tables = [[worsening_table(5, p)] * 2 for p in (0.05, 0.10)]
    model = GraphicalModel(
        states, ("2g", "3g"), states.certain((0.0, 0.0)), TransitionModel.from_factors(tables)
    )
    z1, z2 = states.coordinates.T[:, None, :, None, None]
    span = np.linspace(0.0, 1.0, 24)
    load = np.array([2.0, 3.0])[:, None]
    draws = np.linspace(0.98, 1.03, 30)[:, None, None, None]
    shape = 1e-3 * (1.0 - 0.7 * span)
    strain = shape * load / draws * (1.0 + 0.7 * z1 * np.exp(-3 * span)) * (1.0 + 0.5 * z2 * span)
    sensors = GaussianSensorModel(strain, 125e-6)
    return model, sensors, RewardModel(sensors, 2500e-6, (-0.1, 0.1), 125e-6, (2.0, 3.0))


def eliminate_variables(
    model: GraphicalModel, control: np.ndarray, log_likelihood: np.ndarray, policy: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the seconds that pgmpy takes for the same beliefs, and the last smoothed belief."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("pgmpy").setLevel(logging.ERROR)
        from pgmpy.factors.discrete import TabularCPD
        from pgmpy.inference import VariableElimination
        from pgmpy.models import DiscreteBayesianNetwork

        size, matrix = model.states.size, model.transition.matrix
        tables = [TabularCPD("D0", size, model.prior[:, None])]
        for t in range(1, STEPS + HORIZON):
            if t <= STEPS:
                tables.append(
                    TabularCPD(f"D{t}", size, matrix[control[t - 1]].T, [f"D{t - 1}"], [size])
                )
            else:
                flat = matrix.transpose(2, 1, 0).reshape(size, -1)
                tables.append(
                    TabularCPD(f"D{t}", size, flat, [f"D{t - 1}", f"U{t - 1}"], [size, 2])
                )
            if t >= STEPS:
                tables.append(TabularCPD(f"U{t}", 2, policy.T, [f"D{t}"], [size]))
        for t in range(STEPS):
            odds = np.exp(log_likelihood[t] - log_likelihood[t].max())
            tables.append(TabularCPD(f"O{t}", 2, np.stack([1.0 - odds, odds]), [f"D{t}"], [size]))
        network = DiscreteBayesianNetwork(
            [(parent, table.variable) for table in tables for parent in table.variables[1:]]
        )
        network.add_cpds(*tables)
        inference = VariableElimination(network)
        evidence = {f"O{t}": 1 for t in range(STEPS)}
        names = [f"D{t}" for t in range(STEPS + HORIZON)] + [
            f"U{STEPS + h}" for h in range(HORIZON)
        ]
        begin = time.perf_counter()
        beliefs = {
            name: inference.query([name], evidence=evidence, show_progress=False).values
            for name in names
        }
        seconds = time.perf_counter() - begin
    return seconds, beliefs[f"D{STEPS - 1}"]


def toolbox_seconds(model: GraphicalModel, reward: np.ndarray) -> float:
    """Return the seconds of pymdptoolbox for the same plan."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from mdptoolbox.mdp import ValueIteration

        transition = np.array(model.transition.matrix)

        def solve() -> None:
            plan = ValueIteration(transition, reward, 0.6, epsilon=1e-12, max_iter=1000)
            plan.run()

        return median_seconds(solve)


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
    lists = 1e3 * median_seconds(lambda: joint[0] @ belief, repeats=15)
    alone = "forecast of the joint transitions, scipy.sparse, linear domain"
    return [
        Measurement(
            "filter step, 15,625 states",
            1e3 * median_seconds(step, repeats=25),
            "ms",
            1.0,
            alone,
            lists,
        ),
        Measurement(
            "likelihood of 24 sensors, 15,625 states",
            1e3 * median_seconds(likelihood, repeats=25),
            "ms",
        ),
        Measurement(
            "filter and smooth 50 steps, 15,625 states",
            median_seconds(mission, repeats=5),
            "s",
            10.0,
        ),
    ]


def run() -> list[Measurement]:
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

    elimination, last = eliminate_variables(model, control, log_likelihood, plan.policy)
    np.testing.assert_allclose(last, history.filtered[-1], rtol=1e-9, atol=1e-12)
    per_twin = "pgmpy variable elimination"
    online = median_seconds(online_step, repeats=25, inner=20)
    history_seconds = median_seconds(whole_history, repeats=25, inner=20)

    def side_by_side() -> None:
        beliefs, _ = filter_many(model.transition, many_controls, many, model.log_prior)
        smooth_many(model.transition, many_controls, beliefs.filtered, beliefs.log_filtered)

    batch = median_seconds(side_by_side, repeats=9)
    single = median_seconds(one_by_one, repeats=3)
    planning = median_seconds(lambda: value_iteration(model.transition, reward, 0.6), inner=20)
    mixture = median_seconds(quantities, repeats=5)
    toolbox = toolbox_seconds(model, reward)
    return [
        Measurement("online step at step 50", 1e3 * online, "ms", 1.0, per_twin, 1e3 * elimination),
        Measurement(
            "smooth and predict 50 steps",
            1e3 * history_seconds,
            "ms",
            0.5,
            per_twin,
            1e3 * elimination,
        ),
        Measurement(
            "smooth 1,000 twins of 50 steps", 1e3 * batch, "ms", 60.0, "one by one", 1e3 * single
        ),
        Measurement("value iteration", 1e3 * planning, "ms", 0.5, "pymdptoolbox", 1e3 * toolbox),
        Measurement("quantities of 550 beliefs x 24 sensors, 95 % bands", 1e3 * mixture, "ms"),
        *many_states(),
    ]
