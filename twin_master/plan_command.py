"""Commands `uav-twin plan` and `uav-twin design`: plans on the belief, choices of sensors."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from reporting import terminal
from reporting.files import atomic_write_bytes
from reporting.terminal import JsonOption
from reporting.words import comma_list
from twin_master.command_options import CalibrationOption, ScenarioArgument, SeedOption
from twin_master.errors import MissionInputError

if TYPE_CHECKING:
    from reporting.arrays import Float
    from reporting.json_file import JsonObject
    from twin_master.mission.planning import ComparedPolicy
    from twin_master.mission.preparation import Knowledge
    from twin_master.mission.sensor_design import SensorDesign
    from twin_master.network.belief_planning import BeliefPlan
    from twin_master.scenario.schema import Scenario


Record: TypeAlias = "JsonObject"
"""The result of a command, as it is printed as JSON."""


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
            help="Draw the control that is chosen at each belief, as SVG or PNG.",
        ),
    ] = None,
    value_of: Annotated[
        str | None,
        typer.Option(
            "--value-of",
            metavar="NAME",
            help=(
                "Compute the value of an action that inspects, or of a gauge given by its number "
                "or title."
            ),
        ),
    ] = None,
    seed: SeedOption = None,
    calibration: CalibrationOption = None,
    json: JsonOption = False,
) -> None:
    """Plan on the belief: expected return with its bounds, beside simpler rules.

    Example: `uav-twin plan inspected_wing --out policy.npz`
    """
    from reporting.pages.figures import write_picture
    from twin_master.mission.planning import (
        compare_simple_rules,
        encode_policy,
        fraction_beyond_limit,
    )
    from twin_master.report.planning import plan_figure

    knowledge, _ = _prepare(scenario, seed, calibration)
    without_value_of = None
    if value_of is not None:
        without_value_of = _without_information(knowledge, [value_of])
    belief_plan, simulated = _plan_mission(knowledge)
    if out is not None:
        atomic_write_bytes(out, encode_policy(belief_plan.policy, knowledge.model))
    if picture is not None:
        write_picture(picture, plan_figure(belief_plan.policy, knowledge.model))
    record: Record = {
        "lower": belief_plan.lower,
        "upper": belief_plan.upper,
        "simulated": simulated.mean,
        "half_width": simulated.half_width,
        "beyond_limit": fraction_beyond_limit(
            knowledge.scenario, knowledge.problem, knowledge.rewards, belief_plan.policy
        ),
    }
    rules = [simulated]
    if without_value_of is None:
        rules += compare_simple_rules(knowledge.scenario, knowledge.problem)
    else:
        _, simulated_without = _plan_mission(without_value_of)
        rules.append(replace(simulated_without, name=f"planned without {value_of}"))
        value = simulated.beyond(simulated_without)
        record["value"] = {"of": value_of, "mean": value.mean, "half_width": value.half_width}
    record["rules"] = {rule.name: [rule.mean, rule.half_width] for rule in rules}
    if json:
        terminal.print_json(record)
    else:
        _print_plan(record)


def _print_plan(record: Record) -> None:
    """Print the returns of the rules, the bounds of the plan, and the value of inspections."""
    rows = []
    for rule, (mean, half_width) in record["rules"].items():
        rows.append([rule, f"{mean:.4g}", f"{half_width:.2g}"])
    terminal.print_table(["rule", "expected return", "± (95 %)"], rows)
    lower = record["lower"]
    upper = record["upper"]
    terminal.say(
        f"Bounds of the return of a mission without end: {lower:.5g} to {upper:.5g}, a gap of "
        f"{upper - lower:.2g}."
    )
    percent = 100 * record["beyond_limit"]
    terminal.say(f"Beyond a health limit: {percent:.3g} % of the steps, discounted.")
    if "value" in record:
        value = record["value"]
        worth = f"{value['mean']:.3g} ± {value['half_width']:.2g}"
        terminal.say(f"{value['of']} is worth {worth} (95 %).")


@dataclass(frozen=True)
class _GaugePlaces:
    """The positions of the gauges, for pictures.

    Attributes
    ----------
    positions : (G, 3) array or None
        The positions of the gauges, in metres; None if no file gives them.
    outlines : list of (N, 2) array
        The outlines of a wing and its regions, in metres; empty for other structures.
    """

    positions: "Float | None" = None
    outlines: "list[Float]" = field(default_factory=list)


def _prepare(
    scenario_name: str,
    seed: int | None,
    calibration: Path | None,
    candidates: str | None = None,
) -> "tuple[Knowledge, _GaugePlaces]":
    """Return the knowledge of a scenario's twin and the positions of its gauges.

    Parameters
    ----------
    scenario_name : str
        A shipped scenario or a scenario file.
    seed : int or None
        The seed, if not that of the scenario.
    calibration : Path or None
        A calibration file, if not that of the scenario.
    candidates : str, optional
        Candidates for gauges, as for `add_candidate_gauges`.
    """
    from twin_master.assets.resolution import believed_source, resolve_scenario
    from twin_master.mission.preparation import prepare_without_folder
    from twin_master.mission.sensor_design import add_candidate_gauges
    from twin_master.scenario.reading import load_scenario

    loaded_scenario = load_scenario(scenario_name)
    scenario = resolve_scenario(loaded_scenario, {"seed": seed, "calibration": calibration})
    believed_source(scenario).check()
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        if candidates is not None:
            scenario = add_candidate_gauges(scenario, candidates, Path(folder, "candidates"))
        source = believed_source(scenario)
        knowledge = prepare_without_folder(scenario, source, terminal.progress())
        return knowledge, _find_gauges(scenario)


def _plan_mission(knowledge: "Knowledge") -> "tuple[BeliefPlan, ComparedPolicy]":
    """Return a plan on the belief, and its returns in simulated missions."""
    from twin_master.mission.planning import plan_within_limit, simulate_policy

    scenario = knowledge.scenario
    problem = knowledge.problem
    plan = plan_within_limit(scenario, problem, knowledge.rewards)
    return plan, simulate_policy(scenario, problem, plan.policy)


_BLIND = 1e6
"""Standard deviation of a blind sensor over the largest value that it could show."""


def _without_information(knowledge: "Knowledge", names: Sequence[str]) -> "Knowledge":
    """Return the knowledge of a twin for which some gauges or inspections give no information.

    They stay in the model, but with noise so large that their readings say nothing.

    Parameters
    ----------
    knowledge : Knowledge
        The knowledge with all gauges and inspections.
    names : sequence of str
        The titles of gauges, and the names of actions that inspect.
    """
    import numpy as np

    scenario = knowledge.scenario
    titles = _sensor_titles(scenario)
    _check_names(scenario, names)
    largest_value = np.abs(knowledge.predicted).max(axis=(0, 1, 2))  # (G,)
    deviation = np.broadcast_to(scenario.observation.standard_deviation, len(titles))
    is_blind = [title in names for title in titles]
    deviation = np.where(is_blind, deviation + _BLIND * largest_value, deviation)
    largest_level = np.abs(knowledge.model.states.coordinates).max()
    blind_inspection = {"standard_deviation": _BLIND * (1.0 + largest_level)}
    actions = []
    for action in scenario.action:
        changes = blind_inspection if action.name in names else {}
        actions.append(action.model_copy(update=changes))
    blind_scenario = scenario.with_changes(
        "observation", standard_deviation=tuple(deviation.tolist())
    )
    blind_scenario = blind_scenario.model_copy(update={"action": tuple(actions)})
    return replace(knowledge, scenario=blind_scenario)


def _check_names(scenario: "Scenario", names: Sequence[str]) -> None:
    """Refuse names that are neither a gauge nor an action that inspects."""
    titles = _sensor_titles(scenario)
    inspecting = [action.name for action in scenario.action if action.inspects]
    for name in names:
        if name not in (*titles, *inspecting):
            actions = comma_list(inspecting or ["there is none"])
            raise MissionInputError(
                f"--value-of must name an action that inspects ({actions}) or a gauge ({titles[0]} "
                f"to {titles[-1]}), but `{name}` was given."
            )


def _sensor_titles(scenario: "Scenario") -> tuple[str, ...]:
    """Return the titles of the sensors; if they have none, their numbers from 1."""
    section = scenario.observation
    return section.titles or tuple(str(number + 1) for number in range(section.count))


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
            help="More candidates on a structure: N rosettes spread over its surface, or a file of "
            "gauges.",
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
    from twin_master.mission.sensor_design import choose_sensors, draw_readings, level_separations

    knowledge, places = _prepare(scenario, None, calibration, candidates)
    titles = _sensor_titles(knowledge.scenario)
    candidate_titles = _candidate_titles(titles, among)
    candidate_indices = [titles.index(title) for title in candidate_titles]
    readings = draw_readings(knowledge)
    choice = choose_sensors(readings, candidate_indices, sensors)
    chosen_titles = [titles[sensor] for sensor in choice.sensors]
    not_separated = []
    separations = level_separations(knowledge, readings, candidate_indices)
    for (factor, level), separation in separations.items():
        if separation < 1.0:
            not_separated.append(_neighbouring_levels(knowledge, factor, level))
    record: Record = {
        "sensors": chosen_titles,
        "information": list(choice.information),
        "of_all": choice.information_of_all,
        "not_separated": not_separated,
    }
    if worth:
        record["worth"] = _compare_returns(knowledge, chosen_titles, candidate_titles)
    if vtu is not None:
        _write_vtu(vtu, places, choice)
    if picture is not None:
        _write_design_picture(picture, places, choice, chosen_titles)
    if json:
        terminal.print_json(record)
    else:
        _print_design(record, len(candidate_indices))


def _candidate_titles(titles: Sequence[str], among: str | None) -> Sequence[str]:
    """Return the titles that the option --among names, or all titles without it."""
    if among is None:
        return titles
    candidates = tuple(among.split(","))
    are_known = {*candidates} <= {*titles}
    are_different = len({*candidates}) == len(candidates)
    if not are_known or not are_different:
        raise MissionInputError(
            f"--among must name different sensors, from {titles[0]} to {titles[-1]}, but `{among}` "
            "was given."
        )
    return candidates


def _compare_returns(
    knowledge: "Knowledge", chosen_sensors: Sequence[str], candidates: Sequence[str]
) -> dict[str, list[float]]:
    """Return mean and half width of the returns: with the chosen and with all sensors."""
    titles = _sensor_titles(knowledge.scenario)
    not_chosen = [title for title in titles if title not in chosen_sensors]
    no_candidates = [title for title in titles if title not in candidates]
    _, with_chosen = _plan_mission(_without_information(knowledge, not_chosen))
    _, with_all = _plan_mission(_without_information(knowledge, no_candidates))
    compared = {
        "chosen": with_chosen,
        "all": with_all,
        "all beyond chosen": with_all.beyond(with_chosen),
    }
    return {name: [returns.mean, returns.half_width] for name, returns in compared.items()}


def _print_design(record: Record, candidates: int) -> None:
    """Print the chosen sensors with their information, and the levels that none separates."""
    for sensor, information in zip(record["sensors"], record["information"], strict=True):
        terminal.say(f"{sensor}: {information:.3f} bit together with the sensors above.")
    terminal.say(f"All {candidates} candidates: {record['of_all']:.3f} bit.")
    for levels in record["not_separated"]:
        terminal.say(
            f"No gauge separates {levels}: all candidates together see less than one standard "
            "deviation between them."
        )
    for sensors, (mean, half_width) in record.get("worth", {}).items():
        terminal.say(f"Expected return, {sensors}: {mean:.4g} ± {half_width:.2g} (95 %).")


def _neighbouring_levels(knowledge: "Knowledge", factor_name: str, level: int) -> str:
    """Return a level of a state factor, given by its index, and the next one in words."""
    from twin_master.scenario.section import printed_state

    index = knowledge.scenario.state_names.index(factor_name)
    factor = knowledge.scenario.state[index]
    scale, unit = printed_state(factor.unit)
    low = scale * factor.levels[level]
    high = scale * factor.levels[level + 1]
    return f"{factor_name} of {low:g} {unit} from {high:g} {unit}"


def _write_vtu(path: Path, places: _GaugePlaces, choice: "SensorDesign") -> None:
    """Write the gauges as points; their rank is 1 for the first chosen one, and 0 if not chosen."""
    import numpy as np

    from fe.structure.vtu import write_vtu

    if places.positions is None:
        raise MissionInputError(
            "--vtu needs a wing or a structure whose file says where its gauges are."
        )
    rank = np.zeros(len(places.positions))
    rank[list(choice.sensors)] = np.arange(1, len(choice.sensors) + 1)
    cells = ("vertex", np.arange(len(rank))[:, None])
    write_vtu(path, places.positions, cells, {"rank": rank}, {})


def _write_design_picture(
    path: Path,
    places: _GaugePlaces,
    choice: "SensorDesign",
    chosen_titles: Sequence[str],
) -> None:
    """Draw the information of the chosen sensors, and their positions."""
    import numpy as np

    from reporting.pages.figures import write_picture
    from twin_master.report.planning import design_figure

    positions = places.positions
    if positions is not None:
        # The picture shows the two axes along which the gauges extend most.
        axes_by_extent = np.argsort(-np.ptp(positions, axis=0), kind="stable")
        positions = positions[:, np.sort(axes_by_extent[:2])]
    figure = design_figure(
        list(choice.information),
        choice.information_of_all,
        chosen_titles,
        positions,
        choice.sensors,
        places.outlines,
    )
    write_picture(path, figure)


def _find_gauges(scenario: "Scenario") -> _GaugePlaces:
    """Return the positions of the gauges, from the structure file or the design of a wing."""
    import numpy as np

    from fe.wing.design import load_design
    from twin_master.assets.design_source import DESIGN_COPY
    from twin_master.assets.structure_source import MODEL_COPY
    from twin_master.report.structure import gauge_places, planform_of

    files = scenario.belief.all_files()
    positions = gauge_places(files.get(MODEL_COPY))
    if positions is not None and scenario.observation.role == "strain":
        return _GaugePlaces(positions)
    design_file = files.get(DESIGN_COPY)
    wing_design = None if design_file is None else load_design(design_file)
    planform = planform_of(wing_design, scenario)
    if planform is None:
        return _GaugePlaces()
    positions = np.insert(planform.gauges, 2, 0.0, axis=1)  # at z = 0
    return _GaugePlaces(positions, [planform.outline, *planform.regions])
