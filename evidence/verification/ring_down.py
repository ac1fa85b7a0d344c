"""A ring-down of the wing against direct integration by CalculiX."""

from pathlib import Path

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


def ring_down_agreement(
    operators: AffineOperators,
    folder: Path,
    state: DigitalState,
    periods: float = 5.0,
    steps_per_period: int = 80,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Release the tip from a static force: our modal integration against direct integration.

    Ours is the reduced model with its few modes, exact in time; CalculiX integrates all unknowns by the
    trapezoidal rule, whose period is too long by (omega dt)^2 / 12, so that part of the difference is its.

    Parameters
    ----------
    operators : AffineOperators
        The model; CalculiX takes about a second for each step at 8,000 unknowns.
    folder : Path
        Where CalculiX works.
    state : DigitalState
        Health, masses and damping.
    periods : float
        Length in periods of the first mode.
    steps_per_period : int
        Increments of the direct integration.

    Returns
    -------
    ours, calculix, same_rule : (t,)
        Upward displacement of the tip at equal steps of time after its release over that before it: modal
        integration, exact in time; direct integration by CalculiX; modal integration by the trapezoidal rule
        with the increment of CalculiX, which leaves out the error of that rule.

    Raises
    ------
    CalculixError
        If CalculiX is not there or fails.
    """
    model = reduce_structure(operators).model
    vector = model.vector(state.values, state.stiffness_loss)
    integrator = ModalIntegrator(model.structure_at(vector), state.damping_alpha, state.damping_beta)
    frequency, row = integrator.modes.frequency, model.modes(vector).output[-1]
    increment, steps = 1.0 / (steps_per_period * float(frequency[0])), round(periods * steps_per_period)
    initial = integrator.outputs(integrator.state_at_rest((0.0, TEST_FORCE)))[-1]
    current = integrator.state_after_release(initial, (0.0, 0.0), TIP_FORCE)
    same_rule = _trapezoidal(2.0 * np.pi * frequency, integrator.damping_ratio, increment, steps)
    same_rule = row @ (same_rule * current.displacement[:, None])
    ours = np.empty(steps)
    for step in range(steps):
        current = integrator.advance(current, increment, (0.0, 0.0))
        ours[step] = integrator.outputs(current)[-1]
    load = operators.turn(0.0, TEST_FORCE)
    text = wing_deck(operators, state).text(
        # CalculiX balances energy in a dynamic step and wants it asked for from the first step on.
        Step(load, ("*EL PRINT, ELSET=E0", "ENER")),
        Step(
            0.0 * load,
            ("*NODE PRINT, NSET=NPROBES, FREQUENCY=1", "U"),
            procedure=("*DYNAMIC, DIRECT, ALPHA=0.", number_line([increment, increment * steps])),
        ),
    )
    tables, tip = read_tables(run_calculix(text, folder, "ring_down")), len(operators.gauges)
    theirs = np.array([rows[:, 1:].ravel()[tip] for rows in tables.get("NPROBES", ())])
    if len(theirs) != steps:
        raise CalculixError(f"CalculiX printed {len(theirs)} increments of the ring-down instead of {steps}.")
    return ours / initial, theirs / initial, same_rule / initial


def _trapezoidal(omega: FloatArray, damping_ratio: FloatArray, increment: float, steps: int) -> FloatArray:
    """Free response (m, steps) of modes (m,), released at rest at one, by the trapezoidal rule."""
    half = np.zeros((len(omega), 2, 2))
    half[:, 0, 1], half[:, 1, 0], half[:, 1, 1] = 1.0, -(omega**2), -2.0 * damping_ratio * omega
    half *= 0.5 * increment
    advance = np.linalg.solve(np.eye(2) - half, np.eye(2) + half)
    return np.stack([np.linalg.matrix_power(advance, step)[:, 0, 0] for step in range(1, steps + 1)], axis=1)
