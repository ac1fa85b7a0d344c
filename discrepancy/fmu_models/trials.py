"""Translation of trials and patches into parameters of an FMU."""

from collections.abc import Collection, Mapping

import numpy as np

from discrepancy.campaign.records import Campaign, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.fmu_models.fmu_motion import FmuSimulator
from discrepancy.system.load_change import require_release
from discrepancy.system.response import Conditions
from fe.runtime.patch import ModelPatch


def effect_parameters(
    patch: ModelPatch,
    effects: Mapping[str, str],
    known_parameters: Collection[str],
    model_name: str,
) -> dict[str, float]:
    """Return the parameters that switch on the effects of an FMU for the primitives of a patch.

    An FMU can implement effects itself: `effect.ID.active` switches one on, and `effect.ID.KEY` is
    a number of its primitive. Primitives of a kind that the FMU does not implement are left out.

    Parameters
    ----------
    patch : ModelPatch
        The primitives.
    effects : mapping of str to str
        The ID of the FMU's effect, by the kind of the primitive that it implements.
    known_parameters : collection of str
        The names of parameters that are set already.
    model_name : str
        The name of the model in the error message.

    Raises
    ------
    ModelError
        If the patch has two primitives for one effect, or an effect is switched on already.
    """
    parameters: dict[str, float] = {}
    for primitive in patch:
        if primitive.kind not in effects:
            continue
        effect = f"effect.{effects[primitive.kind]}"
        if f"{effect}.active" in {*known_parameters, *parameters}:
            raise ModelError(
                f"Only one of the two primitives {primitive.kind!r} can be carried by {model_name} "
                f"({effect})."
            )
        parameters[f"{effect}.active"] = 1.0
        for key, value in primitive.to_mapping().items():
            # the place of an effect of an FMU is fixed: only its numbers are parameters
            if isinstance(value, int | float):
                parameters[f"{effect}.{key}"] = float(value)
    return parameters


def first_trial(campaign: Campaign, *, is_dynamic: bool) -> Trial | None:
    """Return the first dynamic trial of a campaign, or the first at rest; None if there is none."""
    for trial in campaign.trials:
        if trial.is_dynamic is is_dynamic:
            return trial
    return None


def trial_without_readings(kind: TrialKind, interval: float) -> Trial:
    """Return a trial without readings, for scales without a campaign.

    The trial has one row if it is static, else 400 samples at the interval [s].
    """
    count = 1 if kind is TrialKind.STATIC else 400
    return Trial.plain("", kind, (), interval * np.arange(float(count)))


def release_values(fmu: FmuSimulator, trial: Trial, conditions: Conditions) -> dict[str, float]:
    """Return the displacement [m], and velocity [m/s], of the release point by variable of the FMU.

    The first entry of `conditions.initial` is the state of the first mode, relative to the nominal
    displacement: for a release from rest the relative deviation of the displacement, else amplitude
    and velocity, the velocity also divided by the angular frequency.

    Raises
    ------
    ModelError
        If the FMU has no variable that releases it, or none for the velocity although the record
        does not begin at rest.
    """
    release = require_release(trial)
    variables = fmu.release_variables
    if not variables:
        raise ModelError(
            f"The FMU model {fmu.description.name!r} cannot ring down: state in [release] the "
            "FMU's parameter of the release displacement, or the force that holds it."
        )
    first_mode = conditions.initial[0] if len(conditions.initial) else np.zeros(2)
    if release.at_rest:
        return {variables[0]: release.displacement * float(1.0 + first_mode[0])}
    if len(variables) < 2:
        raise ModelError(
            f"The ring-down {trial.name!r} does not begin at rest, which the FMU model "
            f"{fmu.description.name!r} can follow only if [release] names parameters of "
            "displacement and velocity."
        )
    angular_frequency = fmu.nominal_step_choice(trial).angular_frequency
    amplitudes = release.displacement * first_mode * (1.0, angular_frequency)
    return dict(zip(variables, amplitudes.tolist(), strict=True))
