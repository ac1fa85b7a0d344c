"""What the channels of a trial would show: the response of a model, seen through the sensors of a patch."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Start, Trial, TrialKind
from discrepancy.errors import CatalogueError, ModelError, said
from discrepancy.system.interface import Model
from discrepancy.system.response import ACROSS, Conditions, Response
from fe.high_pass import filtered_record
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import EVERY_CHANNEL, SENSORS, LoggerClock, ModelPatch, Primitive, SensorRotation
from fe.runtime.sensors import SensorRecord, apply_sensors, check_channels, clock_of


def in_own_clock(trial: Trial, patch: ModelPatch) -> tuple[Trial, ModelPatch]:
    """Return a trial whose stamps count from its first sample, if they are of another clock, and its patch.

    Stamps of an epoch or of a logger that ran before are far from zero: models count from the trial's begin.
    Those of a record that begins within its own length of zero stay, as a release is at zero.

    Parameters
    ----------
    trial : Trial
        With the stamps that its user gave.
    patch : ModelPatch
        Its windows are in these stamps, and move with them.
    """
    if not trial.is_dynamic or len(trial.time) < 2:
        return trial, patch
    first, last = float(trial.time[0]), float(trial.time[-1])
    if abs(first) <= last - first:
        return trial, patch
    primitives = []
    for item in patch:
        windows = tuple(
            window._replace(
                begin=None if window.begin is None else window.begin - first,
                end=None if window.end is None else window.end - first,
            )
            for window in item.windows
        )
        primitives.append(replace(item, windows=windows) if windows else item)
    return replace(trial, time=trial.time - first), ModelPatch(tuple(primitives))


def observe(
    model: Model, campaign: Campaign, trial: Trial, patch: ModelPatch, conditions: Conditions
) -> Response:
    """Return what the channels of a trial would show; gains and zeros that are nuisances are not in it.

    Parameters
    ----------
    model : Model
        Gives the response under the structure, force and load primitives of the patch. Sensors that it has
        built in act before those of the patch.
    campaign : Campaign
        Whose channels the trial names.
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
        If a sensor primitive names a channel that does not exist or has values that no sensor can have.
    """
    patch = (_by_channels(model.sensors, campaign) + patch).in_trial(trial.name)
    trial, patch = in_own_clock(trial, patch)
    outputs, count = campaign.outputs(trial), len(trial.channels)
    if not len(patch.of(*SENSORS)):
        return model.respond(trial, outputs, patch, conditions)
    rate, zero = clock_of(patch)
    clock = (conditions.clock[0] + rate, conditions.clock[1] + zero)
    bare = patch.without(*SENSORS)
    # inputs at their true times, each channel sampled by its own clock; clocks are right at the first stamp
    inputs, by_channel = _logger_rates(campaign, trial, patch)
    first = float(trial.time[0])
    stamped = replace(trial, time=trial.time + inputs * (trial.time - first)) if inputs else trial
    turned = [column for column, (_, quantity) in enumerate(outputs) if quantity is Quantity.STRAIN]
    turned *= len(patch.of(SensorRotation)) > 0
    outputs += tuple((outputs[column][0] + part, Quantity.STRAIN) for part in ACROSS for column in turned)
    if not all(model.output_quantity(output) for output, _ in outputs[count:]):
        raise ModelError(said("models.turned_gauge", model=model))
    values = np.zeros((len(trial.time), len(outputs)))
    slopes, by_output = np.zeros_like(values), np.append(by_channel, np.tile(by_channel[turned], 2))
    for rate in np.unique(by_channel).tolist():
        beside = (rate - inputs) / (1.0 + inputs) * (1.0 + clock[0]) + clock[0]
        own_clock = beside, clock[1] - beside * first
        found = model.respond(stamped, outputs, bare, replace(conditions, clock=own_clock))
        own = by_output == rate
        values[:, own] = found.values[:, own]
        if found.rates is not None:
            slopes[:, own] = found.rates[:, own]
    width = len(turned)
    across = np.zeros((2, len(values), count))
    across[:, :, turned] = values[:, count : count + width], values[:, count + width :]
    seen = Response(values[:, :count], slopes[:, :count] if trial.is_dynamic else None)
    return observe_response(campaign, trial, patch, conditions, seen, across)


def _logger_rates(campaign: Campaign, trial: Trial, patch: ModelPatch) -> tuple[float, FloatArray]:
    """Return the clock rates of a trial's inputs, and of its channels (C,), less one.

    Raises
    ------
    CatalogueError
        If a patch names a logger that the campaign does not have.
    """
    inputs, channels = 1.0, np.ones(len(trial.channels))
    for item in (item for item in patch if isinstance(item, LoggerClock) and trial.is_dynamic):
        members = (*trial.channels, *trial.input_names)
        if item.logger != EVERY_CHANNEL:
            if item.logger not in campaign.loggers:
                known = ", ".join(map(repr, campaign.loggers)) or "one for all, '*'"
                raise CatalogueError(f"The campaign has no logger {item.logger!r}; it has {known}.")
            members = campaign.loggers[item.logger]
        channels = channels * np.array([1.0 + item.rate * (name in members) for name in trial.channels])
        if item.logger == EVERY_CHANNEL or any(name in members for name in trial.input_names):
            inputs *= 1.0 + item.rate
    return inputs - 1.0, channels - 1.0


def _by_channels(sensors: ModelPatch, campaign: Campaign) -> ModelPatch:
    """Return sensor primitives for the channels of their name, else those that measure the output of it."""
    found: list[Primitive] = []
    for item in sensors:
        output = getattr(item, "channel", EVERY_CHANNEL)
        own = output == EVERY_CHANNEL or output in campaign.channels
        names = [name for name, channel in campaign.channels.items() if channel.output == output]
        found += [item] if own else [replace(item, channel=name) for name in names]  # type: ignore[call-arg]
    return ModelPatch(tuple(found))


def observe_response(
    campaign: Campaign, trial: Trial, patch: ModelPatch, conditions: Conditions, response: Response,
    across: Iterable[FloatArray] = (),
) -> Response:  # fmt: skip
    """Return what the channels show of a response that is known already; see `observe`.

    For callers that keep the response of a structure and try sensors on it. The clock of the patch must be in
    the response. `across` are transverse and shear strain (N, C), which turned gauges see.
    """
    trial, patch = in_own_clock(trial, patch)
    release = 1.0  # the nominal one; where the motion starts from the static shape, as that is scaled
    if trial.kind is TrialKind.RINGDOWN and trial.release is not None:
        release = trial.release.displacement
        if trial.release.at_rest and len(conditions.initial):
            release *= 1.0 + float(conditions.initial[0, 0])
    record = SensorRecord(
        tuple((name, campaign.channels[name].quantity.value) for name in trial.channels), trial.kind.value,
        trial.time, trial.start, trial.temperature, trial.run, release, trial.begins is not Start.UNKNOWN,
    )  # fmt: skip
    with CatalogueError.instead_of(InvalidPatchError):
        check_channels(patch, [(name, channel.quantity.value) for name, channel in campaign.channels.items()])
        return Response(*apply_sensors(patch, record, *response, *across, filtered=filtered_record))
