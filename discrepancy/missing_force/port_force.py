"""The missing force that a verdict is about: at which port it is, how large, and what orders it."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.verdict import ForceAtPort, ForceLeft, ForceMoment

from .explained import ForceHypothesis
from .gap_share import GapShare
from .hypotheses import scaled, sees_forces
from .naming import ForceSearch
from .shares import ForceShares

UNSEEN_ERRORS = (DiscrepancyError, np.linalg.LinAlgError, ValueError)
"""Errors by which a missing force cannot be seen; what it would show is left out then."""
BINS = 24
"""Largest number of bins of a variable that may order a force."""
LEAST_IN_BIN = 4
"""Least number of samples in a bin."""
LEAST_ORDER = 0.3
"""Least share of the force's variance that a variable must explain to order it."""
ALIKE = 0.05
"""Difference of such shares up to which two variables order a force alike."""


# ---------------------------------------------------------------- what orders a force


def explained_variance(variable: FloatArray, force: FloatArray) -> float:
    """Return the share of a force's variance that its mean at like values of a variable explains.

    Parameters
    ----------
    variable, force : (N,) array
        The variable and the force at the same times.
    """
    count = len(force)
    bins = min(BINS, count // LEAST_IN_BIN)
    if bins < 2 or not np.ptp(variable) > 0.0:
        return 0.0
    order = np.argsort(variable, kind="stable")
    sums = [float(np.sum((part - part.mean()) ** 2)) for part in np.array_split(force[order], bins)]
    variance_within = sum(sums) / (count - bins)
    variance = max(float(np.var(force, ddof=1)), 1e-300)
    return max(1.0 - variance_within / variance, 0.0)


def ordering_variables(
    force: FloatArray, position: FloatArray, speed: FloatArray, time: FloatArray
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return which variables order a force.

    Parameters
    ----------
    force, position, speed, time : (N,) array
        The force, the motion of its port, and the time.

    Returns
    -------
    shares : dict of str to float
        The share of the force's variance that each variable explains.
    ordered_by : tuple of str
        The variables that order it, as well as the best one does.
    """
    scaled_position = position / max(float(np.std(position)), 1e-300)
    scaled_speed = speed / max(float(np.std(speed)), 1e-300)
    amplitude = np.hypot(scaled_position, scaled_speed)
    shares = {
        "displacement": explained_variance(position, force),
        "velocity": explained_variance(speed, force),
        "amplitude": explained_variance(amplitude, np.abs(force)),
        "time": explained_variance(time, force),
    }
    least = max(LEAST_ORDER, max(shares.values()) - ALIKE)
    return shares, tuple(name for name, share in shares.items() if share >= least)


# ---------------------------------------------------------------- the missing force at a port

GROUND = 3.0
"""Evidence over no missing force at all from which on there is one [nat]."""


@dataclass(frozen=True, eq=False)
class ForceCourse:
    """The missing force in a trial, at its samples.

    Attributes
    ----------
    trial : str
        The name of the trial.
    time : (N,) array
        The stamps [s].
    position, speed : (N,) array
        The motion of the port; at a port of a state the speed is the state.
    force, deviation : (N,) array
        The smoothed force, and its standard deviation.
    law : (N,) array or None
        The force of the named effect along the same motion.
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
    """The missing force at a port.

    Attributes
    ----------
    at_port : ForceAtPort
        The record of the force in the verdict.
    courses : sequence of ForceCourse
        The force in each fitted trial.
    law : str
        The name of the effect at the port that is drawn through it; empty if there is none.
    """

    at_port: ForceAtPort
    courses: Sequence[ForceCourse]
    law: str = ""


def missing_force(search: ForceSearch, hypothesis: ForceHypothesis) -> MissingForce | None:
    """Return the missing force that a hypothesis is about; None where no force is missing at all.

    It is that at the port of its law, or else at the port with the most evidence. The law is drawn
    through it if it acts at one port. The share that the law explains is not computed.
    """
    evidence_of_none = max(evidence_without_force(at_port) for at_port in search.at.values())
    evidence = {}
    for name, at_port in search.at.items():
        evidence[name] = at_port.log_evidence - evidence_of_none
    if max(evidence.values()) < GROUND:
        return None
    terms = hypothesis.candidate.terms
    law_ports = {term.place for term in terms if term.place in search.ports}
    if len(law_ports) == 1:
        (port,) = law_ports
    else:
        port = max(evidence, key=lambda name: evidence[name])
    number = search.ports.index(port)
    if number not in hypothesis.processes:
        hypothesis = search.at[port]
    law = " and ".join(
        term.name_in_words for term in hypothesis.candidate.terms if term.place == port
    )
    courses = _force_courses(hypothesis, number, has_law=bool(law))
    unit, *_ = search.problem.model.port_units(port)
    correlation_time = hypothesis.processes[number].time
    force = _force_at_port(courses, port, unit, evidence, correlation_time, law)
    return MissingForce(force, courses, law)


def _force_courses(hypothesis: ForceHypothesis, port: int, *, has_law: bool) -> list[ForceCourse]:
    """Return the missing force at a port, by its number, in each trial."""
    courses = []
    for trial, motion in zip(hypothesis.view.trials, hypothesis.motions, strict=True):
        samples = slice(None, None, trial.parts)
        force = motion.forces[port][samples]
        law = force - motion.left[port][samples] if has_law else None
        force_deviation, _ = motion.deviations[port]
        courses.append(
            ForceCourse(
                trial=trial.name,
                time=trial.time,
                position=motion.positions[samples, port],
                speed=motion.speeds[samples, port],
                force=force,
                deviation=force_deviation,
                law=law,
            )
        )
    return courses


def _force_at_port(
    courses: Sequence[ForceCourse],
    port: str,
    unit: str,
    evidence: Mapping[str, float],
    correlation_time: float,
    law: str,
) -> ForceAtPort:
    """Return what a verdict says of the missing force at a port.

    Parameters
    ----------
    courses : sequence of ForceCourse
        The force in each trial.
    port, unit : str
        The name of the port, and the unit of its force.
    evidence : mapping of str to float
        The evidence of a missing force over none, by port [nat].
    correlation_time : float
        The correlation time of the force [s].
    law : str
        The name of the law that is drawn through it.
    """
    force = np.concatenate([course.force for course in courses])
    position = np.concatenate([course.position for course in courses])
    speed = np.concatenate([course.speed for course in courses])
    time = np.concatenate([course.time for course in courses])
    shares, ordered_by = ordering_variables(force, position, speed, time)
    # where the force is largest
    course = max(courses, key=lambda course: float(np.abs(course.force).max()))
    k = int(np.abs(course.force).argmax())
    largest = ForceMoment(
        trial=course.trial,
        time=float(course.time[k]),
        force=float(course.force[k]),
        displacement=float(course.position[k]),
        speed=float(course.speed[k]),
    )
    return ForceAtPort(
        port=port,
        unit=unit,
        rms=_rms(force),
        displacement=_rms(position),
        speed=_rms(speed),
        largest=largest,
        evidence=evidence,
        correlation_time=correlation_time,
        orders=shares,
        ordered_by=ordered_by,
        law=law,
    )


def _rms(values: FloatArray) -> float:
    """Return the root mean square of values (N,)."""
    return float(np.sqrt(np.mean(values**2)))


def evidence_without_force(hypothesis: ForceHypothesis) -> float:
    """Return the log evidence of a hypothesis without any missing force [nat]."""
    return hypothesis.view.solve(scaled(hypothesis.processes, 1e-9, 1.0)).evidence


def seen_force(
    problem: Problem,
    search: ForceSearch | None,
    hypotheses: Sequence[ForceHypothesis],
    fit: CandidateFit,
) -> MissingForce | None:
    """Return the missing force beside the fit of a verdict, with the share that its law explains.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    search : ForceSearch or None
        The search for the missing force, if there was one.
    hypotheses : sequence of ForceHypothesis
        The hypotheses that were fitted to the missing force.
    fit : CandidateFit
        The fit that stands for the verdict.

    Returns
    -------
    MissingForce or None
        None where no force can be seen.
    """
    terms = fit.candidate.terms
    try:
        ports = problem.model.ports
        has_law = any(term.place in ports for term in terms)
        if not sees_forces(problem) or (terms and not has_law):
            return None
        search = search or ForceSearch(problem)
        hypothesis = next(
            (known for known in hypotheses if known.candidate.key == fit.candidate.key), None
        )
        if hypothesis is None and terms:
            hypothesis = search.followed(search.whole, fit.candidate, fit.point.effect)
        missing = missing_force(search, search.whole if hypothesis is None else hypothesis)
    except UNSEEN_ERRORS:
        return None
    if missing is None or not missing.law or hypothesis is None:
        return missing
    at_port = missing.at_port
    laws = [(term.name_in_words, term.place) for term in terms if term.place in ports]
    if len({place for _, place in laws}) > 1:
        at_port = replace(at_port, law=" and ".join(f"{name} at {place}" for name, place in laws))
    with suppress(*UNSEEN_ERRORS):
        shares = ForceShares(search)
        held_out = None
        if shares.has_held_out:
            held_out = _force_left(shares.share_of(hypothesis, held_out=True))
        fitted = _force_left(shares.share_of(hypothesis, held_out=False))
        at_port = replace(at_port, fitted=fitted, held_out=held_out)
    return replace(missing, at_port=at_port)


def _force_left(share: GapShare) -> ForceLeft:
    """Return what a law leaves of the missing force, as the verdict has it."""
    return ForceLeft(
        share.remaining_rms, share.total_rms, trials=share.trial_count, tested=share.tested
    )
