"""The kinds of hidden laws, and which effects of the catalogue depend on the same as each."""

from dataclasses import dataclass

OF_DISPLACEMENT = frozenset({"stiffness |x|^n, one- or two-sided", "dead zone"})
"""Families of effects whose force depends on the displacement alone."""


@dataclass(frozen=True)
class Kind:
    """A kind of hidden law; none is an effect of the catalogue, so that no name is exact.

    A name has the right dependence if the effect depends on the same variable as the law, has the
    same sign where its place fixes one, and acts at the same port or channel.

    Attributes
    ----------
    laws : tuple of str
        Names of its laws in `benchmarks.unlisted_laws.rig`; seeds take them by turns.
    shapes : tuple of float
        Least and largest `Truth.shape`.
    largest : float
        Largest `Truth.size`.
    effects : frozenset of str
        Effects of the right dependence, as "effect@place".
    families : frozenset of str
        Families of the right dependence.
    variables : tuple of str
        How the names of the variables begin that the missing force follows if it is told right
        without a name.
    reason : str
        Why these depend on the same, and what no effect of the catalogue has.
    has_releases : bool
        Whether three releases and two forced records are made, or three forced records alone.
    has_accelerometer, has_rod : bool
        Whether the acceleration is measured, too, and whether a second recorded force acts.
    """

    laws: tuple[str, ...]
    shapes: tuple[float, float]
    largest: float
    effects: frozenset[str]
    families: frozenset[str]
    variables: tuple[str, ...]
    reason: str
    has_releases: bool = True
    has_accelerometer: bool = False
    has_rod: bool = False


KINDS = {
    "one-sided stop": Kind(
        ("one_sided_stop",),
        (0.3, 0.6),
        3.0,
        frozenset(
            {"cubic_stiffness@mass", "free_play@mass", "breathing_crack@mass, open at negative x"}
        ),
        OF_DISPLACEMENT,
        ("displacement",),
        "A force of the displacement that is stiffer far out, or at positive x. No effect has a "
        "spring beyond a gap on one side.",
    ),
    "magnet": Kind(
        ("magnet",),
        (2.0, 3.0),
        0.06,
        frozenset({"cubic_stiffness@mass", "breathing_crack@mass, open at positive x"}),
        frozenset({"stiffness |x|^n, one- or two-sided"}),
        ("displacement",),
        "A force of the displacement that is softer at positive x. A gap (free play) is softer "
        "around rest and stiffer far out, on both sides alike. No effect grows towards a pole.",
    ),
    "stiffness step": Kind(
        ("stiffness_step",),
        (0.02, 0.04),
        0.7,
        frozenset({"stiffness_drift@"}),
        frozenset({"time variation"}),
        ("time",),
        "The stiffness depends on the time in the record. The catalogue has a steady drift; it has "
        "no loss from an unknown moment on, because an effect in a window needs an event.",
    ),
    "Stribeck friction": Kind(
        ("stribeck_friction",),
        (0.3, 0.6),
        0.1,
        frozenset({"coulomb_friction@mass"}),
        frozenset({"damping |v|^p |x|^a"}),
        ("velocity",),
        "Friction that depends on the direction of the velocity. In the catalogue it does not fall "
        "with the speed, since exponents below 0 count as 0; quadratic damping is the opposite.",
    ),
    "impact with loss": Kind(
        ("impact_with_loss",),
        (0.3, 0.6),
        3.0,
        frozenset(
            {
                "cubic_stiffness@mass",
                "free_play@mass",
                "breathing_crack@mass, open at negative x",
                "structural_damping@mass",
            }
        ),
        OF_DISPLACEMENT | {"damping |v|^p |x|^a"},
        ("displacement",),
        "A spring of the displacement, as for the stop, and a loss that needs displacement and "
        "velocity, as structural damping and its family. No effect has both beyond a gap.",
    ),
    "Maxwell branch": Kind(
        ("maxwell_branch",),
        (0.4, 2.5),
        2.0,
        frozenset({"joint_micro_slip@mass", "bouc_wen_hysteresis@mass"}),
        frozenset({"rate-independent hysteresis"}),
        ("the displacement relaxed",),
        "The force depends on the past displacement. Hysteresis of the catalogue has sliders in "
        "the place of the damper, so that it depends on amplitude and not on rate; damping has no "
        "memory.",
    ),
    "cross-talk": Kind(
        ("cross_talk",),
        (1.0, 1.0),
        0.5,
        frozenset({"gauge_gain@acceleration"}),
        frozenset({"sensor gain"}),
        (),
        "An error of the second reading alone that is proportional to the motion. No effect has "
        "one channel in the reading of another; near resonance both are nearly proportional.",
        has_releases=False,
        has_accelerometer=True,
    ),
    "saturating actuator": Kind(
        ("actuator_tanh", "actuator_clip"),
        (1.0, 1.0),
        0.8,
        frozenset({"load_cell@"}),
        frozenset({"load"}),
        ("the applied force", "the input"),
        "The error of the force depends on the command. The catalogue has a gain and a constant of "
        "the force; its saturation is that of a sensor.",
        has_releases=False,
    ),
    "actuator delay": Kind(
        ("actuator_delay",),
        (1.0, 1.0),
        10.0,
        frozenset({"sensor_lag@displacement", "clock_error@"}),
        frozenset({"sensor lag"}),
        ("the rate of",),
        "The motion lags behind the command. With one force from rest a lag of all channels is the "
        "very same, and is in the catalogue; so a second recorded force acts without delay. A "
        "clock error has a time zero of all readings.",
        has_releases=False,
        has_rod=True,
    ),
    "pumped stiffness": Kind(
        ("pumped_stiffness",),
        (0.2, 2.5),
        0.3,
        frozenset({"stiffness_drift@"}),
        frozenset({"time variation"}),
        ("time",),
        "The stiffness depends on the time in the record. The catalogue has a steady drift alone.",
    ),
}
"""The kinds by name, in the order of the campaigns' numbers."""
