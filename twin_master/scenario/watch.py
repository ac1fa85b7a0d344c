"""The table `[watch]` of a scenario: how a real asset is watched."""

from pathlib import Path
from typing import Self

from scenarios import recording_files
from twin_master.scenario.section import Count, Positive, Section

__all__ = ["WatchSection"]


class WatchSection(Section):
    """How a real asset is watched."""

    observations: str | None = None
    """A recorded file that is watched where nothing else is given, or the name of a shipped one."""
    lag: Count = 50
    """Turns back over which the twin smooths, and which a message may be late."""
    longest_gap: Count = 1000
    """Turns that a message may be ahead of the next one; those between are predicted through."""
    seconds_per_turn: Positive | None = None
    """Of messages that have a time in the place of a turn."""
    allow_unknown: bool = False
    """Keys and columns that are no sensor are passed over, and not refused."""
    quiet_after_seconds: Positive | None = None
    """Without a turn for so long, a notice says that the last decision grows old."""

    @property
    def recording(self) -> Path | None:
        """The recorded file."""
        name = self.observations
        return None if name is None else recording_files().get(name, Path(name))

    def moved(self, folder: Path) -> Self:
        """Return the table with the path of the recorded file from a folder; a run folder has no copy."""
        if self.observations is None or self.observations in recording_files():
            return self
        return self.model_copy(update={"observations": str(folder / self.observations)})
