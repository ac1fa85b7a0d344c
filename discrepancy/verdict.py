"""The verdict and what it rests on, as records."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import nan

from discrepancy.document import Number, Patch
from reporting.words import brief


class VerdictKind(StrEnum):
    """What is concluded."""

    NOTHING_MISSING = "nothing missing"  # the model explains the data
    NAMED = "named"  # one effect, or a set of effects
    NAMED_IN_PART = "named in part"  # they close most of the gap; the rest is no noise and has no name
    FAMILY = "family"  # an effect of this family with a shape of its own
    GROUP = "group"  # one of a group that these data cannot separate
    UNEXPLAINED = "unexplained"  # a gap that no hypothesis fits
    DATA_ERROR = "data error"  # the data are at fault
    BELOW_LIMIT = "below detectability"  # something may be there, too small for these data


@dataclass(frozen=True)
class Moment:
    """When something changed [s since the trial's start]: posterior median and 90 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class GapWindow:
    """A stretch of a record in which something acts that the model lacks.

    Attributes
    ----------
    trial : str
        Whose record.
    channels : tuple of str
        Those that show it.
    begin, end : Moment or None
        Since when, until when; None where it is there from the first sample on, or to the last.
    first, last : float
        Times of the first and the last sample of the record [s].
    size : float
        Root mean square of what it does to the readings over their noise, of the channel with the largest.
    with_effect : bool
        Whether it is left by the best hypothesis; else by the model as it was.
    """

    trial: str
    channels: tuple[str, ...]
    begin: Moment | None
    end: Moment | None
    first: float
    last: float
    size: float
    with_effect: bool = False


@dataclass(frozen=True)
class Estimate:
    """A number with its 90 % interval: posterior median and quantiles 0.05, 0.95, in `unit`."""

    name: str
    value: Number
    low: Number
    high: Number
    unit: str
    description: str = ""


@dataclass(frozen=True)
class NamedEffect:
    """An effect in a hypothesis: identifier, standard name, place, parameters with intervals, its patch."""

    identifier: str
    name: str
    place: str
    family: str
    parameters: tuple[Estimate, ...]
    shape: tuple[Estimate, ...]
    patch: Patch


@dataclass(frozen=True)
class CalibratedParameter:
    """A calibrated parameter as a hypothesis has it: posterior mean and standard deviation, in `unit`."""

    name: str
    mean: Number
    deviation: Number
    unit: str


@dataclass(frozen=True)
class Hypothesis:
    """A fitted hypothesis.

    Attributes
    ----------
    effects : tuple of NamedEffect
        Empty for 'none'.
    log_evidence : float
        ln p(data | hypothesis), Laplace.
    probability : float
        Posterior probability among the hypotheses compared.
    chi_square, degrees_of_freedom : float
        Of the fitted trials against the noise records.
    parameters : tuple of CalibratedParameter
        Of the model, beside these effects.
    """

    effects: tuple[NamedEffect, ...]
    log_evidence: Number
    probability: Number
    chi_square: Number
    degrees_of_freedom: Number
    parameters: tuple[CalibratedParameter, ...] = ()

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the effects, sorted."""
        return tuple(sorted(effect.identifier for effect in self.effects))


@dataclass(frozen=True)
class Gate:
    """Outcome of one gate: "absolute fit" or "shape".

    Attributes
    ----------
    name : str
        Which.
    passed : bool or None
        None: it could not be applied, `reason` says why.
    statistic, limit : float
        What was compared.
    reason : str
        One sentence.
    """

    name: str
    passed: bool | None
    statistic: Number
    limit: Number
    reason: str


@dataclass(frozen=True)
class Scores:
    """Scores on a set of trials: by a model without or with the effect.

    Attributes
    ----------
    rms : mapping of str to float
        Root mean square residual by channel [channel's unit].
    chi_square_per_dof : float
        Against the noise record.
    log_score : float
        Mean predictive log density of a sample, standardised by its noise.
    coverage_50, coverage_90 : float
        Share of samples within the central predictive intervals.
    whiteness : float
        p-value of the Ljung-Box test, the least over dynamic channels (Holm); nan without dynamic trials.
    sample_count : int
        Used samples.
    chi_square_deviation : float
        Standard deviation of `chi_square_per_dof` if the model is right, from its degrees of freedom and
        those of the noise records; nan without a noise record.
    pit : tuple of float
        Shares of the probability integral transforms in ten equal bins; 0.1 each if predictions are right.
    pit_p_value : float
        Of their uniformity, with the effective number of samples; nan with fewer than ten.
    """

    rms: Mapping[str, Number]
    chi_square_per_dof: Number
    log_score: Number
    coverage_50: Number
    coverage_90: Number
    whiteness: Number
    sample_count: int = 0
    chi_square_deviation: Number = nan
    pit: tuple[Number, ...] = ()
    pit_p_value: Number = nan


@dataclass(frozen=True)
class Proof:
    """What the effect does to data not used: before and after, on held-out and on fitted trials.

    `gap_closed` = 1 - (χ²_after - 1) / (χ²_before - 1) per degree of freedom on held-out trials;
    nan with the reason in `gap_reason` where there is no held-out trial or no gap to close.
    `log_score_gain` per sample with its standard error, trials taken as units.
    """

    held_out_before: Scores | None
    held_out_after: Scores | None
    fitted_before: Scores
    fitted_after: Scores
    gap_closed: Number
    log_score_gain: Number
    log_score_gain_error: Number
    remaining: str = ""
    gap_reason: str = ""


@dataclass(frozen=True)
class ExplainedShare:
    """What the best hypothesis explains of the gap: mean squares over channels in units of their noise.

    Attributes
    ----------
    value, low, high : float
        1 - (rms after^2 - noise^2) / (rms before^2 - noise^2), 90 % interval by a bootstrap of blocks.
    left : float
        Root of rms after^2 - noise^2, over the noise.
    effect, remainder, noise : float
        Shares of rms before^2: what the effects take off, what is left beside the noise, the noise.
    trials : str
        "held-out", or "fitted" where none was held out.
    """

    value: Number
    low: Number
    high: Number
    left: Number
    effect: Number
    remainder: Number
    noise: Number
    trials: str


@dataclass(frozen=True)
class RemainderEstimate:
    """The remainder of a channel in the best hypothesis.

    Attributes
    ----------
    channel : str
        Which.
    size : float
        Its standard deviation over that of the channel's noise.
    time : float
        Time over which it forgets [s].
    frequency : float
        At which it swings [Hz]; nought if it does not.
    """

    channel: str
    size: Number
    time: Number
    frequency: Number


@dataclass(frozen=True)
class ShareOfForce:
    """What share of a missing force a law is, in trials that were fitted or in those held out.

    Attributes
    ----------
    value, low, high : float
        1 - mean square of what is left over that of the force without any effect, noise taken from both;
        90 % interval by a bootstrap of blocks.
    left, whole : float
        Root mean squares of what is left and of the force without any effect, in the force's unit.
    ahead : bool
        Whether it is one of what the force does to predictions over a twelfth of a record, not of the force.
    trials : int
        How many.
    tested : bool
        Whether the law has a force there that could be seen.
    """

    value: Number
    low: Number
    high: Number
    left: Number
    whole: Number
    ahead: bool
    trials: int
    tested: bool


@dataclass(frozen=True)
class ForceMoment:
    """A missing force at a moment: trial, time [s], force, displacement [m or rad] and speed of its port."""

    trial: str
    time: Number
    force: Number
    displacement: Number
    speed: Number


@dataclass(frozen=True)
class ForceAtPort:
    """The force that the model lacks at a port, as it is seen in the fitted trials.

    Attributes
    ----------
    port : str
        Its name.
    unit : str
        Of the force: "N", "N m", or "N or N m" where the model does not say whether the port turns; at a
        port of a state that of its flow.
    rms, displacement, speed : float
        Root mean squares of the force, and of how far and how fast the port moves [m or rad, and its rate];
        of a port of a state of its integral, and of the state.
    largest : ForceMoment
        Where the force is largest.
    evidence : mapping of str to float
        By port: of a missing force there over none [nat].
    correlation_time : float
        Of the force [s].
    orders : mapping of str to float
        Share of the force's variance that its mean at like displacement, velocity, amplitude or time is.
    ordered_by : tuple of str
        Those that order it, as well as the best one does; empty where none does.
    law : str
        What was drawn through it, with their places where laws act at several ports; empty: nothing.
    fitted, held_out : ShareOfForce or None
        What share of the force the law is, of those at all ports where laws act at several.
    """

    port: str
    unit: str
    rms: Number
    displacement: Number
    speed: Number
    largest: ForceMoment
    evidence: Mapping[str, Number]
    correlation_time: Number
    orders: Mapping[str, Number]
    ordered_by: tuple[str, ...]
    law: str = ""
    fitted: ShareOfForce | None = None
    held_out: ShareOfForce | None = None


@dataclass(frozen=True)
class NotFitted:
    """An effect that was not fitted, and why; `gain` is what a screen promised at most [nat]."""

    identifier: str
    reason: str
    gain: Number = nan


@dataclass(frozen=True)
class Experiment:
    """A proposed next experiment: what to do, its mutual information [nat], cost [1], and why."""

    description: str
    information: Number
    cost: Number
    reason: str


@dataclass(frozen=True)
class Verdict:
    """The conclusion.

    Attributes
    ----------
    kind : VerdictKind
        What is concluded.
    sentence : str
        It in one sentence.
    probability : float
        Among the hypotheses compared: of the named set with all that hold it, of the group together, of
        'none' (nothing missing), of the candidates with 'none' (below detectability). Of a family: of it
        and its members; where only the shape gate found it, of its member. Of an unexplained gap nothing.
    log_bayes_factor : float
        ln of evidence of the best hypothesis over that of 'none'.
    effects : tuple of NamedEffect
        The set that is named; members of the group where a group is; the shape's nearest where a family is.
    group : tuple of str
        Identifiers that these data cannot separate.
    family : str
        Where the verdict is a family.
    gates : tuple of Gate
        Absolute fit and shape.
    hypotheses : tuple of Hypothesis
        Compared, most probable first.
    inclusion : mapping of str to float
        Probability that an effect is in the set, by identifier.
    next_experiments : tuple of Experiment
        Best first; empty where nothing is open.
    remarks : tuple of str
        Limits and data errors, one sentence each.
    resembles : tuple of str
        What an unexplained rest looks like; never a name.
    explained : ExplainedShare or None
        Of the gap, by the best hypothesis, where none leaves noise alone.
    remainders : tuple of RemainderEstimate
        Of the best hypothesis.
    not_fitted : tuple of NotFitted
        Effects of the catalogue that were not.
    windows : tuple of GapWindow
        Since when and until when there is a gap in each record: of the model as it was, and of what the best
        hypothesis leaves.
    parameters : tuple of CalibratedParameter
        Of the model, in the hypothesis that stands for the verdict.
    force : ForceAtPort or None
        That is missing; None where none is, or none can be seen.
    """

    kind: VerdictKind
    sentence: str
    probability: Number
    log_bayes_factor: Number
    effects: tuple[NamedEffect, ...] = ()
    group: tuple[str, ...] = ()
    family: str = ""
    gates: tuple[Gate, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()
    inclusion: Mapping[str, Number] = field(default_factory=dict)
    next_experiments: tuple[Experiment, ...] = ()
    remarks: tuple[str, ...] = ()
    resembles: tuple[str, ...] = ()
    explained: ExplainedShare | None = None
    remainders: tuple[RemainderEstimate, ...] = ()
    not_fitted: tuple[NotFitted, ...] = ()
    windows: tuple[GapWindow, ...] = ()
    parameters: tuple[CalibratedParameter, ...] = ()
    force: ForceAtPort | None = None

    def __repr__(self) -> str:
        effects = [effect.identifier for effect in self.effects]
        return brief(self, kind=self.kind.value, probability=self.probability, effects=effects)
