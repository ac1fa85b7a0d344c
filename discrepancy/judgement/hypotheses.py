"""Hypotheses as a verdict lists and describes them: their effects, with values and intervals."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import isfinite, isnan, nan
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import (
    NINETY_PERCENT_QUANTILE,
    EffectParameter,
    ForceTable,
    ShapeParameter,
)
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.search.fitted_candidates import ComparedHypothesis
from discrepancy.search.strategy import Search
from discrepancy.verdict import (
    FREE_SHAPE,
    CalibratedParameter,
    Hypothesis,
    NamedEffect,
    ParameterEstimate,
    RemainderEstimate,
    Verdict,
)
from fe.runtime.patch import SensorGain
from reporting.words import between, listing, rounded

from .curve_words import curve_in_words, curve_of, followed_variable_text

UNEXPLAINED_GAP = "Something is missing that no effect of the catalogue explains."
"""The conclusion on a gap of which neither a law nor a force is known."""
POINT_STRIDE = 6
"""A verdict lists every sixth point of a table of forces."""


class VerdictOutcome(NamedTuple):
    """A verdict, the search on which it is based, and the fit that represents it.

    The fit is that of the effects that the verdict is about: the named set or family, the most
    probable member of a group, the best hypothesis on an unexplained gap, or effects too small to
    be detected. Without such effects it is the fit without effect.
    """

    verdict: Verdict
    search: Search
    fit: CandidateFit


class WeightedHypothesis(NamedTuple):
    """A hypothesis and its probability among those compared."""

    hypothesis: ComparedHypothesis
    probability: float


def outcome_with_hypotheses(
    verdict: Verdict, search: Search, fit: CandidateFit, hypotheses: Sequence[WeightedHypothesis]
) -> VerdictOutcome:
    """Return a verdict together with the hypotheses of its search, and what its fit leaves.

    The probability that each effect of the catalogue is one of the missing ones is added, too.

    Parameters
    ----------
    verdict : Verdict
        The verdict without hypotheses.
    fit : CandidateFit
        The fit that represents the verdict.
    hypotheses : sequence of WeightedHypothesis
        The hypotheses with their probabilities, in the order in which they are listed.
    """
    inclusion = {effect.identifier: 0.0 for effect in search.effects}
    for hypothesis, probability in hypotheses:
        for identifier in set(names_without_free_shape(hypothesis.candidate.identifiers)):
            if identifier in inclusion:
                inclusion[identifier] += probability
    records = [
        hypothesis_record(search.problem, hypothesis, probability)
        for hypothesis, probability in hypotheses
    ]
    complete_verdict = replace(
        verdict,
        hypotheses=tuple(records),
        inclusion=inclusion,
        remainders=_remainder_estimates(search.problem, fit),
    )
    return VerdictOutcome(complete_verdict, search, fit)


def curve_sentence(problem: Problem, effects: Sequence[NamedEffect], probability: float) -> str:
    """Return the sentence on a force of free shape; empty if the effects are something else.

    Parameters
    ----------
    effects : sequence of NamedEffect
        The effects of a hypothesis at their most probable values.
    """
    curve = curve_of(effects)
    if curve is None:
        return ""
    force_unit, _ = problem.model.port_units(curve.port)
    return (
        f"A {followed_variable_text(effects[0])} is missing at {curve.port} "
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

    Intervals are those of the posterior draws if the fit has any, else of its covariance. A
    parameter with a single level is left out if it changes nothing at the place.
    """
    low, high = _intervals(hypothesis, np.eye(hypothesis.candidate.parameter_count))
    first_parameter = 0
    effects = []
    for term, values in hypothesis.candidate.split_by_term(hypothesis.effect):
        parameter_count = 0
        estimates = []
        if term.effect.table is not None:
            estimates = _forces_of_table(problem, term.place, hypothesis, term.effect.table)
            parameter_count = len(estimates)
        else:
            for index, parameter in enumerate(term.parameters):
                number = first_parameter + index
                # such as the distance of a mass from a set of nodes, beside which none can lie
                if parameter.levels == 1 and not term.depends_on(problem.setting, values, index):
                    continue
                if index < len(term.effect.parameters):
                    parameter_count += 1
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

    The curve is the only effect of the hypothesis. It is a sum of functions, and the effect
    parameters of the hypothesis are their amplitudes.
    """
    functions = table.functions[::POINT_STRIDE]
    forces = functions @ hypothesis.effect
    low, high = _intervals(hypothesis, functions)
    force_unit, motion_unit = problem.model.port_units(port)
    unit = f"{motion_unit}/s" if table.variable == "velocity" else motion_unit
    kind = "flow" if table.variable == "state" else "force"
    estimates = []
    for number, point in enumerate(table.points[::POINT_STRIDE].tolist()):
        estimates.append(
            ParameterEstimate(
                name=f"{kind}_at_{point:.3g}_{unit}",
                value=float(forces[number]),
                low=float(low[number]),
                high=float(high[number]),
                unit=force_unit,
                description=f"{kind} at a {table.variable} of {point:.3g} {unit}",
            )
        )
    return estimates


def _intervals(
    hypothesis: ComparedHypothesis, functions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the ends (F,) of 90 % intervals of F linear functions of the effect parameters.

    Parameters
    ----------
    hypothesis : ComparedHypothesis
        The hypothesis with the posterior of its E scaled effect parameters.
    functions : (F, E) array
        The coefficients of the parameters in each function.
    """
    most_probable = functions @ hypothesis.effect
    if isinstance(hypothesis, CandidateFit) and hypothesis.draws is not None:
        low, high = np.quantile(hypothesis.draws @ functions.T, (0.05, 0.95), axis=0)
        # the most probable value may lie outside of the quantiles, and is included
        return np.minimum(low, most_probable), np.maximum(high, most_probable)
    if isinstance(hypothesis, CandidateFit):
        covariance = hypothesis.whole_effect_covariance
    else:
        covariance = hypothesis.covariance[len(hypothesis.shared) :, len(hypothesis.shared) :]
    variances = np.sum((functions @ covariance) * functions, axis=1)
    half_width = NINETY_PERCENT_QUANTILE * np.sqrt(variances)
    return most_probable - half_width, most_probable + half_width


def _estimate(
    parameter: EffectParameter | ShapeParameter,
    scaled_value: float,
    scaled_ends: tuple[float, float],
) -> ParameterEstimate:
    """Return the estimate of a parameter in its unit, given its value and interval as scaled."""
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


def _remainder_estimates(problem: Problem, fit: CandidateFit) -> tuple[RemainderEstimate, ...]:
    """Return the residual process of each channel whose residuals are more than noise."""
    process = fit.residual_process
    if process is None:
        return ()
    estimates = []
    for channel, name in enumerate(problem.channel_names):
        amplitude = float(process.amplitude[channel])
        if amplitude > 0.0:
            correlation_time = float(process.correlation_time[channel])
            frequency = float(process.frequency[channel])
            estimates.append(RemainderEstimate(name, amplitude, correlation_time, frequency))
    return tuple(estimates)


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
        texts.append(f"{text} at {effect.place_in_words}" if effect.place else text)
    return listing(dict.fromkeys(texts))


def missing_clause(effects: Sequence[NamedEffect]) -> str:
    """Return a clause on the effects that the model lacks, and the sensors with a wrong gain.

    It is such as "the model lacks friction at slide and the channel g1 shows 3.1 % (2.8 to 3.4) too
    much", with a 90 % interval in brackets.
    """
    clauses = []
    lacking_effects = [effect for effect in effects if not is_gain_error(effect)]
    if lacking_effects:
        clauses.append(f"the model lacks {effects_text(lacking_effects)}")
    for effect in effects:
        if is_gain_error(effect):
            clauses.append(gain_error_text(effect.place, effect.parameters[0]))
    return listing(clauses)


def group_sentence(effects_by_member: Iterable[Sequence[NamedEffect]], probability: float) -> str:
    """Return the sentence that one of several sets of effects explains what is missing.

    Parameters
    ----------
    effects_by_member : iterable of sequence of NamedEffect
        The effects of each set, the most probable one first.
    probability : float
        The probability that one of them does.
    """
    members = [*effects_by_member]
    explanation = f"Either {listing(map(missing_clause, members), 'or')}"
    if not any(is_gain_error(effect) for effects in members for effect in effects):
        explanation = f"The model lacks either {listing(map(effects_text, members), 'or')}"
    return (
        f"{explanation} (probability {probability_text(probability)}): these data cannot tell "
        "which."
    )


def is_gain_error(effect: NamedEffect) -> bool:
    """Return whether an effect is a wrong gain of one channel."""
    primitives = [*effect.patch]
    return len(primitives) == 1 and isinstance(primitives[0], SensorGain) and bool(effect.place)


def gain_error_text(channel: str, gain: ParameterEstimate) -> str:
    """Return how much too much or too little a channel shows, in percent with its 90 % interval."""
    magnitude = 100.0 * abs(gain.value)
    low, high = sorted((100.0 * abs(gain.low), 100.0 * abs(gain.high)))
    half_width = 50.0 * (gain.high - gain.low)
    interval = ""
    if isfinite(half_width) and gain.low * gain.high > 0.0:
        interval = f" ({between(low, high, half_width)})"
    side = "much" if gain.value > 0.0 else "little"
    return f"the channel {channel} shows {rounded(magnitude, half_width)} %{interval} too {side}"


def probability_text(probability: float) -> str:
    """Return a probability as text that is never rounded to one or to zero."""
    if isnan(probability):
        return "not known"
    if probability > 0.9995:
        return "> 0.999"
    if probability < 5e-4:
        return f"{probability:.0e}" if probability > 1e-99 else "< 1e-99"
    return f"{probability:.3f}"
