"""Verdicts if the residuals of a fit are coloured noise as in the noise records, and nothing else.

Coloured noise is correlated in time.
"""

from dataclasses import replace

from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, RemainderEstimate, VerdictKind

from .conclusion import (
    Conclusion,
    VerdictOutcome,
    below_limit_sentence,
)
from .consistency_gate import check_consistency
from .proof import check_held_out
from .simulation_comparison import SimulationComparison


def verdict_under_coloured_noise(comparison: SimulationComparison) -> VerdictOutcome | None:
    """Return the verdict if the residuals of a fit are coloured noise as in the noise records.

    The fit is that without effect, or that of the best hypothesis. None is returned if neither
    leaves such noise alone, or if the best hypothesis may not be named.
    """
    problem = comparison.problem
    search = comparison.search
    best_fit = search.best()
    no_effect = search.compared_no_effect
    probabilities = search.set_probabilities()
    conclusion = Conclusion.from_probabilities(search, best_fit, probabilities)
    # the model without effect
    no_effect_gate = check_absolute_fit(problem, no_effect)
    probability_of_none = probabilities.get((), 0.0)
    may_lack_nothing = probability_of_none > 1.0 - SEARCH.name_probability
    if (
        may_lack_nothing
        and not no_effect_gate.has_failed
        and _residuals_have_recorded_colour(no_effect)
    ):
        return _nothing_missing_outcome(conclusion, no_effect, no_effect_gate, probability_of_none)
    # the best hypothesis
    if (
        not best_fit.candidate.terms
        or best_fit.candidate.has_free_shape
        or not _residuals_have_recorded_colour(best_fit)
    ):
        return None
    probability = comparison.probability(best_fit)
    held_out_residuals = comparison.search.residuals(replace(best_fit, residual_process=None))
    gates = (
        check_absolute_fit(problem, best_fit),
        check_consistency(problem, best_fit),
        check_held_out(held_out_residuals),
    )
    if probability < SEARCH.name_probability or any(gate.has_failed for gate in gates):
        return None
    return conclusion.build_named_outcome(
        best_fit, probability, gates, remainder_estimates(problem, best_fit)
    )


def _nothing_missing_outcome(
    conclusion: Conclusion, no_effect: CandidateFit, gate: Gate, probability_of_none: float
) -> VerdictOutcome:
    """Return the verdict that nothing is missing, or that it is too small to be detected.

    Parameters
    ----------
    conclusion : Conclusion
        The hypotheses with their probabilities.
    no_effect : CandidateFit
        The fit without effect, whose residuals are coloured noise.
    gate : Gate
        The test of absolute fit of that fit.
    probability_of_none : float
        The probability that no effect is missing.
    """
    remainders = remainder_estimates(conclusion.search.problem, no_effect)
    if probability_of_none >= SEARCH.inconclusive_probability:
        return conclusion.build_outcome(
            VerdictKind.NOTHING_MISSING,
            "The model explains the data within their noise, which is coloured as its records "
            "admit.",
            probability_of_none,
            no_effect,
            gates=(gate,),
            remainders=remainders,
        )
    # effects that are too probable to be excluded
    possible_effects = []
    for name, probability in conclusion.inclusion_probabilities.items():
        if probability > 1.0 - SEARCH.name_probability:
            possible_effects.append(name)
    possible_effects.sort()
    return conclusion.build_outcome(
        VerdictKind.BELOW_LIMIT,
        below_limit_sentence(possible_effects, " that is coloured"),
        probability_of_none,
        no_effect,
        group=tuple(possible_effects),
        gates=(gate,),
        remainders=remainders,
    )


def _residuals_have_recorded_colour(fit: CandidateFit) -> bool:
    """Return whether all residuals of a fit are noise, correlated as in the noise records."""
    process = fit.residual_process
    return process is not None and process.is_all_recorded_colour


def remainder_estimates(problem: Problem, fit: CandidateFit) -> tuple[RemainderEstimate, ...]:
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
