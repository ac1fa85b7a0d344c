"""At rest, a bent curve of the only sensor over the load may be the sensor's or the structure's."""

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.judgement.remarks import verdict_with_only_sensor
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch, TableDamping, TableStiffness

STIFFENING = TableStiffness("cell", (0.0, 1.0), (0.0, 2.0))


def verdict_on(law, kind=VerdictKind.FAMILY):
    effect = NamedEffect("law", "law", "cell", "family", (), (), ModelPatch((law,)))
    return Verdict(kind, "A law is missing.", 0.99, 20.0, effects=(effect,))


def campaign_of(*channels, places=("cell", "cell")):
    """Return a campaign of loadings at given places, in which all channels are read."""
    loads = np.linspace(0.0, 1.0, 5)
    trials = []
    for number, place in enumerate(places):
        values = np.outer(loads, np.ones(len(channels)))
        trials.append(
            Trial.plain(
                f"loading {number}", TrialKind.STATIC, channels, loads, values=values, load_place=place
            )
        )
    noise = NoiseRecord(1e-3, 50.0)
    by_name = {name: Channel(name, Quantity.DISPLACEMENT, name, noise) for name in channels}
    return Campaign("cell", by_name, tuple(trials), None, {}, "0" * 64)


def test_the_map_of_the_only_sensor_is_told():
    reasons = verdict_with_only_sensor(verdict_on(STIFFENING), campaign_of("dial")).reasons
    assert reasons == (
        "A sensor dial whose readings are not in proportion would look the same, "
        "whatever its curve: a second sensor, or a release, would tell."
    )


@pytest.mark.parametrize(
    ("law", "kind", "campaign"),
    [
        (STIFFENING, VerdictKind.FAMILY, campaign_of("dial", "gauge")),
        (STIFFENING, VerdictKind.FAMILY, campaign_of("dial", places=("cell", "tip"))),
        (STIFFENING, VerdictKind.UNEXPLAINED, campaign_of("dial")),
        (TableDamping("cell", (0.0, 1.0), (0.0, 2.0)), VerdictKind.FAMILY, campaign_of("dial")),
    ],
    ids=["two sensors", "two load places", "no name", "a law of speed"],
)
def test_nothing_is_told_where_the_sensor_can_be_tested_or_nothing_is_named(law, kind, campaign):
    verdict = verdict_on(law, kind)
    assert verdict_with_only_sensor(verdict, campaign) is verdict
