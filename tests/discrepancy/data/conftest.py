"""A single mass on a spring as a model, in closed form, and campaigns on it."""

from dataclasses import dataclass

import numpy as np
import pytest

from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.models.interface import ACROSS, Model, Response
from discrepancy.models.scales import PortScale, Scales

# Gauges of a square patch of skin in plane stress: strain along, across, shear per metre of displacement.
GAUGES = {
    "strain[0]": (1.0e-2, -0.3e-2, 0.2e-2),
    "strain[1]": (0.4e-2, -0.12e-2, -0.1e-2),
    "strain[2]": (0.05e-2, -0.02e-2, 0.0),
}
SEEN = {
    name + part: value
    for name, strains in GAUGES.items()
    for part, value in zip(("", *ACROSS), strains, strict=True)
}
STIFFNESS, MASS, RATIO = 400.0, 0.4, 0.02


@dataclass(frozen=True)
class Oscillator(Model):
    """m x'' + c x' + k x = f at rest or released; three gauges proportional to x; outputs x and gauges."""

    name = "single mass"
    ports, shows_ports = ("x",), False
    parameters = (ParameterPrior("stiffness_factor", "1", 1.0, 0.01, 0.5, 2.0),)

    def output_quantity(self, output):
        return Quantity.DISPLACEMENT if output == "x" else Quantity.STRAIN if output in SEEN else None

    def supports(self, primitive):
        return False

    def scales(self, campaign):
        w = float(np.sqrt(STIFFNESS / MASS))
        ports = {"x": PortScale(0.01, STIFFNESS, w)}
        return Scales(1.0, STIFFNESS, MASS, w, 1.0, 1.0, 1.0, 1.0, ports)

    def _respond(self, trial, outputs, patch, conditions):
        stiffness = STIFFNESS * float(conditions.parameters[0])
        scale = np.array([1.0 if name == "x" else SEEN[name] for name, _ in outputs])
        if trial.is_dynamic:
            rate, zero = conditions.clock
            t = np.maximum((1.0 + rate) * trial.time + zero, 0.0)
            w = np.sqrt(stiffness / MASS)
            wd = w * np.sqrt(1.0 - RATIO**2)
            a = trial.release.displacement * (1.0 + conditions.initial[:1, 0].sum())
            e, c, s = np.exp(-RATIO * w * t), np.cos(wd * t), np.sin(wd * t)
            x, v = a * e * (c + RATIO * w / wd * s), -a * e * w**2 / wd * s
        else:
            x = (trial.force if trial.kind is TrialKind.STATIC else trial.load_factor) / stiffness
        return Response(np.outer(x, scale), np.outer(v, scale) if trial.is_dynamic else None)


@pytest.fixture(scope="session")
def oscillator():
    return Oscillator()
