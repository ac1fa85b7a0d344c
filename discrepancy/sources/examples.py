"""Small campaigns to try: simulated trials of a model, with what every test has: noise, zeros, gains."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from discrepancy.campaign.noise import pre_trigger_record
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.campaign.writing import write_campaign
from discrepancy.checks.model_check import prior_mean
from discrepancy.errors import CampaignFileError, ModelError, said
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


@dataclass(frozen=True)
class ExamplePlan:
    """What an example measures; the defaults suit the wing of Kapteyn et al. 2021.

    Attributes
    ----------
    channels : tuple of Channel
        Their noise records say how noisy the sensors are; ring-downs replace them by recorded samples.
    force : float
        Largest static force [N].
    release : float
        Largest release displacement [m].
    load_factors : tuple of float
        Of the flights [1].
    duration, interval : float
        Of a ring-down and its samples [s].
    load_place : str or tuple of float
        Where the force acts.
    flight_channels : tuple of str
        Names of the channels that flights measure; empty: all.
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
        chosen = self.flight_channels if kind is TrialKind.FLIGHT else ()
        return chosen or tuple(channel.name for channel in self.channels)


def wing_plan(gauges: tuple[int, ...] = (1, 5, 9, 13, 18, 22)) -> ExamplePlan:
    """Return the plan of a wing test: some gauges of 2 microstrain and the tip's displacement of 0.05 mm."""
    strain = NoiseRecord(2e-6, 200.0)
    channels = [
        Channel(f"g{number}", Quantity.STRAIN, f"strain[{number}]", strain, 0.005, 2e-6) for number in gauges
    ]
    tip = Channel("tip", Quantity.DISPLACEMENT, "tip_displacement", NoiseRecord(5e-5, 200.0), 0.0, 1e-4)
    names = tuple(channel.name for channel in channels)
    return ExamplePlan((*channels, tip), flight_channels=names)


def plan_of(model: Model) -> ExamplePlan:
    """Return what an example measures: gauges and tip of a wing, every output of another model at rest.

    Raises
    ------
    ModelError
        If no force can act on the model.
    """
    if model.load_places is None:
        return wing_plan()
    if not model.load_places:
        raise ModelError(said("examples.no_force", model=model))
    outputs = tuple(name for name, quantity in model.quantities.items() if quantity.order == 0)
    return plan_for(model, outputs, model.load_places[0], model.largest_force)


def plan_for(
    model: Model,
    outputs: tuple[str, ...],
    load_place: str | tuple[float, float],
    largest_force: float = np.inf,
) -> ExamplePlan:
    """Return a plan for any model: loads that move it by 2 % of its length, noise of 0.1 % of what they show.

    Parameters
    ----------
    model : Model
        Gives its natural scales and the size of its outputs.
    outputs : tuple of str
        What is measured, one channel of the same name each.
    load_place : str or tuple of float
        Where the force acts.
    largest_force : float
        Which the model can take [N]; it may ask for less motion.

    Raises
    ------
    ModelError
        If the model lacks an output.
    """
    channels: dict[str, Channel] = {}
    for output in outputs:
        quantity = model.output_quantity(output)
        if quantity is None:
            raise ModelError(f"{model.name} has no output {output!r}: an example cannot measure it.")
        channels[output] = Channel(output, quantity, output, None, 0.005)
    bare = Campaign("", channels, (), None, {}, "")
    scales = model.scales(replace(bare, channels={}))
    period = 2.0 * np.pi / scales.angular_frequency
    motion = min(0.02 * scales.length, largest_force / scales.tip_stiffness)
    force, plan = motion * scales.tip_stiffness, ExamplePlan(tuple(channels.values()), load_place=load_place)
    plan = replace(plan, force=force, release=motion, duration=20.0 * period, interval=period / 50.0)
    trial = _blank("", TrialKind.STATIC, plan, np.array([force]), 0.0)
    seen = np.abs(observe(model, bare, trial, ModelPatch(), prior_mean(bare, model, trial)).values[0])
    noises = 1e-3 * np.where(seen > 0.0, seen, seen.max() or 1.0)
    sized = (
        replace(channel, noise=NoiseRecord(noise, 200.0), offset_deviation=2.0 * noise)
        for channel, noise in zip(plan.channels, noises.tolist(), strict=True)
    )
    return replace(plan, channels=tuple(sized))


def example_campaign(
    model: Model,
    kind: ExampleKind,
    seed: int,
    plan: ExamplePlan | None = None,
    patch: ModelPatch | None = None,
) -> Campaign:
    """Return a simulated campaign; equal seeds give equal campaigns to the last bit.

    Static: six load levels up and the same down, in two runs. Ring-down: releases from 1, 0.7, 0.5 and 0.3 of
    the largest displacement, the third held out, with 400 samples at rest for the noise record. Flight:
    steady turns at each load factor. What a test has and nobody wants is drawn for each trial: sensors'
    noise, their zeros and gains by their prior deviations, the release by its own.

    Parameters
    ----------
    model : Model
        What is simulated, at its prior mean.
    kind : str
        "static", "ringdown", "flight", "laboratory" or "complete".
    seed : int
        Of the `SeedSequence`.
    plan : ExamplePlan, optional
        By default `wing_plan()`.
    patch : ModelPatch, optional
        What the structure has and the model lacks; nothing by default.

    Raises
    ------
    CampaignFileError
        If there is no such kind of example.
    ModelError, CatalogueError
        As `discrepancy.system.sensing.observe`.
    """
    if kind not in _KINDS:
        raise CampaignFileError(f"There is no example {kind!r}: the kinds are {', '.join(_KINDS)}.")
    plan = wing_plan() if plan is None else plan
    patch = ModelPatch() if patch is None else patch
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    kinds = _KINDS[kind]
    measured = {name for item in kinds for name in plan.names(item)}
    channels = {channel.name: channel for channel in plan.channels if channel.name in measured}
    gains = {
        name: 1.0 + _known(channel.gain_deviation) * generator.normal() for name, channel in channels.items()
    }
    recorded = dict(channels)
    for name in plan.names(TrialKind.RINGDOWN) if TrialKind.RINGDOWN in kinds else ():
        channel = channels[name]
        if channel.noise is not None:
            samples = channel.noise.standard_deviation * generator.normal(size=_AT_REST_SAMPLES)
            noise = pre_trigger_record(samples, plan.interval, name, "the example")
            recorded[name] = replace(channel, noise=noise)
    bare = Campaign(f"Example: {kind}", channels, (), 20.0, {}, "")
    trials = tuple(
        _measure(model, bare, trial, patch, gains, generator)
        for item in kinds
        for trial in _trials(item, plan)
    )
    return replace(bare, channels=recorded, trials=trials)


def write_example(
    model: Model,
    folder: str | Path,
    kind: ExampleKind,
    seed: int,
    plan: ExamplePlan | None = None,
    patch: ModelPatch | None = None,
) -> Campaign:
    """Write `example_campaign` to a folder and return it as read from there; errors as there."""
    return read_campaign(write_campaign(example_campaign(model, kind, seed, plan, patch), folder))


# ---------------------------------------------------------------- parts


def _trials(kind: TrialKind, plan: ExamplePlan) -> list[Trial]:
    if kind is TrialKind.STATIC:
        levels = plan.force * np.arange(6) / 5.0
        return [
            _blank("loading", kind, plan, levels, start=0.0, run="A"),
            _blank("unloading", kind, plan, levels[::-1], start=600.0, run="A"),
            _blank("loading again", kind, plan, levels, start=3600.0, run="B", held_out=True),
        ]
    if kind is TrialKind.FLIGHT:
        factors = np.array(plan.load_factors)
        return [
            _blank("turns", kind, plan, factors, start=10000.0, run="flight"),
            _blank("turns again", kind, plan, factors[1:], start=11000.0, run="flight", held_out=True),
        ]
    time = plan.interval * np.arange(round(plan.duration / plan.interval) + 1)
    return [
        _blank(
            f"release {number}", kind, plan, time, start=5000.0 + 300.0 * number, run="A",
            release=Release(share * plan.release, 0.02, mode_count=3), held_out=number == 3,
        )
        for number, share in enumerate((1.0, 0.7, 0.5, 0.3), start=1)
    ]  # fmt: skip


def _blank(
    name: str, kind: TrialKind, plan: ExamplePlan, rows: np.ndarray, start: float, **given: Any
) -> Trial:
    """Return a trial without readings; `rows` are forces, load factors or times."""
    time = rows if kind is TrialKind.RINGDOWN else np.full(len(rows), start)
    what = {TrialKind.STATIC: {"force": rows}, TrialKind.FLIGHT: {"load_factor": rows}}.get(kind, {})
    return Trial.plain(
        name, kind, plan.names(kind), time, load_place=plan.load_place, start=start, **what, **given
    )


def _measure(
    model: Model,
    campaign: Campaign,
    trial: Trial,
    patch: ModelPatch,
    gains: Mapping[str, float],
    generator: np.random.Generator,
) -> Trial:
    conditions = prior_mean(campaign, model, trial)
    if trial.release is not None:
        initial = conditions.initial.copy()
        initial[0, 0] = trial.release.deviation * generator.normal()
        conditions = Conditions(conditions.parameters, initial, (0.0, 0.0), trial.health)
    values = observe(model, campaign, trial, patch, conditions).values.copy()
    for column, name in enumerate(trial.channels):
        channel = campaign.channels[name]
        values[:, column] = values[:, column] * gains[name]
        values[:, column] += _known(channel.offset_deviation) * generator.normal()
        values[:, column] += channel.noise_in(trial) * generator.normal(size=len(values))
    return replace(trial, values=values)


def _known(deviation: float) -> float:
    return deviation if np.isfinite(deviation) else 0.0
