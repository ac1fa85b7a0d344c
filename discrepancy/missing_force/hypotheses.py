"""Sets of effects as hypotheses: what tells them apart, their prior, and values at which they are tried."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from math import comb, log

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.gates import SHAPE_GAIN
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .filtered import Process
from .view import Processes

LEVELS = (-1.3, -0.4, 0.4, 1.3)
"""Standard normal values at which the numbers of an effect that are no magnitudes are tried."""
MOST_VARIANTS = 16
AWAY = 0.5
"""Standard normal value of a magnitude with which an effect is tried, its size being free."""
LARGEST = 4.0
"""Standard normal value from which on an unknown is not followed."""


def sees_forces(problem: Problem) -> bool:
    """Whether missing forces can be seen: in trials in motion, of a model that tells how its ports move."""
    model = problem.model
    moving = any(data.trial.is_dynamic for data in problem.trials)
    return moving and model.shows_ports and bool(model.ports)


def log_prior(candidate: Candidate, count: int, setting: Setting) -> float:
    """Return ln of the prior probability of a candidate at its places, `count` effects being looked for.

    A free shape has to gain what the shape gate asks for.
    """
    terms = candidate.terms
    if not terms:
        return log(SEARCH.prior_none)
    places = sum(log(len(term.effect.places(setting))) for term in terms)
    free = sum(SHAPE_GAIN for term in terms if term.free_shape)
    share = (1.0 - SEARCH.prior_none) * SEARCH.set_shares[len(terms) - 1]
    return log(share / comb(count, len(terms))) - places - free


def variants(term: Term) -> list[FloatArray]:
    """Return standard normal values (E,) of a term's parameters at which it is tried."""
    free = [number for number, item in enumerate(term.parameters) if not item.magnitude]
    levels = [LEVELS if len(free) < 2 else LEVELS[::3]] * len(free)
    found = []
    for chosen in list(product(*levels))[:MOST_VARIANTS]:
        values = np.full(len(term.parameters), AWAY)  # the middle of a prior of both signs is no effect
        values[free] = chosen
        found.append(values)
    return found


def both_signs(term: Term) -> bool:
    """Whether an effect's size may be negative."""
    return any(item.prior.low < 0.0 for item in term.effect.parameters if item.magnitude)


def stepped(candidate: Candidate, effect: FloatArray, step: FloatArray) -> FloatArray:
    """Return the unknowns of a candidate (E,) after a step, taken along the values' tangents."""
    priors = [item.prior for item in candidate.parameters]
    moved = [prior.stepped(float(u), float(s)) for prior, u, s in zip(priors, effect, step, strict=True)]
    return np.clip(moved, -LARGEST, LARGEST)


def scaled(processes: Processes, size: float, time: float) -> Mapping[int, Process]:
    """Return processes of other sizes and times."""
    return {port: replace(one, size=one.size * size, time=one.time * time) for port, one in processes.items()}
