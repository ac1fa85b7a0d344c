"""The scenario that the page on scenarios shows whole is one."""

import re
from pathlib import Path

from twin_master.scenario.reading import load_scenario

PAGE = Path(__file__).parents[1] / "docs" / "how_to" / "scenarios.md"


def test_the_example_of_a_scenario_is_read(tmp_path):
    match = re.search(r"^```toml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert match is not None
    (tmp_path / "my_mission.toml").write_text(match[1], encoding="utf-8")
    scenario = load_scenario(tmp_path / "my_mission.toml").scenario
    assert scenario.mission.name == "my_mission"
    assert [state.name for state in scenario.state] == ["z1", "z2"]
