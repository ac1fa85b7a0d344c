"""A run as its pages read it: the stored arrays by their names, and what the scenario says of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from reporting.json_file import read_json
from twin_master.errors import RunFolderError, TwinMasterError, said
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import smooth
from twin_master.network.twin import build_graphical_model
from twin_master.run_folder import CONFIG_NAME
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import (
    MOMENTS,
    LearntQuantity,
    printed_unit_of_quantity,
    quantity_titles,
    variable_paths,
)
from twin_master.store.writing import RUN_NAME, SUMMARY_NAME, open_run

if TYPE_CHECKING:
    import xarray as xr


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
    section, word = scenario.observation, scenario.observation.word
    scale, named = section.printed
    units = tuple("µε" if unit == "microstrain" else unit for unit in named)
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


@dataclass(frozen=True)
class Run:
    """A run of T steps, S joint states of K factors, G sensors, U controls, H predicted steps.

    ``run["filtered/mean"]`` is a variable of `run.nc` as an array, SI; see `docs/run_folder.md`.

    Attributes
    ----------
    tree : DataTree
        All groups of `run.nc`.
    scenario : Scenario
        What was flown.
    config, summary, calibration : mapping
        The JSON files of the folder; the last two are empty where there is none.
    """

    tree: "xr.DataTree"
    scenario: Scenario
    config: Mapping[str, Any]
    summary: Mapping[str, Any]
    calibration: Mapping[str, Any]

    def __getitem__(self, path: str) -> Float:
        """Return a variable."""
        return np.asarray(self.tree[path].values)

    def get(self, path: str) -> Float | None:
        """Return a variable; None where the run does not have it."""
        group, _, name = path.partition("/")
        return self[path] if group in self.tree.children and name in self.tree[group] else None

    @cached_property
    def factors(self) -> tuple[PrintedFactor, ...]:
        """The K factors of the state, as printed."""
        return printed_factors(self.scenario)

    @cached_property
    def sensors(self) -> PrintedSensors:
        """The G sensors, as printed."""
        return printed_sensors(self.scenario)

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the U controls."""
        return self.scenario.control_names

    @property
    def step(self) -> str:
        """What a step is called."""
        return self.scenario.mission.step_name

    @property
    def decides_ahead(self) -> bool:
        """Whether it is decided by the belief that is predicted for the next step."""
        told = self.tree["filtered/decision_probability"].attrs["long_name"]
        return "predicted" in told  # a policy that was given decides as it is made, not as the scenario says

    @property
    def watched(self) -> bool:
        """Whether it is that of a real asset."""
        return bool(self.config.get("watched"))

    @property
    def observed(self) -> Float:
        """What the sensors said, SI: (T, G); NaN where lost."""
        return self[f"observed/{self.sensors.quantity}"]

    @property
    def truth(self) -> Float | None:
        """True state, SI: (T, K); None where nobody knows it."""
        return self.get("truth/state")

    @cached_property
    def control_index(self) -> NDArray[np.int64]:
        """Control in force: (T,)."""
        return self["observed/control_index"].astype(np.int64)

    @property
    def steps(self) -> int:
        """Number T of steps."""
        return len(self.control_index)

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers of the steps: (T,)."""
        return self["observed/step"].astype(np.int64)

    @property
    def first_step(self) -> int:
        """Number of the first step."""
        return int(self.numbers[0])

    @property
    def horizon(self) -> int:
        """Number H of predicted steps."""
        return int(self["predicted/mean"].shape[1])

    @cached_property
    def scales(self) -> Float:
        """From the stored units of the factors to the printed ones: (K,)."""
        return np.array([factor.scale for factor in self.factors])

    @cached_property
    def model(self) -> GraphicalModel:
        """States and transitions that the twin believes."""
        return build_graphical_model(self.scenario)

    @cached_property
    def learnt(self) -> tuple[LearntQuantity, ...]:
        """What was learnt, in printed units, in the order in which it is stored; empty where nothing is."""
        if "learnt" not in self.tree.children:
            return ()
        found = []
        for variable, stored in self.tree["learnt"].data_vars.items():
            name = str(variable).removesuffix(f"_prior_{MOMENTS[0]}")
            if name == variable:
                continue
            scale, unit = printed_unit_of_quantity(name, str(stored.attrs["units"]), self.scenario)
            course, prior = (
                scale * np.stack([self[f"learnt/{name}{part}_{moment}"] for moment in MOMENTS], axis=-1)
                for part in ("", "_prior")
            )
            truth = self.get(f"truth/{name}")
            unit = "µε" if unit == "microstrain" else unit
            truth = None if truth is None else scale * truth
            found.append(LearntQuantity(name, quantity_titles(name)[1], unit, course, prior, truth))
        return tuple(found)

    def smoothed_until(self, now: int) -> Float:
        """Return p(D_t | o_0..o_now) for t = 0..now, (now + 1, S), from the filtered beliefs."""
        with np.errstate(divide="ignore"):
            rows = np.log(self["filtered/probability"][: now + 1])
        return smooth(self.model, self.control_index[: now + 1], rows)


def read_run(folder: Path) -> Run:
    """Read a run folder.

    Raises
    ------
    RunFolderError
        There is no ``run.nc``, it is damaged, or of another version.
    """
    tree = open_run(folder)
    config, summary, calibration = (
        _read_json(folder / name) for name in (CONFIG_NAME, SUMMARY_NAME, "calibration.json")
    )
    with RunFolderError.instead_of(TwinMasterError, after=" The run cannot be shown: fly it again."):
        scenario = parse_scenario(config.get("scenario", {}), str(folder / CONFIG_NAME))
    run = Run(tree, scenario, config, summary, calibration)
    missing = [path for path in variable_paths(scenario.observation.role) if run.get(path) is None]
    if missing:
        raise RunFolderError(said("run_folder.layout", name=RUN_NAME, path=missing[0]))
    return run


def _read_json(path: Path) -> dict[str, Any]:
    content = read_json(path, RunFolderError) if path.is_file() else {}
    if not isinstance(content, dict):
        raise RunFolderError(f"{path} must hold one JSON object: fly the run again.")
    return content
