"""How notices speak of turns and sensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from twin_master.scenario.schema import Scenario


@dataclass(frozen=True)
class Words:
    """How sentences speak of turns and sensors.

    Attributes
    ----------
    step, sensor : str
        What one is called.
    factor : float
        From the values of the sensors, SI, to what is printed.
    units : tuple of str
        Printed unit of each sensor; none where they are empty or "1".
    names : tuple of str
        What each sensor is called beside its number, if anything.
    command : str
        What looks for the cause of an alarm; empty where nothing can.
    """

    step: str = "turn"
    sensor: str = "gauge"
    factor: float = 1.0
    units: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    command: str = "uav-twin discrepancy run --from-run DIR"

    @classmethod
    def of(cls, scenario: Scenario) -> "Words":
        """Return how sentences speak of the turns and sensors of a scenario."""
        observation = scenario.observation
        more: dict[str, Any] = {"names": observation.titles} | (
            {} if scenario.searchable else {"command": ""}
        )
        if observation.role == "strain" and set(observation.sensor_units) == {"1"}:
            return cls(scenario.mission.step_name, "gauge", 1e6, ("microstrain",) * observation.count, **more)
        sensor = "gauge" if observation.role == "strain" else "sensor"
        return cls(scenario.mission.step_name, sensor, 1.0, observation.sensor_units, **more)

    def value(self, sensor: int, *values: float) -> list[str]:
        """Return values of a sensor as they are printed."""
        unit = self.units[sensor] if self.units else "1"
        return [f"{self.factor * value:.4g}{'' if unit == '1' else f' {unit}'}" for value in values]

    def sensors(self, numbers: Sequence[int]) -> str:
        """Return sensors, counted from 0, in words."""
        names = [f"{g + 1} ({self.names[g]})" if self.names else str(g + 1) for g in numbers]
        if len(names) == 1:
            return f"{self.sensor} {names[0]}"
        return f"{self.sensor}s {', '.join(names[:-1])} and {names[-1]}"
