"""Parameters, gains and zeros that a fit moves far from their stated values.

A wrong model can fit the readings by wrong calibrated values. Such an error of the model does not
show in the residuals, but in these values. If the stated deviations are wide, the values need not
even be improbable.
"""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.trial_data import TrialData
from discrepancy.verdict import MovedUnknown, SensorEstimate, SensorValue
from reporting.words import listing, plus_minus, significant

from .hypotheses import calibrated_parameters
from .sensor_estimates import sensor_estimates

MOVED_DEVIATIONS = 2.0
"""Distance from the stated value, in stated deviations, above which an unknown is reported."""
GAIN_OF = "gain of "
ZERO_OF = "zero of "
"""Beginnings of the names of gains and zeros."""
LEAST_MOVE_WITHIN_PRIOR = 1.0
"""Distance from the stated value, in stated deviations, above which a move may use up a prior."""
LEAST_RELATIVE_MOVE = 0.02
"""Move, relative to the stated value of a parameter, to one for a gain, or to the largest reading
for a zero, below which a prior is not called wide: too little for an error of the model to hide."""
LEAST_SIGNIFICANCE = 3.0
"""Distance from the stated value, in posterior deviations, from which the data show that an unknown
has moved."""
DRAWN_UNITS = {
    UNITS[quantity].si: UNITS[quantity].drawn
    for quantity in (Quantity.STRAIN, Quantity.DISPLACEMENT)
}
"""Factor and unit in which zeros are told, by their SI unit."""
MOST_MENTIONED = 5
"""Number of moved unknowns that a sentence mentions."""


def moved_unknowns(problem: Problem, fit: CandidateFit) -> tuple[MovedUnknown, ...]:
    """Return the unknowns that a fit moves by more than `MOVED_DEVIATIONS`, the farthest first.

    Parameters
    ----------
    fit : CandidateFit
        The fit, usually that of the model without effect.
    """
    moved_far = [
        unknown
        for unknown in _stated_unknowns(problem, fit)
        if abs(unknown.deviations) > MOVED_DEVIATIONS
    ]
    return tuple(sorted(moved_far, key=lambda unknown: -abs(unknown.deviations)))


def moved_sensors(problem: Problem, fit: CandidateFit) -> tuple[MovedUnknown, ...]:
    """Return the gains and zeros among `moved_unknowns`."""
    return tuple(
        unknown
        for unknown in moved_unknowns(problem, fit)
        if unknown.name.startswith((GAIN_OF, ZERO_OF))
    )


def _stated_unknowns(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    """Return the stated and fitted values of all unknowns that have a stated deviation."""
    return [
        *_parameter_values(problem, fit),
        *_gain_values(problem, fit),
        *_zero_and_constant_values(problem, fit),
    ]


def unknowns_moved_within_prior(problem: Problem, fit: CandidateFit) -> tuple[MovedUnknown, ...]:
    """Return the unknowns that a fit moves far, but not improbably far, the farthest first.

    Their stated deviations are wide. The fit moves such an unknown by one to two stated deviations,
    by at least `LEAST_RELATIVE_MOVE`, and by at least `LEAST_SIGNIFICANCE` posterior deviations.
    Unknowns without a posterior deviation, such as constants of inputs, are left out.

    Parameters
    ----------
    fit : CandidateFit
        The fit, usually that of the model without effect.
    """
    posterior_deviations = {
        parameter.name: parameter.deviation for parameter in calibrated_parameters(problem, fit)
    }
    for estimate in sensor_estimates(problem, fit):
        posterior_deviations[_sensor_name(estimate)] = estimate.deviation
    reference_sizes = _reference_sizes(problem)
    moved = []
    for unknown in _stated_unknowns(problem, fit):
        if unknown.name not in posterior_deviations:
            continue
        move = abs(unknown.value - unknown.stated)
        least_move = max(
            LEAST_MOVE_WITHIN_PRIOR * unknown.deviation,
            LEAST_RELATIVE_MOVE * reference_sizes[unknown.name],
            LEAST_SIGNIFICANCE * posterior_deviations[unknown.name],
        )
        if least_move <= move <= MOVED_DEVIATIONS * unknown.deviation:
            moved.append(unknown)
    return tuple(sorted(moved, key=lambda unknown: -abs(unknown.deviations)))


def _sensor_name(estimate: SensorEstimate) -> str:
    """Return the name of a gain or zero, as `MovedUnknown.name` has it."""
    if estimate.kind is SensorValue.GAIN:
        return _name_of_gain(estimate.channel)
    return _name_of_zero(estimate.channel, estimate.trial)


def _name_of_gain(channel: str) -> str:
    """Return the name of the gain of a channel."""
    return f"{GAIN_OF}{channel}"


def _name_of_zero(channel: str, trial: str) -> str:
    """Return the name of the zero of a channel in a trial."""
    return f"{ZERO_OF}{channel} in {trial!r}"


def _reference_sizes(problem: Problem) -> dict[str, float]:
    """Return the reference value of the relative move of each unknown, by its name.

    It is the stated value of a parameter, one for a gain, and the largest reading for a zero.
    """
    layout = problem.shared
    sizes = {_name_of_gain(channel): 1.0 for channel in layout.gain_channels}
    # the centres of gains follow those of the parameters
    for parameter, centre in zip(problem.model.parameters, layout.centre, strict=False):
        # an error of the mesh, which is stated as zero, is a fraction itself
        sizes[parameter.name] = abs(float(centre)) or 1.0
    for data in problem.trials:
        for column, channel in enumerate(data.trial.channels):
            readings = data.trial.values[data.trial.used[:, column], column]
            largest_reading = float(np.max(np.abs(readings), initial=0.0))
            sizes[_name_of_zero(channel, data.trial.name)] = largest_reading
    return sizes


def _parameter_values(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    """Return the stated and fitted values of the calibrated parameters with a prior deviation."""
    layout = problem.shared
    values = layout.parameters(fit.point.shared)
    unknowns = []
    for parameter_index, parameter in enumerate(problem.model.parameters):
        stated_value = float(layout.centre[parameter_index])
        prior_deviation = float(layout.scale[parameter_index])
        if prior_deviation <= 0.0:  # no prior: nothing to be far from
            continue
        value = float(values[parameter_index])
        unknowns.append(
            MovedUnknown(
                name=parameter.name,
                stated=stated_value,
                deviation=prior_deviation,
                value=value,
                deviations=(value - stated_value) / prior_deviation,
                unit=parameter.unit,
            )
        )
    return unknowns


def _gain_values(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    """Return the fitted values of the gain errors with a stated deviation; they are stated as 0."""
    layout = problem.shared
    unknowns = []
    for gain_number, channel in enumerate(layout.gain_channels):
        shared_number = layout.parameter_count + gain_number
        if layout.precision[shared_number] > 0.0:
            scaled_value = float(fit.point.shared[shared_number])
            scale = float(layout.scale[shared_number])
            unknowns.append(
                _unknown_stated_as_zero(_name_of_gain(channel), scaled_value, scale, "1")
            )
    return unknowns


def _zero_and_constant_values(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    """Return the fitted zeros of channels and constants of inputs that have a stated deviation."""
    unknowns = []
    for data, local_values in zip(problem.trials, fit.point.local, strict=True):
        layout = data.unknowns
        names_and_units = _names_of_zeros_and_constants(problem, data)
        indices = [*layout.indices.zeros, *layout.indices.input_constants]
        for (name, unit), index in zip(names_and_units, indices, strict=True):
            if layout.precision[index] > 0.0:
                scaled_value = float(local_values[index])
                unknowns.append(
                    _unknown_stated_as_zero(name, scaled_value, float(layout.scale[index]), unit)
                )
    return unknowns


def _names_of_zeros_and_constants(problem: Problem, data: TrialData) -> list[tuple[str, str]]:
    """Return the name and SI unit of each unknown zero, then of each input constant."""
    trial = data.trial
    names_and_units = []
    for column in data.unknowns.zero_columns:
        channel = trial.channels[column]
        unit = UNITS[problem.campaign.channels[channel].quantity].si
        names_and_units.append((_name_of_zero(channel, trial.name), unit))
    for row in data.unknowns.offset_inputs:
        recorded_input = trial.inputs[row]
        unit = UNITS[recorded_input.quantity].si
        names_and_units.append((f"constant of {recorded_input.name} in {trial.name!r}", unit))
    return names_and_units


def _unknown_stated_as_zero(
    name: str, scaled_value: float, scale: float, unit: str
) -> MovedUnknown:
    """Return the record of an unknown that is stated as zero with a standard deviation, `scale`."""
    return MovedUnknown(
        name=name,
        stated=0.0,
        deviation=scale,
        value=scale * scaled_value,
        deviations=scaled_value,
        unit=unit,
    )


def moved_sentence(unknowns: Sequence[MovedUnknown]) -> str:
    """Return a sentence on the unknowns that the fit without effect moves; empty if none."""
    if not unknowns:
        return ""
    return f"Without an effect, the fit moves {_moved_texts(unknowns)}."


def hiding_sentences(
    moved: Sequence[MovedUnknown],
    moved_within_prior: Sequence[MovedUnknown],
    sensors: Sequence[SensorEstimate],
) -> str:
    """Return sentences on the unknowns in which an error of the model may hide.

    They are meant for a fit without an effect whose residuals are only noise: the fit may have
    absorbed an error of the model by moving these unknowns away from their true values.

    Parameters
    ----------
    moved : sequence of MovedUnknown
        The unknowns that the fit moves far from what is stated.
    moved_within_prior : sequence of MovedUnknown
        The unknowns that the fit moves far, but not improbably far, as their stated deviations are
        wide.
    sensors : sequence of SensorEstimate
        The gains and zeros in the same fit, with their posterior deviations.

    Returns
    -------
    str
        The sentences; empty if the fit moves nothing.
    """
    gains = {_sensor_name(sensor): sensor for sensor in sensors if sensor.kind is SensorValue.GAIN}
    moved_gains = [gains[unknown.name] for unknown in moved if unknown.name in gains]
    other_unknowns = [unknown for unknown in moved if unknown.name not in gains]
    sentences = []
    if moved_gains:
        gain_texts = listing(map(_gain_text, moved_gains), most=MOST_MENTIONED)
        sentences.append(f"In the fit {gain_texts}: an error of the model may hide there.")
    if other_unknowns:
        sentences.append(
            f"The fit moves {_moved_texts(other_unknowns)}: an error of the model may hide there."
        )
    if moved_within_prior:
        sentences.append(
            f"Within wide stated deviations the fit moves {_moved_texts(moved_within_prior)}: an "
            "error of the model of this size would not show."
        )
    return " ".join(sentences)


def _gain_text(gain: SensorEstimate) -> str:
    """Return in words by how much a channel shows too much or too little, and what was stated."""
    side = "much" if gain.value > 0.0 else "little"
    error = plus_minus(100.0 * abs(gain.value), 100.0 * gain.deviation)
    return (
        f"the channel {gain.channel} shows {error} % too {side} (stated to "
        f"{100.0 * gain.stated_deviation:.3g} %; {abs(gain.deviations):.1f} deviations)"
    )


def _moved_texts(unknowns: Sequence[MovedUnknown]) -> str:
    """Return the first unknowns in words, and how many more there are."""
    parts = [_moved_text(unknown) for unknown in unknowns[:MOST_MENTIONED]]
    unmentioned_count = len(unknowns) - MOST_MENTIONED
    if unmentioned_count > 0:
        parts.append(f"{unmentioned_count} more")
    return listing(parts)


def _moved_text(unknown: MovedUnknown) -> str:
    """Return in words the stated and fitted value of an unknown, and their distance.

    The distance is in standard deviations of the stated value. The value of a gain is its relative
    error. If the stated value is 0, as for gains and zeros, only its standard deviation is given.
    """
    name = unknown.name
    value = unknown.value
    stated_deviation = unknown.deviation
    distance_text = f"{abs(unknown.deviations):.1f} deviations"
    unit = "" if unknown.unit == "1" else f" {unknown.unit}"
    if name.startswith(GAIN_OF):
        stated_text = f"stated to {100.0 * stated_deviation:.3g} %"
        side = "much" if value > 0.0 else "little"
        error = f"{100.0 * abs(value):.3g} % too {side}"
        return f"the {name} to {error} ({stated_text}; {distance_text})"
    if unknown.stated == 0.0:
        factor = 1.0
        if name.startswith(ZERO_OF) and unknown.unit in DRAWN_UNITS:
            factor, drawn_unit = DRAWN_UNITS[unknown.unit]
            unit = f" {drawn_unit}"
        stated_text = f"stated to {factor * stated_deviation:.3g}{unit}"
        return f"the {name} to {significant(factor * value)}{unit} ({stated_text}; {distance_text})"
    stated_text = f"{unknown.stated:.4g} ± {stated_deviation:.2g}"
    return f"{name} from {stated_text} to {value:.4g}{unit} ({distance_text})"
