"""What trials say against a verdict, whatever it rests on.

A hypothesis with which the error grows is no name. Held-out trials far off veto that nothing is missing. A
fit that leaves more than the signal is no fit, and no evidence of anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.units import UNITS
from discrepancy.fits.predictive import residual_set
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.verdict import UnfittedRecord, Verdict, VerdictKind
from reporting.words import listing

from .closed_share import NOMINAL_UNIT, closed_text, rms_by_channel
from .conclusion import NO_GAP, Outcome, effects_text
from .proof import told_share

VETO_NOISES = 5.0
"""rms over the noise from which on a channel of a held-out trial vetoes that nothing is missing."""
VETO_DEVIATIONS = 3.0
"""The same over the deviation of the prediction: what the fitted trials leave open is no gap."""
RECORDS_TOLD = 3
"""Records that a sentence names."""
WHITE_SECOND_DIFFERENCES = 6.0
"""Variance of second differences of white noise over its own."""


def checked_verdict(outcome: Outcome) -> Outcome:
    """Return a verdict that the trials bear out: the same, or one that names nothing and says why.

    Parameters
    ----------
    outcome : Outcome
        A verdict, its search, and the fit that stands for it.
    """
    verdict, search, fit = outcome
    problem = search.problem
    before = residual_set(problem, search.none, sensitivities=False)
    after = before if fit is search.none else residual_set(problem, fit, sensitivities=False)
    unfitted = unfitted_records(after)
    if unfitted:
        return Outcome(_not_fitted(verdict, unfitted), search, search.none)
    if fit.candidate.terms:
        closed, _ = told_share(before, after)
        if closed is not None and closed.grew:
            sentence = _larger_error(verdict, closed_text(before, after, closed))
            return Outcome(_nothing_named(verdict, sentence), search, search.none)
    far_off = far_held_out_records(before) if verdict.kind in NO_GAP else []
    if far_off:
        return Outcome(_nothing_named(verdict, _gap_held_out(before, far_off)), search, search.none)
    return outcome


def _nothing_named(verdict: Verdict, sentence: str) -> Verdict:
    """Return an unexplained gap in the place of a verdict."""
    return replace(
        verdict,
        kind=VerdictKind.UNEXPLAINED,
        sentence=sentence,
        effects=(),
        group=(),
        family="",
        resembles=(),
    )


# ---------------------------------------------------------------- an error that grew


def _larger_error(verdict: Verdict, words: str) -> str:
    """Return the sentence on a hypothesis that would be named, but makes the error larger."""
    what = effects_text(verdict.effects) or "the best hypothesis"
    return (
        f"There is a gap without a name. The most probable explanation in the catalogue is {what}, but "
        f"{words}: nothing is named, and nothing to be applied."
    )


# ---------------------------------------------------------------- held-out trials far off


@dataclass(frozen=True)
class FarRecord:
    """A channel of a trial that is far off the prediction: rms residual over the noise."""

    trial: str
    channel: str
    noises: float


def far_held_out_records(residuals: ResidualSet) -> list[FarRecord]:
    """Return the channels of held-out trials that are far off a prediction, the farthest first.

    That is: rms beyond `VETO_NOISES` of the noise, and beyond `VETO_DEVIATIONS` of what noise and the
    uncertainty of the fit make together. Where no noise is recorded it is what the fit leaves in fitted
    trials.
    """
    found = []
    for item in residuals.trials:
        if not item.trial.held_out:
            continue
        for column, channel in enumerate(item.trial.channels):
            used = item.used[:, column]
            if not used.any():
                continue
            square = float(np.mean(item.standardised[used, column] ** 2))
            expected = float(np.mean(item.expected_variance[used, column]))
            if square > max(VETO_NOISES**2, VETO_DEVIATIONS**2 * expected):
                found.append(FarRecord(item.trial.name, channel, float(np.sqrt(square))))
    return sorted(found, key=lambda record: -record.noises)


def _gap_held_out(residuals: ResidualSet, far_off: Sequence[FarRecord]) -> str:
    """Return the sentence on a gap that only held-out trials show."""
    parts = []
    for record in far_off[:RECORDS_TOLD]:
        own = [item for item in residuals.trials if item.trial.name == record.trial]
        rms = rms_by_channel(replace(residuals, trials=tuple(own)))[record.channel]
        size = _with_unit(residuals, record.channel, rms)
        parts.append(
            f"{record.channel} in {record.trial!r} by {size} (rms, {record.noises:.1f} times the noise)"
        )
    more = len(far_off) - RECORDS_TOLD
    if more > 0:
        parts.append(f"{more} more records")
    return (
        "The model explains the trials that were fitted, but not those held out: it misses "
        f"{listing(parts)}. Something is missing that the fitted trials do not show: fit one like these too."
    )


def _with_unit(residuals: ResidualSet, channel: str, value: float) -> str:
    """Return a size of a channel in the unit in which it is drawn."""
    factor, unit = UNITS[residuals.channels[channel].quantity].drawn
    return f"{factor * value:.3g}" if unit == NOMINAL_UNIT else f"{factor * value:.3g} {unit}"


# ---------------------------------------------------------------- a fit that is none


def unfitted_records(residuals: ResidualSet) -> tuple[UnfittedRecord, ...]:
    """Return the records of fitted trials in motion of which more is left than the signal's own variance.

    The signal's variance is that about its mean. A channel in which nothing but noise is seen is fitted:
    what is left must be beyond `VETO_NOISES` of the noise, recorded or else of the quick part.
    """
    found = []
    for item in residuals.trials:
        if item.trial.held_out or not item.trial.is_dynamic:
            continue
        for column, channel in enumerate(item.trial.channels):
            used = item.used[:, column]
            if not used.any():
                continue
            left = float(np.sqrt(np.mean(item.residual[used, column] ** 2)))
            varies = float(np.std(item.trial.values[used, column]))
            if left > max(varies, VETO_NOISES * _noise(residuals, item, column)):
                found.append(UnfittedRecord(item.trial.name, channel, left, varies))
    return tuple(found)


def _noise(residuals: ResidualSet, item: FittedTrial, column: int) -> float:
    """Return the deviation of the noise of a record: as recorded, or of the quick part of its readings."""
    if residuals.degrees_of_freedom(item.trial.channels[column]) > 0.0:
        return float(item.noise_deviation[column])
    used: FloatArray = item.trial.values[item.used[:, column], column]
    if len(used) < 3:
        return float("inf")
    return float(np.sqrt(np.mean(np.diff(used, 2) ** 2) / WHITE_SECOND_DIFFERENCES))


def _not_fitted(verdict: Verdict, unfitted: Sequence[UnfittedRecord]) -> Verdict:
    """Return the verdict on a model that could not be fitted to the trials."""
    parts = []
    for record in unfitted[:RECORDS_TOLD]:
        parts.append(f"{record.channel} in {record.trial!r}")
    more = len(unfitted) - RECORDS_TOLD
    if more > 0:
        parts.append(f"{more} more records")
    sentence = (
        f"The model is not fitted: it leaves more of {listing(parts)} than the readings vary about their "
        "mean. That is no evidence of a missing force. Check how the trials begin, inputs, signs and units, "
        "and try a shorter record."
    )
    return replace(_nothing_named(verdict, sentence), unfitted=tuple(unfitted))
