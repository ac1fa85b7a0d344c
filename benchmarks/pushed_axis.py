"""An axis that a force pushes back and forth through dry friction, by an integrator of its own.

The model lacks the friction. Records may be of any length.
"""

import tomllib

import numpy as np

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    FloatArray,
    NoiseRecord,
    Quantity,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_model import LumpedModel

MODEL = """
format = 1
name = "Axis"
mass = 10.0
free = true
damping = { matrix = 20.0 }
input = [{ name = "push", vector = 1.0 }]
output = [{ name = "x", vector = 1.0, quantity = "displacement" }]
port = [{ name = "slide", vector = 1.0 }]
parameter = [
  { name = "mass", terms = "mass", deviation = 0.05, low = 0.5, high = 1.5 },
  { name = "damping", terms = "damping", deviation = 0.3, low = 0.2, high = 3.0 },
]
"""
MASS = 10.0756
"""Mass of the true axis [kg]."""
DAMPING = 17.909
"""Damping of the true axis [N s/m]."""
FRICTION = 19.0
"""Dry friction of the true axis [N]."""
NOISE = 2e-5
"""Standard deviation of the noise of the readings [m]."""
INTERVAL = 0.002
"""Interval between two samples [s]."""
STEPS = 100
"""Number of steps of the integrator between two samples."""


def axis_model() -> LumpedModel:
    """Return the model of the axis, without friction."""
    return LumpedModel(LumpedDescription.parse(tomllib.loads(MODEL)))


def axis_positions(force: FloatArray) -> FloatArray:
    """Return the positions (N,) of the true axis under a force (N,), in SI.

    In each step the friction either stops the axis or is as large as it can be (Moreau's time
    stepping).
    """
    step = INTERVAL / STEPS
    largest_change = step * FRICTION / MASS
    position, speed = 0.0, 0.0
    positions = [position]
    for before, after in zip(force[:-1].tolist(), force[1:].tolist(), strict=True):
        for part in range(STEPS):
            push = before + (after - before) * (part + 0.5) / STEPS
            sliding_speed = speed + step * (push - DAMPING * speed) / MASS
            next_speed = sliding_speed - max(-largest_change, min(sliding_speed, largest_change))
            position += 0.5 * step * (speed + next_speed)
            speed = next_speed
        positions.append(position)
    return np.array(positions)


def pushed_axis(samples: int) -> Campaign:
    """Return two trials of so many samples each, pushed by a force of eight sines."""
    generator = np.random.default_rng(2)
    time = np.asarray(np.arange(samples) * INTERVAL, dtype=np.float64)
    trials = []
    for name, amplitude in (("one", 60.0), ("two", 80.0)):
        frequencies = 2.0 * np.pi * generator.uniform(0.3, 3.0, 8)
        phases = generator.uniform(0.0, 2.0 * np.pi, 8)
        waves = np.sin(time[:, None] * frequencies + phases)
        force = amplitude * waves.sum(axis=1) / np.sqrt(8.0)
        noise = NOISE * generator.standard_normal(samples)
        readings = axis_positions(force) + noise
        trial = Trial.plain(
            name,
            TrialKind.FORCED,
            ("x",),
            time,
            values=readings[:, None],
            force=force,
            load_place="push",
            begins=Start.UNKNOWN,
        )
        trials.append(trial)
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))
    return Campaign("axis", {"x": channel}, tuple(trials), None, {}, "0" * 64)
