"""What the channels of a trial would show: a model's response with the sensors of a patch."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
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
    """Clock rates, less one, of a trial's inputs and of its channels (C,)."""

    inputs: float
    channels: FloatArray


@dataclass(frozen=True)
class TurnedGauges:
    """Channels of a trial whose gauges are turned, and the outputs across them that they see.

    Attributes
    ----------
    columns : list of int
        Columns of these channels; empty if the patch turns no gauge.
    outputs : tuple of (str, Quantity)
        All outputs that are asked of the model: those of the channels, then the transverse strain
        of each turned gauge, then the shear strain of each.
    """

    columns: list[int]
    outputs: Outputs


def in_own_clock(trial: Trial, patch: ModelPatch) -> tuple[Trial, ModelPatch]:
    """Return a trial and its patch in a clock that starts at the trial's begin.

    Stamps of an epoch or of a logger that ran before are far from zero, and models count from the
    trial's begin. Stamps that begin within the record's length of zero stay, since a release is at
    zero.

    Parameters
    ----------
    trial : Trial
        Trial with the stamps that its user gave.
    patch : ModelPatch
        Patch whose windows are in these stamps; they move with them.
    """
    if not trial.is_dynamic or len(trial.time) < 2:
        return trial, patch
    first = float(trial.time[0])
    last = float(trial.time[-1])
    if abs(first) <= last - first:
        return trial, patch
    primitives = []
    for primitive in patch:
        windows = tuple(_moved_window(window, first) for window in primitive.windows)
        primitives.append(replace(primitive, windows=windows) if windows else primitive)
    return replace(trial, time=trial.time - first), ModelPatch(tuple(primitives))


def _moved_window(window: Window, first: float) -> Window:
    """Return a window in a clock that is zero at a time `first` [s]."""
    begin = None if window.begin is None else window.begin - first
    end = None if window.end is None else window.end - first
    return window._replace(begin=begin, end=end)


def observe(
    model: Model, campaign: Campaign, trial: Trial, patch: ModelPatch, conditions: Conditions
) -> Response:
    """Return what the channels of a trial would show, without gains and zeros that are fitted.

    Parameters
    ----------
    model : Model
        Model that responds to the structure, force and load primitives of the patch. Sensors that
        it has built in act before those of the patch.
    campaign : Campaign
        Campaign with the channels that the trial names.
    trial : Trial
        Inputs and sample times.
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
    patch = (_by_channels(model.sensors, campaign) + patch).in_trial(trial.name)
    trial, patch = in_own_clock(trial, patch)
    if not len(patch.of(*SENSORS)):
        return model.respond(trial, campaign.outputs(trial), patch, conditions)
    gauges = _turned_gauges(model, campaign, trial, patch)
    response = _response_in_clocks(model, campaign, trial, patch, conditions, gauges)
    # the channels, and the strain across turned gauges
    count = len(trial.channels)
    turned_count = len(gauges.columns)
    values = response.values
    transverse = np.zeros((len(values), count))
    shear = np.zeros((len(values), count))
    transverse[:, gauges.columns] = values[:, count : count + turned_count]
    shear[:, gauges.columns] = values[:, count + turned_count :]
    rates = response.rates[:, :count] if response.rates is not None else None
    of_channels = Response(values[:, :count], rates)
    return observe_response(campaign, trial, patch, conditions, of_channels, (transverse, shear))


def _turned_gauges(
    model: Model, campaign: Campaign, trial: Trial, patch: ModelPatch
) -> TurnedGauges:
    """Return the gauges that a patch turns, and all outputs that are asked of the model.

    Raises
    ------
    ModelError
        If the model gives no strain across a turned gauge.
    """
    outputs = campaign.outputs(trial)
    if not len(patch.of(SensorRotation)):
        return TurnedGauges([], outputs)
    columns = [
        column for column, (_, quantity) in enumerate(outputs) if quantity is Quantity.STRAIN
    ]
    across = []
    for ending in ACROSS:
        across += [(outputs[column][0] + ending, Quantity.STRAIN) for column in columns]
    if not all(model.output_quantity(output) for output, _ in across):
        raise ModelError(
            f"{model.name} gives no transverse and shear strain, so a turned gauge cannot be "
            "computed: leave gauge misalignment out for this model."
        )
    return TurnedGauges(columns, (*outputs, *across))


def _response_in_clocks(
    model: Model,
    campaign: Campaign,
    trial: Trial,
    patch: ModelPatch,
    conditions: Conditions,
    gauges: TurnedGauges,
) -> Response:
    """Return the response of all outputs, each sampled by the clock of its own logger.

    Inputs act at their true times; all clocks are right at the first stamp.

    Parameters
    ----------
    model, campaign, trial, patch, conditions
        As in `observe`.
    gauges : TurnedGauges
        Outputs that are asked of the model.
    """
    without_sensors = patch.without(*SENSORS)
    patch_rate, patch_zero = clock_of(patch)
    clock_rate = conditions.clock[0] + patch_rate
    clock_zero = conditions.clock[1] + patch_zero
    rates = _logger_rates(campaign, trial, patch)
    first = float(trial.time[0])
    stamped = trial
    if rates.inputs:
        stamped = replace(trial, time=trial.time + rates.inputs * (trial.time - first))
    # outputs across a gauge are sampled with it
    output_rates = np.append(rates.channels, np.tile(rates.channels[gauges.columns], 2))
    values = np.zeros((len(trial.time), len(gauges.outputs)))
    slopes = np.zeros_like(values)
    for rate in np.unique(rates.channels).tolist():
        relative_rate = (rate - rates.inputs) / (1.0 + rates.inputs) * (
            1.0 + clock_rate
        ) + clock_rate
        logger_clock = relative_rate, clock_zero - relative_rate * first
        in_clock = replace(conditions, clock=logger_clock)
        response = model.respond(stamped, gauges.outputs, without_sensors, in_clock)
        is_sampled = output_rates == rate
        values[:, is_sampled] = response.values[:, is_sampled]
        if response.rates is not None:
            slopes[:, is_sampled] = response.rates[:, is_sampled]
    return Response(values, slopes if trial.is_dynamic else None)


def _logger_rates(campaign: Campaign, trial: Trial, patch: ModelPatch) -> LoggerRates:
    """Return by how much the clocks that sampled a trial's inputs and channels run fast.

    A rate of 0.01 means that the clock shows 1 % more time than has passed. Errors of several
    loggers on one channel multiply. A trial at rest has no clock, so that its rates are zero.

    Raises
    ------
    CatalogueError
        If a patch names a logger that the campaign does not have.
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
    """Return channels and inputs of a logger; raises `CatalogueError` if there is none."""
    if logger == EVERY_CHANNEL:
        return (*trial.channels, *trial.input_names)
    if logger not in campaign.loggers:
        loggers = ", ".join(map(repr, campaign.loggers)) or "one for all, '*'"
        raise CatalogueError(f"The campaign has no logger {logger!r}; it has {loggers}.")
    return tuple(campaign.loggers[logger])


def _by_channels(sensors: ModelPatch, campaign: Campaign) -> ModelPatch:
    """Return sensor primitives for channels, those that name an output for each channel of it."""
    primitives: list[Primitive] = []
    for primitive in sensors:
        name = getattr(primitive, "channel", EVERY_CHANNEL)
        if name == EVERY_CHANNEL or name in campaign.channels:
            primitives.append(primitive)
            continue
        for channel_name, channel in campaign.channels.items():
            if channel.output == name:
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
    """Return what the channels show of a response that is known already; see `observe`.

    For callers that keep the response of a structure and try sensors on it. The clock of the patch
    must be in the response.

    Parameters
    ----------
    campaign, trial, patch, conditions
        As in `observe`.
    response : Response
        Values and rates (N, C) of the channels' outputs.
    across : iterable of (N, C) array
        Transverse and shear strain, which turned gauges see.

    Raises
    ------
    CatalogueError
        If a sensor primitive names a channel that does not exist or has values that no sensor can
        have.
    """
    trial, patch = in_own_clock(trial, patch)
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
    """Return the displacement of the release, scaled as the static shape is; 1 if there is none."""
    if trial.kind is not TrialKind.RINGDOWN or trial.release is None:
        return 1.0
    displacement = trial.release.displacement
    if trial.release.at_rest and len(conditions.initial):
        displacement *= 1.0 + float(conditions.initial[0, 0])
    return displacement
