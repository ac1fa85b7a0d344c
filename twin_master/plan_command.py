"""`uav-twin plan` and `uav-twin design`: what is decided by the belief, what it is worth, what tells most."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from reporting import terminal
from twin_master.errors import MissionInputError, said

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from twin_master.mission.planning import ComparedPolicy
    from twin_master.mission.preparation import Knowledge
    from twin_master.network.belief_planning import BeliefPlan, DecisionProblem
    from twin_master.scenario.schema import Scenario

    Float = NDArray[np.float64]


def plan(
    scenario: str,
    *,
    out: Path | None = None,
    picture: Path | None = None,
    value_of: str | None = None,
    seed: int | None = None,
    calibration: Path | None = None,
    json: bool = False,
) -> None:
    """Plan on the belief: expected return with its bounds, beside simpler rules."""
    from reporting.files import atomic_write_bytes
    from twin_master.mission.planning import compared, policy_file, risk_of
    from twin_master.report.structure import plan_figure

    knowledge, _ = _knowledge(scenario, seed, calibration)
    blind = _without(knowledge, [value_of]) if value_of is not None else None
    problem, plan, promised = _planned(knowledge)
    if out is not None:
        atomic_write_bytes(out, policy_file(plan.policy, knowledge.model))
    if picture is not None:
        _draw(picture, plan_figure(plan.policy, knowledge.model))
    record: dict[str, Any] = {
        "lower": plan.lower,
        "upper": plan.upper,
        "simulated": promised.mean,
        "half_width": promised.half_width,
        "beyond_limit": risk_of(knowledge.scenario, problem, knowledge.rewards, plan.policy),
    }
    rows = [promised, *([] if blind else compared(knowledge.scenario, problem))]
    if blind is not None:
        without = _planned(blind)[2]
        worth = promised.beyond(without)
        rows.append(replace(without, name=f"planned without {value_of}"))
        record["value"] = {"of": value_of, "mean": worth.mean, "half_width": worth.half_width}
    record["rules"] = {row.name: [row.mean, row.half_width] for row in rows}
    terminal.answer("plan", "twin_master", record, json=json)


def _knowledge(
    scenario: str, seed: int | None, calibration: Path | None, candidates: str | None = None
) -> "tuple[Knowledge, tuple[Float | None, list[Float]]]":
    """Return what the twin knows before any plan on the belief, and where its gauges are, see `_places`."""
    from twin_master.assets.resolution import Overrides, believed_source, resolve_scenario
    from twin_master.mission.preparation import prepared_alone
    from twin_master.mission.sensor_design import with_candidates
    from twin_master.scenario.reading import load_scenario

    resolved = resolve_scenario(load_scenario(scenario), Overrides(seed=seed, calibration=calibration))
    believed_source(resolved).check()
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        if candidates is not None:
            resolved = with_candidates(resolved, candidates, Path(folder, "candidates"))
        found = prepared_alone(resolved, believed_source(resolved), terminal.progress())
        return found, _places(resolved)


def _planned(knowledge: "Knowledge") -> "tuple[DecisionProblem, BeliefPlan, ComparedPolicy]":
    """Return what is decided on, the plan, and what it promises."""
    from twin_master.mission.planning import expected_plan, promised

    scenario, problem = knowledge.scenario, knowledge.problem
    plan = expected_plan(scenario, problem, knowledge.rewards)[0]
    return problem, plan, promised(scenario, problem, plan.policy)


def _without(knowledge: "Knowledge", names: Sequence[str]) -> "Knowledge":
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
    bare = scenario.model_copy(
        update={
            "action": tuple(a.model_copy(update=unread if a.name in names else {}) for a in scenario.action),
            "observation": scenario.observation.model_copy(
                update={"standard_deviation": tuple(blind.tolist())}
            ),
        }
    )
    return replace(knowledge, scenario=bare)


def _titles(scenario: "Scenario") -> tuple[str, ...]:
    """Return what the sensors are called: their titles, or numbers from 1."""
    section = scenario.observation
    return section.titles or tuple(str(number + 1) for number in range(section.count))


_BLIND = 1e6
"""Standard deviation of a sensor that shows nothing, over the largest that it could show."""


def _draw(path: Path, figure: "Figure") -> None:
    from reporting.figures import to_png, to_svg
    from reporting.files import atomic_write_bytes

    atomic_write_bytes(path, to_png(figure) if path.suffix.lower() == ".png" else to_svg(figure))


def design(
    scenario: str,
    *,
    sensors: int,
    among: str | None = None,
    candidates: str | None = None,
    picture: Path | None = None,
    vtu: Path | None = None,
    worth: bool = False,
    calibration: Path | None = None,
    json: bool = False,
) -> None:
    """Choose the sensors that tell most of the state, and name what none of them separates."""
    from twin_master.mission.sensor_design import chosen_sensors, drawn_readings, separations

    knowledge, places = _knowledge(scenario, None, calibration, candidates)
    titles = _titles(knowledge.scenario)
    wanted = titles if among is None else tuple(among.split(","))
    if not {*wanted} <= {*titles} or len({*wanted}) < len(wanted):
        raise MissionInputError(said("plan_command.among", first=titles[0], last=titles[-1], among=among))
    pool, readings = [titles.index(name) for name in wanted], drawn_readings(knowledge)
    found = chosen_sensors(readings, pool, sensors)
    names = [titles[sensor] for sensor in found.sensors]
    apart = separations(knowledge, readings, pool)
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


def _between(knowledge: "Knowledge", name: str, level: int) -> str:
    """Return two neighbouring levels of a state in words."""
    from twin_master.scenario.section import printed_state

    place = knowledge.scenario.state_names.index(name)
    factor = knowledge.scenario.state[place]
    scale, unit = printed_state(factor.unit)
    low, high = (scale * value for value in factor.levels[level : level + 2])
    return f"{name} of {low:g} {unit} from {high:g} {unit}"


def _draw_design(
    picture: Path | None, vtu: Path | None, where: "tuple[Float | None, list[Float]]",
    record: Mapping[str, Any], chosen: Sequence[int],
) -> None:  # fmt: skip
    import numpy as np

    from fe.structure.operators import write_vtu
    from twin_master.report.structure import design_figure

    places, outlines = where
    if vtu is not None:
        if places is None:
            raise MissionInputError("--vtu needs a wing or a structure whose file says where its gauges are.")
        rank = np.zeros(len(places))
        rank[list(chosen)] = np.arange(1, len(chosen) + 1)
        write_vtu(vtu, places, ("vertex", np.arange(len(rank))[:, None]), {"rank": rank}, {})
    if picture is not None:
        if places is not None:  # the two axes along which they are spread most
            places = places[:, np.sort(np.argsort(-np.ptp(places, axis=0), kind="stable")[:2])]
        figure = design_figure(
            record["information"], record["of_all"], record["sensors"], places, chosen, outlines
        )
        _draw(picture, figure)


def _places(scenario: "Scenario") -> "tuple[Float | None, list[Float]]":
    """Return where the gauges are (G, 3) [m], None where no file says it, and outlines (N, 2) of a wing."""
    import numpy as np

    from fe.structure.design import MeshDesign, load_structure
    from fe.wing.design import load_design
    from twin_master.assets.design_source import DESIGN_COPY
    from twin_master.assets.structure_source import MODEL_COPY
    from twin_master.report.structure import planform_of

    files = scenario.belief.all_files()
    structure = load_structure(files[MODEL_COPY]) if MODEL_COPY in files else None
    if isinstance(structure, MeshDesign) and scenario.observation.role == "strain":
        return structure.unit * np.array([part.point for part in structure.gauge]), []
    file = files.get(DESIGN_COPY)
    wing = planform_of(None if file is None else load_design(file), scenario)
    if wing is None:
        return None, []
    return np.insert(wing.gauges, 2, 0.0, axis=1), [wing.outline, *wing.regions]
