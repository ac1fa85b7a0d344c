"""The screen of effects: how well each, added alone to an estimate, explains the missing force.

The motion of the estimate is taken as known. An effect is then a column of a linear model, and the
factor on it is one more unknown. One pass of a filter serves the columns of all effects.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.special import erf

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.errors import DiscrepancyError, ModelError
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.trials_in_motion.effects import EffectLaws
from discrepancy.trials_in_motion.laws import LawForce
from discrepancy.trials_in_motion.trajectory import (
    LawArguments,
    LinearisedForce,
    LinearisedSensorErrors,
)
from fe.runtime.errors import InvalidPatchError
from reporting.arrays import LEAST_DIVISOR

from .estimate import Estimate
from .estimator import NARROWEST_WINDOW
from .filtered import SmoothedTrial
from .force_search import ForceSearch
from .linearisation import Linearisation
from .linearised import LinearisedTrial
from .linearised_rest import LinearisedRest
from .ported_problem import WIDE_WINDOW
from .process_search import Processes, processes_within_range, scale_processes
from .regression import Priors

SHAPE_VALUES = (-1.3, -0.4, 0.4, 1.3)
"""Standard normal values at which a parameter that is not a magnitude is tried."""
MOST_COMBINATIONS = 16
"""Largest number of combinations of parameter values at which an effect is tried."""
MAGNITUDE_VALUE = 0.5
"""Standard normal value at which a magnitude is tried. At zero, the middle of a prior with both
signs, the effect would do nothing."""
FACTOR_DEVIATION = 3.0
"""Prior standard deviation of the factor on an effect, over the factor with which the effect would
be as large as the gap. It is wide, so that the screen prefers no magnitude."""
SCREENED_DEVIATIONS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
"""Standard deviations of the missing forces with which effects are screened, over those of the
estimate. They are smaller, since beside an effect only a part of the force is missing."""
SCREENED_TIMES = (0.5, 1.5)
"""Correlation times of these forces, over those of the estimate."""
LARGEST_RATIO = 1e100
"""Ratio of an effect to the gap that stands for infinity, if the gap is zero."""
CREEP_SHARE = 0.02
"""Fraction of the rms speed below which a body creeps and does not slide, so that its friction is
not a function of the speed."""
MOST_COLUMNS = 60
"""Number of effects that are weighed in one pass of the filter. More need more memory, and hardly
less time for each."""
TIED_EVIDENCE = 1.0
"""Difference to the log evidence of the best values of an effect up to which estimates begin at its
other values, too [nat]."""


class EffectColumn(NamedTuple):
    """The forces or changes of readings that an effect adds to a trial along a known motion.

    Attributes
    ----------
    forces : mapping of int to (F,) ndarray
        The forces of the effect at the fine stamps, by the index of the port [N or N m].
    readings : (N, C) ndarray
        The change of the readings caused by an effect that is no force, divided by the standard
        deviation of the noise.
    """

    forces: dict[int, FloatArray]
    readings: FloatArray

    @property
    def is_zero(self) -> bool:
        """Whether the effect changes nothing in the trial."""
        return not (np.any(self.readings) or any(np.any(force) for force in self.forces.values()))


class TriedEffect(NamedTuple):
    """An effect at its place, with scaled values (E,), and its column in each trial."""

    term: EffectTerm
    values: FloatArray
    columns: list[EffectColumn]


class ScreenedStart(NamedTuple):
    """Values from which an estimate of an effect may begin.

    Attributes
    ----------
    log_evidence : float
        The log evidence of the screening [nat].
    effect : (E,) ndarray
        The scaled parameters of the effect.
    processes : mapping of int to Process
        The missing forces that remain beside the effect, by the index of the port.
    """

    log_evidence: float
    effect: FloatArray
    processes: Processes


class ScreenedEffect(NamedTuple):
    """An effect that may be added to an estimate, with the result of its screening.

    Attributes
    ----------
    rise : float
        The log evidence with the effect, at the best of the values that were tried, minus that
        without it [nat].
    term : EffectTerm
        The effect at its place.
    starts : list of ScreenedStart
        The values from which estimates of the effect begin.
    """

    rise: float
    term: EffectTerm
    starts: list[ScreenedStart]


@np.errstate(over="ignore", invalid="ignore")  # an effect whose readings diverge is left out
def screen_effects(
    search: ForceSearch, base: Estimate, effects: Iterable[Effect]
) -> list[ScreenedEffect]:
    """Return the effects that may be added to an estimate, the most promising first.

    Each effect is tried at each of its places, with several values of its parameters. All values
    whose evidence is within `TIED_EVIDENCE` of the best are starts of later estimates. For example,
    dead zones of different widths look alike as long as only a factor on them is fitted, but
    estimates that begin with them end in different optima.

    Parameters
    ----------
    base : Estimate
        The estimate to which an effect is added.
    """
    tried_effects = _try_effects(search, base, effects)
    evidence_of_base = -inf
    weighed_effects: list[tuple[TriedEffect, ScreenedStart]] = []
    for begin in range(0, len(tried_effects), MOST_COLUMNS):
        some_effects = tried_effects[begin : begin + MOST_COLUMNS]
        evidence_of_base, weighed_of_these = _weigh_effects(base, some_effects)
        weighed_effects += weighed_of_these
    starts_by_term: dict[EffectTerm, list[ScreenedStart]] = {}
    for tried_effect, start in weighed_effects:
        starts_by_term.setdefault(tried_effect.term, []).append(start)
    screened_effects = []
    for term, starts in starts_by_term.items():
        best_evidence = max(start.log_evidence for start in starts)
        tied_starts = [
            start for start in starts if start.log_evidence > best_evidence - TIED_EVIDENCE
        ]
        screened_effects.append(ScreenedEffect(best_evidence - evidence_of_base, term, tied_starts))
    return sorted(screened_effects, key=lambda effect: -effect.rise)


def values_to_try(term: EffectTerm) -> list[FloatArray]:
    """Return sets of standard normal parameter values (E,) at which an effect is tried.

    Parameters that are no magnitudes are tried at `SHAPE_VALUES`; if there are several, only at the
    lowest and highest of these. Several magnitudes that may have both signs, such as the rate and
    the zero of a clock, are tried all together, and each alone: their ratio is not known.
    """
    shape_indices = [
        parameter_index
        for parameter_index, parameter in enumerate(term.parameters)
        if not parameter.magnitude
    ]
    levels = SHAPE_VALUES if len(shape_indices) < 2 else SHAPE_VALUES[::3]
    combinations = []
    for shape_values in list(product(levels, repeat=len(shape_indices)))[:MOST_COMBINATIONS]:
        values = np.full(len(term.parameters), MAGNITUDE_VALUE)
        values[shape_indices] = shape_values
        combinations.append(values)
    signed_magnitudes = [
        parameter_index
        for parameter_index, parameter in enumerate(term.parameters)
        if parameter.magnitude and parameter.prior.low < 0.0
    ]
    if len(signed_magnitudes) > 1:
        for values in list(combinations):
            for parameter_index in signed_magnitudes:
                single_magnitude = values.copy()
                single_magnitude[signed_magnitudes] = 0.0
                single_magnitude[parameter_index] = MAGNITUDE_VALUE
                combinations.append(single_magnitude)
    return combinations


def _terms_to_add(
    search: ForceSearch, base: Estimate, effects: Iterable[Effect]
) -> Iterator[EffectTerm]:
    """Yield the effects at places where an estimate lacks them, also with a free shape.

    With free exponents, dry friction and quadratic damping are the same law. So a free shape is
    tried of only one of the effects of a family whose shapes have the same parameters.
    """
    in_base = {(term.effect.identifier, term.place) for term in base.candidate.terms}
    families: set[tuple[str, str, tuple[str, ...]]] = set()
    for effect in effects:
        for place in effect.places(search.ported.problem.setting):
            if (effect.identifier, place) in in_base:
                continue
            yield EffectTerm(effect, place)
            if not effect.shape:
                continue
            family = (effect.family, place, tuple(parameter.name for parameter in effect.shape))
            if family not in families:
                families.add(family)
                yield EffectTerm(effect, place, free_shape=True)


def _try_effects(
    search: ForceSearch, base: Estimate, effects: Iterable[Effect]
) -> list[TriedEffect]:
    """Return the columns of all effects that may be added, at several values of each.

    Effects that change nothing are left out. So are those that are not possible along the motion;
    the reason is recorded in the problem.
    """
    trials = base.ported_trials
    tried_effects = []
    for term in _terms_to_add(search, base, effects):
        laws = search.ported.laws(Candidate((term,)), trials)
        for values in values_to_try(term):
            try:
                columns = [
                    _column_in_trial(laws, trial_index, smoothed_trial, values)
                    for trial_index, smoothed_trial in enumerate(base.trials)
                ]
            except (DiscrepancyError, InvalidPatchError) as cause:
                search.ported.problem_with_laws.record_refusal(laws.candidate, cause)
                continue
            if not all(np.all(np.isfinite(column.readings)) for column in columns):
                not_finite = ModelError(
                    "What the effect adds to the readings is not a finite number at every time."
                )
                search.ported.problem_with_laws.record_refusal(laws.candidate, not_finite)
            elif not all(column.is_zero for column in columns):
                tried_effects.append(TriedEffect(term, values, columns))
    return tried_effects


def _column_in_trial(
    laws: EffectLaws, trial_index: int, smoothed_trial: SmoothedTrial, values: FloatArray
) -> EffectColumn:
    """Return what a single effect adds to a trial along its smoothed motion.

    An error of a sensor is computed for the explained motion, without that by missing forces: as
    these may have any magnitude, they would fit any gain of a sensor.
    """
    (term,) = laws.candidate.terms
    window = NARROWEST_WINDOW if laws.hold_at_rest else WIDE_WINDOW
    arguments = LawArguments(trial_index, smoothed_trial.trajectory, values, np.zeros(0), window)
    forces = {
        port: law_force.force
        for port, law_force in laws.effect_forces_along_trajectory(arguments).items()
    }
    if forces:
        if laws.hold_at_rest:
            forces = {
                port: _force_that_holds(force, smoothed_trial, port)
                for port, force in forces.items()
            }
        return EffectColumn(forces, np.zeros_like(smoothed_trial.trial.residual))
    readings = laws.readings_change(trial_index, smoothed_trial.explained_trajectory, term, values)
    return EffectColumn({}, readings)


def _force_that_holds(
    sliding_force: FloatArray, smoothed_trial: SmoothedTrial, port: int
) -> FloatArray:
    """Return the force (F,) of a law that can hold its port at rest, such as dry friction.

    While the port slides it is the force of the law at the smoothed speed. While the port is at
    rest it is the force that is lacking there, at most as large as that of the law. In between it
    is the mean of both, weighted by the probability that the port moves, which falls with the speed
    below `CREEP_SHARE` of the rms speed.
    """
    speeds = smoothed_trial.trajectory.speeds[:, port]
    slow_speed = max(CREEP_SHARE * float(np.sqrt(np.mean(speeds**2))), LEAST_DIVISOR)
    # probability that a normal error of deviation `slow_speed` is smaller than the speed
    probability_of_motion = erf(np.abs(speeds) / (np.sqrt(2.0) * slow_speed))
    lacking_force = smoothed_trial.lacking_forces.get(port, np.zeros_like(speeds))
    largest_holding_force = np.abs(sliding_force)
    holding_force = np.clip(lacking_force, -largest_holding_force, largest_holding_force)
    return np.asarray(
        probability_of_motion * sliding_force + (1.0 - probability_of_motion) * holding_force
    )


def _weigh_effects(
    base: Estimate, tried_effects: Sequence[TriedEffect]
) -> tuple[float, list[tuple[TriedEffect, ScreenedStart]]]:
    """Return the best evidence and values of each tried effect, added alone to an estimate.

    The best is taken over several amplitudes and correlation times of the remaining missing forces.
    An effect is left out if its factor always has a sign that the effect cannot have.

    Returns
    -------
    evidence_of_base : float
        The best log evidence without any of the effects [nat].
    starts : list of (TriedEffect, ScreenedStart)
        The effects, each with its best start.
    """
    evidence_of_base = -inf
    with_columns = _with_columns(base, tried_effects)
    base_count = len(base.linearisation.priors)
    best_starts: dict[int, ScreenedStart] = {}
    factors = list(product(SCREENED_DEVIATIONS, SCREENED_TIMES))
    if base.leaves_no_force:
        factors = [(1.0, 1.0)]  # hardly any force is missing, so its amplitude does not matter
    for amplitude_factor, time_factor in factors:
        processes = processes_within_range(
            scale_processes(base.processes, amplitude_factor, time_factor),
            with_columns.correlation_time_range,
        )
        normal_equations = with_columns.regression(with_columns.filter(processes))
        of_base = range(base_count)
        without_effect = normal_equations.solve(of_base, with_columns.priors.of(of_base))
        evidence_of_base = max(evidence_of_base, without_effect.log_evidence)
        for index, tried_effect in enumerate(tried_effects):
            # the unknowns of the base are fitted again, with this column alone
            unknowns = [*range(base_count), base_count + index]
            solution = normal_equations.solve(unknowns, with_columns.priors.of(unknowns))
            factor = float(solution.mean[-1])
            has_possible_sign = factor > 0.0 or tried_effect.term.may_be_negative
            if not (has_possible_sign and np.isfinite(solution.log_evidence)):
                continue
            if index not in best_starts or best_starts[index].log_evidence < solution.log_evidence:
                effect = tried_effect.term.multiply_magnitudes_within_range(
                    tried_effect.values, factor
                )
                best_starts[index] = ScreenedStart(solution.log_evidence, effect, processes)
    return evidence_of_base, [(tried_effects[index], start) for index, start in best_starts.items()]


def _with_columns(base: Estimate, tried_effects: Sequence[TriedEffect]) -> Linearisation:
    """Return the trials of an estimate with one more unknown for each effect: its amplitude."""
    first_unknown = len(base.linearisation.priors)
    effect_values = np.concatenate((base.effect, np.zeros(len(tried_effects))))
    linear_trials = []
    for trial_index, linear_trial in enumerate(base.linearisation.trials):
        columns = [tried_effect.columns[trial_index] for tried_effect in tried_effects]
        linear_trials.append(
            _trial_with_columns(linear_trial, columns, first_unknown, effect_values)
        )
    priors_of_factors = Priors.without_ranges(_precisions_of_factors(base, tried_effects))
    return Linearisation(
        tuple(linear_trials), base.linearisation.priors.followed_by(priors_of_factors)
    )


def _trial_with_columns(
    linear_trial: LinearisedTrial | LinearisedRest,
    columns: Sequence[EffectColumn],
    first_unknown: int,
    effect_values: FloatArray,
) -> LinearisedTrial | LinearisedRest:
    """Add to a linearised trial one unknown for each effect column: its amplitude.

    The amplitude multiplies the forces and the errors of readings of the column.

    Parameters
    ----------
    first_unknown : int
        The index of the first amplitude among all unknowns.
    effect_values : (E,) array
        The effect parameters of the estimate, then the amplitudes, which are zero.
    """
    no_force = np.zeros(len(linear_trial.trial.fine_time))
    forces_by_port = {
        port: LinearisedForce(force.law_force, dict(force.by_unknown))
        for port, force in linear_trial.forces.items()
    }
    errors_by_unknown = dict(linear_trial.sensor_errors.by_unknown)
    for unknown, column in enumerate(columns, start=first_unknown):
        for port, force_of_effect in column.forces.items():
            if port not in forces_by_port:
                no_law = LawForce(no_force, no_force, no_force)
                forces_by_port[port] = LinearisedForce(no_law, {})
            force = forces_by_port[port]
            forces_by_port[port] = LinearisedForce(
                force.law_force, {**force.by_unknown, unknown: force_of_effect}
            )
        if np.any(column.readings):
            errors_by_unknown[unknown] = column.readings
    return replace(
        linear_trial,
        forces=forces_by_port,
        sensor_errors=LinearisedSensorErrors(linear_trial.sensor_errors.change, errors_by_unknown),
        effect=effect_values,
    )


def _precisions_of_factors(base: Estimate, tried_effects: Sequence[TriedEffect]) -> FloatArray:
    """Return the prior precision of the factor on each effect, (number of effects,).

    The prior standard deviation of a factor is `FACTOR_DEVIATION` times the factor with which the
    effect would be as large as the gap: the lacking forces if the effect is a force, else the
    residuals of the readings.
    """
    gap_of_readings = _rms([trial.trial.residual for trial in base.trials])
    gap_of_forces = _rms(
        [force for trial in base.trials for force in trial.lacking_forces.values()]
    )
    precisions = []
    for tried_effect in tried_effects:
        forces = [force for column in tried_effect.columns for force in column.forces.values()]
        if forces:
            ratio = _rms(forces) / gap_of_forces
        else:
            ratio = _rms([column.readings for column in tried_effect.columns]) / gap_of_readings
        # precision = 1 / (FACTOR_DEVIATION * gap / effect)^2
        precisions.append(min(ratio / FACTOR_DEVIATION, LARGEST_RATIO) ** 2)
    return np.array(precisions)


def _rms(series: Iterable[FloatArray]) -> float:
    """Return the root mean square of several arrays together, at least `LEAST_DIVISOR`."""
    values = np.concatenate([np.ravel(entries) for entries in series])
    return max(float(np.sqrt(np.mean(values**2))), LEAST_DIVISOR)
