"""One turn of many twins of a model: what each would conclude alone, to the last bit."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import filter_many
from twin_master.network.planner import BeliefPolicy, PlannedPolicy

__all__ = ["decide_many", "filter_step_many", "rationed"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]


def filter_step_many(
    model: GraphicalModel,
    previous_log_filtered: Float | None,
    previous_control: Index | None,
    log_likelihood: Float,
) -> tuple[Float, Float, Float, NDArray[np.bool_]]:
    """Assimilate one observation of each of B twins, as `filter_step` does for one.

    Parameters
    ----------
    model : GraphicalModel
    previous_log_filtered : (B, S) or None
        `log_filtered` of the step before; None at the first step.
    previous_control : (B,) or None
        Control in force in the step before; None at the first step.
    log_likelihood : (B, S)
        log p(o_t | D_t, u_t).

    Returns
    -------
    filtered, log_filtered : (B, S)
    log_evidence : (B,)
    impossible : (B,)
        Whether the observation has probability zero wherever the belief has support; the rest of such a row
        means nothing.
    """
    before: tuple[Any, ...] = (model.log_prior,)
    if previous_control is not None and previous_log_filtered is not None:
        before = previous_log_filtered, previous_control
    control = np.zeros((len(log_likelihood), 1), dtype=np.int64)
    found, failed = filter_many(model, control, log_likelihood[:, None], *before)
    step = found[:, 0]
    return step.filtered, step.log_filtered, step.log_evidence, failed >= 0


def decide_many(
    model: GraphicalModel, filtered: Float, control: Index, plan: PlannedPolicy, on: str
) -> Index:
    """Return the next control of each of B twins (B,): the mode of the policy over its belief (B, S).

    Parameters
    ----------
    model : GraphicalModel
    filtered : (B, S)
        p(D_t | o_0..o_t).
    control : (B,)
        Control in force in turn t.
    plan : PlannedPolicy
    on : {"filtered", "predicted"}
        Which belief is decided on, see `Twin`.
    """
    belief = filtered
    if on == "predicted" or plan.on_belief is not None:
        pairs = zip(control.tolist(), filtered, strict=True)
        belief = np.stack([model.transition.forward(in_force, row) for in_force, row in pairs])
    if plan.on_belief is not None:
        return np.array([plan.on_belief.decide(row) for row in belief], dtype=np.int64)
    # One product for each twin, so that its last bit does not depend on how many there are.
    chosen: Index = np.argmax(np.matmul(belief[:, None, :], plan.policy)[:, 0], axis=1)
    return chosen


def rationed(
    model: GraphicalModel, filtered: Float, before: Index, chosen: Index, policy: BeliefPolicy,
    scarce: Sequence[int], budget: int,
) -> Index:  # fmt: skip
    """Return the next controls (B,) of which so many at most are scarce: those that are worth most.

    A scarce control is worth what its return is above that of the best other one, which is taken where the
    budget is spent.

    Parameters
    ----------
    model, filtered
        As of `decide_many`.
    before, chosen : (B,)
        Controls in force, and those that were decided.
    policy : BeliefPolicy
    scarce : sequence of int
        Controls of which there are few, such as inspections.
    budget : int
        How many.
    """
    wanting = np.flatnonzero(np.isin(chosen, scarce))
    if len(wanting) <= budget:
        return chosen
    ahead = np.array([model.transition.forward(int(before[twin]), filtered[twin]) for twin in wanting])
    value = policy.action_value(ahead, len(model.controls))
    others = value.copy()
    others[:, scarce] = -np.inf
    gain = value[:, scarce].max(axis=1) - others.max(axis=1)
    late = np.argsort(-gain, kind="stable")[budget:]
    result = chosen.copy()
    result[wanting[late]] = np.argmax(others[late], axis=1)
    return result
