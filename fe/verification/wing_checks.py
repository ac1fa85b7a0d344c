"""Checks of a wing's model: what its rigid motions call forth, sums that must agree, convergence."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fe.elements.cells import gradients
from fe.elements.kinds import gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.runtime.state import DigitalState
from fe.structure.affine import static_response
from fe.structure.mesh import rigid_motions
from fe.verification.calculix_comparison import agreement, calculix_program, wing_deck
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, assemble, eigenmodes
from reporting.progress import stage

DAMAGED = (0.4, 0.6)
REFINEMENTS, QUICK_REFINEMENTS = (0.5, 1.0, 2.0), (0.25, 0.5, 1.0)


def _rigid_motions(operators: AffineOperators) -> FloatArray:
    """Free unknowns (n, 3) of the rigid motions that the root allows: heave, flap and yaw."""
    full = rigid_motions(operators.wing_mesh.points, np.zeros(3), 2.0)[:, [2, 3, 5]]
    return np.vstack((full[operators.body.supports.alone], np.eye(3)))


def wing_balance(operators: AffineOperators, load_factor: float = 3.0) -> dict[str, tuple[float, float, str]]:
    """Return sums that must agree for the wing at a load factor, each with the other and their unit.

    The mass of the matrix and of the volumes; the force of the root spring and the net load; the moment of
    the flap spring and that of the load about the root; the elastic energy and half the work of the load.
    """
    mesh, design = operators.wing_mesh, operators.wing_mesh.design
    heave, flap, _ = _rigid_motions(operators).T
    local, weight = gauss_points(2)
    volume = gradients(mesh.kind, mesh.nodes, local)[1] @ weight
    u = static_response(operators, {"load_factor": load_factor}).displacement
    load = operators.turn(load_factor)
    lift = design.lift.force * load_factor / design.lift.load_factor
    energy = 0.5 * u @ (operators.stiffness() @ u)
    return {
        "mass": (
            float(heave @ (operators.mass_terms[0] @ heave)),
            float(volume @ operators.body.density),
            "kg",
        ),
        "reaction": (float(design.root.transverse_spring * u[-3]), lift, "N"),
        "root moment": (float(design.root.flap_spring * u[-2]), float(flap @ load), "N m"),
        "energy and work": (float(energy), float(0.5 * load @ u), "J"),
    }


def mesh_convergence(design: WingDesign, refinements: Sequence[float]) -> dict[str, FloatArray]:
    """Results of the healthy wing at e = 1 on a sequence of meshes; nothing is refitted.

    Returns
    -------
    dict of str to (meshes, ...)
        Free `unknowns`; `tip stiffness` [N/m]; frequencies of `first bending` and `second bending` at the
        design's nominal masses [Hz]; `strain` (meshes, gauges) at the load factor of the design's lift.

    Raises
    ------
    InvalidDesignError
        If a refinement lies outside the range of the design.
    """
    names = ("unknowns", "tip stiffness", "first bending", "second bending", "strain")
    found: list[tuple[Any, ...]] = []
    for refinement in refinements:
        operators = assemble(design.changed(mesh={"refinement": refinement}))
        loads = np.column_stack((operators.turn(design.lift.load_factor), operators.load_tip))
        turn, bent = Factorisation(operators.stiffness()).solve(loads).T
        modes = eigenmodes(operators, 1.0, (), design.masses.servo, design.masses.pitot, 4)
        first, second = modes.frequency[modes.flapwise_bending].tolist()
        stiffness = 1.0 / float(operators.load_tip @ bent)
        found.append((operators.unknowns, stiffness, first, second, operators.gauge_output @ turn))
    return dict(zip(names, map(np.array, zip(*found, strict=True)), strict=True))


def observed_order(ratio: float, values: Sequence[float]) -> float:
    """Order p of v = v_0 + c h^p through the last three of values on meshes, h each `ratio` times less.

    Returns
    -------
    float
        The order; NaN where the values do not approach a limit from one side with an order of 0.05 to 12.
    """
    first, second = values[-2] - values[-3], values[-1] - values[-2]
    order = math.log(first / second) / math.log(ratio) if first * second > 0.0 else math.nan
    return order if 0.05 < order < 12.0 else math.nan


@dataclass(frozen=True)
class Check:
    """One line of the verification: what, what came, and the limit that it must keep, if it has one.

    Attributes
    ----------
    group, name : str
        What is checked.
    value : float
        What came.
    limit : float, optional
        Largest allowed value; None for a figure that is only reported.
    note : str
        What stands beside the figure.
    """

    group: str
    name: str
    value: float
    limit: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the limit is kept."""
        return self.limit is None or self.value <= self.limit


def all_checks(design: WingDesign, jobs: Path, *, quick: bool = False) -> list[Check]:
    """Return every check of a design; those against CalculiX where it is installed.

    Parameters
    ----------
    design : WingDesign
        The wing.
    jobs : Path
        Where CalculiX works.
    quick : bool
        Coarser meshes.
    """
    checks: list[Check] = []

    def run(title: str, found: Iterable[Check]) -> None:
        with stage(title) as shown:
            for check in found:
                checks.append(check)
                shown.advance(detail=check.name)

    with stage("Meshing the wing"):
        mesh = assemble(design.changed(mesh={"refinement": QUICK_REFINEMENTS[0]}) if quick else design)
    run("Balances of the wing", balance_checks(mesh))
    refinements = QUICK_REFINEMENTS if quick else REFINEMENTS
    run("Convergence of the mesh", convergence_checks(design, refinements, limited=not quick))
    if calculix_program() is not None:
        run("CalculiX on the same mesh", calculix_checks(mesh, jobs))
    return checks


def balance_checks(operators: AffineOperators) -> Iterator[Check]:
    """Yield the sums that must agree for the wing at the load factor of its lift.

    First the largest force that a rigid motion calls forth, over the sum of its terms; the forces of the
    springs are left out.
    """
    free, stiffness = _rigid_motions(operators), operators.stiffness()
    force = np.abs((stiffness - operators.body.supports.stiffness) @ free).max()
    share = force / (abs(stiffness) @ np.abs(free)).max()
    yield Check("wing", "force of a rigid motion", float(share), 1e-12)
    balance = wing_balance(operators, operators.wing_mesh.design.lift.load_factor)
    for name, (found, expected, unit) in balance.items():
        limit = 1e-10 if name == "mass" else 1e-5
        yield Check("wing", name, abs(found / expected - 1.0), limit, f"({found:.5g} {unit})")


def convergence_checks(
    design: WingDesign, refinements: tuple[float, ...], *, limited: bool = True
) -> Iterator[Check]:
    """Yield the change between the two finest meshes and the observed order of every result.

    Parameters
    ----------
    design : WingDesign
        The wing.
    refinements : tuple of float
        At least three, from coarse to fine, with equal ratios.
    limited : bool
        Hold the changes to their bars, which are made for `REFINEMENTS`.
    """
    columns = mesh_convergence(design, refinements)
    middle, fine = refinements[-2:]
    group = f"mesh x{middle:g} to x{fine:g}"

    def order(values: list[float]) -> str:
        found = observed_order(fine / middle, values)
        return "not monotone" if math.isnan(found) else f"order {found:.2f}"

    limit = 0.01 if limited else None
    for name, unit in (("tip stiffness", "N/m"), ("first bending", "Hz"), ("second bending", "Hz")):
        values = columns[name].tolist()
        note = f"({values[-1]:.5g} {unit}, {order(values)})"
        yield Check(group, name, abs(values[-1] / values[-2] - 1.0), limit, note)
    strain = columns["strain"]
    change = np.abs(strain[-1] / strain[-2] - 1.0)
    yield Check(group, "gauges, rms", float(np.sqrt(np.mean(change**2))), limit)
    for gauge, value in enumerate(change, start=1):
        own = strain[:, gauge - 1].tolist()
        note = f"({1e6 * own[-1]:.0f} microstrain, {order(own)})"
        yield Check(group, f"gauge {gauge}", float(value), None, note)
    yield Check(group, "unknowns of the finest mesh", int(columns["unknowns"][-1]))


def calculix_checks(operators: AffineOperators, jobs: Path) -> Iterator[Check]:
    """Yield the differences to CalculiX on the identical mesh: statics and six modes."""
    damaged = tuple(DAMAGED[number % 2] for number in range(len(operators.regions)))
    for health, loss in (("healthy", ()), ("damaged", damaged)):
        group = f"CalculiX, {health}"
        found = agreement(wing_deck(operators, DigitalState(stiffness_loss=loss)), jobs / health)
        for load, differences in found.loads.items():
            for what, value in differences.items():
                yield Check(group, f"{load}: {what}", value, 1e-5)
        yield Check(group, f"frequencies 1 to {len(found.ours)}", found.modal, 1e-5)
