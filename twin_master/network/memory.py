"""What a twin needs in memory, told before it is built."""

from collections.abc import Mapping
from math import prod

from reporting.memory import memory_left
from twin_master.errors import InvalidModelError, said
from twin_master.scenario.schema import Scenario

NUMBER = 8
"""Bytes of a number."""
TRANSITION_COPIES = 3
"""The tables of the controls, the array of all of them, and the checked copy."""
_PREDICTION_COPIES = 8
"""The table, the checked copy, the copy ordered for the likelihood, and what the quantiles are taken from."""
_HISTORY_COPIES = 4
"""Belief before and after the observation, its logarithm, and the smoothed one."""


def check_fits(parts: Mapping[str, float], advice: str) -> None:
    """Check that arrays fit in memory together.

    Parameters
    ----------
    parts : dict of str to float
        What is to be built, in words with its numbers, and its size [bytes].
    advice : str
        What makes it smaller.

    Raises
    ------
    InvalidModelError
        They do not; the sentence has all sizes.
    """
    needed, there = sum(parts.values()), memory_left()
    if needed > there:
        listed = ", ".join(f"{size / 1e9:.3g} GB for {what}" for what, size in parts.items())
        sizes = [f"{size / 1e9:.3g} GB" for size in (needed, there)]
        raise InvalidModelError(said("network.memory", listed=listed, sizes=sizes, advice=advice))


def scenario_bytes(scenario: Scenario) -> dict[str, float]:
    """Return what the twin of a scenario keeps in memory, in words with its numbers, and its size [bytes]."""
    states = prod(len(factor.levels) for factor in scenario.state)
    controls, sensors = len(scenario.control), scenario.observation.count
    steps, ahead = scenario.mission.steps, scenario.mission.prediction_steps
    draws = 1 if scenario.calibration.source == "fixed" else scenario.calibration.draws
    tables = sum(transition_bytes(len(factor.levels), controls) for factor in scenario.state)
    belief = NUMBER * (states + sensors)
    predictions = NUMBER * draws * states * controls * sensors
    return {
        f"the transitions of {len(scenario.state)} state factors under {controls} controls": TRANSITION_COPIES
        * tables,
        f"{draws} draws of {sensors} sensors in {states} states": _PREDICTION_COPIES * predictions,
        f"the beliefs of {steps} steps and {ahead} ahead": _HISTORY_COPIES * belief * (steps + ahead),
    }


def check_scenario_fits(scenario: Scenario) -> None:
    """Check that the twin of a scenario fits in memory, before anything of it is built.

    Raises
    ------
    InvalidModelError
        It does not.
    """
    check_fits(scenario_bytes(scenario), "take fewer levels, state factors, draws or steps")


def transition_bytes(states: int, controls: int) -> float:
    """Return the size of one table of transitions (U, S, S) [bytes]."""
    return float(NUMBER * controls * states * states)
