"""The proof of a verdict: errors and scores on trials, before and after, as records."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan

from discrepancy.document import Number


@dataclass(frozen=True)
class Scores:
    """Scores on a set of trials: by a model without or with the effect."""

    rms: Mapping[str, Number]
    """Root mean square residual by channel [channel's unit]."""
    chi_square_per_sample: Number
    """Mean square residual over the variance of the noise, of channels with a noise record; nan
    without one [1]."""
    log_score: Number
    """Mean predictive log density of a sample, standardised by its noise; -1.419 for a right model
    with known parameters [nat]."""
    coverage_50: Number
    """Fraction of the samples within the central predictive intervals of 50 % [1]."""
    coverage_90: Number
    """Fraction of the samples within the central predictive intervals of 90 % [1]."""
    whiteness: Number
    """Least p-value of the Ljung-Box test over the channels of dynamic trials (Holm); nan without
    dynamic trials [1]."""
    sample_count: int = 0
    """Number of used samples."""
    chi_square_expected: Number = nan
    """Mean of `chi_square_per_sample` if the model is right. It allows for what the fit absorbs or
    leaves uncertain, and for the degrees of freedom of the noise records; nan without a noise
    record [1]."""
    chi_square_deviation: Number = nan
    """Standard deviation of `chi_square_per_sample` if the model is right; nan without a noise
    record [1]."""
    pit: tuple[Number, ...] = ()
    """Fractions of the probability integral transforms in ten equal bins; 0.1 each if predictions
    are right [1]."""
    pit_p_value: Number = nan
    """p-value of their uniformity, for the effective number of samples; nan if that is below ten
    [1]."""


LEAST_GROWTH = 0.02
"""An error has grown for certain if the closed fraction is below minus this value.

1 - (after / before)^2 = -0.02 if the error is larger by a hundredth."""


@dataclass(frozen=True)
class ClosedShare:
    """The fraction of the mean square error that a hypothesis removes: 1 - (after / before)^2.

    Both errors are computed from the same samples and the same kind of prediction: a simulation of
    the whole trial, with only its initial state and zeros fitted to it. Channels are pooled in
    units of their noise, which is the same before and after. For a channel without a noise record,
    the unit is the rms residual of the model without effects in the fitted trials.
    """

    value: Number
    """The fraction; negative if the error grew [1]."""
    low: Number
    """Lower end of the fraction's 90 % interval by a bootstrap of blocks of the records; nan with
    fewer than five blocks [1]."""
    high: Number
    """Upper end of this interval [1]."""
    trials: str
    """What the trials are: "held-out", or "fitted" if none was held out."""
    trial_count: int
    """Number of trials."""

    @property
    def has_grown(self) -> bool:
        """Whether the error is larger with the hypothesis than without it.

        Either it is clearly larger, or the whole interval says so.
        """
        return self.value < -LEAST_GROWTH or self.high < 0.0


@dataclass(frozen=True)
class ErrorComparison:
    """The errors of the deciding trials without and with a hypothesis.

    The deciding trials are the held-out ones if there are any, else the fitted ones. The sentence
    of a verdict and its proof state this one record.

    Attributes
    ----------
    closed : ClosedShare or None
        Fraction of the mean square error that the hypothesis removes; None with the reason in
        `closed_reason`.
    closed_reason : str
        Why the fraction cannot be given, or why it is that of fitted trials; else empty.
    rms_before, rms_after : mapping of str to float
        Root mean square residual by channel without and with the hypothesis [channel's unit].
    """

    closed: ClosedShare | None
    closed_reason: str
    rms_before: Mapping[str, Number]
    rms_after: Mapping[str, Number]

    @property
    def has_grown(self) -> bool:
        """Whether the error is larger with the hypothesis than without it."""
        return self.closed is not None and self.closed.has_grown


@dataclass(frozen=True)
class Proof:
    """What a hypothesis does to trials: before and after, on held-out and on fitted ones."""

    held_out_before: Scores | None
    """Scores on held-out trials without the hypothesis; None if no trial is held out."""
    held_out_after: Scores | None
    """Scores on held-out trials with the hypothesis; None if no trial is held out."""
    fitted_before: Scores
    """Scores on fitted trials without the hypothesis."""
    fitted_after: Scores
    """Scores on fitted trials with the hypothesis."""
    closed: ClosedShare | None
    """Fraction of the mean square error that the hypothesis removes; None with the reason in
    `closed_reason`."""
    log_score_gain: Number
    """Gain of the mean predictive log density per held-out sample [nat]."""
    log_score_gain_error: Number
    """Standard error of this gain, for which each trial counts as one unit [nat]."""
    remaining: str = ""
    """What is still not explained, in one sentence."""
    closed_reason: str = ""
    """Why the fraction cannot be given, such as held-out trials that agree with the model within
    their noise both before and after; empty if it can."""
    effects: tuple[str, ...] = ()
    """The hypothesis: its effects with their places, as `effect_label` gives them."""

    @property
    def has_grown(self) -> bool:
        """Whether the error is larger with the hypothesis than without it."""
        return self.closed is not None and self.closed.has_grown
