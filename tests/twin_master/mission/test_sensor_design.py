"""Which sensors tell most, against exhaustive search and integrals."""

import itertools
import json
from functools import cache
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from fe.structure.location import on_surface
from fe.structure.mesh_file import read_mesh
from scenarios import structure_files
from tests.command_line import refused, said
from tests.twin_master.runs import of_wing
from twin_master.errors import MissionInputError
from twin_master.mission import sensor_design
from twin_master.mission.preparation import Knowledge
from twin_master.mission.sensor_design import Readings, chosen_sensors, drawn_readings, separations
from twin_master.plan_command import _without


@cache
def knowledge() -> Knowledge:
    return of_wing("level_turns")[0]


def test_the_information_of_sensors_is_that_of_an_integral_also_where_something_moves_them_together():
    """Two sensors that turn one reading, and another of no meaning, by 30 degrees tell what the one does."""
    means, moved = np.array([0.0, 1.0, 3.0]), np.array([0.3, 1.0, 0.6])
    spread, state = np.sqrt(1.0 + moved**2), np.arange(60_000) % 3
    shown = means[state] + spread[state] * norm.ppf((np.arange(60_000) // 3 + 0.5) / 20_000)
    residual = np.stack((shown[:, None] - means, np.ones((60_000, 3))), axis=-1)
    turned = np.array([[0.75**0.5, 0.0, 0.5], [-0.5, 0.0, 0.75**0.5]])  # and one shows nothing
    shares = moved[:, None] * turned[0]
    readings = Readings(state, residual @ turned, shares[..., None], np.zeros((3, 3)))

    def entropy(value: float) -> float:
        density = norm.pdf(value - means, scale=spread).mean()
        return -float(density * np.log2(density))

    noise = np.log2(spread).mean() + 0.5 * np.log2(2.0 * np.pi * np.e)
    exact = quad(entropy, -9.0, 12.0, limit=200)[0] - noise
    assert readings.information([0, 2]) == pytest.approx(exact, abs=3e-5)


@pytest.mark.parametrize("samples", [7, 30])
def test_readings_are_drawn_in_states_that_are_all_alike_probable(samples, monkeypatch):
    monkeypatch.setattr(sensor_design, "SAMPLES", samples)
    for readings in drawn_readings(knowledge()):
        times = np.bincount(readings.state, minlength=25)
        assert times.max() == 1
        assert times.sum() == min(samples, 25)
        assert len({*(readings.state // 5)}) > 2  # not only where the first region is sound


def test_three_of_twelve_are_those_of_an_exhaustive_search():
    """One beside a region separates its levels, and those of the other region are hardly told."""
    readings, able = drawn_readings(knowledge()), range(0, 24, 2)
    found = chosen_sensors(readings, able, 3)
    told = {
        some: float(np.mean([under.information(some) for under in readings]))
        for some in itertools.combinations(able, 3)
    }
    best = max(told, key=lambda some: told[some])
    assert tuple(sorted(found.sensors)) == best
    assert found.information[-1] == pytest.approx(told[best], rel=1e-12)
    assert found.of_all > found.information[-1] > found.information[0] > 0.0
    with pytest.raises(MissionInputError, match="from 1 to 2"):
        chosen_sensors(readings, [0, 1], 3)
    apart, fewer = (separations(knowledge(), readings, gauges) for gauges in (range(24), [16, 23]))
    assert min(far for (name, _), far in apart.items() if name == "z1") > 2.0
    assert max(far for (name, _), far in apart.items() if name == "z2") < 1.0
    assert all(fewer[place] <= far + 1e-9 for place, far in apart.items())


def test_a_gauge_that_is_taken_away_tells_nothing_whatever_its_unit():
    known, size = knowledge(), 1e12
    observation = known.scenario.observation.model_copy(update={"standard_deviation": size * 125e-6})
    large = known.scenario.model_copy(update={"observation": observation})
    values = size * known.sensor_model.value_per_draw
    model = _without(Knowledge(large, known.model, known.draws, values), ["24"]).sensor_model
    seen = np.where(np.arange(24) == 23, values[0, 0, 1], np.nan)
    assert np.ptp(model.log_likelihood(seen, 1)) < 1e-6


def test_the_command_chooses_draws_and_names_what_is_not_separated(tmp_path):
    picture, points = tmp_path / "design.png", tmp_path / "gauges.vtu"
    words = ("design", "level_turns", "--sensors", 2, "--among")
    record = json.loads(said(*words, "1,17,24", "--picture", picture, "--vtu", points, "--json"))
    assert record["sensors"] == ["17", "24"]
    assert "z2 of 0 % from 20 %" in record["not_separated"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    rank = meshio.read(points).point_data["rank"]
    assert rank[[16, 23]].tolist() == [1.0, 2.0]
    assert rank.sum() == 3.0


def designed(*words: object) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(said("design", "stiffened_panel", *words, "--json"))
    return record


def test_gauges_may_be_anywhere_on_the_surface_of_a_structure(tmp_path):
    points, picture = tmp_path / "gauges.vtu", tmp_path / "design.svg"
    declared = designed("--sensors", 2)
    found = designed("--sensors", 2, "--candidates", 10, "--vtu", points, "--picture", picture)
    assert found["of_all"] > declared["of_all"]
    assert found["information"][-1] > declared["information"][-1]
    cloud = meshio.read(points)
    assert len(cloud.points) == 6 + 3 * 10
    mesh = read_mesh(structure_files()["stiffened_panel"].with_suffix(".msh"), 1e-3, "mm")
    places = cloud.points[6::3]
    assert max(on_surface(mesh, place, "it").distance for place in places) < 1e-9
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.eye(10)
    assert apart.min() > 0.02  # of a panel of 0.3 m by 0.2 m
    assert picture.read_bytes().startswith(b"<?xml")


def test_a_listed_candidate_tells_what_the_same_gauge_of_the_file_does(tmp_path):
    listed = tmp_path / "more.toml"
    listed.write_text(
        '[[gauge]]\nname = "twin_of_end"\npoint = [40, 50, -20]\ndirection = [1, 0, 0]\nlength = 5\n'
        '[[rosette]]\nname = "r"\npoint = [150, 100, 2]\naxes = [[1, 0, 0], [0, 1, 0]]\nangles = [0, 90]\n'
    )
    words = ("--sensors", 1, "--candidates", listed, "--among")
    same, own, other = (designed(*words, name)["of_all"] for name in ("twin_of_end", "end 1", "stiffener 1"))
    assert same == pytest.approx(own, rel=0.05)  # the noise is drawn anew
    assert abs(other - own) > 0.1 * own
    assert designed(*words, "r_b,skin across")["sensors"][0] in ("r_b", "skin across")
    listed.write_text("gauge = 3\n")
    assert "more.toml" in refused("design", "stiffened_panel", *words, "end 1")
