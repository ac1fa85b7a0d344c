"""Missing effects in a mission: in the asset that flies, and in the model that the twin believes."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.runtime.patch import PortForce, SensorDrift
from fe.runtime.reduced import ReducedModel
from fe.wing.design import WingDesign
from fmu_asset.packing.patch_file import PatchFile, load_patch
from fmu_asset.packing.wing_packing import arrays_for
from fmu_asset.slaves.base import UnacceptableValuesError
from fmu_asset.slaves.behaviour import StructureBehaviour
from fmu_asset.slaves.effects import Effects, effect_rows, switch_of
from fmu_asset.slaves.table import structure_table
from twin_master.assets.interface import asked_table
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]


def check_model_patch(patch: PatchFile, gauge_count: int, where: str = "The patch") -> None:
    """Check that a model without time can carry the effects of a patch.

    Raises
    ------
    MissionInputError
        An effect depends on time or on what happened before.
    PatchFileError
        The wing cannot carry an effect.
    """
    for effect in patch.for_gauges(gauge_count, where).effects:
        for item in effect.patch:
            drifts = isinstance(item, SensorDrift) and item.exponent != 0.0
            if drifts or (isinstance(item, PortForce) and item.hysteretic):
                raise MissionInputError(
                    f"the effect {effect.id!r} depends on {'time' if drifts else 'the loads before'}, and "
                    "the twin predicts the readings of each state and control once for the whole mission: "
                    "leave it out of `belief.patch`."
                )


def patched_observation_table(
    wing: ReducedModel,
    scenario: Scenario,
    draws: ParameterDraws,
    model: GraphicalModel,
    patch: PatchFile,
    design: WingDesign,
    where: str,
) -> Float:
    """Return the strains (E, S, U, G) that the twin predicts with the effects of its patch.

    Raises
    ------
    PatchFileError, MissionInputError
        The model cannot carry the patch.
    """
    check_model_patch(patch, wing.gauge_count, where)
    effects = patch.for_gauges(wing.gauge_count).plain
    rows, roles = structure_table(wing, {})
    acting = Effects(effects, wing.gauge_count, arrays_for(design, patch))
    behaviour = StructureBehaviour(wing, rows, roles, acting)
    on = {switch_of(effect): 1.0 for effect in effects}
    behaviour.tune({row.name: float(row.start or 0.0) for row in effect_rows(effects, 0, on)}, 0.0)
    nominal = {row.name: row.start or 0.0 for row in rows}
    names = [row.name for row in rows if row.causality == "input"]
    force = scenario.asset.constant_load.get("tip_force", 0.0)

    def ask(start: Mapping[str, float], control: Mapping[str, float], health: Mapping[str, float]) -> Float:
        given = {**control, **{f"health.{name}": loss for name, loss in health.items()}, "tip_force": force}
        return np.array(behaviour.start(start, 0.0, [given[name] for name in names])[: wing.gauge_count])

    names_of_states, states = scenario.state_names, model.states.coordinates
    controls = [control.values for control in scenario.control]
    drawn = [{**nominal, "young_modulus_factor": float(value)} for value in draws.values]
    try:
        return np.array([asked_table(names_of_states, states, controls, partial(ask, e)) for e in drawn])
    except UnacceptableValuesError as error:
        raise MissionInputError(f"the twin's model cannot carry {where}: {error}") from error


def effect_names(patch_file: Path, gauge_count: int) -> tuple[str, ...]:
    """Return the variables that a patch adds to the FMU of a wing.

    Raises
    ------
    PatchFileError
        The patch cannot be read, or the FMU cannot carry it.
    """
    effects = load_patch(patch_file).for_gauges(gauge_count, str(patch_file)).plain
    return tuple(row.name for row in effect_rows(effects, 0, {}))
