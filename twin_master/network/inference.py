"""Exact inference in the dynamic decision network: filter, smooth over the whole history, predict.

Pure functions on arrays, in the log domain: beliefs whose linear value underflows come back later when the
data call for it. No floor is added anywhere; what is impossible stays impossible.

The order of one step t: control u_t is in force, the state is D_t, the observation o_t is made under u_t.
Hence D_t follows D_{t-1} through u_{t-1}, and the first state follows the prior.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from twin_master.errors import ImpossibleObservation, InvalidModelError, InvalidObservationError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.kernels import backward_pass, forward_pass
from twin_master.network.transition import TransitionModel, expect_controls, expect_shape


@dataclass(frozen=True)
class Filtered:
    """Filtered beliefs; the leading axes are twins and steps, as far as there are several.

    Attributes
    ----------
    forecast : (..., S)
        p(D_t | o_0..o_{t-1}): the belief before the observation.
    filtered : (..., S)
        p(D_t | o_0..o_t).
    log_filtered : (..., S)
        Its logarithm; carry this to the next step.
    log_evidence : (...)
        log p(o_t | o_0..o_{t-1}); the sum is the log evidence of all observations.
    """

    forecast: Float
    filtered: Float
    log_filtered: Float
    log_evidence: Float

    def __getitem__(self, place: Any) -> "Filtered":
        """Return the beliefs at a place of the leading axes."""
        return Filtered(*(np.asarray(values)[place] for values in vars(self).values()))


@dataclass(frozen=True)
class Predicted:
    """Prediction of H steps through the policy.

    Attributes
    ----------
    predicted : (H, S)
        p(D_{t+h} | o_0..o_t), h = 1..H.
    joint : (H, S, U)
        p(D_{t+h}, U_{t+h} | o_0..o_t): quantities and rewards depend on both.
    """

    predicted: Float
    joint: Float

    @property
    def control_probability(self) -> Float:
        """p(U_{t+h} | o_0..o_t): (H, U)."""
        return np.asarray(self.joint.sum(axis=1))

    def mixed(self, share: float, control: Float) -> "Predicted":
        """Return it where with probability `share` the controls are p(U) (U,), whatever the state is."""
        chosen = self.predicted[..., None] * control
        return Predicted(self.predicted, (1.0 - share) * self.joint + share * chosen)


def _checked(
    model: GraphicalModel, control_index: ArrayLike, rows: ArrayLike, *, what: str
) -> tuple[Index, Float]:
    """Return controls (1, T), and rows of logarithms (1, T, S), as the compiled loops expect them."""
    control = np.array(control_index, dtype=np.int64, order="C")
    expect_shape("controls", control.shape, control.size)
    expect_controls(control, len(model.controls))
    rows = np.require(rows, np.float64, ["C", "W"])
    expect_shape(what, rows.shape, *control.shape, model.states.size)
    if not np.all(rows < np.inf):  # NaN fails this as well
        where = tuple(np.argwhere(~(rows < np.inf))[0].tolist())
        raise InvalidObservationError(f"{what} at {where} is {rows[where]}; expected a number or -inf")
    return control[None], rows[None]


def filter_many(
    transition: TransitionModel,
    control: Index,
    rows: Float,
    log_before: Float,
    control_before: ArrayLike = -1,
) -> tuple[Filtered, Index]:
    """Filter B twins without any check.

    Parameters
    ----------
    transition : TransitionModel
    control : (B, T)
    rows : (B, T, S)
        log p(o_t | D_t, u_t).
    log_before : (B, S) or (S,)
        Logarithm of the belief in the step before the first, or of the prior where there is none.
    control_before : int or (B,)
        Control in force in that step; -1 where there is none.

    Returns
    -------
    tuple of Filtered, (B,)
        The latter is -1, or the row whose observation is impossible; the rest of such a twin means nothing.
    """
    forecast, filtered, log_filtered = (np.empty_like(rows) for _ in range(3))
    log_evidence, failed = np.empty(rows.shape[:2]), np.empty(len(rows), dtype=np.int64)
    found = forecast, filtered, log_filtered, log_evidence
    first = np.full((len(rows), rows.shape[2]), log_before), np.full(len(rows), control_before)
    forward_pass(transition.forward_lists, control, *first, rows, *found, failed)
    return Filtered(*found), failed


def log_forecast(transition: TransitionModel, control: Index, log_filtered: Float) -> Float:
    """Return the logarithms of beliefs (B, S) one transition later, each under its control (B,)."""
    nothing = np.zeros_like(log_filtered)[:, None]
    found, _ = filter_many(transition, control[:, None], nothing, log_filtered, control)
    return np.asarray(found.log_filtered[:, 0] + found.log_evidence)


def smooth_many(transition: TransitionModel, control: Index, filtered: Float, log_filtered: Float) -> Float:
    """Smooth the filtered beliefs (B, T, S) of B twins under controls (B, T), without any check."""
    smoothed = np.empty_like(log_filtered)
    lists = transition.forward_lists, transition.backward_lists
    backward_pass(*lists, control, filtered, log_filtered, smoothed)
    return smoothed


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
    control_index : (T,)
        Control u_t in force in each step.
    log_likelihood : (T, S)
        log p(o_t | D_t, u_t), a row of zeros where nothing was observed.
    before : tuple of (S,) and int, optional
        `log_filtered` of the step before the first, and the control that was in force then; without it the
        first step starts from the prior.

    Raises
    ------
    ImpossibleObservation
        If an observation has probability zero wherever the belief has support.
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a log-likelihood is NaN or plus infinity.
    """
    control, rows = _checked(model, control_index, log_likelihood, what="log-likelihood")
    found, failed = filter_many(model.transition, control, rows, *(before or (model.log_prior,)))
    if failed[0] >= 0:
        raise ImpossibleObservation("twin", int(failed[0]))
    return found[0]


def smooth(model: GraphicalModel, control_index: ArrayLike, log_filtered: ArrayLike) -> Float:
    """Return p(D_t | o_0..o_{T-1}) of all steps (T, S), given the filtered beliefs.

    Parameters
    ----------
    model : GraphicalModel
    control_index : (T,)
        Control u_t in force in each step.
    log_filtered : (T, S)
        As `filter_sequence` gives them, at once or one by one.

    Raises
    ------
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a log belief is NaN or plus infinity.
    """
    control, rows = _checked(model, control_index, log_filtered, what="log belief")
    return np.asarray(smooth_many(model.transition, control, np.exp(rows), rows)[0])


def predict(
    model: GraphicalModel, belief: ArrayLike, control_index: int, policy: ArrayLike, horizon: int
) -> Predicted:
    """Predict through the policy: Kapteyn et al. 2021, eqs. (37)-(39).

    D_{t+1} follows the belief at t through the known control u_t; from then on U_{t+h} ~ policy(. | D_{t+h})
    and D_{t+h+1} ~ T[U_{t+h}](D_{t+h}, .). The control node is marginalised exactly. No observation enters,
    so the linear domain is exact to rounding.

    Parameters
    ----------
    model : GraphicalModel
    belief : (S,)
        p(D_t | o_0..o_t).
    control_index : int
        Control u_t in force at t.
    policy : (S, U)
        p(U | D), row-stochastic.
    horizon : int
        Number H of steps, not negative.

    Raises
    ------
    InvalidModelError
        If shapes do not fit.
    """
    belief = np.asarray(belief, dtype=np.float64)
    policy = np.asarray(policy, dtype=np.float64)
    expect_shape("a belief", belief.shape, model.states.size)
    if horizon < 0:
        raise InvalidModelError(f"expected a horizon of 0 or more steps, got {horizon}")
    predicted, transition = np.empty((horizon, len(belief))), model.transition
    now: Float = belief
    closed_loop = None if transition.is_product else np.einsum("su,usn->sn", policy, transition.matrix)
    for h in range(horizon):
        if h == 0:
            now = transition.forward(control_index, now)
        elif closed_loop is not None:
            now = now @ closed_loop
        else:
            flows = enumerate((now[:, None] * policy).T)
            now = np.sum([transition.forward(u, flow) for u, flow in flows], axis=0)
        predicted[h] = now
    return Predicted(predicted, predicted[:, :, None] * policy)


def known_control(belief: ArrayLike, control_index: ArrayLike, control_count: int) -> Float:
    """Return the joint (..., S, U) of a belief (..., S) and a control that is known (...)."""
    belief = np.asarray(belief, dtype=np.float64)
    chosen = np.eye(control_count)[np.asarray(control_index)]
    return np.asarray(belief[..., :, None] * chosen[..., None, :])
