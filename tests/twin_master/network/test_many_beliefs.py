"""A belief among many gives what it gives alone, to the last bit."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reporting.arrays import Float
from tests.twin_master.runs import of_library
from twin_master.fleet.reading import probability_of_leaving
from twin_master.network.graphical_model import Factor, StateSpace
from twin_master.network.inference import known_control
from twin_master.network.planner import BeliefPolicy
from twin_master.network.quantity import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import TransitionModel

CONTROLS = 2


@dataclass
class Twin:
    """A random model with what it says of beliefs."""

    levels: tuple[int, int]
    sensor_count: int
    generator: np.random.Generator

    def __post_init__(self) -> None:
        random = self.generator
        factors = [Factor(f"z{k}", tuple(range(count))) for k, count in enumerate(self.levels)]
        self.states = StateSpace(tuple(factors))
        size = self.states.size
        values = random.normal(size=(3, size, CONTROLS, self.sensor_count))
        self.sensors = GaussianSensorModel(values, 0.7, np.full(3, 1 / 3), model_error=0.1)
        self.rewards = RewardModel(self.sensors, 2.0, (-0.1, 0.1), 0.4)
        self.policy = BeliefPolicy(random.normal(size=(30, size)), np.arange(30) % CONTROLS)
        blocks = [random.dirichlet(np.ones(count), (CONTROLS, count)) for count in self.levels]
        self.product = TransitionModel(tuple(blocks))

    def beliefs(self, count: int) -> Float:
        """Return beliefs (B, S)."""
        return self.generator.dirichlet(np.ones(self.states.size), count)

    def joint(self, beliefs: Float) -> Float:
        """Return the joint of beliefs (B, S) and a control (B, S, U)."""
        return known_control(beliefs, np.zeros(len(beliefs), dtype=np.int64), CONTROLS)


FUNCTIONS: dict[str, Callable[[Twin, Float], Float]] = {
    "mean of the state": lambda twin, beliefs: twin.states.mean(beliefs),
    "deviation of the state": lambda twin, beliefs: twin.states.standard_deviation(beliefs),
    "moments": lambda twin, beliefs: np.hstack(twin.sensors.moments(twin.joint(beliefs))),
    "quantiles": lambda twin, beliefs: twin.sensors.quantiles(twin.joint(beliefs), [0.1, 0.9]),
    "noise": lambda twin, beliefs: twin.sensors.noise(twin.joint(beliefs)),
    "rewards": lambda twin, beliefs: np.hstack(twin.rewards.expectation(twin.joint(beliefs))),
    "value": lambda twin, beliefs: twin.policy.value(beliefs),
    "value of controls": lambda twin, beliefs: twin.policy.action_value(beliefs, CONTROLS),
    "transition of factors": lambda twin, beliefs: twin.product.forward(1, beliefs),
}
"""Functions of beliefs (B, S); the first axis of the result is that of the beliefs."""


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
@given(
    count=st.integers(2, 40),
    levels=st.tuples(st.integers(2, 7), st.integers(2, 7)),
    sensor_count=st.integers(1, 26),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_belief_among_many_gives_what_it_gives_alone(function, count, levels, sensor_count, seed):
    twin = Twin(levels, sensor_count, np.random.default_rng(seed))
    beliefs = twin.beliefs(count)

    together = function(twin, beliefs)

    alone = [function(twin, belief[None]) for belief in beliefs]
    np.testing.assert_array_equal(together, np.concatenate(alone))


def test_a_twin_among_many_leaves_its_control_as_it_does_alone(library_file: Path):
    knowledge, _ = of_library("level_turns", library_file)
    beliefs = np.random.default_rng(3).dirichlet(np.ones(knowledge.model.states.size), 23)

    together = probability_of_leaving(knowledge, beliefs, control=1)

    alone = [probability_of_leaving(knowledge, belief[None], control=1) for belief in beliefs]
    np.testing.assert_array_equal(together, np.concatenate(alone))
