"""`uav-twin plan` and `uav-twin design`: what is decided by the belief, what it is worth, what tells most."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from reporting import terminal
from reporting.command_options import JsonOption
from reporting.files import atomic_write_bytes
from twin_master import parts
from twin_master.command_options import CalibrationOption, ScenarioArgument, SeedOption
from twin_master.errors import MissionInputError, said


def plan(
    scenario: ScenarioArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Write the policy to this file, for `uav-twin run --policy`.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="Draw what is done at which belief, as SVG or PNG.",
        ),
    ] = None,
    value_of: Annotated[
        str | None,
        typer.Option(
            "--value-of",
            metavar="NAME",
            help="Say what an action that inspects is worth, or a gauge by its number or title.",
        ),
    ] = None,
    seed: SeedOption = None,
    calibration: CalibrationOption = None,
    json: JsonOption = False,
) -> None:
    """Plan on the belief: expected return with its bounds, beside simpler rules.

    Example: `uav-twin plan inspected_wing --out policy.npz`
    """
    knowledge, _ = _knowledge(scenario, seed, calibration)
    blind = _without(knowledge, [value_of]) if value_of is not None else None
    problem, plan, promised = _planned(knowledge)
    if out is not None:
        atomic_write_bytes(out, parts.policy_file(plan.policy, knowledge.model))
    if picture is not None:
        _draw(picture, parts.plan_figure(plan.policy, knowledge.model))
    record: dict[str, Any] = {
        "lower": plan.lower,
        "upper": plan.upper,
        "simulated": promised.mean,
        "half_width": promised.half_width,
        "beyond_limit": parts.risk_of(knowledge.scenario, problem, knowledge.rewards, plan.policy),
    }
    rows = [promised, *([] if blind else parts.compared(knowledge.scenario, problem))]
    if blind is not None:
        without = _planned(blind)[2]
        worth = promised.beyond(without)
        rows.append(replace(without, name=f"planned without {value_of}"))
        record["value"] = {"of": value_of, "mean": worth.mean, "half_width": worth.half_width}
    record["rules"] = {row.name: [row.mean, row.half_width] for row in rows}
    terminal.answer("plan", "twin_master", record, json=json)


def _knowledge(
    scenario: str, seed: int | None, calibration: Path | None, candidates: str | None = None
) -> "tuple[parts.Knowledge, tuple[parts.Float | None, list[parts.Float]]]":
    """Return what the twin knows before any plan on the belief, and where its gauges are, see `_places`."""
    given = {"seed": seed, "calibration": calibration}
    resolved = parts.resolve_scenario(parts.load_scenario(scenario), given)
    parts.believed_source(resolved).check()
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        if candidates is not None:
            resolved = parts.with_candidates(resolved, candidates, Path(folder, "candidates"))
        found = parts.prepared_alone(resolved, parts.believed_source(resolved), terminal.progress())
        return found, _places(resolved)


def _planned(
    knowledge: "parts.Knowledge",
) -> "tuple[parts.DecisionProblem, parts.BeliefPlan, parts.ComparedPolicy]":
    """Return what is decided on, the plan, and what it promises."""
    scenario, problem = knowledge.scenario, knowledge.problem
    plan = parts.expected_plan(scenario, problem, knowledge.rewards)[0]
    return problem, plan, parts.promised(scenario, problem, plan.policy)


def _without(knowledge: "parts.Knowledge", names: Sequence[str]) -> "parts.Knowledge":
    """Return what is known where actions that inspect show nothing, or gauges are not there."""
    import numpy as np

    scenario = knowledge.scenario
    titles, inspecting = _titles(scenario), [action.name for action in scenario.action if action.inspects]
    for name in names:
        if name not in (*titles, *inspecting):
            known, gauges = inspecting or ["there is none"], f"{titles[0]} to {titles[-1]}"
            raise MissionInputError(said("plan_command.value_of", inspecting=known, gauges=gauges, name=name))
    shown = np.abs(knowledge.predicted).max(axis=(0, 1, 2))
    each = np.broadcast_to(scenario.observation.standard_deviation, len(titles))
    blind = np.where([title in names for title in titles], each + _BLIND * shown, each)
    levels = np.abs(knowledge.model.states.coordinates).max()
    unread = {"standard_deviation": _BLIND * (1.0 + levels)}
    actions = tuple(a.model_copy(update=unread if a.name in names else {}) for a in scenario.action)
    bare = scenario.with_changes("observation", standard_deviation=tuple(blind.tolist()))
    return replace(knowledge, scenario=bare.model_copy(update={"action": actions}))


def _titles(scenario: "parts.Scenario") -> tuple[str, ...]:
    """Return what the sensors are called: their titles, or numbers from 1."""
    section = scenario.observation
    return section.titles or tuple(str(number + 1) for number in range(section.count))


_BLIND = 1e6
"""Standard deviation of a sensor that shows nothing, over the largest that it could show."""


def _draw(path: Path, figure: "parts.Figure") -> None:

    atomic_write_bytes(path, parts.to_png(figure) if path.suffix.lower() == ".png" else parts.to_svg(figure))


def design(
    scenario: ScenarioArgument,
    *,
    sensors: Annotated[
        int,
        typer.Option(
            "--sensors",
            min=1,
            help="How many to choose.",
        ),
    ],
    among: Annotated[
        str | None,
        typer.Option(
            "--among",
            metavar="NAMES",
            help="Candidates, by numbers or titles with commas; all by default.",
        ),
    ] = None,
    candidates: Annotated[
        str | None,
        typer.Option(
            "--candidates",
            metavar="N|FILE",
            help="More candidates on a structure: N rosettes spread over its surface, or a file of gauges.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="Draw the choice, as SVG or PNG.",
        ),
    ] = None,
    vtu: Annotated[
        Path | None,
        typer.Option(
            "--vtu",
            help="Write the gauges as points with their ranks.",
        ),
    ] = None,
    worth: Annotated[
        bool,
        typer.Option(
            "--worth",
            help="Plan with the chosen and with all, and compare the returns.",
        ),
    ] = False,
    calibration: CalibrationOption = None,
    json: JsonOption = False,
) -> None:
    """Choose the sensors that tell most of the state, and name what none of them separates.

    Example: `uav-twin design level_turns --sensors 6 --picture gauges.svg`
    """
    knowledge, places = _knowledge(scenario, None, calibration, candidates)
    titles = _titles(knowledge.scenario)
    wanted = titles if among is None else tuple(among.split(","))
    if not {*wanted} <= {*titles} or len({*wanted}) < len(wanted):
        raise MissionInputError(said("plan_command.among", first=titles[0], last=titles[-1], among=among))
    pool, readings = [titles.index(name) for name in wanted], parts.drawn_readings(knowledge)
    found = parts.chosen_sensors(readings, pool, sensors)
    names = [titles[sensor] for sensor in found.sensors]
    apart = parts.separations(knowledge, readings, pool)
    record: dict[str, Any] = {
        "sensors": names,
        "information": list(found.information),
        "of_all": found.of_all,
        "not_separated": [_between(knowledge, *place) for place, far in apart.items() if far < 1.0],
    }
    if worth:
        others = [title for title in titles if title not in names]
        rest = [title for title in titles if title not in wanted]
        few, every = (_planned(_without(knowledge, some))[2] for some in (others, rest))
        compared = {"chosen": few, "all": every, "all beyond chosen": every.beyond(few)}
        record["worth"] = {what: [one.mean, one.half_width] for what, one in compared.items()}
    _draw_design(picture, vtu, places, record, found.sensors)
    terminal.answer("design", "twin_master", record, json=json, candidates=len(pool))


def _between(knowledge: "parts.Knowledge", name: str, level: int) -> str:
    """Return two neighbouring levels of a state in words."""
    place = knowledge.scenario.state_names.index(name)
    factor = knowledge.scenario.state[place]
    scale, unit = parts.printed_state(factor.unit)
    low, high = (scale * value for value in factor.levels[level : level + 2])
    return f"{name} of {low:g} {unit} from {high:g} {unit}"


def _draw_design(
    picture: Path | None, vtu: Path | None, where: "tuple[parts.Float | None, list[parts.Float]]",
    record: Mapping[str, Any], chosen: Sequence[int],
) -> None:  # fmt: skip
    import numpy as np

    places, outlines = where
    if vtu is not None:
        if places is None:
            raise MissionInputError("--vtu needs a wing or a structure whose file says where its gauges are.")
        rank = np.zeros(len(places))
        rank[list(chosen)] = np.arange(1, len(chosen) + 1)
        parts.write_vtu(vtu, places, ("vertex", np.arange(len(rank))[:, None]), {"rank": rank}, {})
    if picture is not None:
        if places is not None:  # the two axes along which they are spread most
            places = places[:, np.sort(np.argsort(-np.ptp(places, axis=0), kind="stable")[:2])]
        figure = parts.design_figure(
            record["information"], record["of_all"], record["sensors"], places, chosen, outlines
        )
        _draw(picture, figure)


def _places(scenario: "parts.Scenario") -> "tuple[parts.Float | None, list[parts.Float]]":
    """Return where the gauges are (G, 3) [m], None where no file says it, and outlines (N, 2) of a wing."""
    import numpy as np

    files = scenario.belief.all_files()
    places = parts.gauge_places(files.get(parts.MODEL_COPY))
    if places is not None and scenario.observation.role == "strain":
        return places, []
    file = files.get(parts.DESIGN_COPY)
    wing = parts.planform_of(None if file is None else parts.load_design(file), scenario)
    if wing is None:
        return None, []
    return np.insert(wing.gauges, 2, 0.0, axis=1), [wing.outline, *wing.regions]
