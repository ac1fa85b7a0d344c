"""Exact inference in the dynamic decision network: filter, smooth over the whole history, predict.

Pure functions on arrays, in the log domain: beliefs whose linear value underflows come back later when the
data call for it. No floor is added anywhere; what is impossible stays impossible.

The order of one turn t: control u_t is in force, the state is D_t, the observation o_t is made under u_t.
Hence D_t follows D_{t-1} through u_{t-1}, and the first state follows the prior.
"""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin_master.errors import ImpossibleObservation, InvalidModelError, InvalidObservationError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.kernels import backward_pass, forward_pass, smooth_many
from twin_master.network.product_kernels import product_backward_pass, product_forward_pass

__all__ = [
    "FilterStep",
    "Filtered",
    "ObservationContext",
    "Predicted",
    "Smoothed",
    "filter_sequence",
    "filter_step",
    "known_control",
    "predict",
    "smooth",
    "smooth_many_twins",
]

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class ObservationContext:
    """Who observes, for the message of `ImpossibleObservation`.

    Attributes
    ----------
    twin : str
        Name of the twin.
    first_step : int
        Step of the first row of the log-likelihoods.
    worst_residuals : callable or None
        Gives, for a step, the names of the worst sensors with their standardised residuals.
    """

    twin: str = "twin"
    first_step: int = 0
    worst_residuals: Callable[[int], Mapping[str, float]] | None = None

    def impossible(self, row: int) -> ImpossibleObservation:
        """Return the exception for the observation in row `row` of the log-likelihoods."""
        step = self.first_step + row
        return ImpossibleObservation(
            self.twin, step, self.worst_residuals(step) if self.worst_residuals else None
        )


@dataclass(frozen=True)
class FilterStep:
    """One filtered step.

    Attributes
    ----------
    forecast : (S,)
        p(D_t | o_0..o_{t-1}): the belief before the observation.
    filtered : (S,)
        p(D_t | o_0..o_t).
    log_filtered : (S,)
        Its logarithm; carry this to the next step.
    log_evidence : float
        log p(o_t | o_0..o_{t-1}).
    """

    forecast: Float
    filtered: Float
    log_filtered: Float
    log_evidence: float


@dataclass(frozen=True)
class Filtered:
    """Filtered beliefs of T steps.

    Attributes
    ----------
    forecast : (T, S)
        p(D_t | o_0..o_{t-1}).
    filtered : (T, S)
        p(D_t | o_0..o_t).
    log_filtered : (T, S)
        Its logarithm.
    log_evidence : (T,)
        log p(o_t | o_0..o_{t-1}); the sum is the log evidence of all observations.
    """

    forecast: Float
    filtered: Float
    log_filtered: Float
    log_evidence: Float


@dataclass(frozen=True)
class Smoothed:
    """Smoothed beliefs of T steps (or of many twins, with a leading axis).

    Attributes
    ----------
    smoothed : (..., T, S)
        p(D_t | o_0..o_{T-1}).
    """

    smoothed: Float


@dataclass(frozen=True)
class Predicted:
    """Prediction of H steps through the policy.

    Attributes
    ----------
    predicted : (H, S)
        p(D_{t+h} | o_0..o_t), h = 1..H.
    control_probability : (H, U)
        p(U_{t+h} | o_0..o_t).
    joint : (H, S, U)
        p(D_{t+h}, U_{t+h} | o_0..o_t): quantities and rewards depend on both.
    """

    predicted: Float
    control_probability: Float
    joint: Float

    def mixed(self, share: float, control: Float) -> "Predicted":
        """Return it where with probability `share` the controls are p(U) (U,), whatever the state is."""
        chosen = (1.0 - share) * self.control_probability + share * control
        joint = (1.0 - share) * self.joint + share * self.predicted[..., None] * control
        return Predicted(self.predicted, chosen, joint)


def _checked_controls(model: GraphicalModel, control_index: ArrayLike) -> Index:
    """Return the controls as the compiled loops expect them."""
    control = np.array(control_index, dtype=np.int64, order="C")
    if control.size and (control.min() < 0 or control.max() >= len(model.controls)):
        found = f"{control.min()} to {control.max()}"
        raise InvalidModelError(f"expected indices between 0 and {len(model.controls) - 1}, got {found}")
    return control


def _checked_rows(model: GraphicalModel, control: Index, rows: ArrayLike, *, what: str) -> Float:
    """Return rows of logarithms, one for each control, as the compiled loops expect them."""
    rows = np.require(rows, np.float64, ["C", "W"])
    expected = (*control.shape, model.states.size)
    if rows.shape != expected:
        raise InvalidModelError(f"{what}: expected shape {expected} (turns, states), got {rows.shape}")
    if not np.all(rows < np.inf):  # NaN fails this as well
        where = tuple(np.argwhere(~(rows < np.inf))[0].tolist())
        raise InvalidObservationError(f"{what} at {where} is {rows[where]}; expected a number or -inf")
    return rows


def _forward(
    model: GraphicalModel,
    control: Index,
    log_likelihood: Float,
    first: int,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
) -> int:
    """Fill the rows from `first` on; return -1, or the row whose observation is impossible."""
    if model.transition.is_product:
        levels, row, begin, source, probability, power = model.transition.forward_lists.arrays
        return product_forward_pass(
            model.log_prior, levels, row, begin, source, probability, power,
            control, log_likelihood, first, forecast, filtered, log_filtered, log_evidence,
        )  # fmt: skip
    sparse = model.transition.sparse
    return forward_pass(
        model.log_prior, sparse.start, sparse.source, sparse.probability, sparse.log_probability,
        control, log_likelihood, first, forecast, filtered, log_filtered, log_evidence,
    )  # fmt: skip


def _backward(
    model: GraphicalModel, control: Index, filtered: Float, log_filtered: Float, smoothed: Float
) -> None:
    """Fill the smoothed rows."""
    transition = model.transition
    if transition.is_product:
        lists = (*transition.forward_lists.arrays, *transition.backward_lists.arrays[1:])
        product_backward_pass(*lists, control, filtered, log_filtered, smoothed)
        return
    sparse = transition.sparse
    backward_pass(
        sparse.start, sparse.source, sparse.probability, sparse.log_probability,
        control, filtered, log_filtered, smoothed,
    )  # fmt: skip


def filter_step(
    model: GraphicalModel,
    previous_log_filtered: ArrayLike | None,
    previous_control_index: int | None,
    log_likelihood: ArrayLike,
    context: ObservationContext | None = None,
) -> FilterStep:
    """Assimilate one observation: Kapteyn et al. 2021, eqs. (2), (28)-(31).

    Parameters
    ----------
    model : GraphicalModel
    previous_log_filtered : (S,) or None
        `log_filtered` of the step before; None at the first step, which starts from the prior.
    previous_control_index : int or None
        Control u_{t-1} that was in force in the step before; None at the first step.
    log_likelihood : (S,)
        log p(o_t | D_t, u_t), zeros when nothing was observed.
    context : ObservationContext, optional
        Names the twin if the observation is impossible; its `first_step` is this step.

    Raises
    ------
    ImpossibleObservation
        If the observation has probability zero wherever the belief has support.
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a log-likelihood is NaN or plus infinity.
    """
    if (previous_log_filtered is None) != (previous_control_index is None):
        raise InvalidModelError(
            "the previous belief and the previous control go together: give both or neither"
        )
    first = 0 if previous_control_index is None else 1
    control = _checked_controls(model, [previous_control_index or 0] * (first + 1))
    rows = np.zeros((first + 1, model.states.size))
    rows[first] = _checked_rows(model, control[0], log_likelihood, what="log-likelihood")
    log_filtered, filtered, forecast = np.empty_like(rows), np.empty_like(rows), np.empty_like(rows)
    log_evidence = np.empty(first + 1)
    if previous_log_filtered is not None:
        log_filtered[0] = _checked_rows(model, control[0], previous_log_filtered, what="previous log belief")
        np.exp(log_filtered[0], out=filtered[0])
    failed = _forward(model, control, rows, first, forecast, filtered, log_filtered, log_evidence)
    if failed >= 0:
        raise (context or ObservationContext()).impossible(0)
    return FilterStep(forecast[first], filtered[first], log_filtered[first], float(log_evidence[first]))


def filter_sequence(
    model: GraphicalModel,
    control_index: ArrayLike,
    log_likelihood: ArrayLike,
    context: ObservationContext | None = None,
) -> Filtered:
    """Filter a whole sequence: Kapteyn et al. 2021, eqs. (2), (28)-(31).

    Parameters
    ----------
    model : GraphicalModel
    control_index : (T,)
        Control u_t in force in each step.
    log_likelihood : (T, S)
        log p(o_t | D_t, u_t), a row of zeros where nothing was observed.
    context : ObservationContext, optional
        Names twin and steps if an observation is impossible.

    Raises
    ------
    ImpossibleObservation, InvalidModelError, InvalidObservationError
        As `filter_step`.
    """
    control = _checked_controls(model, control_index)
    if control.ndim != 1:
        raise InvalidModelError(f"expected one control for each step, got an array of shape {control.shape}")
    rows = _checked_rows(model, control, log_likelihood, what="log-likelihood")
    log_filtered, filtered, forecast = np.empty_like(rows), np.empty_like(rows), np.empty_like(rows)
    log_evidence = np.empty(len(rows))
    failed = _forward(model, control, rows, 0, forecast, filtered, log_filtered, log_evidence)
    if failed >= 0:
        raise (context or ObservationContext()).impossible(failed)
    return Filtered(forecast, filtered, log_filtered, log_evidence)


def smooth(model: GraphicalModel, control_index: ArrayLike, log_filtered: ArrayLike) -> Smoothed:
    """Smooth over the whole history, given the filtered beliefs.

    Parameters
    ----------
    model : GraphicalModel
    control_index : (T,)
        Control u_t in force in each step.
    log_filtered : (T, S)
        As `filter_sequence`, or as the rows that `filter_step` gave one by one.

    Raises
    ------
    InvalidModelError, InvalidObservationError
        If shapes do not fit, or a log belief is NaN or plus infinity.
    """
    control = _checked_controls(model, control_index)
    if control.ndim != 1:
        raise InvalidModelError(f"expected one control for each step, got an array of shape {control.shape}")
    rows = _checked_rows(model, control, log_filtered, what="log belief")
    smoothed = np.empty_like(rows)
    _backward(model, control, np.exp(rows), rows, smoothed)
    return Smoothed(smoothed)


def smooth_many_twins(
    model: GraphicalModel,
    control_index: ArrayLike,
    log_likelihood: ArrayLike,
    context: Callable[[int], ObservationContext] | None = None,
    workers: int | None = None,
) -> tuple[Filtered, Smoothed]:
    """Filter and smooth many independent twins of the same model.

    Parameters
    ----------
    model : GraphicalModel
    control_index : (B, T)
    log_likelihood : (B, T, S)
    context : callable, optional
        Gives the context of twin number b if one of its observations is impossible.
    workers : int, optional
        Number of threads; by default the processors of the machine.

    Returns
    -------
    tuple of Filtered, Smoothed
        With a leading axis B.

    Raises
    ------
    ImpossibleObservation, InvalidModelError, InvalidObservationError
        As `filter_step`; the first twin that fails is named.
    """
    control = _checked_controls(model, control_index)
    if control.ndim != 2:
        raise InvalidModelError(f"expected controls of shape (twins, steps), got {control.shape}")
    rows = _checked_rows(model, control, log_likelihood, what="log-likelihood")
    forecast, filtered, log_filtered, smoothed = (np.empty_like(rows) for _ in range(4))
    log_evidence = np.empty(rows.shape[:2])
    failed = np.empty(len(rows), dtype=np.int64)

    def run(part: slice) -> None:
        if not model.transition.is_product:
            sparse = model.transition.sparse
            smooth_many(
                model.log_prior, sparse.start, sparse.source, sparse.probability, sparse.log_probability,
                control[part], rows[part], forecast[part], filtered[part], log_filtered[part],
                log_evidence[part], smoothed[part], failed[part],
            )  # fmt: skip
            return
        for twin in range(len(rows))[part]:
            failed[twin] = _forward(
                model, control[twin], rows[twin], 0,
                forecast[twin], filtered[twin], log_filtered[twin], log_evidence[twin],
            )  # fmt: skip
            if failed[twin] < 0:
                _backward(model, control[twin], filtered[twin], log_filtered[twin], smoothed[twin])

    count = max(1, min(workers or os.cpu_count() or 1, len(rows)))
    edges = [len(rows) * i // count for i in range(count + 1)]
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(run, map(slice, edges[:-1], edges[1:])))
    if np.any(failed >= 0):
        twin = int(np.argmax(failed >= 0))
        found = context(twin) if context else ObservationContext(twin=f"twin {twin}")
        raise found.impossible(int(failed[twin]))
    return Filtered(forecast, filtered, log_filtered, log_evidence), Smoothed(smoothed)


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
    size, controls = model.states.size, len(model.controls)
    belief = np.asarray(belief, dtype=np.float64)
    policy = np.asarray(policy, dtype=np.float64)
    if belief.shape != (size,) or policy.shape != (size, controls):
        raise InvalidModelError(
            f"expected a belief of shape ({size},) and a policy of shape ({size}, {controls}), "
            f"got {belief.shape} and {policy.shape}"
        )
    if not 0 <= control_index < controls or horizon < 0:
        raise InvalidModelError(
            f"expected a control index between 0 and {controls - 1} and a horizon of 0 or more steps, "
            f"got {control_index} and {horizon}"
        )
    transition = model.transition
    predicted = np.empty((horizon, size))
    if transition.is_product:
        for h in range(horizon):
            if h == 0:
                predicted[h] = transition.forward(control_index, belief)
                continue
            flows = (transition.forward(u, predicted[h - 1] * policy[:, u]) for u in range(controls))
            predicted[h] = sum(flows, np.zeros(size))
    else:
        matrix = transition.matrix
        closed_loop = policy[:, 0, None] * matrix[0]
        for control in range(1, controls):
            closed_loop += policy[:, control, None] * matrix[control]
        step = matrix[control_index]
        for h in range(horizon):
            np.dot(belief, step, out=predicted[h])
            belief, step = predicted[h], closed_loop
    joint = predicted[:, :, None] * policy
    return Predicted(predicted=predicted, control_probability=joint.sum(axis=1), joint=joint)


def known_control(belief: ArrayLike, control_index: ArrayLike, control_count: int) -> Float:
    """Return the joint (..., S, U) of a belief (..., S) and a control that is known (...)."""
    belief = np.asarray(belief, dtype=np.float64)
    chosen = np.eye(control_count)[np.asarray(control_index)]
    result: Float = belief[..., :, None] * chosen[..., None, :]
    return result
