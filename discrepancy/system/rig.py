"""Matrices and controllers of a lumped model at given parameters, patch and temperature."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from discrepancy.campaign.records import FloatArray, Hold, RecordedInput, Trial
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Load
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_sections import (
    GAINS,
    ControllerSection,
    Damping,
    LoadSection,
    PlaceSection,
)
from discrepancy.system.output_equation import OutputEquation
from discrepancy.system.system_state import SystemState
from discrepancy.system.time_history import RecordedHistory
from fe.runtime.patch import ModelPatch, ModulusTemperature, PointMass, SupportCompliance

LEAST_STIFFNESS = 0.05
"""A temperature that leaves less than this fraction of the stiffness is refused."""


class OffsetInput(NamedTuple):
    """A recorded input, and a constant to add to its readings [SI]."""

    recorded: RecordedInput
    offset: float

    @property
    def values(self) -> FloatArray:
        """The values (N,) that truly acted: the recorded values plus the constant [SI]."""
        return self.recorded.values + self.offset


@dataclass(frozen=True)
class ControlLoop:
    """A controller in a rig of N unknowns, with its gains times their factors.

    Attributes
    ----------
    section : ControllerSection
        The controller in the file.
    proportional, derivative, integral : float
        The gains on the error, on its rate and on its integral.
    measured : (4, N) ndarray
        Rows of the measured quantity, in the form of `OutputEquation.rows`.
    direction : (N,) ndarray
        The load for a controller output of one.
    error_integral : (N,) ndarray
        One at the unknown that is the integral of the error, else zero; all zero without an
        integral gain.
    """

    section: ControllerSection
    proportional: float
    derivative: float
    integral: float
    measured: FloatArray
    direction: FloatArray
    error_integral: FloatArray

    @property
    def output_rows(self) -> FloatArray:
        """Rows (4, N) of the controller's output at a reference of zero.

        The rows have the form of `OutputEquation.rows`; without a reference the error is minus the
        measured quantity.
        """
        # row k multiplies the k-th time derivative: a shift by one row differentiates (the last
        # row, which is zero, comes first)
        measured_rate = np.roll(self.measured, 1, axis=0)
        rows = -self.proportional * self.measured - self.derivative * measured_rate
        rows[1] += self.integral * self.error_integral
        return rows

    def reference_loads(self, trial: Trial, inputs: Mapping[str, OffsetInput]) -> list[Load]:
        """Return the loads that follow from the recorded reference of the controller.

        There are none if the trial does not record its reference. The reference drives the
        proportional force and the integral of the error; the derivative gain adds a second load.

        Raises
        ------
        ModelError
            If the reference has another quantity than the controller, or is held constant between
            its samples although the controller differentiates it.
        """
        section = self.section
        if section.reference is None or section.reference not in inputs:
            return []
        reference = inputs[section.reference]
        recorded_input = reference.recorded
        if recorded_input.quantity is not section.quantity:
            raise ModelError(
                f"The controller {section.name!r} follows {section.quantity.value}, but the trial "
                f"{trial.name!r} records its reference {recorded_input.name!r} as "
                f"{recorded_input.quantity.value}."
            )
        history = RecordedHistory(trial.time, reference.values, recorded_input.hold)
        loads = [Load(self.proportional * self.direction + self.error_integral, history)]
        if self.derivative != 0.0 and section.derivative_of == "error":
            if history.hold is Hold.ZERO_ORDER:
                raise ModelError(
                    f"The reference {section.reference!r} of the trial {trial.name!r} goes in "
                    f"steps, which the controller {section.name!r} cannot differentiate: set "
                    "derivative_of = 'measurement' in the model, or hold = 'linear' in the "
                    "campaign."
                )
            loads.append(Load(self.derivative * self.direction, history, derivative=1))
        return loads


@dataclass(frozen=True)
class Rig:
    """A lumped model at values of its parameters, under a patch of its structure.

    Attributes
    ----------
    factors : mapping of str to float
        The factors of the terms by name.
    matrices : mapping of str to (N, N) ndarray
        Matrices by kind, and their parts by name.
    loops : mapping of str to ControlLoop
        The controllers by their names.
    """

    factors: Mapping[str, float]
    matrices: Mapping[str, FloatArray]
    loops: Mapping[str, ControlLoop]

    def term_factor(self, name: str) -> float:
        """Return the factor of a term, one if no parameter scales it."""
        return self.factors.get(name, 1.0)

    def load_direction(self, section: LoadSection, row: Sequence[float] | FloatArray) -> FloatArray:
        """Return the load (N,) of a section for a value of one, along a row of the first unknowns.

        If the section names a matrix (`through`), the load is this matrix times the row.
        """
        direction = np.zeros(len(self.matrices["mass"]))
        direction[: len(row)] = row
        if section.through is not None:
            direction = self.matrices[section.through] @ direction
        return np.asarray(self.term_factor(section.name) * direction)

    def loads_of_references(self, trial: Trial, inputs: Mapping[str, OffsetInput]) -> list[Load]:
        """Return the loads that follow from the recorded references of all controllers."""
        loads: list[Load] = []
        for loop in self.loops.values():
            loads += loop.reference_loads(trial, inputs)
        return loads


def build_rig(
    description: LumpedDescription,
    factors: Mapping[str, float],
    state: SystemState,
    places: Sequence[PlaceSection],
) -> Rig:
    """Return a lumped model in a state.

    A rise of the temperature softens the whole stiffness by the primitives `ModulusTemperature`.

    Parameters
    ----------
    description : LumpedDescription
        The content of the model file.
    factors : mapping of str to float
        The factors of the terms by name, from the values of the parameters.
    state : SystemState
        The structural patch and the temperature.
    places : sequence of PlaceSection
        The places of masses in the order of their stations.

    Raises
    ------
    ModelError
        If the temperature leaves too little of the stiffness.
    """
    softening = state.temperature_rise * sum(
        primitive.coefficient
        for primitive in state.structure
        if isinstance(primitive, ModulusTemperature)
    )
    remaining_stiffness = 1.0 - softening
    if remaining_stiffness < LEAST_STIFFNESS:
        raise ModelError(
            f"At this temperature the factor on the stiffness would be {remaining_stiffness:.2g}, "
            "and it must be positive: check the temperature and the coefficient."
        )
    warm_factors = {**factors, "stiffness": factors.get("stiffness", 1.0) * remaining_stiffness}
    matrices = description.scaled_matrices(warm_factors)
    displacement_count = description.displacement_count
    if displacement_count:
        # views of the matrices, which `_apply_patch` changes in place
        mass = matrices["mass"][:displacement_count, :displacement_count]
        stiffness = matrices["stiffness"][:displacement_count, :displacement_count]
        _apply_patch(state.structure, description, places, mass, stiffness)
        if description.damping is not None:
            damping = _damping_matrix(description.damping, mass, stiffness)
            matrices["damping"][:displacement_count, :displacement_count] += (
                factors.get("damping", 1.0) * damping
            )
    return Rig(factors, matrices, _control_loops(description, factors))


def _apply_patch(
    patch: ModelPatch,
    description: LumpedDescription,
    places: Sequence[PlaceSection],
    mass: FloatArray,
    stiffness: FloatArray,
) -> None:
    """Add the point masses and root compliances of a patch to mass and stiffness (n, n), in place.

    A point mass acts at its station between the `places`. A root compliance is ignored if the file
    has no `[root]`.
    """
    for primitive in patch:
        if isinstance(primitive, PointMass):
            row = _row_at_station(places, primitive.station)[: len(mass)]
            mass += primitive.mass * np.outer(row, row)
        elif isinstance(primitive, SupportCompliance) and description.root is not None:
            # A rotational spring of compliance c in series with the structure: the flexibility
            # becomes K^-1 + c l l^T, with the lever l. By Sherman and Morrison its inverse is
            # K - K l l^T K c / (1 + c l^T K l).
            lever = np.array(description.root.lever)
            moment = stiffness @ lever
            reduction_factor = primitive.compliance / (
                1.0 + primitive.compliance * float(moment @ lever)
            )
            stiffness -= np.outer(moment, moment) * reduction_factor


def _row_at_station(places: Sequence[PlaceSection], station: float) -> FloatArray:
    """Return the row (n,) of the displacement at a station [m], interpolated between the places."""
    stations = [place.station for place in places]
    coefficients = np.transpose([place.vector for place in places])  # (n, places)
    return np.array([np.interp(station, stations, values) for values in coefficients])


def _damping_matrix(damping: Damping, mass: FloatArray, stiffness: FloatArray) -> FloatArray:
    """Return the damping (n, n) by Rayleigh coefficients, or by the damping ratios of the modes.

    For mass-normalised shapes S and ratios zeta it is M S diag(2 zeta omega) S^T M.
    """
    if damping.ratios is None:
        return (damping.alpha or 0.0) * mass + (damping.beta or 0.0) * stiffness
    squares, shapes = eigh(stiffness, mass)
    frequencies = np.sqrt(np.maximum(squares, 0.0))
    mass_times_shapes = mass @ shapes
    return np.asarray(
        (mass_times_shapes * (2.0 * np.array(damping.ratios) * frequencies)) @ mass_times_shapes.T
    )


def _control_loops(
    description: LumpedDescription, factors: Mapping[str, float]
) -> dict[str, ControlLoop]:
    """Return the controllers by name, with their gains times the factors of the parameters.

    The integrals of errors are the last unknowns, in the order of the controllers that have them.
    """
    unknown_count = description.unknown_count
    displacement_count = description.displacement_count
    next_integral = displacement_count + description.state_count
    loops: dict[str, ControlLoop] = {}
    for section in description.controller:
        gains = []
        for gain in GAINS:
            scaled_gain = factors.get(f"{section.name}.{gain}", 1.0) * getattr(section, gain)
            gains.append(factors.get(section.name, 1.0) * scaled_gain)
        proportional, derivative, integral = gains
        error_integral = np.zeros(unknown_count)
        if section.integral:
            error_integral[next_integral] = 1.0
            next_integral += 1
        measured_output = OutputEquation.from_row(
            description.pad_to_all_unknowns(section.vector),
            displacement_derivative=section.quantity.order,
            state_count=unknown_count - displacement_count,
        )
        loops[section.name] = ControlLoop(
            section=section,
            proportional=proportional,
            derivative=derivative,
            integral=integral,
            measured=measured_output.rows,
            direction=description.pad_to_all_unknowns(section.acts),
            error_integral=error_integral,
        )
    return loops
