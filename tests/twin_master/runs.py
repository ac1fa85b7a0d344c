"""What tests of missions share: scenarios with changes, twins of a strain library, runs cut off."""

import hashlib
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.arrays import arrays_from_bytes, arrays_to_bytes
from fe.runtime.patch import ModelPatch, Primitive
from fmu_asset.packing.patch_file import SCHEMA
from reporting.files import hash_record
from reporting.progress import SilentProgress
from scenarios import scenario_files
from twin_master.assets.asset_source import Asset, AssetSource
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.assets.resolution import asset_source, resolve_scenario
from twin_master.assets.strain_library_source import StrainLibrarySource, load_strain_library
from twin_master.mission.flights import fly
from twin_master.mission.journal import (
    JOURNAL_NAME,
    JournalFile,
    decode_state,
    encode_state,
    records,
)
from twin_master.mission.journal_packing import PROBABILITY_DECIMALS
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.mission.recent_parts import RECENT_NAMES, RecentParts
from twin_master.mission.steps import History, MissionStep
from twin_master.network.estimator import Estimator
from twin_master.run_folder import CONFIG_NAME, to_json
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario
from uav_twin import Estimate, load_scenario, reduced_model


def edited(text: str, *changes: tuple[str, str]) -> str:
    """Return a text in which pieces, that it must have, are exchanged once."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def text_of(name: str, *changes: tuple[str, str]) -> str:
    """Return the text of a shipped scenario in which pieces are exchanged."""
    return edited(scenario_files()[name].read_text(encoding="utf-8"), *changes)


def written(folder: Path, text: str, *changes: tuple[str, str], name: str = "mine.toml") -> Path:
    """Write a text in which pieces are exchanged into a folder."""
    path = folder / name
    path.write_text(edited(text, *changes), encoding="utf-8")
    return path


def table_of(name: str) -> dict[str, Any]:
    return tomllib.loads(text_of(name))


def merged(table: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with other values, also in its tables; "" for a key that goes."""
    found = {key: value for key, value in table.items() if changes.get(key) != ""}
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(found.get(key), dict):
            found[key] = merged(found[key], value)
        elif value != "":
            found[key] = value
    return found


def changed_scenario(name: str, changes: Mapping[str, Any]) -> LoadedScenario:
    """Return a shipped scenario with other values in its tables."""
    return loaded_from(merged(table_of(name), changes), name)


def loaded_from(table: dict[str, Any], name: str) -> LoadedScenario:
    """Return a scenario that stands where a shipped one does."""
    return LoadedScenario(parse_scenario(table, name), scenario_files()[name], "0" * 64)


def prepared(loaded: LoadedScenario, folder: Path, given: Mapping[str, Any]) -> AssetSource:
    """Return what flies in a scenario under options, checked and ready in a folder."""
    source = asset_source(resolve_scenario(loaded, given))
    source.check()
    source.prepare(folder, SilentProgress())
    return source


def of_library(
    name: str, library: Path, seed: int = 3, **sections: Any
) -> tuple[Knowledge, StrainLibrarySource]:
    """Return what a twin knows of the wing of a strain library, and that wing; with other sections."""
    scenario = load_scenario(name).scenario.model_copy(update=sections)
    source = StrainLibrarySource(scenario, load_strain_library(library))
    return prepare_knowledge(scenario, source, seed), source


def of_wing(given: str | Scenario, seed: int = 3) -> tuple[Knowledge, ReducedModelSource]:
    """Return what a twin of the shipped wing knows, and that wing."""
    scenario = load_scenario(given).scenario if isinstance(given, str) else given
    source = ReducedModelSource(scenario, reduced_model())
    return prepare_knowledge(scenario, source, seed), source


def flight_of(
    knowledge: Knowledge,
    source: AssetSource,
    *sinks: Callable[[MissionStep], None],
    seed: int = 3,
    asset: Asset | None = None,
) -> History:
    """Return the mission of a seed, flown by an asset or by what its source opens."""
    plant = knowledge.plant(knowledge.truth(seed), asset or source.open())
    return fly(knowledge.scenario, knowledge.twin(), plant, *sinks)


def estimates_of(
    estimator: Estimator, seen: np.ndarray, controls: Sequence[int] | None = None
) -> list[Estimate]:
    """Return what an estimator makes of steps, under their controls or always the first one."""
    estimates: list[Estimate] = []
    for step, (row, control) in enumerate(zip(seen, controls or [0] * len(seen), strict=True)):
        before = estimates[-1].carried if estimates else None
        estimates.append(estimator.step(before, row, control, step))
    return estimates


def patch_record(*primitives: Primitive, channel: str = "g5") -> dict[str, Any]:
    """Return a patch of hidden effects, in which a gauge has a name."""
    effects = [{"id": "hidden", "primitives": ModelPatch(primitives).to_list()}]
    return {"schema": SCHEMA, "effects": effects, "channels": {channel: f"strain[{channel[1:]}]"}}


def figures_of(folder: Path) -> dict[str, Any]:
    """Return the figures in the summary of a run."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return {figure["key"]: figure["value"] for figure in summary["figures"]}


def journal(folder: Path) -> list[dict[str, Any]]:
    """Return the records of the journal of a run or watch, the last ones with their large parts."""
    recent = RecentParts(folder)
    return [record for record, *_ in records(folder / JOURNAL_NAME, recent=recent)]


def belief_in_journal(filtered: np.ndarray) -> list[Any]:
    """Return beliefs as a journal has them."""
    return np.round(filtered, PROBABILITY_DECIMALS).tolist()


def line_of_format_1(record: Mapping[str, Any]) -> bytes:
    """Return a line of a journal as the first version of its format has it."""
    text = json.dumps(record, sort_keys=True, allow_nan=False).encode("ascii")
    return hashlib.sha256(text).hexdigest().encode("ascii") + b" " + text + b"\n"


def in_format_1(folder: Path, rename: Callable[[str], str] = str) -> None:
    """Write the journal of a watch as the first version of its format has it, in which each line has all.

    The text of each line may be changed, too.
    """
    path, content = folder / JOURNAL_NAME, b""
    config_hash = hash_record(json.loads((folder / CONFIG_NAME).read_text(encoding="utf-8")))
    for record in [{"config_hash": config_hash}, *journal(folder)]:
        if "standing" in record:
            record["standing"]["begin"] = len(content)
        content += line_of_format_1(json.loads(rename(json.dumps(record))))
    path.write_bytes(content)
    for name in RECENT_NAMES:
        (folder / name).unlink(missing_ok=True)


def with_former_names(folder: Path) -> None:
    """Write a run folder as earlier versions did, with `turn` wherever a key says `step`."""
    config = json.loads((folder / CONFIG_NAME).read_text(encoding="utf-8"))
    notice = config["scenario"].get("notice") or {}
    for name in [name for name in notice if name.endswith("_steps")]:
        notice[name.replace("steps", "turns")] = notice.pop(name)
    (folder / CONFIG_NAME).write_text(to_json(config), encoding="utf-8")

    def renamed(text: str) -> str:
        record = json.loads(re.sub(r'"(\w+_)?step(s?)":', r'"\1turn\2":', text))
        if "settled" in record:
            arrays = arrays_from_bytes(decode_state(record["settled"]["state"]), "the state")
            arrays = {re.sub(r"\bsteps$", "turns", name): values for name, values in arrays.items()}
            record["settled"]["state"] = encode_state(arrays_to_bytes(arrays))
        return json.dumps(record)

    in_format_1(folder, renamed)
    assert b'"step' not in (folder / JOURNAL_NAME).read_bytes()


@contextmanager
def cut_off_after(steps: int) -> Iterator[None]:
    """Let the run within die once so many steps are kept."""
    append = JournalFile.append

    def dying(self: JournalFile, record: Mapping[str, Any], parts: dict[str, Any] | None = None) -> None:
        append(self, record, parts)
        if record.get("step") == steps - 1:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(JournalFile, "append", dying)
        with pytest.raises(KeyboardInterrupt):
            yield


def noted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return where what is said to those who look at the progress is kept."""
    said = list[str]()
    monkeypatch.setattr(SilentProgress, "note", lambda _progress, text: said.append(text))
    return said


def check_same(first: Path, second: Path, *names: str) -> None:
    """Compare files of two folders to the last bit."""
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
