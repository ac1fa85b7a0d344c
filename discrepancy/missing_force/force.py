"""The force that a verdict is about: where it is, how large, what a named law is of it, what is left."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.catalogue.entry import Effect
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.models.ported import shows_ports
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .columns import Columns
from .naming import ROUNDS, ForceSearch, Seen, seen
from .view import Column

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


def missing_force(problem: Problem, fit: CandidateFit, effects: Sequence[Effect] = ()) -> MissingForce | None:
    """Return the missing force beside a verdict's fit.

    It is that beside parameters within their priors, at the port of the verdict's effect or else at the one
    with the most evidence. Where the verdict has no law at a port, that of `effects` is drawn which follows
    the force best, if one follows it at all.

    None where a model does not tell how its ports move, where the verdict is no law at one port, where its
    law is not ahead of a force without one (friction that holds is anything up to its largest), and where
    nothing is missing.
    """
    model = problem.model.inner
    dynamic = [data for data in problem.trials if data.trial.is_dynamic]
    if not dynamic or not shows_ports(model):
        return None
    try:
        return _missing(problem, fit, effects)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # it is shown, and no verdict rests on it
        return None


def _missing(problem: Problem, fit: CandidateFit, effects: Sequence[Effect]) -> MissingForce | None:
    search = ForceSearch(problem)
    patch = fit.candidate.patch(problem.setting, fit.point.effect) if fit.candidate.terms else ModelPatch()
    if not all(isinstance(item, PortForce) for item in patch):
        return None
    strained = np.abs(fit.point.shared[problem.shared.precision > 0.0]).max(initial=0.0) > FAR
    believed = len(patch) > 0 and not strained
    at = search.locate(fit.point if believed else None)
    nothing = max(of_nothing(one) for one in at.values())
    evidence = {name: one.evidence - nothing for name, one in at.items()}
    port = max(at, key=lambda name: at[name].evidence)
    if evidence[port] < GROUND:
        return None
    drawn = Drawn(at[port])
    if believed:
        laws = [law for name in at if (law := law_at_port(search, fit, name)) is not None]
        ahead = [law for law in laws if law.seen.evidence > at[law.port(at)].evidence + GROUND]
        if (
            len(laws) != 1 or not ahead
        ):  # several hide each other's motion; one that sticks has no known force
            return None
        drawn = ahead[0]
    elif effects:
        first = next(iter(search.name(effects)), None)
        acts = first is not None and any(part.forces for part in first.seen.view.effects[-1].parts)
        if first is not None and acts and first.evidence > at[port].evidence + GROUND:
            column = first.seen.view.effects[-1]
            drawn = Drawn(first.seen, column, first.size, first.term.effect.name)
    return _told(search, drawn.port(at), drawn, evidence)


def of_nothing(found: Seen) -> float:
    """Return the evidence [nat] without any missing force."""
    return found.view.solve(replace(found.process, size=1e-9 * found.process.size)).evidence


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is left of the missing force beside a law, which is a factor times a column."""

    seen: Seen
    law: Column | None = None
    factor: float = 1.0
    name: str = ""

    def port(self, ports: Iterable[str]) -> str:
        """Return its port, one of some."""
        return list(ports)[self.seen.view.port]


def law_at_port(search: ForceSearch, fit: CandidateFit, port: str) -> Drawn | None:
    """Return what is left at a port beside the laws of a verdict there; None where it has none."""
    candidate, one, drawn = fit.candidate, search.at[port], None
    patch = candidate.patch(search.problem.setting, fit.point.effect) if candidate.terms else ()
    own = ModelPatch(tuple(item for item in patch if isinstance(item, PortForce) and item.port == port))
    columns, motions = Columns(search.problem, search.numbers, search.point), one.motions
    for _ in range(ROUNDS if len(own) else 0):  # along the motion that the law itself gives
        column = columns.of_patch(one.view, motions, own, candidate.acts_on)
        if column is None:
            break
        view = replace(one.view, motions=motions, certain=(*one.view.certain, column))
        named = " and ".join(term.effect.name for term in candidate.terms)
        drawn = Drawn(seen(view, one.process), column, 1.0, named)
        motions = drawn.seen.motions
    return drawn


def _told(search: ForceSearch, port: str, drawn: Drawn, evidence: Mapping[str, float]) -> MissingForce:
    found, view = drawn.seen, drawn.seen.view
    courses = []
    for number, (trial, motion) in enumerate(zip(view.trials, found.motions, strict=True)):
        at = slice(None, None, trial.parts)
        position, speed = trial.port_motion(view.port, motion.added)
        force, law = found.left[number][at], None
        if drawn.law is not None:
            law = drawn.factor * drawn.law.parts[number].forces.get(view.port, np.zeros(len(speed)))[at]
            force = force + law
        deviation = view.filtered(found.process)[number].deviation()
        courses.append(ForceCourse(trial.name, trial.time, position[at], speed[at], force, deviation, law))
    share = None
    if drawn.law is not None:
        left, whole = (np.concatenate([getattr(c, name) for c in courses]) for name in ("left", "force"))
        share = 1.0 - float(np.mean(left**2) / np.mean(whole**2))
    scale = search.problem.setting.scales.ports.get(port)
    of_state = bool(scale and scale.of_state)
    return MissingForce(port, of_state, dict(evidence), found.process.time, courses, drawn.name, share)
