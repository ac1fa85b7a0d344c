"""Effects of stores that empty: outflow by a power of the level, and what begins at a level.

They act at ports of states, where laws are flows. The scales are those of the campaign: the largest value
x_m of the state by the model as it is, and Q, the flow scale of the port (`PortScale`), five times the rms
there.
"""

from collections.abc import Mapping

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.building import (
    at_least_zero,
    carried,
    needs,
    port_scale,
    somewhere,
    state_ports,
    trial_of,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting, ShapeParameter
from fe.runtime.patch import ModelPatch, Overflow, PowerDamping

DRIVEN = frozenset({TrialKind.FORCED, TrialKind.DRIVEN})
EVERY_PORT = "every port"
"""Place of a law that acts at all ports of states alike."""
NARROWEST = 1e-3
"""Least height above the level at which an overflow begins, over x_m."""


def _outlets(setting: Setting) -> tuple[str, ...]:
    found = state_ports(setting)
    return (*found, EVERY_PORT) if len(found) > 1 else found


def _outflow(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    exponent = at_least_zero(values, "exponent")
    laws = []
    for port in state_ports(setting) if place == EVERY_PORT else (place,):
        scale = port_scale(setting, port)
        flow = values["flow_ratio"] * scale.stiffness * scale.displacement
        largest = scale.displacement * scale.angular_frequency
        laws.append(PowerDamping(port, flow, exponent, 0.0, largest, scale.displacement))
    return ModelPatch(tuple(laws))


def _overflow(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    scale = port_scale(setting, place)
    largest = scale.displacement * scale.angular_frequency
    level = max(values["level_ratio"], 0.0) * largest
    flow = values["flow_ratio"] * scale.stiffness * scale.displacement
    height = max(largest - level, NARROWEST * largest)
    return ModelPatch((Overflow(place, flow, max(values["exponent"], 0.05), level, height),))


_NO_STATE = "The model has no port of a state (a level, a charge), at which a flow could act."

OUTFLOW = Effect(
    identifier="outflow",
    name="outflow by a power of the level",
    family="outflow |x|^n",
    equation="q = q_m |x / x_m|^n sgn x, n = 1/2 (Torricelli), q_m = r Q",
    signature="The store empties faster at low level and slower at high level than in proportion.",
    reference="Streeter 1975, Fluid Mechanics, 6th ed.",
    acts_on=DRIVEN,
    parameters=(
        EffectParameter(
            "flow_ratio",
            "r",
            "1",
            "flow at the largest value over the flow scale of the port",
            Prior("log_normal", 0.02, 1.0),
            magnitude=True,
        ),
    ),
    build=_outflow,
    shape=(
        ShapeParameter(
            "exponent", "n", "exponent of the level (built from 0 on)", 0.5, Prior("uniform", -0.5, 3.0)
        ),
    ),
    places=_outlets,
    unavailable=needs(trial_of(DRIVEN), carried(PowerDamping), somewhere(state_ports, _NO_STATE)),
    confusable=("overflow", "load_cell"),
)

OVERFLOW = Effect(
    identifier="overflow",
    name="overflow (flow that begins at a level)",
    family="overflow (x - l)^n",
    equation="q = q_m ((x - l) / (x_m - l))^n where x > l, else 0, n = 3/2 (a weir), q_m = r Q",
    signature="A gap in those times only in which the store is full.",
    reference="Streeter 1975, Fluid Mechanics, 6th ed.",
    acts_on=DRIVEN,
    parameters=(
        EffectParameter(
            "level_ratio",
            "l / x_m",
            "1",
            "level at which it begins, over the largest by the model",
            Prior("uniform", 0.2, 1.0),
        ),
        EffectParameter(
            "flow_ratio",
            "r",
            "1",
            "flow at the largest value over the flow scale of the port",
            Prior("log_normal", 0.02, 1.0),
            magnitude=True,
        ),
    ),
    build=_overflow,
    shape=(
        ShapeParameter(
            "exponent", "n", "exponent of the height above the level", 1.5, Prior("uniform", 0.0, 4.0)
        ),
    ),
    places=state_ports,
    unavailable=needs(trial_of(DRIVEN), carried(Overflow), somewhere(state_ports, _NO_STATE)),
    confusable=("outflow", "load_cell"),
)

EFFECTS = (OUTFLOW, OVERFLOW)
