"""Effects of damping: Coulomb, structural (hysteretic), quadratic; one family c |v|^p |x|^a.

A force F = F_0 |v / (A w)|^p |x / A|^a sgn v takes F_0 A 2 B((p + 2) / 2, (a + 1) / 2) from a harmonic motion
x = A sin w t in each cycle (B is the beta function), a viscous damper of ratio zeta 2 pi zeta k A^2. Equal
losses give the equivalent viscous ratio zeta_eq = F_0 B / (pi k A):

- Coulomb, p = a = 0, B = 2: zeta_eq = 2 mu / pi with mu = F_c / (k A);
- structural, p = 0, a = 1, B = 1: zeta_eq = g / pi with F = g k |x| sgn v;
- quadratic, p = 2, a = 0, B = 4/3: zeta_eq = 4 F_0 / (3 pi k A) = 4 c A w^2 / (3 pi k) with F = c |v| v.

At a stiff port k is far above the stiffness at rest k_0, and a force of k_0 A that does not fall with the
speed (p < 1) holds it still: no more than 0.9 of it is built, unless drives alone move the port.

Spread over a wing, F acts at each place by its share w of the area, on the place's motion r x, x the mean's:
the loss is sum w r^(p + a + 1) times as large.

Where the exponents are free, the loss at the amplitude A is kept, so that they change the shape alone.
"""

from collections.abc import Mapping
from math import pi

from scipy.special import beta

from discrepancy.catalogue.building import (
    DYNAMIC,
    LARGEST_SHARE,
    at_held_ports,
    at_least_zero,
    at_ports,
    carried,
    has_port,
    needs,
    over_the_planform,
    port_scale,
    somewhere,
    trial_of,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter
from fe.runtime.patch import ModelPatch, PowerDamping

FAMILY = "damping |v|^p |x|^a"


def loss_integral(velocity_exponent: float, displacement_exponent: float) -> float:
    """Return B((p + 2) / 2, (a + 1) / 2): half the loss of a cycle over F_0 A; 2 for p = a = 0."""
    return float(beta(0.5 * velocity_exponent + 1.0, 0.5 * displacement_exponent + 0.5))


def _damping(setting: Setting, values: Mapping[str, float], port: str, equivalent_ratio: float) -> ModelPatch:
    scale = port_scale(setting, port)
    p, a = at_least_zero(values, "velocity_exponent"), at_least_zero(values, "displacement_exponent")
    a = 0.0 if scale.free else a  # a port that nothing holds has no zero
    loss = loss_integral(p, a) * scale.mean_power(p + a + 1.0)
    force = pi * equivalent_ratio * scale.stiffness * scale.displacement / loss
    if scale.static_stiffness is not None and p < 1.0 and not scale.driven:  # more holds a port still
        force = min(force, LARGEST_SHARE * scale.static_stiffness * scale.displacement)
    speed = scale.displacement * scale.angular_frequency
    return ModelPatch((PowerDamping(port, force, p, a, speed, scale.displacement),))


def _coulomb(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return _damping(setting, values, place, 2.0 / pi * values["friction_ratio"])


def _structural(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return _damping(setting, values, place, values["loss_factor"] / pi)


def _quadratic(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return _damping(setting, values, place, values["equivalent_damping_ratio"])


def _exponents(velocity: float, displacement: float) -> tuple[ShapeParameter, ...]:
    # The prior reaches below zero so that an exponent of zero is not at its edge; the family ends there.
    return (
        ShapeParameter(
            "velocity_exponent",
            "p",
            "exponent of the speed (built from 0 on)",
            velocity,
            Prior("uniform", -0.5, 3.0),
        ),
        ShapeParameter(
            "displacement_exponent",
            "a",
            "exponent of the displacement (built from 0 on)",
            displacement,
            Prior("uniform", -0.5, 2.0),
        ),
    )


_AVAILABLE = needs(trial_of(DYNAMIC), carried(PowerDamping), has_port)

COULOMB_FRICTION = Effect(
    identifier="coulomb_friction",
    name="Coulomb friction",
    family=FAMILY,
    equation="F = F_c sgn v, F_c = mu k A",
    signature="Peaks fall along a straight line: zeta ~ 1/A, and the motion stops early.",
    reference="Den Hartog 1931, Trans. ASME 53, APM-53-9",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "friction_ratio",
            "mu",
            "1",
            "friction over the elastic force at the largest motion, F_c / (k A)",
            Prior("log_normal", 0.002, 0.05),
            magnitude=True,
        ),
    ),
    build=_coulomb,
    shape=_exponents(0.0, 0.0),
    places=at_ports("root"),
    unavailable=_AVAILABLE,
    confusable=("structural_damping", "joint_micro_slip", "bouc_wen_hysteresis"),
)

STRUCTURAL_DAMPING = Effect(
    identifier="structural_damping",
    name="structural (hysteretic) damping",
    family=FAMILY,
    equation="F = g k |x| sgn v",
    signature="Damping ratio alike in all modes and at all amplitudes; Rayleigh damping differs by mode.",
    reference="Kimball and Lovell 1927, Physical Review 30, 948-959",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "loss_factor",
            "g",
            "1",
            "force against the motion over the elastic force; zeta_eq = g / pi",
            Prior("log_normal", 0.005, 0.10),
            magnitude=True,
        ),
    ),
    build=_structural,
    shape=_exponents(0.0, 1.0),
    places=at_held_ports("root"),
    unavailable=needs(
        trial_of(DYNAMIC),
        carried(PowerDamping),
        has_port,
        somewhere(at_held_ports(), "Nothing holds a port of the model, so that no place is its zero."),
    ),
    confusable=("coulomb_friction", "quadratic_damping", "joint_micro_slip"),
)

QUADRATIC_DAMPING = Effect(
    identifier="quadratic_damping",
    name="quadratic aerodynamic damping",
    family=FAMILY,
    equation="F = c |v| v, zeta_eq(A) = 4 c m A w^2 / (3 pi k), m = 1 at a port",
    signature="zeta ~ A: the envelope falls fast at first, then slowly.",
    reference="Worden and Tomlinson 2001, Nonlinearity in Structural Dynamics",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "equivalent_damping_ratio",
            "zeta_eq",
            "1",
            "equivalent viscous ratio at the largest motion A",
            Prior("log_normal", 0.002, 0.05),
            magnitude=True,
        ),
    ),
    build=_quadratic,
    shape=_exponents(2.0, 0.0),
    places=over_the_planform(),
    unavailable=_AVAILABLE,
    confusable=("joint_micro_slip", "structural_damping", "bouc_wen_hysteresis"),
)

EFFECTS = (COULOMB_FRICTION, STRUCTURAL_DAMPING, QUADRATIC_DAMPING)
