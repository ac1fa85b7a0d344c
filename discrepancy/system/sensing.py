"""Readings of the channels of a trial: a model's response, changed by the sensors of a patch."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.errors import CatalogueError, ModelError
from discrepancy.system.interface import Model
from discrepancy.system.response import ACROSS, Conditions, Outputs, Response
from fe.high_pass import filtered_record
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    EVERY_CHANNEL,
    SENSORS,
    LoggerClock,
    ModelPatch,
    Primitive,
    SensorRotation,
    Window,
)
from fe.runtime.sensors import SensorRecord, apply_sensors, check_channels, clock_of


class LoggerRates(NamedTuple):
    """Clock errors (rate minus one) of a trial's inputs, and of each of its channels (C,)."""

    inputs: float
    channels: FloatArray


class OutputsForSensors(NamedTuple):
    """The outputs that a model has to compute so that the sensors of a patch can act on them.

    Attributes
    ----------
    outputs : tuple of (str, Quantity)
        The outputs of the C channels, then the transverse strain of each of the G strain channels
        below, then the shear strain of each.
    strain_columns : list of int
        The columns of all G strain channels among the channels; empty if the patch turns no gauge.
    """

    outputs: Outputs
    strain_columns: list[int]


def shift_clock_to_first_sample(trial: Trial, patch: ModelPatch) -> tuple[Trial, ModelPatch]:
    """Count the times of a trial and its patch from the first sample, if this is far from zero.

    Models count time from the start of the trial, but time stamps may count from an epoch or from
    the start of a logger. If the first time stamp is closer to zero than the record is long, all
    stay as they are, since a release happens at zero.

    Parameters
    ----------
    trial : Trial
        The trial with the stamps that its user gave.
    patch : ModelPatch
        Patch whose time windows are given in these stamps; the windows are shifted too.
    """
    if not trial.is_dynamic or len(trial.time) < 2:
        return trial, patch
    first_stamp = float(trial.time[0])
    last_stamp = float(trial.time[-1])
    if abs(first_stamp) <= last_stamp - first_stamp:
        return trial, patch
    primitives = []
    for primitive in patch:
        windows = tuple(_shift_window(window, first_stamp) for window in primitive.windows)
        primitives.append(replace(primitive, windows=windows) if windows else primitive)
    return replace(trial, time=trial.time - first_stamp), ModelPatch(tuple(primitives))


def _shift_window(window: Window, first_stamp: float) -> Window:
    """Return a window of time counted from `first_stamp` [s]; an open end stays open."""
    begin = None if window.begin is None else window.begin - first_stamp
    end = None if window.end is None else window.end - first_stamp
    return window._replace(begin=begin, end=end)


def observe(
    model: Model, campaign: Campaign, trial: Trial, patch: ModelPatch, conditions: Conditions
) -> Response:
    """Return the readings of all channels of a trial, without the gains and zeros that are fitted.

    Parameters
    ----------
    model : Model
        The model that responds to the structure, force and load primitives of the patch. Sensors
        that it has built in act before those of the patch.
    campaign : Campaign
        The campaign with the channels that the trial names.
    trial : Trial
        The trial, of which only the inputs and the sample times are used.
    patch : ModelPatch
        Clocks are added to `conditions.clock`; other sensor primitives act on the response
        (`fe.runtime.sensors`).
    conditions : Conditions
        Parameters, initial state, clock and health.

    Raises
    ------
    ModelError
        If the model lacks an output or cannot carry a primitive.
    CatalogueError
        If a sensor primitive names a channel that does not exist or has values that no sensor can
        have.
    """
    built_in_sensors = _with_channel_names(model.built_in_sensors, campaign)
    patch = (built_in_sensors + patch).in_trial(trial.name)
    trial, patch = shift_clock_to_first_sample(trial, patch)
    if not len(patch.of(*SENSORS)):
        return model.respond(trial, campaign.outputs(trial), patch, conditions)
    needed = _outputs_for_sensors(model, campaign, trial, patch)
    response = _response_in_clocks(model, campaign, trial, patch, conditions, needed)
    # columns: the C channels, transverse strains of the G strain channels, their shear strains
    channel_count = len(trial.channels)
    gauge_count = len(needed.strain_columns)
    values = response.values  # (N, C + 2 G)
    transverse = np.zeros((len(values), channel_count))
    shear = np.zeros((len(values), channel_count))
    transverse[:, needed.strain_columns] = values[:, channel_count : channel_count + gauge_count]
    shear[:, needed.strain_columns] = values[:, channel_count + gauge_count :]
    rates = response.rates[:, :channel_count] if response.rates is not None else None
    channel_response = Response(values[:, :channel_count], rates)
    return observe_response(
        campaign, trial, patch, conditions, channel_response, (transverse, shear)
    )


def _outputs_for_sensors(
    model: Model, campaign: Campaign, trial: Trial, patch: ModelPatch
) -> OutputsForSensors:
    """Return the outputs that a model has to compute for the channels of a trial.

    If the patch turns a gauge, the transverse and the shear strain are needed as well. They are
    added for every strain channel, whether it is turned or not (`observe_response` decides that),
    and the columns of these channels are returned. Otherwise no columns are returned.

    Raises
    ------
    ModelError
        If gauges are turned, but the model does not compute these strains.
    """
    channel_outputs = campaign.outputs(trial)
    if not len(patch.of(SensorRotation)):
        return OutputsForSensors(channel_outputs, [])
    strain_columns = []
    strain_names = []
    for column, (name, quantity) in enumerate(channel_outputs):
        if quantity is Quantity.STRAIN:
            strain_columns.append(column)
            strain_names.append(name)
    transverse_and_shear = []
    for ending in ACROSS:  # all transverse strains come before the first shear strain
        transverse_and_shear += [(name + ending, Quantity.STRAIN) for name in strain_names]
    if not all(model.output_quantity(name) for name, _ in transverse_and_shear):
        raise ModelError(
            f"{model.name} gives no transverse and shear strain, so a turned gauge cannot be "
            "computed: leave gauge misalignment out for this model."
        )
    return OutputsForSensors((*channel_outputs, *transverse_and_shear), strain_columns)


def _response_in_clocks(
    model: Model,
    campaign: Campaign,
    trial: Trial,
    patch: ModelPatch,
    conditions: Conditions,
    needed: OutputsForSensors,
) -> Response:
    """Return the response of all needed outputs, each at the times at which its logger samples.

    The recorded inputs are first brought to their true times. The clocks of all loggers agree at
    the first sample; the model is run once for each distinct rate of the clocks.
    """
    without_sensors = patch.without(*SENSORS)
    patch_rate, patch_zero = clock_of(patch)
    clock_rate = conditions.clock[0] + patch_rate
    clock_zero = conditions.clock[1] + patch_zero
    rates = _logger_rates(campaign, trial, patch)
    first_stamp = float(trial.time[0])
    trial_in_true_time = trial
    if rates.inputs:
        trial_in_true_time = replace(
            trial, time=trial.time + rates.inputs * (trial.time - first_stamp)
        )
    # of each output: the channels, then the transverse and the shear strains, which have the clock
    # of their gauge
    output_rates = np.append(rates.channels, np.tile(rates.channels[needed.strain_columns], 2))
    values = np.zeros((len(trial.time), len(needed.outputs)))
    output_slopes = np.zeros_like(values)
    for rate in np.unique(rates.channels).tolist():
        # relative to the time of the inputs: (1 + rate) / (1 + input rate) (1 + clock rate) - 1
        relative_rate = (rate - rates.inputs) / (1.0 + rates.inputs) * (
            1.0 + clock_rate
        ) + clock_rate
        # the zero makes all clocks agree at the first sample
        logger_clock = relative_rate, clock_zero - relative_rate * first_stamp
        clock_conditions = replace(conditions, clock=logger_clock)
        response = model.respond(
            trial_in_true_time, needed.outputs, without_sensors, clock_conditions
        )
        is_sampled = output_rates == rate
        values[:, is_sampled] = response.values[:, is_sampled]
        if response.rates is not None:
            output_slopes[:, is_sampled] = response.rates[:, is_sampled]
    return Response(values, output_slopes if trial.is_dynamic else None)


def _logger_rates(campaign: Campaign, trial: Trial, patch: ModelPatch) -> LoggerRates:
    """Return the clock errors of a trial's inputs and channels, by the `LoggerClock` of the patch.

    With a clock error e, a sample with the time stamp t was taken at (1 + e) t. If several
    primitives act on one channel, their factors 1 + e are multiplied. A trial at rest has no clock,
    so that its errors are zero. Raises `CatalogueError` if the patch names a logger that the
    campaign does not have.
    """
    input_factor = 1.0
    channel_factors = np.ones(len(trial.channels))
    if not trial.is_dynamic:
        return LoggerRates(input_factor - 1.0, channel_factors - 1.0)
    for clock in patch:
        if not isinstance(clock, LoggerClock):
            continue
        members = _members_of_logger(campaign, trial, clock.logger)
        is_member = np.array([name in members for name in trial.channels], dtype=bool)
        channel_factors = channel_factors * np.where(is_member, 1.0 + clock.rate, 1.0)
        # the logger of every channel samples the inputs, also where the trial has none by name
        samples_inputs = any(name in members for name in trial.input_names)
        if clock.logger == EVERY_CHANNEL or samples_inputs:
            input_factor *= 1.0 + clock.rate
    return LoggerRates(input_factor - 1.0, channel_factors - 1.0)


def _members_of_logger(campaign: Campaign, trial: Trial, logger: str) -> tuple[str, ...]:
    """Return the names of a logger's channels and inputs; `EVERY_CHANNEL` is the logger of all.

    Raises `CatalogueError` if the campaign has no logger of that name.
    """
    if logger == EVERY_CHANNEL:
        return (*trial.channels, *trial.input_names)
    if logger not in campaign.loggers:
        loggers = ", ".join(map(repr, campaign.loggers)) or "one for all, '*'"
        raise CatalogueError(f"The campaign has no logger {logger!r}; it has {loggers}.")
    return tuple(campaign.loggers[logger])


def _with_channel_names(sensor_patch: ModelPatch, campaign: Campaign) -> ModelPatch:
    """Return the sensor primitives of a model with names of channels in place of its outputs.

    A primitive that names an output is replaced by one for each channel that measures it; without
    such a channel it is left out.
    """
    primitives: list[Primitive] = []
    for primitive in sensor_patch:
        # a primitive without a channel, such as a clock, acts on all of them
        channel_or_output = getattr(primitive, "channel", EVERY_CHANNEL)
        if channel_or_output == EVERY_CHANNEL or channel_or_output in campaign.channels:
            primitives.append(primitive)
            continue
        for channel_name, channel in campaign.channels.items():
            if channel.output == channel_or_output:
                primitives.append(replace(primitive, channel=channel_name))  # type: ignore[call-arg]
    return ModelPatch(tuple(primitives))


def observe_response(
    campaign: Campaign,
    trial: Trial,
    patch: ModelPatch,
    conditions: Conditions,
    response: Response,
    across: Iterable[FloatArray] = (),
) -> Response:
    """Return the readings of the channels, given the response of their outputs; see `observe`.

    With this, several faults of sensors can be tried on one response, which must already be sampled
    by the clocks of the patch.

    Parameters
    ----------
    campaign, trial, patch, conditions
        As in `observe`.
    response : Response
        Values and rates (N, C) of the channels' outputs.
    across : iterable of (N, C) array
        Transverse strain and shear strain, on which the reading of a turned gauge depends; nothing
        if no gauge is turned.

    Raises
    ------
    CatalogueError
        If a sensor primitive names a channel that does not exist or has values that no sensor can
        have.
    """
    trial, patch = shift_clock_to_first_sample(trial, patch)
    strains = tuple(across)
    transverse, shear = strains if strains else (None, None)
    record = SensorRecord(
        tuple((name, campaign.channels[name].quantity.value) for name in trial.channels),
        trial.kind.value,
        trial.time,
        trial.start,
        trial.temperature,
        trial.run,
        _release_displacement(trial, conditions),
        trial.begins is not Start.UNKNOWN,
    )
    quantities = [(name, channel.quantity.value) for name, channel in campaign.channels.items()]
    with CatalogueError.instead_of(InvalidPatchError):
        check_channels(patch, quantities)
        values, rates = apply_sensors(
            patch,
            record,
            response.values,
            response.rates,
            transverse=transverse,
            shear=shear,
            high_pass=filtered_record,
        )
    return Response(values, rates)


def _release_displacement(trial: Trial, conditions: Conditions) -> float:
    """Return the displacement from which the structure is released, which scales a free gain.

    The displacement includes the deviation of a release from rest. For trials without a release it
    is 1.
    """
    if trial.kind is not TrialKind.RINGDOWN or trial.release is None:
        return 1.0
    displacement = trial.release.displacement
    if trial.release.at_rest and len(conditions.initial):
        displacement *= 1.0 + float(conditions.initial[0, 0])
    return displacement
