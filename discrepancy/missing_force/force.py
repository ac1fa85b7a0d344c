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
    share : float or None
        Share of the force's mean square that the law is; None without one.
    """

    port: str
    of_state: bool
    evidence: Mapping[str, float]
    correlation_time: float
    courses: Sequence[ForceCourse]
    law: str = ""
    share: float | None = None

    @property
    def sentence(self) -> str:
        """Where it is, how large, and what a named law is of it."""
        what, unit = ("flow", "") if self.of_state else ("force", " N (N m if the port turns)")
        others = {name: value for name, value in self.evidence.items() if name != self.port}
        nearest = max(others, key=lambda name: others[name]) if others else ""
        ahead = self.evidence[self.port] - others[nearest] if others else 0.0
        beside = ""
        if others:
            beside = f", {abs(ahead):.0f} nat {'more' if ahead >= 0.0 else 'less'} than at {nearest!r}"
        found = (
            f"A {what} of {self.size:.3g}{unit} root mean square is missing at the port {self.port!r} "
            f"(evidence {self.evidence[self.port]:.0f} nat over none{beside})."
        )
        if self.share is not None:
            found += f" {self.law[:1].upper()}{self.law[1:]} is {100.0 * max(self.share, 0.0):.3g} % of it."
        return found

    @property
    def size(self) -> float:
        """Root mean square of the force [N, N m or the port's flow]."""
        return float(np.sqrt(np.mean(np.concatenate([item.force for item in self.courses]) ** 2)))


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
    return MissingForce(port, of_state, evidence, time, courses, named, _share(courses) if named else None)


def of_nothing(found: Explained) -> float:
    """Return the evidence [nat] without any missing force."""
    return found.view.solve(scaled(found.processes, 1e-9, 1.0)).evidence


def _share(courses: Sequence[ForceCourse]) -> float:
    left, whole = (np.concatenate([getattr(c, name) for c in courses]) for name in ("left", "force"))
    return 1.0 - float(np.mean(left**2) / np.mean(whole**2))
