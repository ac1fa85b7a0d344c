"""Faults of data that a model reveals: units, signs, swapped channels, short records."""

import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import pi

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Hold, Trial, TrialKind
from discrepancy.campaign.sampling import quantum_of
from discrepancy.catalogue.entry import Setting
from discrepancy.checks.fault import DataFault, FaultKind, mark_accepted
from discrepancy.checks.frequency import frequency_faults
from discrepancy.checks.quality import dead_fault, is_still
from discrepancy.checks.rest import noise_record_faults
from discrepancy.checks.scales import (
    CLEAR_NOISE_DEVIATIONS,
    data_scales,
    swap_fault,
    swapped_channels,
)
from discrepancy.checks.unit_slips import unit_slips
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.fits.normal_equations import normal_equations
from discrepancy.fits.problem import Problem
from discrepancy.judgement.separability import prior_point_with_initial_states
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch

LARGEST_DEVIATION_RATIO = 0.9
"""Fraction of its prior standard deviation above which a parameter is not observable."""


def posterior_to_prior_ratios(campaign: Campaign, model: Model) -> dict[str, float]:
    """Return the posterior over the prior standard deviation of each calibrated parameter.

    The ratio is 0 if the records determine a parameter exactly, and 1 if they do not depend on it.
    The posterior is that of the linearised model, from the information matrix of the fitted trials
    at the prior mean. Gains, zeros, initial states, constants of inputs and all parameters are
    unknown at the same time, so that a parameter counts as undetermined if others can explain the
    same readings. Unknown initial states are fitted first, because a model at rest does not depend
    on any parameter.

    Returns
    -------
    dict of str to float
        The ratio by the name of the parameter, for parameters with a prior standard deviation above
        0.
    """
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    channel_weights = np.ones(len(problem.channel_names))
    at_prior = fit(problem, Candidate(), prior_point_with_initial_states(problem), iterations=0)
    information = normal_equations(problem, at_prior, Candidate(), channel_weights).matrix
    covariance = np.linalg.pinv(information, hermitian=True)
    count = problem.shared.parameter_count  # parameters come first among the unknowns
    # the unknowns are scaled by their prior standard deviations, so that these are ratios already
    ratios = np.sqrt(np.diag(covariance)[:count])
    prior_deviations = problem.shared.scale[:count]
    return {
        parameter.name: float(ratio)
        for parameter, ratio, deviation in zip(
            model.parameters, ratios, prior_deviations, strict=True
        )
        if deviation > 0.0
    }


def unobservable_parameter_faults(campaign: Campaign, model: Model) -> Iterator[DataFault]:
    """Yield one fault that names the calibrated parameters that the records do not determine.

    A parameter is named if its posterior standard deviation is more than `LARGEST_DEVIATION_RATIO`
    of its prior one.
    """
    ratios = posterior_to_prior_ratios(campaign, model)
    undetermined = {
        name: ratio for name, ratio in ratios.items() if ratio > LARGEST_DEVIATION_RATIO
    }
    if undetermined:
        names = ", ".join(f"{name!r} ({ratio:.0%})" for name, ratio in undetermined.items())
        noun = "parameters" if len(undetermined) > 1 else "parameter"
        sentence = (
            f"The records do not determine the calibrated {noun} {names} (in per cent: "
            "posterior over prior standard deviation): an effect that acts like them cannot be "
            "distinguished from them; record trials in which they act, or state narrower priors."
        )
        yield DataFault(FaultKind.UNOBSERVABLE, sentence)


LEAST_PERIODS = 3.0
"""Fewest periods of the first mode in a record in time."""
LEAST_SAMPLES = 4.0
"""Fewest samples in a period of the first mode."""
LEAST_REPORTED_CHANGE = 0.3
"""Least effect of an input's course between samples that is reported (rms, over the noise)."""


def check_against_model(campaign: Campaign, model: Model) -> tuple[DataFault, ...]:
    """Return the faults of the data that a comparison with the model at its prior mean shows.

    If a channel has no matching output of the model, only this is reported. The scale of a channel
    in a trial is the ratio of data to prediction. The checks are:

    - Frequency: ring-downs oscillate more than four times slower or faster than the model's first
      mode. Unless this is accepted, the other checks are left out, because they would only repeat
      it.
    - Unit slip: two units of the channel's quantity differ by the scale in all its trials (within a
      factor of 3 for slips from 200 on, 2 from 20 on, 1.35 from 7 on, 1.1 below). If all channels
      of a trial have the same slip, the input of that trial has it.
    - Reversed sign: the scale is negative.
    - Swapped channels: exchanging two channels of one quantity leaves each less than half of its
      misfit and lowers chi-squared by 30 or more.
    - Limits of what can be concluded: a noise record with a spectral line at the first mode, an
      input whose course between samples matters, and a parameter that the records do not determine.

    Signals of unknown scale have no scale to check. The model must have no patch.
    """
    missing_outputs = tuple(_output_faults(campaign, model))
    if missing_outputs:
        return missing_outputs
    faults: list[DataFault] = []
    if model.oscillates:
        frequency = model.scales(campaign).angular_frequency / (2.0 * pi)
        wrong_frequencies = tuple(frequency_faults(campaign, model.name, frequency))
        marked_faults = mark_accepted(wrong_frequencies, campaign)
        if any(fault.fatal for fault in marked_faults):
            return marked_faults
        faults += wrong_frequencies
        faults += _length_faults(campaign, frequency)
        faults += noise_record_faults(campaign, frequency)
    predictions: dict[str, FloatArray] = {}
    for trial in campaign.trials:
        conditions = prior_conditions(campaign, model, trial)
        predictions[trial.name] = observe(model, campaign, trial, ModelPatch(), conditions).values
    faults += _dead_faults(campaign, predictions)
    scales = data_scales(campaign, predictions)  # by channel and trial
    swaps = swapped_channels(campaign, predictions)
    swapped_names = {name for swap in swaps for name in swap}
    # what an exchange of channels explains is neither a unit slip nor a reversed sign
    scales = {
        (channel, trial): scale
        for (channel, trial), scale in scales.items()
        if channel not in swapped_names
    }
    faults += unit_slips(campaign, scales)
    faults += _sign_faults(campaign, scales)
    for trial in campaign.trials:
        faults += _hold_faults(campaign, model, trial)
    if any(trial.kind is TrialKind.DRIVEN for trial in campaign.fitted) and model.parameters:
        faults += unobservable_parameter_faults(campaign, model)
    faults += [swap_fault(first_channel, second_channel) for first_channel, second_channel in swaps]
    return mark_accepted(faults, campaign)


def prior_conditions(campaign: Campaign, model: Model, trial: Trial) -> Conditions:
    """Return the conditions under which a trial is simulated before any fit.

    The parameters have their prior means, the release its nominal displacement, the clock no error.
    """
    prior_means = np.array([mean for mean, _ in model.prior_moments(campaign)])
    # displacement and velocity of each mode that the release may excite
    mode_count = 0 if trial.release is None else trial.release.mode_count
    initial_modes = np.zeros((mode_count, 2))
    if trial.release is not None and not trial.release.at_rest:
        initial_modes[0, 0] = 1.0  # the first mode at the nominal release displacement
    return Conditions(
        parameters=prior_means,
        initial=initial_modes,
        clock=(0.0, 0.0),
        health=trial.health,
    )


def _hold_faults(campaign: Campaign, model: Model, trial: Trial) -> Iterator[DataFault]:
    """Yield a fault if the course of inputs between their samples matters and is not stated.

    The key `hold` of a campaign states whether an input is smooth, linear or constant between its
    samples. For inputs without this key, the model's response to straight lines is compared with
    its response to smooth curves. The fault is reported if the two differ by more than
    `LEAST_REPORTED_CHANGE` times the noise (rms) in any channel with a noise record. The fault
    limits the conclusions, but does not make the data wrong. Only forced and driven trials have
    such inputs.
    """
    if trial.kind not in (TrialKind.FORCED, TrialKind.DRIVEN) or len(trial.time) < 4:
        return
    force_is_open = trial.kind is TrialKind.FORCED and trial.hold is None
    open_inputs = [
        recorded_input.name for recorded_input in trial.inputs if recorded_input.hold is None
    ]
    if force_is_open:
        open_inputs = ["force"]
    if not open_inputs:
        return
    smooth_inputs = tuple(
        replace(recorded_input, hold=Hold.SMOOTH)
        if recorded_input.name in open_inputs
        else recorded_input
        for recorded_input in trial.inputs
    )
    smooth_trial = replace(
        trial, inputs=smooth_inputs, hold=Hold.SMOOTH if force_is_open else trial.hold
    )
    conditions = prior_conditions(campaign, model, trial)
    response_to_lines = observe(model, campaign, trial, ModelPatch(), conditions).values
    response_to_curves = observe(model, campaign, smooth_trial, ModelPatch(), conditions).values
    # infinite without a noise record, so that the difference counts as zero
    noise = [trial.noise_deviation(campaign.channels[name]) or np.inf for name in trial.channels]
    # (channels,), in standard deviations of the noise
    differences = np.sqrt(np.mean((response_to_lines - response_to_curves) ** 2, axis=0)) / noise
    largest = differences.max()
    if largest > LEAST_REPORTED_CHANGE:
        names = ", ".join(map(repr, open_inputs))
        channel = trial.channels[int(differences.argmax())]
        table = "[[trial]]" if force_is_open else "[[input]]"
        sentence = (
            f"In the trial {trial.name!r} straight lines and curves between the samples of {names} "
            f"differ by {largest:.2g} noise deviations (rms) in {channel!r}: state what it did by "
            "hold = "
            f'"smooth", "zero_order" or "linear" in its {table}, or record it faster.'
        )
        yield DataFault(FaultKind.BETWEEN_SAMPLES, sentence, trial=trial.name)


def _output_faults(campaign: Campaign, model: Model) -> Iterator[DataFault]:
    """Yield a fault for each channel without a matching output of the model.

    The output does not exist, or is of another quantity than the channel measures.
    """
    for name, channel in campaign.channels.items():
        quantity = model.output_quantity(channel.output)
        if quantity is None:
            sentence = (
                f"The channel {name!r} is compared with the output {channel.output!r}, which "
                f"{model.name} does not have: correct `output`, or leave the channel out."
            )
            yield DataFault(FaultKind.MISSING_OUTPUT, sentence, name)
        elif not channel.quantity.can_measure(quantity):
            sentence = (
                f"The channel {name!r} measures {channel.quantity.value}, but the output "
                f"{channel.output!r} of {model.name} is {quantity.value}: correct `quantity` or "
                "`output`."
            )
            yield DataFault(FaultKind.WRONG_QUANTITY, sentence, name)


def _length_faults(campaign: Campaign, frequency: float) -> Iterator[DataFault]:
    """Yield a fault for each record that is too short, or sampled too slowly, for the first mode.

    `frequency` is that of the first mode [Hz]. Driven trials are left out: they are long enough if
    they determine the parameters; see `unobservable_parameter_faults`.
    """
    for trial in campaign.trials:
        if not trial.is_dynamic or trial.kind is TrialKind.DRIVEN:
            continue
        periods = float(trial.time[-1] - trial.time[0]) * frequency
        if periods < LEAST_PERIODS:
            sentence = (
                f"The trial {trial.name!r} holds {periods:.2g} periods of the first mode "
                f"({frequency:.3g} Hz), and at least {LEAST_PERIODS:.0f} are needed: record longer."
            )
            yield DataFault(FaultKind.TOO_SHORT, sentence, trial=trial.name)
        samples = 1.0 / (trial.interval * frequency)
        if samples < LEAST_SAMPLES:
            sentence = _undersampled_sentence(trial, frequency, samples)
            yield DataFault(FaultKind.UNDERSAMPLED, sentence, trial=trial.name)


def _undersampled_sentence(trial: Trial, frequency: float, samples: float) -> str:
    """Return the message that a trial has too few samples in a period of the first mode.

    `frequency` is that of the first mode [Hz], and `samples` the number of samples in its period.
    If it is less than a tenth of what is needed, and enough if times are milliseconds, the message
    says that they look like milliseconds.
    """
    samples_if_milliseconds = 1e3 * samples
    if samples < LEAST_SAMPLES / 10.0 and samples_if_milliseconds >= LEAST_SAMPLES:
        return (
            f"The time of the trial {trial.name!r} looks like milliseconds: taken as seconds it "
            f"gives {samples:.2g} samples per period of the first mode ({frequency:.3g} Hz), as "
            f"milliseconds {samples_if_milliseconds:.3g}; write it in seconds, as `uav-twin "
            "discrepancy import` does."
        )
    return (
        f"The trial {trial.name!r} has {samples:.2g} samples per period of the first mode "
        f"({frequency:.3g} Hz), and at least {LEAST_SAMPLES:.0f} are needed: sample faster."
    )


def _dead_faults(campaign: Campaign, predictions: Mapping[str, FloatArray]) -> Iterator[DataFault]:
    """Yield a fault for each channel that is constant in a trial at rest, but should change.

    Such a channel has a prediction, a column of `predictions` (N, C) of its trial, that changes by
    more than `CLEAR_NOISE_DEVIATIONS` times the noise or the sensor's quantum. `check_data`
    reports, without a model, the channels that are constant in a dynamic trial or in all their
    trials.
    """
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            if trial.is_dynamic or not is_still(trial, name):
                continue
            readings = np.concatenate([values for _, values, _ in campaign.records(name)])
            quantum = quantum_of(readings)
            noise = trial.noise_deviation(campaign.channels[name])
            predicted_range = np.ptp(predictions[trial.name][:, column])
            if quantum and predicted_range > CLEAR_NOISE_DEVIATIONS * max(noise, quantum):
                yield dead_fault(trial, name)


def _sign_faults(
    campaign: Campaign, scales: Mapping[tuple[str, str], float]
) -> Iterator[DataFault]:
    """Yield a fault for each channel whose sign is opposite to the model's in all its trials.

    `scales` holds the signed ratio of data to prediction by channel and trial (`data_scales`). If
    it is negative for all of several channels, one fault reports the sign of the forces instead.
    """
    dynamic_trials = {trial.name for trial in campaign.trials if trial.is_dynamic}
    channels_at_rest = {name for name, trial in scales if trial not in dynamic_trials}
    scales_of_channels: dict[str, list[float]] = defaultdict(list)
    for (name, trial), scale in scales.items():
        # a filter may reverse the phase of a motion: readings at rest decide, if there are any
        if trial not in dynamic_trials or name not in channels_at_rest:
            scales_of_channels[name].append(scale)
    reversed_channels = [
        name
        for name, scales_of_channel in scales_of_channels.items()
        if max(scales_of_channel) < 0.0
    ]
    if len(reversed_channels) == len(scales_of_channels) > 1:
        sentence = (
            "All channels move in the opposite direction to the model: check the sign of the "
            "forces, which are positive upwards."
        )
        yield DataFault(FaultKind.SIGN, sentence)
        return
    for name in reversed_channels:
        sentence = (
            f"The channel {name!r} moves in the opposite direction to the model in every trial: "
            "reverse its sign (as the model has it: displacement upwards, the wing's strain "
            "positive where upward load compresses the upper skin), for example by "
            f"`discrepancy import --scale {shlex.quote(f'{name}=-1')}`, or correct its `output`."
        )
        yield DataFault(FaultKind.SIGN, sentence, name)
