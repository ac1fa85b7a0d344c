"""What the records of a campaign can tell of a model's calibrated parameters, before effects are sought."""

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.problem import Problem
from discrepancy.judgement.separability import begun
from discrepancy.models.interface import Model
from discrepancy.sentences import said

FloatArray = NDArray[np.float64]

LEFT = 0.9
"""A parameter of whose prior deviation the records leave more than this share is not observable in them."""


def prior_left(campaign: Campaign, model: Model) -> dict[str, float]:
    """Return the share of its prior deviation that the fitted records leave to each calibrated parameter.

    From the information matrix at the prior mean. What begins in an unknown state begins as the records say:
    of a model at rest no parameter shows. Gains, zeros, initial states, constants of inputs and the other
    parameters follow within their priors (what they can do as well is projected out).
    """
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    point = begun(problem)
    count, known = problem.shared.size, len(problem.shared.parameter_mean)
    total = np.diag(problem.shared.precision)
    for number, data in enumerate(problem.trials):
        parts = problem.linearise(number, point, Candidate())
        found = problem.derivatives(number, point, parts, Candidate())
        normal = found.normal(found.products(), np.ones(len(data.trial.channels)))
        local = found.local_size
        own = normal[:local, :local] + np.diag(data.unknowns.precision)
        cross, index = normal[:local, local:], found.index[found.index < count]
        rest = normal[local:, local:] - cross.T @ np.linalg.lstsq(own, cross, rcond=1e-12)[0]
        total[np.ix_(index, index)] += rest[: len(index), : len(index)]
    left = np.sqrt(np.diag(np.linalg.pinv(total, hermitian=True))[:known])
    return {
        item.name: float(value)
        for item, value, scale in zip(model.parameters, left, problem.shared.parameter_scale, strict=True)
        if scale > 0.0
    }


def unobservable(campaign: Campaign, model: Model) -> str | None:
    """Return which calibrated parameters the records do not tell, in one sentence; None if they tell all."""
    left = {name: share for name, share in prior_left(campaign, model).items() if share > LEFT}
    if not left:
        return None
    names = ", ".join(f"{name!r} ({share:.0%})" for name, share in left.items())
    return said("faults.unobservable", parameters="parameters" if len(left) > 1 else "parameter", names=names)
