"""The force that a verdict is about: where it is, how large, what a named law is of it, what is left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .hypotheses import scaled
from .naming import Explained, ForceSearch

FloatArray = NDArray[np.float64]

GROUND = 3.0
"""Evidence over no missing force at all [nat] from which there is one."""


@dataclass(frozen=True, eq=False)
class ForceCourse:
    """The missing force in a trial, at its samples (N,).

    Attributes
    ----------
    trial : str
        Its name.
    time : (N,) ndarray
        [s].
    position, speed : (N,) ndarray
        Of the port; of a port of a state the speed is the state.
    force, deviation : (N,) ndarray
        Smoothed, with its standard deviation.
    law : (N,) ndarray or None
        What the named effect gives along the same motion.
    """

    trial: str
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    force: FloatArray
    deviation: FloatArray
    law: FloatArray | None

    @property
    def left(self) -> FloatArray:
        """The missing force (N,) beside the law."""
        return self.force if self.law is None else self.force - self.law


@dataclass(frozen=True, eq=False)
class MissingForce:
    """What is missing at a port.

    Attributes
    ----------
    port : str
        Its name.
    of_state : bool
        Whether it is a flow at a store.
    evidence : mapping of str to float
        By port: over no missing force [nat].
    correlation_time : float
        [s].
    courses : sequence of ForceCourse
        Of the trials that were fitted.
    law : str
        Name of the effect drawn beside it; empty: none.
    """

    port: str
    of_state: bool
    evidence: Mapping[str, float]
    correlation_time: float
    courses: Sequence[ForceCourse]
    law: str = ""


def missing_force(search: ForceSearch, found: Explained) -> MissingForce | None:
    """Return the missing force that a hypothesis is about, None where no force is missing at all.

    It is that at the port of its law, or else at the one with the most evidence; the law is drawn through it
    if it acts at one port.
    """
    nothing = max(of_nothing(one) for one in search.at.values())
    evidence = {name: one.evidence - nothing for name, one in search.at.items()}
    if max(evidence.values()) < GROUND:
        return None
    laws = {term.place for term in found.candidate.terms if term.place in search.ports}
    port = laws.pop() if len(laws) == 1 else max(evidence, key=lambda name: evidence[name])
    at = search.ports.index(port)
    if at not in found.processes:
        found = search.at[port]
    named = " and ".join(term.effect.name for term in found.candidate.terms if term.place == port)
    courses = []
    filters = found.view.filtered(found.processes)
    for trial, motion, one in zip(found.view.trials, found.motions, filters, strict=True):
        samples = slice(None, None, trial.parts)
        position, speed = motion.positions[:, at], motion.speeds[:, at]
        force, left = motion.forces[at][samples], motion.left[at][samples]
        law = force - left if named else None
        motion_at = (position[samples], speed[samples])
        courses.append(ForceCourse(trial.name, trial.time, *motion_at, force, one.deviation(at), law))
    scale = search.problem.setting.scales.ports.get(port)
    of_state = bool(scale and scale.of_state)
    time = found.processes[at].time
    return MissingForce(port, of_state, evidence, time, courses, named)


def of_nothing(found: Explained) -> float:
    """Return the evidence [nat] without any missing force."""
    return found.view.solve(scaled(found.processes, 1e-9, 1.0)).evidence
