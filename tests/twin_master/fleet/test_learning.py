"""What a fleet teaches, against enumeration, closed forms and the truth."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import expit, logit
from scipy.stats import beta, betabinom, norm, t

from reporting.pages.page import render_page
from reporting.progress import Progress
from tests.refusals import refused
from tests.twin_master.network.decision_oracles import precise_forward_backward
from tests.twin_master.runs import text_of, written
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import FleetError, MissionInputError
from twin_master.fleet.comparison import outcomes_of_group
from twin_master.fleet.configuration import fleet_config, knowledge_folder
from twin_master.fleet.learning.evidence import (
    TransitionFamily,
    reason_transitions_are_fixed,
    transition_evidence,
)
from twin_master.fleet.learning.grid_density import Axes, Distribution
from twin_master.fleet.learning.learn import learn_fleet
from twin_master.fleet.learning.noise import with_noise_factor
from twin_master.fleet.learning.parameter_evidence import parameter_evidence
from twin_master.fleet.learning.posterior import (
    HIGHEST,
    LOWEST,
    LikelihoodGrid,
    PopulationPosterior,
    likelihood_grid,
    population_posterior,
    shared_posterior,
)
from twin_master.fleet.learning.row_file import RowFile
from twin_master.fleet.outcomes import Estimated, Outcomes
from twin_master.fleet.page.overview import overview_of_group
from twin_master.fleet.page.report import fleet_page, write_fleet_report
from twin_master.fleet.page.view import ATTENTION_ROWS
from twin_master.fleet.plan import Fleet, ensemble, load_fleet
from twin_master.fleet.reading import ControlForecast, probability_of_leaving, severity
from twin_master.fleet.storage.store_layout import ALL_ROWS, observation_rows, row_blocks
from twin_master.mission.knowledge_file import load_knowledge, save_knowledge
from twin_master.network.graphical_model import build_graphical_model
from twin_master.network.planner import BeliefPolicy
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario
from uav_twin import GaussianSensorModel, fly_fleet, learn_from_fleet, load_scenario, open_fleet

EACH = {"2g": 0.07, "3g": 0.2}


def tiny(
    probability: object, levels: int = 3, name: str = "growing_damage", success: float = 1.0
) -> Scenario:
    """Return a shipped scenario with few levels, whose repairs may fail."""
    table = load_scenario(name).scenario.to_dict()
    for action in table["action"]:
        action["success"] = success if action["repairs"] else 1.0
    for state in table["state"]:
        state["levels"] = np.linspace(0.0, 0.4, levels).tolist()
        state["prior"] = [1.0] + [0.0] * (levels - 1)
    table["transition"]["probability"] = probability
    return parse_scenario(table, "tiny")


@pytest.mark.parametrize(
    ("probability", "name", "success"),
    [
        (EACH, "growing_damage", 1.0),
        ({"2g": {"z1": 0.07, "z2": 0.3}, "3g": {"z1": 0.2, "z2": 0.01}}, "growing_damage", 1.0),
        (EACH, "inspected_wing", 0.7),
    ],
)
def test_evidence_of_a_twin_is_that_of_all_paths(probability, name, success):
    """Also of one that is repaired."""
    scenario = tiny(probability, name=name, success=success)
    family, controls = TransitionFamily.learnable(scenario), len(scenario.control)
    assert len(family.names) == (controls if probability is EACH else 4)
    generator = np.random.default_rng(4)
    likelihood = generator.random((2, 4, 9))
    control = generator.permuted(np.tile(np.arange(4 + controls) % controls, (2, 1)), axis=1)[:, :4]
    points = np.array([family.assumed, 0.5 * family.assumed + 0.3])
    found = transition_evidence(family, points, np.log(likelihood), control)
    for row, point in enumerate(points):
        value = dict(zip(family.names, point.tolist(), strict=True))
        given = {
            control: {name: value.get(f"{control}, {name}", value.get(control)) for name in ("z1", "z2")}
            for control in scenario.control_names
        }
        model = build_graphical_model(tiny(given, name=name, success=success))
        for twin in range(2):
            *_, expected = precise_forward_backward(model, control[twin], np.log(likelihood[twin]))
            assert found[twin, row] == pytest.approx(expected.sum(), abs=1e-12)


def test_evidence_of_a_node_is_that_of_the_filter():
    scenario = tiny(EACH, levels=5)
    model, family = build_graphical_model(scenario), TransitionFamily.learnable(scenario)
    generator = np.random.default_rng(5)
    values = 1e-3 * (1.0 + generator.random((3, 25, 2, 24)))
    interval = 1e-4 * generator.standard_normal((25, 2, 24, 2))
    observed = values[1, 3, 0] + 1e-4 * generator.standard_normal((2, 6, 24))
    observed[0, 2] = observed[1, :, 5] = np.nan
    control = generator.integers(0, 2, (2, 6))
    sensors = GaussianSensorModel(values, 1e-4, interval=interval)
    nodes = parameter_evidence(family, family.assumed, sensors, observed, control)
    for node, twin in product(range(3), range(2)):
        alone = GaussianSensorModel(values[node : node + 1], 1e-4, interval=interval)
        rows = alone.log_likelihood_sequence(observed[twin], control[twin])
        *_, expected = precise_forward_backward(model, control[twin], rows)
        assert nodes[twin, node] == pytest.approx(expected.sum(), rel=1e-12)


class Counts:
    """The log likelihood of probabilities of which so many were hits; counts its grids."""

    def __init__(self, hits: float, misses: float) -> None:
        self.hits, self.misses = hits, misses
        self.grids = 0

    def on_grid(self, axes: Axes) -> np.ndarray:
        self.grids += 1
        points = expit(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        return self.hits * np.log(points).sum(axis=-1) + self.misses * np.log1p(-points).sum(axis=-1)


@pytest.mark.parametrize(
    "first",
    [(0.099, 0.101), (0.08, 0.12), (0.1, 0.9), (0.3, 0.4)],
    ids=["narrow", "about right", "one-sided", "beside it"],
)
def test_a_search_finds_a_posterior_wherever_it_begins(first):
    counts = Counts(1e5, 9e5)
    first_axis = np.linspace(*logit(first), 13)
    marginals = likelihood_grid(counts.on_grid, 2, (first_axis, first_axis)).marginals
    exact = beta(1e5 + 1.0, 9e5 + 1.0)
    for marginal in marginals:
        assert marginal.mean == pytest.approx(exact.mean(), abs=1e-3 * exact.std())
        assert marginal.standard_deviation == pytest.approx(exact.std(), rel=1e-3)


def test_a_search_that_begins_with_the_posterior_of_some_twins_needs_few_grids():
    """The posterior of one twin in sixteen is four times as wide."""
    some, all_twins, whole_range = Counts(6.3e3, 56.2e3), Counts(1e5, 9e5), Counts(1e5, 9e5)
    first_axes = likelihood_grid(some.on_grid, 2).axes
    likelihood_grid(all_twins.on_grid, 2, first_axes)
    likelihood_grid(whole_range.on_grid, 2)
    assert all_twins.grids <= 3 < whole_range.grids


def grid_of(*counts: tuple[int, int]) -> LikelihoodGrid:
    """Return the likelihood of probabilities of which so many were hits, and so many not."""
    hits, misses = np.array(counts, dtype=float).T

    def log_likelihood(axes: Axes) -> np.ndarray:
        points = expit(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        return np.log(points) @ hits + np.log1p(-points) @ misses

    return likelihood_grid(log_likelihood, len(counts))


SIMILAR, MANY = ((3, 47), (6, 44), (2, 48), (9, 41), (4, 46)), (22_500, 427_500)


class DenseSum:
    """Groups with a beta-binomial law each, summed over a dense grid of shared mean and concentration."""

    def __init__(self, counts: Sequence[tuple[int, int]]) -> None:
        low, high = logit(np.array([LOWEST, HIGHEST]))
        middles = np.linspace(low, high, 402)[:-1] + 0.5 * (high - low) / 401
        concentrations = 10.0 ** (np.log10(3.0) + (np.arange(120) + 0.5) / 40.0)
        self.mean, self.concentration = np.meshgrid(expit(middles), concentrations, indexing="ij")
        self.a = self.mean * self.concentration
        self.b = (1.0 - self.mean) * self.concentration
        likelihoods = [betabinom.pmf(worsened, worsened + kept, self.a, self.b) for worsened, kept in counts]
        weight = np.prod(likelihoods, axis=0)
        self.weight = weight / weight.sum()

    def expectation(self, values: np.ndarray) -> float:
        """Return the posterior mean of values on the grid."""
        return float((self.weight * values).sum())


@pytest.fixture(
    scope="module",
    params=[
        (SIMILAR, (), 1e-3),
        (SIMILAR, ((5, 95),), 1e-3),
        ((MANY, (1, 249)), (), 1e-2),
        ((MANY, (13, 237)), (), 1e-3),
    ],
)
def shared_groups(request: pytest.FixtureRequest) -> tuple[Any, Any, Any, float]:
    """The counts of groups, their posterior, the dense sum, and the relative error that is allowed.

    One case stands beside another probability, which says nothing of it; some have one group of few twins
    beside one of many.
    """
    counts, counts_of_other_control, tolerance = request.param
    posterior = shared_posterior([grid_of(own, *counts_of_other_control) for own in counts])
    return counts, posterior, DenseSum(counts), tolerance


def test_groups_share_the_hyperparameters_of_a_dense_sum(shared_groups):
    _, posterior, dense, tolerance = shared_groups
    shared = posterior.hyperparameters[0]
    log10_concentration = dense.expectation(np.log10(dense.concentration))
    assert shared["mean"] == pytest.approx(dense.expectation(dense.mean), rel=tolerance)
    assert shared["log10_concentration"] == pytest.approx(log10_concentration, rel=tolerance)


def test_groups_have_the_means_and_intervals_of_a_dense_sum(shared_groups):
    counts, posterior, dense, tolerance = shared_groups
    for (worsened, kept), (marginal, *_) in zip(counts, posterior.groups, strict=True):
        a, b = dense.a + worsened, dense.b + kept
        mean = dense.expectation(a / (a + b))
        assert marginal.mean == pytest.approx(mean, rel=max(tolerance, 2e-3))
        for bound, expected_probability in zip(marginal.interval(), (0.025, 0.975), strict=True):
            probability = dense.expectation(beta.cdf(bound, a, b))
            assert probability == pytest.approx(expected_probability, abs=4e-3)


@pytest.mark.parametrize("members", [2, 5, 60])
def test_a_population_is_what_a_dense_sum_says(members):
    """Of normal members, under a Student's prior of the spread."""
    nodes, blur, scale = np.linspace(0.94, 1.06, 61), 0.004, 0.01
    seen = 1.01 + np.hypot(0.01, blur) * np.random.default_rng(members).standard_normal(members)
    found = population_posterior(nodes, [-0.5 * ((nodes - seen[:, None]) / blur) ** 2], scale)
    mean, spread = np.linspace(0.94, 1.06, 401)[:, None], np.linspace(1e-5, 0.06, 400)
    density = sum(norm.logpdf(x, mean, np.hypot(spread, blur)) for x in seen) + t.logpdf(spread / scale, 4)
    weight = np.exp(density - density.max()) / np.exp(density - density.max()).sum()
    for line, values, share in zip(
        (found.mean, found.deviation),
        (mean[:, 0], spread),
        (weight.sum(1), weight.sum(0)),
        strict=True,
    ):
        middle = share @ values
        deviation = np.sqrt(share @ (values - middle) ** 2)
        assert line.mean == pytest.approx(middle, abs=0.02 * deviation)
        assert line.standard_deviation == pytest.approx(deviation, rel=0.01)
        ends = np.interp([0.025, 0.975], np.cumsum(share) - 0.5 * share, values)
        np.testing.assert_allclose(line.interval(), ends, atol=0.03 * deviation)


@pytest.fixture(scope="module")
def grown(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Fleet, Path]:
    folder = tmp_path_factory.mktemp("grown")
    fleet = ensemble("growing_damage", range(60), Overrides(strain_library=library_file))
    return fleet, fly_fleet(fleet, folder / "fleet").folder


@pytest.fixture(scope="module")
def learnt_by_fleet(
    grown: tuple[Fleet, Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    """What the fleet teaches of its group, and the file with it."""
    file = tmp_path_factory.mktemp("learnt") / "learnt.toml"
    return learn_from_fleet(grown[1], file)["groups"]["growing_damage"], file


@pytest.mark.parametrize(("control", "truth"), [("2g", 0.05), ("3g", 0.1)])
def test_a_fleet_learns_its_rates(learnt_by_fleet, control, truth):
    record, _ = learnt_by_fleet
    rate = record["probability"][control]
    assert abs(rate["mean"] - truth) < 4.0 * rate["standard_deviation"] < 0.1
    assert rate["lower_95"] < rate["mean"] < rate["upper_95"]


def test_what_a_fleet_has_learnt_is_believed_and_leaves_the_truth(learnt_by_fleet):
    record, file = learnt_by_fleet
    scenario = resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=file))
    assert scenario.transition.probability["3g"] == record["probability"]["3g"]["mean"]
    assert scenario.truth.probability == {"2g": 0.05, "3g": 0.1}


def test_the_noise_that_a_fleet_has_learnt_is_believed(grown, learnt_by_fleet):
    fleet, _ = grown
    record, file = learnt_by_fleet
    scenario = resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=file))
    assumed = fleet.groups[0].scenarios[0].observation.standard_deviation
    expected = np.multiply(assumed, record["noise_factor"]["mean"])
    assert scenario.observation.standard_deviation == pytest.approx(expected)


def numbers_of(record: Any) -> list[float]:
    """Return all numbers of a record in their order."""
    if isinstance(record, dict):
        return [number for value in record.values() for number in numbers_of(value)]
    return [float(record)] if isinstance(record, int | float) else []


def test_a_fleet_that_is_read_by_blocks_teaches_what_the_whole_teaches(grown, learnt_by_fleet, monkeypatch):
    monkeypatch.setattr("twin_master.fleet.storage.store_layout.BLOCK_TWINS", 7)
    record = learn_fleet(grown[1])["groups"]["growing_damage"]
    np.testing.assert_allclose(numbers_of(record), numbers_of(learnt_by_fleet[0]), rtol=1e-9)


@pytest.mark.parametrize("spread", [0.001, 0.05, 0.15], ids=["narrow", "two steps", "wide"])
def test_the_prior_of_a_member_has_the_mean_of_the_population(spread):
    """Also if the population lies between two of the values, which are 0.02 apart."""
    nodes = np.linspace(0.0, 2.0, 101)
    grid = np.linspace(-4.0, 4.0, 41)
    around = norm.pdf(grid) / norm.pdf(grid).sum()
    population = PopulationPosterior(
        mean=Distribution(1.007 + 0.0002 * grid, around),
        deviation=Distribution(spread * (1.0 + 0.05 * grid), around),
    )
    prior = population.prior_of_member(nodes)
    deviation = np.sqrt(prior @ (nodes - prior @ nodes) ** 2)
    assert prior.sum() == pytest.approx(1.0, rel=1e-12)
    assert prior @ nodes == pytest.approx(1.007, abs=2e-5)
    assert deviation == pytest.approx(max(spread, 0.02 * 2.0 / 3.0), rel=0.01)


def test_a_population_is_the_same_for_members_taken_a_few_at_a_time(tmp_path):
    nodes = np.linspace(-1.0, 1.0, 31)
    log_evidence = -0.5 * ((nodes - np.random.default_rng(4).normal(0.0, 0.2, (23, 1))) / 0.1) ** 2
    whole = population_posterior(nodes, [log_evidence], 0.2)
    with RowFile(tmp_path, len(nodes), rows_together=4) as rows:
        for first in range(0, 23, 5):
            rows.append(log_evidence[first : first + 5])
        assert [len(block) for block in rows] == [4, 4, 4, 4, 4, 3]
        parts = population_posterior(nodes, rows, 0.2)
    for name in ("mean", "deviation"):
        expected = numbers_of(getattr(whole, name).summary)
        np.testing.assert_allclose(numbers_of(getattr(parts, name).summary), expected, rtol=1e-12)


TRUE_MODULUS = {"soft": 0.99, "stiff": 1.02}
"""Mean of the true modulus of each group, as a factor."""


@pytest.fixture(scope="module")
def learnt_by_two_groups(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What two groups teach, of wings whose model tells the strains at any value of the modulus."""
    folder = tmp_path_factory.mktemp("two")
    text = 'format = 1\nfleet = { name = "two", seed = 5 }\n'
    for name, mean in TRUE_MODULUS.items():
        text += f'[[group]]\nname = "{name}"\nscenario = "growing_damage"\ncount = 8\nsteps = 12\n'
        text += f"parameters = {{ young_modulus_factor = {{ mean = {mean}, standard_deviation = 0.002 }} }}\n"
    flown = fly_fleet(load_fleet(written(folder, text)), folder / "fleet").folder
    return learn_from_fleet(flown, folder / "learnt.toml")


def test_values_of_the_parameter_outside_the_range_of_the_model_are_refused(tmp_path):
    known = ('source = "static_test"', 'source = "normal"\nmean = 1.0\nstandard_deviation = 0.02')
    scenario = written(tmp_path, text_of("growing_damage", known))
    text = 'format = 1\nfleet = { name = "wide", seed = 5 }\n'
    text += f'[[group]]\nname = "north"\nscenario = "{scenario.name}"\ncount = 2\nsteps = 3\n'
    plan = load_fleet(written(tmp_path, text, name="fleet.toml"))
    flown = fly_fleet(plan, tmp_path / "fleet").folder
    sentence = "up to 6 standard deviations from the mean of the calibration, .* fly the fleet again"
    with refused(FleetError, sentence):
        learn_fleet(flown)


@pytest.mark.parametrize("name", TRUE_MODULUS)
def test_each_group_has_a_population_of_the_parameter(learnt_by_two_groups, name):
    group = learnt_by_two_groups["groups"][name]
    mean = group["population"]["mean"]
    assert group["population"]["parameter"] == "young_modulus_factor"
    assert abs(mean["mean"] - TRUE_MODULUS[name]) < 4.0 * mean["standard_deviation"] < 0.02
    assert group["noise_factor"]["mean"] == pytest.approx(150.0 / 125.0, rel=0.03)


def test_groups_share_their_rates(learnt_by_two_groups):
    """Alone, of few steps, the rates of 2g would be 0.19 and 0.45."""
    groups = learnt_by_two_groups["groups"].values()
    rates_of_3g = [group["probability"]["3g"]["mean"] for group in groups]
    rates_of_2g = [group["probability"]["2g"]["mean"] for group in groups]
    assert min(rates_of_3g) < learnt_by_two_groups["shared"]["3g"]["mean"] < max(rates_of_3g)
    assert max(rates_of_2g) < 0.1


def test_the_store_of_a_fleet_has_the_evidence_that_its_twins_had(tmp_path):
    """Readings of inspections, too: without them damage that is found and repaired would not have been."""
    text = text_of("inspected_wing", ("steps = 120", "steps = 5"), ('policy = "belief"', 'policy = "qmdp"'))
    path = written(tmp_path, text, ('first_control = "3g"', 'first_control = "inspect"'))
    fleet = ensemble(str(path), range(3))
    folder = fly_fleet(fleet, tmp_path / "fleet").folder
    (stored,) = open_fleet(folder).values()
    (group,) = fleet.groups
    known = load_knowledge(knowledge_folder(folder, group.name, 0), group.scenarios[0])
    rows = observation_rows(stored, known.scenario)
    control = stored["observed/control_index"].values.astype(int)
    assert np.isfinite(rows[:, 0, 24:]).all()
    family = TransitionFamily.learnable(known.scenario)
    model = with_noise_factor(known.sensor_model, 1.0)  # as the lessons are learnt with
    log_likelihood = model.log_likelihood_sequence(rows.reshape(15, -1), control.ravel()).reshape(3, 5, -1)
    found = transition_evidence(family, family.assumed[None], log_likelihood, control)[:, 0]
    np.testing.assert_allclose(found, stored["filtered/log_evidence"].values.sum(axis=1), rtol=1e-5)


def test_what_was_learnt_must_fit(tmp_path):
    file = tmp_path / "learnt.toml"
    file.write_text('format = 1\n[transition]\nprobability = { "4g" = 0.1 }\n')
    with pytest.raises(MissionInputError, match="probabilities for 4g"):
        resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=file))
    file.write_text('format = 1\n[calibration]\nparameter = "colour"\nmean = 1.0\nstandard_deviation = 0.1\n')
    with pytest.raises(MissionInputError, match="has learnt colour"):
        resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=file))
    file.write_text(file.read_text().replace("colour", "young_modulus_factor"))
    found = resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=file)).calibration
    assert (found.source, found.mean, found.standard_deviation, found.draws) == ("normal", 1.0, 0.1, 100)


def as_tables(scenario: Scenario) -> Scenario:
    """Return a scenario whose probabilities to worsen are written as tables."""
    table = scenario.to_dict()
    size = len(table["state"][0]["levels"])
    tables = {}
    for control, worsens in table["transition"]["probability"].items():
        rows = np.diag([1.0 - worsens] * (size - 1) + [1.0]) + np.diag([worsens] * (size - 1), 1)
        tables[control] = {state["name"]: rows.tolist() for state in table["state"]}
    table["transition"] = {"kind": "independent_tables", "tables": tables}
    return parse_scenario(table, "tables")


def test_the_evidence_of_table_transitions_is_that_of_the_tables():
    assumed = tiny(EACH)
    generator = np.random.default_rng(4)
    likelihood = generator.random((2, 4, 9))
    control = generator.integers(0, 2, (2, 4))
    tables = as_tables(assumed)
    free, fixed = (
        TransitionFamily.learnable(assumed),
        TransitionFamily.fixed(tables, reason_transitions_are_fixed(tables)),
    )
    assert (fixed.names, fixed.reason_fixed) == (
        (),
        "transitions of the kind `independent_tables` have no probability to worsen",
    )
    expected = transition_evidence(free, free.assumed[None], np.log(likelihood), control)
    found = transition_evidence(fixed, fixed.assumed[None], np.log(likelihood), control)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_five_probabilities_are_too_many_to_be_learnt_and_stay_as_assumed():
    table = tiny({"2g": 0.1, "3g": 0.1}).to_dict()
    names = [f"c{number}" for number in range(5)]
    table["control"] = [table["control"][0] | {"name": name} for name in names]
    table["transition"]["probability"] = dict.fromkeys(names, 0.1)
    table["rewards"]["control"] = dict.fromkeys(names, 0.0)
    table["mission"]["first_control"] = names[0]
    table["planner"]["safest"] = None
    found = reason_transitions_are_fixed(parse_scenario(table, "five"))
    assert "they have 5 probabilities to worsen, and 4 are learnt together" in found


class Notes(Progress):
    """Keeps what a user is told."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)


class TableFleet:
    """The fleet with transitions of tables, which no fleet learns; its notes, and what it teaches."""

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        (group,) = fleet.groups
        tables = replace(group, scenarios=tuple(map(as_tables, group.scenarios)))
        progress = Notes()
        fly_fleet(replace(fleet, groups=(tables,)), folder / "fleet", progress=progress)
        self.notes = progress.notes
        self.file = folder / "learnt.toml"
        self.record = learn_from_fleet(folder / "fleet", self.file)["groups"][group.name]


@pytest.fixture(scope="module")
def table_fleet(grown: tuple[Fleet, Path], tmp_path_factory: pytest.TempPathFactory) -> TableFleet:
    return TableFleet(grown[0], tmp_path_factory.mktemp("tables"))


def test_a_fleet_of_table_transitions_says_before_it_flies_that_it_teaches_none(table_fleet):
    sentence = "`fleet learn` leaves the transitions as assumed"
    assert any(sentence in note for note in table_fleet.notes)


def test_a_fleet_of_table_transitions_teaches_its_noise(table_fleet, learnt_by_fleet):
    record, _ = learnt_by_fleet
    noise_factor = record["noise_factor"]["mean"]
    assert table_fleet.record["probability"] == {}
    assert table_fleet.record["noise_factor"]["mean"] == pytest.approx(noise_factor, rel=1e-6)


def test_what_table_transitions_teach_leaves_the_transitions_as_assumed(table_fleet):
    scenario = resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=table_fleet.file))
    assert scenario.transition.probability == {"2g": 0.05, "3g": 0.1}


def test_assets_with_files_of_their_own_leave_a_control_by_plans_of_their_own(grown, tmp_path):
    fleet, folder = grown
    (group,), (name,) = open_fleet(folder).values(), open_fleet(folder)
    scenario, home = fleet.groups[0].scenarios[0], tmp_path / "groups" / name
    knowledge = load_knowledge(knowledge_folder(folder, fleet.groups[0].name, 0), scenario)
    for place, control in enumerate((1, 0)):
        (home / str(place)).mkdir(parents=True)
        always = BeliefPolicy(np.ones((1, 25)), np.array([control]))
        save_knowledge(home / str(place), replace(knowledge, policy=always))
    table = scenario.portable().to_dict()
    record = {"name": name, "members": [["a", 3, 0], ["b", 4, 1]], "scenarios": [table, table]}
    two = group.isel(twin=slice(2))
    control = two["observed/control_index"].values[:, -1]
    np.testing.assert_array_equal(
        ControlForecast(tmp_path, record).probabilities(two, ALL_ROWS), [control[0] != 1, control[1] != 0]
    )


def test_states_of_other_units_count_alike_for_who_is_badly_off():
    table = tiny(EACH).to_dict()
    table["state"][1]["levels"] = [1.0, 1.5, 4.0]
    found = severity(parse_scenario(table, "units"), np.array([[0.4, 1.0], [0.1, 4.0]]))
    np.testing.assert_allclose(found, [1.0, 1.25])


class DrawnOutcomes:
    """Outcomes of 50 drawn assets, one that ended behind its first step, and one that failed."""

    def __init__(self) -> None:
        self.random = np.random.default_rng(1)
        self.error = self.random.standard_normal((52, 3, 2))
        self.error[50, 1:] = np.nan
        self.credible = np.r_[np.zeros(25), np.ones(25), 0.5, 1.0]
        self.outcomes = Outcomes.from_store(
            {
                "status": np.r_[np.ones(50), 3.0, 2.0],
                "delay": np.r_[np.ones(40), np.full(5, np.inf), np.full(6, np.nan), 1.0],
                "early": np.r_[np.ones(10), np.zeros(40), -1.0, 1.0],  # the last but one cannot be
                "filtered/mean": self.error + 1.0,
                "truth/state": np.ones((52, 3, 2)),
                "filtered/log_evidence": self.error[..., 0],
                "credible": self.credible,
            }
        )
        self.mean_errors = np.nanmean(self.error[:51], axis=1)
        self.mean_squares = np.nanmean(self.error[:51] ** 2, axis=1)


@pytest.fixture
def drawn_outcomes() -> DrawnOutcomes:
    return DrawnOutcomes()


def mean_of_assets(values: np.ndarray) -> Estimated:
    """Return the mean of the 51 assets that did not fail, with its standard error."""
    error = values.std(ddof=1) / np.sqrt(51)
    return Estimated(pytest.approx(values.mean()), pytest.approx(error))


def test_means_over_a_fleet_have_standard_errors(drawn_outcomes):
    drawn = drawn_outcomes
    assert drawn.outcomes.bias[1] == mean_of_assets(drawn.mean_errors[:, 1])
    assert drawn.outcomes.log_evidence == mean_of_assets(drawn.mean_errors[:, 0])
    assert drawn.outcomes.credible_coverage == mean_of_assets(drawn.credible[:51])


def test_fractions_of_a_fleet_have_standard_errors_of_a_beta_distribution(drawn_outcomes):
    outcomes = drawn_outcomes.outcomes
    error_of_prompt = pytest.approx(beta(41, 6).std())
    error_of_early = pytest.approx(beta(11, 41).std())
    assert outcomes.prompt_fallbacks == Estimated(pytest.approx(40 / 45), error_of_prompt)
    assert outcomes.early_fallbacks == Estimated(0.2, error_of_early)


def test_an_rms_error_of_a_fleet_has_the_standard_error_of_a_bootstrap(drawn_outcomes):
    squares = drawn_outcomes.mean_squares[:, 0]
    random = drawn_outcomes.random
    resampled = [np.sqrt(np.mean(random.choice(squares, 51))) for _ in range(4000)]
    assert drawn_outcomes.outcomes.rms[0].value == pytest.approx(np.sqrt(squares.mean()))
    assert drawn_outcomes.outcomes.rms[0].error == pytest.approx(np.std(resampled), rel=0.1)


class GrownGroup:
    """The group of the grown fleet: its last controls and means, and what its twins know."""

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        self.folder = folder
        self.plan = fleet.groups[0]
        self.scenario = self.plan.scenarios[0]
        self.knowledge = load_knowledge(knowledge_folder(folder, self.plan.name, 0), self.scenario)
        (self.store,) = open_fleet(folder).values()
        self.control = self.store["observed/control_index"].values[:, -1]
        self.loss = self.store["filtered/mean"].values[:, -1].astype(float).sum(axis=1)

    @property
    def certain(self) -> np.ndarray:
        """Return a belief for each state in which the state is certain."""
        return np.eye(self.knowledge.model.states.size)


@pytest.fixture(scope="module")
def grown_group(grown: tuple[Fleet, Path]) -> GrownGroup:
    return GrownGroup(*grown)


def test_the_report_begins_with_fallbacks_and_the_worst_off(grown_group):
    text = write_fleet_report(grown_group.folder).read_text()
    delays = grown_group.store["delay"].values
    delays = delays[~np.isnan(delays)]
    worst_off = grown_group.plan.members[int(np.argmax(grown_group.loss))].name
    opening = (
        f"60 of 60 assets have flown. In {len(delays)} assets the damage called for another control; the "
        f"fallback came within 2 steps of it in {100 * np.mean(delays <= 2):.0f}\u00a0%.</div>"
    )
    worst = f"<p>The asset with the most damage is {worst_off} of growing_damage: "
    map_title = "The assets of group growing_damage by health"
    for words in (opening, worst, "60 assets in 1 group", map_title, "Assets that need attention next"):
        assert words in text


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let fleets be read by blocks of seven twins."""
    monkeypatch.setattr("twin_master.fleet.storage.store_layout.BLOCK_TWINS", 7)
    monkeypatch.setattr("twin_master.fleet.storage.store_layout._VALUES_TOGETHER", 1)


def test_figures_of_a_fleet_that_is_read_by_blocks_are_those_of_the_whole(grown_group, small_blocks):
    whole = Outcomes.from_store(grown_group.store)
    assert len(list(row_blocks(grown_group.store))) == 9
    parts = outcomes_of_group(grown_group.store)
    np.testing.assert_allclose(flat(parts), flat(whole), rtol=1e-12)


def flat(outcomes: Outcomes) -> list[float]:
    """Return values and errors of all outcomes."""
    single = [outcomes.prompt_fallbacks, outcomes.early_fallbacks, outcomes.log_evidence]
    estimates = [*single, outcomes.credible_coverage, *outcomes.rms, *outcomes.bias]
    return [number for estimate in estimates for number in (estimate.value, estimate.error)]


def test_the_page_of_a_fleet_that_is_read_by_blocks_is_that_of_the_whole(grown_group, monkeypatch):
    whole = fleet_page(grown_group.folder, ATTENTION_ROWS)
    monkeypatch.setattr("twin_master.fleet.storage.store_layout.BLOCK_TWINS", 7)
    monkeypatch.setattr("twin_master.fleet.storage.store_layout._VALUES_TOGETHER", 1)
    assert fleet_page(grown_group.folder, ATTENTION_ROWS) == whole


def test_the_figures_of_a_large_fleet_show_some_of_its_assets_and_say_so(grown_group, monkeypatch):
    monkeypatch.setattr("twin_master.fleet.page.overview.DRAWN_ASSETS", 25)
    record = fleet_config(grown_group.folder)["fleet"]["groups"][0]
    overview = overview_of_group(grown_group.folder, record, grown_group.store, 5)
    expected = grown_group.store["filtered/mean"].values[::3]
    np.testing.assert_array_equal(np.concatenate(overview.drawn.mean), expected)
    assert "Of 60 assets, one in 3 is drawn." in render_page(fleet_page(grown_group.folder, 5))


def test_a_policy_of_one_control_is_never_left_or_at_once(grown_group):
    certain = grown_group.certain
    always = BeliefPolicy(np.ones((1, len(certain))), np.array([1]))
    knowledge = replace(grown_group.knowledge, policy=always)
    assert probability_of_leaving(knowledge, certain, 1).tolist() == [0.0] * 25
    assert probability_of_leaving(knowledge, certain, 0).tolist() == [1.0] * 25


def test_the_probability_of_leaving_a_control_is_that_of_the_states_without_it(grown_group):
    """The damage moves under the control in force as long as it is kept."""
    knowledge, scenario = grown_group.knowledge, grown_group.scenario
    leaving = probability_of_leaving(knowledge, grown_group.certain, 1)
    is_kept = knowledge.plan.control_index == 1
    staying = knowledge.model.transition.matrix[1][np.ix_(is_kept, is_kept)]
    later_steps = scenario.mission.prediction_steps - 1
    expected = 1.0 - np.linalg.matrix_power(staying, later_steps).sum(axis=1)
    assert (leaving[~is_kept] == 1.0).all()
    np.testing.assert_allclose(leaving[is_kept], expected, atol=1e-12)
    assert np.ptp(expected) > 0.1


def test_a_twin_that_decides_on_predictions_leaves_a_control_a_step_earlier(grown_group):
    knowledge, certain = grown_group.knowledge, grown_group.certain
    planner = grown_group.scenario.planner.model_copy(update={"decide_on": "predicted"})
    predicting = replace(knowledge, scenario=grown_group.scenario.model_copy(update={"planner": planner}))
    expected = knowledge.model.transition.matrix[1] @ probability_of_leaving(knowledge, certain, 1)
    np.testing.assert_allclose(probability_of_leaving(predicting, certain, 1), expected, atol=1e-12)


def test_the_report_names_who_needs_attention(grown_group):
    """First who gave an alarm, then who leaves soon; among equal percentages the worst state."""
    beliefs = grown_group.store["filtered/last_probability"].values.astype(float)
    alarms = grown_group.store["notice/count"].values[:, 0]
    leaving = [
        probability_of_leaving(grown_group.knowledge, belief[None], int(control))[0]
        for belief, control in zip(beliefs, grown_group.control, strict=True)
    ]
    percentage = np.rint(100.0 * np.maximum(leaving, 0.0))
    order = np.lexsort((-grown_group.loss, -percentage, -alarms))
    page = render_page(fleet_page(grown_group.folder, ATTENTION_ROWS))
    table = page.partition("Assets that need attention next")[2]
    assert max(leaving) > min(leaving) + 0.1
    assert len(set(percentage)) < len(set(leaving))
    listed = [row for row in order[:50] if percentage[row] > 0.0 or alarms[row] > 0]
    assert 0 < len(listed) < len(order)
    assert re.findall(r"seed-\d+", table) == [f"seed-{row}" for row in listed]
