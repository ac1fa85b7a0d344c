"""Hidden effects: how large they are, what they change, and what is true of them.

Identifiers are those of the package's catalogue; what is true is said with the names and SI units
of the package's primitives ("<identifier>.<field>"), forces of power laws at unit speed [m/s,
rad/s] and unit displacement [m, rad]. Where an effect acts otherwise than at a port, its truth is
what gives the same energy or force in the first mode at each port, "<identifier>.<field>@<port>".
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes, Fault
from benchmarks.blind.laws import BOUC_WEN, DRAG, FRICTION, GAP, JENKINS, POWER, Law

FloatArray = NDArray[np.float64]
Truth = dict[str, float]
Draw = Callable[[np.random.Generator, "Bench"], "Hidden"]

JENKINS_COUNT = 48


@dataclass(frozen=True)
class Scale:
    """Stiffness [N/m, N m/rad], largest motion [m, rad] and angular frequency [rad/s] at a port."""

    port: str
    stiffness: float
    displacement: float
    frequency: float

    @property
    def force(self) -> float:
        """Elastic force at the largest motion."""
        return self.stiffness * self.displacement


@dataclass(frozen=True)
class Bench:
    """What an effect must know of the rig and its campaign.

    Attributes
    ----------
    rig : str
        "wing" or "lumped".
    joint, free : Scale
        Of the joint (its own spring), and of the place that moves most (the first mode's stiffness
        there).
    gauges, dynamic : tuple of str
        Strain channels, and channels of ring-downs.
    dynamic_range : mapping of str to float
        Largest reading of each of them [unit].
    noise, scale : mapping of str to float
        Noise of each channel [unit]; SI value of its unit.
    release, largest : float
        Largest release, and largest motion of the free place in the whole campaign [m].
    displacements : tuple of str
        Displacement channels of static trials.
    runs : tuple of str
        Runs of static trials.
    force, compliance : float
        Largest applied force [N], static compliance where it acts [m/N].
    length, modal_mass : float
        Semi-span [m]; the first mode's mass at the load point [kg].
    regions : int
        Number of regions that may be damaged.
    record, duration : float
        Length of a ring-down and of the campaign [s].
    region_places : (R, 2)
        Start and end of each region [m].
    line_shares, line_motion : (S,)
        Shares of the area by mesh line along the span, and the first mode's motion there.
    port_motion : mapping of str to float
        The first mode's motion at the ports.
    """

    rig: str
    joint: Scale
    free: Scale
    gauges: tuple[str, ...]
    dynamic: tuple[str, ...]
    dynamic_range: Mapping[str, float]
    noise: Mapping[str, float]
    scale: Mapping[str, float]
    release: float
    largest: float
    displacements: tuple[str, ...]
    runs: tuple[str, ...]
    force: float
    compliance: float
    record: float
    duration: float
    frequencies: FloatArray
    length: float = 1.0
    modal_mass: float = 1.0
    region_places: tuple[tuple[float, float], ...] = ()
    line_shares: FloatArray | None = None
    line_motion: FloatArray | None = None
    port_motion: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Hidden:
    """A hidden effect: what changes, what is true, and where."""

    identifier: str
    changes: Changes
    truth: Truth
    place: str = ""


def log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(generator.uniform(np.log(low), np.log(high))))


def _signed(generator: np.random.Generator, low: float, high: float) -> float:
    return float(generator.choice([-1.0, 1.0])) * log_uniform(generator, low, high)


def _pick(generator: np.random.Generator, names: tuple[str, ...]) -> str:
    return str(names[int(generator.integers(len(names)))])


# ---------------------------------------------------------------- structure


def point_mass(generator: np.random.Generator, bench: Bench) -> Hidden:
    mass = log_uniform(generator, 0.01, 0.3) * bench.modal_mass
    station = float(generator.uniform(0.35, 1.0)) * bench.length
    return Hidden(
        "point_mass",
        Changes(mass=mass, mass_station=station),
        {"point_mass.mass": mass, "point_mass.station": station},
    )


def support_compliance(generator: np.random.Generator, bench: Bench) -> Hidden:
    arm = bench.length - 0.05
    compliance = log_uniform(generator, 0.02, 0.3) * bench.compliance / arm**2
    return Hidden(
        "support_compliance",
        Changes(root_compliance=compliance),
        {"support_compliance.compliance": compliance},
    )


def local_stiffness_loss(generator: np.random.Generator, bench: Bench) -> Hidden:
    region = int(generator.integers(len(bench.region_places)))
    start, end = bench.region_places[region]
    loss = float(generator.uniform(0.05, 0.6))
    return Hidden(
        "local_stiffness_loss",
        Changes(region=region, loss=loss),
        {
            "local_stiffness_loss.loss": loss,
            "local_stiffness_loss.start": start,
            "local_stiffness_loss.length": end - start,
        },
    )


def temperature_dependent_modulus(generator: np.random.Generator, bench: Bench) -> Hidden:
    value = log_uniform(generator, 3e-4, 5e-3)
    return Hidden(
        "temperature_dependent_modulus",
        Changes(modulus_temperature=value),
        {"temperature_dependent_modulus.coefficient": value},
    )


def stiffness_drift(generator: np.random.Generator, bench: Bench) -> Hidden:
    rate = _signed(generator, 0.004, 0.1) / bench.record
    return Hidden("stiffness_drift", Changes(stiffness_rate=rate), {"stiffness_drift.rate": rate})


# ---------------------------------------------------------------- forces inside


def coulomb_friction(generator: np.random.Generator, bench: Bench) -> Hidden:
    ranges = (0.02, 0.3) if bench.rig == "wing" else (0.002, 0.05)
    force = log_uniform(generator, *ranges) * bench.joint.force
    law = Law(bench.joint.port, FRICTION, (force, 0.0))
    return Hidden(
        "coulomb_friction",
        Changes(laws=(law,)),
        {"coulomb_friction.coefficient": force},
        bench.joint.port,
    )


def structural_damping(generator: np.random.Generator, bench: Bench) -> Hidden:
    ranges = (0.08, 0.6) if bench.rig == "wing" else (0.005, 0.1)
    force = log_uniform(generator, *ranges) * bench.joint.stiffness
    law = Law(bench.joint.port, FRICTION, (force, 1.0))
    return Hidden(
        "structural_damping",
        Changes(laws=(law,)),
        {"structural_damping.coefficient": force},
        bench.joint.port,
    )


def quadratic_damping(generator: np.random.Generator, bench: Bench) -> Hidden:
    scale = bench.free
    ratio = log_uniform(generator, 0.002, 0.05)
    at_free = (
        ratio * 3.0 * np.pi * scale.stiffness / (4.0 * scale.displacement * scale.frequency**2)
    )
    truth = "quadratic_damping.coefficient"
    if bench.line_shares is None or bench.line_motion is None or bench.port_motion is None:
        law = Law(scale.port, DRAG, (at_free,))
        return Hidden("quadratic_damping", Changes(laws=(law,)), {truth: at_free}, scale.port)
    # Equal loss in the first mode.
    cube = float(bench.line_shares @ np.abs(bench.line_motion) ** 3)
    drag = at_free * bench.port_motion["tip"] ** 3 / cube
    values = {
        f"{truth}@{port}": drag * cube / motion**3 for port, motion in bench.port_motion.items()
    }
    values[f"{truth}@planform"] = drag
    return Hidden("quadratic_damping", Changes(drag=drag), values, "planform")


def cubic_stiffness(generator: np.random.Generator, bench: Bench) -> Hidden:
    """Hide a cubic spring at the free port, sized at the largest motion of the campaign."""
    # Softer than -4/27 no state holds the largest motion's load: such a draw is drawn again.
    hard = generator.random() < 0.6
    ratio = log_uniform(generator, 0.02, 0.3) if hard else -log_uniform(generator, 0.02, 0.15)
    force = ratio * bench.free.stiffness / bench.largest**2
    law = Law(bench.free.port, POWER, (force, 3.0, 0.0))
    return Hidden(
        "cubic_stiffness",
        Changes(laws=(law,)),
        {"cubic_stiffness.coefficient": force},
        bench.free.port,
    )


def spread_cubic_stiffness(generator: np.random.Generator, bench: Bench) -> Hidden:
    """Hide cubic springs spread over the wing's area."""
    if bench.line_shares is None or bench.line_motion is None or bench.port_motion is None:
        raise ValueError("cubic springs can only be spread over the wing")
    at_tip = log_uniform(generator, 0.02, 0.2) * bench.free.stiffness / bench.largest**2
    fourth = float(bench.line_shares @ bench.line_motion**4)
    spread = at_tip * bench.port_motion["tip"] ** 4 / fourth
    truth = "cubic_stiffness.coefficient"
    values = {f"{truth}@{port}": spread * fourth / m**4 for port, m in bench.port_motion.items()}
    values[f"{truth}@planform"] = spread
    return Hidden("cubic_stiffness", Changes(spread_cubic=spread), values, "planform")


def breathing_crack(generator: np.random.Generator, bench: Bench) -> Hidden:
    ranges = (0.15, 0.7) if bench.rig == "wing" else (0.02, 0.4)
    side = float(generator.choice([-1.0, 1.0]))
    force = -log_uniform(generator, *ranges) * bench.joint.stiffness
    law = Law(bench.joint.port, POWER, (force, 1.0, side))
    place = f"{bench.joint.port}, {'lower' if side > 0.0 else 'upper'} skin"
    return Hidden(
        "breathing_crack", Changes(laws=(law,)), {"breathing_crack.coefficient": force}, place
    )


def free_play(generator: np.random.Generator, bench: Bench) -> Hidden:
    share = (
        float(generator.uniform(0.4, 0.9))
        if bench.rig == "wing"
        else log_uniform(generator, 0.1, 0.8)
    )
    stiffness = share * bench.joint.stiffness
    half_width = log_uniform(generator, 0.01, 0.4) * bench.joint.displacement
    law = Law(bench.joint.port, GAP, (stiffness, half_width))
    return Hidden(
        "free_play",
        Changes(laws=(law,)),
        {"free_play.stiffness": stiffness, "free_play.half_width": half_width},
        bench.joint.port,
    )


def jenkins(
    port: str, stiffness: float, slip_force: float, chi: float, count: int = JENKINS_COUNT
) -> Law:
    """Return Jenkins elements with slips of density d^chi and the total force `slip_force`."""
    largest = slip_force * (2.0 + chi) / ((1.0 + chi) * stiffness)
    share = (np.arange(count) + 0.5) / count
    return Law(
        port, JENKINS, (), largest * share ** (1.0 / (1.0 + chi)), np.full(count, stiffness / count)
    )


def joint_micro_slip(generator: np.random.Generator, bench: Bench) -> Hidden:
    share = (
        float(generator.uniform(0.4, 0.9))
        if bench.rig == "wing"
        else log_uniform(generator, 0.05, 0.5)
    )
    stiffness = share * bench.joint.stiffness
    slip_force = log_uniform(generator, 0.1, 2.0) * stiffness * bench.joint.displacement
    return Hidden(
        "joint_micro_slip",
        Changes(laws=(jenkins(bench.joint.port, stiffness, slip_force, -0.5),)),
        {"joint_micro_slip.stiffness": stiffness, "joint_micro_slip.slip_force": slip_force},
        bench.joint.port,
    )


def bouc_wen_hysteresis(generator: np.random.Generator, bench: Bench) -> Hidden:
    share = (
        float(generator.uniform(0.4, 0.9))
        if bench.rig == "wing"
        else log_uniform(generator, 0.05, 0.5)
    )
    stiffness = share * bench.joint.stiffness
    limit = log_uniform(generator, 0.15, 3.0) * bench.joint.displacement
    law = Law(bench.joint.port, BOUC_WEN, (stiffness, limit, 1.0))
    return Hidden(
        "bouc_wen_hysteresis",
        Changes(laws=(law,)),
        {
            "bouc_wen_hysteresis.stiffness": stiffness,
            "bouc_wen_hysteresis.yield_displacement": limit,
        },
        bench.joint.port,
    )


# ---------------------------------------------------------------- loads


def load_place(generator: np.random.Generator, bench: Bench) -> Hidden:
    along = float(generator.uniform(-0.05, 0.025)) * bench.length
    aft = float(generator.uniform(-0.02, 0.02))
    return Hidden(
        "load_place",
        Changes(shift_span=along, shift_chord=aft),
        {"load_place.along_span": along, "load_place.along_chord": aft},
    )


def load_cell(generator: np.random.Generator, bench: Bench) -> Hidden:
    gain = _signed(generator, 0.01, 0.05)
    tare = _signed(generator, 0.005, 0.05) * bench.force
    return Hidden(
        "load_cell",
        Changes(force_gain=gain, force_tare=tare),
        {"load_cell.gain": gain, "load_cell.tare": tare},
    )


def washout(generator: np.random.Generator, bench: Bench) -> Hidden:
    value = log_uniform(generator, 0.02, 0.25)
    return Hidden(
        "washout", Changes(washout=value, washout_exponent=1.0), {"washout.coefficient": value}
    )


def inertia_relief(generator: np.random.Generator, bench: Bench) -> Hidden:
    value = _signed(generator, 0.02, 0.25)
    return Hidden("inertia_relief", Changes(relief=value), {"inertia_relief.fraction": value})


# ---------------------------------------------------------------- instruments


def _fault(identifier: str, fault: Fault, truth: Truth, place: str) -> Hidden:
    return Hidden(identifier, Changes(faults=(fault,)), truth, place)


def seating_offset(generator: np.random.Generator, bench: Bench) -> Hidden:
    run = _pick(generator, bench.runs)
    offset = _signed(generator, 0.005, 0.06) * bench.force * bench.compliance
    return _fault(
        "seating_offset",
        Fault("offset", bench.displacements, (offset,), run),
        {"seating_offset.offset": offset},
        run,
    )


def thermal_strain(generator: np.random.Generator, bench: Bench) -> Hidden:
    value = _signed(generator, 0.2e-6, 12e-6)
    return _fault(
        "thermal_strain",
        Fault("thermal", bench.gauges, (value,)),
        {"thermal_strain.coefficient": value},
        "*",
    )


def gauge_zero_drift(generator: np.random.Generator, bench: Bench) -> Hidden:
    channel = _pick(generator, bench.gauges)
    value = _signed(generator, 0.01, 0.2) * bench.dynamic_range[channel]
    # The amplitude is that over the whole campaign.
    return _fault(
        "gauge_zero_drift",
        Fault("drift", (channel,), (value, 1.0)),
        {
            "gauge_zero_drift.rate": bench.scale[channel] * value / bench.duration,
            "gauge_zero_drift.amplitude": bench.scale[channel] * value,
        },
        channel,
    )


def gauge_gain(generator: np.random.Generator, bench: Bench) -> Hidden:
    channel = _pick(generator, bench.gauges)
    value = _signed(generator, 0.02, 0.15)
    return _fault(
        "gauge_gain", Fault("gain", (channel,), (value,)), {"gauge_gain.gain": value}, channel
    )


def gauge_misalignment(generator: np.random.Generator, bench: Bench) -> Hidden:
    channel = _pick(generator, bench.gauges)
    value = float(np.radians(_signed(generator, 5.0, 15.0)))
    return _fault(
        "gauge_misalignment",
        Fault("rotation", (channel,), (value,)),
        {"gauge_misalignment.angle": value},
        channel,
    )


def high_pass(generator: np.random.Generator, bench: Bench) -> Hidden:
    channel = _pick(generator, bench.dynamic)
    value = log_uniform(generator, 0.02, 5.0)
    return _fault(
        "high_pass",
        Fault("high_pass", (channel,), (value,)),
        {"high_pass.time_constant": value},
        channel,
    )


def clock_error(generator: np.random.Generator, bench: Bench) -> Hidden:
    rate = _signed(generator, 5e-4, 5e-3)
    zero = float(generator.uniform(0.0, 0.08)) / bench.free.frequency
    return Hidden(
        "clock_error",
        Changes(clock_rate=rate, clock_zero=zero),
        {"clock_error.rate": rate, "clock_error.zero": zero},
    )


def _wave(identifier: str, amplitude: float, phase: float) -> Truth:
    return {
        f"{identifier}.amplitude": amplitude,
        f"{identifier}.cosine": amplitude * float(np.cos(phase)),
        f"{identifier}.sine": amplitude * float(np.sin(phase)),
    }


def mains_hum(generator: np.random.Generator, bench: Bench) -> Hidden:
    channel = _pick(generator, bench.dynamic)
    line = float(generator.choice([50.0, 60.0, 400.0]))
    frequency = line * (1.0 + 2e-4 * float(generator.standard_normal()))
    amplitude = log_uniform(generator, 0.3, 6.0) * bench.noise[channel]
    phase = float(generator.uniform(0.0, 2.0 * np.pi))
    return _fault(
        "mains_hum",
        Fault(
            "line", (channel,), (frequency, amplitude * np.cos(phase), amplitude * np.sin(phase))
        ),
        {
            "mains_hum.frequency": frequency,
            **_wave("mains_hum", amplitude * bench.scale[channel], phase),
        },
        f"{line:g} Hz, {channel}",
    )


def unmodelled_mode(generator: np.random.Generator, bench: Bench) -> Hidden:
    channel = _pick(generator, bench.dynamic)
    while True:
        frequency = log_uniform(generator, 0.6, 7.0) * bench.frequencies[0]
        if np.all(np.abs(frequency / bench.frequencies - 1.0) > 0.06):
            break
    ratio = log_uniform(generator, 0.004, 0.03)
    amplitude = log_uniform(generator, 0.005, 0.1) * bench.dynamic_range[channel] / bench.release
    phase = float(generator.uniform(0.0, 2.0 * np.pi))
    return _fault(
        "unmodelled_mode",
        Fault(
            "mode",
            (channel,),
            (frequency, ratio, amplitude * np.cos(phase), amplitude * np.sin(phase)),
        ),
        {
            "unmodelled_mode.frequency": float(frequency),
            "unmodelled_mode.damping_ratio": ratio,
            **_wave("unmodelled_mode", amplitude * bench.scale[channel], phase),
        },
        channel,
    )


DRAWS: dict[str, Draw] = {
    draw.__name__: draw
    for draw in (
        point_mass,
        support_compliance,
        local_stiffness_loss,
        temperature_dependent_modulus,
        stiffness_drift,
        coulomb_friction,
        structural_damping,
        quadratic_damping,
        cubic_stiffness,
        breathing_crack,
        free_play,
        joint_micro_slip,
        bouc_wen_hysteresis,
        load_place,
        load_cell,
        washout,
        inertia_relief,
        seating_offset,
        thermal_strain,
        gauge_zero_drift,
        gauge_gain,
        gauge_misalignment,
        high_pass,
        clock_error,
        mains_hum,
        unmodelled_mode,
    )
}
"""Every effect by its identifier."""

LUMPED = (
    "stiffness_drift",
    "coulomb_friction",
    "structural_damping",
    "quadratic_damping",
    "cubic_stiffness",
    "breathing_crack",
    "free_play",
    "joint_micro_slip",
    "bouc_wen_hysteresis",
    "load_cell",
    "seating_offset",
    "high_pass",
    "clock_error",
    "mains_hum",
    "unmodelled_mode",
)
"""Effects that the lumped rig can hide."""
