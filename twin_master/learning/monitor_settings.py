"""What the monitor notices and when, and how it speaks of turns and sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["MonitorSettings", "Words"]


@dataclass(frozen=True)
class MonitorSettings:
    """What is noticed, and when.

    Attributes
    ----------
    threshold : float
        Of each of the two e-processes: the probability of a false alarm is at most 1 / threshold, whatever
        the number of turns.
    gauge_gain : float
        Gain error of a single gauge that is to be found; less than half of it raises no alarm.
    all_gain : float
        Prior standard deviation of the gains of gauges that have one of their own, where no state explains
        all of them.
    memory_turns : float
        Turns after which what was learnt of these gains has faded to 1 / e.
    onset_turns : float
        Turns within which half of the faults begin that were not there from the start; n turns later a
        share of onset_turns / (onset_turns + n) is still to begin.
    absurd_deviations : float
        A reading so many assumed standard deviations beyond what any state can show is left out.
    prior : float
        Prior probability of each of the two kinds of fault, for their posterior.
    noise_degrees : float
        How sure the assumed noise is: as if it came from so many observations of each gauge.
    """

    threshold: float = 100.0
    gauge_gain: float = 0.2
    all_gain: float = 0.1
    memory_turns: float = 20.0
    onset_turns: float = 50.0
    absurd_deviations: float = 8.0
    prior: float = 0.01
    noise_degrees: float = 10.0


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
