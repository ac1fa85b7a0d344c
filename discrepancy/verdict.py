"""The verdict and what it rests on, as records; its proof has a module of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import nan

from discrepancy.document import Number, Patch
from reporting.words import brief

FREE_SHAPE = " (free shape)"
"""What marks the identifier of an effect whose shape is free: its family."""


class VerdictKind(StrEnum):
    """What is concluded."""

    NOTHING_MISSING = "nothing missing"  # the model explains the data
    NAMED = "named"  # one effect, or a set of effects
    NAMED_IN_PART = (
        "named in part"  # they close most of the gap; the rest is no noise and has no name
    )
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
        Root mean square residual in it over the noise, of the channel with the largest. Where no
        noise is recorded, over what the model as it was leaves in fitted trials, before and with
        the effect.
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
    """An effect in a hypothesis: identifier, name, place, parameters with intervals, patch."""

    identifier: str
    name: str
    place: str
    family: str
    parameters: tuple[Estimate, ...]
    shape: tuple[Estimate, ...]
    patch: Patch


def effect_label(identifier: str, place: str, *, free_shape: bool = False) -> str:
    """Return an effect with its place, "coulomb_friction@slide", and a mark of a free shape."""
    return f"{identifier}{FREE_SHAPE if free_shape else ''}@{place}"


@dataclass(frozen=True)
class CalibratedParameter:
    """A calibrated parameter of a hypothesis: posterior mean and standard deviation, in `unit`."""

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

    @property
    def labels(self) -> tuple[str, ...]:
        """Its effects with their places, sorted, as `Proof.effects` has them."""
        labels = [
            effect_label(effect.identifier, effect.place, free_shape=bool(effect.shape))
            for effect in self.effects
        ]
        return tuple(sorted(labels))


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
class ForceLeft:
    """What a law leaves of a missing force, in trials that were fitted or in those held out.

    Attributes
    ----------
    left, whole : float
        Root mean squares of the force beside the law and of the force without any effect, in its
        unit.
    trials : int
        How many.
    tested : bool
        Whether the law has a force there that could be seen.
    """

    left: Number
    whole: Number
    trials: int
    tested: bool


@dataclass(frozen=True)
class ForceMoment:
    """A missing force at a moment: trial, time [s], force, displacement and speed of its port."""

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
        Of the force: "N", "N m", or "N or N m" where the model does not say whether the port turns;
        at a port of a state that of its flow.
    rms, displacement, speed : float
        Root mean squares of the force, and of how far and how fast the port moves [m or rad, and
        its rate]; of a port of a state of its integral, and of the state.
    largest : ForceMoment
        Where the force is largest.
    evidence : mapping of str to float
        By port: of a missing force there over none [nat].
    correlation_time : float
        Of the force [s].
    orders : mapping of str to float
        Share of the force's variance that its mean at like displacement, velocity, amplitude or
        time is.
    ordered_by : tuple of str
        Those that order it, as well as the best one does; empty where none does.
    law : str
        What was drawn through it, with their places where laws act at several ports; empty:
        nothing.
    fitted, held_out : ForceLeft or None
        What the law leaves of the force, of those at all ports where laws act at several.
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
    fitted: ForceLeft | None = None
    held_out: ForceLeft | None = None


@dataclass(frozen=True)
class UnfittedRecord:
    """A record that the model is not fitted to: the fit leaves more than the signal's own variance.

    `left` is the rms residual, `varies` the standard deviation of the readings about their mean
    [channel's unit].
    """

    trial: str
    channel: str
    left: Number
    varies: Number


@dataclass(frozen=True)
class MovedUnknown:
    """A parameter, gain or zero that a fit without effects moves far from what is stated.

    Attributes
    ----------
    name : str
        Of the parameter, or "gain of CHANNEL", "zero of CHANNEL in TRIAL", "constant of INPUT in
        TRIAL".
    stated, deviation : float
        What is stated of it, and its standard deviation [`unit`].
    value : float
        What the fit without any effect makes of it.
    deviations : float
        By how many standard deviations it is moved.
    unit : str
        SI; gains are errors of the gain [1].
    """

    name: str
    stated: Number
    deviation: Number
    value: Number
    deviations: Number
    unit: str


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
        Among the hypotheses compared: of the named set with all that hold it, of the group
        together, of 'none' (nothing missing), of the candidates with 'none' (below detectability).
        Of a family: of it and its members; where only the shape gate found it, of its member. Of an
        unexplained gap nothing.
    log_bayes_factor : float
        ln of evidence of the best hypothesis over that of 'none'.
    effects : tuple of NamedEffect
        The set that is named; members of the group where a group is; the shape's nearest where a
        family is.
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
    remainders : tuple of RemainderEstimate
        Of the best hypothesis.
    not_fitted : tuple of NotFitted
        Effects of the catalogue that were not.
    windows : tuple of GapWindow
        Since when and until when there is a gap in each record: of the model as it was, and of what
        the best hypothesis leaves.
    parameters : tuple of CalibratedParameter
        Of the model, in the hypothesis that stands for the verdict.
    force : ForceAtPort or None
        That is missing; None where none is, or none can be seen.
    unfitted : tuple of UnfittedRecord
        Records that the hypothesis of the verdict leaves more of than their own variance: it is not
        fitted.
    moved : tuple of MovedUnknown
        Parameters, gains and zeros that the model without any effect moves by more than two of
        their stated deviations, the farthest first.
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
    remainders: tuple[RemainderEstimate, ...] = ()
    not_fitted: tuple[NotFitted, ...] = ()
    windows: tuple[GapWindow, ...] = ()
    parameters: tuple[CalibratedParameter, ...] = ()
    force: ForceAtPort | None = None
    unfitted: tuple[UnfittedRecord, ...] = ()
    moved: tuple[MovedUnknown, ...] = ()

    def __repr__(self) -> str:
        effects = [effect.identifier for effect in self.effects]
        return brief(self, kind=self.kind.value, probability=self.probability, effects=effects)
