"""A ring-down of the wing against direct integration by CalculiX."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.errors import CalculixError
from fe.runtime.state import TIP_FORCE, DigitalState
from fe.runtime.transient import ModalIntegrator
from fe.verification.calculix_deck import TEST_FORCE, Step, number_line, wing_deck
from fe.verification.calculix_run import read_tables, run_calculix
from fe.wing.operators import AffineOperators

FloatArray = NDArray[np.float64]


class RingDowns(NamedTuple):
    """Upward displacement of the tip at equal steps of time after its release, over that before it.

    Attributes
    ----------
    modal : (t,) array
        Modal integration of the reduced model, exact in time.
    calculix : (t,) array
        Direct integration of all unknowns by CalculiX.
    modal_trapezoidal : (t,) array
        Modal integration by the trapezoidal rule with the increment of CalculiX. Its difference to
        CalculiX does not contain the error of that rule.
    """

    modal: FloatArray
    calculix: FloatArray
    modal_trapezoidal: FloatArray


def ring_down_agreement(
    operators: AffineOperators,
    folder: Path,
    state: DigitalState,
    periods: float = 5.0,
    steps_per_period: int = 80,
) -> RingDowns:
    """Return ring-downs after a release of the tip from a static force.

    The reduced model has few modes and is exact in time. CalculiX integrates all unknowns by the
    trapezoidal rule, whose period is too long by (omega dt)^2 / 12. This is one part of the
    difference.

    Parameters
    ----------
    operators : AffineOperators
        The wing; CalculiX takes about a second for each step at 8,000 unknowns.
    folder : Path
        Folder in which CalculiX works.
    state : DigitalState
        Health, masses and damping.
    periods : float
        Length in periods of the first mode.
    steps_per_period : int
        Increments of the direct integration in each period.

    Raises
    ------
    CalculixError
        If CalculiX is not installed or fails.
    """
    model = reduce_structure(operators).model
    vector = model.vector(state.values, state.stiffness_loss)
    integrator = ModalIntegrator(
        model.structure_at(vector), state.damping_alpha, state.damping_beta
    )
    frequency = integrator.modes.frequency
    increment = 1.0 / (steps_per_period * float(frequency[0]))
    step_count = round(periods * steps_per_period)
    initial = integrator.outputs(integrator.state_at_rest((0.0, TEST_FORCE)))[-1]
    released = integrator.state_after_release(initial, (0.0, 0.0), TIP_FORCE)

    # Modes by the trapezoidal rule
    modal_motion = _trapezoidal_response(
        2.0 * np.pi * frequency, integrator.damping_ratio, increment, step_count
    )
    tip_row = model.modes(vector).output[-1]
    modal_trapezoidal = tip_row @ (modal_motion * released.displacement[:, np.newaxis])

    # Modes, exact in time
    modal = np.empty(step_count)
    current = released
    for step in range(step_count):
        current = integrator.advance(current, increment, (0.0, 0.0))
        modal[step] = integrator.outputs(current)[-1]

    direct = _calculix_response(operators, folder, state, increment, step_count)
    return RingDowns(
        modal=modal / initial,
        calculix=direct / initial,
        modal_trapezoidal=modal_trapezoidal / initial,
    )


def _calculix_response(
    operators: AffineOperators,
    folder: Path,
    state: DigitalState,
    increment: float,
    step_count: int,
) -> FloatArray:
    """Return the displacements of the tip (steps,) [m] by direct integration of CalculiX.

    Parameters
    ----------
    operators : AffineOperators
        The wing.
    folder : Path
        Folder in which CalculiX works.
    state : DigitalState
        Health, masses and damping.
    increment : float
        Increment of time [s].
    step_count : int
        Number of increments.

    Raises
    ------
    CalculixError
        If CalculiX is not installed or fails.
    """
    load = operators.turn(0.0, TEST_FORCE)
    # CalculiX balances energy in a dynamic step and wants it asked for from the first step on.
    static_step = Step(load, ("*EL PRINT, ELSET=E0", "ENER"))
    dynamic_step = Step(
        0.0 * load,
        ("*NODE PRINT, NSET=NPROBES, FREQUENCY=1", "U"),
        procedure=(
            "*DYNAMIC, DIRECT, ALPHA=0.",
            number_line([increment, increment * step_count]),
        ),
    )
    text = wing_deck(operators, state).text(static_step, dynamic_step)
    tables = read_tables(run_calculix(text, folder, "ring_down"))
    tip = len(operators.gauges)
    displacements = [rows[:, 1:].ravel()[tip] for rows in tables.get("NPROBES", ())]
    if len(displacements) != step_count:
        raise CalculixError(
            f"CalculiX printed {len(displacements)} increments of the ring-down instead of "
            f"{step_count}."
        )
    return np.array(displacements)


def _trapezoidal_response(
    omega: FloatArray, damping_ratio: FloatArray, increment: float, step_count: int
) -> FloatArray:
    """Return the free response (m, steps) of modes by the trapezoidal rule.

    Each mode is released at rest at one.

    Parameters
    ----------
    omega, damping_ratio : (m,) arrays
        Circular frequency [rad/s] and damping ratio of each mode.
    increment : float
        Increment of time [s].
    step_count : int
        Number of increments.
    """
    zero = np.zeros_like(omega)
    one = np.ones_like(omega)
    velocity_row = np.stack([zero, one], axis=-1)
    acceleration_row = np.stack([-(omega**2), -2.0 * damping_ratio * omega], axis=-1)
    half_step = 0.5 * increment * np.stack([velocity_row, acceleration_row], axis=-2)
    step_matrix = np.linalg.solve(np.eye(2) - half_step, np.eye(2) + half_step)
    response = []
    for step in range(1, step_count + 1):
        power = np.linalg.matrix_power(step_matrix, step)
        displacement_row, _ = np.moveaxis(power, 1, 0)
        displacement_of_displacement, _ = displacement_row.T
        response.append(displacement_of_displacement)
    return np.stack(response, axis=1)
