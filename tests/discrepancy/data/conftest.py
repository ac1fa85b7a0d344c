"""A single mass on a spring as a model, in closed form, and campaigns on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.interface import Conditions, Model, Outputs, Response
from discrepancy.models.scales import PortScale, Scales
from fe.runtime.patch import ModelPatch, Primitive

# Gauges of a square patch of skin in plane stress: strain along, across, shear per metre of displacement.
GAUGES = {
    "strain[0]": (1.0e-2, -0.3e-2, 0.2e-2),
    "strain[1]": (0.4e-2, -0.12e-2, -0.1e-2),
    "strain[2]": (0.05e-2, -0.02e-2, 0.0),
}


@dataclass(frozen=True)
class Oscillator(Model):
    """m x'' + c x' + k x = f from rest or released; three gauges proportional to x; outputs x and gauges."""

    stiffness: float = 400.0
    mass: float = 0.4
    damping_ratio: float = 0.02

    name = "single mass"
    parameters = (ParameterPrior("stiffness_factor", "1", 1.0, 0.01, 0.5, 2.0),)

    def output_quantity(self, output: str) -> Quantity | None:
        return Quantity.DISPLACEMENT if output == "x" else Quantity.STRAIN if output in GAUGES else None

    def supports(self, primitive: type[Primitive]) -> bool:
        return False

    def ports(self) -> tuple[str, ...]:
        return ("x",)

    def scales(self, campaign: Campaign) -> Scales:
        w = float(np.sqrt(self.stiffness / self.mass))
        return Scales(
            1.0, self.stiffness, self.mass, w, 1.0, 1.0, 1.0, 1.0, {"x": PortScale(0.01, self.stiffness, w)}
        )

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        stiffness = self.stiffness * float(conditions.parameters[0])
        x, v = self._motion(trial, stiffness, conditions)
        scale = np.zeros((3, len(outputs)))
        for column, (output, _) in enumerate(outputs):
            if self.output_quantity(output) is None:
                raise ModelError(f"The single mass has no output {output!r}.")
            scale[:, column] = (1.0, 0.0, 0.0) if output == "x" else GAUGES[output]
        parts = [x[:, None] * row for row in scale]
        return Response(
            parts[0],
            v[:, None] * scale[0] if trial.is_dynamic else None,
            parts[1] if conditions.components else None,
            parts[2] if conditions.components else None,
        )

    def _motion(self, trial: Trial, stiffness: float, conditions: Conditions):
        if not trial.is_dynamic:
            load = trial.force if trial.kind is TrialKind.STATIC else trial.load_factor
            x = load / stiffness
            return x, np.zeros_like(x)
        rate, zero = conditions.clock
        t = (1.0 + rate) * trial.time + zero
        w = np.sqrt(stiffness / self.mass)
        zeta = self.damping_ratio
        wd = w * np.sqrt(1.0 - zeta**2)
        if trial.kind is TrialKind.RINGDOWN:
            a = trial.release.displacement * (
                1.0 + (float(conditions.initial[0, 0]) if len(conditions.initial) else 0.0)
            )
            e = np.exp(-zeta * w * np.maximum(t, 0.0))
            c, s = np.cos(wd * np.maximum(t, 0.0)), np.sin(wd * np.maximum(t, 0.0))
            return a * e * (c + zeta * w / wd * s), -a * e * w**2 / wd * s
        # Forced: superposition of the responses to the ramps between samples (closed form of each).
        x, v = np.zeros_like(t), np.zeros_like(t)
        h = trial.interval
        slopes = np.diff(trial.force) / h
        for start, slope in zip(trial.time, np.diff(slopes, prepend=0.0), strict=False):
            tau = np.maximum(t - start, 0.0)
            e, c, s = np.exp(-zeta * w * tau), np.cos(wd * tau), np.sin(wd * tau)
            x += (
                slope / stiffness * (tau - 2 * zeta / w + e * (2 * zeta / w * c + (2 * zeta**2 - 1) / wd * s))
            )
            v += slope / stiffness * (1.0 - e * (c + zeta * w / wd * s))
        return x, v


@pytest.fixture(scope="session")
def oscillator() -> Oscillator:
    return Oscillator()
