"""Replace forces and moments on distributing couplings by the nodal forces of CalculiX.

CalculiX applies such a load as forces at the nodes of the coupled surface, and prints these forces.
To read them, all other nodes are held, and what else binds the nodes of the surface is left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fe.runtime.errors import CalculixError
from fe.structure.abaqus import KeywordBlock
from fe.structure.deck_text import whole
from fe.structure.matrix_tables import Dof

from .calculix_jobs import CalculixJobs
from .linear_model import TRANSLATIONS, HeldMotion, LinearModel
from .loads import DeckLoad
from .pressures import NodalForces, NotReadError, surface_nodes
from .shell_sides import ShellGeometry

_BINDING = {"EQUATION", "MPC", "PRE-TENSION SECTION", "RIGID BODY", "TIE"}
"""Keywords that bind nodes, besides couplings."""
_SMALLEST_FORCE = 1e-9
"""Forces below this, relative to the largest, are rounding."""


def share_over_couplings(
    jobs: CalculixJobs, blocks: Sequence[KeywordBlock], loads: Sequence[DeckLoad]
) -> list[DeckLoad]:
    """Replace the loads at reference nodes of couplings by forces at the coupled nodes.

    A load on a coupling whose forces CalculiX does not print stays at the reference node.

    Raises
    ------
    MeshError
        If a coupling names something that the deck does not have.
    """
    nodes_of_reference = dict(_distributing_couplings(jobs.model))
    loads_without_references = []
    for load in loads:
        on_references = {
            dof: value
            for dof, value in (*load.forces.items(), *load.moments.items())
            if value and dof[0] in nodes_of_reference
        }
        forces = dict(load.forces)
        moments = dict(load.moments)
        for dof, value in on_references.items():
            unit_forces = _forces_of_unit(jobs, blocks, dof, nodes_of_reference[dof[0]])
            if not unit_forces:
                continue
            forces.pop(dof, None)
            moments.pop(dof, None)
            for coupled_dof, force in unit_forces.items():
                forces[coupled_dof] = forces.get(coupled_dof, 0.0) + value * force
        loads_without_references.append(replace(load, forces=forces, moments=moments))
    return loads_without_references


def _distributing_couplings(model: LinearModel) -> Iterator[tuple[int, list[int]]]:
    """Yield the reference node of each distributing coupling, and the coupled nodes."""
    shells = ShellGeometry(model.mesh, model.blocks)
    for block, next_block in zip(model.blocks, [*model.blocks[1:], None], strict=True):
        if block.keyword == "DISTRIBUTING COUPLING":
            elements = model.mesh.elements_named(block.required("ELSET"), block.where)
            nodes = [
                node
                for where, values in block.data
                for node in model.mesh.nodes_named(values[0], where)
            ]
            for number in elements:
                yield model.mesh.elements[number].nodes[0], nodes
        elif block.keyword == "COUPLING" and next_block and next_block.keyword == "DISTRIBUTING":
            reference = whole(block.where, block.required("REF NODE"))
            try:
                nodes = surface_nodes(shells, block.required("SURFACE"), block.where)
            except NotReadError:
                continue
            yield reference, nodes


def _forces_of_unit(
    jobs: CalculixJobs, blocks: Sequence[KeywordBlock], dof: Dof, nodes: Sequence[int]
) -> NodalForces:
    """Return the forces at coupled nodes by which a coupling transmits a unit load.

    CalculiX computes them: all other nodes are held, everything else that binds nodes is removed,
    and the forces at the coupled nodes are printed. Forces that are zero but for rounding are left
    out; the result is empty if CalculiX fails.

    Parameters
    ----------
    dof : (int, int)
        The reference node, and the direction of the load.
    nodes : sequence of int
        The coupled nodes.
    """
    model = jobs.model
    reference, direction = dof
    free_nodes = {reference, *nodes}
    held_motions = [
        HeldMotion(node, axis)
        for node in model.mesh.points
        if node not in free_nodes
        for axis in TRANSLATIONS
    ]
    jobs_with_others_held = replace(jobs, model=replace(model, held=held_motions))
    unit_load = DeckLoad("unit", lines=["*CLOAD", f"{reference},{direction},1."])
    try:
        (table,) = jobs_with_others_held.displacements(
            [unit_load], _without_bonds(blocks, reference), preloaded=False, quantity="RF"
        )
    except CalculixError:
        return {}
    largest_force = max(float(np.abs(table[node]).max()) for node in nodes)
    forces = {}
    for node in dict.fromkeys(nodes):
        for axis, force in zip(TRANSLATIONS, table[node].tolist(), strict=True):
            if abs(force) > _SMALLEST_FORCE * largest_force:
                forces[node, axis] = force
    return forces


def _without_bonds(blocks: Sequence[KeywordBlock], reference: int) -> list[KeywordBlock]:
    """Return the blocks without everything that binds nodes but one node's coupling."""
    remaining = []
    is_other_coupling = False
    for block in blocks:
        if block.keyword == "COUPLING":
            is_other_coupling = block.parameters.get("REF NODE") != str(reference)
        elif block.keyword not in ("DISTRIBUTING", "KINEMATIC"):
            is_other_coupling = False
        if block.keyword not in _BINDING and not is_other_coupling:
            remaining.append(block)
    return remaining
