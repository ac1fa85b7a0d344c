"""Everything that a mission made, before it is stored."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin_master.learning.expectation import LearntExpectation
from twin_master.learning.learning_filter import LearningFilter
from twin_master.learning.setup import learning_filter
from twin_master.mission.loop import Flight
from twin_master.mission.truth import Truth
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import PlannedPolicy
from twin_master.network.rewards import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario
from twin_master.store.learnt import LearntQuantity, learnt_quantities

__all__ = ["SEVERAL_UNITS", "MissionResult"]

Float = NDArray[np.float64]

SEVERAL_UNITS = "see sensor_unit"
"""Unit of a variable over sensors of different units."""


@dataclass(frozen=True)
class MissionResult:
    """Everything that a mission made, before it is stored.

    Attributes
    ----------
    scenario : Scenario
        What was flown.
    model : GraphicalModel
        S states, U controls.
    sensor_model : GaussianSensorModel
        The twin's predicted observations for each draw of the parameter, and their noise.
    draws : (E,)
        Draws of the uncertain parameter.
    rewards : RewardModel
        Rewards by state and control.
    plan : PlannedPolicy
        Value iteration.
    truth : Truth or None
        What the sensors really did; None where nobody knows.
    flight : Flight
        The mission.
    units : dict of str to str
        Units of control inputs, monitors and parameters; those that are missing are dimensionless.
    """

    scenario: Scenario
    model: GraphicalModel
    sensor_model: GaussianSensorModel
    draws: Float
    rewards: RewardModel
    plan: PlannedPolicy
    truth: Truth | None
    flight: Flight
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def state_unit(self) -> str:
        """Unit of the state factors; a list where they have several."""
        return ", ".join(dict.fromkeys(factor.unit for factor in self.scenario.state))

    @property
    def observation_unit(self) -> str:
        """Unit of the observed values; where they have several, each sensor has its own, `sensor_unit`."""
        units = dict.fromkeys(self.scenario.observation.sensor_units)
        return next(iter(units)) if len(units) == 1 else SEVERAL_UNITS

    @property
    def parameter_unit(self) -> str:
        """Unit of the uncertain parameter."""
        return self.units.get(self.scenario.calibration.parameter, "1")

    @cached_property
    def learning(self) -> LearningFilter | None:
        """What learnt; None where nothing is."""
        if not self.flight.learnt_names:
            return None
        return learning_filter(self.scenario, self.model, self.sensor_model, self.draws)

    @cached_property
    def expectation(self) -> LearntExpectation | None:
        """What is expected of sensors and rewards by what was learnt; None where nothing is."""
        if self.learning is None:
            return None
        return LearntExpectation(self.learning, self.rewards, self.plan.policy)

    @cached_property
    def learnt(self) -> tuple[LearntQuantity, ...]:
        """What was learnt; empty where nothing is."""
        if self.learning is None:
            return ()
        return learnt_quantities(
            self.scenario,
            self.flight.learnt_names,
            self.flight.learnt,
            self.learning.prior,
            {self.scenario.calibration.parameter: self.parameter_unit, "gauge_offset": self.observation_unit},
            simulated=self.truth is not None,
        )
