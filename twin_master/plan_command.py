"""`uav-twin plan`: what a scenario decides by its belief, and what that and knowing more are worth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from twin_master.command import Calibration, Seed
from twin_master.errors import MissionInputError

if TYPE_CHECKING:
    from twin_master.mission.planning import ComparedPolicy
    from twin_master.mission.preparation import Knowledge
    from twin_master.network.belief_planning import BeliefPlan, DecisionProblem

ValueOf = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", help="Say what an action that inspects is worth, or a gauge by its number or title."
    ),
]


@dataclass(frozen=True)
class _Planned:
    """A plan, what it was made for, and what it brings."""

    problem: "DecisionProblem"
    plan: "BeliefPlan"
    promised: "ComparedPolicy"


def plan(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A shipped scenario, or a TOML file.")],
    out: Annotated[
        Path | None, typer.Option(help="Write the policy to this file, for `uav-twin run --policy`.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw what is done at which belief, as SVG or PNG.")
    ] = None,
    value_of: ValueOf = None,
    seed: Seed = None,
    calibration: Calibration = None,
    json: terminal.Json = False,
) -> None:
    """Plan on the belief: expected return with its bounds, beside simpler rules."""
    from twin_master.mission.planning import compared, risk_of, write_policy

    knowledge = _knowledge(scenario, seed, calibration)
    found = _planned(knowledge)
    plan, promised = found.plan, found.promised
    if out is not None:
        write_policy(out, plan.policy, knowledge.model)
    if picture is not None:
        _draw(picture, plan, knowledge)
    record: dict[str, Any] = {
        "lower": plan.lower,
        "upper": plan.upper,
        "simulated": promised.mean,
        "half_width": promised.half_width,
        "beyond_limit": risk_of(knowledge.scenario, found.problem, knowledge.rewards, plan.policy),
    }
    rows = [promised, *([] if value_of else compared(knowledge.scenario, found.problem))]
    if value_of is not None:
        without = _planned(_without(knowledge, value_of)).promised
        half = float((promised.half_width**2 + without.half_width**2) ** 0.5)
        rows.append(replace(without, name=f"planned without {value_of}"))
        record["value"] = {"of": value_of, "mean": promised.mean - without.mean, "half_width": half}
    record["rules"] = {row.name: [row.mean, row.half_width] for row in rows}
    if json:
        terminal.print_json(record)
        return
    _show(record, rows)


def _knowledge(scenario: str, seed: int | None, calibration: Path | None) -> "Knowledge":
    """Return what the twin knows before any plan on the belief."""
    from twin_master.assets.resolution import Overrides
    from twin_master.mission.preparation import prepare_twin
    from twin_master.scenario.reading import load_scenario

    loaded = load_scenario(scenario)
    planner = loaded.scenario.planner
    plain = planner.model_copy(update={"policy": "mode", "limit_probability": None})
    unplanned = replace(loaded, scenario=loaded.scenario.model_copy(update={"planner": plain}))
    found = prepare_twin(
        unplanned, Overrides(seed=seed, calibration=calibration), progress=terminal.progress()
    )
    return replace(found, scenario=found.scenario.model_copy(update={"planner": planner}))


def _planned(knowledge: "Knowledge") -> _Planned:
    from twin_master.mission.planning import decision_problem, expected_plan, promised

    scenario, rewards = knowledge.scenario, knowledge.rewards
    problem = decision_problem(scenario, knowledge.model, knowledge.sensor_model, rewards)
    plan = expected_plan(scenario, problem, rewards)[0]
    return _Planned(problem, plan, promised(scenario, problem, plan.policy))


def _without(knowledge: "Knowledge", name: str) -> "Knowledge":
    """Return what is known where an action that inspects shows nothing, or a gauge is not there."""
    from twin_master.mission.preparation import knowledge_of

    scenario = knowledge.scenario
    observation = scenario.observation
    changed: Mapping[str, Any]
    inspecting = [action.name for action in scenario.action if action.inspects]
    titles = observation.titles or tuple(str(number + 1) for number in range(observation.count))
    if name in inspecting:
        blind = [
            action.model_copy(update={"standard_deviation": _BLIND}) if action.name == name else action
            for action in scenario.action
        ]
        changed = {"action": tuple(blind)}
    elif name in titles:
        given = observation.standard_deviation
        each = list(given) if isinstance(given, tuple) else [given] * observation.count
        each[titles.index(name)] = _BLIND
        changed = {"observation": observation.model_copy(update={"standard_deviation": tuple(each)})}
    else:
        raise MissionInputError(
            f"--value-of names an action that inspects ({', '.join(inspecting) or 'there is none'}) or a "
            f"gauge ({titles[0]} to {titles[-1]}), and `{name}` came."
        )
    settings = scenario.planner.model_copy(update={"policy": "mode", "limit_probability": None})
    bare = scenario.model_copy(update={**changed, "planner": settings})
    found = knowledge_of(
        bare, knowledge.model, knowledge.draws, knowledge.sensor_model.value_per_draw,
        true=knowledge.rewards.true_per_draw,
    )  # fmt: skip
    return replace(found, scenario=bare.model_copy(update={"planner": scenario.planner}))


_BLIND = 1e6
"""Standard deviation of a sensor that shows nothing, SI."""


def _draw(path: Path, plan: "BeliefPlan", knowledge: "Knowledge") -> None:
    from reporting.figures import to_png, to_svg
    from reporting.files import atomic_write_bytes
    from twin_master.report.plan import plan_figure

    figure = plan_figure(plan.policy, knowledge.model)
    atomic_write_bytes(path, to_png(figure) if path.suffix.lower() == ".png" else to_svg(figure))


def _show(record: Mapping[str, Any], rows: "list[ComparedPolicy]") -> None:
    from rich import box
    from rich.table import Table

    table = Table("rule", "expected return", "± (95 %)", box=box.SIMPLE_HEAD)
    for row in rows:
        table.add_row(row.name, f"{row.mean:.4g}", f"{row.half_width:.2g}")
    terminal.console().print(table)
    lower, upper = record["lower"], record["upper"]
    terminal.say(f"Bounds of the return: {lower:.5g} to {upper:.5g}, a gap of {upper - lower:.2g}.")
    terminal.say(f"Beyond a health limit: {100.0 * record['beyond_limit']:.2g} % of the turns, discounted.")
    if "value" in record:
        value = record["value"]
        terminal.say(f"{value['of']} is worth {value['mean']:.3g} ± {value['half_width']:.2g} (95 %).")
