"""The twin: it is shown observations and the control in force, and says what to do next.

It holds no asset and no truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin_master.network.graphical_model import GraphicalModel, worsening_table
from twin_master.network.inference import ObservationContext, Predicted, filter_step, predict, smooth
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_WORST_SHOWN = 3


def build_graphical_model(scenario: Scenario) -> GraphicalModel:
    """Return states, controls, prior and transitions of a scenario: Kapteyn et al. 2021, eqs. (28)-(29).

    The factors of the state move independently given the control, and are independent before the first
    observation.
    """
    tables: dict[str, dict[str, Float]] = {}
    for control in scenario.control_names:
        if scenario.transition.kind == "independent_tables":
            given = scenario.transition.tables[control]
            tables[control] = {name: np.asarray(given[name], np.float64) for name in scenario.state_names}
        else:
            entry = scenario.transition.probability[control]
            tables[control] = {
                factor.name: worsening_table(
                    len(factor.levels), entry[factor.name] if isinstance(entry, dict) else entry
                )
                for factor in scenario.state
            }
    levels = {factor.name: factor.levels for factor in scenario.state}
    return GraphicalModel.from_tables(
        levels, tables, {factor.name: factor.prior for factor in scenario.state}
    )


@dataclass(frozen=True)
class TwinTurn:
    """What the twin concludes in one turn t.

    Attributes
    ----------
    filtered : (S,)
        p(D_t | o_0..o_t).
    log_evidence : float
        log p(o_t | o_0..o_{t-1}).
    prediction : Predicted
        Beliefs and controls of the steps t + 1 ... t + H.
    decision_probability : (U,)
        policy(U | D) averaged over the belief that the twin decides on.
    next_control : int
        Its mode, the first of equals: the control to fly in step t + 1.
    """

    filtered: Float
    log_evidence: float
    prediction: Predicted
    decision_probability: Float
    next_control: int


class Twin:
    """Belief about one asset, updated turn by turn.

    Parameters
    ----------
    name : str
        Name of the twin, for messages.
    model : GraphicalModel
        S states, U controls.
    sensor_model : GaussianSensorModel
        Gives log p(o_t | D_t, u_t).
    policy : (S, U)
        p(U | D), row-stochastic.
    steps : int
        Largest number of turns.
    prediction_steps : int
        How far to predict.
    decide_on : {"filtered", "predicted"}
        The next control is the mode of policy(U | D) averaged over p(D_t | o_0..o_t), so that the policy
        acts on the state last observed, as in the paper's graph; or over p(D_{t+1} | o_0..o_t), one step
        ahead, as in the authors' published code.
    """

    def __init__(
        self,
        name: str,
        model: GraphicalModel,
        sensor_model: GaussianSensorModel,
        policy: Float,
        steps: int,
        prediction_steps: int,
        decide_on: Literal["filtered", "predicted"] = "filtered",
    ) -> None:
        self.name = name
        self.model = model
        self.sensor_model = sensor_model
        self.policy = policy
        self.prediction_steps = prediction_steps
        self.decide_on = decide_on
        size = model.states.size
        self._log_filtered: Float = np.zeros((steps, size))
        self._control: Index = np.zeros(steps, dtype=np.int64)
        self._turns = 0

    @property
    def turns(self) -> int:
        """Number of turns seen so far."""
        return self._turns

    def turn(self, observation: Float, control_index: int) -> TwinTurn:
        """Assimilate one observation, predict and decide.

        Parameters
        ----------
        observation : (G,)
            What the sensors say, SI; NaN where nothing was received.
        control_index : int
            The control in force during this turn.

        Raises
        ------
        ImpossibleObservation
            If the observation is impossible in every state that the belief allows; the twin is unchanged.
        """
        step = self._turns
        log_likelihood = self.sensor_model.log_likelihood(observation, control_index)

        def worst(_step: int) -> Mapping[str, float]:
            return self._worst_residuals(observation, control_index)

        filtered = filter_step(
            self.model,
            self._log_filtered[step - 1] if step else None,
            int(self._control[step - 1]) if step else None,
            log_likelihood,
            ObservationContext(self.name, step, worst),
        )
        self._log_filtered[step] = filtered.log_filtered
        self._control[step] = control_index
        self._turns = step + 1
        prediction = predict(self.model, filtered.filtered, control_index, self.policy, self.prediction_steps)
        decided_on = filtered.filtered
        if self.decide_on == "predicted":
            decided_on = filtered.filtered @ self.model.transition.matrix[control_index]
        decision_probability: Float = decided_on @ self.policy
        return TwinTurn(
            filtered=filtered.filtered,
            log_evidence=filtered.log_evidence,
            prediction=prediction,
            decision_probability=decision_probability,
            next_control=int(np.argmax(decision_probability)),
        )

    def smoothed(self) -> Float:
        """Return p(D_k | o_0..o_t) for every turn k = 0..t seen so far: (t + 1, S).

        The decision does not need it, and after each turn it would cost the square of the turns.
        """
        seen = slice(0, self._turns)
        return smooth(self.model, self._control[seen], self._log_filtered[seen]).smoothed

    def _worst_residuals(self, observation: Float, control_index: int) -> dict[str, float]:
        """Return the sensors that fit worst in the state that fits best, in standard deviations."""
        predicted = self.sensor_model.mean[:, control_index]
        deviation = self.sensor_model.total_standard_deviation[:, control_index]
        with np.errstate(over="ignore"):  # an absurd observation is what this is for
            residual = (observation - predicted) / deviation
            distance = np.nan_to_num(np.abs(residual), nan=0.0)
            best = int(np.argmin(distance.sum(axis=1)))
        order = np.argsort(-distance[best])[:_WORST_SHOWN]
        return {f"sensor {index + 1}": float(residual[best, index]) for index in order}
