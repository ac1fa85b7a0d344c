"""Effects of what acts on the structure: place of a load, load cell, washout, inertia relief."""

from collections.abc import Mapping

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.building import LOADED, applied_force, carried, needs, trial_of
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter
from fe.runtime.patch import InertiaRelief, LoadGain, LoadPlace, ModelPatch, Washout

FLIGHT = frozenset({TrialKind.FLIGHT})


def _load_place(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    length = setting.scales.length
    return ModelPatch((LoadPlace(values["along_span_ratio"] * length, values["along_chord_ratio"] * length),))


def _load_cell(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((LoadGain(values["gain_error"], values["tare_ratio"] * setting.scales.force),))


def _washout(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((Washout(values["washout"], max(values["exponent"], 0.0)),))


def _inertia_relief(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((InertiaRelief(values["relief"]),))


LOAD_PLACE = Effect(
    identifier="load_place",
    name="error of the load's place",
    family="load",
    equation="F acts at (y + dy, x + dx), dy = r_y L, dx = r_x L",
    signature="Displacement and strain scale as a load further out would, and the wing twists with dx.",
    reference="Coleman and Steele 2009, Experimentation, Validation, and Uncertainty Analysis for Engineers",
    acts_on=LOADED,
    parameters=(
        EffectParameter(
            "along_span_ratio",
            "r_y",
            "1",
            "error along the span over the length",
            Prior("normal", -0.05, 0.05),
            magnitude=True,
        ),
        EffectParameter(
            "along_chord_ratio",
            "r_x",
            "1",
            "error along the chord over the length",
            Prior("normal", -0.03, 0.03),
            magnitude=True,
        ),
    ),
    build=_load_place,
    unavailable=needs(applied_force, carried(LoadPlace)),
    confusable=("load_cell", "root_compliance"),
)

LOAD_CELL = Effect(
    identifier="load_cell",
    name="gain and tare of the load cell",
    family="load",
    equation="F -> (1 + g) F + F_0, F_0 = r F_max",
    signature="All channels of the loaded trials scale alike and share an intercept; ring-downs fit.",
    reference="Coleman and Steele 2009, Experimentation, Validation, and Uncertainty Analysis for Engineers",
    acts_on=LOADED,
    parameters=(
        EffectParameter(
            "gain_error",
            "g",
            "1",
            "relative error of the force",
            Prior("normal", -0.05, 0.05),
            magnitude=True,
        ),
        EffectParameter(
            "tare_ratio",
            "r",
            "1",
            "constant force over the campaign's largest force",
            Prior("normal", -0.03, 0.03),
            magnitude=True,
        ),
    ),
    build=_load_cell,
    unavailable=needs(applied_force, carried(LoadGain)),
    confusable=("load_place", "root_compliance", "seating_offset", "temperature_dependent_modulus"),
)

WASHOUT = Effect(
    identifier="washout",
    name="aeroelastic washout",
    family="lift",
    equation="l -> l (1 - k n eta^p), p = 1",
    signature="Outboard strain over root strain falls with the load factor.",
    reference="Hodges and Pierce 2011, Introduction to Structural Dynamics and Aeroelasticity, 2nd ed.",
    acts_on=FLIGHT,
    parameters=(
        EffectParameter(
            "washout",
            "k",
            "1",
            "share of the lift lost at the tip per unit of load factor",
            Prior("log_normal", 0.02, 0.30),
            magnitude=True,
        ),
    ),
    build=_washout,
    shape=(
        ShapeParameter(
            "exponent", "p", "exponent of the station (built from 0 on)", 1.0, Prior("uniform", 0.0, 4.0)
        ),
    ),
    unavailable=needs(trial_of(FLIGHT), carried(Washout)),
    confusable=("inertia_relief", "local_stiffness_loss"),
)

INERTIA_RELIEF = Effect(
    identifier="inertia_relief",
    name="inertia relief (mass distribution)",
    family="lift",
    equation="l -> l - r n m g",
    signature="Flight strain is off in proportion to the load factor, most at the root; ground trials fit.",
    reference="Megson 2017, Aircraft Structures for Engineering Students, 6th ed.",
    acts_on=FLIGHT,
    parameters=(
        EffectParameter(
            "relief",
            "r",
            "1",
            "relief that the model lacks, as a share of the modelled structural weight",
            Prior("normal", -0.20, 0.20),
            magnitude=True,
        ),
    ),
    build=_inertia_relief,
    unavailable=needs(trial_of(FLIGHT), carried(InertiaRelief)),
    confusable=("washout", "root_compliance", "point_mass"),
)

EFFECTS = (LOAD_PLACE, LOAD_CELL, WASHOUT, INERTIA_RELIEF)
