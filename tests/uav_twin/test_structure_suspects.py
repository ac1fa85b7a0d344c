"""`uav-twin structure suspects`: which faults a planned measurement would tell apart."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command_line import refused, said


@pytest.fixture(scope="module")
def rows(write_beam: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory):
    """Return the row of each suspicion by its name, for a beam that is pushed at its end."""
    file = write_beam(tmp_path_factory.mktemp("beam"))
    plan = json.loads(said("structure", "suspects", file, "--json"))
    return {row["suspicion"]: row for row in plan["suspicions"]}


def test_a_mass_shows_at_rest_by_its_weight(rows):
    """The beam has a load of gravity; without one, a mass needs a release."""
    number, unit = rows["added or lost mass"]["least_size"].split()
    assert 0.1 < float(number) < 2.0
    assert unit == "kg"


def test_a_support_that_yields_is_told_with_its_spring(rows):
    row = rows["yielding of a support"]
    assert row["place"].startswith("root, ")
    assert row["least_size"].startswith("a spring of ")


def test_smaller_noise_shows_a_smaller_turn_of_a_gauge(write_beam, tmp_path):
    file = write_beam(tmp_path)
    sizes = []
    for noise in ("1", "4"):
        text = said("structure", "suspects", file, "--strain-noise", noise, "--json")
        row = next(
            row for row in json.loads(text)["suspicions"] if row["suspicion"] == "misalignment of a gauge"
        )
        sizes.append(float(row["least_size"].split()[0]))
    assert sizes[1] > 2.0 * sizes[0]


def test_a_structure_without_a_force_is_refused():
    assert "has no control in N: a planned load line needs one" in refused("structure", "suspects", "bracket")
