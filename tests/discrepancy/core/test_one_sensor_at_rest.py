"""A structure that stiffens under a load at rest, seen by one sensor: its force, or the sensor's map.

The load of a beam with the force k x + c (x / x_0)^n is known in closed form.
"""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, TrialKind
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.discrepancy.core import kit
from tests.discrepancy.rigs import model_of

STIFFNESS, STIFFENING, FULL_DEFLECTION = 84.6, 6.2, 0.2755
NOISE = 1e-3
BEAM = """
format = 1
name = "Tip deflection of a linear beam"
mass = 0.1
stiffness = 84.6
damping = { ratios = 0.01 }
input = [{ name = "tip", vector = 1.0 }]
output = [{ name = "deflection", vector = 1.0 }]
port = [{ name = "root", vector = 1.0 }]

[[parameter]]
name = "stiffness_factor"
terms = "stiffness"
mean = 1.0
deviation = 0.03
low = 0.7
high = 1.3
"""


def beam_investigation(exponent):
    """Return the investigation of one sweep of 16 loads by one sensor of the deflection."""
    deflection = np.linspace(0.0, 1.0, 16) * FULL_DEFLECTION
    load = STIFFNESS * deflection + STIFFENING * (deflection / FULL_DEFLECTION) ** exponent
    noise = NOISE * np.random.default_rng(11).standard_normal(16)
    sweep = kit.blank_trial("sweep", TrialKind.STATIC, ("deflection",), load, load_place="tip")
    sweep = replace(sweep, values=(deflection + noise)[:, np.newaxis])
    sensor = Channel("deflection", Quantity.DISPLACEMENT, "deflection", NoiseRecord(NOISE, 100.0), 0.0, 5e-4)
    campaign = Campaign("beam", {"deflection": sensor}, (sweep,), None, {}, "")
    return investigate(campaign, model_of(BEAM))


@pytest.fixture(scope="module", params=[4.25, 5.0], ids=lambda exponent: f"|x|^{exponent}")
def investigation(request):
    return beam_investigation(request.param)


def test_one_sensor_cannot_tell_its_map_from_a_force_that_stiffens(investigation):
    verdict = investigation.verdict
    assert verdict.kind is VerdictKind.GROUP
    assert set(verdict.group) == {"sensor_saturation", "cubic_stiffness"}


def test_a_second_sensor_would_tell(investigation):
    proposals = [item.description for item in investigation.verdict.next_experiments]
    assert "Repeat 'sweep' with a second sensor beside 'deflection'." in proposals
