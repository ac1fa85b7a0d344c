"""The bottom and top sides of shells, half the thickness away from the mid-surface."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from fe.elements.kinds import DECK_KINDS, ElementKind
from fe.runtime.arrays import FloatArray
from fe.structure.abaqus import KeywordBlock
from fe.structure.deck_text import real

from .mesh_of_deck import DeckMesh, TypedElement

KIND_BY_TYPE = {kind.calculix: kind for kind in DECK_KINDS.values()}
"""Kinds of solids by their names in a deck."""

_SHELL_SOLIDS = {
    "S3": "C3D6",
    "S4": "C3D8",
    "S4R": "C3D8",
    "S6": "C3D15",
    "S8": "C3D20",
    "S8R": "C3D20",
}
"""The solid whose first face has the shape functions of a shell."""


class ShellSide(StrEnum):
    """The side of a shell: its normal points from the bottom to the top."""

    BOTTOM = "bottom"
    TOP = "top"


def solid_of_shell(type_name: str) -> ElementKind | None:
    """Return the solid whose first face has the shape functions of a shell, or None."""
    solid = _SHELL_SOLIDS.get(type_name)
    return None if solid is None else KIND_BY_TYPE[solid]


@dataclass(frozen=True)
class _Thickness:
    """Thickness of a shell, and the offset of its mid-surface from the nodes in thicknesses."""

    thickness: float
    offset: float


@dataclass(frozen=True)
class ShellGeometry:
    """Positions of nodes on the sides of a deck's shells.

    CalculiX expands a shell along the normal at each node, which is the mean of the normals of the
    shells that meet there, and applies pressure on the expanded side.
    """

    mesh: DeckMesh
    blocks: Sequence[KeywordBlock]

    def side_positions(self, number: int, side: ShellSide) -> FloatArray:
        """Return the positions (k, 3) of a shell's nodes on one of its sides.

        A shell whose thickness is given at nodes, or not at all, has both sides at its nodes.
        """
        nodes = self.mesh.elements[number].nodes
        positions = np.array([self.mesh.points[node] for node in nodes])
        section = self._thicknesses.get(number)
        if section is None:
            return positions
        half = -0.5 if side is ShellSide.BOTTOM else 0.5
        height = section.thickness * (section.offset + half)
        return positions + height * np.array([self._normals[node] for node in nodes])

    @cached_property
    def _thicknesses(self) -> dict[int, _Thickness]:
        """Thickness and offset of each shell that has a section with a constant thickness."""
        thicknesses: dict[int, _Thickness] = {}
        for block in self.blocks:
            if block.keyword != "SHELL SECTION" or "NODAL THICKNESS" in block.parameters:
                continue
            # A composite has a line for each layer, which begins with its thickness.
            thickness = sum(real(where, values[0]) for where, values in block.data)
            offset = block.parameters.get("OFFSET", "0.")
            section = _Thickness(thickness, real(block.where, offset))
            members = self.mesh.element_sets.get(block.parameters["ELSET"].upper(), ())
            thicknesses |= dict.fromkeys(members, section)
        return thicknesses

    @cached_property
    def _normals(self) -> dict[int, FloatArray]:
        """The mean normal (3,) of the shells at each node."""
        sums: dict[int, FloatArray] = {}
        for element in self.mesh.elements.values():
            solid = solid_of_shell(element.type_name)
            if solid is None or len(element.nodes) != len(solid.face_nodes[0]):
                continue
            normals = self._element_normals(element, solid)
            for node, normal in zip(element.nodes, normals, strict=True):
                sums[node] = sums.get(node, 0.0) + normal
        return {node: total / np.linalg.norm(total) for node, total in sums.items()}

    def _element_normals(self, element: TypedElement, solid: ElementKind) -> FloatArray:
        """Return the unit normals (k, 3) of a shell at its nodes."""
        face_nodes = list(solid.face_nodes[0])
        _, gradients = solid.shape_functions(solid.node_positions[face_nodes])
        positions = np.array([self.mesh.points[node] for node in element.nodes])
        along_first, along_second = solid.face_frames.tangents[0]
        on_face = gradients[:, face_nodes]
        first = np.einsum("ai,qaj,j->qi", positions, on_face, along_first)
        second = np.einsum("ai,qaj,j->qi", positions, on_face, along_second)
        # The first face of a solid is its bottom, with the outward normal downwards.
        normals = np.cross(second, first)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
