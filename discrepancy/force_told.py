"""What a verdict tells of the missing force: size, motion, what orders it, and what share of it a law is."""

from dataclasses import replace

import numpy as np

from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.hypotheses import key_of, sees_forces
from discrepancy.missing_force.naming import Explained, ForceSearch
from discrepancy.missing_force.shares import (
    OF_PREDICTIONS,
    ForceShares,
    MissingForce,
    Share,
    missing_force,
    told_force,
)
from discrepancy.search.strategy import Search
from discrepancy.verdict import ForceAtPort, ShareOfForce

CANNOT = (DiscrepancyError, np.linalg.LinAlgError, ValueError)
"""What keeps a picture or a share from being told: it is left out."""


def seen_force(
    problem: Problem, search: Search, fit: CandidateFit
) -> tuple[MissingForce | None, ForceAtPort | None]:
    """Return the missing force beside the fit of a verdict, its law drawn through it, and what is told of it.

    None where no force can be seen. `search`: with its hypotheses along the missing force, if it has any.
    """
    terms = fit.candidate.terms
    try:
        ports = problem.model.ports()
        if not sees_forces(problem) or (terms and not any(term.place in ports for term in terms)):
            return None, None
        force, found = _along(problem, search, fit)
        missing = missing_force(force, force.whole if found is None else found)
    except CANNOT:
        return None, None
    if missing is None:
        return None, None
    told = told_force(missing, problem.model)
    laws = [(term.effect.name, term.place) for term in terms if term.place in ports]
    if missing.law and len({place for _, place in laws}) > 1:
        told = replace(told, law=" and ".join(f"{name} at {place}" for name, place in laws))
    if not missing.law or found is None:
        return missing, told
    try:
        shares = ForceShares(force)
        outside = _share(shares.of(found, held_out=True)) if shares.has_held_out else None
        return missing, replace(told, fitted=_share(shares.of(found, held_out=False)), held_out=outside)
    except CANNOT:
        return missing, told


def _along(problem: Problem, search: Search, fit: CandidateFit) -> tuple[ForceSearch, Explained | None]:
    """Return the missing force of a problem, and the hypothesis along it that a fit is."""
    force, key = search.force, key_of(fit.candidate)
    if force is None:
        force = ForceSearch(problem)
        force.locate()
    found = next((item for item in search.forces if key_of(item.candidate) == key), None)
    if found is None and fit.candidate.terms:
        found = force.followed(force.whole, fit.candidate, fit.point.effect)
    return force, found


def _share(share: Share) -> ShareOfForce:
    sizes = (share.value, *share.interval, share.left, share.whole)
    return ShareOfForce(*sizes, ahead=share.of == OF_PREDICTIONS, trials=share.trials, tested=share.tested)
