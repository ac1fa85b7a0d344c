"""The missing force that a verdict reports: its port, its rms, and the variables it depends on."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter
from scipy.spatial import KDTree

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import DiscrepancyError
from discrepancy.estimation.estimate import LEAST_EVIDENCE, Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.ported_problem import can_estimate_forces
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.verdict import RATE_OF, STATE, ForceAtPort, ForceLeft, ForceMoment
from reporting.arrays import LEAST_DIVISOR

from .gap_share import GapShare
from .shares import ForceShares

ESTIMATION_ERRORS = (DiscrepancyError, np.linalg.LinAlgError, ValueError)
"""Errors that mean that a missing force cannot be estimated. The verdict is then given without the
force."""
MOST_BINS = 24
"""Largest number of bins of a variable in the test of whether a force depends on it."""
LEAST_IN_BIN = 4
"""Least number of samples in a bin."""
LEAST_ORDER = 0.3
"""Least share of a force's variance that a variable explains if the force depends on it."""
TIED_SHARE = 0.05
"""Difference of these shares up to which two variables explain a force equally well."""
LARGEST_SINGLE_SHARE = 0.6
"""Largest share by a single variable, over that by displacement and velocity together, if the force
follows the two together. On simulated rigs it is at most 0.5 for impacts with loss, and at least
0.68 for forces of one of the two."""
NEIGHBOURS, CANDIDATE_NEIGHBOURS = 3, 100
"""Number of neighbours whose mean force predicts that of a sample, and number of nearest samples
among which they are looked for."""
RELAXED_DISPLACEMENT = "the displacement relaxed within"
AVERAGED_STATE = "the state averaged over the past"
HISTORIES = (RELAXED_DISPLACEMENT, AVERAGED_STATE)
"""Beginnings of the names of variables that depend on the history of the motion; a port of a state
has the second one."""
RELAXATION_TIMES = np.geomspace(2.0, 200.0, 12)
"""Relaxation times with which the displacement is tried as a variable, in sampling intervals."""


# ---------------------------------------------------------------- variables a force depends on


def explained_variance(variable: FloatArray, force: FloatArray) -> float:
    """Return the share of a force's variance that is explained by its mean in bins of a variable.

    It is near one if the force is a function of the variable, and near zero if it is independent.

    Parameters
    ----------
    variable, force : (N,) array
        The variable and the force at the same times.
    """
    count = len(force)
    bin_count = min(MOST_BINS, count // LEAST_IN_BIN)
    if bin_count < 2 or not np.ptp(variable) > 0.0:
        return 0.0
    ascending = np.argsort(variable, kind="stable")
    squares_by_bin = [
        float(np.sum((forces_in_bin - forces_in_bin.mean()) ** 2))
        for forces_in_bin in np.array_split(force[ascending], bin_count)
    ]
    # each bin has its own mean, which takes one degree of freedom
    variance_within = sum(squares_by_bin) / (count - bin_count)
    variance = max(float(np.var(force, ddof=1)), LEAST_DIVISOR)
    return max(1.0 - variance_within / variance, 0.0)


def variance_explained_by_state(trial_forces: Sequence["TrialForce"]) -> float:
    """Return the share of a force's variance that displacement and velocity explain together.

    The force at each sample is predicted by its mean at the `NEIGHBOURS` nearest states of the port
    in all trials. States of the same trial within half a period of the sample do not count: there
    the force is similar whatever it depends on (Theiler 1986, Phys. Rev. A 34, 2427-2432). The
    share is 0 if there are too few samples, or if less than half of them have enough neighbours
    among the `CANDIDATE_NEIGHBOURS` nearest states.
    """
    # N samples of all trials together
    force = np.concatenate([trial.force for trial in trial_forces])
    position = np.concatenate([trial.position for trial in trial_forces])
    speed = np.concatenate([trial.speed for trial in trial_forces])
    sample_count = len(force)
    if sample_count <= CANDIDATE_NEIGHBOURS:
        return 0.0
    trial_of_sample = np.repeat(
        np.arange(len(trial_forces)), [len(trial.force) for trial in trial_forces]
    )
    # half a period: the mean number of samples between two changes of the sign of the speed
    sign_changes = sum(np.count_nonzero(np.diff(np.sign(trial.speed))) for trial in trial_forces)
    half_period = sample_count / max(sign_changes, 1)
    scaled_state = np.column_stack(
        [values / max(float(np.std(values)), LEAST_DIVISOR) for values in (position, speed)]
    )
    # (N, CANDIDATE_NEIGHBOURS): indices of the samples with the nearest states, the nearest first
    _, candidates = KDTree(scaled_state).query(scaled_state, CANDIDATE_NEIGHBOURS)
    is_other_trial = trial_of_sample[candidates] != trial_of_sample[:, np.newaxis]
    distance_in_time = np.abs(candidates - np.arange(sample_count)[:, np.newaxis])
    is_admitted = is_other_trial | (distance_in_time > half_period)
    # the first NEIGHBOURS admitted candidates: the running count of admitted ones selects them
    is_neighbour = is_admitted & (np.cumsum(is_admitted, axis=1) <= NEIGHBOURS)
    is_predicted = is_neighbour.sum(axis=1) == NEIGHBOURS  # (N,)
    if np.count_nonzero(is_predicted) < sample_count / 2:
        return 0.0
    # (number of predicted samples, NEIGHBOURS)
    neighbours = candidates[is_predicted][is_neighbour[is_predicted]].reshape(-1, NEIGHBOURS)
    errors = force[is_predicted] - force[neighbours].mean(axis=1)
    # the mean of n independent neighbours has an n-th of the variance around the function
    variance_around = float(np.mean(errors**2)) / (1.0 + 1.0 / NEIGHBOURS)
    variance = max(float(np.var(force, ddof=1)), LEAST_DIVISOR)
    return max(1.0 - variance_around / variance, 0.0)


def explanatory_variables(
    force: FloatArray,
    position: FloatArray | None,
    speed: FloatArray,
    time: FloatArray,
    other_variables: Mapping[str, FloatArray],
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the variables of which a force is nearly a function, each of one alone.

    Displacement, velocity, amplitude of the vibration and time are always tried; at a port of a
    state, the state and time.

    Parameters
    ----------
    force, speed, time : (N,) array
        The force, the speed of its port or its state, and the time.
    position : (N,) array or None
        The displacement of the port; None at a port of a state.
    other_variables : mapping of str to (N,) array
        Recorded inputs, their rates and a relaxed displacement, by name. A missing force is a
        function of an input if the input that acts is smaller or larger than the recorded one, of
        an input's rate if the input acts later than recorded, and of a relaxed displacement if the
        force depends on the history of the motion.

    Returns
    -------
    shares : dict of str to float
        The share of the force's variance that each variable explains, 0 to 1.
    ordered_by : tuple of str
        The variables whose share is at least `LEAST_ORDER`, and at most `TIED_SHARE` below the
        largest one. Empty if there is none.
    """
    if position is None:
        shares = {"state": explained_variance(speed, force)}
    else:
        # unit standard deviations, so that position and speed of a harmonic motion form a circle
        scaled_position = position / max(float(np.std(position)), LEAST_DIVISOR)
        scaled_speed = speed / max(float(np.std(speed)), LEAST_DIVISOR)
        # amplitude of a vibration; in a cycle the force changes its sign, but not its magnitude
        amplitude = np.hypot(scaled_position, scaled_speed)
        shares = {
            "displacement": explained_variance(position, force),
            "velocity": explained_variance(speed, force),
            "amplitude": explained_variance(amplitude, np.abs(force)),
        }
    shares["time"] = explained_variance(time, force)
    for name, values in other_variables.items():
        shares[name] = explained_variance(values, force)
    least_share = max(LEAST_ORDER, max(shares.values()) - TIED_SHARE)
    return shares, tuple(name for name, share in shares.items() if share >= least_share)


def relaxed_displacement(time: FloatArray, speed: FloatArray, relaxation_time: float) -> FloatArray:
    """Return the elongation (N,) of a spring in series with a damper: z' = v - z / relaxation_time.

    For a long relaxation time it is the displacement since the first sample, and for a short one it
    is proportional to the speed. In between it depends on the history of the motion. Of a state in
    the place of the speed it is the average over the past, times the relaxation time.

    Parameters
    ----------
    time, speed : (N,) array
        The times of the samples [s], and the speed at them.
    relaxation_time : float
        The ratio of damping and stiffness [s].
    """
    steps = np.linspace(time[0], time[-1], len(time))
    decay = float(np.exp(-(steps[1] - steps[0]) / relaxation_time))
    speed_at_steps = np.interp(steps, time, speed)
    relaxed = lfilter([relaxation_time * (1.0 - decay)], [1.0, -decay], speed_at_steps)
    return np.asarray(np.interp(time, steps, relaxed))


# ---------------------------------------------------------------- the missing force at a port


@dataclass(frozen=True, eq=False)
class TrialForce:
    """The force that the model lacks in one trial, at its samples.

    Attributes
    ----------
    trial : str
        The name of the trial.
    time : (N,) array
        The times of the samples [s].
    position, speed : (N,) array
        The motion of the port [m or rad, and per s]; at a port of a state the speed is the state.
    variables : mapping of str to (N,) array
        Further variables that the force may follow, see `explanatory_variables` [SI].
    force, deviation : (N,) array
        The smoothed force, that of a law included, and the posterior standard deviation of the part
        that no law explains [N, N m or the port's flow].
    law : (N,) array or None
        The force of the effect in the verdict along the same motion; None if it has no law here.
    is_of_state : bool
        Whether the port is one of a state, such as a temperature: its position is then without
        meaning.
    """

    trial: str
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    variables: Mapping[str, FloatArray]
    force: FloatArray
    deviation: FloatArray
    law: FloatArray | None
    is_of_state: bool = False

    @property
    def left(self) -> FloatArray:
        """The force (N,) that the law does not explain; figures draw it by its name."""
        return self.force if self.law is None else self.force - self.law


@dataclass(frozen=True, eq=False)
class MissingForce:
    """The missing force at a port, as a verdict reports it.

    Attributes
    ----------
    at_port : ForceAtPort
        The record of the force in the verdict.
    courses : sequence of TrialForce
        The force in each fitted trial.
    law : str
        The name of the effect at the port whose force is drawn with it; empty if there is none.
    """

    at_port: ForceAtPort
    courses: Sequence[TrialForce]
    law: str = ""


def missing_force(search: ForceSearch, estimate: Estimate) -> MissingForce | None:
    """Return the missing force at one port, with the law that a hypothesis has there.

    The port is that of the law of the hypothesis if it has laws at one port only, otherwise the
    port with the most evidence. If the estimate has no missing force at this port, the one that was
    estimated at this port alone is taken. The share that the law explains is not computed here.

    Returns
    -------
    MissingForce or None
        The missing force; None if no force is missing at any port.
    """
    log_evidence_without_force = max(
        at_port.log_evidence_without_force for at_port in search.estimate_by_port.values()
    )
    log_evidence_ratios = {}  # of a missing force at each port to none
    for name, at_port in search.estimate_by_port.items():
        log_evidence_ratios[name] = at_port.log_evidence - log_evidence_without_force
    if max(log_evidence_ratios.values()) < LEAST_EVIDENCE:
        return None
    terms = estimate.candidate.terms
    law_ports = {term.port for term in terms if term.port in search.ported.ports}
    if len(law_ports) == 1:
        (port,) = law_ports
    else:
        port = max(log_evidence_ratios, key=lambda name: log_evidence_ratios[name])
    port_index = search.ported.ports.index(port)
    # an estimate without a missing force at this port: take the force at the port alone
    if port_index not in estimate.processes:
        estimate = search.estimate_by_port[port]
    law_name = " and ".join(
        term.name_in_words for term in estimate.candidate.terms if term.port == port
    )
    recorded = {trial.name: trial for trial in search.ported.problem.campaign.trials}
    is_of_state = search.ported.problem.setting.scales.ports[port].of_state
    trial_forces = _with_history_of_motion(
        _forces_by_trial(
            estimate, port_index, recorded, has_law=bool(law_name), is_of_state=is_of_state
        )
    )
    unit, *_ = search.ported.problem.model.port_units(port)
    correlation_time = estimate.processes[port_index].correlation_time
    force = _force_at_port(
        trial_forces, port, unit, log_evidence_ratios, correlation_time, law_name
    )
    return MissingForce(force, trial_forces, law_name)


def _forces_by_trial(
    estimate: Estimate,
    port: int,
    recorded: Mapping[str, Trial],
    *,
    has_law: bool,
    is_of_state: bool,
) -> list[TrialForce]:
    """Return the force that the model lacks at a port in each trial, with the motion of the port.

    The model lacks the force of the hypothesis' law and the missing force, which no law explains.
    With `has_law`, the result also has the force of the law by itself. `port` is the index of the
    port, `recorded` has the trials as they were recorded, by name, and `is_of_state` says whether
    the port is one of a state.
    """
    trial_forces = []
    # the few load steps at rest tell little beside records in motion
    leaves_out_rest = any(not trial.trial.is_at_rest for trial in estimate.trials)
    filtered_trials = estimate.linearisation.filter(estimate.processes)
    for smoothed_trial, filtered_trial in zip(estimate.trials, filtered_trials, strict=True):
        trial = smoothed_trial.trial
        if trial.is_at_rest and leaves_out_rest:
            continue
        samples = slice(None, None, trial.substeps)
        law_force = smoothed_trial.effect_forces[port][samples] if has_law else None
        trial_forces.append(
            TrialForce(
                trial=trial.name,
                time=trial.time,
                position=smoothed_trial.trajectory.positions[samples, port],
                speed=smoothed_trial.trajectory.speeds[samples, port],
                variables=_inputs_and_rates(recorded[trial.name], trial.stride),
                # the law's force counts as exact: the deviation is that of the missing force alone
                force=smoothed_trial.lacking_forces[port][samples],
                deviation=filtered_trial.missing_force_deviations[port][samples],
                law=law_force,
                is_of_state=is_of_state,
            )
        )
    return trial_forces


def _inputs_and_rates(trial: Trial, stride: int) -> dict[str, FloatArray]:
    """Return the recorded inputs of a trial and their rates, at every `stride`-th sample.

    Without inputs they are the applied force and its rate, or nothing if that is zero. At rest
    there are no rates.
    """
    inputs = {f"the input {item.name!r}": item.values for item in trial.inputs}
    if not inputs and np.any(trial.force):
        inputs = {"the applied force": trial.force}
    variables = {}
    for name, values in inputs.items():
        variables[name] = values[::stride]
        if trial.is_dynamic:
            variables[RATE_OF + name] = np.gradient(values, trial.time)[::stride]
    return variables


def _force_at_port(
    trial_forces: Sequence[TrialForce],
    port: str,
    unit: str,
    log_evidence_ratio_by_port: Mapping[str, float],
    correlation_time: float,
    law_name: str,
) -> ForceAtPort:
    """Return the record of the missing force at a port for the verdict.

    Parameters
    ----------
    trial_forces : sequence of TrialForce
        The force and the motion of the port in each trial.
    unit : str
        The unit of the force.
    log_evidence_ratio_by_port : mapping of str to float
        The log evidence of a missing force at a port, minus that of no missing force [nat].
    correlation_time : float
        The correlation time of the missing force [s].
    law_name : str
        The effects with a law at the port, in words; empty if there is none.
    """
    force = np.concatenate([trial_force.force for trial_force in trial_forces])
    position = np.concatenate([trial_force.position for trial_force in trial_forces])
    speed = np.concatenate([trial_force.speed for trial_force in trial_forces])
    # the share of the variance that each variable explains, and the variables that explain most
    shares, explanatory_names = _explanatory_variables_of_trials(trial_forces)
    # the trial and the sample with the largest force
    trial = max(trial_forces, key=lambda trial_force: float(np.abs(trial_force.force).max()))
    sample_of_largest = int(np.abs(trial.force).argmax())
    largest = ForceMoment(
        trial=trial.trial,
        time=float(trial.time[sample_of_largest]),
        force=float(trial.force[sample_of_largest]),
        displacement=float(trial.position[sample_of_largest]),
        speed=float(trial.speed[sample_of_largest]),
    )
    return ForceAtPort(
        port=port,
        unit=unit,
        rms=_rms(force),
        displacement=_rms(position),
        speed=_rms(speed),
        largest=largest,
        evidence=log_evidence_ratio_by_port,
        correlation_time=correlation_time,
        orders=shares,
        ordered_by=explanatory_names,
        law=law_name,
    )


def _explanatory_variables_of_trials(
    trial_forces: Sequence[TrialForce],
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the variables that explain the force in all trials together.

    Returns
    -------
    shares : dict of str to float
        The share of the force's variance that each variable explains, 0 to 1.
    ordered_by : tuple of str
        The variables that the force depends on, see `explanatory_variables`. If displacement and
        velocity together explain clearly more than any variable alone, as for an impact with loss,
        it is `STATE` alone.
    """
    is_of_state = trial_forces[0].is_of_state
    position = np.concatenate([trial.position for trial in trial_forces])
    # an input that was not recorded in a trial did not act there
    names = dict.fromkeys(name for trial in trial_forces for name in trial.variables)
    other_variables = {
        name: np.concatenate(
            [trial.variables.get(name, np.zeros_like(trial.force)) for trial in trial_forces]
        )
        for name in names
    }
    shares, ordered_by = explanatory_variables(
        force=np.concatenate([trial.force for trial in trial_forces]),
        position=None if is_of_state else position,
        speed=np.concatenate([trial.speed for trial in trial_forces]),
        time=np.concatenate([trial.time for trial in trial_forces]),
        other_variables=other_variables,
    )
    if is_of_state:
        return shares, ordered_by
    share_of_state = variance_explained_by_state(trial_forces)
    is_by_one_variable = max(shares.values()) > LARGEST_SINGLE_SHARE * share_of_state
    if is_by_one_variable or share_of_state < LEAST_ORDER:
        return shares, ordered_by
    return {**shares, STATE: share_of_state}, (STATE,)


def _with_history_of_motion(trial_forces: Sequence[TrialForce]) -> list[TrialForce]:
    """Add to each trial's variables the relaxed displacement that explains the force best.

    It is added only if it explains more of the force's variance than each of the other variables,
    by at least `TIED_SHARE`: with a short or long relaxation time it is nearly velocity or
    displacement.
    """
    if not any(np.any(trial.speed) for trial in trial_forces):
        return list(trial_forces)  # at rest there is no history in time
    shares, _ = _explanatory_variables_of_trials(trial_forces)
    force = np.concatenate([trial.force for trial in trial_forces])
    interval = min(float(np.median(np.diff(trial.time))) for trial in trial_forces)
    share_of_relaxation = {}
    for relaxation_time in (interval * RELAXATION_TIMES).tolist():
        relaxed = [
            relaxed_displacement(item.time, item.speed, relaxation_time) for item in trial_forces
        ]
        share_of_relaxation[relaxation_time] = explained_variance(np.concatenate(relaxed), force)
    best_time = max(
        share_of_relaxation, key=lambda relaxation_time: share_of_relaxation[relaxation_time]
    )
    if share_of_relaxation[best_time] < max(shares.values()) + TIED_SHARE:
        return list(trial_forces)
    history = AVERAGED_STATE if trial_forces[0].is_of_state else RELAXED_DISPLACEMENT
    name = f"{history} {best_time:.2g} s"
    trials_with_history = []
    for trial in trial_forces:
        relaxed_in_trial = relaxed_displacement(trial.time, trial.speed, best_time)
        variables = {**trial.variables, name: relaxed_in_trial}
        trials_with_history.append(replace(trial, variables=variables))
    return trials_with_history


def _rms(values: FloatArray) -> float:
    """Return the root mean square of values (N,)."""
    return float(np.sqrt(np.mean(values**2)))


def missing_force_of_verdict(
    problem: Problem,
    search: ForceSearch | None,
    estimate: Estimate | None,
    fit: CandidateFit,
    *,
    is_named: bool,
) -> MissingForce | None:
    """Return the missing force for a verdict, with the share of it that its law explains.

    Parameters
    ----------
    search : ForceSearch or None
        The search for the missing force, if there was one.
    estimate : Estimate or None
        The estimate of the effects of the verdict. If there is none, they are estimated now.
    fit : CandidateFit
        The fit of the verdict.
    is_named : bool
        Whether the verdict names the effects of the fit.

    Returns
    -------
    MissingForce or None
        The missing force; None if no force is missing or can be estimated, or if the verdict names
        effects none of which acts at a port, such as errors of sensors.
    """
    terms = fit.candidate.terms
    try:
        ports = problem.model.ports
        laws = [term for term in terms if term.port in ports]
        if not can_estimate_forces(problem) or (terms and not laws and is_named):
            return None
        search = search or ForceSearch(problem)
        if not laws:
            return missing_force(search, search.estimate_without_effects)
        if estimate is None:
            estimate = search.estimate_of_simulation(fit.candidate, fit.point)
        force = missing_force(search, estimate or search.estimate_without_effects)
    except ESTIMATION_ERRORS:
        return None
    if force is None or not force.law or estimate is None:
        return force
    at_port = force.at_port
    if len({law.port for law in laws}) > 1:
        names_at_ports = [f"{law.name_in_words} at {law.place}" for law in laws]
        at_port = replace(at_port, law=" and ".join(names_at_ports))
    if estimate.leaves_no_force:
        return replace(force, at_port=at_port)
    # if the shares cannot be computed, the force is returned without them
    with suppress(*ESTIMATION_ERRORS):
        shares = ForceShares(search)
        held_out = None
        if shares.has_held_out:
            held_out = _remaining_force(shares.gap_share(estimate, held_out=True))
        fitted_remainder = _remaining_force(shares.gap_share(estimate, held_out=False))
        at_port = replace(at_port, fitted=fitted_remainder, held_out=held_out)
    return replace(force, at_port=at_port)


def _remaining_force(share: GapShare) -> ForceLeft:
    """Return the rms of the missing force without and with a law, for the verdict."""
    return ForceLeft(
        share.remaining_rms, share.total_rms, trials=share.trial_count, tested=share.is_tested
    )
