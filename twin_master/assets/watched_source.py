"""A real asset: nothing of it flies here, its observations come from outside."""

from typing import Literal, NoReturn

from twin_master.errors import MissionInputError
from twin_master.scenario.asset import AssetSection
from twin_master.scenario.schema import Scenario


class WatchedSection(AssetSection):
    """A scenario without `[asset]`: it is watched, and not flown."""

    kind: Literal["watched"] = "watched"

    def source(self, scenario: Scenario) -> "WatchedSource":
        """Return what can be watched only."""
        return WatchedSource()


class WatchedSource:
    """What stands for a real asset; whatever a flight would ask of it ends in one sentence."""

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise MissionInputError(
            "this scenario has no `[asset]`: it is for a real one, whose observations `uav-twin watch` takes "
            "in, and its `belief` must be a model of its own."
        )
