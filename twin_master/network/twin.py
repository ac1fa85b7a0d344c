"""The twin: it is shown observations and the control in force, and says what to do; it holds no truth."""

import re
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fe.runtime.arrays import arrays_from_bytes, arrays_to_bytes
from fe.runtime.errors import ReducedModelFileError
from reporting.arrays import Float
from reporting.choices import require_one_of
from reporting.words import brief
from twin_master.errors import InvalidModelError, InvalidObservationError, said
from twin_master.network import graphical_model
from twin_master.network.estimator import (
    Carried,
    Estimate,
    Estimator,
    ExactFilter,
    Notice,
    SensorModel,
    Suspicion,
)
from twin_master.network.graphical_model import GraphicalModel, worsening_table
from twin_master.network.inference import Predicted, predict
from twin_master.network.planner import BeliefPolicy, decision
from twin_master.network.transition import expect_controls
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import probability_of

_LARGEST = np.float64(1e150)
"""What is carried is below this, so that what follows from it are numbers, too."""
Planner = Callable[[GraphicalModel], ArrayLike]
"""Returns the policy p(U | D), (S, U), for states, controls and transitions."""
DecisionBasis = Literal["filtered", "predicted"]
"""Belief that the twin decides on: of the present step, or of the next one."""
DEFAULT_LAG = 50
"""Steps back that a twin smooths and may be revised."""
_FORMER_COUNT = re.compile(r"(?<![^/])turns$")
"""The name that the arrays `steps` had in the saved states of earlier versions, also behind a prefix."""


def factor_tables(scenario: Scenario, leaving: float = 1.0) -> dict[str, dict[str, Float]]:
    """Return the transitions (levels, levels) of each factor under each control, with what actions repair."""
    tables: dict[str, dict[str, Float]] = {}
    for control in scenario.control_names:
        if scenario.transition.kind == "independent_tables":
            given = scenario.transition.tables[control]
            tables[control] = {name: np.asarray(given[name], np.float64) for name in scenario.state_names}
        else:
            probability = partial(probability_of, scenario.transition.probability, control)
            tables[control] = {
                factor.name: worsening_table(len(factor.levels), probability(factor.name))
                for factor in scenario.state
            }
    if leaving != 1.0:
        tables = {
            control: {name: graphical_model.leaving_table(table, leaving) for name, table in rows.items()}
            for control, rows in tables.items()
        }
    for action in scenario.action:
        for name in action.repairs:
            tables[action.name][name] = graphical_model.repaired_table(
                tables[action.name][name], action.success
            )
    return tables


def build_graphical_model(scenario: Scenario, leaving: float = 1.0) -> GraphicalModel:
    """Return states, controls, prior and transitions of a scenario: Kapteyn et al. 2021, eqs. (28)-(29).

    Its factors move independently given the control, and are independent before the first observation.

    Parameters
    ----------
    scenario : Scenario
    leaving : float
        Factor on the probabilities of each factor of the state to leave a level.

    Raises
    ------
    InvalidModelError
        The factor makes a probability larger than one.
    """
    levels = {factor.name: factor.levels for factor in scenario.state}
    return GraphicalModel.from_tables(
        levels, factor_tables(scenario, leaving), {factor.name: factor.prior for factor in scenario.state}
    )


@dataclass(frozen=True, kw_only=True)
class TwinStep(Estimate):
    """What the twin concludes in one step t, and its decision.

    Attributes
    ----------
    step : int
        The number t, from 0.
    prediction : Predicted
        Beliefs and controls of the steps t + 1 ... t + H.
    decision_probability : (U,)
        policy(U | D) averaged over the belief that the twin decides on.
    next_control : int
        Its mode, the first of equals: the control to fly in step t + 1.
    """

    step: int
    prediction: Predicted
    decision_probability: Float
    next_control: int

    @property
    def control_index(self) -> int:
        """Control u_t in force."""
        return self.carried.control_index


@dataclass(frozen=True)
class _Seen:
    """A step that is kept: what was observed and what the estimator carries on."""

    observation: Float
    estimate: Carried


class Twin:
    """Belief about one asset, updated step by step, without end.

    A step costs the same time and memory at the start and after years: what is kept are the last `lag` steps,
    over which the twin smooths and into which it takes what comes late.

    Parameters
    ----------
    name : str
        Name of the twin, for messages.
    model : GraphicalModel
        S states, U controls.
    sensor_model : SensorModel
        Gives log p(o_t | D_t, u_t): a `GaussianSensorModel`, or anything with its `log_likelihood`.
    policy : (S, U) or callable
        p(U | D), row-stochastic, or a planner: called with the model, it returns the policy.
    prediction_steps : int
        How far to predict.
    decide_on : {"filtered", "predicted"}
        The next control is the mode of policy(U | D) averaged over p(D_t | o_0..o_t), the state last seen, as
        in the paper's graph; or over p(D_{t+1} | o_0..o_t), as in the authors' published code.
    lag : int or None
        How many steps back the twin smooths and may be revised; None keeps all steps.
    first_control : int or str
        Control of the first step, where none is given with it.
    estimator : Estimator, optional
        What holds the belief in the place of the exact filter of model and sensor model.
    safest : int or str, optional
        Control where no state is believed; without it the policy of what is believed decides alone.
    on_belief : BeliefPolicy, optional
        Decides by p(D_{t+1} | o_0..o_t) in the place of the policy, which predicts.

    Raises
    ------
    InvalidModelError
        The policy has another shape or is none, there is no such control, or the lag is negative.
    InvalidChoiceError
        If `decide_on` is another word.
    """

    def __init__(
        self,
        name: str,
        model: GraphicalModel,
        sensor_model: SensorModel,
        policy: "ArrayLike | Planner",
        *,
        prediction_steps: int = 10,
        decide_on: DecisionBasis = "filtered",
        lag: int | None = DEFAULT_LAG,
        first_control: int | str = 0,
        estimator: Estimator | None = None,
        safest: int | str | None = None,
        on_belief: BeliefPolicy | None = None,
    ) -> None:
        require_one_of(decide_on, get_args(DecisionBasis), "decide_on")
        if lag is not None and lag < 0:
            raise InvalidModelError(f"expected a lag of 0 or more steps, or None for all, got {lag}")
        self.name = name
        self.sensor_model = sensor_model
        self.estimator: Estimator = estimator or ExactFilter(model, sensor_model, name)
        self.policy = model.policy(policy(model) if callable(policy) else policy)
        self.prediction_steps = prediction_steps
        self.decide_on = decide_on
        self._on_belief = on_belief
        self.lag = lag
        self._seen: deque[_Seen] = deque(maxlen=None if lag is None else lag + 2)  # with the step before
        self._steps = 0
        self._proposed = self._index_of(first_control)
        self._safest: Float | None = None
        if safest is not None:
            self._safest = np.eye(len(model.controls))[self._index_of(safest)]

    def __repr__(self) -> str:
        return brief(self, name=self.name, model=self.model, steps=self._steps, lag=self.lag)

    @property
    def model(self) -> GraphicalModel:
        """States, controls, prior and transitions."""
        return self.estimator.model

    @property
    def steps(self) -> int:
        """Number of steps seen so far."""
        return self._steps

    @property
    def proposed_control(self) -> int:
        """Index of the control for the next step: that of the last decision, or the first control."""
        return self._proposed

    @property
    def first_kept(self) -> int:
        """The first step of `smoothed`, and the first that may still be revised."""
        return self._steps - len(self._recent())

    def step(self, observation: ArrayLike, control: int | str | None = None) -> TwinStep:
        """Advance by one step, correct by an observation, predict and decide.

        Parameters
        ----------
        observation : (G,)
            What the sensors say, SI; NaN where nothing was received. All NaN predicts through the step.
        control : int or str, optional
            Index or name of the control in force during this step; the one that was proposed if left out.

        Raises
        ------
        ImpossibleObservation
            If the observation is impossible in every state that the belief allows; the twin is unchanged.
        InvalidObservationError, InvalidModelError
            If the observation has another shape, is infinite or cannot be weighed, the twin is unchanged; if
            there is no such control.
        """
        given = np.array(observation, dtype=np.float64)
        index = self._proposed if control is None else self._index_of(control)
        return self._assimilated(len(self._seen), [(given, index)])

    def revise(self, step: int, observation: ArrayLike, control: int | str | None = None) -> TwinStep:
        """Put an observation that came late in its place, and filter anew from there.

        The result is that of a twin which had it in time, to the last bit, where the controls in force were
        the same.

        Parameters
        ----------
        step : int
            Its step, not before `first_kept`.
        observation, control
            As in `step`; the control that was assumed for that step if left out.

        Returns
        -------
        TwinStep
            What the twin now concludes in its last step, with the notices of all steps filtered anew: what
            the late observation brings to light in a step before would never be told.

        Raises
        ------
        IndexError
            The step is not kept any more, or has not been.
        ImpossibleObservation, InvalidObservationError, InvalidModelError
            As in `step`; the twin is unchanged.
        """
        if not self.first_kept <= step < self._steps:
            raise IndexError(said("network.revised", step=step, first=self.first_kept, seen=self._steps))
        at = step - self._steps + len(self._seen)
        index = self._seen[at].estimate.control_index if control is None else self._index_of(control)
        rows = [(np.array(observation, dtype=np.float64), index)]
        rows += [(seen.observation, seen.estimate.control_index) for seen in list(self._seen)[at + 1 :]]
        return self._assimilated(at, rows)

    def _assimilated(self, at: int, rows: Sequence[tuple[Float, int]]) -> TwinStep:
        """Filter observations under their controls from a place of what is kept on, and decide."""
        first, anew, notices = self._steps - len(self._seen) + at, list[_Seen](), list[Notice]()
        before = self._seen[at - 1].estimate if at else None
        for number, (given, in_force) in enumerate(rows, start=first):
            estimate = self._estimate(before, given, in_force, number)
            before = estimate.carried
            anew.append(_Seen(given, before))
            notices += estimate.notices
        for _ in range(len(self._seen) - at):
            self._seen.pop()
        self._seen.extend(anew)
        self._steps = first + len(rows)
        return self._decided(replace(estimate, notices=tuple(notices)))

    def observed(self, step: int) -> Float:
        """Return what was observed in a step that is kept: (G,), NaN where nothing was received."""
        return self._seen[step - self._steps + len(self._seen)].observation

    def control_of(self, step: int) -> int:
        """Return the index of the control in force in a step that is kept."""
        return self._seen[step - self._steps + len(self._seen)].estimate.control_index

    def predict(self, belief: ArrayLike, control: int | str, steps: int | None = None) -> Predicted:
        """Predict through the policy from any belief (S,) under a control in force: eqs. (37)-(39)."""
        ahead = self.prediction_steps if steps is None else steps
        return predict(self.model, belief, self._index_of(control), self.policy, ahead)

    def smoothed(self) -> Float:
        """Return p(D_k | o_0..o_t) for the steps k = `first_kept`..t: (n, S).

        The decision does not need it, and after each step it would cost as much as all steps that are kept.
        """
        return self.estimator.smoothed(self.carried)

    @property
    def carried(self) -> tuple[Carried, ...]:
        """What the estimator carried on from the steps `first_kept`..t."""
        return tuple(seen.estimate for seen in self._recent())

    def save_state(self) -> bytes:
        """Return all that the twin has seen and keeps, for `restore_state`."""
        return self._packed(self._steps, self._seen)

    def settled(self) -> tuple[int, bytes] | None:
        """Return the last step that cannot be revised any more, and the state behind it, for `restore_state`.

        All later steps follow from it; None before there is such a step.
        """
        step = self.first_kept - 1
        return None if step < 0 else (step, self._packed(step + 1, [self._seen[0]]))

    def _packed(self, steps: int, kept: Iterable[_Seen]) -> bytes:
        arrays: dict[str, NDArray[Any]] = {"steps": np.array([steps, self._proposed])}
        for place, seen in enumerate(kept):
            arrays[f"{place}/observation"] = seen.observation
            arrays[f"{place}/control"] = np.array(seen.estimate.control_index)
            arrays |= {f"{place}/carried/{name}": value for name, value in seen.estimate.arrays.items()}
        return arrays_to_bytes(arrays)

    def restore_state(self, state: bytes) -> None:
        """Go on from a saved state of a twin of the same model, sensors and estimator, to the last bit.

        Raises
        ------
        InvalidModelError
            It is no such state.
        """
        causes = ReducedModelFileError, KeyError, ValueError, TypeError
        with InvalidModelError.instead_of(*causes, before="this is no saved state of a twin: "):
            arrays = {
                _FORMER_COUNT.sub("steps", name): value
                for name, value in arrays_from_bytes(state, "the state of the twin").items()
            }
            steps, proposed = arrays["steps"].tolist()
            seen: list[_Seen] = []
            while f"{len(seen)}/control" in arrays:
                prefix = f"{len(seen)}/carried/"
                own = {
                    name.removeprefix(prefix): value
                    for name, value in arrays.items()
                    if name.startswith(prefix)
                }
                control = int(arrays[f"{len(seen)}/control"])
                seen.append(_Seen(arrays[f"{len(seen)}/observation"], Carried(control, own)))
        self._steps, self._proposed = steps, proposed
        self._seen.clear()
        self._seen.extend(seen)

    def _recent(self) -> list[_Seen]:
        seen = list(self._seen)
        return seen if self.lag is None else seen[-(self.lag + 1) :]

    def _estimate(self, before: Carried | None, given: Float, control: int, step: int) -> Estimate:
        """Return what the estimator concludes, of which nothing is NaN or too large to be squared."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                estimate = self.estimator.step(before, given, control, step)
            found = (estimate.log_evidence, estimate.filtered, *estimate.carried.arrays.values())
            held = all(np.all(np.asarray(values) < _LARGEST) for values in found)
        except (ArithmeticError, np.linalg.LinAlgError):
            held = False
        if not held:
            raise InvalidObservationError(said("network.no_belief", name=self.name, step=step))
        return estimate

    def _index_of(self, control: int | str) -> int:
        controls = self.model.controls
        if isinstance(control, str):
            if control not in controls:
                raise InvalidModelError(f"no control is named {control!r}; there are {', '.join(controls)}")
            return controls.index(control)
        expect_controls(control, len(controls))
        return int(control)

    def _decided(self, estimate: Estimate) -> TwinStep:
        control_index = estimate.carried.control_index
        prediction = predict(self.model, estimate.filtered, control_index, self.policy, self.prediction_steps)
        decision_probability = self._decision(estimate.filtered, control_index)
        if self._safest is not None:
            none = estimate.unexplained
            decision_probability = (1.0 - none) * decision_probability + none * self._safest
            prediction = prediction.mixed(none, self._safest)
        self._proposed = int(np.argmax(decision_probability))
        own = vars(estimate) | {"suspicion": self._with_decision(estimate)}
        return TwinStep(
            **own, step=self._steps - 1, prediction=prediction, decision_probability=decision_probability,
            next_control=self._proposed,
        )  # fmt: skip

    def _with_decision(self, estimate: Estimate) -> Suspicion | None:
        """Return what is suspected, with the hypothesis that adds most to the probability of the decision."""
        share = {}
        for one in estimate.hypotheses:
            chosen = self._safest
            if one.belief is not None:
                chosen = self._decision(one.belief, estimate.carried.control_index)
            share[one.name] = 0.0 if chosen is None else one.probability * float(chosen[self._proposed])
        if estimate.suspicion is None or not share:
            return estimate.suspicion
        return replace(estimate.suspicion, decided_by=max(share, key=share.__getitem__))

    def _decision(self, belief: Float, control_index: int) -> Float:
        """Return the probability of each control (U,), by the belief of this step or the next."""
        alone = belief[None], np.array([control_index]), self.policy, self._on_belief
        return np.asarray(decision(self.model.transition, *alone, ahead=self.decide_on == "predicted")[0])
