"""Everything that a mission made, before it is stored."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from twin_master.learning.expectation import LearntExpectation
from twin_master.learning.learning_filter import LearningFilter
from twin_master.learning.setup import learning_filter
from twin_master.mission.preparation import Knowledge
from twin_master.mission.truth import Truth
from twin_master.mission.turns import History
from twin_master.scenario.schema import Scenario
from twin_master.store.learnt import LearntQuantity, learnt_quantities

__all__ = ["SEVERAL_UNITS", "MissionResult"]

SEVERAL_UNITS = "see sensor_unit"
"""Unit of a variable over sensors of different units."""


@dataclass(frozen=True)
class MissionResult:
    """Everything that a mission made, before it is stored.

    Attributes
    ----------
    scenario : Scenario
        What was flown.
    knowledge : Knowledge
        What the twin knew before.
    flight : History
        The turns.
    truth : Truth or None
        What the sensors really did; None where nobody knows.
    units : dict of str to str
        Units of control inputs, monitors and parameters; those that are missing are dimensionless.
    """

    scenario: Scenario
    knowledge: Knowledge
    flight: History
    truth: Truth | None = None
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
        known = self.knowledge
        return learning_filter(self.scenario, known.model, known.sensor_model, known.draws.values)

    @cached_property
    def expectation(self) -> LearntExpectation | None:
        """What is expected of sensors and rewards by what was learnt; None where nothing is."""
        if self.learning is None:
            return None
        return LearntExpectation(self.learning, self.knowledge.rewards, self.knowledge.plan.policy)

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
