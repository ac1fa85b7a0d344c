"""Trials and patches as an FMU takes them."""

from collections.abc import Collection, Mapping

import numpy as np
from fe.runtime.patch import ModelPatch

from discrepancy.campaign.records import Campaign, Trial, TrialKind
from discrepancy.errors import ModelError


def effect_parameters(
    patch: ModelPatch,
    effects: Mapping[str, str],
    known_parameters: Collection[str],
    model_name: str,
) -> dict[str, float]:
    """Return the parameters of the effects that an FMU carries itself.

    Parameters
    ----------
    patch : ModelPatch
        Any primitives.
    effects : mapping of str to str
        Kinds of primitives that the FMU carries, to the ids of its effects.
    known_parameters : collection of str
        Parameters that are set already.
    model_name : str
        The model as it is called in a sentence.

    Raises
    ------
    ModelError
        If the patch has two primitives for one effect.
    """
    parameters: dict[str, float] = {}
    for primitive in patch:
        if primitive.kind not in effects:
            continue
        effect = f"effect.{effects[primitive.kind]}"
        if f"{effect}.active" in {*known_parameters, *parameters}:
            raise ModelError(
                f"Of the two primitives {primitive.kind!r} {model_name} carries one ({effect})."
            )
        parameters[f"{effect}.active"] = 1.0
        for key, value in primitive.to_mapping().items():
            if key != "kind":
                parameters[f"{effect}.{key}"] = float(value)
    return parameters


def first_trial(campaign: Campaign, *, is_dynamic: bool) -> Trial | None:
    """Return the first dynamic trial of a campaign, or the first at rest; None if there is none."""
    for trial in campaign.trials:
        if trial.is_dynamic is is_dynamic:
            return trial
    return None


def bare_trial(kind: TrialKind, interval: float) -> Trial:
    """Return a trial without readings, for scales without a campaign."""
    count = 1 if kind is TrialKind.STATIC else 400
    return Trial.plain("", kind, (), interval * np.arange(float(count)))
