"""What the records of a campaign can tell of a model's calibrated parameters, before effects are sought."""

import numpy as np

from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.elimination import eliminated
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.judgement.separability import begun
from discrepancy.models.interface import Model
from discrepancy.sentences import said

LEFT = 0.9
"""A parameter of whose prior deviation the records leave more than this share is not observable in them."""


def prior_left(campaign: Campaign, model: Model) -> dict[str, float]:
    """Return the share of its prior deviation that the fitted records leave to each calibrated parameter.

    From the information matrix at the prior mean. What begins in an unknown state begins as the records say:
    of a model at rest no parameter shows. Gains, zeros, initial states, constants of inputs and the other
    parameters follow within their priors (what they can do as well is projected out).
    """
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    known, weights = len(problem.shared.parameter_mean), np.ones(len(problem.channel_names))
    found = fit(problem, Candidate(), begun(problem), iterations=0, evidence=False)
    matrix = eliminated(problem, found, Candidate(), weights).matrix
    left = np.sqrt(np.diag(np.linalg.pinv(matrix, hermitian=True))[:known])
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
