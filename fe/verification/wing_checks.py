"""Checks of a wing's model: rigid motions, balances, mesh convergence, CalculiX."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe.elements.cells import gradients
from fe.elements.kinds import gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.state import DigitalState
from fe.structure.affine import natural_frequencies, static_response
from fe.structure.supports import rigid_motions
from fe.wing.design import WingDesign
from fe.wing.operators import (
    AffineOperators,
    assemble,
    flapwise_bending_modes,
    point_masses,
)
from reporting.progress import stage

from .calculix_comparison import agreement
from .calculix_deck import wing_deck
from .calculix_run import calculix_program

DAMAGED_LOSSES = (0.4, 0.6)
"""Alternating stiffness losses of the damage regions in the damaged state that is checked."""
REFINEMENTS = (0.5, 1.0, 2.0)
QUICK_REFINEMENTS = (0.25, 0.5, 1.0)
RIGID_FORCE_LIMIT = 1e-12
"""Largest elastic force in a rigid motion, relative to the terms that cancel."""
MASS_LIMIT = 1e-10
"""Largest relative difference between the mass of the matrix and that of the volumes."""
BALANCE_LIMIT = 1e-5
"""Largest relative difference of the other balances."""
CONVERGENCE_LIMIT = 0.01
"""Largest relative change of a result between the two finest meshes."""
CALCULIX_LIMIT = 1e-5
"""Largest relative difference from CalculiX."""


class RootMotions(NamedTuple):
    """Free unknowns (n,) of the rigid motions that the root allows."""

    heave: FloatArray
    flap: FloatArray
    yaw: FloatArray


def _root_motions(operators: AffineOperators) -> RootMotions:
    """Return the rigid motions that the root allows: heave, flap and yaw.

    In a vector of the free unknowns, the displacements of the nodes come first. The last three
    entries are heave, flap and yaw of the root: each motion has a one in its own entry.
    """
    motions = rigid_motions(operators.wing_mesh.points, np.zeros(3), 2.0)
    nodal_motions = motions[operators.body.supports.free_displacements]
    _, _, along_z, about_x, _, about_z = nodal_motions.T
    at_nodes = np.column_stack((along_z, about_x, about_z))
    at_root = np.eye(3)
    heave, flap, yaw = np.vstack((at_nodes, at_root)).T
    return RootMotions(heave, flap, yaw)


class Balance(NamedTuple):
    """Two sums that must agree, and their unit."""

    value: float
    expected: float
    unit: str


def wing_balance(operators: AffineOperators, load_factor: float = 3.0) -> dict[str, Balance]:
    """Return pairs of sums that must be equal in a correct model of the wing.

    Returns
    -------
    dict of str to Balance
        Four balances:

        - "mass": the mass by the mass matrix, and density times volume;
        - "reaction": the force in the transverse spring of the root, and the net lift;
        - "root moment": the moment in the flap spring, and that of the load about the root;
        - "energy and work": the elastic energy, and half the work of the load.
    """
    mesh = operators.wing_mesh
    root = mesh.design.root
    lift = mesh.design.lift
    motions = _root_motions(operators)
    # mass of matrix and volumes
    rule = gauss_points(2)
    _, determinants = gradients(mesh.kind, mesh.nodes, rule.points)
    volume = determinants @ rule.weights
    # the kinetic energy of heaving at unit speed is half the total mass
    matrix_mass = motions.heave @ (operators.mass_terms[0] @ motions.heave)
    volume_mass = volume @ operators.body.density
    # forces at the root, from the solution and from the load
    displacement = static_response(operators, {"load_factor": load_factor}).displacement
    root_heave, root_flap, _ = displacement[-3:]
    load = operators.turn(load_factor)
    reaction = root.transverse_spring * root_heave
    net_lift = lift.force * load_factor / lift.load_factor
    spring_moment = root.flap_spring * root_flap
    load_moment = motions.flap @ load
    # energy of the solution
    elastic_force = operators.stiffness() @ displacement
    energy = 0.5 * displacement @ elastic_force
    work = 0.5 * load @ displacement
    return {
        "mass": Balance(float(matrix_mass), float(volume_mass), "kg"),
        "reaction": Balance(float(reaction), net_lift, "N"),
        "root moment": Balance(float(spring_moment), float(load_moment), "N m"),
        "energy and work": Balance(float(energy), float(work), "J"),
    }


class MeshResults(NamedTuple):
    """Results of the healthy wing at e = 1 on one mesh, with nominal masses.

    Attributes
    ----------
    unknowns : int
        Number of free unknowns.
    tip_stiffness : float
        Stiffness at the point of the static test [N/m].
    first_bending, second_bending : float
        Frequencies of flapwise bending [Hz].
    strain : (gauges,) array
        Strains at the load factor of the design's lift.
    """

    unknowns: int
    tip_stiffness: float
    first_bending: float
    second_bending: float
    strain: FloatArray


def mesh_convergence(design: WingDesign, refinements: Sequence[float]) -> list[MeshResults]:
    """Return the results on meshes of several refinements, without recalibration.

    Raises
    ------
    InvalidDesignError
        If a refinement lies outside the range of the design.
    """
    results = []
    nominal_masses = point_masses(design.masses.servo, design.masses.pitot)
    for refinement in refinements:
        operators = assemble(design.changed(mesh={"refinement": refinement}))
        factors = Factorisation(operators.stiffness())
        lift = operators.turn(design.lift.load_factor)
        loads = np.column_stack((lift, operators.load_tip))
        under_lift, under_tip_force = factors.solve(loads).T
        modes = natural_frequencies(operators, 4, nominal_masses)
        bending = flapwise_bending_modes(operators, modes)
        first_bending, second_bending = modes.frequency[bending].tolist()
        results.append(
            MeshResults(
                unknowns=operators.unknowns,
                tip_stiffness=1.0 / float(operators.load_tip @ under_tip_force),
                first_bending=first_bending,
                second_bending=second_bending,
                strain=operators.gauge_output @ under_lift,
            )
        )
    return results


def observed_order(ratio: float, values: Sequence[float]) -> float:
    """Return the observed order of convergence p on the three finest meshes.

    With v = v_0 + c h^p and h_k = h_0 / ratio^k, successive changes of v have the ratio
    ratio^p, from which p follows (Roache 1998, Richardson extrapolation). It is NaN if the results
    oscillate, or if p is not between 0.05 and 12.

    Parameters
    ----------
    ratio : float
        The ratio of the mesh sizes h of successive meshes, coarser to finer.
    values : sequence of float
        The results, from the coarsest to the finest mesh; at least three.
    """
    earlier_change = values[-2] - values[-3]
    last_change = values[-1] - values[-2]
    if earlier_change * last_change <= 0.0:
        return math.nan
    order = math.log(earlier_change / last_change) / math.log(ratio)
    # Any other order is an accident of rounding or of meshes too coarse to converge.
    return order if 0.05 < order < 12.0 else math.nan


@dataclass(frozen=True)
class Check:
    """One line of the verification: a value, and its limit if it has one.

    Attributes
    ----------
    group, name : str
        The group of the check, and the quantity that is checked.
    limit : float, optional
        Largest allowed value; None for a value that is only reported.
    note : str
        Text printed after the value.
    """

    group: str
    name: str
    value: float
    limit: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value does not exceed its limit."""
        return self.limit is None or self.value <= self.limit


def all_checks(design: WingDesign, jobs: Path, *, quick: bool = False) -> list[Check]:
    """Run all checks of a design, with those against CalculiX if it is installed.

    Parameters
    ----------
    jobs : Path
        The folder in which CalculiX writes its files.
    quick : bool
        Use coarser meshes.
    """
    checks: list[Check] = []

    def run(title: str, results: Iterable[Check]) -> None:
        with stage(title) as progress:
            for check in results:
                checks.append(check)
                progress.advance(detail=check.name)

    refinements = QUICK_REFINEMENTS if quick else REFINEMENTS
    with stage("Meshing the wing"):
        checked = design.changed(mesh={"refinement": refinements[0]}) if quick else design
        operators = assemble(checked)
    run("Balances of the wing", balance_checks(operators))
    run("Convergence of the mesh", convergence_checks(design, refinements, limited=not quick))
    if calculix_program() is not None:
        run("CalculiX on the same mesh", calculix_checks(operators, jobs))
    return checks


def balance_checks(operators: AffineOperators) -> Iterator[Check]:
    """Yield the checks of the wing's forces, masses and energies.

    First, rigid motions must cause no elastic force. With the stiffness K_0 without the springs of
    the root, and all rigid motions r that the root allows, the value is the largest entry of K_0 r
    over the largest entry of |K| |r|: the magnitude of the terms that cancel, which determines the
    rounding errors. Then come the balances of `wing_balance` at the load factor of the design's
    lift, each as the relative difference of two sums.
    """
    motions = np.column_stack(_root_motions(operators))
    stiffness = operators.stiffness()
    without_springs = stiffness - operators.body.supports.stiffness
    largest_force = np.abs(without_springs @ motions).max()
    largest_sum_of_magnitudes = (abs(stiffness) @ np.abs(motions)).max()
    yield Check(
        "wing",
        "force of a rigid motion",
        float(largest_force / largest_sum_of_magnitudes),
        RIGID_FORCE_LIMIT,
    )
    balances = wing_balance(operators, operators.wing_mesh.design.lift.load_factor)
    for name, balance in balances.items():
        yield Check(
            group="wing",
            name=name,
            value=abs(balance.value / balance.expected - 1.0),
            limit=MASS_LIMIT if name == "mass" else BALANCE_LIMIT,
            note=f"({balance.value:.5g} {balance.unit})",
        )


def convergence_checks(
    design: WingDesign, refinements: tuple[float, ...], *, limited: bool = True
) -> Iterator[Check]:
    """Yield the change of each result between the two finest meshes, and its observed order.

    Parameters
    ----------
    refinements : tuple of float
        At least three, from coarse to fine, with equal ratios.
    limited : bool
        Compare the changes with limits, which are made for `REFINEMENTS`.
    """
    results = mesh_convergence(design, refinements)
    middle, fine = refinements[-2:]
    group = f"mesh x{middle:g} to x{fine:g}"
    limit = CONVERGENCE_LIMIT if limited else None

    def order_in_words(values: list[float]) -> str:
        order = observed_order(fine / middle, values)
        return "not monotone" if math.isnan(order) else f"order {order:.2f}"

    # stiffness and frequencies
    scalar_results = {
        "tip stiffness": ("N/m", [result.tip_stiffness for result in results]),
        "first bending": ("Hz", [result.first_bending for result in results]),
        "second bending": ("Hz", [result.second_bending for result in results]),
    }
    for name, (unit, values) in scalar_results.items():
        *_, middle_value, fine_value = values
        change = abs(fine_value / middle_value - 1.0)
        note = f"({fine_value:.5g} {unit}, {order_in_words(values)})"
        yield Check(group, name, change, limit, note)
    # gauges
    strain = np.array([result.strain for result in results])
    *_, middle_strain, fine_strain = strain
    strain_change = np.abs(fine_strain / middle_strain - 1.0)
    mean_square = np.mean(strain_change**2)
    yield Check(group, "gauges, rms", float(np.sqrt(mean_square)), limit)
    readings_of_gauges = strain.T.tolist()
    for number, readings in enumerate(readings_of_gauges):
        fine_microstrain = 1e6 * readings[-1]
        note = f"({fine_microstrain:.0f} microstrain, {order_in_words(readings)})"
        yield Check(group, f"gauge {number + 1}", float(strain_change[number]), None, note)
    yield Check(group, "unknowns of the finest mesh", results[-1].unknowns)


def calculix_checks(operators: AffineOperators, jobs: Path) -> Iterator[Check]:
    """Yield the differences from CalculiX on the identical mesh: statics and six modes.

    `jobs` is the folder in which CalculiX writes its files.
    """
    damaged = tuple(
        DAMAGED_LOSSES[number % len(DAMAGED_LOSSES)] for number in range(len(operators.regions))
    )
    for health, losses in (("healthy", ()), ("damaged", damaged)):
        group = f"CalculiX, {health}"
        deck = wing_deck(operators, DigitalState(stiffness_loss=losses))
        comparison = agreement(deck, jobs / health)
        for load, differences in comparison.loads.items():
            for quantity, difference in differences.items():
                yield Check(group, f"{load}: {quantity}", difference, CALCULIX_LIMIT)
        frequencies = f"frequencies 1 to {len(comparison.ours)}"
        yield Check(group, frequencies, comparison.modal, CALCULIX_LIMIT)
