"""What a fleet teaches, against enumeration, closed forms and the truth."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.twin_master.network.decision_oracles import enumerate_trajectories
from tests.twin_master.runs import text_of, written
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import FleetError, MissionInputError
from twin_master.fleet.evidence import Worsening, node_evidence, scaled_likelihood, transition_evidence
from twin_master.fleet.flight import group_folder
from twin_master.fleet.learn import _noisier, learn_fleet
from twin_master.fleet.plan import Fleet, ensemble, load_fleet
from twin_master.fleet.posterior import HIGHEST, LOWEST, Grid, logistic, logit, population, refined, shared
from twin_master.fleet.reading import Outcomes, attention, leaving, severity
from twin_master.fleet.report import write_fleet_report
from twin_master.mission.preparation import keep_knowledge, kept_knowledge
from twin_master.network.planner import BeliefPolicy
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario
from uav_twin import (
    GaussianSensorModel,
    filter_sequence,
    fly_fleet,
    learn_from_fleet,
    load_scenario,
    open_fleet,
)

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
        (EACH, "inspected_wing", 1.0),
        (EACH, "inspected_wing", 0.7),
    ],
)
def test_evidence_of_a_twin_is_that_of_all_paths(probability, name, success):
    """Also of one that is repaired."""
    scenario = tiny(probability, name=name, success=success)
    worsening, controls = Worsening.of(scenario), len(scenario.control)
    assert len(worsening.names) == (controls if probability is EACH else 4)
    generator = np.random.default_rng(4)
    likelihood = generator.random((2, 4, 9))
    control = generator.permuted(np.tile(np.arange(4 + controls) % controls, (2, 1)), axis=1)[:, :4]
    points = np.array([worsening.assumed, 0.5 * worsening.assumed + 0.3])
    found = transition_evidence(worsening, points, likelihood, control)
    for row, point in enumerate(points):
        given: dict[str, object] = {}
        for place, value in zip(worsening.names, point.tolist(), strict=True):
            own, _, factor = place.partition(", ")
            if factor:
                given.setdefault(own, {})[factor] = value  # type: ignore[index]
            else:
                given[own] = value
        model = build_graphical_model(tiny(given, name=name, success=success))
        for twin in range(2):
            *_, expected = enumerate_trajectories(model, control[twin], np.log(likelihood[twin]))
            assert found[twin, row] == pytest.approx(expected.sum(), abs=1e-12)


def test_evidence_of_a_node_is_that_of_the_filter():
    scenario = tiny(EACH, levels=5)
    model, worsening = build_graphical_model(scenario), Worsening.of(scenario)
    generator = np.random.default_rng(5)
    values = 1e-3 * (1.0 + generator.random((3, 25, 2, 24)))
    interval = 1e-4 * generator.standard_normal((25, 2, 24, 2))
    observed = values[1, 3, 0] + 1e-4 * generator.standard_normal((2, 6, 24))
    observed[0, 2] = observed[1, :, 5] = np.nan
    control = generator.integers(0, 2, (2, 6))
    sensors = GaussianSensorModel(values, 1e-4, interval=interval)
    nodes = node_evidence(worsening, worsening.assumed, sensors, observed, control)
    for node, twin in product(range(3), range(2)):
        alone = GaussianSensorModel(values[node : node + 1], 1e-4, interval=interval)
        rows = alone.log_likelihood_sequence(observed[twin], control[twin])
        expected = filter_sequence(model, control[twin], rows).log_evidence.sum()
        assert nodes[twin, node] == pytest.approx(expected, rel=1e-12)


def grid_of(*counts: tuple[int, int]) -> Grid:
    """Return the likelihood of probabilities of which so many were hits, and so many not."""
    hits, misses = np.array(counts, dtype=float).T
    return refined(lambda points: np.log(points) @ hits + np.log1p(-points) @ misses, len(counts))


@pytest.mark.parametrize(
    "counts",
    [
        ((0, 50),),
        ((2, 0), (400, 3600)),
        ((0, 200), (7, 60), (90, 270)),
        ((3, 20), (7, 60), (30, 90), (9, 900)),
    ],
)
def test_a_grid_has_the_moments_of_a_beta(counts):
    """Between the bounds, which cut some off; of four probabilities with few points for each."""
    from scipy.stats import beta

    for (a, b), marginal in zip(counts, grid_of(*counts).marginals, strict=True):
        exact = beta(a + 1, b + 1)
        low, high = exact.cdf([LOWEST, HIGHEST])
        draws = exact.ppf(low + (high - low) * (np.arange(20_000) + 0.5) / 20_000)
        assert marginal.mean == pytest.approx(draws.mean(), abs=0.02 * draws.std())
        assert marginal.standard_deviation == pytest.approx(draws.std(), rel=2e-2)
        np.testing.assert_allclose(marginal.interval(), np.quantile(draws, [0.025, 0.975]), rtol=2e-2)


@pytest.mark.parametrize("beside", [(), ((5, 95),)])
def test_groups_share_what_a_dense_sum_says(beside):
    """Also beside another probability, which says nothing of it."""
    from scipy.stats import beta, betabinom

    counts = [(3, 47), (6, 44), (2, 48), (9, 41), (4, 46)]
    (found, *_), groups = shared([grid_of(own, *beside) for own in counts])
    low, high = logit(np.array([LOWEST, HIGHEST]))
    m, kappa = np.meshgrid(
        logistic(np.linspace(low, high, 402)[:-1] + 0.5 * (high - low) / 401),
        10.0 ** (np.log10(3.0) + (np.arange(120) + 0.5) / 40.0),
        indexing="ij",
    )
    a, b = m * kappa, (1.0 - m) * kappa
    weight = np.prod([betabinom.pmf(n, n + k, a, b) for n, k in counts], axis=0)
    weight /= weight.sum()
    assert found["mean"] == pytest.approx(float((weight * m).sum()), rel=1e-3)
    assert found["log10_concentration"] == pytest.approx(float((weight * np.log10(kappa)).sum()), rel=1e-3)
    for (n, k), (marginal, *_) in zip(counts, groups, strict=True):
        exact = float((weight * (a + n) / (kappa + n + k)).sum())
        assert marginal.mean == pytest.approx(exact, rel=2e-3)
        for bound, reached in zip(marginal.interval(), (0.025, 0.975), strict=True):
            below = float((weight * beta.cdf(bound, a + n, b + k)).sum())
            assert below == pytest.approx(reached, abs=4e-3)
    means = [marginal.mean for marginal, *_ in groups]
    assert np.std(means) < 0.8 * np.std([n / (n + k) for n, k in counts])


@pytest.mark.parametrize("few", [(1, 249), (13, 237)])
def test_a_group_that_is_known_well_stays_so_beside_one_of_few_twins(few):
    many = (22_500, 427_500)
    large, _ = shared([grid_of(many), grid_of(few)])[1]
    p, n = many[0] / sum(many), sum(many)
    deviation = np.sqrt(p * (1.0 - p) / n)
    assert large[0].mean == pytest.approx(p, abs=0.1 * deviation)
    low, high = large[0].interval()
    assert (low, high) == pytest.approx((p - 1.96 * deviation, p + 1.96 * deviation), abs=0.1 * deviation)


def test_a_population_is_that_of_normal_members():
    generator = np.random.default_rng(8)
    nodes = np.linspace(0.94, 1.06, 61)
    own, blur = 1.01 + 0.01 * generator.standard_normal(400), 0.004
    seen = own + blur * generator.standard_normal(400)
    mean, spread = population(nodes, -0.5 * ((nodes - seen[:, None]) / blur) ** 2, 0.01)
    assert mean.mean == pytest.approx(seen.mean(), abs=2e-5)
    assert mean.standard_deviation == pytest.approx(np.std(seen) / 20.0, rel=0.05)
    half = 1.96 * mean.standard_deviation
    assert mean.interval() == pytest.approx((mean.mean - half, mean.mean + half), abs=0.1 * half)
    assert 0.0 < spread.interval()[0] < spread.mean < spread.interval()[1]
    assert spread.mean == pytest.approx(np.sqrt(np.var(seen) - blur**2), rel=0.02)


@pytest.mark.parametrize("members", [2, 5])
def test_a_population_of_few_is_told_with_its_doubt(members):
    """95 % intervals hold the truth, for spreads from nothing to more than expected."""
    generator = np.random.default_rng(members)
    nodes, blur, scale, fleets = np.linspace(0.94, 1.06, 31), 0.004, 0.01, 80
    held = np.zeros(2)
    for _ in range(fleets):
        truth = 1.0 + 0.01 * generator.uniform(-1.0, 1.0), scale * abs(generator.standard_t(4))
        own = truth[0] + truth[1] * generator.standard_normal(members)
        seen = own + blur * generator.standard_normal(members)
        for which, line in enumerate(population(nodes, -0.5 * ((nodes - seen[:, None]) / blur) ** 2, scale)):
            low, high = line.interval()
            held[which] += low <= truth[which] <= high
    assert (held >= 71).all(), held  # 76 expected, with a deviation of 1.9


@pytest.fixture(scope="module")
def grown(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Fleet, Path]:
    folder = tmp_path_factory.mktemp("grown")
    fleet = ensemble("growing_damage", range(60), Overrides(strain_library=library_file))
    return fleet, fly_fleet(fleet, folder / "fleet").folder


def test_a_fleet_learns_and_flies_what_it_has_learnt(grown, tmp_path):
    fleet, folder = grown
    file = tmp_path / "learnt.toml"
    record = learn_from_fleet(folder, file)["groups"]["growing_damage"]
    for control, truth in (("2g", 0.05), ("3g", 0.1)):
        rate = record["probability"][control]
        assert abs(rate["mean"] - truth) < 4.0 * rate["standard_deviation"] < 0.1
        assert rate["lower_95"] < rate["mean"] < rate["upper_95"]
    scenario = resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=file))
    assert scenario.transition.probability["3g"] == record["probability"]["3g"]["mean"]
    assert scenario.truth.probability == {"2g": 0.05, "3g": 0.1}
    assumed = fleet.groups[0].scenarios[0].observation.standard_deviation
    found = scenario.observation.standard_deviation
    assert found == pytest.approx(np.multiply(assumed, record["noise_factor"]["mean"]))


def test_nothing_is_learnt_of_the_control_that_was_flown_last(library_file, tmp_path):
    """A turn of 3g, and one of 2g that nothing follows."""
    text = text_of("growing_damage", ("steps = 50", "steps = 2"), ('"2g" = -0.1, "3g"', '"2g" = 9.0, "3g"'))
    fleet = ensemble(str(written(tmp_path, text)), range(2), Overrides(strain_library=library_file))
    (record,) = learn_fleet(fly_fleet(fleet, tmp_path / "fleet").folder)["groups"].values()
    flown = {control: rate["flown"] for control, rate in record["probability"].items()}
    assert flown == {"2g": False, "3g": True}


def test_the_store_of_a_fleet_has_the_evidence_that_its_twins_had(tmp_path):
    """Readings of inspections, too: without them damage that is found and repaired would not have been."""
    text = text_of("inspected_wing", ("steps = 120", "steps = 5"), ('policy = "belief"', 'policy = "qmdp"'))
    path = written(tmp_path, text, ('first_control = "3g"', 'first_control = "inspect"'))
    fleet = ensemble(str(path), range(3))
    folder = fly_fleet(fleet, tmp_path / "fleet").folder
    (stored,) = open_fleet(folder).values()
    (group,) = fleet.groups
    known = kept_knowledge(group_folder(folder, group, 0), group.scenarios[0])
    rows, control = stored["observed"].values, stored["control_index"].values.astype(int)
    assert np.isfinite(rows[:, 0, 24:]).all()
    worsening = Worsening.of(known.scenario)
    model = _noisier(known.sensor_model, 1.0)  # as the lessons are learnt with
    scaled, common = scaled_likelihood(model, rows.astype(float), control)
    found = transition_evidence(worsening, worsening.assumed[None], scaled, control)[:, 0] + common
    np.testing.assert_allclose(found, stored["log_evidence"].values.sum(axis=1), rtol=1e-5)


def test_what_was_learnt_must_fit(grown, tmp_path):
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
    (tmp_path / "empty").mkdir()
    with pytest.raises(Exception, match="not the folder of a fleet"):
        learn_fleet(tmp_path / "empty")


def test_tables_are_not_learnt():
    table = tiny({"2g": 0.1, "3g": 0.1}).to_dict()
    rows = [[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 1.0]]
    tables = {control: {"z1": rows, "z2": rows} for control in ("2g", "3g")}
    table["transition"] = {"kind": "independent_tables", "tables": tables}
    with pytest.raises(FleetError, match="independent_worsening"):
        Worsening.of(parse_scenario(table, "tables"))


def test_true_rates_may_differ_from_those_believed(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text(
        'format = 1\n[fleet]\nname = "slow"\n[[group]]\nname = "slow"\n'
        'scenario = "growing_damage"\ncount = 1\n'
        'true_probability = { "2g" = 0.0, "3g" = 0.0 }\n'
    )
    scenario = load_fleet(path).groups[0].scenarios[0]
    assert scenario.truth.probability == {"2g": 0.0, "3g": 0.0}
    assert scenario.transition.probability == {"2g": 0.05, "3g": 0.1}
    assert load_scenario("growing_damage").scenario.to_dict()["truth"]["probability"] == {}
    path.write_text(path.read_text().replace("growing_damage", "level_turns"))
    with pytest.raises(FleetError, match=r"truth\.probability"):
        load_fleet(path)


def test_assets_with_files_of_their_own_leave_a_control_by_plans_of_their_own(grown, tmp_path):
    fleet, folder = grown
    (group,), (name,) = open_fleet(folder).values(), open_fleet(folder)
    scenario, home = fleet.groups[0].scenarios[0], tmp_path / "groups" / name
    knowledge = kept_knowledge(group_folder(folder, fleet.groups[0], 0), scenario)
    for place, control in enumerate((1, 0)):
        (home / str(place)).mkdir(parents=True)
        always = BeliefPolicy(np.ones((1, 25)), np.array([control]))
        keep_knowledge(home / str(place), replace(knowledge, policy=always))
    table = scenario.portable().to_dict()
    record = {"name": name, "members": [["a", 3, 0], ["b", 4, 1]], "scenarios": [table, table]}
    two = group.isel(twin=slice(2))
    control = two["control_index"].values[:, -1]
    np.testing.assert_array_equal(leaving(tmp_path, record, two), [control[0] != 1, control[1] != 0])


def test_states_of_other_units_count_alike_for_who_is_badly_off():
    table = tiny(EACH).to_dict()
    table["state"][1]["levels"] = [1.0, 1.5, 4.0]
    found = severity(parse_scenario(table, "units"), np.array([[0.4, 1.0], [0.1, 4.0]]))
    np.testing.assert_allclose(found, [1.0, 1.25])


def test_turns_that_were_not_flown_take_no_part_in_the_figures():
    """Of an asset that ended behind its first turn, and of one that failed."""
    nan, state = np.nan, np.zeros((3, 3, 1))
    mean = np.array([[3.0, 1.0, 2.0], [4.0, nan, nan], [9.0, 9.0, nan]])
    stored = {"status": [1, 3, 2], "early": [0, 1, 1], "delay": [nan, 2.0, nan], "credible": [0.5, 1.0, nan]}
    found = Outcomes.of(stored | {"mean": mean[..., None], "state": state, "log_evidence": -mean})
    assert (found.bias[0].value, found.evidence.value, found.credible.value) == (3.0, -3.0, 0.75)
    assert found.rms[0].value == pytest.approx(np.sqrt((14.0 / 3.0 + 16.0) / 2.0))
    assert (found.early.value, found.within.value) == (0.5, 1.0)


def test_the_report_names_who_needs_attention(grown):
    fleet, folder = grown
    text = write_fleet_report(folder).read_text()
    (group,) = open_fleet(folder).values()
    delay = group["delay"].values[~np.isnan(group["delay"].values)]
    control = group["control_index"].values
    last = [mean[flown >= 0][-1].sum() for mean, flown in zip(group["mean"].values, control, strict=True)]
    opening = (
        f"60 of 60 assets have flown. In {len(delay)} assets the damage called for another control; the "
        f"fallback came within 2 turns of it in {100 * np.mean(delay <= 2):.0f}\u00a0%. The worst off is "
        f"{fleet.groups[0].members[int(np.argmax(last))].name} of growing_damage: "
    )
    for words in (
        opening,
        "60 assets in 1 group",
        "The assets by health",
        "Who needs attention next",
        "seed-",
    ):
        assert words in text
    scenario = fleet.groups[0].scenarios[0]
    knowledge = kept_knowledge(group_folder(folder, fleet.groups[0], 0), scenario)
    model, policy = knowledge.model, knowledge.plan.control_index
    belief = np.eye(model.states.size)
    always = replace(knowledge, policy=BeliefPolicy(np.ones((1, len(belief))), np.array([1])))
    assert [attention(always, belief, control).tolist() for control in (1, 0)] == [[0.0] * 25, [1.0] * 25]
    found = attention(knowledge, belief, 1)
    assert (found[policy != 1] == 1.0).all()
    kept = policy == 1  # the damage moves under the control in force as long as it is kept
    stays = model.transition.matrix[1][np.ix_(kept, kept)]
    chance = 1.0 - np.linalg.matrix_power(stays, scenario.mission.prediction_steps - 1).sum(axis=1)
    np.testing.assert_allclose(found[kept], chance, atol=1e-12)
    assert np.ptp(chance) > 0.1
