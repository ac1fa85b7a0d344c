"""Effects of rate-independent hysteresis: micro-slip of a joint (Iwan), Bouc-Wen."""

from collections.abc import Mapping

from discrepancy.catalogue.building import (
    EVERY_TRIAL,
    at_ports,
    carried,
    has_port,
    needs,
    port_scale,
    removed_stiffness,
    turning,
    turns_somewhere,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter
from fe.runtime.patch import BoucWen, MicroSlip, ModelPatch

FAMILY = "rate-independent hysteresis"
# With 24 Jenkins elements and chi = -0.5 the loss of a cycle is that of a continuous distribution within 2 %
# from a twentieth of the largest slip displacement on and within 13 % at a hundredth; at chi = -0.2 within
# 6 % and 73 %. What is named has more of them (`SearchSettings.fine_joint`).


def _micro_slip(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    scale = port_scale(setting, place)
    stiffness = removed_stiffness(setting, place, values["stiffness_share"])
    if stiffness == 0.0:
        return ModelPatch()  # a joint without stiffness of its own carries nothing that could slip
    slip_force = values["slip_ratio"] * stiffness * scale.displacement
    return ModelPatch((MicroSlip(place, slip_force, stiffness, values["chi"], setting.joint_elements),))


def _bouc_wen(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    scale = port_scale(setting, place)
    stiffness = removed_stiffness(setting, place, values["stiffness_share"])
    return ModelPatch(
        (BoucWen(place, stiffness, values["yield_ratio"] * scale.displacement, values["order"]),)
    )


JOINT_MICRO_SLIP = Effect(
    identifier="joint_micro_slip",
    name="joint micro-slip (Iwan)",
    family=FAMILY,
    equation="F = sum of Jenkins elements - K_T x, K_T = s k_0, F_S = r K_T A, slip displacements ~ d^chi",
    signature="Frequency falls and damping rises with amplitude; loss per cycle ~ A^(3 + chi).",
    reference="Iwan 1966, J. Appl. Mech. 33 (4), 893-900; Segalman 2005, J. Appl. Mech. 72 (5), 752-760",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "stiffness_share",
            "s",
            "1",
            "joint's share of the port's stiffness at rest, K_T / k_0 (built up to 0.9)",
            Prior("log_normal", 0.03, 0.70),
            magnitude=True,
        ),
        EffectParameter(
            "slip_ratio",
            "r",
            "1",
            "slip force over elastic force of the joint at the largest motion, F_S / (K_T A)",
            Prior("log_normal", 0.05, 2.0),
        ),
    ),
    build=_micro_slip,
    shape=(
        ShapeParameter(
            "chi", "chi", "exponent of the density of slip displacements", -0.5, Prior("uniform", -0.95, 0.0)
        ),
    ),
    places=turning(at_ports("root", "tip")),
    unavailable=needs(carried(MicroSlip), has_port, turns_somewhere(at_ports())),
    confusable=(
        "bouc_wen_hysteresis",
        "quadratic_damping",
        "stiffness_drift",
        "unmodelled_mode",
        "coulomb_friction",
    ),
)

BOUC_WEN_HYSTERESIS = Effect(
    identifier="bouc_wen_hysteresis",
    name="Bouc-Wen hysteresis",
    family=FAMILY,
    equation="F = s k_0 (z - x), z' = v (1 - (1 + sgn(v z)) / 2 |z / z_y|^n), z_y = r A",
    signature="Smooth loops of load against motion at any speed; softer and more damped with amplitude.",
    reference="Bouc 1967, 4th Conf. Nonlinear Oscillation, Prague; Wen 1976, J. Eng. Mech. Div. 102, 249-263",
    acts_on=EVERY_TRIAL,
    parameters=(
        EffectParameter(
            "stiffness_share",
            "s",
            "1",
            "hysteretic share of the port's stiffness at rest, 1 - alpha (built up to 0.9)",
            Prior("log_normal", 0.03, 0.70),
            magnitude=True,
        ),
        EffectParameter(
            "yield_ratio",
            "r",
            "1",
            "yield displacement over the largest motion, z_y / A",
            Prior("log_normal", 0.10, 2.0),
        ),
    ),
    build=_bouc_wen,
    shape=(ShapeParameter("order", "n", "sharpness of the yield", 1.0, Prior("uniform", 0.5, 4.0)),),
    places=turning(at_ports("root", "tip")),
    unavailable=needs(carried(BoucWen), has_port, turns_somewhere(at_ports())),
    confusable=("joint_micro_slip", "quadratic_damping", "coulomb_friction", "cubic_stiffness"),
)

EFFECTS = (JOINT_MICRO_SLIP, BOUC_WEN_HYSTERESIS)
