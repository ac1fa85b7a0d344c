"""Supports of a mesh: held, sprung and rigid nodes, and whether the structure is free to move."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import MeshError

from .affine import SupportMotion
from .design import MeshDesign, Support
from .interfaces import interface_motions
from .mesh import StructureMesh
from .nodal_loads import set_weights
from .tables import MOTIONS

_FREE = 1e-8
"""A rigid motion is free if the supports resist it less than this fraction of the stiffest one."""


class RigidSet(NamedTuple):
    """Nodes that move as a rigid body.

    Attributes
    ----------
    point : (3,) array
        The point about which the body turns [m].
    held : (6,) array of bool
        Whether each motion, along x, y, z and about them, is held.
    springs : (6,) array
        Springs to the ground [N/m, N m/rad].
    scaled_by : str or None
        Parameter that scales the springs.
    """

    nodes: IntArray
    point: FloatArray
    held: BoolArray
    springs: FloatArray
    scaled_by: str | None = None


class Supports(NamedTuple):
    """The n free unknowns: free displacements, then motions of rigid sets by 1 m and 1 rad.

    Attributes
    ----------
    expansion : csr (full, n)
        Free unknowns to the displacements of all nodes (3 node + component).
    free_displacements : (f,) array of int
        Displacements that are free unknowns themselves, the first of these.
    springs : (n,) array
        Springs to the ground, where each parameter that scales some is one [N/m, N m/rad].
    scaled_springs : dict of str to (n,) array
        The springs that each parameter scales, which are parts of these.
    motions : tuple of SupportMotion
        Support motions that are unknowns: those of rigid sets on springs and, if the supports
        yield, the motions that would be held, which come last.
    """

    expansion: sparse.csr_array
    free_displacements: IntArray
    springs: FloatArray
    scaled_springs: dict[str, FloatArray]
    motions: tuple[SupportMotion, ...] = ()

    @property
    def stiffness(self) -> sparse.csr_array:
        """Stiffness (n, n) of the springs, where each parameter that scales some is one."""
        return sparse.diags_array(self.springs).tocsr()

    @property
    def springs_by_parameter(self) -> dict[str | None, FloatArray]:
        """The springs (n,) that no parameter scales, if there are any, and those of each."""
        unscaled = self.springs - sum(self.scaled_springs.values(), np.zeros(len(self.springs)))
        constant: dict[str | None, FloatArray] = {None: unscaled} if unscaled.any() else {}
        return constant | dict(self.scaled_springs.items())


def supports(
    points: FloatArray, is_held: BoolArray, springs: FloatArray, bodies: Iterable[RigidSet]
) -> Supports:
    """Return the free unknowns of a structure with held nodes, nodes on springs and rigid sets.

    Parameters
    ----------
    points : (nodes, 3) array
        Positions of the nodes [m].
    is_held : (nodes, 3) array of bool
        Whether each displacement is held.
    springs : (nodes, 3) array
        Springs to the ground of nodes that belong to no rigid set [N/m].
    bodies : iterable of RigidSet
        The rigid sets, each with up to six motions as unknowns.
    """
    is_free = ~is_held
    body_expansions = []
    body_springs = []
    for body in bodies:
        is_free[body.nodes] = False
        body_expansions.append(_body_expansion(points, body))
        body_springs.append(body.springs[~body.held])
    free_displacements = np.flatnonzero(is_free)
    identity = sparse.eye_array(is_free.size, format="csc")
    expansion = sparse.hstack((identity[:, free_displacements], *body_expansions))
    all_springs = np.concatenate((springs.ravel()[free_displacements], *body_springs))
    return Supports(expansion.tocsr(), free_displacements, all_springs, {})


def _body_expansion(
    points: FloatArray, body: RigidSet, is_moving: BoolArray | None = None
) -> sparse.coo_array:
    """Return the displacements (3 nodes, m) of all nodes by unit values of m motions of a body.

    The motions are those that are not held, or those for which `is_moving` (6,) is true.
    """
    motions = rigid_motions(points[body.nodes], body.point, 2.0)
    moving = sparse.coo_array(motions[:, ~body.held if is_moving is None else is_moving])
    number_in_body, component = np.divmod(moving.row, 3)
    node = body.nodes[number_in_body]
    displacement = 3 * node + component
    free_motions = moving.shape[1]
    entries = (moving.data, (displacement, moving.col))
    return sparse.coo_array(entries, (points.size, free_motions))


@dataclass
class _NodeSupports:
    """Supports of nodes that belong to no rigid set.

    Attributes
    ----------
    held : (nodes, 3) array of bool
        Whether each displacement is held.
    springs : (nodes, 3) array
        Springs to the ground [N/m].
    scaled_springs : dict of str to (nodes, 3) array
        The parts of them that each parameter scales.
    """

    held: BoolArray
    springs: FloatArray
    scaled_springs: dict[str, FloatArray]

    @property
    def resists(self) -> BoolArray:
        """Whether each displacement (nodes, 3) is held or sprung."""
        return np.asarray(self.held | (self.springs > 0.0))


def supports_of_design(
    design: MeshDesign, mesh: StructureMesh, *, yielding: bool = False
) -> Supports:
    """Return the supports of a design: held displacements, springs, rigid sets and free unknowns.

    Parameters
    ----------
    yielding : bool
        Whether the motions that the supports hold are added as the last unknowns. The displacements
        that a set of nodes holds then move as a rigid body, by six motions about the centre of the
        set.

    Raises
    ------
    MeshError
        If a set is missing or empty, a rigid set lies on a line or shares nodes with another
        support, or the supports leave a rigid motion of the structure free.
    """
    bodies: dict[str, RigidSet] = {}
    shape = (len(mesh.points), 3)
    nodal = _NodeSupports(
        held=np.zeros(shape, dtype=bool),
        springs=np.zeros(shape),
        scaled_springs={},
    )
    # supports that hold or spring single nodes, and rigid sets
    for label, support in design.numbered("support"):
        nodes = mesh.nodes_of(support.set, label)
        if support.rigid_about is not None:
            bodies[label] = _rigid_set(support, mesh, nodes, label)
            continue
        translations = MOTIONS[:3]
        nodal.held[nodes] |= np.isin(translations, support.hold)
        if support.springs is not None:
            spring_of_node = np.asarray(support.springs) / len(nodes)
            nodal.springs[nodes] += spring_of_node
            if support.scaled_by is not None:
                scaled = nodal.scaled_springs.setdefault(support.scaled_by, np.zeros(shape))
                scaled[nodes] += spring_of_node
    for springs in (nodal.springs, *nodal.scaled_springs.values()):
        springs[nodal.held] = 0.0
    _check_no_shared_nodes(mesh, nodal, bodies)
    _check_free_interfaces(mesh, nodal, bodies)
    rigid_sets = tuple(bodies.values())
    _check_rigid_motions(mesh, nodal, rigid_sets)
    follows = mesh.joined_nodes != np.arange(len(mesh.points))
    held_supports = supports(
        mesh.points, nodal.held | follows[:, np.newaxis], nodal.springs, rigid_sets
    )
    # the motions of rigid sets against springs are free unknowns, after the displacements of nodes
    sets_of_bodies = [
        support.set for _, support in design.numbered("support") if support.rigid_about is not None
    ]
    first_of_bodies = len(held_supports.free_displacements)
    sprung = _sprung_motions(sets_of_bodies, rigid_sets, first_of_bodies)
    held_supports = held_supports._replace(
        motions=sprung, scaled_springs=_scaled_springs(held_supports, nodal, rigid_sets)
    )
    held_supports = _with_interface_springs(held_supports, mesh, design)
    if not yielding:
        return held_supports
    # the motions that are held, as further unknowns
    held = dict(_held_motions(design, mesh))
    for set_name, body in zip(sets_of_bodies, rigid_sets, strict=True):
        for number in np.flatnonzero(body.held).tolist():
            column = _body_expansion(mesh.points, body, np.arange(len(MOTIONS)) == number)
            held[set_name, MOTIONS[number]] = column
    for motion in interface_motions(mesh, design):
        if motion.spring == 0.0:
            held[motion.interface, motion.motion] = motion.displacements
    return _with_unknown_motions(held_supports, held)


def _scaled_springs(
    held_supports: Supports, nodal: _NodeSupports, bodies: Iterable[RigidSet]
) -> dict[str, FloatArray]:
    """Return the springs (n,) on the free unknowns that each parameter scales."""
    springs_of_parameters: dict[str, FloatArray] = {}
    count = len(held_supports.springs)
    free = held_supports.free_displacements
    for parameter, springs in nodal.scaled_springs.items():
        springs_of_parameters[parameter] = np.pad(springs.ravel()[free], (0, count - len(free)))
    first_of_body = len(free)
    for body in bodies:
        springs = body.springs[~body.held]
        if body.scaled_by is not None:
            of_parameter = springs_of_parameters.setdefault(body.scaled_by, np.zeros(count))
            of_parameter[first_of_body : first_of_body + len(springs)] += springs
        first_of_body += len(springs)
    return springs_of_parameters


def _with_interface_springs(
    held_supports: Supports, mesh: StructureMesh, design: MeshDesign
) -> Supports:
    """Append the motions of interfaces that have springs; copied nodes follow their originals."""
    if not mesh.interfaces:
        return held_supports
    count = len(mesh.points)
    followed = (np.ones(count), (np.arange(count), mesh.joined_nodes))
    follows = sparse.csr_array(followed, shape=(count, count))
    expansion = sparse.kron(follows, sparse.eye_array(3)) @ held_supports.expansion
    sprung = [motion for motion in interface_motions(mesh, design) if motion.spring > 0.0]
    first = expansion.shape[1]
    scaled = {
        parameter: np.pad(springs, (0, len(sprung)))
        for parameter, springs in held_supports.scaled_springs.items()
    }
    motions = []
    for unknown, motion in enumerate(sprung, start=first):
        if motion.scaled_by is not None:
            scaled.setdefault(motion.scaled_by, np.zeros(first + len(sprung)))
            scaled[motion.scaled_by][unknown] = motion.spring
        motions.append(
            SupportMotion(motion.interface, motion.motion, unknown, motion.spring, motion.scaled_by)
        )
    columns = [motion.displacements for motion in sprung]
    return Supports(
        expansion=sparse.hstack((expansion, *columns)).tocsr(),
        free_displacements=held_supports.free_displacements,
        springs=np.append(held_supports.springs, [motion.spring for motion in sprung]),
        scaled_springs=scaled,
        motions=(*held_supports.motions, *motions),
    )


def _sprung_motions(
    sets: Iterable[str], bodies: Iterable[RigidSet], first: int
) -> tuple[SupportMotion, ...]:
    """Return the motions of rigid sets that have springs.

    `first` is the index of the first unknown of the rigid sets.
    """
    motions = []
    unknown = first
    for set_name, body in zip(sets, bodies, strict=True):
        for number in np.flatnonzero(~body.held).tolist():
            spring = float(body.springs[number])
            if spring > 0.0:
                motions.append(
                    SupportMotion(set_name, MOTIONS[number], unknown, spring, body.scaled_by)
                )
            unknown += 1
    return tuple(motions)


def _held_motions(
    design: MeshDesign, mesh: StructureMesh
) -> Iterator[tuple[tuple[str, str], sparse.coo_array]]:
    """Yield each rigid motion that a support holds: the set, the motion, and its displacements.

    The displacements of all nodes are a (3 nodes, 1) array, which is zero where the support holds
    nothing. Several [[support]] tables of one set are taken together. Motions that move none of the
    held displacements, such as a rotation of collinear nodes about their line, are left out.
    """
    held_of_set: dict[str, BoolArray] = {}
    for label, support in design.numbered("support"):
        if support.rigid_about is not None or not support.hold:
            continue
        nodes = mesh.nodes_of(support.set, label)
        is_held = np.zeros((len(mesh.points), 3), dtype=bool)
        is_held[nodes] = np.isin(MOTIONS[:3], support.hold)
        held_of_set[support.set] = held_of_set.get(support.set, False) | is_held
    for set_name, is_held in held_of_set.items():
        centre = set_weights(mesh, set_name, f"support {set_name!r}") @ mesh.points
        motions = rigid_motions(mesh.points, centre, mesh.size)
        motions[~is_held.ravel()] = 0.0
        lengths = np.linalg.norm(motions, axis=0)
        for number, motion in enumerate(MOTIONS):
            if lengths[number] > _FREE * lengths.max():
                # `rigid_motions` turns by 2 rad m / size; a unit motion turns by 1 rad
                scale = 1.0 if number < 3 else 0.5 * mesh.size
                yield (set_name, motion), sparse.coo_array(scale * motions[:, [number]])


def _with_unknown_motions(
    held_supports: Supports, columns: dict[tuple[str, str], sparse.coo_array]
) -> Supports:
    """Append motions of sets, given by their displacements (3 nodes, 1), to the unknowns."""
    first = held_supports.expansion.shape[1]
    motions = tuple(
        SupportMotion(set_name, motion, first + number, 0.0)
        for number, (set_name, motion) in enumerate(columns)
    )
    expansion = sparse.hstack((held_supports.expansion, *columns.values()))
    return Supports(
        expansion=expansion.tocsr(),
        free_displacements=held_supports.free_displacements,
        springs=np.pad(held_supports.springs, (0, len(columns))),
        scaled_springs={
            parameter: np.pad(springs, (0, len(columns)))
            for parameter, springs in held_supports.scaled_springs.items()
        },
        motions=held_supports.motions + motions,
    )


def _check_no_shared_nodes(
    mesh: StructureMesh, nodal: _NodeSupports, bodies: dict[str, RigidSet]
) -> None:
    """Raise `MeshError` if a node of a rigid set belongs to another support, too."""
    is_supported = np.any(nodal.resists, axis=1)
    for label, body in bodies.items():
        shared_nodes = body.nodes[is_supported[body.nodes]]
        if len(shared_nodes):
            place = mesh.describe_point(mesh.points[shared_nodes[0]])
            raise MeshError(
                f"{label}: {len(shared_nodes)} nodes of the rigid set belong to another support, "
                f"too, such as that at {place}; say what holds it in its own table."
            )
        is_supported[body.nodes] = True


def _check_free_interfaces(
    mesh: StructureMesh, nodal: _NodeSupports, bodies: dict[str, RigidSet]
) -> None:
    """Raise `MeshError` if a support holds a node of an interface, which could not yield then."""
    is_supported = np.any(nodal.resists, axis=1)
    for body in bodies.values():
        is_supported[body.nodes] = True
    for interface in mesh.interfaces:
        pairs = np.concatenate((interface.nodes, interface.copies))
        supported = pairs[is_supported[pairs]]
        if len(supported):
            raise MeshError(
                f"The interface {interface.name!r} has nodes that a support holds, such as that at "
                f"{mesh.describe_point(mesh.points[supported[0]])}; take them out of the support."
            )


def _rigid_set(support: Support, mesh: StructureMesh, nodes: IntArray, label: str) -> RigidSet:
    """Return the rigid set of a support; raise `MeshError` if its nodes are collinear."""
    point = mesh.unit * np.asarray(support.rigid_about)
    motions = rigid_motions(mesh.points[nodes], point, 2.0)
    rank = np.linalg.matrix_rank(motions, _FREE * np.linalg.norm(motions))
    if rank < len(MOTIONS):
        raise MeshError(
            f"{label}: the nodes of the rigid set {support.set!r} lie on a line, about which it "
            "could turn."
        )
    springs = np.zeros(len(MOTIONS))
    if support.springs is not None:
        springs[: len(support.springs)] = support.springs
    return RigidSet(
        nodes,
        point,
        held=np.isin(MOTIONS, support.hold),
        springs=springs,
        scaled_by=support.scaled_by,
    )


def rigid_motions(points: FloatArray, centre: FloatArray, size: float) -> FloatArray:
    """Return the displacements (3 m, 6) of points in six rigid motions, along and about x, y, z.

    Parameters
    ----------
    points : (m, 3) array
        Positions of the points [m].
    centre : (3,) array
        The point about which the motions turn [m].
    size : float
        The angle of a rotation is 2 rad m / size; a size of 2 m gives unit rotations.
    """
    arm = (points - centre) / (0.5 * size)
    motions = np.zeros((len(points), 3, 6))
    for axis, unit_axis in enumerate(np.eye(3)):
        motions[:, axis, axis] = 1.0
        displacement_by_rotation = np.cross(unit_axis, arm)
        motions[:, :, 3 + axis] = displacement_by_rotation
    return motions.reshape(-1, 6)


def _check_rigid_motions(
    mesh: StructureMesh, nodal: _NodeSupports, bodies: tuple[RigidSet, ...]
) -> None:
    """Raise `MeshError` if the supports leave a rigid motion free; the message describes it.

    A free motion is one that moves no displacement which is held or has a spring, however stiff: a
    singular vector for the singular value zero.
    """
    # each row is a held or sprung displacement by the six rigid motions of the structure
    centre = mesh.points.mean(axis=0)
    motions = rigid_motions(mesh.points, centre, mesh.size)
    resisted_rows = [motions[nodal.resists.ravel()]]
    for body in bodies:
        # a rigid set shifts with its point, and turns with the structure
        shifts = rigid_motions(body.point[None], centre, mesh.size)
        turns = np.eye(6)[3:]
        body_resists = body.held | (body.springs > 0.0)
        resisted_rows.append(np.vstack((shifts, turns))[body_resists])
    # Motions with a singular value of zero are free. Rows of zeros make the decomposition return
    # all six directions.
    rows = np.vstack((*resisted_rows, np.zeros((6, 6))))
    _, singular_values, directions = np.linalg.svd(rows, full_matrices=False)
    free_motions = directions[singular_values <= _FREE * max(float(singular_values[0]), 1e-300)]
    if len(free_motions):
        raise MeshError(
            f"{mesh.source}: the supports leave {len(free_motions)} of the six rigid motions free, "
            f"among them {_motion_in_words(free_motions[0], mesh, centre)}; hold further "
            "directions."
        )


def _motion_in_words(motion: FloatArray, mesh: StructureMesh, centre: FloatArray) -> str:
    """Describe a rigid motion (6,) about a centre (3,) [m] for a message."""
    shift, scaled_turn = np.split(motion, 2)
    if np.linalg.norm(scaled_turn) < 1e-6:
        return f"a shift along ({_components(shift / np.linalg.norm(shift))})"
    turn = scaled_turn / (0.5 * mesh.size)
    axis = turn / np.linalg.norm(turn)
    point_on_axis = centre + np.cross(turn, shift) / (turn @ turn)
    rounded_point = mesh.size * np.round(point_on_axis / mesh.size, 9)
    point_text = mesh.describe_point(rounded_point)
    return f"a turn about the axis along ({_components(axis)}) through {point_text}"


def _components(vector: FloatArray) -> str:
    """Format the components of a vector (3,) without negative zeros."""
    return ", ".join(f"{value + 0.0:.3g}" for value in np.round(vector, 9))
