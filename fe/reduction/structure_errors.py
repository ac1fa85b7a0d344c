"""Errors of a reduced structure, measured against its full model."""

from dataclasses import dataclass

import numpy as np

from fe.runtime.reduced import ReducedModel
from fe.structure.affine import AffineStructure, natural_frequencies, static_response


@dataclass(frozen=True)
class MeasuredErrors:
    """Largest errors of a reduced structure at random states, against the full model.

    Attributes
    ----------
    strain, displacement : float
        Of the outputs, relative to the largest of the same load and state; NaN where there are none.
    bound : float
        The largest certified bound there, relative in the same way, of strains and displacements.
    frequency : float
        Relative error of the natural frequencies, at the first and the last of the states.
    states : int
        Number of states.
    broken : int
        In how many of them an error is larger than its bound.
    """

    strain: float
    displacement: float
    bound: float
    frequency: float
    states: int
    broken: int


def measured_errors(
    structure: AffineStructure, model: ReducedModel, states: int, seed: int = 2021
) -> MeasuredErrors:
    """Compare a reduced model with the full one, each control at its nominal value, or one where that is 0.

    Parameters
    ----------
    structure : AffineStructure
        The full model.
    model : ReducedModel
        Its reduced model.
    states : int
        Random states, uniform in the ranges; each costs a factorisation.
    seed : int
        Of the states.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    random = np.random.default_rng(seed)
    low, high = model.validity_box.T
    first_control = len(model.chosen) - len(model.controls)
    broken = set()
    worst = {"strain": np.nan, "displacement": np.nan, "bound": 0.0, "frequency": 0.0}
    for number in range(states):
        vector = low + (high - low) * random.random(len(low))
        nominal = model.nominal[first_control:]
        vector[first_control:] = np.where(
            nominal == 0.0, np.clip(1.0, *model.validity_box[first_control:].T), nominal
        )
        values = dict(zip(model.chosen, vector.tolist(), strict=True))
        full, found = static_response(structure, values), model.static_response(vector)
        for what, wanted in (("strain", full.strain), ("displacement", full.output)):
            came, error = getattr(found, what), getattr(found, f"{what}_error_bound")
            if wanted.size:
                size, missed = float(np.abs(wanted).max()), float(np.abs(came - wanted).max())
                worst[what] = np.fmax(worst[what], missed / size)
                if missed > error:
                    broken.add(number)
                worst["bound"] = max(worst["bound"], error / size)
        if number in (0, states - 1):
            ratio = (
                model.modes(vector).frequency / natural_frequencies(structure, model.mode_count, values)[0]
            )
            worst["frequency"] = max(worst["frequency"], float(np.abs(ratio - 1.0).max()))
    return MeasuredErrors(
        **{name: float(value) for name, value in worst.items()}, states=states, broken=len(broken)
    )
