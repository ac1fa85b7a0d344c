"""Exact inference in the dynamic decision network: filter, smooth over the whole history, predict.

`ExactFilter` is the estimator of a twin. The rest are pure functions of arrays, with logarithms of
beliefs: a probability that underflows is kept as a logarithm, and can grow again by later data. No
floor is added to probabilities, so that an impossible state stays impossible.

The order of one step t: control u_t is in force, the state is D_t, the observation o_t is made
under u_t. Hence D_t follows D_{t-1} through u_{t-1}, and the first state follows the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index, nan_where_masked
from twin_master.errors import ImpossibleObservation, InvalidModelError, InvalidObservationError
from twin_master.network.estimator import Carried, Estimate, SensorModel
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.kernels import backward_pass, forward_pass
from twin_master.network.transition import TransitionModel, check_shape, checked_controls

NO_CONTROL = -1
"""The control before the first step: the belief before it is the prior, without a transition."""


@dataclass(frozen=True)
class Filtered:
    """Filtered beliefs; the leading axes are twins and steps, if there are several.

    Attributes
    ----------
    forecast : (..., S) array
        p(D_t | o_0..o_{t-1}): the belief before the observation.
    filtered : (..., S) array
        p(D_t | o_0..o_t).
    log_filtered : (..., S) array
        The logarithm of the filtered belief, which the next step needs.
    log_evidence : (...) array
        log p(o_t | o_0..o_{t-1}); the sum over steps is the log evidence of all observations.
    """

    forecast: Float
    filtered: Float
    log_filtered: Float
    log_evidence: Float

    def __getitem__(self, index: int | slice | tuple[int | slice, ...]) -> Filtered:
        """Return the beliefs at an index of the leading axes."""
        return Filtered(
            forecast=np.asarray(self.forecast[index]),
            filtered=np.asarray(self.filtered[index]),
            log_filtered=np.asarray(self.log_filtered[index]),
            log_evidence=np.asarray(self.log_evidence[index]),
        )


@dataclass(frozen=True)
class Predicted:
    """Prediction of H steps through the policy.

    Attributes
    ----------
    predicted : (H, S) array
        p(D_{t+h} | o_0..o_t), h = 1..H.
    joint : (H, S, U) array
        p(D_{t+h}, U_{t+h} | o_0..o_t), on which sensor values and rewards depend.
    """

    predicted: Float
    joint: Float

    @property
    def control_probability(self) -> Float:
        """p(U_{t+h} | o_0..o_t): (H, U)."""
        return np.asarray(self.joint.sum(axis=1))

    def mix_control(self, weight: float, control: Float) -> Predicted:
        """Return the prediction with another distribution of the controls mixed in.

        Parameters
        ----------
        weight : float
            The probability that the controls follow the other distribution.
        control : (U,) array
            That distribution, which does not depend on the state.
        """
        joint_of_control = self.predicted[..., None] * control
        return Predicted(self.predicted, (1.0 - weight) * self.joint + weight * joint_of_control)


def checked_sequence(
    model: GraphicalModel, control_index: ArrayLike, log_rows: ArrayLike, *, what: str
) -> tuple[Index, Float]:
    """Check controls and logarithms of a sequence; return them as the compiled loops expect them.

    Parameters
    ----------
    model : GraphicalModel
        S states and U controls.
    control_index : (T,) array
        The control in force in each step.
    log_rows : (T, S) array
        A logarithm for each step and state.
    what : str
        The noun of the rows, for the message.

    Returns
    -------
    control : (1, T) array
    rows : (1, T, S) array

    Raises
    ------
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a logarithm is NaN or plus infinity.
    """
    control = checked_controls(control_index, len(model.controls))
    check_shape("controls", control.shape, control.size)
    rows = np.require(nan_where_masked(log_rows), np.float64, ["C", "W"])
    check_shape(what, rows.shape, *control.shape, model.states.size)
    is_valid = rows < np.inf  # false for NaN as well
    if not np.all(is_valid):
        position = tuple(np.argwhere(~is_valid)[0].tolist())
        raise InvalidObservationError(
            f"{what} at {position} is {rows[position]}; expected a number or -inf"
        )
    return control[None], rows[None]


def filter_many(
    transition: TransitionModel,
    control: Index,
    log_likelihood: Float,
    log_before: Float,
    control_before: ArrayLike = NO_CONTROL,
) -> tuple[Filtered, Index]:
    """Filter the observations of B twins over T steps; the arguments are not checked.

    Parameters
    ----------
    transition : TransitionModel
        Transitions between S states.
    control : (B, T) array
        The control in force in each step.
    log_likelihood : (B, T, S) array
        log p(o_t | D_t, u_t).
    log_before : (B, S) or (S,) array
        The log belief in the step before the first one; or the log prior if there is none.
    control_before : int or (B,) array
        The control in force in that step; -1 if there is none.

    Returns
    -------
    result : Filtered
        The beliefs, with axes (B, T, S), and the log evidence (B, T).
    failed : (B,) array
        The first step whose observation is impossible, or -1. Later beliefs of such a twin are not
        defined.
    """
    twins, steps, state_count = log_likelihood.shape
    result = Filtered(
        forecast=np.empty_like(log_likelihood),
        filtered=np.empty_like(log_likelihood),
        log_filtered=np.empty_like(log_likelihood),
        log_evidence=np.empty((twins, steps)),
    )
    failed = np.empty(twins, dtype=np.int64)
    forward_pass(
        transition.forward_lists,
        control,
        np.full((twins, state_count), log_before),
        np.full(twins, control_before),
        log_likelihood,
        result.forecast,
        result.filtered,
        result.log_filtered,
        result.log_evidence,
        failed,
    )
    return result, failed


def log_forecast(transition: TransitionModel, control: Index, log_filtered: Float) -> Float:
    """Return the log beliefs (B, S) of B twins after a transition, each under its control.

    A belief need not sum to one; its sum is kept.
    """
    no_information = np.zeros_like(log_filtered)[:, None]
    beliefs, _ = filter_many(transition, control[:, None], no_information, log_filtered, control)
    # The filter normalises each belief. Without information, the evidence is the sum of the belief
    # before that: adding its logarithm restores the sum.
    log_filtered_of_step = beliefs.log_filtered.squeeze(axis=1)
    return np.asarray(log_filtered_of_step + beliefs.log_evidence)


def smooth_many(
    transition: TransitionModel,
    control: Index,
    filtered_beliefs: Float,
    log_filtered_beliefs: Float,
) -> Float:
    """Smooth the beliefs (B, T, S) of B twins under controls (B, T), without checks."""
    smoothed_beliefs = np.empty_like(log_filtered_beliefs)
    backward_pass(
        transition.forward_lists,
        transition.backward_lists,
        control,
        filtered_beliefs,
        log_filtered_beliefs,
        smoothed_beliefs,
    )
    return smoothed_beliefs


def filter_sequence(
    model: GraphicalModel,
    control_index: ArrayLike,
    log_likelihood: ArrayLike,
    before: tuple[Float, int] | None = None,
) -> Filtered:
    """Filter a whole sequence, or a part of one: Kapteyn et al. 2021, eqs. (2), (28)-(31).

    Parameters
    ----------
    model : GraphicalModel
        States, controls, prior and transitions.
    control_index : (T,) array
        The control u_t in force in each step.
    log_likelihood : (T, S) array
        log p(o_t | D_t, u_t); a row of zeros if nothing was observed.
    before : tuple of (S,) array and int, optional
        `log_filtered` of the step before the first one, and the control that was in force then. If
        left out, the first step starts from the prior.

    Raises
    ------
    ImpossibleObservation
        If an observation has probability zero in every state that the belief allows.
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a log-likelihood is NaN or plus infinity.
    """
    control, rows = checked_sequence(model, control_index, log_likelihood, what="log-likelihood")
    log_before, control_before = before or (model.log_prior, NO_CONTROL)
    filtered_steps, failed = filter_many(
        model.transition, control, rows, log_before, control_before
    )
    if failed[0] >= 0:
        raise ImpossibleObservation("twin", int(failed[0]))
    return filtered_steps[0]


def smooth(model: GraphicalModel, control_index: ArrayLike, log_filtered: ArrayLike) -> Float:
    """Return p(D_t | o_0..o_{T-1}) of all steps (T, S), given the filtered beliefs.

    Parameters
    ----------
    model : GraphicalModel
        States, controls, prior and transitions.
    control_index : (T,) array
        The control u_t in force in each step.
    log_filtered : (T, S) array
        The filtered log beliefs, from one call of `filter_sequence` or from one call for each step.

    Raises
    ------
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a log belief is NaN or plus infinity.
    """
    control, rows = checked_sequence(model, control_index, log_filtered, what="log belief")
    return np.asarray(smooth_many(model.transition, control, np.exp(rows), rows)[0])


def predict(
    model: GraphicalModel, belief: ArrayLike, control_index: int, policy: ArrayLike, horizon: int
) -> Predicted:
    """Predict beliefs and controls H steps ahead under a policy: Kapteyn et al. 2021, (37)-(39).

    D_{t+1} follows the belief at t through the known control u_t. From then on U_{t+h} follows
    policy(. | D_{t+h}), and D_{t+h+1} follows T[U_{t+h}](D_{t+h}, .). The control is marginalised
    exactly. No observation enters, so probabilities are exact to rounding without logarithms.

    Parameters
    ----------
    model : GraphicalModel
        States, controls and transitions.
    belief : (S,) array
        p(D_t | o_0..o_t).
    control_index : int
        The control u_t in force at t.
    policy : (S, U) array
        p(U | D), row-stochastic.
    horizon : int
        The number H of steps, not negative.

    Raises
    ------
    InvalidModelError
        If shapes do not fit, or there is no such control.
    """
    control_index = int(checked_controls(control_index, len(model.controls)))
    belief = nan_where_masked(belief)
    policy = nan_where_masked(policy)
    check_shape("a belief", belief.shape, model.states.size)
    if horizon < 0:
        raise InvalidModelError(f"the horizon must be 0 steps or more, but it is {horizon}")
    predicted_beliefs = np.empty((horizon, len(belief)))
    if horizon > 0:
        predicted_beliefs[0] = model.transition.forward(control_index, belief)
    if model.transition.is_product:
        # By blocks of the transition: the table (U, S, S) of all transitions may be too large.
        for h in range(1, horizon):
            joint = predicted_beliefs[h - 1][:, None] * policy
            next_by_control = [
                model.transition.forward(u, belief_with_control)
                for u, belief_with_control in enumerate(joint.T)
            ]
            predicted_beliefs[h] = np.sum(next_by_control, axis=0)
    else:
        closed_loop = np.einsum("su,usn->sn", policy, model.transition.matrix)
        for h in range(1, horizon):
            predicted_beliefs[h] = predicted_beliefs[h - 1] @ closed_loop
    return Predicted(predicted_beliefs, predicted_beliefs[:, :, None] * policy)


def known_control(belief: ArrayLike, control_index: ArrayLike, control_count: int) -> Float:
    """Return the joint beliefs over states and controls (..., S, U) when the controls are known.

    Parameters
    ----------
    belief : (..., S) array
        The beliefs about the state.
    control_index : (...) array
        The index of the control for each belief.
    control_count : int
        The number U of controls.
    """
    is_control = np.eye(control_count)[checked_controls(control_index, control_count)]
    return nan_where_masked(belief)[..., :, None] * is_control[..., None, :]


class ExactFilter:
    """The exact filter and smoother: Kapteyn et al. 2021, eqs. (2), (28)-(31).

    It carries the logarithm of the filtered belief, `log_filtered` (S,).

    Parameters
    ----------
    model : GraphicalModel
        States, controls, prior and transitions.
    sensor_model : SensorModel
        The probability of observations in each state.
    name : str
        The name of the twin, for messages.
    """

    def __init__(
        self, model: GraphicalModel, sensor_model: SensorModel, name: str = "twin"
    ) -> None:
        self.model = model
        self._sensor_model = sensor_model
        self._name = name

    def step(
        self, before: Carried | None, observation: Float, control_index: int, step: int
    ) -> Estimate:
        """Advance the belief to step t and correct it by an observation, see `Estimator.step`."""
        log_belief = self.model.log_prior
        previous_control = NO_CONTROL
        if before is not None:
            log_belief = before.arrays["log_filtered"]
            previous_control = before.control_index
        beliefs, errors = self.step_of_twins(
            log_belief, previous_control, np.asarray(observation)[None], [control_index], step
        )
        for error in errors.values():
            raise error
        belief = beliefs[0]
        return Estimate(
            forecast=belief.forecast,
            filtered=belief.filtered,
            log_evidence=float(belief.log_evidence),
            carried=Carried(control_index, {"log_filtered": belief.log_filtered}),
        )

    def step_of_twins(
        self,
        log_before: Float,
        control_before: ArrayLike,
        observations: Float,
        control_index: ArrayLike,
        step: int,
    ) -> tuple[Filtered, dict[int, ImpossibleObservation]]:
        """Advance the beliefs of B twins to step t, and correct each by its observation.

        The belief of a twin does not depend on the other twins, not even in the last bit.

        Parameters
        ----------
        log_before : (B, S) or (S,) array
            The log beliefs in step t - 1; the log prior if this is the first step.
        control_before : int or (B,) array
            The controls in force in step t - 1; `NO_CONTROL` if this is the first step.
        observations : (B, G) array
            The sensor values, SI; NaN where a sensor is lost.
        control_index : (B,) array
            The controls in force in step t.
        step : int
            The number t of the step, for messages.

        Returns
        -------
        beliefs : Filtered
            The beliefs, with the leading axis B.
        errors : dict of int to ImpossibleObservation
            The error of each twin whose observation is impossible, by its number. Such a twin has
            the prior as its belief.

        Raises
        ------
        InvalidObservationError, InvalidModelError
            If an observation has another shape, is infinite or cannot be weighed, or if there is no
            such control.
        """
        # A sensor model of a user may take only one observation at a time.
        sequence_likelihood = getattr(self._sensor_model, "log_likelihood_sequence", None)
        if sequence_likelihood is not None:
            likelihoods = sequence_likelihood(observations, control_index)
        else:
            pairs = zip(observations, np.asarray(control_index).tolist(), strict=True)
            likelihoods = [self._sensor_model.log_likelihood(row, u) for row, u in pairs]
        (controls,), (log_likelihood,) = checked_sequence(
            self.model, control_index, likelihoods, what="log-likelihood"
        )
        # The filter takes sequences of steps; each twin has a sequence of one.
        sequences, failed_step = filter_many(
            self.model.transition,
            controls[:, None],
            log_likelihood[:, None],
            log_before,
            control_before,
        )
        beliefs = sequences[:, 0]
        errors = {}
        for twin in np.flatnonzero(failed_step >= 0).tolist():
            worst_residuals = getattr(self._sensor_model, "worst_residuals", None)
            residuals = None
            if worst_residuals is not None:
                residuals = worst_residuals(observations[twin], int(controls[twin]))
            errors[twin] = ImpossibleObservation(self._name, step, residuals)
            beliefs.filtered[twin] = self.model.prior
            beliefs.log_filtered[twin] = self.model.log_prior
        return beliefs, errors

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for n consecutive steps k, up to t; see `Estimator.smoothed`."""
        controls = [step.control_index for step in carried]
        log_filtered = np.array([step.arrays["log_filtered"] for step in carried])
        # The shape is given because there may be no steps.
        return smooth(self.model, controls, log_filtered.reshape(-1, self.model.states.size))
