"""Simulated experiments on a wing whose true state is known.

Every experiment needs a `TestBench`. `VirtualWing` implements it by a reduced model with a known
digital state, and `twin_master.assets.virtual_experiments` by an FMU. The functions `measure_...`
do the experiments of the paper on a bench, with reading errors and a seed.
"""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from calibration.dynamics.records import RingDownRecord
from calibration.errors import ExperimentDataError
from calibration.joint.wing_table import weighed_mass
from calibration.result.record import QuantityReading
from calibration.static.experiments import (
    HALF_WIDTH_95,
    LoadDisplacementData,
    published_measurements,
)
from calibration.static.posterior import Seed, child_seed
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState, Geometry
from reporting.arrays import Float

from .geometry import READING_UNCERTAINTY, Lengths, MeasuredLength, published_lengths

SENSITIVITY = 50.0
"""Signal for a unit strain: a quarter bridge of gauge factor 2 at 5 V, amplified 20 times [V]."""

RECORDED_GAUGE = 23
"""Number of the gauge whose strain is recorded, from 1. After a release of the tip, mode 2 has a
quarter of the strain of mode 1 there, and higher modes hardly any; nearer to the root mode 2 is
small beside mode 1."""

MOST_SAMPLES = 10_000_000
"""Largest number of samples of all records; more need gigabytes and improve nothing."""

# Numbers of the purposes of a seed
_LOAD_TEST = 31
_RING_DOWN = 32
_GEOMETRY = 33
_WEIGHING = 34

_RELEASE_DEVIATION = 0.05  # relative standard deviation of the tip displacement at release


RingDownSignal = tuple[Float, Float]
"""A recorded signal: times (N,) from the release on [s] and values (N,) [V]."""


class TestBench(Protocol):
    """A wing, real or simulated, that can be loaded and released, and is read without error."""

    def tip_displacement(self, load: float) -> float:
        """Return the displacement [m] of the point 5 cm from the tip under a load there [N]."""

    def ring_down(
        self, initial_tip_displacement: float, duration: float, sampling_rate: float
    ) -> RingDownSignal:
        """Return the signal after a release of the tip.

        Parameters
        ----------
        initial_tip_displacement : float
            The displacement of the tip at its release [m].
        duration : float
            The duration of the record [s].
        sampling_rate : float
            The sampling rate [Hz].
        """


def check_recorded(gauges: int) -> None:
    """Raise `ExperimentDataError` if a wing has fewer than `RECORDED_GAUGE` gauges."""
    if gauges < RECORDED_GAUGE:
        raise ExperimentDataError(
            f"the wing has {gauges} gauges, but a release is recorded at gauge {RECORDED_GAUGE}."
        )


def sampling_times(duration: float, sampling_rate: float) -> Float:
    """Return the times of a record [s], from 0 to `duration`.

    Raises
    ------
    ExperimentDataError
        If duration [s] or rate [Hz] is not positive and finite, or the record has no two samples.
    """
    are_positive = 0.0 < duration < math.inf and 0.0 < sampling_rate < math.inf
    if not are_positive or duration * sampling_rate < 1.0:
        raise ExperimentDataError(
            f"a record needs a positive duration and sampling rate, but {duration:g} s at "
            f"{sampling_rate:g} Hz were asked for."
        )
    intervals = int(duration * sampling_rate + 1e-9)  # a product just below a whole number counts
    return np.arange(intervals + 1) / sampling_rate


@dataclass(frozen=True, eq=False)
class VirtualWing:
    """A reduced model with a known digital state, as a `TestBench`.

    Attributes
    ----------
    truth : DigitalState
        The true state of the wing; the geometry is that of the model.
    frequency_error : (float, float)
        The relative differences delta between this wing's two flapwise frequencies and its model's
        [1]: the effect of what the model leaves out. Mode shapes and damping ratios are the
        model's.

    Raises
    ------
    ExperimentDataError
        If the wing has fewer gauges than `RECORDED_GAUGE`, or a frequency error is not above -1.
    fe.runtime.errors.OutsideModelError
        If the true state lies outside the range of the model.
    """

    model: ReducedModel
    truth: DigitalState
    frequency_error: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check_recorded(len(self.model.gauges))
        if not all(math.isfinite(error) and error > -1.0 for error in self.frequency_error):
            errors = " and ".join(f"{error:g}" for error in self.frequency_error)
            raise ExperimentDataError(
                f"a relative frequency error must be finite and above -1, but {errors} were given."
            )
        # The model refuses a truth outside its range.
        self.model.modes(self.truth.values, self.truth.stiffness_loss)

    def tip_displacement(self, load: float) -> float:
        """Return the displacement [m] of the point 5 cm from the tip under a load there [N]."""
        state = self.truth
        stiffness = self.model.tip_stiffness(state.young_modulus_factor, state.stiffness_loss)
        return load / stiffness

    def ring_down(
        self, initial_tip_displacement: float, duration: float, sampling_rate: float
    ) -> RingDownSignal:
        """Return the strain signal after a release of the tip, the sum of all modes' decays.

        Parameters
        ----------
        initial_tip_displacement : float
            The displacement of the tip at its release [m].
        duration : float
            The duration of the record [s].
        sampling_rate : float
            The sampling rate [Hz].
        """
        time = sampling_times(duration, sampling_rate)
        state = self.truth
        vector = self.model.vector(state.values, state.stiffness_loss)
        modes = self.model.modes(vector)
        static_response = self.model.static_response(vector, load=np.array((0.0, 1.0)))

        # Modal coordinates at the release, for a unit displacement of the tip. A unit load gives
        # the coordinate participation / omega^2, and the static response's tip displacement.
        angular_frequency = 2.0 * math.pi * modes.frequency
        initial_coordinate = (
            modes.participation[1] / angular_frequency**2 / static_response.displacement[0]
        )
        initial_strain = modes.output[RECORDED_GAUGE - 1] * initial_coordinate

        for mode, error in zip(modes.followed, self.frequency_error, strict=True):
            angular_frequency[mode] *= 1.0 + error
        damping_ratio = rayleigh_damping_ratio(
            state.damping_alpha, state.damping_beta, modes.frequency
        )
        strain = np.zeros_like(time)
        for mode, amplitude in enumerate(initial_strain):
            strain += amplitude * _free_decay(
                float(angular_frequency[mode]), float(damping_ratio[mode]), time
            )
        return time, SENSITIVITY * initial_tip_displacement * strain


def _free_decay(omega: float, zeta: float, time: Float) -> Float:
    """Return the free decay of an oscillator from a displacement of 1.

    It solves q'' + 2 zeta omega q' + omega^2 q = 0 with q(0) = 1, q'(0) = 0; zeta may exceed 1.
    """
    root = np.sqrt(complex(zeta**2 - 1.0))
    if abs(root) < 1e-8:  # critical damping, where both poles are equal
        return np.asarray((1.0 + omega * time) * np.exp(-omega * time))
    # Poles s1, s2 of the oscillator: q = (s2 exp(s1 t) - s1 exp(s2 t)) / (s2 - s1)
    slow_pole = omega * (-zeta + root)
    fast_pole = omega * (-zeta - root)
    slow_term = fast_pole * np.exp(slow_pole * time)
    fast_term = slow_pole * np.exp(fast_pole * time)
    decay = (fast_term - slow_term) / (slow_pole - fast_pole)
    return np.asarray(decay.real)


def measure_load_test(bench: TestBench, seed: Seed) -> LoadDisplacementData:
    """Simulate a load test as in the paper: two runs of 250 to 1000 g near the tip.

    The true load is the nominal one; load and displacement are both read with the paper's errors.
    """
    paper = published_measurements()
    generator = np.random.default_rng(child_seed(seed, _LOAD_TEST))
    displacement = np.array([bench.tip_displacement(float(load)) for load in paper.load])
    load = paper.load + generator.normal(0.0, paper.load_standard_deviation, paper.count)
    displacement += generator.normal(0.0, paper.displacement_standard_deviation, paper.count)
    return replace(paper, load=load, displacement=displacement, source="virtual load test")


def measure_ring_down(
    bench: TestBench,
    seed: Seed,
    *,
    trials: int = 5,
    initial_tip_displacement: float = 0.03,
    duration: float = 6.4,
    sampling_rate: float = 2000.0,
    noise: float = 1e-4,
    quantisation: float | None = None,
) -> tuple[RingDownRecord, ...]:
    """Simulate records of the strain after several releases of the tip.

    Parameters
    ----------
    trials : int
        The number of records.
    initial_tip_displacement : float
        The nominal displacement of the tip at its release [m]. The true one has a standard
        deviation of 5 %, as of a hand.
    duration, sampling_rate : float
        The duration [s] and sampling rate [Hz] of a record; the published ones last 6.5 s at 100
        kHz.
    noise : float
        The standard deviation of a sample [V]; about 1 % of the first mode by default.
    quantisation : float, optional
        The resolution of the recorder [V]; by default values are not rounded.

    Raises
    ------
    ExperimentDataError
        If the resolution is not positive, or the records would be too short or too long.
    """
    if MOST_SAMPLES < trials * duration * sampling_rate < math.inf:
        raise ExperimentDataError(
            f"{trials} records of {duration:g} s at {sampling_rate:g} Hz are more than "
            f"{MOST_SAMPLES:,} samples: take fewer, shorter or slower ones."
        )
    if quantisation is not None and not (math.isfinite(quantisation) and quantisation > 0.0):
        raise ExperimentDataError(
            f"the recorder's step must be positive, but {quantisation:g} V was given."
        )
    generator = np.random.default_rng(child_seed(seed, _RING_DOWN))
    records = []
    for trial in range(1, trials + 1):
        # release by hand, noise of the recorder, and its resolution
        relative_error = _RELEASE_DEVIATION * float(generator.standard_normal())
        tip_displacement = initial_tip_displacement * (1.0 + relative_error)
        time, signal = bench.ring_down(tip_displacement, duration, sampling_rate)
        signal = signal + generator.normal(0.0, noise, signal.size)
        if quantisation is not None:
            signal = quantisation * np.round(signal / quantisation)
        records.append(RingDownRecord(time, signal, source=f"virtual ring-down {trial}"))
    return tuple(records)


def measure_lengths(
    geometry: Geometry,
    seed: Seed,
    *,
    designed: Geometry | None = None,
) -> Lengths:
    """Simulate readings of semi-span and chords of a wing.

    Parameters
    ----------
    geometry : Geometry
        The true lengths [m].
    designed : Geometry, optional
        The designed lengths [m]; the published ones by default.
    """
    generator = np.random.default_rng(child_seed(seed, _GEOMETRY))
    deviation = READING_UNCERTAINTY / HALF_WIDTH_95
    lengths = []
    for published in published_lengths():
        name = published.name
        reading = getattr(geometry, name) + generator.normal(0.0, deviation)
        designed_length = published.designed if designed is None else getattr(designed, name)
        lengths.append(MeasuredLength(name, designed_length, reading))
    return Lengths(*lengths)


def weigh(truth: DigitalState, seed: Seed, *, standard_deviation: float = 1e-3) -> QuantityReading:
    """Simulate a weighing of two servos and the pitot tube.

    Parameters
    ----------
    truth : DigitalState
        The true masses.
    standard_deviation : float
        The standard deviation of the weighing [kg].
    """
    generator = np.random.default_rng(child_seed(seed, _WEIGHING))
    error = float(generator.normal(0.0, standard_deviation))
    total_mass = 2.0 * truth.servo_mass + truth.pitot_mass
    return weighed_mass(total_mass + error, standard_deviation)
