"""Expected sensor values and rewards in the steps of a history, and the residuals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reporting.arrays import Float
from twin_master.learning.expectation import (
    Expectation,
    concatenate_expectations,
    expectation_of_draws,
)
from twin_master.mission.preparation import Knowledge
from twin_master.mission.replay import BelievedModel, spans_of_models
from twin_master.mission.steps import History
from twin_master.network.inference import known_control

Spans = Sequence[tuple[Knowledge, slice]]
"""The models that a twin believed, each with the slice of its steps; see `spans_of_models`."""


def expected_in_steps(
    history: History, spans: Spans, belief: Float, *, is_smoothed: bool
) -> Expectation:
    """Return the expected observations and rewards in the steps of a history, given a belief.

    The model is the one that was believed in the step. The sensor model is averaged over the draws
    of the calibrated parameter or, if the twin has learnt during the flight, over what it had
    learnt in each step (`carried`).

    Parameters
    ----------
    belief : (T, S) array
        The filtered or smoothed belief in each step.
    is_smoothed : bool
        Whether the belief is the smoothed one.
    """
    expectations = []
    for knowledge, span in spans:
        part = replace(history, steps=history.steps[span])
        learnt_expectation = knowledge.expectation
        if not part.steps:
            continue
        if learnt_expectation is None:
            joint = known_control(belief[span], part.control_index, len(knowledge.model.controls))
            expectation = expectation_of_draws(
                knowledge.sensor_model, knowledge.rewards, joint, part.observation_rows
            )
        else:
            expect = learnt_expectation.smoothed if is_smoothed else learnt_expectation.filtered
            carried = [step.twin_step.carried for step in part.steps]
            expectation = expect(carried, belief[span], part.observed)
        expectations.append(expectation)
    return concatenate_expectations(expectations)


def expected_ahead(
    history: History, spans: Spans, predicted_beliefs: Float
) -> tuple[Expectation, Float]:
    """Return the predicted observations and rewards in the H steps after each step of a history.

    The control of each predicted step follows the policy in its state (Kapteyn et al. 2021, eqs.
    (37) to (39)). If the twin has learnt during the flight, the predictions use what it had learnt
    up to each step.

    Parameters
    ----------
    predicted_beliefs : (T, H, S) array
        The belief about the state in each of the H steps after each step.

    Returns
    -------
    Expectation
        The observations and rewards; their leading axes are (T, H).
    (T, H, U) array
        The probability of each control.
    """
    expectations = []
    control_probabilities = []
    for knowledge, span in spans:
        part = replace(history, steps=history.steps[span])
        if not part.steps:
            continue
        # (T, S, U), with the safest control by the probability that no state explains the sensors
        policy = knowledge.policy_with_safest_control(part.unexplained)
        state_and_control = predicted_beliefs[span][..., None] * policy[:, None]  # (T, H, S, U)
        control_probabilities.append(state_and_control.sum(axis=-2))
        learnt_expectation = knowledge.expectation
        if learnt_expectation is None:
            expectation = expectation_of_draws(
                knowledge.sensor_model, knowledge.rewards, state_and_control, None
            )
        else:
            carried = [step.twin_step.carried for step in part.steps]
            horizon = predicted_beliefs.shape[1]
            expectation = learnt_expectation.predicted(carried, part.filtered, policy, horizon)
        expectations.append(expectation)
    return concatenate_expectations(expectations), np.concatenate(control_probabilities)


def residual_summary(
    history: History, from_step: int, models: Sequence[BelievedModel]
) -> dict[str, float | None]:
    """Return root mean square residual and log evidence of the steps from `from_step` on.

    The residuals are in standard deviations of the assumed or learnt noise. Both values are None if
    nothing was observed in these steps.

    Parameters
    ----------
    from_step : int
        The number of the first step that is evaluated.
    models : sequence of BelievedModel
        The models that the twin believed in the steps, in the order of adoption.
    """
    history = history.without_first(from_step - history.first_step)
    if not history.steps or np.isnan(history.observed).all():
        return {"rms_residual": None, "log_evidence": None}
    spans = spans_of_models(history, models)
    expectation = expected_in_steps(history, spans, history.filtered, is_smoothed=False)
    residual = (history.observed - expectation.mean) / expectation.noise_standard_deviation
    return {
        "rms_residual": float(np.sqrt(np.nanmean(residual**2))),
        "log_evidence": float(np.sum(history.log_evidence)),
    }
