"""The verdict and what it rests on, as records; its proof has a module of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import nan

from discrepancy.document import Number, Patch
from fe.runtime.patch import EVERY_CHANNEL
from reporting.pages.notebook import html_table
from reporting.words import between, brief, listing, rounded

RATE_OF = "the rate of "
"""How the name of an input's rate begins, among the variables that may order a missing force."""
STATE = "displacement and velocity"
"""The name of the motion of a port as a whole, among these variables."""
FREE_SHAPE = " (free shape)"
"""What marks the identifier of an effect whose shape is free: its family."""


class VerdictKind(StrEnum):
    """What is concluded."""

    NOTHING_MISSING = "nothing missing"  # the model explains the data
    NAMED = "named"  # one effect, or a set of effects
    NAMED_IN_PART = (
        "named in part"  # they close most of the gap; the rest is not a noise and has no name
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
    """Posterior median [s]."""
    low: float
    """Quantile 0.05 [s]."""
    high: float
    """Quantile 0.95 [s]."""


@dataclass(frozen=True)
class GapWindow:
    """A stretch of a record in which something acts that the model lacks."""

    trial: str
    """Name of the trial."""
    channels: tuple[str, ...]
    """Names of the channels that show the gap."""
    begin: Moment | None
    """Beginning of the window; None if it begins with the first sample."""
    end: Moment | None
    """End of the window; None if it ends with the last sample."""
    first: float
    """Time of the first sample of the record [s]."""
    last: float
    """Time of the last sample of the record [s]."""
    size: float
    """Root mean square residual in the window over the noise, of the channel with the largest. For
    a channel without a noise record, the residuals of the model without effects in the fitted
    trials replace the noise, also if `with_effect` is true [1]."""
    with_effect: bool = False
    """True if the gap remains with the best hypothesis; False for the model without effects."""


@dataclass(frozen=True)
class ParameterEstimate:
    """A number with its 90 % interval: posterior median and quantiles 0.05, 0.95, in `unit`."""

    name: str
    """Name of the number."""
    value: Number
    """Posterior median [unit of the entry]."""
    low: Number
    """Quantile 0.05 [unit of the entry]."""
    high: Number
    """Quantile 0.95 [unit of the entry]."""
    unit: str
    """Unit of the number."""
    description: str = ""
    """What the number is."""


@dataclass(frozen=True)
class NamedEffect:
    """An effect in a hypothesis: identifier, name, place, parameters with intervals, patch."""

    identifier: str
    """Identifier of the effect in the catalogue."""
    name: str
    """Name of the effect."""
    place: str
    """Channel, port, run or frequency where it acts; empty if it has no place."""
    family: str
    """Name of the family of laws to which it belongs."""
    parameters: tuple[ParameterEstimate, ...]
    """Its parameters."""
    shape: tuple[ParameterEstimate, ...]
    """Its exponents, if its law has a free shape; else empty."""
    patch: Patch
    """Primitive changes of the model."""

    @property
    def place_in_words(self) -> str:
        """The place as a reader is told it."""
        return place_in_words(self.place)


def place_in_words(place: str) -> str:
    """Return a place as a reader is told it: "all channels" for "*"."""
    return "all channels" if place == EVERY_CHANNEL else place


def effect_label(identifier: str, place: str, *, free_shape: bool = False) -> str:
    """Return the label of an effect at a place, such as "coulomb_friction@slide".

    Parameters
    ----------
    identifier, place : str
        Identifier of the effect and name of its place.
    free_shape : bool
        True to mark the effect as one of its family with a free shape.
    """
    return f"{identifier}{FREE_SHAPE if free_shape else ''}@{place}"


@dataclass(frozen=True)
class CalibratedParameter:
    """A calibrated parameter of a hypothesis: posterior mean and standard deviation, in `unit`."""

    name: str
    """Name of the parameter."""
    mean: Number
    """Posterior mean [unit of the entry]."""
    deviation: Number
    """Posterior standard deviation [unit of the entry]."""
    unit: str
    """Unit of the parameter."""


@dataclass(frozen=True)
class Hypothesis:
    """A fitted hypothesis."""

    effects: tuple[NamedEffect, ...]
    """Effects of the hypothesis; empty for 'none', the unchanged model."""
    log_evidence: Number
    """ln p(data | hypothesis) by Laplace's approximation [nat]."""
    probability: Number
    """Posterior probability among the hypotheses compared [1]."""
    chi_square: Number
    """Chi-squared of the fitted trials against the noise records [1]."""
    degrees_of_freedom: Number
    """Degrees of freedom of `chi_square` [1]."""
    parameters: tuple[CalibratedParameter, ...] = ()
    """Calibrated parameters of the model, fitted together with these effects."""

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
    """Outcome of one test of a hypothesis, such as "absolute fit", "shape" or "consistency"."""

    name: str
    """Name of the gate."""
    passed: bool | None
    """True if the hypothesis passed; None if the gate could not be applied."""
    statistic: Number
    """Statistic of the test [unit of the statistic]."""
    limit: Number
    """Limit that the statistic was compared with [unit of the statistic]."""
    reason: str
    """The outcome, or why the gate could not be applied, in one sentence."""

    @property
    def has_failed(self) -> bool:
        """Whether the hypothesis failed; a gate that could not be applied has not failed."""
        return self.passed is False


@dataclass(frozen=True)
class RemainderEstimate:
    """The remainder of a channel in the best hypothesis."""

    channel: str
    """Name of the channel."""
    size: Number
    """Standard deviation of the remainder over that of the channel's noise [1]."""
    time: Number
    """Correlation time of the remainder [s]."""
    frequency: Number
    """Frequency at which the remainder oscillates [Hz]; 0 if it does not."""


@dataclass(frozen=True)
class ForceLeft:
    """What a law leaves of a missing force, in trials that were fitted or in those held out."""

    left: Number
    """Root mean square of the missing force that remains with the law [unit of the force]."""
    whole: Number
    """Root mean square of the missing force without any effect [unit of the force]."""
    trials: int
    """Number of trials."""
    tested: bool
    """Whether the law has a force in these trials that is large enough to be detected; else they
    cannot test it."""


@dataclass(frozen=True)
class ForceMoment:
    """A missing force at a moment: trial, time [s], force, displacement and speed of its port."""

    trial: str
    """Name of the trial."""
    time: Number
    """Time [s]."""
    force: Number
    """Force [unit of the force]."""
    displacement: Number
    """Displacement of the port [m or rad]."""
    speed: Number
    """Speed of the port [m/s or rad/s]."""


def as_noun(variable: str) -> str:
    """Return the name of a variable that a force may follow with its article."""
    return variable if variable.startswith("the ") else f"the {variable}"


@dataclass(frozen=True)
class ForceAtPort:
    """The force that the model lacks at a port, as it is seen in the fitted trials."""

    port: str
    """Name of the port."""
    unit: str
    """Unit of the force: "N", "N m", or "N or N m" if the model does not say whether the port
    translates or rotates. At a port of a state it is the unit of the flow."""
    rms: Number
    """Root mean square of the force [`unit`]."""
    displacement: Number
    """Root mean square displacement of the port [m or rad]; at a port of a state, of the state's
    integral."""
    speed: Number
    """Root mean square speed of the port [m/s or rad/s]; at a port of a state, of the state."""
    largest: ForceMoment
    """The moment at which the force is largest."""
    evidence: Mapping[str, Number]
    """Log evidence of a missing force at a port over that of none [nat], by the name of the
    port."""
    correlation_time: Number
    """Correlation time of the force [s]."""
    orders: Mapping[str, Number]
    """Fraction of the force's variance that is explained by its mean at equal displacement,
    velocity, amplitude, time, recorded input or rate of an input, by the name of that variable; 1
    if the force is a function of the variable, 0 if the two are independent [1]. Displacement and
    velocity together are among the variables if they explain clearly more, and so is the
    displacement relaxed within some time. At a port of a state, the variables of the motion are
    that state and, if it explains clearly more, its average over the past."""
    ordered_by: tuple[str, ...]
    """Variables whose value in `orders` is at least 0.3 and within 0.05 of the largest;
    "displacement and velocity" alone if no single variable explains 0.6 of what these explain
    together; empty if none explains the force."""
    law: str = ""
    """The named effect or the best hypothesis, with places if laws act at several ports; empty if
    no law was fitted."""
    fitted: ForceLeft | None = None
    """What remains of the force with the law in fitted trials; if laws act at several ports, of the
    forces at all of them."""
    held_out: ForceLeft | None = None
    """The same in held-out trials."""

    @property
    def noun(self) -> str:
        """What is missing: a force, a moment or, at a port of a state, a flow."""
        return {"N": "force", "N m": "moment", "N or N m": "force"}.get(self.unit, "flow")

    @property
    def followed_percent(self) -> str:
        """The largest fraction of the force's variance that follows one variable, in %."""
        return f"{100.0 * max(self.orders.values()):.0f}"

    @property
    def sentence(self) -> str:
        """That the force is missing, where and how large, and what it depends on."""
        return (
            f"A {self.noun} of {self.rms:.3g} {self.unit} (rms) is missing at {self.port}, and no "
            f"law of the catalogue explains it: {self.dependence}."
        )

    @property
    def dependence(self) -> str:
        """What the force depends on, as a clause of a sentence."""
        if not self.ordered_by:
            return f"it follows none of {listing(map(as_noun, self.orders))}"
        followed = listing(map(as_noun, self.ordered_by), "or")
        clause = f"{self.followed_percent} % of its variance follows {followed}"
        if len(self.ordered_by) == 1 and self.ordered_by[0].startswith(RATE_OF):
            return f"{clause}, as if it acted later or earlier than was recorded"
        return clause


@dataclass(frozen=True)
class UnfittedRecord:
    """A record that the model does not fit: its residuals vary more than the signal itself.

    `left` is the rms residual, `varies` the standard deviation of the readings about their mean
    [channel's unit].
    """

    trial: str
    """Name of the trial."""
    channel: str
    """Name of the channel."""
    left: Number
    """Root mean square residual [unit of the channel]."""
    varies: Number
    """Standard deviation of the readings about their mean [unit of the channel]."""


@dataclass(frozen=True)
class MovedUnknown:
    """A parameter, gain or zero that a fit without effects moves far from its stated value."""

    name: str
    """Name of the parameter, or "gain of CHANNEL", "zero of CHANNEL in TRIAL", "constant of INPUT
    in TRIAL"."""
    stated: Number
    """Stated value [unit of the entry]."""
    deviation: Number
    """Standard deviation of the stated value [unit of the entry]."""
    value: Number
    """Value in the fit without any effect [unit of the entry]."""
    deviations: Number
    """Distance of the two in standard deviations [1]."""
    unit: str
    """Unit in SI; for a gain it is "1", and the values are relative errors of the gain."""


class SensorValue(StrEnum):
    """What is estimated of a channel."""

    GAIN = "gain"
    ZERO = "zero"


@dataclass(frozen=True)
class SensorEstimate:
    """The gain of a channel or its zero in a trial, fitted in the hypothesis of the verdict."""

    channel: str
    """Name of the channel."""
    kind: SensorValue
    """Whether it is a gain, which is given by its relative error, or a zero."""
    trial: str
    """Name of the trial in which the channel has this zero; empty for a gain, which is the same in
    all trials."""
    value: Number
    """Fitted value [unit of the entry]. The stated value is zero."""
    deviation: Number
    """Posterior standard deviation of the value [unit of the entry]."""
    stated_deviation: Number
    """Stated standard deviation of the value; infinite if the value was not stated [unit of the
    entry]."""
    deviations: Number
    """Fitted value in stated standard deviations; not a number if the value was not stated [1]."""
    unit: str
    """Unit in SI; "1" for a gain."""


@dataclass(frozen=True)
class NotFitted:
    """An effect that was not fitted, the reason, and the largest predicted `gain` [nat]."""

    identifier: str
    """Identifier of the effect in the catalogue."""
    reason: str
    """Why it was not fitted."""
    gain: Number = nan
    """Gain of log evidence that a screen promised at most [nat]."""


@dataclass(frozen=True)
class Experiment:
    """A proposed next experiment: what to do, its mutual information [nat], cost [1], and why."""

    description: str
    """What to do."""
    information: Number
    """Mutual information of the result and the open question [nat]."""
    cost: Number
    """Cost [1]."""
    reason: str
    """Why it is proposed."""


@dataclass(frozen=True)
class Verdict:
    """The conclusion."""

    kind: VerdictKind
    """Kind of the conclusion."""
    sentence: str
    """The conclusion in one sentence."""
    probability: Number
    """Posterior probability of the conclusion among the hypotheses compared: of all sets that
    contain the named one, of all members of the group, or of 'none' (nothing missing and below
    detectability). For a family it is that of the family and its members, or that of the member if
    only the shape gate found the family. It has no meaning for an unexplained gap, where no set is
    named, and is nan where the data are at fault [1]."""
    log_bayes_factor: Number
    """Log evidence of the best hypothesis over that of the model as it is, without a missing force
    [nat]."""
    effects: tuple[NamedEffect, ...] = ()
    """The named set of effects; for a group its members; for a family the member of the nearest
    shape."""
    group: tuple[str, ...] = ()
    """Identifiers of effects that these data cannot separate."""
    family: str = ""
    """Name of the family, if the verdict is a family; else empty."""
    gates: tuple[Gate, ...] = ()
    """Outcomes of the gates of absolute fit and shape."""
    hypotheses: tuple[Hypothesis, ...] = ()
    """Hypotheses that were compared, the most probable first."""
    inclusion: Mapping[str, Number] = field(default_factory=dict)
    """Probability that an effect is in the set, by identifier [1]."""
    next_experiments: tuple[Experiment, ...] = ()
    """Proposed experiments, the best first; empty if no question is open."""
    remarks: tuple[str, ...] = ()
    """Limits of the conclusion and faults of the data, one sentence each."""
    resembles: tuple[str, ...] = ()
    """Effects that an unexplained remainder resembles; these are not names."""
    remainders: tuple[RemainderEstimate, ...] = ()
    """Remainders of the channels in the best hypothesis."""
    not_fitted: tuple[NotFitted, ...] = ()
    """Effects of the catalogue that were not fitted."""
    windows: tuple[GapWindow, ...] = ()
    """Windows in time with a gap in each record, for the model without effects and for the best
    hypothesis."""
    parameters: tuple[CalibratedParameter, ...] = ()
    """Parameters of the model beside the named effects or the first member of a group; without an
    effect if neither is there."""
    force: ForceAtPort | None = None
    """The missing force; None if no force is missing, or none can be determined."""
    unfitted: tuple[UnfittedRecord, ...] = ()
    """Records whose residuals in the hypothesis of the verdict have a larger variance than the
    readings themselves."""
    moved: tuple[MovedUnknown, ...] = ()
    """Parameters, gains and zeros that the fit without any effect moves by more than two of their
    stated standard deviations, the farthest first."""
    moved_within_prior: tuple[MovedUnknown, ...] = ()
    """Unknowns that the fit without any effect moves by one to two of their stated standard
    deviations, if these are so wide that the move is at least 2 % of the stated value (for a zero,
    of the largest reading) and three posterior standard deviations."""
    sensors: tuple[SensorEstimate, ...] = ()
    """Gains of the channels, and their zeros in each fitted trial, beside the named effects;
    without an effect if none is named."""
    reasons: str = ""
    """What the conclusion rests on, what it leaves and what it does not exclude, in sentences."""

    @property
    def text(self) -> str:
        """The conclusion together with its reasons."""
        return f"{self.sentence} {self.reasons}".strip()

    def with_reasons(self, sentences: str) -> "Verdict":
        """Return the verdict with further sentences after its reasons."""
        return replace(self, reasons=f"{self.reasons} {sentences}".strip())

    def __repr__(self) -> str:
        effects = [effect.identifier for effect in self.effects]
        return brief(self, kind=self.kind.value, probability=self.probability, effects=effects)

    def _repr_html_(self) -> str:
        """Return the conclusion with the parameters of its effects, for a notebook."""
        rows = []
        for effect in self.effects:
            for parameter in effect.parameters:
                half_width = 0.5 * (parameter.high - parameter.low)
                row = [
                    effect.name,
                    effect.place,
                    parameter.name.replace("_", " "),
                    rounded(parameter.value, half_width),
                    between(parameter.low, parameter.high, half_width),
                    "" if parameter.unit == "1" else parameter.unit,
                ]
                rows.append(row)
        headings = ("effect", "place", "parameter", "value", "90 % interval", "unit")
        return html_table(self.text, headings if rows else (), rows, self.remarks)
