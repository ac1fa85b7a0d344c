"""Which sensors tell most, against exhaustive search and integrals."""

import itertools
import json
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from fe.structure.location import on_surface
from fe.structure.mesh_file import read_mesh
from tests.command_line import refused, said
from tests.costs import once
from tests.twin_master.runs import of_wing
from twin_master.errors import MissionInputError
from twin_master.mission import sensor_design
from twin_master.mission.preparation import Knowledge
from twin_master.mission.sensor_design import DrawnReadings, choose_sensors, draw_readings, level_separations
from twin_master.plan_command import _without_information
from uav_twin import structure_files


@once
def gauged() -> Knowledge:
    return of_wing("level_turns")[0]


def test_the_information_of_sensors_is_that_of_an_integral_also_where_something_moves_them_together():
    """Two sensors that step one reading, and another of no meaning, by 30 degrees tell what the one does."""
    means, moved = np.array([0.0, 1.0, 3.0]), np.array([0.3, 1.0, 0.6])
    spread, state = np.sqrt(1.0 + moved**2), np.arange(60_000) % 3
    shown = means[state] + spread[state] * norm.ppf((np.arange(60_000) // 3 + 0.5) / 20_000)
    residual = np.stack((shown[:, None] - means, np.ones((60_000, 3))), axis=-1)
    turned = np.array([[0.75**0.5, 0.0, 0.5], [-0.5, 0.0, 0.75**0.5]])  # and one shows nothing
    shares = moved[:, None] * turned[0]
    readings = DrawnReadings(state, residual @ turned, shares[..., None], np.zeros((3, 3)))

    def entropy(value: float) -> float:
        density = norm.pdf(value - means, scale=spread).mean()
        return -float(density * np.log2(density))

    noise = np.log2(spread).mean() + 0.5 * np.log2(2.0 * np.pi * np.e)
    exact = quad(entropy, -9.0, 12.0, limit=200)[0] - noise
    assert readings.information([0, 2]) == pytest.approx(exact, abs=3e-5)


@pytest.mark.parametrize("samples", [7, 30])
def test_readings_are_drawn_in_states_that_are_all_alike_probable(samples, monkeypatch):
    monkeypatch.setattr(sensor_design, "SAMPLES", samples)
    for readings in draw_readings(gauged()):
        times = np.bincount(readings.state, minlength=25)
        assert times.max() == 1
        assert times.sum() == min(samples, 25)
        assert len({*(readings.state // 5)}) > 2  # not only where the first region is sound


EVERY_SECOND_GAUGE = range(0, 24, 2)


@once
def gauge_readings() -> Any:
    """Return the readings from which gauges of the level turns are chosen."""
    return draw_readings(gauged())


def test_three_of_twelve_are_those_of_an_exhaustive_search():
    readings = gauge_readings()
    chosen = choose_sensors(readings, EVERY_SECOND_GAUGE, 3)
    information = {
        gauges: float(np.mean([reading.information(gauges) for reading in readings]))
        for gauges in itertools.combinations(EVERY_SECOND_GAUGE, 3)
    }
    best = max(information, key=lambda gauges: information[gauges])
    assert tuple(sorted(chosen.sensors)) == best
    assert chosen.information[-1] == pytest.approx(information[best], rel=1e-12)
    assert chosen.information_of_all > chosen.information[-1] > chosen.information[0] > 0.0


def test_more_sensors_than_there_are_cannot_be_chosen():
    with pytest.raises(MissionInputError, match="from 1 to 2"):
        choose_sensors(gauge_readings(), [0, 1], 3)


def test_gauges_beside_a_region_separate_its_levels_and_hardly_those_of_the_other_region():
    separations = level_separations(gauged(), gauge_readings(), range(24))
    assert min(value for (region, _), value in separations.items() if region == "z1") > 2.0
    assert max(value for (region, _), value in separations.items() if region == "z2") < 1.0


def test_fewer_gauges_separate_no_levels_better():
    all_gauges = level_separations(gauged(), gauge_readings(), range(24))
    two_gauges = level_separations(gauged(), gauge_readings(), [16, 23])
    assert all(two_gauges[levels] <= value + 1e-9 for levels, value in all_gauges.items())


def test_a_gauge_that_is_taken_away_tells_nothing_whatever_its_unit():
    known, size = gauged(), 1e12
    observation = known.scenario.observation.model_copy(update={"standard_deviation": size * 125e-6})
    large = known.scenario.model_copy(update={"observation": observation})
    values = size * known.sensor_model.value_per_draw
    model = _without_information(Knowledge(large, known.model, known.draws, values), ["24"]).sensor_model
    seen = np.where(np.arange(24) == 23, values[0, 0, 1], np.nan)
    assert np.ptp(model.log_likelihood(seen, 1)) < 1e-6


@pytest.fixture(scope="module")
def two_chosen_gauges(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path, Path]:
    """What the command says of two gauges for the level turns; its picture, and its points."""
    folder = tmp_path_factory.mktemp("chosen")
    picture = folder / "design.png"
    points = folder / "gauges.vtu"
    options = ("--sensors", 2, "--among", "1,17,24", "--picture", picture, "--vtu", points, "--json")
    record: dict[str, Any] = json.loads(said("design", "level_turns", *options))
    return record, picture, points


def test_the_command_chooses_sensors_and_names_what_is_not_separated(two_chosen_gauges):
    record, _, _ = two_chosen_gauges
    assert record["sensors"] == ["17", "24"]
    assert "z2 of 0 % from 20 %" in record["not_separated"]


def test_the_command_draws_and_ranks_chosen_sensors(two_chosen_gauges):
    _, picture, points = two_chosen_gauges
    rank = meshio.read(points).point_data["rank"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert rank[[16, 23]].tolist() == [1.0, 2.0]
    assert rank.sum() == 3.0


def designed(*words: object) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(said("design", "stiffened_panel", *words, "--json"))
    return record


class PanelDesign:
    """Two gauges chosen on the stiffened panel from ten candidates; its points and its picture."""

    def __init__(self, folder: Path) -> None:
        points = folder / "gauges.vtu"
        self.picture = folder / "design.svg"
        options = ("--candidates", 10, "--vtu", points, "--picture", self.picture)
        self.record = designed("--sensors", 2, *options)
        self.points = meshio.read(points).points
        self.candidates = self.points[6::3]
        """Behind the six gauges of the file stand ten candidates of three directions each."""


@pytest.fixture(scope="module")
def panel_design(tmp_path_factory: pytest.TempPathFactory) -> PanelDesign:
    return PanelDesign(tmp_path_factory.mktemp("panel"))


def test_gauges_anywhere_on_a_structure_tell_more_than_those_of_its_file(panel_design):
    declared = designed("--sensors", 2)
    assert panel_design.record["of_all"] > declared["of_all"]
    assert panel_design.record["information"][-1] > declared["information"][-1]


def test_candidates_lie_on_the_surface_of_a_structure(panel_design):
    mesh = read_mesh(structure_files()["stiffened_panel"].with_suffix(".msh"), 1e-3, "mm")
    distances = [on_surface(mesh, point, "it").distance for point in panel_design.candidates]
    assert max(distances) < 1e-9


def test_candidates_are_spread_over_a_structure(panel_design):
    """They are 20 mm apart on a panel of 0.3 m by 0.2 m."""
    candidates = panel_design.candidates
    assert len(panel_design.points) == 6 + 3 * 10
    distances = np.linalg.norm(candidates[:, None] - candidates, axis=2)
    assert (distances + np.eye(10)).min() > 0.02


def test_candidates_are_drawn(panel_design):
    assert panel_design.picture.read_bytes().startswith(b"<?xml")


@pytest.fixture
def listed_gauges(tmp_path: Path) -> Path:
    """A list with a gauge, which stands where the file has one, and a rosette of two axes."""
    path = tmp_path / "more.toml"
    path.write_text(
        '[[gauge]]\nname = "twin_of_end"\npoint = [40, 50, -20]\ndirection = [1, 0, 0]\nlength = 5\n'
        '[[rosette]]\nname = "r"\npoint = [150, 100, 2]\naxes = [[1, 0, 0], [0, 1, 0]]\nangles = [0, 90]\n'
    )
    return path


def test_a_listed_candidate_tells_what_the_same_gauge_of_the_file_does(listed_gauges):
    words = ("--sensors", 1, "--candidates", listed_gauges, "--among")
    listed = designed(*words, "twin_of_end")["of_all"]
    declared = designed(*words, "end 1")["of_all"]
    elsewhere = designed(*words, "stiffener 1")["of_all"]
    assert listed == pytest.approx(declared, rel=0.05)  # the noise is drawn anew
    assert abs(elsewhere - declared) > 0.1 * declared


def test_the_axes_of_a_listed_rosette_are_candidates(listed_gauges):
    words = ("--sensors", 1, "--candidates", listed_gauges, "--among", "r_b,skin across")
    assert designed(*words)["sensors"][0] in ("r_b", "skin across")


def test_a_list_without_gauges_is_refused_by_its_name(listed_gauges):
    listed_gauges.write_text("gauge = 3\n")
    words = ("--sensors", 1, "--candidates", listed_gauges, "--among", "end 1")
    assert "more.toml" in refused("design", "stiffened_panel", *words)
