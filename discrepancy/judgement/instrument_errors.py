"""Errors of instruments that a verdict does not name.

They are too small, or cannot be distinguished from a change of the model's parameters.
"""

from dataclasses import replace

from discrepancy.campaign.records import TrialKind
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.system.structure_unknowns import MESH_DEVIATION
from discrepancy.verdict import Verdict, VerdictKind
from fe.runtime.patch import (
    READ_PLACES,
    SENSORS,
    Clock,
    LoadGain,
    ModelPatch,
    Primitive,
    SensorGain,
)

from .comparison import Comparison, HypothesisT
from .proof import check_held_out

INSTRUMENT_PRIMITIVES = (LoadGain, *READ_PLACES, *SENSORS)
"""Primitives that describe errors of instruments."""

LEAST_INSTRUMENT_ERROR = 1e-3
"""Relative gain, tare or clock error below which it is not named, as any instrument has errors like
that; on a mesh, see `_least_named_error`."""
LEAST_UNSTATED_GAIN = 1e-2
"""The same for the gain of a channel without a stated deviation, if laws alone explain as much. A
gain is never exact, even if the campaign states no deviation."""


def has_one_driven_channel(problem: Problem) -> bool:
    """Return whether all trials of a campaign have a recorded drive, and there is only one channel.

    An error of that channel cannot then be distinguished from a change of the model's parameters.
    """
    driven_kinds = (TrialKind.DRIVEN, TrialKind.FORCED)
    is_driven = all(trial.kind in driven_kinds for trial in problem.campaign.trials)
    return is_driven and len(problem.channel_names) == 1


def _least_named_error(problem: Problem, primitive: Primitive) -> float:
    """Return the relative error of an instrument below which it is not named.

    On a mesh it is larger: an error of a frequency by the mesh shifts phases as a clock does, and
    the mesh causes errors of readings as a gain does.
    """
    if not problem.model.nuisance_parameters:
        return LEAST_INSTRUMENT_ERROR
    return MESH_DEVIATION if isinstance(primitive, Clock) else SEARCH.mesh_error


def is_negligible_instrument_error(
    problem: Problem, patch: ModelPatch, *, least_unstated_gain: float = LEAST_INSTRUMENT_ERROR
) -> bool:
    """Return whether a change consists of errors of instruments that are too small to be named.

    Parameters
    ----------
    least_unstated_gain : float
        The relative gain error below which a gain is too small, for a channel without a stated
        deviation.
    """
    ratios = []
    for primitive in patch:
        error = _relative_instrument_error(problem, primitive)
        if error is None:
            return False
        least_named_error = _least_named_error(problem, primitive)
        if isinstance(primitive, SensorGain) and _has_exact_gain(problem, primitive):
            least_named_error = max(least_unstated_gain, least_named_error)
        ratios.append(error / least_named_error)
    # an empty change is not an error of instruments
    return max(ratios, default=1.0) < 1.0


def _has_exact_gain(problem: Problem, gain: SensorGain) -> bool:
    """Return whether a campaign states no uncertainty of the gain of a channel."""
    channel = problem.campaign.channels.get(gain.channel)
    return channel is not None and channel.gain_deviation == 0.0


def _relative_instrument_error(problem: Problem, primitive: Primitive) -> float | None:
    """Return the relative error that a primitive gives an instrument; None for other primitives."""
    scales = problem.setting.scales
    if isinstance(primitive, LoadGain):
        tare = abs(primitive.tare) / scales.force if scales.force > 0.0 else 0.0
        return max(abs(primitive.gain), tare)
    if isinstance(primitive, SensorGain):
        return abs(primitive.gain)
    if isinstance(primitive, Clock):
        return max(abs(primitive.rate), abs(primitive.zero) * scales.angular_frequency)
    return None


def verdict_rejecting_instruments(
    comparison: Comparison[HypothesisT], verdict: Verdict
) -> Verdict | None:
    """Return the verdict that rejects named errors of instruments; None if they may be the cause.

    There are two reasons to reject them. The errors may be so small that any instrument has them,
    or that a mesh causes as much.
    Or they may only serve to keep calibrated parameters within their priors: with one channel and a
    recorded drive, a gain has the same effect as all parameters of a linear model together. If the
    model without effect predicts held-out trials, nothing but these priors supports the gain.
    """
    if verdict.kind not in (VerdictKind.NAMED, VerdictKind.GROUP):
        return None
    problem = comparison.problem
    search = comparison.search
    without_name = replace(verdict, effects=(), group=())
    causes = " or ".join(dict.fromkeys(effect.name for effect in verdict.effects))
    # reason 1: errors that any instrument has, or that a mesh causes
    if all(is_negligible_instrument_error(problem, effect.patch) for effect in verdict.effects):
        limit = max(
            _least_named_error(problem, primitive)
            for effect in verdict.effects
            for primitive in effect.patch
        )
        source = "the mesh" if problem.model.nuisance_parameters else "the instruments"
        sentence = (
            f"Nothing is missing but {causes} below {100.0 * limit:g} % of the quantity, which is "
            f"an ordinary error of {source} and is not named."
        )
        return replace(
            without_name, kind=VerdictKind.NOTHING_MISSING, sentence=sentence, reasons=""
        )
    # reason 2: a gain that only keeps calibrated parameters within their priors
    if not has_one_driven_channel(problem) or not problem.campaign.held_out:
        return None
    if not _are_instrument_errors_with_gain(verdict):
        return None
    if not check_held_out(search.residuals(search.no_effect)).passed:
        return None
    sentence = (
        "The model predicts held-out trials as it is, but with calibrated parameters outside "
        f"the range that was stated{_implausible_parameters_clause(search)}."
    )
    reasons = (
        f"An error of the instruments ({causes}) would explain the readings as well: with one "
        "channel, these data cannot distinguish the two."
    )
    resembles = tuple(dict.fromkeys(effect.identifier for effect in verdict.effects))
    return replace(
        without_name,
        kind=VerdictKind.UNEXPLAINED,
        sentence=sentence,
        reasons=reasons,
        resembles=resembles,
    )


def _are_instrument_errors_with_gain(verdict: Verdict) -> bool:
    """Return whether a verdict names only errors of instruments, and among them a wrong gain."""
    has_gain = False
    for effect in verdict.effects:
        for primitive in effect.patch:
            if not isinstance(primitive, INSTRUMENT_PRIMITIVES):
                return False
            if isinstance(primitive, LoadGain | SensorGain):
                has_gain = True
    return has_gain


def _implausible_parameters_clause(search: Search) -> str:
    """Return the parameters that the fit without effect moves far from their priors, in brackets.

    The clause begins with a blank; it is empty if there are no such parameters.
    """
    parameters = search.problem.model.parameters
    # the scaled unknowns are the parameters, in prior deviations, and then the gains of channels
    scaled_values = search.no_effect.point.shared[: len(parameters)]
    texts = []
    for parameter, scaled_value in zip(parameters, scaled_values, strict=True):
        if abs(scaled_value) > SEARCH.reported_prior_deviations:
            texts.append(f"{parameter.name!r} {abs(scaled_value):.1f}")
    return f" ({', '.join(texts)} stated deviations off)" if texts else ""


def notable_terms(comparison: Comparison[HypothesisT], fit: CandidateFit) -> set[tuple[str, str]]:
    """Return the effects of a fit that deserve a name of their own, as pairs (label, place).

    Two kinds of effects are left out:

    - Errors of instruments that are too small to be named.
    - All errors of readings, if the campaign has a single channel under a recorded drive. A gain of
      that channel scales the whole response, as a change of the model's parameters would, so the
      readings cannot show which of the two it is.
    """
    problem = comparison.problem
    has_one_channel = has_one_driven_channel(problem)
    patches = fit.candidate.patches(problem.setting, fit.effect)
    notable_keys = set()
    for term, patch in zip(fit.candidate.terms, patches, strict=True):
        if is_negligible_instrument_error(problem, patch, least_unstated_gain=LEAST_UNSTATED_GAIN):
            continue
        is_error_of_readings = not comparison.acts_on_structure(term)
        if is_error_of_readings and has_one_channel:
            continue
        notable_keys.add((term.label, term.place))
    return notable_keys
