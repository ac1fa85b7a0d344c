"""`uav-twin scenarios` and `uav-twin scenario check`."""

from pathlib import Path

from scenarios import scenario_files
from uav_twin import parts
from uav_twin.options import answer, show


def list_scenarios() -> None:
    """List the scenarios that are shipped."""
    files = scenario_files()
    shown = {name: parts.load_scenario(path).scenario for name, path in files.items()}
    show("scenarios", shown=shown, folder=next(iter(files.values())).parent)


def check(file: str, *, calibration: Path | None = None, json: bool = False) -> None:
    """Say what a scenario flies and believes, and what it takes; exit code 1 if anything is wrong with it."""
    loaded = parts.load_scenario(file)
    answer(
        "scenario check", parts.check_scenario(loaded, parts.Overrides(calibration=calibration)), json=json
    )
