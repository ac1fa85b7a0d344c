"""`uav-twin structure suspects`: which faults a planned measurement would tell apart."""

import json
import re
from collections.abc import Callable
from math import log
from pathlib import Path

import pytest

from discrepancy.campaign.records import Quantity
from discrepancy.catalogue.library import library
from discrepancy.planned_measurement import PlannedMeasurement, Precision, load_plannable_structure
from tests.command_line import refused, said

TEXT_OF_BEAM = (Path(__file__).parents[1] / "inputs" / "beam.toml").read_text(encoding="utf-8")
TIP = 'displacement = [{ name = "tip", point = [100, 10, 5], direction = [0, 0, 1] }]'
CLAMP_OR_GAIN = {"support_compliance", "gauge_gain"}


@pytest.fixture(scope="module")
def rows(write_beam: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory):
    """Return the row of each suspicion by its name, for a beam that is pushed at its end."""
    file = write_beam(tmp_path_factory.mktemp("beam"))
    plan = json.loads(said("structure", "suspects", file, "--json"))
    assert all(pair["measurements"] for pair in plan["look_alikes"])
    return {row["suspicion"]: row for row in plan["suspicions"]}


def measurement(file, strain_noise=1e-6):
    """Return what is planned on a structure file, with gains known to 1 %."""
    noise = {Quantity.STRAIN: strain_noise, Quantity.DISPLACEMENT: 1e-6, Quantity.ACCELERATION: 0.01}
    return PlannedMeasurement(load_plannable_structure(file), Precision(noise, 0.01), library())


def remedies_of_clamp_and_gain(file):
    """Return the remedies for a soft clamp and a gain of the sensor "tip", None if they differ."""
    planned = measurement(file)
    for confusion, plan in planned.confusions:
        if confusion.effects == CLAMP_OR_GAIN:
            pair = planned.look_alikes(confusion, plan)
            return pair.remedies if "tip" in [term.place for term in pair.terms] else None
    return None


def test_a_mass_whose_weight_was_there_at_the_zero_readings_needs_a_release(rows):
    """In load steps, sensors are read from zero with the mass in place."""
    assert rows["added or lost mass"]["least_size"] == "needs a release"


def test_a_support_that_yields_is_told_with_its_spring(rows):
    row = rows["yielding of a support"]
    assert row["place"].startswith("root, ")
    assert row["least_size"].startswith("a spring of ")


def test_smaller_noise_shows_a_smaller_turn_of_a_gauge(write_beam, tmp_path):
    file = write_beam(tmp_path, cells=2)
    least = []
    for noise in (1e-6, 4e-6):
        rows = measurement(file, noise).static.separability.detectability
        least += [row.detectable for row in rows if row.effect.identifier == "gauge_misalignment"]
    assert least[1] > 2.0 * least[0]


def test_a_structure_without_a_force_is_refused():
    assert "has no control in N: a planned load line needs one" in refused("structure", "suspects", "bracket")


def test_what_tells_a_soft_clamp_from_a_wrong_gain_does_so_when_it_is_added(write_beam, tmp_path):
    """The proposed displacement sensor, written into the file, leaves the two distinguishable."""
    gauges = TEXT_OF_BEAM[TEXT_OF_BEAM.index("gauge = [") : TEXT_OF_BEAM.index("displacement = [")]
    # a known modulus: else a softer material looks like the clamp as well
    changes = {gauges: "", 'name = "e"': 'name = "e", minimum = 0.999, maximum = 1.001'}
    remedies = remedies_of_clamp_and_gain(write_beam(tmp_path, changes, cells=2))
    for remedy in remedies:
        assert 0.5 <= remedy.worth.certainty <= 1.0
        assert 0.0 <= remedy.worth.information <= log(2.0) + 1e-9
    words = "a displacement sensor at the point "
    (sensor,) = [remedy for remedy in remedies if remedy.description.startswith(words)]
    assert sensor.worth.certainty > 0.9
    point, axis = re.search(r"\((.*)\) mm along (.)", sensor.description).groups()
    direction = [int(axis == other) for other in "xyz"]
    added = TIP[:-1] + f', {{ name = "added", point = [{point}], direction = {direction} }}]'
    assert remedies_of_clamp_and_gain(write_beam(tmp_path, changes | {TIP: added}, cells=2)) is None
