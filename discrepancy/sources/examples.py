"""Small campaigns to try: simulated trials of a model with noise, zeros and errors of gain."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from discrepancy.campaign.noise_records import pre_trigger_record
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    FloatArray,
    NoiseRecord,
    Quantity,
    Trial,
    TrialKind,
)
from discrepancy.campaign.writing import write_campaign
from discrepancy.checks.model_check import prior_conditions
from discrepancy.errors import CampaignFileError, ModelError
from discrepancy.system.interface import Model
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch

ExampleKind = Literal["static", "ringdown", "flight", "laboratory", "complete"]
"""What is measured: one kind of trial, static and ring-down, or all three."""

_KINDS: dict[str, tuple[TrialKind, ...]] = {
    "static": (TrialKind.STATIC,),
    "ringdown": (TrialKind.RINGDOWN,),
    "flight": (TrialKind.FLIGHT,),
    "laboratory": (TrialKind.STATIC, TrialKind.RINGDOWN),
    "complete": (TrialKind.STATIC, TrialKind.RINGDOWN, TrialKind.FLIGHT),
}
_AT_REST_SAMPLES = 400
"""Samples at rest of the noise record of a channel."""


@dataclass(frozen=True)
class ExamplePlan:
    """What an example measures; the defaults suit the wing of Kapteyn et al. 2021.

    Attributes
    ----------
    channels : tuple of Channel
        Channels, with the noise of their sensors; with ring-downs their noise records hold samples.
    force : float
        The largest static force [N].
    release : float
        The largest displacement before a release [m].
    load_factors : tuple of float
        The load factors of the flights [1].
    duration, interval : float
        The duration and sampling interval of a ring-down [s].
    load_place : str or tuple of float
        The point at which the force acts.
    flight_channels : tuple of str
        The names of the channels that flights measure; all if empty.
    """

    channels: tuple[Channel, ...]
    force: float = 10.0
    release: float = 0.015
    load_factors: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5, 3.0)
    duration: float = 2.0
    interval: float = 0.002
    load_place: str | tuple[float, float] = "tip_load"
    flight_channels: tuple[str, ...] = ()

    def names(self, kind: TrialKind) -> tuple[str, ...]:
        """Return the names of the channels that a kind of trial measures."""
        if kind is TrialKind.FLIGHT and self.flight_channels:
            return self.flight_channels
        return tuple(channel.name for channel in self.channels)


def wing_plan(gauges: tuple[int, ...] = (1, 5, 9, 13, 18, 22)) -> ExamplePlan:
    """Return the plan of a test of the wing, with a channel for each gauge and one for the tip.

    The gauges have a noise of 2 microstrain, and the displacement of the tip has one of 0.05 mm,
    both with 200 degrees of freedom. Flights measure the gauges only.

    Parameters
    ----------
    gauges : tuple of int
        The numbers of the gauges, from 1.
    """
    channels = []
    for number in gauges:
        channels.append(
            Channel(
                name=f"g{number}",
                quantity=Quantity.STRAIN,
                output=f"strain[{number}]",
                noise=NoiseRecord(2e-6, 200.0),
                gain_deviation=0.005,
                offset_deviation=2e-6,
            )
        )
    tip = Channel(
        name="tip",
        quantity=Quantity.DISPLACEMENT,
        output="tip_displacement",
        noise=NoiseRecord(5e-5, 200.0),
        offset_deviation=1e-4,
    )
    names_of_gauges = tuple(channel.name for channel in channels)
    return ExamplePlan((*channels, tip), flight_channels=names_of_gauges)


def usual_plan(model: Model) -> ExamplePlan:
    """Return the usual plan for a model: gauges and tip of a wing, else all outputs of order zero.

    Velocities and accelerations are not measured. The force acts at the first load place.

    Raises
    ------
    ModelError
        If no force can act on the model.
    """
    if model.load_places is None:
        return wing_plan()
    if not model.load_places:
        raise ModelError(
            f"{model.name} has no force, and an example is made by forces: write a campaign of it."
        )
    outputs = tuple(name for name, quantity in model.quantities.items() if quantity.order == 0)
    return plan_from_scales(model, outputs, model.load_places[0], model.largest_force)


def plan_from_scales(
    model: Model,
    outputs: tuple[str, ...],
    load_place: str | tuple[float, float],
    largest_force: float = np.inf,
) -> ExamplePlan:
    """Return a plan for any model, from its natural scales.

    The largest load moves the model by 2 % of its length. The noise of a channel is 0.1 % of its
    reading under that load, and the deviation of its zero twice that. Ring-downs last 20 periods of
    the first mode, with 50 samples in each.

    Parameters
    ----------
    model : Model
        The model that predicts the readings.
    outputs : tuple of str
        The outputs that are measured, each by a channel of the same name.
    load_place : str or tuple of float
        The point at which the force acts.
    largest_force : float
        The largest force that the model can take [N]; it may limit the motion.

    Raises
    ------
    ModelError
        If the model lacks an output.
    """
    channels: dict[str, Channel] = {}
    for output in outputs:
        quantity = model.output_quantity(output)
        if quantity is None:
            raise ModelError(
                f"{model.name} has no output {output!r}: an example cannot measure it."
            )
        channels[output] = Channel(output, quantity, output, noise=None, gain_deviation=0.005)
    campaign = _campaign_without_trials("", channels, reference_temperature=None)
    scales = model.scales(replace(campaign, channels={}))
    period = 2.0 * np.pi / scales.angular_frequency
    motion = min(0.02 * scales.length, largest_force / scales.tip_stiffness)
    force = motion * scales.tip_stiffness
    plan = ExamplePlan(
        tuple(channels.values()),
        force=force,
        release=motion,
        duration=20.0 * period,
        interval=period / 50.0,
        load_place=load_place,
    )
    # noise from the readings (C,) under the largest force; a channel that shows nothing gets the
    # noise of the channel with the largest reading
    trial = _planned_static_trial("", plan, np.array([force]), start=0.0)
    conditions = prior_conditions(campaign, model, trial)
    readings = np.abs(observe(model, campaign, trial, ModelPatch(), conditions).values[0])
    noises = 1e-3 * np.where(readings > 0.0, readings, readings.max() or 1.0)
    noisy_channels = []
    for channel, noise in zip(plan.channels, noises.tolist(), strict=True):
        noisy_channels.append(
            replace(channel, noise=NoiseRecord(noise, 200.0), offset_deviation=2.0 * noise)
        )
    return replace(plan, channels=tuple(noisy_channels))


def _campaign_without_trials(
    name: str, channels: Mapping[str, Channel], reference_temperature: float | None
) -> Campaign:
    """Return a campaign with channels, but without trials."""
    return Campaign(
        name=name,
        channels=channels,
        trials=(),
        reference_temperature=reference_temperature,
        parameters={},
        data_hash="",
    )


def example_campaign(
    model: Model,
    kind: ExampleKind,
    seed: int,
    plan: ExamplePlan | None = None,
    patch: ModelPatch | None = None,
) -> Campaign:
    """Return a simulated campaign; equal seeds give equal campaigns to the last bit.

    Static trials have six load levels, upwards, downwards, and upwards again in a second run, which
    is held out. Ring-downs are released from 1, 0.7, 0.5 and 0.3 of the largest displacement; the
    third is held out, and 400 samples at rest give the noise record. Flights are steady turns at
    each load factor. The errors of a real test are drawn from their priors: gains once for the
    campaign, and noise, zeros and the error of the release for each trial.

    Parameters
    ----------
    model : Model
        The model that is simulated, at its prior mean.
    kind : str
        "static", "ringdown", "flight", "laboratory" or "complete".
    seed : int
        The entropy of the `SeedSequence` from which all random draws come.
    plan : ExamplePlan, optional
        What is measured; `wing_plan()` by default.
    patch : ModelPatch, optional
        The effects that the structure has and the model lacks; none by default.

    Raises
    ------
    CampaignFileError
        If there is no such kind of example.
    ModelError, CatalogueError
        For the causes of `discrepancy.system.sensing.observe`.
    """
    if kind not in _KINDS:
        raise CampaignFileError(f"There is no example {kind!r}: the kinds are {', '.join(_KINDS)}.")
    if plan is None:
        plan = wing_plan()
    if patch is None:
        patch = ModelPatch()
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    kinds = _KINDS[kind]
    measured_channels = {name for trial_kind in kinds for name in plan.names(trial_kind)}
    channels = {
        channel.name: channel for channel in plan.channels if channel.name in measured_channels
    }
    gains = {}
    for name, channel in channels.items():
        gains[name] = 1.0 + _finite_or_zero(channel.gain_deviation) * generator.normal()
    recorded_channels = dict(channels)
    if TrialKind.RINGDOWN in kinds:
        for name in plan.names(TrialKind.RINGDOWN):
            recorded_channels[name] = _with_samples_at_rest(channels[name], plan, generator)
    campaign = _campaign_without_trials(f"Example: {kind}", channels, reference_temperature=20.0)
    trials = []
    for trial_kind in kinds:
        for trial in _planned_trials(trial_kind, plan):
            trials.append(_simulate_readings(model, campaign, trial, patch, gains, generator))
    return replace(campaign, channels=recorded_channels, trials=tuple(trials))


def _with_samples_at_rest(
    channel: Channel, plan: ExamplePlan, generator: np.random.Generator
) -> Channel:
    """Return a channel whose noise record holds simulated samples at rest.

    A channel without noise is returned as it is, and takes no random numbers.
    """
    if channel.noise is None:
        return channel
    samples = channel.noise.standard_deviation * generator.normal(size=_AT_REST_SAMPLES)
    noise = pre_trigger_record(samples, plan.interval, channel.name, "the example")
    return replace(channel, noise=noise)


def write_example(
    model: Model,
    folder: str | Path,
    kind: ExampleKind,
    seed: int,
    plan: ExamplePlan | None = None,
    patch: ModelPatch | None = None,
) -> Campaign:
    """Write an `example_campaign` to a folder, and return it as read from there.

    Parameters and errors are those of `example_campaign`, and the folder.
    """
    campaign = example_campaign(model, kind, seed, plan, patch)
    return read_campaign(write_campaign(campaign, folder))


# ---------------------------------------------------------------- trials


def _planned_trials(kind: TrialKind, plan: ExamplePlan) -> list[Trial]:
    """Return the trials of a kind without readings; one of each kind is held out.

    Three static trials load, unload and load the model again in steps of a fifth of the plan's
    force. Two flights take its load factors, the second without the first of them. Four ring-downs
    are released from fractions of its displacement.
    """
    if kind is TrialKind.STATIC:
        levels = plan.force * np.arange(6, dtype=np.float64) / 5.0
        return [
            _planned_static_trial("loading", plan, levels, start=0.0, run="A"),
            _planned_static_trial("unloading", plan, levels[::-1], start=600.0, run="A"),
            _planned_static_trial(
                "loading again", plan, levels, start=3600.0, run="B", held_out=True
            ),
        ]
    if kind is TrialKind.FLIGHT:
        factors = np.array(plan.load_factors)
        return [
            _planned_flight("turns", plan, factors, start=10000.0),
            _planned_flight("turns again", plan, factors[1:], start=11000.0, held_out=True),
        ]
    samples = np.arange(round(plan.duration / plan.interval) + 1, dtype=np.float64)
    time = plan.interval * samples
    releases = []
    for number, fraction in enumerate((1.0, 0.7, 0.5, 0.3), start=1):
        releases.append(
            Trial.plain(
                f"release {number}",
                kind,
                plan.names(kind),
                time,
                load_place=plan.load_place,
                start=5000.0 + 300.0 * number,
                run="A",
                release=Release(fraction * plan.release, deviation=0.02, mode_count=3),
                held_out=number == 3,
            )
        )
    return releases


def _planned_static_trial(
    name: str, plan: ExamplePlan, forces: FloatArray, start: float, **fields: object
) -> Trial:
    """Return a static trial without readings, with a row for each force [N]."""
    return Trial.plain(
        name,
        TrialKind.STATIC,
        plan.names(TrialKind.STATIC),
        np.full(len(forces), start),
        force=forces,
        load_place=plan.load_place,
        start=start,
        **fields,
    )


def _planned_flight(
    name: str, plan: ExamplePlan, load_factors: FloatArray, start: float, **fields: object
) -> Trial:
    """Return a flight without readings, with a row for each load factor [1]."""
    return Trial.plain(
        name,
        TrialKind.FLIGHT,
        plan.names(TrialKind.FLIGHT),
        np.full(len(load_factors), start),
        load_factor=load_factors,
        load_place=plan.load_place,
        start=start,
        run="flight",
        **fields,
    )


def _simulate_readings(
    model: Model,
    campaign: Campaign,
    trial: Trial,
    patch: ModelPatch,
    gains: Mapping[str, float],
    generator: np.random.Generator,
) -> Trial:
    """Return a trial with simulated readings of a structure: the model, and the effects of a patch.

    The errors of the release and of the zeros, and the noise, are drawn from the generator; the
    gains are given by channel.
    """
    conditions = prior_conditions(campaign, model, trial)
    if trial.release is not None:
        # the first entry is the relative deviation of the whole release shape
        initial_modes = conditions.initial.copy()
        initial_modes[0, 0] = trial.release.deviation * generator.normal()
        conditions = Conditions(conditions.parameters, initial_modes, (0.0, 0.0), trial.health)
    values = observe(model, campaign, trial, patch, conditions).values.copy()
    for column, name in enumerate(trial.channels):
        channel = campaign.channels[name]
        zero = _finite_or_zero(channel.offset_deviation) * generator.normal()
        noise = trial.noise_deviation(channel) * generator.normal(size=len(values))
        values[:, column] = values[:, column] * gains[name]
        values[:, column] += zero
        values[:, column] += noise
    return replace(trial, values=values)


def _finite_or_zero(deviation: float) -> float:
    """Return a standard deviation; 0 for an infinite one, since no error can be drawn from it."""
    return deviation if np.isfinite(deviation) else 0.0
