"""Effects of sensors: thermal strain, zero drift, gain, misalignment of a gauge, AC coupling."""

from collections.abc import Mapping
from contextlib import suppress
from math import isinf, pi

import numpy as np

from discrepancy.catalogue.building import (
    DYNAMIC,
    EVERY_TRIAL,
    at_gauges,
    at_strain_channels,
    campaign_times,
    channels,
    largest_reading,
    needs,
    somewhere,
    temperature_varies,
    trial_of,
    trials,
    with_all,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, Response
from fe.runtime.patch import HighPass, ModelPatch, SensorDrift, SensorGain, SensorRotation, ThermalStrain

_NO_STRAIN = "The campaign has no strain channel."


def _thermal_places(setting: Setting) -> tuple[str, ...]:
    return with_all(at_strain_channels(setting))


def _thermal_strain(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((ThermalStrain(place, values["coefficient"]),))


def _drifting(setting: Setting) -> tuple[str, ...]:
    """Return the gauges that were read at more than one time since the campaign's start."""
    places = []
    for name in at_gauges(setting):
        first, last = campaign_times(setting, name)
        if last > max(first, 0.0):
            places.append(name)
    return tuple(places)


def _zero_drift(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    amplitude = values["drift_ratio"] * largest_reading(setting, (place,))
    return ModelPatch((SensorDrift(place, amplitude, setting.scales.campaign_time, values["exponent"]),))


def _calibrated(setting: Setting) -> tuple[str, ...]:
    """Return the channels whose gain is known at all: a free gain absorbs an error of it."""
    return tuple(channel.name for channel in channels(setting) if not isinf(channel.gain_deviation))


def _gauge_gain(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((SensorGain(place, values["gain_error"]),))


def _misalignment(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((SensorRotation(place, values["angle"]),))


def _strain_components(setting: Setting) -> str | None:
    """Return why a turned gauge cannot be computed, None if the model gives strain across and in shear."""
    model, campaign = setting.model, setting.campaign
    names = at_strain_channels(setting)
    trial = next(trial for trial in trials(setting) if any(name in names for name in trial.channels))
    channel = campaign.channels[next(name for name in trial.channels if name in names)]
    means = [campaign.parameters.get(item.name, (item.mean, 0.0))[0] for item in model.parameters]
    conditions = Conditions(np.array(means), health=trial.health)
    given: Response | None = None
    with suppress(ModelError):
        given = model.respond(
            trial, ((channel.output, channel.quantity),), ModelPatch(), conditions, components=True
        )
    if given is None or given.transverse is None or given.shear is None:
        return f"The model {model.name!r} gives no transverse and shear strain, which a turned gauge sees."
    return None


def _dynamic_channels(setting: Setting) -> tuple[str, ...]:
    return with_all(tuple(channel.name for channel in channels(setting, kinds=DYNAMIC)))


def _high_pass(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    corner = values["corner_ratio"] * setting.scales.angular_frequency
    if corner == 0.0:
        return ModelPatch()  # a corner at zero passes everything
    return ModelPatch((HighPass(place, 1.0 / corner, values["order"]),))


THERMAL_STRAIN = Effect(
    identifier="thermal_strain",
    name="thermal strain of a gauge",
    family="sensor zero",
    equation="eps -> eps + a (T - T_ref)",
    signature="Strain readings follow the temperature and not the load; displacement does not.",
    reference="Hoffmann 1989, An Introduction to Measurements using Strain Gages",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "coefficient",
            "a",
            "1/K",
            "apparent strain per kelvin",
            Prior("normal", -15e-6, 15e-6),
            magnitude=True,
        ),
    ),
    build=_thermal_strain,
    places=_thermal_places,
    unavailable=needs(temperature_varies, somewhere(at_strain_channels, _NO_STRAIN)),
    confusable=("gauge_zero_drift", "temperature_dependent_modulus"),
)

GAUGE_ZERO_DRIFT = Effect(
    identifier="gauge_zero_drift",
    name="zero drift of a gauge",
    family="sensor zero",
    equation="eps -> eps + a (t / T)^n, n = 1, t since the campaign's start",
    signature="One channel moves with the time of the campaign, whatever the load.",
    reference="Hoffmann 1989, An Introduction to Measurements using Strain Gages",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "drift_ratio",
            "a / eps_max",
            "1",
            "drift over the campaign over the channel's largest reading",
            Prior("normal", -0.20, 0.20),
            magnitude=True,
        ),
    ),
    build=_zero_drift,
    shape=(ShapeParameter("exponent", "n", "exponent of the time", 1.0, Prior("uniform", 0.2, 3.0)),),
    places=_drifting,
    unavailable=needs(
        somewhere(at_gauges, "The campaign has no channel to fit."),
        somewhere(_drifting, "The campaign does not say at which times its channels were read."),
    ),
    confusable=("thermal_strain", "seating_offset"),
)

GAUGE_GAIN = Effect(
    identifier="gauge_gain",
    name="gain error of a sensor",
    family="sensor gain",
    equation="y -> (1 + g) y",
    signature="One channel is off by the same share in every trial.",
    reference="Hoffmann 1989, An Introduction to Measurements using Strain Gages",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "gain_error",
            "g",
            "1",
            "relative error of the gauge factor or sensitivity, and amplifier",
            Prior("normal", -0.15, 0.15),
            magnitude=True,
        ),
    ),
    build=_gauge_gain,
    places=_calibrated,
    unavailable=needs(
        somewhere(_calibrated, "The campaign has no channel whose gain is known, so no gain can be wrong."),
    ),
    confusable=("gauge_misalignment", "local_stiffness_loss"),
)

GAUGE_MISALIGNMENT = Effect(
    identifier="gauge_misalignment",
    name="misalignment of a gauge",
    family="sensor gain",
    equation="eps = (eps_x + eps_y)/2 + (eps_x - eps_y)/2 cos 2 theta + gamma_xy/2 sin 2 theta",
    signature="One channel reads less than it should in bending, and more or less where the skin shears.",
    reference="Window 1992, Strain Gauge Technology, 2nd ed.",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "angle",
            "theta",
            "rad",
            "angle from the spanwise direction, in the skin",
            Prior("normal", -15.0 * pi / 180.0, 15.0 * pi / 180.0),
            magnitude=True,
            levels=2,  # shear makes the two senses differ
        ),
    ),
    build=_misalignment,
    places=at_strain_channels,
    unavailable=needs(somewhere(at_strain_channels, _NO_STRAIN), _strain_components),
    confusable=("gauge_gain", "local_stiffness_loss"),
)

# The corner is no magnitude: however low, a filter that had settled takes off the value before a release.
HIGH_PASS = Effect(
    identifier="high_pass",
    name="high-pass of a piezo gauge or AC coupling",
    family="filter of order n",
    equation="eps -> (tau s / (1 + tau s))^n eps, n = 1, 1 / tau = r w_1",
    signature="The record returns to zero, undershoots after a step, and low frequencies lead in phase.",
    reference="Doebelin 2004, Measurement Systems: Application and Design, 5th ed.",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "corner_ratio",
            "r",
            "1",
            "corner over the first frequency, 1 / (w_1 tau)",
            Prior("log_normal", 0.005, 1.0),
        ),
    ),
    build=_high_pass,
    shape=(ShapeParameter("order", "n", "order of the filter", 1.0, Prior("uniform", 0.3, 3.0)),),
    places=_dynamic_channels,
    unavailable=needs(trial_of(DYNAMIC)),
    confusable=("gauge_zero_drift", "clock_error"),
)

EFFECTS = (THERMAL_STRAIN, GAUGE_ZERO_DRIFT, GAUGE_GAIN, GAUGE_MISALIGNMENT, HIGH_PASS)
