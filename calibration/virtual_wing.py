"""A wing that never was on the test bench: experiments of which the truth is known.

`TestBench` is what every experiment needs of a wing; `VirtualWing` is a reduced model with a digital state as
its truth, `twin_master.assets.virtual_experiments` has the FMU behind the same interface. The functions
`measure_...` do the experiments of the paper on a bench, with reading errors and a seed.
"""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from calibration.dynamics.records import RingDownRecord
from calibration.errors import ExperimentDataError, said
from calibration.joint.wing_table import weighed
from calibration.result.record import Reading
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
"""Volts per unit strain: a quarter bridge of gauge factor 2 at 5 V, amplified 20 times [V]."""

RECORDED_GAUGE = 23
"""The gauge whose strain is recorded, counted from 1: a released tip moves mode 2 by a quarter of mode
1 there, the higher modes hardly; nearer to the root mode 2 is lost behind mode 1."""

MOST_SAMPLES = 10_000_000
"""Most samples of all records: beyond, they need gigabytes and tell nothing more."""

_PURPOSES = {"load": 31, "ring_down": 32, "geometry": 33, "weighing": 34}


RingDownSignal = tuple[Float, Float]
"""What a recorder saw: instants (N,) from the release on [s] and signal (N,) [V]."""


class TestBench(Protocol):
    """A wing, real or not, that can be loaded and let go. It reads without error."""

    def tip_displacement(self, load: float) -> float:
        """Return the displacement [m] of the load point, 5 cm from the tip, under a load there [N]."""

    def ring_down(
        self, initial_tip_displacement: float, duration: float, sampling_rate: float
    ) -> RingDownSignal:
        """Hold the tip aside [m], let it go, and record for `duration` [s] at `sampling_rate` [Hz]."""


def check_recorded(gauges: int) -> None:
    """Refuse a wing with too few gauges.

    Raises
    ------
    ExperimentDataError
        If it has fewer than `RECORDED_GAUGE`.
    """
    if gauges < RECORDED_GAUGE:
        raise ExperimentDataError(said("virtual.gauges", gauges=gauges, recorded=RECORDED_GAUGE))


def sampling_times(duration: float, sampling_rate: float) -> Float:
    """Return the instants of a record [s], from 0 to `duration`.

    Raises
    ------
    ExperimentDataError
        If duration or rate is not positive and finite, or no two samples fit.
    """
    if not (0.0 < duration < math.inf and 0.0 < sampling_rate < math.inf and duration * sampling_rate >= 1.0):
        asked = duration, sampling_rate
        raise ExperimentDataError(said("virtual.duration", asked=asked))
    return np.arange(int(duration * sampling_rate + 1e-9) + 1) / sampling_rate


@dataclass(frozen=True, eq=False)
class VirtualWing:
    """A reduced model with a known digital state, in the manner of `TestBench`.

    Attributes
    ----------
    model : ReducedModel
        The wing.
    truth : DigitalState
        Its true state; the geometry is that of the model.
    frequency_error : (float, float)
        Relative differences delta between this wing's two flapwise frequencies and its model's [1]: what
        the model leaves out. Mode shapes and damping ratios stay the model's.

    Raises
    ------
    ExperimentDataError
        If the wing has fewer gauges than `RECORDED_GAUGE`, or a frequency error is not above -1.
    fe.runtime.errors.OutsideModelError
        If the truth lies outside the model.
    """

    model: ReducedModel
    truth: DigitalState
    frequency_error: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check_recorded(len(self.model.gauges))
        if not all(math.isfinite(error) and error > -1.0 for error in self.frequency_error):
            given = " and ".join(f"{error:g}" for error in self.frequency_error)
            raise ExperimentDataError(said("virtual.frequency_error", given=given))
        self.model.modes(self.truth.values, self.truth.stiffness_loss)  # refuses a truth outside the model

    def tip_displacement(self, load: float) -> float:
        """Return the displacement [m] of the load point under a load there [N]."""
        return load / self.model.tip_stiffness(self.truth.young_modulus_factor, self.truth.stiffness_loss)

    def ring_down(
        self, initial_tip_displacement: float, duration: float, sampling_rate: float
    ) -> RingDownSignal:
        """Return the strain signal after the tip is let go: each mode's free decay, exactly."""
        time = sampling_times(duration, sampling_rate)
        truth, model = self.truth, self.model
        vector = model.vector(truth.values, truth.stiffness_loss)
        modes, held = model.modes(vector), model.static_response(vector, load=np.array((0.0, 1.0)))
        omega = 2.0 * math.pi * modes.frequency
        released = modes.participation[1] / omega**2 / held.displacement[0]  # of each mode, per displacement
        for mode, error in zip(modes.followed, self.frequency_error, strict=True):
            omega[mode] *= 1.0 + error
        zeta = rayleigh_damping_ratio(truth.damping_alpha, truth.damping_beta, modes.frequency)
        signal = np.zeros_like(time)
        for mode, strain in enumerate(modes.output[RECORDED_GAUGE - 1] * released):
            signal += strain * _free_decay(float(omega[mode]), float(zeta[mode]), time)
        return time, SENSITIVITY * initial_tip_displacement * signal


def _free_decay(omega: float, zeta: float, time: Float) -> Float:
    """Return q(t) of q'' + 2 zeta omega q' + omega^2 q = 0 with q(0) = 1, q'(0) = 0."""
    root = np.sqrt(complex(zeta**2 - 1.0))
    if abs(root) < 1e-8:
        return np.asarray((1.0 + omega * time) * np.exp(-omega * time))
    slow, fast = omega * (-zeta + root), omega * (-zeta - root)
    decay = (slow * np.exp(fast * time) - fast * np.exp(slow * time)) / (slow - fast)
    return np.asarray(decay.real)


# ---------------------------------------------------------------------- the experiments


def measure_load_test(bench: TestBench, seed: Seed) -> LoadDisplacementData:
    """Hang the paper's weights near the tip, in its two runs of 250 to 1000 g, and read the displacement.

    The true load is the nominal one; load and displacement are then both read with the paper's errors.

    Parameters
    ----------
    bench : TestBench
        The wing.
    seed : int or SeedSequence
        Of the reading errors.
    """
    paper = published_measurements()
    generator = np.random.default_rng(child_seed(seed, _PURPOSES["load"]))
    displacement = np.array([bench.tip_displacement(float(value)) for value in paper.load])
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
    """Let the tip go several times and record the strain.

    Parameters
    ----------
    bench : TestBench
        The wing.
    seed : int or SeedSequence
        Of noise and releases.
    trials : int
        Number of records.
    initial_tip_displacement : float
        How far the tip is held aside [m]; a hand holds it to 5 % (standard deviation).
    duration, sampling_rate : float
        Of a record [s], [Hz]; the published ones last 6.5 s at 100 kHz.
    noise : float
        Standard deviation of a sample [V]; about 1 % of the first mode by default.
    quantisation : float, optional
        Step of the recorder [V]; none by default.

    Raises
    ------
    ExperimentDataError
        If the step is not positive, or the records would be too short or too long.
    """
    if MOST_SAMPLES < trials * duration * sampling_rate < math.inf:
        asked = trials, duration, sampling_rate, MOST_SAMPLES
        raise ExperimentDataError(said("virtual.samples", asked=asked))
    if quantisation is not None and not (math.isfinite(quantisation) and quantisation > 0.0):
        raise ExperimentDataError(f"the recorder's step must be positive, but {quantisation:g} V was given.")
    generator = np.random.default_rng(child_seed(seed, _PURPOSES["ring_down"]))
    records = []
    for trial in range(1, trials + 1):
        held = initial_tip_displacement * (1.0 + 0.05 * float(generator.standard_normal()))
        time, signal = bench.ring_down(held, duration, sampling_rate)
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
    """Measure semi-span and chords of a wing.

    Parameters
    ----------
    geometry : Geometry
        True lengths [m].
    seed : int or SeedSequence
        Of the reading errors.
    designed : Geometry, optional
        The drawing that it was built to; the published one by default.
    """
    generator = np.random.default_rng(child_seed(seed, _PURPOSES["geometry"]))
    measured = []
    for drawn in published_lengths():
        length = getattr(geometry, drawn.name) + generator.normal(0.0, READING_UNCERTAINTY / HALF_WIDTH_95)
        intended = drawn.designed if designed is None else getattr(designed, drawn.name)
        measured.append(MeasuredLength(drawn.name, intended, length))
    return Lengths(*measured)


def weigh(truth: DigitalState, seed: Seed, *, standard_deviation: float = 1e-3) -> Reading:
    """Weigh two servos and the pitot tube together.

    Parameters
    ----------
    truth : DigitalState
        True masses.
    seed : int or SeedSequence
        Of the reading error.
    standard_deviation : float
        Of the weighing [kg].
    """
    generator = np.random.default_rng(child_seed(seed, _PURPOSES["weighing"]))
    error = float(generator.normal(0.0, standard_deviation))
    return weighed(2.0 * truth.servo_mass + truth.pitot_mass + error, standard_deviation)
