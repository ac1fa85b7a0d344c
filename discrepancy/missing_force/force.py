"""The force that a verdict is about: where it is, how large, what a named law is of it, what is left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.models.ported import shows_ports
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .columns import Columns
from .naming import ForceSearch, Seen

FloatArray = NDArray[np.float64]

FAR = 2.0
"""Prior deviations from which on a parameter has taken up what it should not: no law is drawn beside it."""
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


def missing_force(problem: Problem, fit: CandidateFit) -> MissingForce | None:
    """Return the missing force beside a verdict's fit.

    None where a model does not tell how its ports move, where laws of the verdict act at several ports, and
    where nothing is missing.

    It is that beside parameters within their priors, of the port at which the verdict's effect acts, or else
    of the one with the most evidence.
    """
    model = problem.model.inner
    dynamic = [data for data in problem.trials if data.trial.is_dynamic]
    if not dynamic or not shows_ports(model):
        return None
    try:
        return _missing(problem, fit)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # it is shown, and no verdict rests on it
        return None


def _missing(problem: Problem, fit: CandidateFit) -> MissingForce | None:
    search = ForceSearch(problem)
    strained = np.abs(fit.point.shared[problem.shared.precision > 0.0]).max(initial=0.0) > FAR
    told = bool(fit.candidate.terms) and not strained
    at = search.locate(fit.point if told else None)
    nothing = {
        name: one.view.solve(replace(one.process, size=1e-9 * one.process.size)).evidence
        for name, one in at.items()
    }
    evidence = {name: one.evidence - nothing[name] for name, one in at.items()}
    port = max(at, key=lambda name: at[name].evidence)
    found, named = at[port], ""
    if told:
        patch = fit.candidate.patch(problem.setting, fit.point.effect)
        columns = Columns(search.problem, search.numbers, search.point)
        beside = [
            seen for name in at if (seen := _with_laws(columns, at[name], name, patch, fit)) is not None
        ]
        if len(beside) > 1:  # each hides the motion that the others make
            return None
        if beside and beside[0].gap > GROUND:
            found = beside[0].seen
            port = list(at)[found.view.port]
            named = " and ".join(term.effect.name for term in fit.candidate.terms)
    return None if evidence[port] < GROUND else _told(search, port, found, evidence, named)


class _Beside(NamedTuple):
    """What is left beside laws, and how much more evidence that has than the missing force alone [nat]."""

    seen: Seen
    gap: float


def _with_laws(
    columns: Columns, found: Seen, port: str, patch: ModelPatch, fit: CandidateFit
) -> _Beside | None:
    """Return what is left at a port beside the laws there; None where none acts there."""
    forces = (item for item in patch if isinstance(item, PortForce))
    own = ModelPatch(tuple(item for item in forces if item.port == port))
    column = columns.of_patch(found.view, found.motions, own, fit.candidate.acts_on) if len(own) else None
    if column is None:
        return None
    view = replace(found.view, motions=found.motions, certain=(*found.view.certain, column))
    process, evidence = view.most_probable(found.process)
    return _Beside(Seen(view, process, evidence, *view.smoothed(process)), evidence - found.evidence)


def _told(
    search: ForceSearch, port: str, found: Seen, evidence: Mapping[str, float], named: str
) -> MissingForce:
    view = found.view
    law = view.certain[-1] if named else None
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
    scale = search.problem.setting.scales.ports.get(port)
    return MissingForce(
        port, bool(scale and scale.of_state), dict(evidence), found.process.time, courses, named, share
    )
