"""A wing and its watches, made once."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from reporting.progress import SilentProgress
from tests.twin_master.runs import flight_of
from tests.twin_master.watch.watches import begun, ran, watchful, write_csv
from twin_master.mission.turns import History
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.watch.feeds import CsvFeed
from twin_master.watch.folder import Watch
from twin_master.watch.opening import begun_watch


@pytest.fixture(scope="session")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> LoadedScenario:
    """`paper_level_turns` of a real wing: without what flies and what really happens."""
    text = load_scenario("paper_level_turns").path.read_text(encoding="utf-8")
    tables = re.compile(r"^\[+(asset|truth|reference)\b.*?(?=^\[|\Z)", re.MULTILINE | re.DOTALL)
    path = tmp_path_factory.mktemp("scenario") / "my_wing.toml"
    path.write_text(f"{tables.sub('', text)}\n[watch]\nlag = 12\n", encoding="utf-8")
    return load_scenario(path)


@pytest.fixture(scope="session")
def mission(base: Watch) -> History:
    """The paper's mission, flown by the model that the watch believes."""
    knowledge = replace(base.models[0].knowledge, scenario=load_scenario("paper_level_turns").scenario)
    return flight_of(knowledge, base._source, seed=knowledge.scenario.mission.seed)


@pytest.fixture(scope="session")
def recorded(mission: History, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mission as a CSV file with some garbage between its turns."""
    path = tmp_path_factory.mktemp("recorded") / "mission.csv"
    return write_csv(path, mission.observed, mission.control_index, garbage=True)


@pytest.fixture(scope="session")
def plain(mission: History, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mission as a CSV file without it."""
    path = tmp_path_factory.mktemp("plain") / "m.csv"
    return write_csv(path, mission.observed, mission.control_index)


@pytest.fixture(scope="session")
def base(scenario: LoadedScenario, tmp_path_factory: pytest.TempPathFactory) -> Watch:
    """A watch that has seen nothing."""
    folder = tmp_path_factory.mktemp("base") / "watch"
    with begun_watch(scenario.scenario, scenario.file, folder, SilentProgress()) as watch:
        return watch


@pytest.fixture
def watch(base: Watch, tmp_path: Path) -> Watch:
    """One like it in a folder of its own."""
    return begun(base, tmp_path / "watch")


@pytest.fixture
def hasty(watch: Watch) -> Watch:
    """A watch that notices a silence at once."""
    section = watch.scenario.watch.model_copy(update={"quiet_after_seconds": 0.2})
    watch.scenario = watch.scenario.model_copy(update={"watch": section})
    return watch


@pytest.fixture
def noticing(base: Watch, tmp_path: Path) -> Watch:
    """A watch that gives notice."""
    return watchful(base, tmp_path / "watch")


@pytest.fixture(scope="session")
def whole(base: Watch, recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the watch of the whole mission."""
    folder = tmp_path_factory.mktemp("whole") / "watch"
    watch = begun(base, folder)
    watch.store(ran(watch, CsvFeed(recorded, watch.scenario)))
    return folder


@pytest.fixture(scope="session")
def loose(mission: History, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mission with a gauge that shows 30 % too little from turn 15 on."""
    observed = mission.observed.copy()
    observed[15:, 4] *= 0.7
    return write_csv(tmp_path_factory.mktemp("loose") / "m.csv", observed, mission.control_index)
