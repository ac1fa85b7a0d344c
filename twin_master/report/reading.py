"""Reading a run folder for a report: stored arrays, and printed names and units."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from reporting.json_file import JsonObject, JsonRecord, read_json
from twin_master.errors import RunFolderError, TwinMasterError
from twin_master.mission.knowledge_file import CALIBRATION_NAME
from twin_master.network.estimator import MOMENTS
from twin_master.network.graphical_model import GraphicalModel, build_graphical_model
from twin_master.network.inference import smooth
from twin_master.run_folder import CONFIG_NAME
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state
from twin_master.store.mission_result import (
    LearntQuantity,
    printed_unit_of_quantity,
    quantity_titles,
)
from twin_master.store.schema import variable_paths
from twin_master.store.writing import RUN_NAME, SUMMARY_NAME, open_run

if TYPE_CHECKING:
    import xarray as xr


NORMAL_95 = 1.959963984540054
"""Half-width of a 95 % interval of the normal distribution, in standard deviations."""
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


@dataclass(frozen=True)
class PrintedFactor:
    """A factor of the state, as reports print it.

    Attributes
    ----------
    symbol : str
        The name with its trailing digits as a subscript, such as z₁.
    title : str
        The name of the quantity in words.
    unit : str
        The unit as it is printed.
    scale : float
        The factor from the stored unit to the printed one.
    levels : tuple of float
        The levels in the printed unit, the lowest first.
    """

    symbol: str
    title: str
    unit: str
    scale: float
    levels: tuple[float, ...]

    @property
    def label(self) -> str:
        """The symbol and the printed unit, as an axis shows them."""
        return f"{self.symbol} ({self.unit})"


@dataclass(frozen=True)
class PrintedSensors:
    """The G sensors of a scenario, as reports print them.

    Attributes
    ----------
    word : str
        The noun for one sensor, such as "gauge".
    titles : tuple of str
        The title of each sensor.
    quantity : str
        The quantity that the sensors measure, such as "strain".
    units : tuple of str
        The printed unit of each sensor.
    scale : float
        The factor from the stored unit to the printed one.
    named : bool
        Whether the titles come from the scenario; otherwise they are numbers such as "gauge 1".
    """

    word: str
    titles: tuple[str, ...]
    quantity: str
    units: tuple[str, ...]
    scale: float
    named: bool

    @property
    def unit(self) -> str:
        """The unit of all sensors; empty if they have different units."""
        return self.units[0] if len(set(self.units)) == 1 else ""


def printed_factors(scenario: Scenario) -> tuple[PrintedFactor, ...]:
    """Return the factors of a scenario's state, as reports print them."""
    factors = []
    for factor in scenario.state:
        scale, unit = printed_state(factor.unit)
        factors.append(
            PrintedFactor(
                symbol=symbol(factor.name),
                title=factor.title or factor.name,
                unit=unit,
                scale=scale,
                levels=tuple(scale * level for level in factor.levels),
            )
        )
    return tuple(factors)


def printed_sensors(scenario: Scenario) -> PrintedSensors:
    """Return the sensors of a scenario, as reports print them."""
    observation = scenario.observation
    scale, units = observation.printed
    numbers = range(1, observation.count + 1)
    return PrintedSensors(
        word=observation.word,
        titles=observation.titles or tuple(f"{observation.word} {number}" for number in numbers),
        quantity=observation.role,
        units=tuple(_short_unit(unit) for unit in units),
        scale=scale,
        named=bool(observation.titles),
    )


def _short_unit(unit: str) -> str:
    """Return a unit as reports print it: "µε" for "microstrain", others as they are."""
    return "µε" if unit == "microstrain" else unit


def short_number(value: float) -> str:
    """Return a number short enough for the tick of an axis, such as 0.5, 1500 or 1e-4."""
    text = f"{value:g}"
    if len(text.lstrip("-")) <= 4:
        return text
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def symbol(name: str) -> str:
    """Return a name with its trailing digits as a subscript: z1 becomes z₁."""
    stem = name.rstrip("0123456789")
    if not stem:
        return name
    digits = name[len(stem) :]
    return stem + digits.translate(_SUBSCRIPTS)


class Moments(NamedTuple):
    """Moments of posteriors, as `run.nc` stores them on the last axis of an array.

    Attributes
    ----------
    mean, standard_deviation : array
        The mean and the standard deviation.
    lower, upper : array
        The ends of the central 90 % interval.
    """

    mean: Float
    standard_deviation: Float
    lower: Float
    upper: Float


def moments_of(values: Float) -> Moments:
    """Split a (..., 4) array of moments along its last axis into four (...) arrays."""
    return Moments(*np.moveaxis(values, -1, 0))


@dataclass(frozen=True)
class Run:
    """A run of T steps, S joint states of K factors, G sensors, U controls and H predicted steps.

    ``run["filtered/mean"]`` is a variable of `run.nc` as an array in SI units; the page
    `docs/reference/run_folder.md` lists the variables.

    Attributes
    ----------
    tree : DataTree
        All groups of `run.nc`.
    scenario : Scenario
        The scenario that was flown.
    config : mapping
        The content of the file `config.json`.
    summary, calibration : mapping
        The content of `summary.json` and of `calibration.json`; empty if the file is missing.
    """

    tree: "xr.DataTree"
    scenario: Scenario
    config: JsonRecord
    summary: JsonRecord
    calibration: JsonRecord

    def __getitem__(self, path: str) -> Float:
        """Return the variable at a path such as "filtered/mean"."""
        return np.asarray(self.tree[path].values)

    def get(self, path: str) -> Float | None:
        """Return the variable at a path "GROUP/NAME"; None if the run does not have it."""
        group, _, name = path.partition("/")
        if group in self.tree.children and name in self.tree[group]:
            return self[path]
        return None

    @cached_property
    def factors(self) -> tuple[PrintedFactor, ...]:
        """The K factors of the state, as reports print them."""
        return printed_factors(self.scenario)

    @cached_property
    def sensors(self) -> PrintedSensors:
        """The G sensors, as reports print them."""
        return printed_sensors(self.scenario)

    @property
    def controls(self) -> tuple[str, ...]:
        """The names of the U controls."""
        return self.scenario.control_names

    @property
    def step_word(self) -> str:
        """The scenario's noun for a step, such as "step" or "shift"."""
        return self.scenario.mission.step_name

    @property
    def decides_on_prediction(self) -> bool:
        """Whether the control of a step is chosen by the belief that was predicted for this step.

        Otherwise it is chosen by the last filtered belief. The answer comes from the description of
        a stored variable, because a policy from a file may differ in this from the scenario.
        """
        description = self.tree["filtered/decision_probability"].attrs["long_name"]
        return "predicted" in description

    @property
    def is_watched(self) -> bool:
        """Whether the run is the watch of a real asset, not a simulated flight."""
        return bool(self.config.get("watched"))

    @property
    def observations(self) -> Float:
        """The readings of the sensors as a (T, G) array in SI units; NaN where one was lost."""
        return self[f"observed/{self.sensors.quantity}"]

    @property
    def true_state(self) -> Float | None:
        """The true state as a (T, K) array in SI units; None if it is not known."""
        return self.get("truth/state")

    @cached_property
    def control_index(self) -> NDArray[np.int64]:
        """The index of the control in force in each step, a (T,) array."""
        return self["observed/control_index"].astype(np.int64)

    @property
    def step_count(self) -> int:
        """The number T of steps."""
        return len(self.control_index)

    @cached_property
    def step_numbers(self) -> NDArray[np.int64]:
        """The numbers of the steps, a (T,) array."""
        return self["observed/step"].astype(np.int64)

    @property
    def first_step(self) -> int:
        """The number of the first step; the steps of a watch may begin late."""
        return int(self.step_numbers[0])

    @property
    def horizon(self) -> int:
        """The number H of predicted steps."""
        return int(self["predicted/mean"].shape[1])

    @cached_property
    def factor_scales(self) -> Float:
        """The factors (K,) that convert the K state factors from stored to printed units."""
        return np.array([factor.scale for factor in self.factors])

    @cached_property
    def model(self) -> GraphicalModel:
        """The twin's graphical model: its states and transitions."""
        return build_graphical_model(self.scenario)

    @cached_property
    def learnt_quantities(self) -> tuple[LearntQuantity, ...]:
        """The quantities that the twin learnt, in printed units and in the order of the store."""
        if "learnt" not in self.tree.children:
            return ()
        quantities = []
        ending = f"_prior_{MOMENTS[0]}"  # each learnt quantity has one variable with this ending
        for variable, stored_array in self.tree["learnt"].data_vars.items():
            if str(variable).endswith(ending):
                name = str(variable).removesuffix(ending)
                quantities.append(self._learnt_quantity(name, str(stored_array.attrs["units"])))
        return tuple(quantities)

    def _learnt_quantity(self, name: str, stored_unit: str) -> LearntQuantity:
        """Return a learnt quantity by its name in the store, in printed units."""
        scale, unit = printed_unit_of_quantity(name, stored_unit, self.scenario)
        course = [self[f"learnt/{name}_{moment}"] for moment in MOMENTS]
        prior = [self[f"learnt/{name}_prior_{moment}"] for moment in MOMENTS]
        truth = self.get(f"truth/{name}")
        return LearntQuantity(
            name=name,
            title=quantity_titles(name)[1],
            unit=_short_unit(unit),
            posterior=scale * np.stack(course, axis=-1),
            prior=scale * np.stack(prior, axis=-1),
            truth=None if truth is None else scale * truth,
        )

    def smoothed_until(self, now: int) -> Float:
        """Return the smoothed beliefs p(D_t | o_0..o_now) for t = 0..now, a (now + 1, S) array.

        They use the observations up to the step in row `now` alone.
        """
        with np.errstate(divide="ignore"):  # impossible states have the logarithm -inf
            log_belief = np.log(self["filtered/probability"][: now + 1])
        return smooth(self.model, self.control_index[: now + 1], log_belief)


def read_run(folder: Path) -> Run:
    """Read the run in a folder for its report, and check that no variable is missing.

    Parameters
    ----------
    folder : Path
        The folder of a run, with `run.nc` and `config.json`.

    Returns
    -------
    Run
        The scenario, the stored arrays, and the JSON files of the folder.

    Raises
    ------
    RunFolderError
        If `run.nc` is missing, damaged, or lacks a variable of this version; if a JSON file is
        damaged; or if the scenario in `config.json` is not valid.
    """
    tree = open_run(folder)
    config = _read_object(folder / CONFIG_NAME)
    summary = _read_object(folder / SUMMARY_NAME)
    calibration = _read_object(folder / CALIBRATION_NAME)
    with RunFolderError.instead_of(
        TwinMasterError, after=" The run cannot be shown: fly it again."
    ):
        scenario = parse_scenario(config.get("scenario", {}), str(folder / CONFIG_NAME))
    run = Run(tree, scenario, config, summary, calibration)
    for path in variable_paths(scenario.observation.role):
        if run.get(path) is None:
            raise RunFolderError(
                f"{RUN_NAME} does not have the layout of a run of this version "
                f"(the variable {path} is missing): fly the run again."
            )
    return run


def _read_object(path: Path) -> JsonObject:
    """Return the object in a JSON file; empty if the file is missing.

    Raises
    ------
    RunFolderError
        If the file is damaged, or holds something else than an object.
    """
    content = read_json(path, RunFolderError) if path.is_file() else {}
    if not isinstance(content, dict):
        raise RunFolderError(f"{path} must hold one JSON object: fly the run again.")
    return content
