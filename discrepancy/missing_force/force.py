"""The force that a verdict is about: where it is missing, how large, what a named law is of it, what is left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.models.ported import shows_ports
from fe.runtime.laws.interface import PortForce

from .columns import Columns
from .naming import ForceSearch, Seen
from .view import Column, View

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
    def size(self) -> float:
        """Root mean square of the force [N, N m or the port's flow]."""
        return float(np.sqrt(np.mean(np.concatenate([item.force for item in self.courses]) ** 2)))


def missing_force(problem: Problem, fit: CandidateFit) -> MissingForce | None:
    """Return the missing force beside a verdict's fit; None where a model does not tell how ports move.

    It is that of the port with the most evidence, or of the port at which the verdict's effect acts.
    """
    model = problem.model.inner
    dynamic = [data for data in problem.trials if data.trial.is_dynamic]
    if not dynamic or not shows_ports(model):
        return None
    search = ForceSearch(problem)
    at = search.locate(fit.point if fit.candidate.terms else None)
    nothing = {name: one.view.solve(replace(one.process, size=1e-9 * one.process.size)).evidence for name, one in at.items()}
    evidence = {name: one.evidence - nothing[name] for name, one in at.items()}
    law, port = None, max(at, key=lambda name: at[name].evidence)
    patch = fit.candidate.patch(problem.setting, fit.point.effect) if fit.candidate.terms else None
    places = [item.port for item in patch if isinstance(item, PortForce)] if patch is not None else []
    if places and places[0] in at:
        port = places[0]
    if evidence[port] < GROUND:
        return None
    found = at[port]
    if patch is not None and places:
        columns = Columns(search.problem, search.numbers, search.point)
        column = columns.of_patch(found.view, found.motions, patch, fit.candidate.acts_on)
        if column is not None:
            found, law = _beside(found, column), column
    return _told(search, port, found, evidence, fit.candidate if law is not None else Candidate())


def _beside(found: Seen, column: Column) -> Seen:
    """Return the missing force with a law that is known about its size: what is left is a process of its own."""
    certain = (*found.view.certain, column)
    view = replace(found.view, motions=found.motions, certain=certain)
    process, evidence = view.most_probable(found.process)
    return Seen(view, process, evidence, *view.smoothed(process))


def _told(
    search: ForceSearch, port: str, found: Seen, evidence: Mapping[str, float], named: Candidate
) -> MissingForce:
    view: View = found.view
    law = view.certain[-1] if named.terms else None
    courses = []
    for number, (trial, motion) in enumerate(zip(view.trials, found.motions, strict=True)):
        at = slice(None, None, trial.parts)
        position, speed = trial.port_motion(view.port, motion.added)
        given = None if law is None else law.parts[number].forces.get(view.port, np.zeros(len(speed)))[at]
        force = motion.force[at] if given is None else motion.force[at] + given
        deviation = view.filtered(found.process)[number].deviation()
        courses.append(ForceCourse(trial.name, trial.time, position[at], speed[at], force, deviation, given))
    share = None
    if law is not None:
        left = np.concatenate([item.left for item in courses])
        share = 1.0 - float(np.mean(left**2) / np.mean(np.concatenate([c.force for c in courses]) ** 2))
    names = " and ".join(term.effect.name for term in named.terms)
    scale = search.problem.setting.scales.ports.get(port)
    return MissingForce(
        port, bool(scale and scale.of_state), dict(evidence), found.process.time, courses, names, share
    )
