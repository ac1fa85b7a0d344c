"""Remarks beside a verdict: strained priors, and effects that were not tested or fitted."""

from collections.abc import Sequence
from math import isnan, nan, pi

from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.catalogue.needs import NO_PORT
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.structures import StructureModel
from discrepancy.system.system_state import SystemState
from discrepancy.verdict import NotFitted
from reporting.words import listing

IMPLAUSIBLE_DEVIATIONS = 4.0
"""Least distance from the prior mean, in prior deviations, of a parameter that is remarked on."""


def implausible_value_remarks(problem: Problem, fit: CandidateFit) -> list[str]:
    """Return a remark on each calibrated parameter and gain that a fit moves far from its prior.

    An implausible value of a parameter or gain can explain what the model lacks. Nothing then
    remains in the residuals, so that only this remark shows it: the test of absolute fit judges all
    gains together and all parameters together, and not each of them.
    """
    names = [f"The parameter {parameter.name!r}" for parameter in problem.model.parameters]
    names += [f"The gain of the channel {name!r}" for name in problem.shared.gain_channels]
    values = fit.point.shared.tolist()  # in prior standard deviations
    precisions = problem.shared.precision.tolist()
    remarks = []
    for subject, value, precision in zip(names, values, precisions, strict=True):
        if precision > 0.0 and abs(value) > IMPLAUSIBLE_DEVIATIONS:
            remarks.append(
                f"{subject} differs from its stated value by {abs(value):.1f} stated standard "
                "deviations in the hypothesis of the verdict, which depends on this standard "
                "deviation: check it."
            )
    return remarks


def missing_port_remark(setting: Setting, effects: Sequence[Effect]) -> list[str]:
    """Return the remark on effects that were not tested because the model has no port.

    The list is empty if there is no such effect.
    """
    names = [effect.name for effect in effects if NO_PORT in (effect.unavailable(setting) or "")]
    if not names:
        return []
    example = ""
    model = setting.model
    if isinstance(model, LumpedModel) and model.description.input:
        load = model.description.input[0]
        vector = ", ".join(f"{value:g}" for value in load.vector)
        example = f", such as vector = [{vector}] between the ground and {load.name!r}"
    return [
        f"Not tested for lack of a port: {listing(names)}; declare a [[port]] in the model's "
        f"file{example} where such a force may act."
    ]


def left_out_modes_remark(problem: Problem) -> str | None:
    """Return the remark that records may show higher modes than a reduced model has; else None.

    A reduced model lets the modes that it leaves out follow the loads at once; in the structure
    they ring. The frequencies are those at the prior means of the parameters.
    """
    model = problem.model
    intervals = [data.trial.interval for data in problem.trials if data.trial.is_dynamic]
    if not isinstance(model, StructureModel) or not intervals:
        return None
    state = SystemState(tuple(model.prior_mean().tolist()))
    frequencies = model.build_system(state).angular_frequency / (2.0 * pi)
    sampled_frequency = 0.5 / min(intervals)
    if sampled_frequency <= frequencies.max():
        return None
    return (
        f"The reduced model has {len(frequencies)} modes up to {frequencies.max():.4g} Hz, and the "
        f"records are sampled for up to {sampled_frequency:.4g} Hz: if higher modes ring in them, "
        "state more modes in [reduction] of the structure file."
    )


def effects_not_fitted(
    setting: Setting, effects: Sequence[Effect], search: Search
) -> tuple[NotFitted, ...]:
    """Return the effects of a catalogue that were not fitted, each with the reason.

    The reason is that the effect is not available in this setting, could not be fitted, seemed less
    promising than others, or was screened out; only then its gain is a number.
    """
    # identifiers of effects that were fitted to the missing force, and of all that were fitted
    fitted_to_force: set[str] = set()
    for estimate in search.force_estimates:
        fitted_to_force.update(term.effect.identifier for term in estimate.candidate.terms)
    fitted = search.fitted_effects() | fitted_to_force
    not_fitted = []
    for effect in effects:
        identifier = effect.identifier
        unavailable = effect.unavailable(setting)
        if unavailable is not None:
            not_fitted.append(NotFitted(identifier, unavailable))
        elif identifier not in fitted:
            gain = search.screened_gains.get(identifier, nan)
            refusal = search.problem.refusals.get(identifier)
            if refusal is not None and not 0.0 < gain < SEARCH.least_gain_to_fit:
                reason = f"could not be fitted: {refusal}"
            elif isnan(gain):
                comparison = "along the missing force" if fitted_to_force else "at first sight"
                reason = f"less promising than others {comparison}"
            else:
                reason = f"screened out: at most {gain:.1f} nat more than the unchanged model"
            not_fitted.append(NotFitted(identifier, reason, gain))
    return tuple(not_fitted)
