"""What all verdicts on a search have in common: records of hypotheses, and sentences.

The module also decides which errors of instruments are too small to be named.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isnan, nan
from typing import NamedTuple, Protocol

import numpy as np

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.catalogue.entry import (
    NINETY_PERCENT_QUANTILE,
    EffectParameter,
    ForceTable,
    ShapeParameter,
)
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.predictive import with_draws
from discrepancy.fits.problem import Problem
from discrepancy.search.strategy import Search
from discrepancy.verdict import (
    FREE_SHAPE,
    CalibratedParameter,
    Gate,
    Hypothesis,
    NamedEffect,
    ParameterEstimate,
    RemainderEstimate,
    Verdict,
    VerdictKind,
)
from fe.runtime.patch import Clock, LoadGain, ModelPatch, Primitive, SensorGain
from reporting.words import listing

from .curve_words import curve_in_words, curve_of, followed_variable

TOLD_POINT = 6
"""Every how many points of a table of forces one is told."""


class ComparedHypothesis(Protocol):
    """A fitted hypothesis: a simulation (`CandidateFit`), or a fit to the missing force."""

    @property
    def candidate(self) -> Candidate:
        """The effects."""

    @property
    def effect(self) -> FloatArray:
        """The scaled effect parameters (E,)."""

    @property
    def shared(self) -> FloatArray:
        """The scaled shared unknowns (Q,)."""

    @property
    def covariance(self) -> FloatArray:
        """The covariance (Q + E, Q + E) of shared unknowns and effect parameters."""

    @property
    def log_evidence(self) -> float:
        """The log evidence [nat]."""

    def __hash__(self) -> int:
        """Return the hash of the object, by its identity: two fits are never equal."""


class VerdictOutcome(NamedTuple):
    """A verdict, the search on which it is based, and the fit that represents it.

    The fit is that of the named set or family, of the most probable member of a group, or of the
    effects that are too small to be detected; else the one without effect.
    """

    verdict: Verdict
    search: Search
    fit: CandidateFit


class WeightedHypothesis(NamedTuple):
    """A hypothesis and its probability among those compared."""

    hypothesis: ComparedHypothesis
    probability: float


@dataclass(frozen=True)
class Conclusion:
    """The hypotheses of a search with their probabilities, from which a verdict is made.

    Attributes
    ----------
    search : Search
        The search with all of its fits.
    log_bayes_factor : float
        ln of the evidence of the best hypothesis over that of the model without effect.
    hypotheses : sequence of WeightedHypothesis
        The hypotheses that the verdict lists, in their order.
    """

    search: Search
    log_bayes_factor: float
    hypotheses: Sequence[WeightedHypothesis]

    @classmethod
    def from_probabilities(
        cls, search: Search, best_fit: CandidateFit, probabilities: Mapping[tuple[str, ...], float]
    ) -> "Conclusion":
        """Return the conclusion on the sets of effects of a search.

        Parameters
        ----------
        search : Search
            The search with all of its fits.
        best_fit : CandidateFit
            The best set of effects. For the Bayes factor its evidence is divided by the number of
            places from which its places were chosen.
        probabilities : mapping of tuple of str to float
            The probability of each set of identifiers, the most probable first.
        """
        setting = search.problem.setting
        log_places = sum(
            np.log(len(term.effect.places(setting))) for term in best_fit.candidate.terms
        )
        no_effect = search.compared_no_effect
        log_bayes_factor = float(best_fit.log_evidence - log_places - no_effect.log_evidence)
        hypotheses = [
            WeightedHypothesis(search.best_fit_of_set(names), probability)
            for names, probability in probabilities.items()
        ]
        return cls(search, log_bayes_factor, hypotheses)

    @cached_property
    def inclusion_probabilities(self) -> dict[str, float]:
        """The probability of each effect to be one of the missing effects, by its identifier."""
        inclusion = {}
        for effect in self.search.effects:
            total_probability: float = 0
            for hypothesis, probability in self.hypotheses:
                if effect.identifier in names_without_free_shape(hypothesis.candidate.identifiers):
                    total_probability += probability
            inclusion[effect.identifier] = total_probability
        return inclusion

    def build_outcome(
        self,
        kind: VerdictKind,
        sentence: str,
        probability: float,
        fit: CandidateFit | None = None,
        *,
        effects: tuple[NamedEffect, ...] = (),
        group: tuple[str, ...] = (),
        family: str = "",
        gates: tuple[Gate, ...] = (),
        resembles: tuple[str, ...] = (),
        remainders: tuple[RemainderEstimate, ...] = (),
    ) -> VerdictOutcome:
        """Return a verdict with the fit that represents it.

        Parameters
        ----------
        kind, sentence, probability
            What is concluded, see `Verdict`.
        fit : CandidateFit, optional
            The fit that represents the verdict; the one without effect if left out.
        effects, group, family, gates, resembles, remainders
            Further attributes of the `Verdict`.
        """
        records = [
            hypothesis_record(self.search.problem, hypothesis, hypothesis_probability)
            for hypothesis, hypothesis_probability in self.hypotheses
        ]
        verdict = Verdict(
            kind,
            sentence,
            probability,
            self.log_bayes_factor,
            effects=effects,
            group=group,
            family=family,
            gates=gates,
            hypotheses=tuple(records),
            inclusion=self.inclusion_probabilities,
            resembles=resembles,
            remainders=remainders,
        )
        return VerdictOutcome(verdict, self.search, self.search.no_effect if fit is None else fit)

    def build_named_outcome(
        self,
        fit: CandidateFit,
        probability: float,
        gates: tuple[Gate, ...],
        remainders: tuple[RemainderEstimate, ...] = (),
    ) -> VerdictOutcome:
        """Return the verdict that names the effects of a fit.

        Parameters
        ----------
        fit : CandidateFit
            The fit of a hypothesis to all trials.
        probability : float
            The probability of the set.
        gates : tuple of Gate
            The outcomes of the tests, that of absolute fit first.
        remainders : tuple of RemainderEstimate
            The residual processes of the fit, by channel.
        """
        effects = named_effects(self.search.problem, fit)
        probability_clause = f"probability {probability_text(probability)}"
        sentence = f"The model lacks {effects_text(effects)} ({probability_clause})."
        absolute_fit = gates[0]
        if not absolute_fit.passed:
            sentence += f" {absolute_fit.reason}"
        return self.build_outcome(
            VerdictKind.NAMED,
            sentence,
            probability,
            fit,
            effects=effects,
            gates=gates,
            remainders=remainders,
        )

    def build_family_outcome(
        self, fit: CandidateFit, probability: float, gates: tuple[Gate, ...]
    ) -> VerdictOutcome:
        """Return the verdict that names the family of a law that was fitted with a free shape.

        Parameters
        ----------
        fit : CandidateFit
            The fit of a hypothesis to all trials.
        probability : float
            The probability of the set.
        gates : tuple of Gate
            The outcomes of the tests.
        """
        fit_with_draws = with_draws(self.search.problem, fit)
        effects = named_effects(self.search.problem, fit_with_draws)
        free_terms = [term for term in fit.candidate.terms if term.free_shape]
        family = ", ".join(sorted({term.effect.family for term in free_terms}))
        sentence = curve_sentence(self.search.problem, effects, probability)
        if not sentence:
            other_names = ", ".join(effect.name for effect in effects if not effect.shape)
            beside_clause = f", beside {other_names}" if other_names else ""
            sentence = (
                f"An effect of the family {family} is missing, with a fitted shape{beside_clause} "
                f"(probability {probability_text(probability)})."
            )
        return self.build_outcome(
            VerdictKind.FAMILY,
            sentence,
            probability,
            fit_with_draws,
            effects=effects,
            family=family,
            gates=gates,
        )


def curve_sentence(problem: Problem, effects: Sequence[NamedEffect], probability: float) -> str:
    """Return the sentence on a force of free shape; empty if the effects are something else.

    Parameters
    ----------
    problem : Problem
        The campaign and the model.
    effects : sequence of NamedEffect
        The effects of a hypothesis at their most probable values.
    probability : float
        The probability of the hypothesis.
    """
    curve = curve_of(effects)
    if curve is None:
        return ""
    force_unit, _ = problem.model.port_units(curve.port)
    return (
        f"A force that follows the {followed_variable(curve)} is missing at {curve.port} "
        f"(probability {probability_text(probability)}), and no law of the catalogue has its "
        f"shape: {curve_in_words(curve, force_unit)}."
    )


# ---------------------------------------------------------------- records of hypotheses


def names_without_free_shape(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return identifiers of effects without the suffix `FREE_SHAPE`."""
    return tuple(name.removesuffix(FREE_SHAPE) for name in names)


def hypothesis_record(
    problem: Problem, hypothesis: ComparedHypothesis, probability: float
) -> Hypothesis:
    """Return the record of a hypothesis for the verdict.

    χ² and its degrees of freedom are nan for a hypothesis that was fitted to the missing force, as
    no readings are compared then.
    """
    chi_square = nan
    freedom = nan
    if isinstance(hypothesis, CandidateFit):
        chi_square = hypothesis.chi_square
        freedom = float(problem.sample_counts.sum() - hypothesis.absorbed_freedom.sum())
    return Hypothesis(
        effects=named_effects(problem, hypothesis),
        log_evidence=hypothesis.log_evidence,
        probability=probability,
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        parameters=calibrated_parameters(problem, hypothesis),
    )


def named_effects(problem: Problem, hypothesis: ComparedHypothesis) -> tuple[NamedEffect, ...]:
    """Return the effects of a hypothesis with the values and 90 % intervals of their parameters.

    Intervals are those of the posterior draws if the fit has any, else of its covariance.
    """
    low, high = _intervals(hypothesis, np.eye(hypothesis.candidate.parameter_count))
    first_parameter = 0
    effects = []
    for term, values in hypothesis.candidate.split_by_term(hypothesis.effect):
        parameter_count = len(term.effect.parameters)
        estimates = []
        if term.effect.table is not None:
            estimates = _forces_of_table(problem, term.place, hypothesis, term.effect.table)
            parameter_count = len(estimates)
        else:
            for number, parameter in enumerate(term.parameters, start=first_parameter):
                bounds = (float(low[number]), float(high[number]))
                estimates.append(_estimate(parameter, float(hypothesis.effect[number]), bounds))
        first_parameter += len(term.parameters)
        effects.append(
            NamedEffect(
                identifier=term.effect.identifier,
                name=term.effect.name,
                place=term.place,
                family=term.effect.family,
                parameters=tuple(estimates[:parameter_count]),
                shape=tuple(estimates[parameter_count:]),
                patch=term.patch(problem.setting, values),
            )
        )
    return tuple(effects)


def _forces_of_table(
    problem: Problem, port: str, hypothesis: ComparedHypothesis, table: ForceTable
) -> list[ParameterEstimate]:
    """Return the forces of a curve of free shape at some of its points, with 90 % intervals.

    Parameters
    ----------
    problem : Problem
        The campaign and the model.
    port : str
        The port of the curve.
    hypothesis : ComparedHypothesis
        The hypothesis, of which the curve is the only effect.
    table : ForceTable
        The curve, as functions of which the hypothesis has the amplitudes.
    """
    functions = table.functions[::TOLD_POINT]
    forces = functions @ hypothesis.effect
    low, high = _intervals(hypothesis, functions)
    force_unit, motion_unit = problem.model.port_units(port)
    unit = motion_unit if table.variable == "displacement" else f"{motion_unit}/s"
    estimates = []
    for number, point in enumerate(table.points[::TOLD_POINT].tolist()):
        estimates.append(
            ParameterEstimate(
                name=f"force_at_{point:.3g}",
                value=float(forces[number]),
                low=float(low[number]),
                high=float(high[number]),
                unit=force_unit,
                description=f"force at a {table.variable} of {point:.3g} {unit}",
            )
        )
    return estimates


def _intervals(
    hypothesis: ComparedHypothesis, functions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper ends (F,) of 90 % intervals of what is linear in the parameters.

    Parameters
    ----------
    hypothesis : ComparedHypothesis
        The hypothesis with the posterior of its E scaled effect parameters.
    functions : (F, E) array
        What each quantity changes by for a unit of each parameter.
    """
    most_probable = functions @ hypothesis.effect
    if isinstance(hypothesis, CandidateFit) and hypothesis.draws is not None:
        low, high = np.quantile(hypothesis.draws @ functions.T, (0.05, 0.95), axis=0)
        # the most probable value may lie outside of the quantiles, and is included
        return np.minimum(low, most_probable), np.maximum(high, most_probable)
    first_effect = len(hypothesis.shared)
    covariance = hypothesis.covariance[first_effect:, first_effect:]
    variances = np.sum((functions @ covariance) * functions, axis=1)
    half_width = NINETY_PERCENT_QUANTILE * np.sqrt(variances)
    return most_probable - half_width, most_probable + half_width


def _estimate(
    parameter: EffectParameter | ShapeParameter,
    scaled_value: float,
    scaled_ends: tuple[float, float],
) -> ParameterEstimate:
    """Return the estimate of a parameter in its unit.

    Parameters
    ----------
    parameter : EffectParameter or ShapeParameter
        The parameter, whose prior maps scaled to physical values.
    scaled_value : float
        The value on the scale on which the prior is standard normal.
    scaled_ends : tuple of float
        The ends of its scaled 90 % interval.
    """
    ends = [parameter.prior.value(scaled_end) for scaled_end in scaled_ends]
    return ParameterEstimate(
        name=parameter.name,
        value=parameter.prior.value(scaled_value),
        low=min(ends),
        high=max(ends),
        unit=parameter.unit,
        description=parameter.description,
    )


def calibrated_parameters(
    problem: Problem, hypothesis: ComparedHypothesis
) -> tuple[CalibratedParameter, ...]:
    """Return the values and standard deviations of the model's parameters under a hypothesis.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, whose parameters were calibrated together with the effects.
    hypothesis : ComparedHypothesis
        The hypothesis with the posterior of its scaled unknowns. The first of them are those of the
        parameters.
    """
    layout = problem.shared
    # physical values, limited to the ranges of the parameters
    values = layout.parameters(hypothesis.shared)
    # standard deviations: a scaled unknown is multiplied by its scale
    scaled_variances = np.diag(hypothesis.covariance)[: layout.parameter_count]
    scaled_deviations = np.sqrt(np.maximum(scaled_variances, 0.0))
    deviations = layout.scale[: layout.parameter_count] * scaled_deviations
    parameter_records = []
    for parameter, value, deviation in zip(
        problem.model.parameters, values, deviations, strict=True
    ):
        if parameter.name in problem.model.nuisance_parameters:
            continue
        parameter_records.append(
            CalibratedParameter(parameter.name, float(value), float(deviation), parameter.unit)
        )
    return tuple(parameter_records)


# ---------------------------------------------------------------- words


def effects_text(effects: Iterable[NamedEffect]) -> str:
    """Return effects with their places in words, such as "friction at slide and gain at g1".

    A law whose shape was fitted is called by its family, with the shape in brackets.
    """
    texts = []
    for effect in effects:
        text = effect.name
        if effect.shape:
            shape = ", ".join(
                f"{item.name.replace('_', ' ')} {item.value:.2g}" for item in effect.shape
            )
            text = f"a law of the family {effect.family} ({shape})"
        texts.append(f"{text} at {effect.place}" if effect.place else text)
    return listing(dict.fromkeys(texts))


def probability_text(probability: float) -> str:
    """Return a probability as text that is never rounded to one or to zero."""
    if isnan(probability):
        return "not known"
    if probability > 0.9995:
        return "> 0.999"
    if probability < 5e-4:
        return f"{probability:.0e}" if probability > 1e-99 else "< 1e-99"
    return f"{probability:.3f}"


def below_limit_sentence(names: Sequence[str], noise_clause: str = "") -> str:
    """Return the sentence that effects may be missing, but are too small to be detected.

    Parameters
    ----------
    names : sequence of str
        The identifiers of the effects. The first four are mentioned in the sentence.
    noise_clause : str
        A clause on the noise, such as " that is coloured".
    """
    nearest_clause = f"; the nearest are {', '.join(names[:4])}" if names else ""
    return (
        "Something may be missing, but it is too small for these data to distinguish from "
        f"noise{noise_clause}{nearest_clause}."
    )


LEAST_INSTRUMENT_ERROR = 1e-3
"""Relative size of a gain, tare or clock error below which it is not named, as any instrument has
errors of this size."""
LEAST_UNSTATED_GAIN = 1e-2
"""The same for the gain of a channel without a stated deviation, if laws alone explain as much. A
gain is never exact, even if the campaign states no deviation."""


def has_one_driven_channel(problem: Problem) -> bool:
    """Return whether all trials of a campaign have a recorded drive, and there is only one channel.

    An error of that channel cannot then be told from a change of the model's parameters.
    """
    driven_kinds = (TrialKind.DRIVEN, TrialKind.FORCED)
    is_driven = all(trial.kind in driven_kinds for trial in problem.campaign.trials)
    return is_driven and len(problem.channel_names) == 1


def is_negligible_instrument_error(
    problem: Problem, patch: ModelPatch, *, least_unstated_gain: float = LEAST_INSTRUMENT_ERROR
) -> bool:
    """Return whether a change consists of errors of instruments that are too small to be named.

    Parameters
    ----------
    problem : Problem
        The campaign and model, whose scales make the sizes relative.
    patch : ModelPatch
        The change of the model by an effect.
    least_unstated_gain : float
        The least size of a gain of a channel without a stated deviation.
    """
    ratios = []
    for primitive in patch:
        size = _instrument_error(problem, primitive)
        if size is None:
            return False
        least_named_size = LEAST_INSTRUMENT_ERROR
        if isinstance(primitive, SensorGain) and _has_exact_gain(problem, primitive):
            least_named_size = least_unstated_gain
        ratios.append(size / least_named_size)
    # an empty change is not an error of instruments
    return max(ratios, default=1.0) < 1.0


def _has_exact_gain(problem: Problem, gain: SensorGain) -> bool:
    """Return whether a campaign states no uncertainty of the gain of a channel."""
    channel = problem.campaign.channels.get(gain.channel)
    return channel is not None and channel.gain_deviation == 0.0


def _instrument_error(problem: Problem, primitive: Primitive) -> float | None:
    """Return the relative size of an error of an instrument; None for other primitives."""
    scales = problem.setting.scales
    if isinstance(primitive, LoadGain):
        tare = abs(primitive.tare) / scales.force if scales.force > 0.0 else 0.0
        return max(abs(primitive.gain), tare)
    if isinstance(primitive, SensorGain):
        return abs(primitive.gain)
    if isinstance(primitive, Clock):
        return max(abs(primitive.rate), abs(primitive.zero) * scales.angular_frequency)
    return None
