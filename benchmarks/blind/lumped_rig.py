"""A rig of three masses on a joint: its nominal model for the file, and the rig with something hidden."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes
from benchmarks.blind.laws import Law
from benchmarks.blind.plan import CampaignPlan, ChannelPlan, TrialPlan
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
    lines += ["stiffness = [" + ", ".join(row(line) for line in _stiffness()) + "]", "", "[damping]"]
    lines += [f"alpha = {ALPHA}", f"beta = {BETA}"]
    lines += ["", "[[input]]", 'name = "end"', f"vector = {row(PORTS['end'])}"]
    for name, (quantity, vector) in OUTPUTS.items():
        lines += ["", "[[output]]", f'name = "{name}"', f'quantity = "{quantity}"', f"vector = {row(vector)}"]
    for name, vector in PORTS.items():
        lines += ["", "[[port]]", f'name = "{name}"', f"vector = {row(vector)}"]
    for name, (mean, deviation) in PRIORS.items():
        lines += ["", "[[parameter]]", f'name = "{name}"', f'terms = "{name.removesuffix("_factor")}"']
        lines += [f"mean = {mean}", f"deviation = {deviation}", "low = 0.5", "high = 2.0"]
    return "\n".join(lines) + "\n"


def lumped_campaign() -> CampaignPlan:
    """Return the plan of the campaign: static loads at the end, and releases."""
    channels = {}
    for name, (quantity, _) in OUTPUTS.items():
        if quantity == "strain":
            channels[name] = ChannelPlan(name, quantity, "microstrain", name, 1e-6, STRAIN_NOISE, 0.005, 40.0)
        else:
            channels[name] = ChannelPlan(name, quantity, "mm", name, 1e-3, DISPLACEMENT_NOISE, 0.005, 0.05)
    levels = np.round(np.linspace(5.0, 30.0, 6), 3)
    forces = np.concatenate([levels, -levels])
    trials: list[TrialPlan] = []

    def add(
        name: str, kind: str, run: str, measured: tuple[str, ...], rows: FloatArray, **more: object
    ) -> None:
        start = 0.0 if not trials else float(trials[-1].campaign_times[-1]) + 600.0
        trials.append(TrialPlan(name, kind, run, measured, rows, place="end", start=start, **more))  # type: ignore[arg-type]

    for run in ("A", "B"):
        for repeat in (1, 2):
            add(
                f"load {run}{repeat}",
                "static",
                run,
                tuple(channels),
                forces,
                held_out=(run, repeat) == ("A", 2),
            )
    ring, long = np.arange(1000) / 250.0, np.arange(1750) / 250.0
    for amplitude, repeat, rows in (
        (4.0, 1, ring), (-4.0, 1, ring), (12.0, 1, ring), (12.0, 2, ring), (-12.0, 1, ring), (8.0, 1, ring),
        (12.0, 3, long),
    ):  # fmt: skip
        sign = "plus" if amplitude > 0.0 else "minus"
        add(
            f"release {abs(amplitude):.0f} mm {sign} {repeat}", "ringdown", "R", ("x1", "x3", "s2"), rows,
            release=amplitude * 1e-3, held_out=amplitude == 8.0,
        )  # fmt: skip
    add("load warm", "static", "A", tuple(channels), forces, temperature=15.0)
    add("release warm", "ringdown", "R", ("x1", "x3", "s2"), ring, release=0.012, temperature=15.0)
    return CampaignPlan(
        "Three masses on a joint", channels, tuple(trials), 20.0, PRIORS, {"end": "end"},
        model_file="model.toml", model_text=model_text(),
    )  # fmt: skip


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
