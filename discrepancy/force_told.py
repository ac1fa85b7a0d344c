"""What a verdict tells of the missing force: size, motion, what orders it, and what share of it a law is."""

from collections.abc import Sequence

import numpy as np

from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.force import ForceCourse, MissingForce, missing_force
from discrepancy.missing_force.hypotheses import key_of, sees_forces
from discrepancy.missing_force.naming import Explained, ForceSearch
from discrepancy.missing_force.shares import OF_PREDICTIONS, ForceShares, Share, orders
from discrepancy.search.strategy import Search
from discrepancy.verdict import ForceAtPort, ForceMoment, ShareOfForce


def told_force(problem: Problem, search: Search, fit: CandidateFit, missing: MissingForce) -> ForceAtPort:
    """Return what is told of a missing force beside the fit that stands for a verdict.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    search : Search
        With its hypotheses along the missing force, if it has any.
    fit : CandidateFit
        What stands for the verdict.
    missing : MissingForce
        As it is drawn.
    """
    force, position, speed, time = (
        np.concatenate([getattr(item, name) for item in missing.courses])
        for name in ("force", "position", "speed", "time")
    )
    by_variable, ordered_by = orders(force, position, speed, time)
    rms, displacement, velocity = (float(np.sqrt(np.mean(item**2))) for item in (force, position, speed))
    shares = _shares(problem, search, fit) if missing.law else (None, None)
    ports = problem.model.ports()
    laws = [(term.effect.name, term.place) for term in fit.candidate.terms if term.place in ports]
    several = missing.law and len({place for _, place in laws}) > 1
    return ForceAtPort(
        missing.port, problem.model.port_unit(missing.port), rms, displacement, velocity,
        _largest(missing.courses), missing.evidence, missing.correlation_time, by_variable, ordered_by,
        " and ".join(f"{name} at {place}" for name, place in laws) if several else missing.law, *shares,
    )  # fmt: skip


def _largest(courses: Sequence[ForceCourse]) -> ForceMoment:
    item = max(courses, key=lambda one: float(np.abs(one.force).max()))
    at = int(np.abs(item.force).argmax())
    course = (item.time, item.force, item.position, item.speed)
    return ForceMoment(item.trial, *(float(values[at]) for values in course))


def _shares(
    problem: Problem, search: Search, fit: CandidateFit
) -> tuple[ShareOfForce | None, ShareOfForce | None]:
    """Return the shares that a hypothesis is of the missing force, in fitted and in held-out trials."""
    try:
        force, found = _along(problem, search, fit)
        if found is None:
            return None, None
        shares = ForceShares(force)
        outside = _share(shares.of(found, held_out=True)) if shares.has_held_out else None
        return _share(shares.of(found, held_out=False)), outside
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # a share that cannot be told is left out
        return None, None


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


def shown_force(problem: Problem, search: Search, fit: CandidateFit) -> MissingForce | None:
    """Return the missing force, with the law of a verdict drawn through it; None where none can be seen."""
    terms = fit.candidate.terms
    try:
        ports = problem.model.ports()
        if not sees_forces(problem) or (terms and not any(term.place in ports for term in terms)):
            return None
        force, found = _along(problem, search, fit)
        return missing_force(force, force.whole if found is None else found)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # a picture that cannot be is left out
        return None
