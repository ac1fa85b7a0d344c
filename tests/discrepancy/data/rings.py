"""Rings of a mass on a spring and a rest, as files would have them; what is found wrong with them."""

import numpy as np

from discrepancy.campaign.noise_records import pre_trigger_record
from discrepancy.campaign.records import Channel, Quantity, Start, TrialKind
from discrepancy.checks.fault import FaultKind
from tests.discrepancy.rigs import asked, campaign, model_of
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
MODEL = model_of(INPUTS.text("mass_on_a_spring.toml"))
TIME = 0.005 * np.arange(1600)


def campaign_of(ring=None, rest=None, digit=1e-6, trials=2):
    """Return rings of x and y [mm] and a rest as files would have them; both may be changed in place."""
    generator = np.random.default_rng(5)
    still = 0.02 * generator.standard_normal((800, 2))
    if rest:
        rest(still)
    made = []
    for number in range(trials):
        # a tenth stiffer than the model has it: records in phase with it would say less
        motion = (20.0 + number) * np.exp(-0.2 * TIME) * np.cos(np.sqrt(440.0) * TIME + number)
        values = np.column_stack((motion, -0.5 * motion)) + 0.02 * generator.standard_normal((1600, 2))
        if ring:
            ring(values)
        given = {"values": np.round(values / digit) * digit * 1e-3, "begins": Start.UNKNOWN}
        given |= {"name": f"ring {number}", "channels": ("x", "y"), "file": f"{number}.csv"}
        made.append(asked(TrialKind.DRIVEN, TIME, **given))
    noise = (pre_trigger_record(1e-3 * column, 0.005, "rest", "rest.csv") for column in still.T)
    channels = {
        name: Channel(name, Quantity.DISPLACEMENT, name, record, column=f"{name} [mm]", unit="mm")
        for name, record in zip("xy", noise, strict=True)
    }
    return campaign(*made, **channels)


def only(faults, kind):
    """Return the one fault of a campaign, which is of a kind; what is held or scaled belies its noise too."""
    (fault,) = (item for item in faults if item.kind is not FaultKind.NOISE_LABEL)
    assert fault.kind is kind, fault.sentence
    assert fault.sentence.count(". ") == 0
    return fault
