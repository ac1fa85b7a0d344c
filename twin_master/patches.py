"""Missing effects in a mission: in the asset that flies, and in the model that the twin believes."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.design import WingDesign
from fe.patch import BoucWen, MicroSlip, SensorDrift
from fe.patch_arrays import PatchArrays
from fe.patch_cache import patch_arrays
from fe.patched_steps import PatchedSteps
from fe.patched_wing import PatchedWing
from fe.reduced import ReducedModel
from fe.state import DigitalState
from fmu_asset.behaviour import Moment, UnacceptableEffectError, WingParameters
from fmu_asset.patch_file import PatchFile, load_patch
from fmu_asset.patched_model import effect_values, patched_behaviour
from fmu_asset.patched_runtime import output_channels, plain_effects
from fmu_asset.variables import QUASI_STATIC
from reporting.progress import Progress, SilentProgress
from twin_master.asset_source import check_wing_scenario, wing_observation_table
from twin_master.errors import MissionInputError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws
from twin_master.scenario import Scenario

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
    for effect in patch.for_outputs(output_channels(gauge_count), where):
        for item in effect.patch:
            drifts = isinstance(item, SensorDrift) and item.exponent != 0.0
            if drifts or isinstance(item, MicroSlip | BoucWen):
                raise MissionInputError(
                    f"the effect {effect.id!r} depends on {'time' if drifts else 'the loads before'}, and "
                    "the twin predicts the readings of each state and control once for the whole mission: "
                    "leave it out of `asset.model_patch`."
                )


def model_observation_table(
    wing: ReducedModel,
    scenario: Scenario,
    draws: ParameterDraws,
    model: GraphicalModel,
    patch_file: Path | None,
    design: WingDesign | None,
) -> Float:
    """Return the strains (E, S, U, G) that the twin predicts, with the effects of its patch if it has one.

    Raises
    ------
    MissingObservationModelError, OutsideModelError
        As `wing_observation_table`.
    PatchFileError, MissionInputError
        The patch cannot be read, or the model cannot carry it.
    """
    if patch_file is None:
        return wing_observation_table(wing, scenario, draws, model)
    check_wing_scenario(scenario, wing.gauge_count)
    patch = load_patch(patch_file)
    check_model_patch(patch, wing.gauge_count, str(patch_file))
    effects = plain_effects(patch.for_outputs(output_channels(wing.gauge_count)))
    arrays = arrays_of(design, patch, SilentProgress())
    steps = None if arrays is None else partial(PatchedSteps, wing, PatchedWing(arrays))
    behaviour = patched_behaviour(wing, effects, steps)
    moment = Moment(0.0, 0.0, effect_values(effects, active=True))
    states, controls = model.states.coordinates, scenario.control
    first, second = (scenario.state_names.index(name) for name in ("z1", "z2"))
    force = scenario.asset.load.get("tip_force", 0.0)
    table = np.empty((len(draws.values), len(states), len(controls), wing.gauge_count))
    try:
        for row, value in enumerate(draws.values):
            parameters = _parameters(float(value))
            for state, levels in enumerate(states):
                for index, control in enumerate(controls):
                    inputs = (
                        control.values["load_factor"],
                        float(levels[first]),
                        float(levels[second]),
                        force,
                    )
                    table[row, state, index] = behaviour.start(parameters, inputs, moment).strain
    except UnacceptableEffectError as error:
        raise MissionInputError(f"the twin's model cannot carry {patch_file}: {error}") from error
    return table


def _parameters(young_modulus_factor: float) -> WingParameters:
    state = DigitalState()
    return WingParameters(
        young_modulus_factor=young_modulus_factor,
        damping_alpha=state.damping_alpha,
        damping_beta=state.damping_beta,
        servo_mass=state.servo_mass,
        pitot_mass=state.pitot_mass,
        initial_tip_displacement=0.0,
        response=QUASI_STATIC,
    )


def effect_names(patch_file: Path | None, gauge_count: int) -> tuple[str, ...]:
    """Return the variables that a patch adds to the FMU of a wing.

    Raises
    ------
    PatchFileError
        The patch cannot be read, or the FMU cannot carry it.
    """
    if patch_file is None:
        return ()
    effects = plain_effects(load_patch(patch_file).for_outputs(output_channels(gauge_count), str(patch_file)))
    return tuple(effect_values(effects, active=False))


def arrays_of(design: WingDesign | None, patch: PatchFile | None, progress: Progress) -> PatchArrays | None:
    """Return the wing in the basis for patches; None where the patch does not need it.

    Raises
    ------
    FiniteElementError
        The design cannot be modelled.
    """
    if design is None or patch is None or not patch.needs_arrays:
        return None
    return patch_arrays(design, progress)
