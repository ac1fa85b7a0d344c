"""Effects of nonlinear and slowly changing stiffness: cubic, breathing crack, free play, seating, drift."""

from collections.abc import Mapping
from math import isinf

from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.catalogue.building import (
    DYNAMIC,
    EVERY_TRIAL,
    applied_force,
    at_ports,
    carried,
    channels,
    has_port,
    needs,
    over_the_planform,
    port_scale,
    removed_stiffness,
    somewhere,
    trial_of,
    trials,
    turning,
    turns_somewhere,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter
from fe.runtime.patch import FreePlay, ModelPatch, PowerStiffness, RunOffset, StiffnessDrift

FAMILY = "stiffness |x|^n, one- or two-sided"
SKINS = {"lower skin": 1, "upper skin": -1}
"""Skin that is cracked, and the sign of x that opens it: upward bending stretches the lower skin."""


def _cubic(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    scale = port_scale(setting, place)
    # in all trials: a softening that a ring-down bears may leave nothing of the stiffness in flight
    largest = scale.displacement if scale.largest_displacement is None else scale.largest_displacement
    exponent, asymmetry = values["exponent"], values["asymmetry"]
    # spread over a wing: the force of the first mode
    force = values["stiffening"] * scale.stiffness * largest / scale.mean_power(exponent + 1.0)
    if asymmetry == 0.0:
        return ModelPatch((PowerStiffness(place, force, exponent, 0, largest),))
    return ModelPatch(
        tuple(
            PowerStiffness(place, force * (1.0 + side * asymmetry), exponent, side, largest)
            for side in (1, -1)
        )
    )


def _skins(setting: Setting) -> tuple[str, ...]:
    return tuple(f"{port}, {skin}" for port in at_ports("root")(setting) for skin in SKINS)


def _breathing_crack(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    port, _, skin = place.rpartition(", ")
    scale = port_scale(setting, port)
    force = -removed_stiffness(setting, port, values["stiffness_loss"]) * scale.displacement
    return ModelPatch((PowerStiffness(port, force, values["exponent"], SKINS[skin], scale.displacement),))


def _free_play(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    scale = port_scale(setting, place)
    stiffness = removed_stiffness(setting, place, values["stiffness_share"])
    return ModelPatch((FreePlay(place, stiffness, values["gap_ratio"] * scale.displacement),))


def _runs(setting: Setting) -> tuple[str, ...]:
    """Return the runs whose static trials have a displacement channel with a zero that is known at all."""
    names = {
        channel.name
        for channel in channels(setting, Quantity.DISPLACEMENT, kinds=frozenset({TrialKind.STATIC}))
        if not isinf(channel.offset_deviation)
    }
    runs = (trial.run for trial in trials(setting, TrialKind.STATIC) if names.intersection(trial.channels))
    return tuple(dict.fromkeys(runs))


def _seating_offset(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    offset = values["offset_ratio"] * setting.scales.force / setting.scales.tip_stiffness
    return ModelPatch((RunOffset(place, offset, quantity=Quantity.DISPLACEMENT.value),))


def _stiffness_drift(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((StiffnessDrift(values["stiffness_change"] / setting.scales.duration),))


CUBIC_STIFFNESS = Effect(
    identifier="cubic_stiffness",
    name="geometric (cubic) stiffness",
    family=FAMILY,
    equation="F = k_3 x^3, k_3 = kappa k / A^2",
    signature="Frequency shifts by 3/8 kappa (amplitude / A)^2; third harmonic; a bent load line.",
    reference="Kerschen, Worden, Vakakis and Golinval 2006, Mech. Syst. Signal Process. 20 (3), 505-592",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "stiffening",
            "kappa",
            "1",
            "cubic over linear force at the largest motion in any trial, k_3 A^2 / k",
            Prior("normal", -0.24, 0.24),
            magnitude=True,
        ),
    ),
    build=_cubic,
    shape=(
        ShapeParameter("exponent", "n", "exponent of the displacement", 3.0, Prior("uniform", 1.2, 5.0)),
        ShapeParameter(
            "asymmetry",
            "s",
            "asymmetry (the force is 1 + s times as large at x > 0, 1 - s times at x < 0)",
            0.0,
            Prior("uniform", -1.0, 1.0),
        ),
    ),
    places=turning(over_the_planform("tip")),
    unavailable=needs(carried(PowerStiffness), has_port, turns_somewhere(at_ports())),
    confusable=("breathing_crack", "free_play", "stiffness_drift", "joint_micro_slip"),
)

BREATHING_CRACK = Effect(
    identifier="breathing_crack",
    name="breathing crack (bilinear stiffness)",
    family=FAMILY,
    equation="F = -d k_0 x where the crack is open (one sign of x), 0 where it is closed",
    signature="Second harmonic and a shift of the mean, as the amplitude; frequencies constant.",
    reference="Chu and Shen 1992, AIAA Journal 30 (10), 2512-2519",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "stiffness_loss",
            "d",
            "1",
            "share of the port's stiffness at rest lost while open (built up to 0.9)",
            Prior("log_normal", 0.03, 0.60),
            magnitude=True,
        ),
    ),
    build=_breathing_crack,
    shape=(ShapeParameter("exponent", "n", "exponent of the displacement", 1.0, Prior("uniform", 0.4, 3.0)),),
    places=_skins,
    unavailable=needs(carried(PowerStiffness), has_port, turns_somewhere(at_ports())),
    confusable=("cubic_stiffness", "free_play", "root_compliance"),
)

FREE_PLAY = Effect(
    identifier="free_play",
    name="free play (dead zone)",
    family="dead zone",
    equation="F = -s k_0 clip(x, -delta, delta), delta = r A",
    signature="The frequency falls as the amplitude nears the gap; a load line with a jump at zero load.",
    reference="Conner, Tang, Dowell and Virgin 1997, J. Fluids Struct. 11 (1), 89-109",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "gap_ratio",
            "r",
            "1",
            "half the gap over the largest motion, delta / A",
            Prior("log_normal", 0.005, 0.15),
            magnitude=True,
        ),
        EffectParameter(
            "stiffness_share",
            "s",
            "1",
            "share of the port's stiffness at rest that the gap removes (built up to 0.9)",
            Prior("log_normal", 0.10, 0.80),
        ),
    ),
    build=_free_play,
    places=turning(at_ports("root")),
    unavailable=needs(carried(FreePlay), has_port, turns_somewhere(at_ports())),
    confusable=("seating_offset", "cubic_stiffness", "breathing_crack", "coulomb_friction"),
)

SEATING_OFFSET = Effect(
    identifier="seating_offset",
    name="seating offset of a run",
    family="sensor zero",
    equation="w -> w + w_0 in the static trials of one run, w_0 = r F_max / k_tip",
    signature="One run's line of load against displacement has an intercept; slopes and strain agree.",
    reference="Coleman and Steele 2009, Experimentation, Validation, and Uncertainty Analysis for Engineers",
    acts_on=frozenset({TrialKind.STATIC}),
    parameters=(
        EffectParameter(
            "offset_ratio",
            "r",
            "1",
            "offset over the static displacement under the largest force",
            Prior("normal", -0.05, 0.05),
            magnitude=True,
        ),
    ),
    build=_seating_offset,
    places=_runs,
    unavailable=needs(
        trial_of(frozenset({TrialKind.STATIC})),
        applied_force,
        somewhere(_runs, "No static trial has a displacement channel whose zero is known."),
    ),
    confusable=("free_play", "load_cell", "gauge_zero_drift"),
)

STIFFNESS_DRIFT = Effect(
    identifier="stiffness_drift",
    name="slow time variation of stiffness",
    family="time variation",
    equation="K -> K (1 + rho t), rho = delta / T",
    signature="Frequencies move with the time in the record, alike after a large and a small release.",
    reference="Poulimenos and Fassois 2006, Mech. Syst. Signal Process. 20 (4), 763-816",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "stiffness_change",
            "delta",
            "1",
            "relative change of stiffness over the longest record, rho T",
            Prior("normal", -0.10, 0.10),
            magnitude=True,
        ),
    ),
    build=_stiffness_drift,
    unavailable=needs(trial_of(DYNAMIC), carried(StiffnessDrift)),
    confusable=("cubic_stiffness", "joint_micro_slip", "clock_error", "unmodelled_mode"),
)

EFFECTS = (CUBIC_STIFFNESS, BREATHING_CRACK, FREE_PLAY, SEATING_OFFSET, STIFFNESS_DRIFT)
