"""What of a scenario is printed: names, signs and units of states and sensors."""

from dataclasses import dataclass

from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state

NORMAL_95 = 1.959963984540054
"""Half-width of a 95 % interval of the normal distribution, in standard deviations."""


@dataclass(frozen=True)
class PrintedFactor:
    """A factor of the state, as printed.

    Attributes
    ----------
    symbol, title, unit : str
    scale : float
        From the stored unit to the printed one.
    levels : tuple of float
        Printed, the lowest first.
    """

    symbol: str
    title: str
    unit: str
    scale: float
    levels: tuple[float, ...]

    @property
    def label(self) -> str:
        """Symbol and printed unit."""
        return f"{self.symbol} ({self.unit})"


@dataclass(frozen=True)
class PrintedSensors:
    """The sensors, as printed.

    Attributes
    ----------
    word : str
        What one is called.
    titles : tuple of str
        Of each.
    quantity : str
        What they show.
    units : tuple of str
        Of each.
    scale : float
        From the stored unit to the printed one.
    named : bool
        Whether the scenario names them.
    """

    word: str
    titles: tuple[str, ...]
    quantity: str
    units: tuple[str, ...]
    scale: float
    named: bool

    @property
    def unit(self) -> str:
        """The unit of all; empty where they have several."""
        return self.units[0] if len(set(self.units)) == 1 else ""


def printed_factors(scenario: Scenario) -> tuple[PrintedFactor, ...]:
    """Return the factors of the state, as printed."""
    found = []
    for factor in scenario.state:
        scale, unit = printed_state(factor.unit)
        levels = tuple(scale * level for level in factor.levels)
        found.append(PrintedFactor(symbol(factor.name), factor.title or factor.name, unit, scale, levels))
    return tuple(found)


def printed_sensors(scenario: Scenario) -> PrintedSensors:
    """Return the sensors, as printed."""
    section = scenario.observation
    word, units, scale = "gauge" if section.role == "strain" else "sensor", section.sensor_units, 1.0
    if section.role == "strain" and set(units) <= {"1", ""}:
        units, scale = ("µε",) * section.count, 1.0e6
    titles = section.titles or tuple(f"{word} {number}" for number in range(1, section.count + 1))
    return PrintedSensors(word, titles, section.role, units, scale, bool(section.titles))


def short_number(value: float) -> str:
    """Return a number that fits beside an axis: 0.5, 1500, 1e-4."""
    text = f"{value:g}"
    if len(text.lstrip("-")) <= 4:
        return text
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def symbol(name: str) -> str:
    """Return the name with its trailing digits as a subscript: ``z1`` -> z₁."""
    stem = name.rstrip("0123456789")
    digits = name[len(stem) :]
    return stem + digits.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")) if stem else name
