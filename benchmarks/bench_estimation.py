"""Fit of a law by simulation and log likelihood of a linear system, beside SciPy and statsmodels.

A mass on a spring with a cubic part is pushed by a recorded force. Our estimator and SciPy's
least squares find mass, damping, cubic stiffness and initial state of the same record under the
same priors. A chain of three masses under white forces is filtered by our Kalman filter and by that
of statsmodels. Processor seconds, each the least of several.
"""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint
from scipy.optimize import least_squares

from benchmarks.measurement import (
    Measurement,
    compared,
    least_processor_seconds,
    peer_version,
)
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    NoiseRecord,
    Quantity,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.estimation.kernel import filter_record
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.two_filters import RecordFilter
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.trials_in_motion.steps import discretise
from fe.runtime.patch import PowerStiffness

Float = NDArray[np.float64]

MASS = 10.0
"""Mass of the model [kg]."""
STIFFNESS = 4000.0
"""Stiffness of the model [N/m]."""
DAMPING = 20.0
"""Damping of the model [N s/m]."""
TRUE_FACTORS = (1.03, 0.8)
"""Mass and damping of the true rig over those of the model."""
CUBIC_STIFFNESS = 1.0e5
"""Cubic stiffness of the true rig [N/m^3], which the model lacks."""
DEVIATIONS = (0.05, 0.3)
"""Prior standard deviations of the factors of mass and damping."""
NOISE = 2e-5
"""Standard deviation of the noise of the readings [m]."""
INTERVAL = 0.004
"""Interval between two samples [s]."""
SAMPLES = 1000
FILTERED_SAMPLES = 5000

MODEL = f"""
format = 1
name = "Spring"
mass = {MASS}
stiffness = {STIFFNESS}
damping = {{ matrix = {DAMPING} }}
input = [{{ name = "push", vector = 1.0 }}]
output = [{{ name = "x", vector = 1.0, quantity = "displacement" }}]
port = [{{ name = "spring", vector = 1.0 }}]
parameter = [
  {{ name = "mass", terms = "mass", deviation = {DEVIATIONS[0]}, low = 0.5, high = 1.5 }},
  {{ name = "damping", terms = "damping", deviation = {DEVIATIONS[1]}, low = 0.2, high = 3.0 }},
]
"""


@dataclass(frozen=True)
class PushedSpring:
    """A record of the true rig.

    Attributes
    ----------
    time, force, readings : (N,) ndarray
        Time [s], force [N] between whose samples it is linear, and read displacement [m].
    """

    time: Float
    force: Float
    readings: Float

    def displacement(
        self, mass_factor: float, damping_factor: float, cubic: float, start: Float
    ) -> Float:
        """Return the displacement (N,) [m] by SciPy's `odeint`, which is LSODA.

        Parameters
        ----------
        mass_factor, damping_factor : float
            Mass and damping over those of the model.
        cubic : float
            The cubic stiffness [N/m^3].
        start : (2,) array
            Displacement [m] and velocity [m/s] at the first sample.
        """
        forces = self.force.tolist()
        last = len(forces) - 2
        mass, damping = mass_factor * MASS, damping_factor * DAMPING

        def rate(state: Float, moment: float) -> tuple[float, float]:
            x, velocity = state.tolist()
            sample = min(int(moment / INTERVAL), last)
            slope = forces[sample + 1] - forces[sample]
            push = forces[sample] + slope * (moment / INTERVAL - sample)
            internal = STIFFNESS * x + cubic * x**3 + damping * velocity
            return velocity, (push - internal) / mass

        motion = odeint(rate, start, self.time, rtol=1e-9, atol=1e-11, hmax=INTERVAL)
        return np.asarray(motion[:, 0])


def run() -> Iterator[Measurement]:
    """Measure the fit of the law, then the log likelihood of the linear system."""
    spring = pushed_spring()
    problem, candidate = fit_problem(spring)
    start = problem.prior_mean_point(candidate)
    ours = fit(problem, candidate, start)
    our_seconds = least_processor_seconds(lambda: fit(problem, candidate, start), repeats=5)
    theirs = fit_by_scipy(spring)
    their_seconds = least_processor_seconds(lambda: fit_by_scipy(spring), repeats=1)
    yield Measurement(f"fit of a cubic spring, {SAMPLES} samples", our_seconds, "s").beside(
        "least_squares over odeint",
        their_seconds,
        peer=peer_version("scipy"),
        agreement=compared(
            "parameters over their true values",
            fitted_ratios(problem, candidate, ours),
            theirs,
            1e-3,
        ),
    )
    yield filter_beside_statsmodels()


def fit_law() -> CandidateFit:
    """Return our fit of the cubic spring to its record."""
    problem, candidate = fit_problem(pushed_spring())
    return fit(problem, candidate, problem.prior_mean_point(candidate))


def pushed_spring() -> PushedSpring:
    """Return a record of the true rig from rest, under a force of six sines."""
    generator = np.random.default_rng(4)
    time = np.asarray(np.arange(SAMPLES) * INTERVAL, dtype=np.float64)
    frequencies = 2.0 * np.pi * generator.uniform(0.5, 5.0, 6)
    force = 40.0 * np.sin(time[:, None] * frequencies + generator.uniform(0.0, 6.0, 6)).sum(axis=1)
    silent = PushedSpring(time, force, np.zeros(SAMPLES))
    displacement = silent.displacement(*TRUE_FACTORS, CUBIC_STIFFNESS, np.zeros(2))
    readings = displacement + NOISE * generator.standard_normal(SAMPLES)
    return PushedSpring(time, force, readings)


def fit_problem(spring: PushedSpring) -> tuple[Problem, Candidate]:
    """Return the record as a problem of the search, and the candidate that is fitted to it."""
    trial = Trial.plain(
        "pushed",
        TrialKind.FORCED,
        ("x",),
        spring.time,
        values=spring.readings[:, None],
        force=spring.force,
        load_place="push",
        begins=Start.UNKNOWN,
    )
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, np.inf))
    campaign = Campaign("spring", {"x": channel}, (trial,), None, {}, "0" * 64)
    model = LumpedModel(LumpedDescription.parse(tomllib.loads(MODEL)))
    setting = Setting(campaign, model, model.scales(campaign))
    cubic = next(effect for effect in library() if effect.identifier == "cubic_stiffness")
    return Problem(campaign, model, setting), Candidate((EffectTerm(cubic, "spring"),))


def fitted_ratios(problem: Problem, candidate: Candidate, fitted: CandidateFit) -> Float:
    """Return mass factor, damping factor and cubic stiffness over the true values (3,)."""
    mass_factor, damping_factor = problem.shared.parameters(fitted.shared)
    (law,) = candidate.patch(problem.setting, fitted.effect)
    assert isinstance(law, PowerStiffness)
    cubic = law.coefficient / law.reference_displacement**3
    return np.array([mass_factor, damping_factor, cubic]) / (*TRUE_FACTORS, CUBIC_STIFFNESS)


def fit_by_scipy(spring: PushedSpring) -> Float:
    """Return the same ratios by least squares of SciPy, from the model without a cubic part."""
    scales = np.array([*DEVIATIONS, CUBIC_STIFFNESS, 1e-4, 1e-3])

    def residuals(shifted: Float) -> Float:
        scaled = shifted - 1.0
        mass_change, damping_change, cubic, *start = scaled * scales
        simulated = spring.displacement(
            1.0 + mass_change, 1.0 + damping_change, cubic, np.array(start)
        )
        return np.concatenate(((simulated - spring.readings) / NOISE, scaled[:2]))

    # The default step of the difference quotients is smaller than the errors of the integrator, and
    # a step is relative to the unknown: all unknowns begin at one.
    solution = least_squares(residuals, np.ones(5), diff_step=1e-4, x_scale="jac")
    mass_change, damping_change, cubic = (solution.x[:3] - 1.0) * scales[:3]
    ratios = np.array([1.0 + mass_change, 1.0 + damping_change, cubic])
    return np.asarray(ratios / (*TRUE_FACTORS, CUBIC_STIFFNESS))


def filter_beside_statsmodels() -> Measurement:
    """Measure the log likelihood of a chain of three masses beside statsmodels."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    record, covariance = chain_record()
    steps = np.zeros(FILTERED_SAMPLES, dtype=np.int64)
    steps[0] = -1  # no step leads to the first sample
    mean = np.zeros((len(covariance), 1))

    def ours() -> float:
        innovations, _, variances, _, _ = filter_record(
            1,
            steps,
            record.transitions,
            record.noises,
            record.output_rows[None],
            record.columns,
            record.used,
            covariance,
            mean,
            False,
        )
        squares = np.sum(innovations[:, :, 0] ** 2 / variances)
        return float(-0.5 * np.sum(squares + np.sum(np.log(2.0 * np.pi * variances))))

    channels, states = record.output_rows.shape
    peer = KalmanFilter(channels, states)
    peer.bind(np.ascontiguousarray(record.columns[:, :, 0]))
    peer["design"] = record.output_rows
    peer["obs_cov"] = np.eye(channels)
    peer["transition"] = record.transitions[0]
    peer["selection"] = np.eye(states)
    peer["state_cov"] = record.noises[0]
    peer.initialize_known(np.zeros(states), covariance)
    agreement = compared("log likelihoods", ours(), peer.loglike(), 1e-9)
    our_seconds = least_processor_seconds(ours, repeats=15)
    their_seconds = least_processor_seconds(peer.loglike, repeats=15)
    name = f"log likelihood of {FILTERED_SAMPLES:,} samples, {states} states, {channels} channels"
    return Measurement(name, 1e3 * our_seconds, "ms").beside(
        "Kalman filter", 1e3 * their_seconds, peer=peer_version("statsmodels"), agreement=agreement
    )


def chain_record() -> tuple[RecordFilter, Float]:
    """Return a record of a chain of three masses under white forces, and its first covariance.

    The readings are displacements over the standard deviation of their noise.
    """
    generator = np.random.default_rng(5)
    stiffness = 100.0 * (2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1))
    rate_matrix = np.block([[np.zeros((3, 3)), np.eye(3)], [-stiffness, -0.5 * np.eye(3)]])
    intensity = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    transitions, noises = discretise(rate_matrix, intensity, np.array([0.02]))
    covariance = 0.01 * np.eye(6)
    output_rows = np.hstack([np.eye(3), np.zeros((3, 3))]) / 0.01
    state = generator.multivariate_normal(np.zeros(6), covariance)
    readings = np.empty((FILTERED_SAMPLES, 3))
    for sample in range(FILTERED_SAMPLES):
        if sample:
            noise = generator.multivariate_normal(np.zeros(6), noises[0])
            state = transitions[0] @ state + noise
        readings[sample] = output_rows @ state + generator.standard_normal(3)
    used = np.ones(readings.shape, dtype=bool)
    record = RecordFilter(transitions, noises, output_rows, used, readings[:, :, None])
    return record, covariance
