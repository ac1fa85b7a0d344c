"""The proof of a verdict: errors and scores on trials, before and after, as records."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan

from discrepancy.document import Number


@dataclass(frozen=True)
class Scores:
    """Scores on a set of trials: by a model without or with the effect.

    Attributes
    ----------
    rms : mapping of str to float
        Root mean square residual by channel [channel's unit].
    chi_square_per_sample : float
        Mean square residual over the variance of the noise, of channels with a noise record; nan
        without one.
    log_score : float
        Mean predictive log density of a sample, standardised by its noise.
    coverage_50, coverage_90 : float
        Share of samples within the central predictive intervals.
    whiteness : float
        p-value of the Ljung-Box test, the least over dynamic channels (Holm); nan without dynamic
        trials.
    sample_count : int
        Used samples.
    chi_square_expected, chi_square_deviation : float
        Mean and standard deviation of `chi_square_per_sample` if the model is right, from what the
        fit absorbs or leaves open and the degrees of freedom of the noise records; nan without a
        noise record.
    pit : tuple of float
        Shares of the probability integral transforms in ten equal bins; 0.1 each if predictions are
        right.
    pit_p_value : float
        Of their uniformity, with the effective number of samples; nan with fewer than ten.
    """

    rms: Mapping[str, Number]
    chi_square_per_sample: Number
    log_score: Number
    coverage_50: Number
    coverage_90: Number
    whiteness: Number
    sample_count: int = 0
    chi_square_expected: Number = nan
    chi_square_deviation: Number = nan
    pit: tuple[Number, ...] = ()
    pit_p_value: Number = nan


LEAST_GROWTH = 0.02
"""Share below zero from which on an error has grown whatever its interval: by a hundredth of its
size."""


@dataclass(frozen=True)
class ClosedShare:
    """The fraction of the mean square error that a hypothesis removes: 1 - (after / before)^2.

    Both errors are of the same samples and of the same kind of prediction: a simulation of the
    whole trial, with no more than its own beginning and zeros fitted to it. Channels are pooled in
    units of their noise, which is the same before and after; where no noise is recorded, of what
    the model as it was leaves of the channel in fitted trials.

    Attributes
    ----------
    value : float
        The share, negative where the error grew.
    low, high : float
        Its 90 % interval by a bootstrap of blocks of the records; nan with fewer than five blocks.
    trials : str
        "held-out", or "fitted" where none was held out.
    trial_count : int
        How many.
    """

    value: Number
    low: Number
    high: Number
    trials: str
    trial_count: int

    @property
    def grew(self) -> bool:
        """Whether the error is larger with the hypothesis than without it."""
        return self.value < -LEAST_GROWTH or self.high < 0.0


@dataclass(frozen=True)
class Proof:
    """What a hypothesis does to trials: before and after, on held-out and on fitted ones.

    Attributes
    ----------
    held_out_before, held_out_after : Scores or None
        None without a held-out trial.
    fitted_before, fitted_after : Scores
        Of the fitted trials.
    closed : ClosedShare or None
        Of the mean square error; None with the reason in `closed_reason`.
    log_score_gain, log_score_gain_error : float
        Of the mean predictive log density per held-out sample [nat], and its standard error.
    remaining : str
        What is still not explained, in one sentence.
    closed_reason : str
        Why there is no share.
    effects : tuple of str
        The hypothesis: its effects with their places, as `effect_label` gives them.
    """

    held_out_before: Scores | None
    held_out_after: Scores | None
    fitted_before: Scores
    fitted_after: Scores
    closed: ClosedShare | None
    log_score_gain: Number
    log_score_gain_error: Number
    remaining: str = ""
    closed_reason: str = ""
    effects: tuple[str, ...] = ()

    @property
    def grew(self) -> bool:
        """Whether the error is larger with the hypothesis than without it."""
        return self.closed is not None and self.closed.grew
