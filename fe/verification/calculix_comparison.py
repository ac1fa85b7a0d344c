"""Structures and the wing against CalculiX on the identical mesh: statics, modes and a ring-down."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.elements.cells import gradients, strain_matrix
from fe.full.statics import Factorisation
from fe.runtime.errors import CalculixError
from fe.runtime.state import TIP_FORCE, DigitalState, Losses
from fe.structure.affine import AffineStructure
from fe.structure.field import natural_frequencies, static_responses
from fe.structure.operators import Structure
from fe.wing.operators import AffineOperators
from fe.wing.responses import eigenmodes

from .calculix_deck import CalculixDeck
from .calculix_job import read_frequencies, read_tables, run_calculix
from .calculix_models import gauge_cells, structure_deck, structure_loads, wing_deck

FloatArray = NDArray[np.float64]

TEST_FORCE = 10.0
"""Upward force of the static test and before the ring-down [N]."""
_LINE = 0.5 + 0.5 * np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0])
INTEGRATION_POINTS = np.array([(x, y, z) for z in _LINE for y in _LINE for x in _LINE])
"""Local places (27, 3) in 0..1 of the integration points of a C3D20 element, in the order of its output."""
# Rows and columns in which CalculiX prints a strain tensor.
_PRINTED = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


class _Printed(NamedTuple):
    """What CalculiX printed of a static step: nodes (nodes, 3) and probes (m,), strains at cells (n, 6)."""

    field: FloatArray
    probes: FloatArray
    strain: FloatArray


def _statics(
    deck: CalculixDeck, loads: Iterable[Iterable[str]], folder: Path, prints: Iterable[str] = ()
) -> list[_Printed]:
    steps = [[*load] for load in loads]
    tables = read_tables(run_calculix(deck.static_steps(steps, [*prints]), folder, "static"))
    nodes, probes, strains = (
        [table.rows for table in tables if table.set_name == name] for name in ("NALL", "NPROBES", "EGAUGES")
    )
    if len(nodes) != len(steps):
        raise CalculixError(f"CalculiX printed {len(nodes)} static solutions instead of {len(steps)}.")
    nothing = [np.zeros((0, 8))] * len(steps)
    return [
        _Printed(field[:, 1:], probe[:, 1:].ravel(), strain[:, 2:])
        for field, probe, strain in zip(nodes, probes or nothing, strains or nothing, strict=True)
    ]


def _frequencies(deck: CalculixDeck, count: int, folder: Path) -> FloatArray:
    found = read_frequencies(run_calculix(deck.frequency_step(count), folder, "modes"))
    if len(found) < count:
        raise CalculixError(f"CalculiX printed {len(found)} frequencies instead of {count}.")
    return found[:count]


def _relative(theirs: FloatArray, ours: FloatArray) -> float:
    return float(np.abs(theirs - ours).max() / np.abs(ours).max())


def _relative_each(theirs: FloatArray, ours: FloatArray) -> float:
    return float(np.abs(theirs / ours - 1.0).max())


@dataclass(frozen=True)
class ModalAgreement:
    """Frequencies (m,) [Hz] of both codes."""

    ours: FloatArray
    calculix: FloatArray

    @property
    def relative(self) -> float:
        """Largest relative difference."""
        return float(np.abs(self.calculix / self.ours - 1.0).max())


@dataclass(frozen=True)
class LoadAgreement:
    """Differences under one load, each relative.

    Attributes
    ----------
    load : str
        Its name.
    field : float
        Largest difference of a nodal displacement, over the largest displacement.
    strain, output : float or None
        Of the strains of the gauges and of displacement outputs, over the largest of their kind, or of a wing
        each over its own; None where there are none.
    tensor : float or None
        Of a wing: largest difference of a strain component at the integration points of the cells with
        gauges, over the largest strain there. CalculiX evaluates these strains itself.
    """

    load: str
    field: float
    strain: float | None
    output: float | None
    tensor: float | None = None


def _agreement(
    structure: AffineStructure,
    deck: CalculixDeck,
    load: str,
    displacement: FloatArray,
    theirs: _Printed,
    relative: Callable[[FloatArray, FloatArray], float],
    tensor: FloatArray | None = None,
) -> LoadAgreement:
    ours, gauges = deck.probes @ displacement, len(structure.gauges)
    parts = (slice(0, gauges), slice(gauges, len(ours)))
    strain, output = (relative(theirs.probes[own], ours[own]) if len(ours[own]) else None for own in parts)
    return LoadAgreement(
        load,
        _relative(theirs.field, structure.full_displacement(displacement)),
        strain,
        output,
        None if tensor is None else _relative(theirs.strain.reshape(tensor.shape), tensor),
    )


@dataclass(frozen=True)
class StructureAgreement:
    """A structure and CalculiX.

    Attributes
    ----------
    loads : tuple of LoadAgreement
        One for each load.
    modes : ModalAgreement
        Lowest frequencies.
    """

    loads: tuple[LoadAgreement, ...]
    modes: ModalAgreement


def structure_agreement(structure: Structure, folder: Path, modes: int = 6) -> StructureAgreement:
    """Solve every load and the lowest modes by both codes, undamaged and with nominal values.

    Parameters
    ----------
    structure : Structure
        The model; assembled with `mass_as_stiffness`, for frequencies that can be compared.
    folder : Path
        Where CalculiX works.
    modes : int
        Number of modes.

    Raises
    ------
    CalculixError
        If CalculiX is not there, fails, or has no such element.
    """
    deck = structure_deck(structure)
    printed = _statics(deck, structure_loads(structure, deck), folder) if structure.loads else []
    loads = tuple(
        _agreement(structure, deck, name, ours.displacement, theirs, _relative)
        for (name, ours), theirs in zip(static_responses(structure).items(), printed, strict=True)
    )
    found = ModalAgreement(natural_frequencies(structure, modes)[0], _frequencies(deck, modes, folder))
    return StructureAgreement(loads, found)


def static_agreement(
    operators: AffineOperators,
    folder: Path,
    young_modulus_factor: float = 1.0,
    stiffness_loss: Losses = (),
) -> tuple[LoadAgreement, ...]:
    """Compare the static test and the lift of the design in one state of health.

    Parameters
    ----------
    operators : AffineOperators
        The model.
    folder : Path
        Where CalculiX works.
    young_modulus_factor, stiffness_loss
        As of `fe.runtime.state.DigitalState`.

    Raises
    ------
    CalculixError
        If CalculiX is not there or fails.
    """
    state = DigitalState(young_modulus_factor=young_modulus_factor, stiffness_loss=stiffness_loss)
    deck = wing_deck(operators, state)
    turn = operators.wing_mesh.design.lift.load_factor
    loads = {"tip force": operators.turn(0.0, TEST_FORCE), "lift": operators.turn(turn)}
    printed = _statics(
        deck, map(deck.force_lines, loads.values()), folder, ("*EL PRINT, ELSET=EGAUGES, GLOBAL=YES", "E")
    )
    parameters = {"young_modulus_factor": young_modulus_factor}
    solve = Factorisation(operators.stiffness(parameters, stiffness_loss)).solve
    found = []
    for (name, load), theirs in zip(loads.items(), printed, strict=True):
        ours = solve(load)
        tensor = _strain_tensors(operators, ours)
        found.append(_agreement(operators, deck, name, ours, theirs, _relative_each, tensor))
    return tuple(found)


def _strain_tensors(operators: AffineOperators, free: FloatArray) -> FloatArray:
    """Strain tensor (cells, 27, 6) in CalculiX's order at the integration points of the gauges' cells."""
    mesh, cells = operators.wing_mesh, gauge_cells(operators)
    slopes, _ = gradients(mesh.kind, mesh.nodes[cells], INTEGRATION_POINTS)
    displacement = operators.full_displacement(free).ravel()[mesh.unknowns_of(cells)]
    voigt = np.einsum("nqij,nj->nqi", strain_matrix(slopes), displacement)
    voigt[..., 3:] *= 0.5  # engineering to tensor shear
    return np.asarray(voigt[..., [_VOIGT.index(place) for place in _PRINTED]])


def modal_agreement(
    operators: AffineOperators,
    folder: Path,
    state: DigitalState,
    count: int = 6,
) -> ModalAgreement:
    """Compare the lowest modes in one state.

    Raises
    ------
    CalculixError
        If CalculiX is not there or fails.
    """
    ours = eigenmodes(
        operators,
        state.young_modulus_factor,
        state.stiffness_loss,
        state.servo_mass,
        state.pitot_mass,
        count,
    ).frequency
    return ModalAgreement(ours, _frequencies(wing_deck(operators, state), count, folder))


@dataclass(frozen=True)
class RingDownAgreement:
    """Upward displacement [m] of the tip after its release, at the times (t,) [s], of both codes.

    Attributes
    ----------
    time, ours, calculix : (t,)
        Modal integration, exact in time, and direct integration by CalculiX.
    same_rule : (t,)
        Modal integration by the trapezoidal rule with the increment of CalculiX, which leaves out the error
        of that rule.
    initial : float
        Displacement before the release [m].
    period : float
        Period of the first mode [s].
    """

    time: FloatArray
    ours: FloatArray
    calculix: FloatArray
    same_rule: FloatArray
    initial: float
    period: float

    @property
    def relative(self) -> float:
        """Largest difference over the initial displacement."""
        return float(np.abs(self.calculix - self.ours).max() / abs(self.initial))

    @property
    def relative_same_rule(self) -> float:
        """Largest difference over the initial displacement when both use the trapezoidal rule."""
        return float(np.abs(self.calculix - self.same_rule).max() / abs(self.initial))


def ring_down_agreement(
    operators: AffineOperators,
    folder: Path,
    state: DigitalState,
    periods: float = 5.0,
    steps_per_period: int = 80,
) -> RingDownAgreement:
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

    Raises
    ------
    CalculixError
        If CalculiX is not there or fails.
    """
    from fe.reduction.reduced_basis import reduce_model
    from fe.runtime.transient import ModalIntegrator

    model = reduce_model(operators).model
    vector = model.vector(state.values, state.stiffness_loss)
    integrator = ModalIntegrator(model, vector, state.damping_alpha, state.damping_beta)
    period = 1.0 / float(integrator.modes.frequency[0])
    increment, steps = period / steps_per_period, round(periods * steps_per_period)
    initial = integrator.outputs(integrator.at_rest((0.0, TEST_FORCE)))[-1]
    current = integrator.released(initial, (0.0, 0.0), TIP_FORCE)
    same_rule = integrator.modes.output[-1] @ _trapezoidal(
        current.displacement,
        2.0 * np.pi * integrator.modes.frequency,
        integrator.damping_ratio,
        increment,
        steps,
    )
    ours = np.empty(steps)
    for step in range(steps):
        current = integrator.advance(current, increment, (0.0, 0.0))
        ours[step] = integrator.outputs(current)[-1]
    text = wing_deck(operators, state).ring_down_steps(operators.turn(0.0, TEST_FORCE), increment, steps)
    tables, tip = read_tables(run_calculix(text, folder, "ring_down")), len(operators.gauges)
    theirs = np.array([table.rows[:, 1:].ravel()[tip] for table in tables if table.set_name == "NPROBES"])
    if len(theirs) != steps:
        raise CalculixError(f"CalculiX printed {len(theirs)} increments of the ring-down instead of {steps}.")
    time = np.asarray(increment * np.arange(1, steps + 1), dtype=np.float64)
    return RingDownAgreement(time, ours, theirs, same_rule, initial, period)


def _trapezoidal(
    start: FloatArray, omega: FloatArray, damping_ratio: FloatArray, increment: float, steps: int
) -> FloatArray:
    """Free response (m, steps) of modes (m,) from rest at `start` by the trapezoidal rule of Newmark."""
    displacement, velocity, acceleration = start, np.zeros_like(start), -(omega**2) * start
    divisor = 1.0 + damping_ratio * omega * increment + 0.25 * (omega * increment) ** 2
    found = np.empty((len(start), steps))
    for step in range(steps):
        displacement = displacement + increment * velocity + 0.25 * increment**2 * acceleration
        velocity = velocity + 0.5 * increment * acceleration
        acceleration = -(2.0 * damping_ratio * omega * velocity + omega**2 * displacement) / divisor
        displacement = displacement + 0.25 * increment**2 * acceleration
        velocity = velocity + 0.5 * increment * acceleration
        found[:, step] = displacement
    return found
