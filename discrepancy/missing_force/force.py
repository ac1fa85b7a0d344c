"""The force that a verdict is about: where it is, how large, what a named law is of it, what is left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from discrepancy.models.interface import Model
from discrepancy.verdict import ForceAtPort, ForceMoment

from .hypotheses import scaled
from .naming import Explained, ForceSearch
from .shares import orders

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
    time = found.processes[at].time
    return MissingForce(port, evidence, time, courses, named)


def told_force(missing: MissingForce, model: Model) -> ForceAtPort:
    """Return what is told of a missing force: size, motion, what orders it; not of the shares of a law."""
    force, position, speed, at = (
        np.concatenate([getattr(item, name) for item in missing.courses])
        for name in ("force", "position", "speed", "time")
    )
    by_variable, ordered_by = orders(force, position, speed, at)
    rms, displacement, velocity = (float(np.sqrt(np.mean(item**2))) for item in (force, position, speed))
    course = max(missing.courses, key=lambda one: float(np.abs(one.force).max()))
    k = int(np.abs(course.force).argmax())
    most = (float(item[k]) for item in (course.time, course.force, course.position, course.speed))
    return ForceAtPort(
        missing.port, model.port_unit(missing.port), rms, displacement, velocity,
        ForceMoment(course.trial, *most), missing.evidence, missing.correlation_time, by_variable,
        ordered_by, missing.law,
    )  # fmt: skip


def of_nothing(found: Explained) -> float:
    """Return the evidence [nat] without any missing force."""
    return found.view.solve(scaled(found.processes, 1e-9, 1.0)).evidence
