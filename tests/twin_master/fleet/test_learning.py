"""What a fleet teaches, against enumeration, closed forms and the truth."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit, logit
from scipy.stats import beta, betabinom, norm, t

from reporting.progress import Progress
from tests.twin_master.network.decision_oracles import precise_forward_backward
from tests.twin_master.runs import text_of, written
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.fleet.configuration import group_folder
from twin_master.fleet.evidence import (
    TransitionFamily,
    parameter_evidence,
    reason_transitions_are_fixed,
    scaled_likelihood,
    transition_evidence,
)
from twin_master.fleet.learn import with_noise_factor
from twin_master.fleet.plan import Fleet, ensemble, load_fleet
from twin_master.fleet.posterior import (
    HIGHEST,
    LOWEST,
    LikelihoodGrid,
    likelihood_grid,
    population_posterior,
    shared_posterior,
)
from twin_master.fleet.reading import (
    Estimated,
    Outcomes,
    leaving_probabilities,
    probability_of_leaving,
    severity,
)
from twin_master.fleet.report import fleet_page, write_fleet_report
from twin_master.fleet.store_layout import observation_rows
from twin_master.fleet.view import ATTENTION_ROWS
from twin_master.mission.preparation import load_knowledge, save_knowledge
from twin_master.network.planner import BeliefPolicy
from twin_master.network.twin import build_graphical_model
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
    found = transition_evidence(family, points, likelihood, control)
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


def grid_of(*counts: tuple[int, int]) -> LikelihoodGrid:
    """Return the likelihood of probabilities of which so many were hits, and so many not."""
    hits, misses = np.array(counts, dtype=float).T
    return likelihood_grid(lambda points: np.log(points) @ hits + np.log1p(-points) @ misses, len(counts))


SIMILAR, MANY = ((3, 47), (6, 44), (2, 48), (9, 41), (4, 46)), (22_500, 427_500)


@pytest.mark.parametrize(
    ("counts", "beside", "close"),
    [
        (SIMILAR, (), 1e-3),
        (SIMILAR, ((5, 95),), 1e-3),
        ((MANY, (1, 249)), (), 1e-2),
        ((MANY, (13, 237)), (), 1e-3),
    ],
)
def test_groups_share_what_a_dense_sum_says(counts, beside, close):
    """Also beside another probability, which says nothing of it, and one of few twins beside one of many."""
    posterior = shared_posterior([grid_of(own, *beside) for own in counts])
    found, groups = posterior.hyperparameters[0], posterior.groups
    low, high = logit(np.array([LOWEST, HIGHEST]))
    m, kappa = np.meshgrid(
        expit(np.linspace(low, high, 402)[:-1] + 0.5 * (high - low) / 401),
        10.0 ** (np.log10(3.0) + (np.arange(120) + 0.5) / 40.0),
        indexing="ij",
    )
    a, b = m * kappa, (1.0 - m) * kappa
    weight = np.prod([betabinom.pmf(n, n + k, a, b) for n, k in counts], axis=0)
    weight /= weight.sum()
    assert found["mean"] == pytest.approx(float((weight * m).sum()), rel=close)
    assert found["log10_concentration"] == pytest.approx(float((weight * np.log10(kappa)).sum()), rel=close)
    for (n, k), (marginal, *_) in zip(counts, groups, strict=True):
        exact = float((weight * (a + n) / (kappa + n + k)).sum())
        assert marginal.mean == pytest.approx(exact, rel=max(close, 2e-3))
        for bound, reached in zip(marginal.interval(), (0.025, 0.975), strict=True):
            below = float((weight * beta.cdf(bound, a + n, b + k)).sum())
            assert below == pytest.approx(reached, abs=4e-3)


@pytest.mark.parametrize("members", [2, 5, 60])
def test_a_population_is_what_a_dense_sum_says(members):
    """Of normal members, under a Student's prior of the spread."""
    nodes, blur, scale = np.linspace(0.94, 1.06, 61), 0.004, 0.01
    seen = 1.01 + np.hypot(0.01, blur) * np.random.default_rng(members).standard_normal(members)
    found = population_posterior(nodes, -0.5 * ((nodes - seen[:, None]) / blur) ** 2, scale)
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


def test_groups_share_their_rates_and_each_has_a_population_of_the_parameter(tmp_path):
    """Of wings whose model tells the strains at any value of it."""
    means, text = {"soft": 0.99, "stiff": 1.02}, 'format = 1\nfleet = { name = "two", seed = 5 }\n'
    for name, mean in means.items():
        text += f'[[group]]\nname = "{name}"\nscenario = "growing_damage"\ncount = 8\nsteps = 12\n'
        text += f"parameters = {{ young_modulus_factor = {{ mean = {mean}, standard_deviation = 0.002 }} }}\n"
    folder = fly_fleet(load_fleet(written(tmp_path, text)), tmp_path / "fleet").folder
    record = learn_from_fleet(folder, tmp_path / "learnt.toml")
    for name, mean in means.items():
        group = record["groups"][name]
        found = group["population"]["mean"]
        assert group["population"]["parameter"] == "young_modulus_factor"
        assert abs(found["mean"] - mean) < 4.0 * found["standard_deviation"] < 0.02
        assert group["noise_factor"]["mean"] == pytest.approx(150.0 / 125.0, rel=0.03)
    rates = [record["groups"][name]["probability"]["3g"]["mean"] for name in means]
    assert min(rates) < record["shared"]["3g"]["mean"] < max(rates)
    few = [record["groups"][name]["probability"]["2g"]["mean"] for name in means]
    assert max(few) < 0.1  # alone, of few steps, they would be 0.19 and 0.45


def test_the_store_of_a_fleet_has_the_evidence_that_its_twins_had(tmp_path):
    """Readings of inspections, too: without them damage that is found and repaired would not have been."""
    text = text_of("inspected_wing", ("steps = 120", "steps = 5"), ('policy = "belief"', 'policy = "qmdp"'))
    path = written(tmp_path, text, ('first_control = "3g"', 'first_control = "inspect"'))
    fleet = ensemble(str(path), range(3))
    folder = fly_fleet(fleet, tmp_path / "fleet").folder
    (stored,) = open_fleet(folder).values()
    (group,) = fleet.groups
    known = load_knowledge(group_folder(folder, group, 0), group.scenarios[0])
    rows = observation_rows(stored, known.scenario)
    control = stored["observed/control_index"].values.astype(int)
    assert np.isfinite(rows[:, 0, 24:]).all()
    family = TransitionFamily.learnable(known.scenario)
    model = with_noise_factor(known.sensor_model, 1.0)  # as the lessons are learnt with
    scaled, common = scaled_likelihood(model, rows, control)
    found = transition_evidence(family, family.assumed[None], scaled, control)[:, 0] + common
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
    expected = transition_evidence(free, free.assumed[None], likelihood, control)
    found = transition_evidence(fixed, fixed.assumed[None], likelihood, control)
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


def test_a_fleet_of_table_transitions_teaches_its_noise_and_says_so_before_it_flies(grown, tmp_path):
    fleet, folder = grown
    (group,) = fleet.groups
    tables = replace(group, scenarios=tuple(map(as_tables, group.scenarios)))
    progress = Notes()
    fly_fleet(replace(fleet, groups=(tables,)), tmp_path / "fleet", progress=progress)
    assert any("`fleet learn` leaves the transitions as assumed" in note for note in progress.notes)
    learnt = learn_from_fleet(tmp_path / "fleet", tmp_path / "learnt.toml")["groups"][group.name]
    usual = learn_from_fleet(folder, tmp_path / "usual.toml")["groups"][group.name]
    assert learnt["probability"] == {}
    assert learnt["noise_factor"]["mean"] == pytest.approx(usual["noise_factor"]["mean"], rel=1e-6)
    resolved = resolve_scenario(load_scenario("growing_damage"), Overrides(learnt=tmp_path / "learnt.toml"))
    assert resolved.transition.probability == {"2g": 0.05, "3g": 0.1}


def test_assets_with_files_of_their_own_leave_a_control_by_plans_of_their_own(grown, tmp_path):
    fleet, folder = grown
    (group,), (name,) = open_fleet(folder).values(), open_fleet(folder)
    scenario, home = fleet.groups[0].scenarios[0], tmp_path / "groups" / name
    knowledge = load_knowledge(group_folder(folder, fleet.groups[0], 0), scenario)
    for place, control in enumerate((1, 0)):
        (home / str(place)).mkdir(parents=True)
        always = BeliefPolicy(np.ones((1, 25)), np.array([control]))
        save_knowledge(home / str(place), replace(knowledge, policy=always))
    table = scenario.portable().to_dict()
    record = {"name": name, "members": [["a", 3, 0], ["b", 4, 1]], "scenarios": [table, table]}
    two = group.isel(twin=slice(2))
    control = two["observed/control_index"].values[:, -1]
    np.testing.assert_array_equal(
        leaving_probabilities(tmp_path, record, two), [control[0] != 1, control[1] != 0]
    )


def test_states_of_other_units_count_alike_for_who_is_badly_off():
    table = tiny(EACH).to_dict()
    table["state"][1]["levels"] = [1.0, 1.5, 4.0]
    found = severity(parse_scenario(table, "units"), np.array([[0.4, 1.0], [0.1, 4.0]]))
    np.testing.assert_allclose(found, [1.0, 1.25])


def test_figures_of_a_fleet_have_standard_errors():
    """Also of an asset that ended behind its first step; one that failed takes no part."""
    random = np.random.default_rng(1)
    error = random.standard_normal((52, 3, 2))
    error[50, 1:] = np.nan
    credible = np.r_[np.zeros(25), np.ones(25), 0.5, 1.0]
    study = Outcomes.from_store(
        {
            "status": np.r_[np.ones(50), 3.0, 2.0],
            "delay": np.r_[np.ones(40), np.full(5, np.inf), np.full(6, np.nan), 1.0],
            "early": np.r_[np.ones(10), np.zeros(40), -1.0, 1.0],  # the last but one cannot be
            "filtered/mean": error + 1.0,
            "truth/state": np.ones((52, 3, 2)),
            "filtered/log_evidence": error[..., 0],
            "credible": credible,
        }
    )

    def of_missions(values: np.ndarray) -> Estimated:
        return Estimated(pytest.approx(values.mean()), pytest.approx(values.std(ddof=1) / np.sqrt(51)))

    bias, squared = (np.nanmean(error[:51] ** power, axis=1) for power in (1, 2))
    assert study.bias[1] == of_missions(bias[:, 1])
    assert study.log_evidence == of_missions(bias[:, 0])
    assert study.credible_coverage == of_missions(credible[:51])
    assert study.prompt_fallbacks == Estimated(pytest.approx(40 / 45), pytest.approx(beta(41, 6).std()))
    assert study.early_fallbacks == Estimated(0.2, pytest.approx(beta(11, 41).std()))
    again = [np.sqrt(np.mean(random.choice(squared[:, 0], 51))) for _ in range(4000)]  # the bootstrap
    assert study.rms[0].value == pytest.approx(np.sqrt(squared[:, 0].mean()))
    assert study.rms[0].error == pytest.approx(np.std(again), rel=0.1)


def test_the_report_names_who_needs_probability_of_leaving(grown):
    fleet, folder = grown
    text = write_fleet_report(folder).read_text()
    (group,) = open_fleet(folder).values()
    delay = group["delay"].values[~np.isnan(group["delay"].values)]
    control, mean = (
        group["observed/control_index"].values[:, -1],
        group["filtered/mean"].values[:, -1].astype(float),
    )
    opening = (
        f"60 of 60 assets have flown. In {len(delay)} assets the damage called for another control; the "
        f"fallback came within 2 steps of it in {100 * np.mean(delay <= 2):.0f}\u00a0%. The asset "
        "with the most damage is "
        f"{fleet.groups[0].members[int(np.argmax(mean.sum(axis=1)))].name} of growing_damage: "
    )
    for words in (opening, "60 assets in 1 group", "The assets by health", "Assets that need attention next"):
        assert words in text

    scenario = fleet.groups[0].scenarios[0]
    knowledge = load_knowledge(group_folder(folder, fleet.groups[0], 0), scenario)
    model, policy = knowledge.model, knowledge.plan.control_index
    belief = np.eye(model.states.size)
    always = replace(knowledge, policy=BeliefPolicy(np.ones((1, len(belief))), np.array([1])))
    assert [probability_of_leaving(always, belief, one).tolist() for one in (1, 0)] == [
        [0.0] * 25,
        [1.0] * 25,
    ]
    found = probability_of_leaving(knowledge, belief, 1)
    assert (found[policy != 1] == 1.0).all()
    kept = policy == 1  # the damage moves under the control in force as long as it is kept
    stays = model.transition.matrix[1][np.ix_(kept, kept)]
    chance = 1.0 - np.linalg.matrix_power(stays, scenario.mission.prediction_steps - 1).sum(axis=1)
    np.testing.assert_allclose(found[kept], chance, atol=1e-12)
    assert np.ptp(chance) > 0.1
    section = scenario.planner.model_copy(update={"decide_on": "predicted"})
    ahead = replace(knowledge, scenario=scenario.model_copy(update={"planner": section}))
    np.testing.assert_allclose(
        probability_of_leaving(ahead, belief, 1), model.transition.matrix[1] @ found, atol=1e-12
    )

    # Who gave an alarm comes first, then who leaves soon; with the same percentage by its state.
    beliefs, alarms = (
        group["filtered/last_probability"].values.astype(float),
        group["notice/count"].values[:, 0],
    )
    soon = [
        probability_of_leaving(knowledge, own[None], int(u))[0]
        for own, u in zip(beliefs, control, strict=True)
    ]
    printed = np.rint(100.0 * np.maximum(soon, 0.0))
    worst = np.lexsort((-mean.sum(axis=1), -printed, -alarms))
    assert max(soon) > min(soon) + 0.1
    assert len(set(printed)) < len(set(soon))
    table = fleet_page(folder, ATTENTION_ROWS).partition("Assets that need attention next")[2]
    assert re.findall(r"seed-\d+", table) == [f"seed-{row}" for row in worst[:50]]
