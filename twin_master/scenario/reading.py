"""Reading scenario files: TOML in, a checked `Scenario` out, and one clear sentence for whatever is wrong."""

import hashlib
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from reporting.section import shown
from reporting.toml_file import read_toml
from scenarios import scenario_files
from twin_master.errors import ScenarioError, UnknownScenarioError
from twin_master.scenario.asset import KindSection
from twin_master.scenario.format import from_format_1
from twin_master.scenario.notice import GAINS, MOST_DRAWS, NUMBERS_BY_DEFAULT, Noticing
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Section


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario, its file, the SHA-256 of that file's content, and a remark for its user, if any."""

    scenario: Scenario
    path: Path
    content_hash: str
    remark: str = ""


def find_scenario(name: str) -> Path:
    """Return the file of a shipped scenario, or of a path to a TOML file.

    Raises
    ------
    UnknownScenarioError
        Neither a shipped scenario nor a file has this name.
    """
    shipped = scenario_files()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.is_file():
        return path
    raise UnknownScenarioError(
        f"There is no scenario `{name}`: give the path of a TOML file or one of {', '.join(shipped)}."
    )


def load_scenario(name_or_path: str | Path) -> LoadedScenario:
    """Read and check a scenario by its shipped name or its path.

    Where the file says nothing of `notice` the twin gives notices, if it can. `config.json` of a run says
    what was flown: nothing is added to that.

    Raises
    ------
    UnknownScenarioError
        There is no such scenario.
    ScenarioError
        The file cannot be read, is not TOML, or breaks the schema; the sentence names file and key.
    """
    path = find_scenario(str(name_or_path))
    table = read_toml(path, ScenarioError, what="scenario")
    content_hash = hashlib.sha256(path.read_bytes()).hexdigest()
    scenario, remark = parse_scenario(table, str(path)), ""
    if "notice" not in table:
        reason = why_no_notices(scenario)
        scenario = scenario.model_copy(update={"notice": None if reason else Noticing()})
        remark = f"This twin gives no notices: {reason}; `notice = false` says that it is meant so."
    return LoadedScenario(scenario, path, content_hash, remark if scenario.notice is None else "")


def why_no_notices(scenario: Scenario) -> str:
    """Return why notices are not given by themselves, in words; empty where they are."""
    observation, calibration = scenario.observation, scenario.calibration
    if observation.modes is not None:
        return "observations of modes have a covariance of their own"
    if scenario.readings:
        return "a scenario with inspections asks for them by `[notice]`"
    if observation.average_over_draws == "inside":
        return "the average over the draws is taken `inside`, so that each sensor has a parameter of its own"
    draws = 1 if calibration.source == "fixed" else min(calibration.draws, MOST_DRAWS)
    numbers = prod(len(factor.levels) for factor in scenario.state) * draws * observation.count * GAINS
    if numbers > NUMBERS_BY_DEFAULT:
        return (
            f"they take {numbers:,} numbers a turn, more than {NUMBERS_BY_DEFAULT:,} (`[notice]` takes them)"
        )
    return ""


def parse_scenario(table: Mapping[str, Any], source: str) -> Scenario:
    """Return the scenario that a table (of a TOML file, or of `config.json`) describes.

    Raises
    ------
    ScenarioError
        The table breaks the schema; `source` names it in the sentence.
    """
    if table.get("format") == 1 and table["format"] is not True and "belief" not in table:
        table = from_format_1(table)
    try:
        return Scenario.model_validate(table)
    except ValidationError as error:
        errors = error.errors(include_url=False, include_context=True)
        # A misspelt key shows up twice, as unknown and as missing: the unknown one tells more.
        first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
        raise ScenarioError(f"{source}: {_sentence(first, table)}") from None


def _sentence(error: Mapping[str, Any], table: Mapping[str, Any]) -> str:
    location = tuple(error["loc"])
    kind = error["type"]
    if kind == "extra_forbidden":
        keys = _known_keys(location[:-1], table)
        return f"unknown key `{_written(location, table)}`; the keys known there are {', '.join(keys)}."
    if kind == "missing":
        name = _with_unit(_section_at(location[:-1], table), str(location[-1]))
        return f"`{_written(location, table).removesuffix(str(location[-1]))}{name}` is missing."
    if kind == "value_error":
        where = _written(location, table)
        message = str(error["ctx"]["error"])
        return f"{message}{f' (in `{where}`)' if where else ''}."
    expected = str(error["msg"]).replace("Input should", "should", 1)
    return f"`{_written(location, table)}` {expected}, and {shown(_value(location, table, error))} came."


def _step(node: Any, part: int | str) -> tuple[bool, Any, str]:
    """Follow one part of a location; return whether it led anywhere, the node and the key as written."""
    if isinstance(node, Mapping):
        for key in node:
            if key == part or str(key).startswith(f"{part}_"):
                if key != part and part in node:
                    continue
                return True, node[key], str(key)
    elif (
        isinstance(node, Sequence)
        and not isinstance(node, str)
        and isinstance(part, int)
        and part < len(node)
    ):
        return True, node[part], f"[{part + 1}]"
    return False, None, str(part)


def _written(location: tuple[int | str, ...], table: Mapping[str, Any]) -> str:
    """Return a location as the file has it: keys with their units, entries of arrays counted from 1."""
    node: Any = table
    text = ""
    for index, part in enumerate(location):
        found, next_node, key = _step(node, part)
        if not found and index < len(location) - 1:
            continue  # the name of a branch of a union, which the file does not have
        if not found and (not isinstance(node, Mapping) or isinstance(part, int)):
            continue
        text += key if key.startswith("[") or not text else f".{key}"
        node = next_node
    return text


def _value(location: tuple[int | str, ...], table: Mapping[str, Any], error: Mapping[str, Any]) -> object:
    node: Any = table
    for part in location:
        found, next_node, _ = _step(node, part)
        if found:
            node = next_node
    return error["input"] if node is table else node


def _section_in(annotation: Any) -> type[Section] | None:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    for argument in typing.get_args(annotation):
        section = _section_in(argument)
        if section is not None:
            return section
    return None


def _section_at(location: tuple[int | str, ...], table: Mapping[str, Any]) -> type[Section]:
    section: type[Section] = Scenario
    node: Any = table
    for part in location:
        field = section.model_fields.get(str(part))
        inner = None if field is None else _section_in(field.annotation)
        section = inner if inner is not None else section
        found, next_node, _ = _step(node, part)
        node = next_node if found else node
        if issubclass(section, KindSection) and section.own_kind() is None and isinstance(node, Mapping):
            section = section.kinds().get(str(node.get("kind")), section)
    return section


def _known_keys(location: tuple[int | str, ...], table: Mapping[str, Any]) -> list[str]:
    section = _section_at(location, table)
    return [_with_unit(section, key) for key in section.model_fields]


def _with_unit(section: type[Section], key: str) -> str:
    """Return a key with the unit that its name may carry, in brackets."""
    return f"{key}[_{section.units[key]}]" if key in section.units else key
