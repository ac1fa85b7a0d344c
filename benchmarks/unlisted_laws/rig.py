"""A mass on a spring with a hidden law, by equations written out here, and its model file."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.open_rigs.rigs import entry, port, solved

FloatArray = NDArray[np.float64]

MASS = 2.0
"""[kg]"""
STIFFNESS = 800.0
"""[N/m]"""
ANGULAR_FREQUENCY = (STIFFNESS / MASS) ** 0.5
"""[rad/s]"""
DAMPING = 0.02 * MASS * ANGULAR_FREQUENCY
"""Damper of the damping ratio 1 % [N s/m]."""
LENGTH = 0.02
"""Displacement of the largest release, the length scale of all laws [m]."""
FORCE = 6.0
"""Largest command of an actuator in any trial [N]."""
INTERVAL = 0.005
"""Sampling interval [s]."""
SAMPLES = 450
"""Samples of a trial."""
STAMPS = INTERVAL * np.arange(float(SAMPLES))
"""Times of the samples of a trial [s]."""
PARAMETERS = {"stiffness": 0.015, "damping": 0.15}
"""Prior deviation of each parameter; both scale the term of their name and have the mean 1."""
TURNS_OVER = 1e-5
"""Speed within which friction changes its sign [m/s]."""
FRICTION_SPEED = 0.15 * ANGULAR_FREQUENCY * LENGTH
"""Speed over which Stribeck friction falls from its peak [m/s]."""


@dataclass(frozen=True)
class Truth:
    """The truth of the rig: its parameters and a hidden law.

    Attributes
    ----------
    stiffness, damping : float
        True values over nominal ones.
    law : str
        Name of the hidden law, or nothing.
    size : float
        Size of the law as its branch of the equations defines it; without effect at 0.
    shape : float
        Second number of the law.
    """

    stiffness: float = 1.0
    damping: float = 1.0
    law: str = ""
    size: float = 0.0
    shape: float = 1.0


@dataclass(frozen=True)
class Tones:
    """A force that is a sum of sines and begins at time 0.

    Attributes
    ----------
    amplitudes : (K,) array
        Amplitudes [N].
    angular_frequencies : (K,) array
        Angular frequencies [rad/s].
    """

    amplitudes: FloatArray = field(default_factory=lambda: np.zeros(1))
    angular_frequencies: FloatArray = field(default_factory=lambda: np.zeros(1))

    def force(self, t: float) -> float:
        """Return the force at a time [N]."""
        if t <= 0.0:
            return 0.0
        return float(self.amplitudes @ np.sin(self.angular_frequencies * t))


@dataclass(frozen=True)
class Excitation:
    """What moves the mass in a trial.

    Attributes
    ----------
    release : float
        Displacement from which the mass is released at rest [m].
    command : Tones
        Recorded command of the shaker.
    rod : Tones
        Recorded force of a rod that pulls at the mass beside the shaker.
    """

    release: float = 0.0
    command: Tones = field(default_factory=Tones)
    rod: Tones = field(default_factory=Tones)


def motion(truth: Truth, excitation: Excitation, stamps: FloatArray = STAMPS) -> FloatArray:
    """Return displacement [m] and acceleration [m/s^2] of the mass as they are read, (n, 2).

    Parameters
    ----------
    truth : Truth
        Parameters and hidden law.
    excitation : Excitation
        Release and forces.
    stamps : (n,) array
        Times [s].
    """
    stiffness = truth.stiffness * STIFFNESS
    damping = truth.damping * DAMPING
    shaker = shaker_force(truth, excitation.command)

    def slope(t: float, state: FloatArray) -> list[float]:
        x, v, branch = (float(value) for value in state)
        forces = shaker(t) + excitation.rod.force(t) - law_force(truth, t, x, v, branch)
        acceleration = (forces - damping * v - stiffness * x) / MASS
        # The damper of a Maxwell branch relaxes the extension of the spring in series with it
        branch_rate = v - truth.shape * ANGULAR_FREQUENCY * branch
        return [v, acceleration, branch_rate if truth.law == "maxwell_branch" else 0.0]

    # A release comes after a long hold, in which the spring of a Maxwell branch has relaxed
    begin = [excitation.release, 0.0, 0.0]
    states = solved(slope, begin, (moment_of_change(truth),), stamps)
    displacement = states[:, 0]
    acceleration = np.array(
        [slope(float(t), state)[1] for t, state in zip(stamps, states, strict=True)]
    )
    if truth.law == "cross_talk":
        acceleration = acceleration + truth.size * ANGULAR_FREQUENCY**2 * displacement
    return np.column_stack((displacement, acceleration))


def moment_of_change(truth: Truth) -> float:
    """Return when a step of stiffness or a delayed force begins [s]; 0 for other laws."""
    if truth.law == "stiffness_step":
        return float((1.0 - truth.size) * STAMPS[-1])
    if truth.law == "actuator_delay":
        return truth.size * INTERVAL
    return 0.0


def shaker_force(truth: Truth, command: Tones) -> Callable[[float], float]:
    """Return the force (t) [N] with which the shaker follows its command.

    `size` is the delay in samples, the share of the largest command that is cut off, or, for the
    hyperbolic tangent, the share that is lost to first order.
    """
    if truth.law == "actuator_delay":
        return lambda t: command.force(t - truth.size * INTERVAL)
    if truth.law == "actuator_clip":
        limit = (1.0 - truth.size) * FORCE
        return lambda t: min(max(command.force(t), -limit), limit)
    if truth.law == "actuator_tanh" and truth.size > 0.0:
        scale = FORCE / (3.0 * truth.size) ** 0.5
        return lambda t: float(scale * np.tanh(command.force(t) / scale))
    return command.force


def law_force(truth: Truth, t: float, x: float, v: float, branch: float) -> float:
    """Return the force [N] of the hidden law against the motion.

    `size` is a stiffness over that of the rig, or a force over that of the spring at the largest
    release; `shape` is a length over the largest release, an angular frequency over that of the
    rig, or what a comment says.

    Parameters
    ----------
    truth : Truth
        The hidden law.
    t : float
        Time [s].
    x, v : float
        Displacement [m] and velocity [m/s].
    branch : float
        Extension of the spring of a Maxwell branch [m].
    """
    stiffness = truth.size * STIFFNESS
    if truth.law == "one_sided_stop":
        return stiffness * max(x - truth.shape * LENGTH, 0.0)
    if truth.law == "impact_with_loss":
        # The damper has the impedance of the stop at the frequency of the rig; it cannot pull
        depth = x - truth.shape * LENGTH
        push = stiffness * (depth + v / ANGULAR_FREQUENCY)
        return max(push, 0.0) if depth > 0.0 else 0.0
    if truth.law == "magnet":
        distance = truth.shape * LENGTH
        return stiffness * LENGTH * (1.0 - (distance / (distance - x)) ** 2)
    if truth.law == "stribeck_friction":
        # `shape` is the friction at high speed over its peak at rest
        speed_factor = truth.shape + (1.0 - truth.shape) * np.exp(-((v / FRICTION_SPEED) ** 2))
        return float(stiffness * LENGTH * speed_factor * np.tanh(v / TURNS_OVER))
    if truth.law == "maxwell_branch":
        return stiffness * branch
    if truth.law == "stiffness_step":
        # `size` is the share of the record after the step, and `shape` the lost share of stiffness
        return -truth.shape * STIFFNESS * x if t >= moment_of_change(truth) else 0.0
    if truth.law == "pumped_stiffness":
        return stiffness * x * float(np.sin(truth.shape * ANGULAR_FREQUENCY * t))
    return 0.0


def model_text(*, has_accelerometer: bool, has_rod: bool) -> str:
    """Return the model file of the rig as its user would write it, without a hidden law."""
    text = f'format = 1\nname = "A mass on a spring"\nmass = {MASS}\nstiffness = {STIFFNESS}\n'
    text += f"damping = {{ matrix = {DAMPING:g} }}\n"
    text += entry("input", name="shaker", vector=1.0, quantity="force")
    if has_rod:
        text += entry("input", name="rod", vector=1.0, quantity="force")
    text += entry("output", name="displacement", vector=1.0)
    if has_accelerometer:
        text += entry("output", name="acceleration", vector=1.0, quantity="acceleration")
    text += port("mass")
    for name, deviation in PARAMETERS.items():
        text += entry("parameter", name=name, terms=name, deviation=deviation, low=0.4, high=2.5)
    return text
