"""`uav-twin init fmu`: a twin of any FMU, with a drafted binding."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, parse_binding
from fmu_asset.client.draft import draft_binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.packing.script import script_fmu
from reporting.errors import FileNotWrittenError
from reporting.words import comma_list
from scenarios.assets import gear_pump
from uav_twin.projects.project import (
    CHECK_MISSION,
    FLY_MISSION,
    VIEW_FLIGHT,
    Project,
    filled_in,
    rounded_to,
)

BINDING_NAME = "binding.toml"
OBSERVATION = "sensors"
"""The name of the observation in the binding."""
_LEVELS = 5
_LARGEST_LOSS = 0.8
"""Largest level of a damage, as a fraction of its declared maximum or of one."""
_GENTLE = 0.8
"""The gentler control, as a fraction of the start values of the inputs."""
_REWARDS = (-0.1, 0.1)
"""Rewards of the gentle and of the hard control."""
_WORSENING = (0.03, 0.08)
"""Probabilities that a damage gets worse by a level, under both controls."""
_GAMMA = 0.8
"""The discount factor of the mission, as in its template."""
_STEPS_TO_SETTLE = 5
_NOISE = 0.05
"""Noise as a fraction of the change between no damage and the largest one."""


@dataclass(frozen=True)
class FmuDraft:
    """What is guessed about an FMU.

    Attributes
    ----------
    binding : Binding
        The roles of its variables, with one observation of all sensors.
    controls : dict of str to dict of str to float
        The inputs under the gentle and the hard control.
    levels : dict of str to list of float
        The levels of each damage.
    parameter : str
        A parameter that is taken as uncertain.
    value : float
        Its start value.
    """

    binding: Binding
    controls: Mapping[str, Mapping[str, float]]
    levels: Mapping[str, list[float]]
    parameter: str
    value: float


def draft_fmu(description: FmuDescription) -> FmuDraft:
    """Guess roles and values of an FMU's variables from names, units and ranges.

    Raises
    ------
    FileNotWrittenError
        If no input or parameter is named like damage, or no parameter has a start value.
    """
    binding = parse_binding(tomllib.loads(draft_binding(description)))
    variables = {variable.name: variable for variable in description.variables}
    if not binding.health:
        names = [entry.variable for entry in (*binding.control.values(), *binding.load.values())]
        raise FileNotWrittenError(
            f"No input of {description.path.name} is named like damage, such as wear, fouling or "
            f"loss, which the twin is to estimate (inputs: {comma_list(names)}): draft a binding "
            f"by `uav-twin fmu bind {description.path.name} --out binding.toml`, move the right "
            "table to [health], and write the scenario as in docs/tutorials/your_own_fmu.md."
        )

    def start_of(name: str) -> float:
        """Return the declared start value of a variable; zero if it has none."""
        start = variables[name].start
        return float(start.split()[0]) if start else 0.0

    hard = {}
    for key, entry in binding.control.items():
        declared = variables[entry.variable]
        value = start_of(entry.variable) or 1.0
        if declared.minimum is not None:
            value = max(value, declared.minimum)
        if declared.maximum is not None:
            value = min(value, declared.maximum)
        hard[key] = value
    levels = {}
    for key, entry in binding.health.items():
        maximum = variables[entry.variable].maximum
        largest = _LARGEST_LOSS * (1.0 if maximum is None else maximum)
        levels[key] = np.linspace(0.0, largest, _LEVELS).round(12).tolist()
    parameters = {key: start_of(entry.variable) for key, entry in binding.parameter.items()}
    uncertain = [key for key, value in parameters.items() if value != 0.0]
    if not uncertain:
        raise FileNotWrittenError(
            f"No parameter of {description.path.name} has a start value other than zero, and the "
            "twin needs one that is not known exactly: give the FMU such a parameter."
        )
    gentle = {key: _GENTLE * value for key, value in hard.items()}
    controls = {"gentle": gentle, "hard": hard} if hard else {"only": {}}
    return FmuDraft(binding, controls, levels, uncertain[0], parameters[uncertain[0]])


def _probe(fmu_file: Path, binding_file: Path, draft: FmuDraft) -> FloatArray:
    """Return the readings (U, L, G) under each control at each level of all damages."""
    readings = []
    for inputs in draft.controls.values():
        readings_of_levels = []
        for level in range(_LEVELS):
            health = {name: levels[level] for name, levels in draft.levels.items()}
            with FmiAsset(fmu_file, binding_file) as asset:
                for _ in range(_STEPS_TO_SETTLE):
                    observation = asset.step(inputs, health)
            readings_of_levels.append(observation.values)
        readings.append(readings_of_levels)
    return np.array(readings)


def _binding_text(draft: FmuDraft, fmu_name: str) -> str:
    """Return the text of the binding file, with one observation of all sensors."""
    variables: list[str] = []
    units: list[str] = []
    for entry in draft.binding.observation.values():
        variables += entry.variables
        units += entry.units
    return filled_in(
        "binding.toml",
        schema="binding",
        fmu=fmu_name,
        binding=draft.binding,
        observation=OBSERVATION,
        variables=variables,
        units=units,
    )


def _mission_text(name: str, fmu_name: str, draft: FmuDraft, readings: FloatArray) -> str:
    """Return the text of an FMU's mission, given its readings, see `_probe`."""
    controls = []
    for control, inputs in draft.controls.items():
        pairs = ", ".join(f"{key} = {value:g}" for key, value in inputs.items())
        controls.append({"name": control, "inputs": f"{{ {pairs} }}"})
    names = list(draft.controls)
    growth = next(iter(draft.levels.values()))[-1] / 15.0
    sensors = _sensors(draft, readings)
    return filled_in(
        "mission.toml",
        schema="scenario",
        name=name,
        title=f"A mission of {name}",
        steps=30,
        controls=controls,
        states=[_state(damage, levels) for damage, levels in draft.levels.items()],
        role=OBSERVATION,
        sensors=sensors,
        probability=_inline(dict(zip(names, _WORSENING, strict=False))),
        rewards=_inline(dict(zip(names, _REWARDS, strict=False))),
        control_weight=sensors["control_weight"],
        asset=(
            f'kind = "fmu"  # what flies\nfile = "{fmu_name}"\nbinding = "{BINDING_NAME}"\n'
            f"parameters = {{ {draft.parameter} = {rounded_to(1.01 * draft.value, 4)} }}"
            "  # the true one, unseen by the twin"
        ),
        belief='kind = "asset"  # what the FMU itself shows at each level; it must have no memory',
        parameter={
            "name": draft.parameter,
            "mean": draft.value,
            "deviation": rounded_to(0.02 * abs(draft.value)),
        },
        growth={"last_step": 17, "text": f"gain = {rounded_to(growth, 3)}"},
    )


def _state(damage: str, levels: list[float]) -> dict[str, object]:
    """Return the table of a damage with its levels."""
    return {
        "name": damage,
        "title": damage.replace("_", " "),
        "levels_key": "levels",
        "levels": levels,
        "prior": [1] + [0] * (len(levels) - 1),
    }


def _sensors(draft: FmuDraft, readings: FloatArray) -> dict[str, object]:
    """Return titles, noise and limit of the sensors, and the weight of the control's reward.

    `readings` are (controls, levels, sensors), see `_probe`. The limit holds for the sensor whose
    reading rises most with the damage, relative to its healthy value.
    """
    hard_readings = readings[-1]  # (levels, sensors), under the hardest control
    healthy = hard_readings[0]
    damaged = hard_readings[-1]
    change = np.abs(damaged - healthy)
    largest_readings = np.abs(hard_readings).max(axis=0)
    deviations = np.where(change > 0.0, _NOISE * change, 0.01 * largest_readings)
    noise = [rounded_to(deviation) or 1.0 for deviation in deviations.tolist()]
    rise = np.where(healthy > 0.0, (damaged - healthy) / np.where(healthy > 0.0, healthy, 1.0), 0.0)
    limited_sensor = int(np.argmax(rise))
    limit = rounded_to(float(hard_readings[_LEVELS - 2, limited_sensor])) or 1.0
    # If possible, the gentle control becomes the better one at the last level but one: there it
    # saves as much as it costs, at once and in later steps, in which the FMU is worn less.
    saved_at_once = (hard_readings - readings[0])[:, limited_sensor] / limit
    loss_of_level = float(np.diff(hard_readings[: _LEVELS - 1, limited_sensor]).mean()) / limit
    saved_later = _GAMMA / (1.0 - _GAMMA) * (_WORSENING[1] - _WORSENING[0]) * loss_of_level
    saved = float(saved_at_once[_LEVELS - 3 : _LEVELS - 1].mean()) + max(saved_later, 0.0)
    weight = saved / (_REWARDS[1] - _REWARDS[0])
    titles: list[str] = []
    for entry in draft.binding.observation.values():
        titles += entry.variables
    return {
        "titles": titles,
        "titles_text": "[" + ", ".join(f'"{title}"' for title in titles) + "]",
        "noise_text": f"standard_deviation = {noise}",
        "limit_text": f"health_limit = {limit}",
        "limited_text": f"health_sensors = [{limited_sensor + 1}]",
        "scale_text": f"error_scale = {noise}",
        "control_weight": rounded_to(weight, 3) if weight > 0.0 else 1.0,
    }


def _inline(values: Mapping[str, float]) -> str:
    """Return numbers by name as an inline table of TOML."""
    return "{ " + ", ".join(f"{name} = {value}" for name, value in values.items()) + " }"


def fmu_project(name: str, fmu_file: Path | None) -> Project:
    """Return the project of an FMU, by default of the shipped gear pump."""
    with TemporaryDirectory(prefix="uav_twin_") as temporary_folder:
        folder = Path(temporary_folder)
        if fmu_file is None:
            fmu_file = folder / "gear_pump.fmu"
            fmu_file.write_bytes(script_fmu(gear_pump.__file__).content)
        draft = draft_fmu(read_fmu(fmu_file))
        binding = _binding_text(draft, fmu_file.name)
        binding_file = folder / BINDING_NAME
        binding_file.write_text(binding, encoding="utf-8")
        readings = _probe(fmu_file, binding_file, draft)
        content = fmu_file.read_bytes()
    mission = _mission_text(name, fmu_file.name, draft, readings)
    return Project(
        title="An FMU, and the mission of its twin.",
        texts={BINDING_NAME: binding, "mission.toml": mission},
        contents={fmu_file.name: content},
        files={
            fmu_file.name: "the FMU",
            BINDING_NAME: "which variable of the FMU plays which role",
            "mission.toml": "what the twin sees, believes and may choose, and what really happens",
        },
        commands=(
            (
                f"uav-twin fmu check {fmu_file.name} --binding {BINDING_NAME} --cycles 0",
                "Check the FMU and its binding.",
            ),
            CHECK_MISSION,
            FLY_MISSION,
            VIEW_FLIGHT,
            (
                "uav-twin run mission.toml --seeds 0:5 --out runs/many",
                "Fly it under five seeds, and see what the policy earns.",
            ),
        ),
    )
