"""The twin: it receives observations and the control in force, and decides on the next control.

It never receives the true state.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from fe.runtime.arrays import arrays_from_bytes, arrays_to_bytes
from fe.runtime.errors import ReducedModelFileError
from reporting.arrays import AnyArray, Float, Index, nan_where_masked, product_of_each
from reporting.choices import require_one_of
from reporting.words import brief
from twin_master.errors import InvalidModelError, InvalidObservationError
from twin_master.network.estimator import (
    Carried,
    Estimate,
    Estimator,
    KeptStep,
    KeptSteps,
    Notice,
    SensorModel,
)
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import NO_CONTROL, ExactFilter, Predicted, predict
from twin_master.network.planner import BeliefPolicy, Hold, RiskPolicy
from twin_master.network.transition import TransitionModel, checked_beliefs, checked_controls

LARGEST_CARRIED = np.float64(1e150)
"""Upper bound of the numbers of an estimate and of those that it carries to the next step: their
squares are still finite."""
Planner = Callable[[GraphicalModel], ArrayLike]
"""Returns the policy p(U | D), (S, U), for states, controls and transitions."""
DecisionBasis = Literal["filtered", "predicted"]
"""Belief on which the twin decides: that of the present step, or of the next one."""
DEFAULT_LAG = 50
"""Steps back over which a twin smooths and which may be revised."""
_FORMER_COUNT = re.compile(r"(?<![^/])turns$")
"""Pattern of the former name `turns` of arrays in saved states, with or without a prefix."""


@dataclass(frozen=True)
class DecisionRule:
    """The rule by which twins with the same model choose their next controls.

    It is the same for a single twin, for twins side by side, and in simulated missions. The
    decision of a twin does not depend on the other twins, not even in the last bit.

    Attributes
    ----------
    transition : TransitionModel
        The transitions between S states.
    policy : (S, U) array
        p(U | D), which is averaged over the belief.
    on_belief : BeliefPolicy, RiskPolicy or None
        A policy that takes the place of `policy`.
    looks_ahead : bool
        Whether the policy is averaged over p(D_{t+1} | o_0..o_t), and not over p(D_t | o_0..o_t). A
        `BeliefPolicy` always decides by the former.
    safest : (U,) array or None
        One for the control that is taken if no state explains the sensors, zero for the others. If
        it is None, that case is ignored.
    hold : Hold or None
        How often a harder control must be proposed in a row; once if None.
    """

    transition: TransitionModel
    policy: Float
    on_belief: BeliefPolicy | RiskPolicy | None = None
    looks_ahead: bool = False
    safest: Float | None = None
    hold: Hold | None = None

    def probabilities(
        self,
        filtered: Float,
        control: Index,
        unexplained: Float | None = None,
        *,
        predicted: Float | None = None,
    ) -> Float:
        """Return the probability (B, U) of each next control by the policy alone, for B twins.

        Parameters
        ----------
        filtered : (B, S) array
            p(D_t | o_0..o_t).
        control : (B,) array
            The indices of the controls in force in step t.
        unexplained : (B,) array, optional
            The probability that no state explains the sensors; zero if left out.
        predicted : (B, S) array, optional
            p(D_{t+1} | o_0..o_t), if it is known already.
        """
        belief = filtered
        if self.looks_ahead or isinstance(self.on_belief, BeliefPolicy):
            if predicted is None:
                pairs = zip(control.tolist(), filtered, strict=True)
                predicted = np.stack([self.transition.forward(u, row) for u, row in pairs])
            belief = predicted
        # A policy on the belief is deterministic: its control has the probability one. A twin whose
        # flight has failed has no belief, and its control is not used.
        one_hot = np.eye(self.policy.shape[1])
        if isinstance(self.on_belief, RiskPolicy):
            # The risk contains the case that no state explains the sensors.
            doubt_of_twin = 0.0 if unexplained is None else np.nan_to_num(unexplained)
            return np.asarray(one_hot[self.on_belief.decide(np.nan_to_num(belief), doubt_of_twin)])
        if self.on_belief is not None:
            probability = one_hot[self.on_belief.decide(np.nan_to_num(belief))]
        else:
            probability = product_of_each(belief, self.policy)
        if unexplained is None or self.safest is None:
            return probability
        doubt = unexplained[:, None]
        return (1.0 - doubt) * probability + doubt * self.safest

    def decide(
        self, probability: Float, control: Index, proposals_before: Index
    ) -> tuple[Float, Index, Index]:
        """Decide on the next control of each of B twins: the most probable one.

        With a `Hold`, a change to a harder control waits until harder controls have been proposed
        often enough in a row.

        Parameters
        ----------
        probability : (B, U) array
            The probability of each next control by the policy.
        control : (B,) array
            The indices of the controls in force.
        proposals_before : (B,) array
            How often in a row a harder control than the one in force was proposed before.

        Returns
        -------
        probability : (B, U) array
            The probability of each next control. While a change is held back, the probability of
            all harder controls is added to that of the control in force.
        next_control : (B,) array
            The index of the most probable next control; the first one on a tie.
        proposals : (B,) array
            How often in a row a harder control was proposed, this step included; 0 without a
            `Hold`.
        """
        proposals = np.zeros_like(proposals_before)
        if self.hold is not None:
            probability, proposals = self.hold.apply(probability, control, proposals_before)
        return probability, np.argmax(probability, axis=1), proposals


@dataclass(frozen=True, kw_only=True)
class TwinStep(Estimate):
    """What the twin concludes in one step t, and its decision.

    Attributes
    ----------
    step : int
        The number t, from 0.
    prediction : Predicted
        Beliefs and controls of the steps t + 1 ... t + H.
    decision_probability : (U,) array
        policy(U | D) averaged over the belief on which the twin decides.
    next_control : int
        The index of the control to fly in step t + 1: the most probable one, or the first on a tie.
    """

    step: int
    prediction: Predicted
    decision_probability: Float
    next_control: int

    @property
    def control_index(self) -> int:
        """Control u_t in force."""
        return self.carried.control_index


class Twin:
    """The belief about one asset, updated step by step, without end.

    A step takes the same time and memory at the start and after years, because only the last `lag`
    steps are kept: the twin smooths over them, and late observations can revise them.

    Parameters
    ----------
    name : str
        The name of the twin, for messages.
    model : GraphicalModel
        S states, U controls.
    sensor_model : SensorModel
        Gives log p(o_t | D_t, u_t): a `GaussianSensorModel`, or anything with its `log_likelihood`.
    policy : (S, U) array or callable
        p(U | D), row-stochastic; or a planner, which is called with the model and returns the
        policy.
    prediction_steps : int
        The number of steps that are predicted.
    decide_on : {"filtered", "predicted"}
        The next control is the mode of policy(U | D) averaged over p(D_t | o_0..o_t), the belief of
        this step, as in the paper's graph; or over p(D_{t+1} | o_0..o_t), as in the authors'
        published code.
    lag : int or None
        The number of steps back over which the twin smooths and which may be revised; None keeps
        all steps.
    first_control : int or str
        The control of the first step, if none is given with it.
    estimator : Estimator, optional
        The estimator of the belief; the exact filter of model and sensor model if left out.
    safest : int or str, optional
        The control to take if no state explains the sensors. If left out, that case is ignored: the
        policy decides by the belief alone.
    on_belief : BeliefPolicy or RiskPolicy, optional
        A policy that decides by the belief. If it is given, `policy` serves only to predict.
    hold : Hold, optional
        How often a change to a harder control must be proposed in a row; once if left out.

    Raises
    ------
    InvalidModelError
        If the policy has another shape or is not a policy, there is no such control, or the lag is
        negative.
    InvalidChoiceError
        If `decide_on` is another word.
    """

    def __init__(
        self,
        name: str,
        model: GraphicalModel,
        sensor_model: SensorModel,
        policy: ArrayLike | Planner,
        *,
        prediction_steps: int = 10,
        decide_on: DecisionBasis = "filtered",
        lag: int | None = DEFAULT_LAG,
        first_control: int | str = 0,
        estimator: Estimator | None = None,
        safest: int | str | None = None,
        on_belief: BeliefPolicy | RiskPolicy | None = None,
        hold: Hold | None = None,
    ) -> None:
        require_one_of(decide_on, get_args(DecisionBasis), "decide_on")
        if lag is not None and lag < 0:
            raise InvalidModelError(
                f"the lag must be 0 or more steps, or None for all steps, but {lag} was given"
            )
        self.name = name
        self.sensor_model = sensor_model
        self.estimator: Estimator = estimator or ExactFilter(model, sensor_model, name)
        self.decision_rule = DecisionRule(
            model.transition,
            model.policy(policy(model) if callable(policy) else policy),
            on_belief,
            looks_ahead=decide_on == "predicted",
            safest=None if safest is None else np.eye(len(model.controls))[self._index_of(safest)],
            hold=hold,
        )
        self.prediction_steps = prediction_steps
        self.lag = lag
        # The present step, `lag` steps before it, and one more: to filter the first of these again,
        # the arrays carried on from the step before it are needed.
        self._kept_steps = KeptSteps(self.estimator, None if lag is None else lag + 2)
        self._proposed = self._index_of(first_control)

    def __repr__(self) -> str:
        return brief(self, name=self.name, model=self.model, steps=self.steps, lag=self.lag)

    @property
    def model(self) -> GraphicalModel:
        """States, controls, prior and transitions."""
        return self.estimator.model

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self._kept_steps.end

    @property
    def proposed_control(self) -> int:
        """Index of the control for the next step: the last decision, or the first control."""
        return self._proposed

    @property
    def previous_control(self) -> int:
        """Index of the control in force in the last step; `NO_CONTROL` before the first one."""
        return self.control_of(self.steps - 1) if self.steps > 0 else NO_CONTROL

    @property
    def first_kept(self) -> int:
        """The first step of `smoothed`, and the first that may still be revised."""
        first = self._kept_steps.first
        return first if self.lag is None else max(first, self.steps - self.lag - 1)

    def step(self, observation: ArrayLike, control: int | str | None = None) -> TwinStep:
        """Advance by one step, correct by an observation, predict and decide.

        Parameters
        ----------
        observation : (G,) array
            The sensor values, SI; NaN where nothing was received. If all are NaN, the belief is
            predicted through the step.
        control : int or str, optional
            Index or name of the control in force during this step; the proposed one if left out.

        Raises
        ------
        ImpossibleObservation
            If the observation is impossible in every state that the belief allows; the twin is
            unchanged.
        InvalidObservationError, InvalidModelError
            If the observation has another shape, is infinite or cannot be weighed, the twin is
            unchanged; if there is no such control.
        """
        values = np.array(nan_where_masked(observation))
        index = self._proposed if control is None else self._index_of(control)
        return self._assimilate_from(self.steps, [(values, index)])

    def revise(
        self, step: int, observation: ArrayLike, control: int | str | None = None
    ) -> TwinStep:
        """Assimilate a late observation: filter again from its step to the last one.

        The result is that of a twin which had the observation in time, to the last bit, if the
        controls in force were the same.

        Parameters
        ----------
        step : int
            The step of the observation, not before `first_kept`.
        observation, control
            As in `step`; if left out, the control is the one that was assumed for that step.

        Returns
        -------
        TwinStep
            The estimate and the decision in the last step, with the notices of all steps that were
            filtered again: what a late observation reveals about an earlier step is reported too.

        Raises
        ------
        IndexError
            If the step is not kept any more, or is still to come.
        ImpossibleObservation, InvalidObservationError, InvalidModelError
            As in `step`; the twin is unchanged.
        """
        if not self.first_kept <= step < self.steps:
            raise IndexError(
                f"step {step} cannot be revised: the twin keeps the steps from {self.first_kept} "
                f"on and has seen {self.steps}"
            )
        index = self.control_of(step) if control is None else self._index_of(control)
        rows = [(np.array(nan_where_masked(observation)), index)]
        for later_step in range(step + 1, self.steps):
            rows.append((self.observed(later_step), self.control_of(later_step)))
        return self._assimilate_from(step, rows)

    def _assimilate_from(self, first_step: int, rows: Sequence[tuple[Float, int]]) -> TwinStep:
        """Filter the observations of consecutive steps, and decide on the next control.

        With a `Hold`, a harder control is taken only after it was proposed in several steps in a
        row; `proposals` counts them.

        Parameters
        ----------
        first_step : int
            The step of the first observation; it and later steps are replaced.
        rows : sequence of (G,) array and int
            The observation and the control in force of each step; at least one step.
        """
        previous_carried = None  # what the estimator carries from step to step
        proposals = 0
        if first_step > self._kept_steps.first:
            (step_before,) = self._kept_steps.complete_steps(first_step - 1, first_step)
            previous_carried = step_before.carried
            proposals = step_before.proposals
        new_steps: list[KeptStep] = []
        notices: list[Notice] = []
        for step, (observation, control_index) in enumerate(rows, start=first_step):
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    estimate = self.estimator.step(
                        previous_carried, observation, control_index, step
                    )
            except (ArithmeticError, np.linalg.LinAlgError):
                raise unbelievable_observation(self.name, step) from None
            previous_carried = estimate.carried
            checked_values = (
                estimate.log_evidence,
                estimate.filtered,
                *previous_carried.arrays.values(),
            )
            # the comparison is also False for NaN
            if not all(np.all(np.asarray(values) < LARGEST_CARRIED) for values in checked_values):
                raise unbelievable_observation(self.name, step)
            proposals_before = proposals
            if self.decision_rule.hold is not None:
                in_force = np.array([control_index])
                probability = self.decision_rule.probabilities(
                    estimate.filtered[None], in_force, np.array([estimate.unexplained])
                )
                _, _, (proposals,) = self.decision_rule.decide(
                    probability, in_force, np.array([proposals_before])
                )
            new_steps.append(KeptStep(observation, previous_carried, int(proposals)))
            notices += estimate.notices
        # From here on nothing fails, so that a refused observation leaves the twin unchanged.
        self._kept_steps.replace_from(first_step, new_steps)
        return self._decide(replace(estimate, notices=tuple(notices)), proposals_before)

    def observed(self, step: int) -> Float:
        """Return the observation (G,) of a kept step; NaN for a sensor without a reading."""
        return self._kept_steps[step].observation

    def control_of(self, step: int) -> int:
        """Return the index of the control in force in a kept step."""
        return self._kept_steps[step].carried.control_index

    def predict(self, belief: ArrayLike, control: int | str, steps: int | None = None) -> Predicted:
        """Predict through the policy from any belief (S,) under a control in force: (37)-(39)."""
        horizon = self.prediction_steps if steps is None else steps
        return predict(
            self.model,
            checked_beliefs(belief),
            self._index_of(control),
            self.decision_rule.policy,
            horizon,
        )

    def smoothed(self) -> Float:
        """Return p(D_k | o_0..o_t) for the steps k = `first_kept`..t: (n, S).

        Smoothing takes a time proportional to the number of kept steps. So it is not done in every
        step; the decision does not need it.
        """
        return self.estimator.smoothed(self.carried)

    @property
    def carried(self) -> tuple[Carried, ...]:
        """The arrays that smoothing needs of the steps `first_kept`..t; of the last step, all."""
        return tuple(self._kept_steps[step].carried for step in range(self.first_kept, self.steps))

    def save_state(self) -> bytes:
        """Return everything that the twin keeps, for `restore_state`."""
        kept_steps = self._kept_steps.complete_steps(self._kept_steps.first, self.steps)
        return self._state_of(self.steps, kept_steps)

    def settled(self) -> tuple[int, bytes] | None:
        """Return the last step that cannot be revised any more, and the state after it.

        All later steps follow from that state, which `restore_state` takes. The result is None if
        all steps can still be revised.
        """
        step = self.first_kept - 1
        if step < 0:
            return None
        return step, self._state_of(step + 1, self._kept_steps.complete_steps(step, step + 1))

    def _state_of(self, steps: int, kept_steps: Iterable[KeptStep]) -> bytes:
        """Return the state of a twin after `steps` steps, of which it keeps some, as bytes."""
        arrays: dict[str, AnyArray] = {"steps": np.array([steps, self._proposed])}
        for index, kept_step in enumerate(kept_steps):
            arrays[f"{index}/observation"] = kept_step.observation
            arrays[f"{index}/control"] = np.array(kept_step.carried.control_index)
            if self.decision_rule.hold is not None:
                arrays[f"{index}/proposals"] = np.array(kept_step.proposals)
            for name, value in kept_step.carried.arrays.items():
                arrays[f"{index}/carried/{name}"] = value
        return arrays_to_bytes(arrays)

    def restore_state(self, state: bytes) -> None:
        """Continue from the saved state of a twin of the same model, sensors and estimator.

        All later results equal those of the saved twin, to the last bit.

        Raises
        ------
        InvalidModelError
            If the bytes are not such a state.
        """
        causes = ReducedModelFileError, KeyError, ValueError, TypeError
        with InvalidModelError.instead_of(*causes, before="this is not a saved state of a twin: "):
            stored_arrays = arrays_from_bytes(state, "the state of the twin")
            arrays = {
                _FORMER_COUNT.sub("steps", name): value for name, value in stored_arrays.items()
            }
            steps, proposed = arrays["steps"].tolist()
            kept_steps: list[KeptStep] = []
            while f"{len(kept_steps)}/control" in arrays:
                index = len(kept_steps)
                prefix = f"{index}/carried/"
                carried_arrays = {
                    name.removeprefix(prefix): value
                    for name, value in arrays.items()
                    if name.startswith(prefix)
                }
                kept_steps.append(
                    KeptStep(
                        arrays[f"{index}/observation"],
                        Carried(int(arrays[f"{index}/control"]), carried_arrays),
                        int(arrays.get(f"{index}/proposals", 0)),
                    )
                )
        self._proposed = proposed
        self._kept_steps.restore(steps, kept_steps)

    def _index_of(self, control: int | str) -> int:
        """Return the index of a control that is given by index or name."""
        controls = self.model.controls
        if isinstance(control, str):
            if control not in controls:
                raise InvalidModelError(
                    f"no control is named {control!r}; there are {', '.join(controls)}"
                )
            return controls.index(control)
        return int(checked_controls(control, len(controls)))

    def _decide(self, estimate: Estimate, proposals_before: int) -> TwinStep:
        """Predict from the estimate of the last step, and decide on the next control.

        With the probability that no state explains the sensors, the safest control is taken.
        """
        rule = self.decision_rule
        prediction = predict(
            self.model,
            estimate.filtered,
            estimate.carried.control_index,
            rule.policy,
            self.prediction_steps,
        )
        if rule.safest is not None:
            prediction = prediction.mix_control(estimate.unexplained, rule.safest)

        # The next controls by the belief of the step, and by the belief under each hypothesis.
        believed_hypotheses = [
            hypothesis for hypothesis in estimate.hypotheses if hypothesis.belief is not None
        ]
        hypothesis_beliefs = [hypothesis.belief for hypothesis in believed_hypotheses]
        beliefs = np.array([estimate.filtered, *hypothesis_beliefs])
        unexplained = np.zeros(len(beliefs))
        unexplained[0] = estimate.unexplained
        control = np.full(len(beliefs), estimate.carried.control_index)
        probability, *hypothesis_policies = rule.probabilities(beliefs, control, unexplained)
        (decision_probability,), (next_control,), _ = rule.decide(
            probability[None], control[:1], np.array([proposals_before])
        )
        self._proposed = int(next_control)

        # The hypothesis that decided adds most to the probability of the proposed control.
        suspicion = estimate.suspicion
        if suspicion is not None and estimate.hypotheses:
            names = [hypothesis.name for hypothesis in believed_hypotheses]
            policy_by_name = dict(zip(names, hypothesis_policies, strict=True))
            contribution = {}
            for hypothesis in estimate.hypotheses:
                policy_under_hypothesis = policy_by_name.get(hypothesis.name, rule.safest)
                contribution[hypothesis.name] = 0.0
                if policy_under_hypothesis is not None:
                    proposed_probability = float(policy_under_hypothesis[self._proposed])
                    contribution[hypothesis.name] = hypothesis.probability * proposed_probability
            decided_by = max(contribution, key=contribution.__getitem__)
            suspicion = replace(suspicion, decided_by=decided_by)
        return TwinStep(
            forecast=estimate.forecast,
            filtered=estimate.filtered,
            log_evidence=estimate.log_evidence,
            carried=estimate.carried,
            learnt=estimate.learnt,
            notices=estimate.notices,
            suspicion=suspicion,
            hypotheses=estimate.hypotheses,
            step=self.steps - 1,
            prediction=prediction,
            decision_probability=decision_probability,
            next_control=self._proposed,
        )


def unbelievable_observation(twin: str, step: int) -> InvalidObservationError:
    """Return the error for an observation after which no belief can be computed."""
    return InvalidObservationError(
        f"twin {twin!r}, step {step}: the observation is so improbable after the earlier ones that "
        "no belief can be computed; check the sensors and the control in force"
    )
