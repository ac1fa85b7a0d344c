"""A rig of three masses on a joint: its nominal model file, and its true response."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes
from benchmarks.blind.laws import Law
from benchmarks.blind.plan import CampaignPlan, ChannelPlan, TrialPlan, schedule
from benchmarks.blind.structure import Release, Structure

FloatArray = NDArray[np.float64]

MASS = np.diag([1.4, 1.1, 0.8])  # kg
SPRINGS = (5200.0, 9000.0, 7000.0)  # N/m: the joint, then between the masses
ALPHA, BETA = 0.35, 1.1e-4
STRAIN_LENGTH = 0.4  # m: the strain of a spring is its extension over this
STRAIN_NOISE, DISPLACEMENT_NOISE = 80.0, 0.1  # microstrain, mm
PRIORS = {
    "stiffness_factor": (1.0, 0.01),
    "mass_factor": (1.0, 0.005),
    "damping_factor": (1.0, 0.05),
}


def _stiffness() -> FloatArray:
    k1, k2, k3 = SPRINGS
    return np.array([[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]])


OUTPUTS: dict[str, tuple[str, FloatArray]] = {
    "x1": ("displacement", np.array([1.0, 0.0, 0.0])),
    "x2": ("displacement", np.array([0.0, 1.0, 0.0])),
    "x3": ("displacement", np.array([0.0, 0.0, 1.0])),
    "s1": ("strain", np.array([1.0, 0.0, 0.0]) / STRAIN_LENGTH),
    "s2": ("strain", np.array([-1.0, 1.0, 0.0]) / STRAIN_LENGTH),
    "s3": ("strain", np.array([0.0, -1.0, 1.0]) / STRAIN_LENGTH),
}
"""Quantity and weights of each output."""
PORTS = {"joint": np.array([1.0, 0.0, 0.0]), "end": np.array([0.0, 0.0, 1.0])}


def model_text() -> str:
    """Return the nominal model in the package's format for lumped models."""

    def row(vector: FloatArray) -> str:
        return "[" + ", ".join(repr(float(value)) for value in vector) + "]"

    lines = ["format = 1", 'name = "Three masses on a joint"']
    lines += [f"mass = {row(np.diag(MASS))}"]
    lines += [
        "stiffness = [" + ", ".join(row(line) for line in _stiffness()) + "]",
        "",
        "[damping]",
    ]
    lines += [f"alpha = {ALPHA}", f"beta = {BETA}"]
    lines += ["", "[[input]]", 'name = "end"', f"vector = {row(PORTS['end'])}"]
    for name, (quantity, vector) in OUTPUTS.items():
        lines += [
            "",
            "[[output]]",
            f'name = "{name}"',
            f'quantity = "{quantity}"',
            f"vector = {row(vector)}",
        ]
    for name, vector in PORTS.items():
        lines += ["", "[[port]]", f'name = "{name}"', f"vector = {row(vector)}"]
    for name, (mean, deviation) in PRIORS.items():
        lines += [
            "",
            "[[parameter]]",
            f'name = "{name}"',
            f'terms = "{name.removesuffix("_factor")}"',
        ]
        lines += [f"mean = {mean}", f"deviation = {deviation}", "low = 0.5", "high = 2.0"]
    return "\n".join(lines) + "\n"


RATE = 250.0  # Hz
DYNAMIC = ("x1", "x3", "s2")
"""Channels of ring-downs."""
WARMER = 15.0
"""Temperature of the warm trials above the reference [K]."""


def _channels() -> dict[str, ChannelPlan]:
    """Return a channel for each output, by name."""
    channels = {}
    for name, (quantity, _) in OUTPUTS.items():
        if quantity == "strain":
            channels[name] = ChannelPlan(
                name, quantity, "microstrain", name, 1e-6, STRAIN_NOISE, gain=0.005, offset=40.0
            )
        else:
            channels[name] = ChannelPlan(
                name, quantity, "mm", name, 1e-3, DISPLACEMENT_NOISE, gain=0.005, offset=0.05
            )
    return channels


def _load_test(name: str, run: str, *, held_out: bool = False) -> TrialPlan:
    """Return a load test of the end, in both directions."""
    levels = np.round(np.linspace(5.0, 30.0, 6), 3)
    forces = np.concatenate([levels, -levels])
    return TrialPlan(name, "static", run, tuple(OUTPUTS), forces, place="end", held_out=held_out)


def _release(amplitude: float, repeat: int, samples: int) -> TrialPlan:
    """Return a release of the end.

    Parameters
    ----------
    amplitude : float
        Displacement before the release [mm].
    repeat : int
        Number of the repetition.
    samples : int
        Number of samples.
    """
    direction = "plus" if amplitude > 0.0 else "minus"
    return TrialPlan(
        name=f"release {abs(amplitude):.0f} mm {direction} {repeat}",
        kind="ringdown",
        run="R",
        channels=DYNAMIC,
        rows=np.arange(samples) / RATE,
        place="end",
        release=amplitude * 1e-3,
        held_out=amplitude == 8.0,
    )


def lumped_campaign() -> CampaignPlan:
    """Return the plan of the campaign: load tests of the end and releases, some of them warm."""
    load_tests = [
        _load_test(f"load {run}{repeat}", run, held_out=(run, repeat) == ("A", 2))
        for run, repeat in (("A", 1), ("A", 2), ("B", 1), ("B", 2))
    ]
    releases = [
        _release(4.0, 1, 1000),
        _release(-4.0, 1, 1000),
        _release(12.0, 1, 1000),
        _release(12.0, 2, 1000),
        _release(-12.0, 1, 1000),
        _release(8.0, 1, 1000),
        _release(12.0, 3, 1750),
    ]
    warm_load_test = replace(_load_test("load warm", "A"), temperature=WARMER)
    warm_release = replace(releases[2], name="release warm", release=0.012, temperature=WARMER)
    return CampaignPlan(
        name="Three masses on a joint",
        channels=_channels(),
        trials=schedule([*load_tests, *releases, warm_load_test, warm_release]),
        reference_temperature=20.0,
        priors=PRIORS,
        places={"end": "end"},
        model_file="model.toml",
        model_text=model_text(),
    )


class LumpedRig:
    """The rig."""

    name = "lumped"

    def __init__(self) -> None:
        self.outputs = tuple(OUTPUTS)

    def structure(
        self, parameters: Mapping[str, float], changes: Changes, temperature: float = 0.0
    ) -> Structure:
        """Return the rig at a temperature above the reference [K]."""
        factor = parameters["damping_factor"]
        mass = parameters["mass_factor"] * MASS
        nominal = parameters["stiffness_factor"] * (1.0 - changes.modulus_temperature * temperature)
        return Structure(
            stiffness=nominal * _stiffness(),
            mass=mass,
            alpha=factor * ALPHA,
            beta=factor * BETA,
            outputs=np.array([vector for _, vector in OUTPUTS.values()]),
            ports=PORTS,
            modes=3,
            stiffness_rate=changes.stiffness_rate,
        )

    def laws(self, changes: Changes) -> tuple[Law, ...]:
        """Return the laws of the forces inside."""
        return changes.laws

    def respond(
        self,
        structure: Structure,
        changes: Changes,
        trial: TrialPlan,
        amplitude: float = 0.0,
        place_error: float = 0.0,
        split: int = 1,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (n, C) of a trial, see `WingRig.respond`."""
        end = PORTS["end"]
        if trial.kind == "static":
            force = (1.0 + changes.force_gain) * trial.rows + changes.force_tare
            return structure.static(end[:, None] * force, changes.laws), trial.rows
        times = (1.0 + changes.clock_rate) * trial.rows + changes.clock_zero
        release = Release(amplitude, end, end, times)
        if changes.is_linear and split == 1:
            return structure.free_ringdown(release), trial.rows
        outputs, _ = structure.fine_ringdown(release, changes.laws, split)
        return outputs, np.linspace(trial.rows[0], trial.rows[-1], len(outputs))
