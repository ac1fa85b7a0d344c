"""Effects of mass and linear stiffness: point mass, root compliance, stiffness loss, temperature."""

from collections.abc import Mapping

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.building import (
    DYNAMIC,
    EVERY_TRIAL,
    along_span,
    carried,
    has_stations,
    needs,
    temperature_varies,
    trial_of,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch, ModulusTemperature, PointMass, RootCompliance

ACCELERATED = DYNAMIC | {TrialKind.FLIGHT}
"""Trials in which a mass acts: by its inertia, in flight by its weight times the load factor."""
LARGEST_LOSS = 0.9
"""Stiffness losses beyond this are built as this: a section without stiffness is no wing."""


def _point_mass(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    mass = values["mass_ratio"] * setting.scales.modal_mass
    return ModelPatch((PointMass(mass, along_span(setting, values["station_ratio"])),))


def _root_compliance(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    scales = setting.scales
    compliance = values["compliance_share"] / (scales.tip_stiffness * scales.length**2)
    return ModelPatch((RootCompliance(compliance),))


def _local_stiffness_loss(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    start = along_span(setting, values["start_ratio"])
    end = along_span(setting, min(values["start_ratio"] + values["length_ratio"], 1.0))
    return ModelPatch((LocalStiffnessLoss(min(values["loss"], LARGEST_LOSS), start, end - start),))


def _modulus_temperature(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((ModulusTemperature(values["coefficient"]),))


POINT_MASS = Effect(
    identifier="point_mass",
    name="unmodelled point mass",
    family="mass at a free place",
    equation="M -> M + m delta(y - y_m), m = mu m_1",
    signature="Frequencies fall by phi_r(y_m)^2 m / (2 m_r) each; in flight n m g relieves the lift inboard "
    "of it; the static response stays as it is.",
    reference="Blevins 1979, Formulas for Natural Frequency and Mode Shape",
    acts_on=ACCELERATED,
    parameters=(
        EffectParameter(
            "mass_ratio",
            "mu",
            "1",
            "mass over the first mode's mass at the load point",
            Prior("log_normal", 0.01, 0.30),
            magnitude=True,
        ),
        EffectParameter(
            "station_ratio",
            "eta_m",
            "1",
            "place, as a share of the modelled length from the root",
            Prior("uniform", 0.0, 1.0),
            levels=6,
        ),
    ),
    build=_point_mass,
    unavailable=needs(trial_of(ACCELERATED), carried(PointMass), has_stations),
    confusable=(
        "root_compliance",
        "clock_error",
        "stiffness_drift",
        "local_stiffness_loss",
        "inertia_relief",
    ),
)

ROOT_COMPLIANCE = Effect(
    identifier="root_compliance",
    name="root rotational compliance",
    family="linear compliance",
    equation="theta_root = c M_root, c = s / (k_tip L^2)",
    signature="More displacement by c M y, static strain as before, the first frequency falls most.",
    reference="Gorman 1975, Free Vibration Analysis of Beams and Shafts",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "compliance_share",
            "s",
            "1",
            "what the root adds to the compliance at the tip, as a share of it",
            Prior("log_normal", 0.02, 0.30),
            magnitude=True,
        ),
    ),
    build=_root_compliance,
    unavailable=needs(carried(RootCompliance)),
    confusable=("point_mass", "load_place", "load_cell", "clock_error"),
)

LOCAL_STIFFNESS_LOSS = Effect(
    identifier="local_stiffness_loss",
    name="stiffness loss outside the modelled regions",
    family="linear compliance",
    equation="EI(y) -> EI(y) (1 - d) for y_0 <= y <= y_0 + l",
    signature="Strain rises at the place and hardly elsewhere; frequencies fall by the curvature there.",
    reference="Cawley and Adams 1979, J. Strain Analysis 14 (2), 49-57",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "loss",
            "d",
            "1",
            "share of the skin's stiffness that is lost (built up to 0.9)",
            Prior("log_normal", 0.03, 0.60),
            magnitude=True,
        ),
        EffectParameter(
            "start_ratio",
            "eta_0",
            "1",
            "inner end, as a share of the modelled length from the root",
            Prior("uniform", 0.0, 0.9),
            levels=14,
        ),
        EffectParameter(
            "length_ratio",
            "lambda",
            "1",
            "length, as a share of the modelled length (cut at the tip)",
            Prior("uniform", 0.03, 0.30),
            levels=3,
        ),
    ),
    build=_local_stiffness_loss,
    unavailable=needs(carried(LocalStiffnessLoss), has_stations),
    confusable=("gauge_gain", "gauge_misalignment", "root_compliance", "point_mass"),
)

TEMPERATURE_DEPENDENT_MODULUS = Effect(
    identifier="temperature_dependent_modulus",
    name="temperature-dependent modulus",
    family="temperature",
    equation="E -> E (1 - b (T - T_ref))",
    signature="Slope of load against strain and displacement, and all frequencies, follow the temperature.",
    reference="Sohn 2007, Phil. Trans. R. Soc. A 365, 539-560",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "coefficient",
            "b",
            "1/K",
            "relative loss of Young's modulus per kelvin",
            Prior("log_normal", 3e-4, 5e-3),
            magnitude=True,
        ),
    ),
    build=_modulus_temperature,
    unavailable=needs(temperature_varies, carried(ModulusTemperature)),
    confusable=("thermal_strain", "stiffness_drift", "local_stiffness_loss", "load_cell"),
)

EFFECTS = (POINT_MASS, ROOT_COMPLIANCE, LOCAL_STIFFNESS_LOSS, TEMPERATURE_DEPENDENT_MODULUS)
