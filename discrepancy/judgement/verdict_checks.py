"""Checks of a verdict against the trials, however it was reached.

A hypothesis that makes the error larger is not named. The verdict that nothing is missing is
rejected if the model is far off in held-out trials. A fit whose residuals are larger than the
signal is rejected, and is no evidence of anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.units import UNITS
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.verdict import UnfittedRecord, Verdict, VerdictKind
from reporting.words import listing

from .closed_share import NOMINAL_UNIT, closed_share_text, rms_by_channel
from .hypotheses import UNEXPLAINED_GAP, VerdictOutcome, effects_text
from .proof import errors_of_fit
from .remarks import KINDS_WITHOUT_GAP

VETO_NOISE_DEVIATIONS = 5.0
"""rms residual over the noise deviation above which a channel of a held-out trial is far off."""
VETO_PREDICTIVE_DEVIATIONS = 3.0
"""rms residual over the predictive deviation (noise and uncertainty of the fit together) that a
channel must also exceed to be far off, since the uncertainty of the fit is not a gap."""
MOST_MENTIONED = 3
"""Largest number of records (one channel in one trial each) that a sentence mentions."""
MISSING_IN_HELD_OUT = (
    "The model explains the trials that were fitted, but not those held out: something is missing "
    "that the fitted trials do not show."
)
"""The conclusion if only held-out trials show a gap."""
WHITE_SECOND_DIFFERENCES = 6.0
"""Variance of the second differences of white noise over its own: 1 + 4 + 1 by their weights."""


def check_against_trials(outcome: VerdictOutcome) -> VerdictOutcome:
    """Return the outcome if its verdict passes three checks; else a verdict of an unexplained gap.

    The checks are made in this order, and the first one that fails gives the reason:

    1. The fit of the verdict leaves residuals that are smaller than the signal in every fitted
       trial in motion.
    2. If the verdict has effects, the error of the trials is not larger with them than without.
    3. If the verdict is that nothing is missing, no held-out trial is far off the prediction of the
       model without effect.

    Parameters
    ----------
    outcome : VerdictOutcome
        The verdict, its search, and the fit that represents it.
    """
    verdict, search, fit = outcome
    no_effect = search.no_effect
    # check 1: residuals against the signal
    unfitted = unfitted_records(search.residuals(fit))
    if unfitted:
        return VerdictOutcome(_unfitted_verdict(verdict, unfitted), search, no_effect)
    # check 2: the error with and without the effects
    if fit.candidate.terms:
        errors = errors_of_fit(search, fit)
        if errors.has_grown:
            channels = search.problem.campaign.channels
            reason = _larger_error_sentence(verdict, closed_share_text(channels, errors))
            verdict = _verdict_without_name(verdict, UNEXPLAINED_GAP, reason)
            return VerdictOutcome(verdict, search, no_effect)
    # check 3: held-out trials
    residuals_without_effect = search.residuals(no_effect)
    far_records = (
        far_held_out_records(residuals_without_effect) if verdict.kind in KINDS_WITHOUT_GAP else []
    )
    if far_records:
        reason = _held_out_gap_sentence(residuals_without_effect, far_records)
        verdict = _verdict_without_name(verdict, MISSING_IN_HELD_OUT, reason)
        return VerdictOutcome(verdict, search, no_effect)
    return outcome


def _verdict_without_name(verdict: Verdict, sentence: str, reasons: str) -> Verdict:
    """Return the verdict of an unexplained gap instead of the given one, with new sentences."""
    return replace(
        verdict,
        kind=VerdictKind.UNEXPLAINED,
        sentence=sentence,
        reasons=reasons,
        effects=(),
        group=(),
        family="",
        resembles=(),
    )


# ---------------------------------------------------------------- an error that grew


def _larger_error_sentence(verdict: Verdict, clause: str) -> str:
    """Return the sentence on a hypothesis that would be named, but makes the error larger.

    `clause` is that of `closed_share_text` on how much the error grows.
    """
    effects = effects_text(verdict.effects) or "the best hypothesis"
    return (
        f"The most probable explanation in the catalogue is {effects}, but {clause}: no effect is "
        "named, and there is nothing to apply."
    )


# ---------------------------------------------------------------- held-out trials far off


@dataclass(frozen=True)
class FarRecord:
    """A channel of a trial whose readings are far off the prediction.

    Attributes
    ----------
    trial, channel : str
        The names of the trial and the channel.
    noise_deviations : float
        The rms residual over the noise deviation.
    """

    trial: str
    channel: str
    noise_deviations: float


def far_held_out_records(residuals: ResidualSet) -> list[FarRecord]:
    """Return the channels of held-out trials that are far off a prediction, the farthest first.

    Their rms residual is beyond `VETO_NOISE_DEVIATIONS` of the noise, and beyond
    `VETO_PREDICTIVE_DEVIATIONS` of what noise and the uncertainty of the fit make together. Without
    a noise record the noise is what the fit leaves in the fitted trials.
    """
    far_records = []
    for fitted_trial in residuals.trials:
        if not fitted_trial.trial.held_out:
            continue
        for column, channel in enumerate(fitted_trial.trial.channels):
            is_used = fitted_trial.used[:, column]
            if not is_used.any():
                continue
            mean_square = float(np.mean(fitted_trial.standardised[is_used, column] ** 2))
            expected_mean_square = float(np.mean(fitted_trial.expected_variance[is_used, column]))
            if mean_square > max(
                VETO_NOISE_DEVIATIONS**2, VETO_PREDICTIVE_DEVIATIONS**2 * expected_mean_square
            ):
                far_records.append(
                    FarRecord(fitted_trial.trial.name, channel, float(np.sqrt(mean_square)))
                )
    return sorted(far_records, key=lambda record: -record.noise_deviations)


def _held_out_gap_sentence(residuals: ResidualSet, far_records: Sequence[FarRecord]) -> str:
    """Return the sentence on a gap that only held-out trials show."""
    parts = []
    for record in far_records[:MOST_MENTIONED]:
        trials = [
            fitted_trial
            for fitted_trial in residuals.trials
            if fitted_trial.trial.name == record.trial
        ]
        rms = rms_by_channel(replace(residuals, trials=tuple(trials)))[record.channel]
        rms_text = _value_with_unit(residuals, record.channel, rms)
        noise_text = f"{record.noise_deviations:.1f} times the noise"
        parts.append(f"{record.channel} in {record.trial!r} by {rms_text} (rms, {noise_text})")
    unmentioned_count = len(far_records) - MOST_MENTIONED
    if unmentioned_count > 0:
        parts.append(f"{unmentioned_count} more records")
    return f"It misses {listing(parts)}. Fit trials like these, too."


def _value_with_unit(residuals: ResidualSet, channel: str, value: float) -> str:
    """Return a value of a channel (SI) in the unit of its figures."""
    factor, unit = UNITS[residuals.channels[channel].quantity].drawn
    text = f"{factor * value:.3g}"
    return text if unit == NOMINAL_UNIT else f"{text} {unit}"


# ---------------------------------------------------------------- a model that is not fitted


def unfitted_records(residuals: ResidualSet) -> tuple[UnfittedRecord, ...]:
    """Return the records in motion that the model does not fit, although their trials were fitted.

    The residuals of such a record are larger than the signal itself, whose size is the standard
    deviation of the readings about their mean. A channel may show nothing but noise, so the rms
    residual must also exceed `VETO_NOISE_DEVIATIONS` noise deviations.
    """
    unfitted = []
    for fitted_trial in residuals.trials:
        if fitted_trial.trial.held_out or not fitted_trial.trial.is_dynamic:
            continue
        for column, channel in enumerate(fitted_trial.trial.channels):
            is_used = fitted_trial.used[:, column]
            if not is_used.any():
                continue
            residual_rms = float(np.sqrt(np.mean(fitted_trial.residual[is_used, column] ** 2)))
            signal_deviation = float(np.std(fitted_trial.trial.values[is_used, column]))
            noise_deviation = _noise_deviation(residuals, fitted_trial, column)
            if residual_rms > max(signal_deviation, VETO_NOISE_DEVIATIONS * noise_deviation):
                record = UnfittedRecord(
                    fitted_trial.trial.name, channel, residual_rms, signal_deviation
                )
                unfitted.append(record)
    return tuple(unfitted)


def _noise_deviation(residuals: ResidualSet, fitted_trial: FittedTrial, column: int) -> float:
    """Return the noise deviation of a column of a trial [unit of the channel].

    It is the recorded one, or estimated from the second differences of the readings.
    """
    if residuals.degrees_of_freedom(fitted_trial.trial.channels[column]) > 0.0:
        return float(fitted_trial.noise_deviation[column])
    readings: FloatArray = fitted_trial.trial.values[fitted_trial.used[:, column], column]
    if len(readings) < 3:
        return float("inf")
    return float(np.sqrt(np.mean(np.diff(readings, 2) ** 2) / WHITE_SECOND_DIFFERENCES))


def _unfitted_verdict(verdict: Verdict, unfitted: Sequence[UnfittedRecord]) -> Verdict:
    """Return the verdict on a model that could not be fitted to the trials."""
    parts = [f"{record.channel} in {record.trial!r}" for record in unfitted[:MOST_MENTIONED]]
    unmentioned_count = len(unfitted) - MOST_MENTIONED
    if unmentioned_count > 0:
        parts.append(f"{unmentioned_count} more records")
    sentence = (
        f"The model does not fit: its residuals of {listing(parts)} are larger than the variation "
        "of the readings about their mean."
    )
    reasons = (
        "That is no evidence of a missing force. Check how the trials begin, inputs, signs and "
        "units, and try a shorter record."
    )
    return replace(_verdict_without_name(verdict, sentence, reasons), unfitted=tuple(unfitted))
