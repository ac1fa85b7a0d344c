"""The description of a structure: a TOML file beside a mesh or matrices.

Positions and lengths are in the unit of length of the mesh, which the file names; all else is in SI
units. Matrices, of any finite element code, are in newtons, seconds and the unit of length that the
file names; a mass in kg and an acceleration in m/s^2 are turned into these units.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from fe.elements.elasticity import (
    axes_of,
    isotropic_compliance,
    orthotropic_compliance,
    rotate_elasticity,
)
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import DesignFileError, InvalidDesignError, MeshError
from fe.runtime.state import MOST_REGIONS
from reporting.formats.toml_file import Check, read_toml, validate

from . import tables
from .matrix_design import MatrixDesign

LEAST_SINE = 1e-3
"""Two axes whose angle has a smaller sine do not span a plane."""


class Spot(tables.DesignSection):
    """A place of a gauge: the strain is the mean over `length` along it and `width` across it."""

    point: tables.Vector
    """Place of its middle [unit of length]."""
    length: float = Field(default=0.0, ge=0.0)
    """Length along it over which the strain is averaged, at 20 points [unit of length]."""
    width: float = Field(default=0.0, ge=0.0)
    """Width across it over which the strain is averaged, at 10 points [unit of length]."""


class Gauge(tables.Named, Spot):
    """Strain gauge on the surface: mean strain along `direction`, positive in tension."""

    direction: tables.Direction
    """Direction of the strain, as a vector [1]."""


def _span_a_plane(
    axes: tuple[tables.Direction, tables.Direction],
) -> tuple[tables.Direction, tables.Direction]:
    """Return two axes; raise `ValueError` if they are parallel."""
    first, second = axes
    product_of_lengths = np.linalg.norm(first) * np.linalg.norm(second)
    if np.linalg.norm(np.cross(first, second)) <= LEAST_SINE * product_of_lengths:
        raise ValueError("the two axes must not be parallel, and must point in two directions")
    return axes


Axes = Annotated[tuple[tables.Direction, tables.Direction], AfterValidator(_span_a_plane)]
"""Axis 1 is along the first vector; axis 2 lies in the plane of both, at right angles to it."""


class Rosette(Spot):
    """Gauges NAME_a, NAME_b, ... at one point, at `angles` [degrees] from axis 1 towards axis 2."""

    name: Annotated[str, Field(max_length=30, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    """Name, to which a letter is added for each gauge."""
    axes: Axes
    """Two vectors: axis 1, and another vector in the plane of the surface, towards axis 2 [1]."""
    angles: Annotated[tuple[float, ...], Field(min_length=2, max_length=6)] = (0.0, 45.0, 90.0)
    """Angle of each gauge from axis 1 towards axis 2 [degrees]."""

    def gauges(self) -> list[Gauge]:
        """Return the gauges of the rosette, named by letters."""
        first_axis, second_axis, _ = axes_of(*self.axes)
        place = self.model_dump(include={*Spot.model_fields})
        gauges = []
        for letter, angle in zip("abcdef", np.radians(self.angles).tolist(), strict=False):
            direction = np.cos(angle) * first_axis + np.sin(angle) * second_axis
            name = f"{self.name}_{letter}"
            gauges.append(Gauge(name=name, direction=tuple(direction.tolist()), **place))
        return gauges


class Gauged(tables.DesignSection):
    """Gauges; those of rosettes come behind the others."""

    gauge: tuple[Gauge, ...] = ()
    rosette: tuple[Rosette, ...] = Field(default=(), exclude=True)
    """Rosettes of gauges, which are numbered after the single gauges."""

    @model_validator(mode="after")
    def _add_gauges_of_rosettes(self) -> "Gauged":
        gauges = list(self.gauge)
        for rosette in self.rosette:
            gauges += rosette.gauges()
        self.__dict__["gauge"] = tuple(gauges)  # past the check of frozen sections
        return self


SetName = Annotated[str, Field(min_length=1, max_length=200)]
Poisson = Annotated[float, Field(gt=-1.0, lt=0.5)]
Spring = Annotated[float, Field(ge=0.0, le=1e15)]
Springs = tuple[Spring, Spring, Spring] | tuple[Spring, Spring, Spring, Spring, Spring, Spring]


class NamedSet(tables.AlternativeKeys):
    """Set of nodes, or of cells: those in a box, cells by their centres, or those with numbers."""

    name: SetName
    """Name of the set."""
    of: Literal["nodes", "cells"]
    """What the set contains."""
    box: tuple[tables.Vector, tables.Vector] | None = None
    """Two opposite corners of the box, the lower one first [unit of length]."""
    numbers: Annotated[tuple[int, ...], Field(min_length=1)] | None = None
    """Numbers of the nodes or elements in the mesh file, counted from 1 if it has none."""

    alternatives = (("box",), ("numbers",))

    def checks(self) -> Iterator[Check]:
        """Yield the checks against two ways at once, and a box with corners in the wrong order."""
        yield from super().checks()
        lower, upper = self.box or ((), ())
        is_reversed = any(high < low for low, high in zip(lower, upper, strict=True))
        yield is_reversed, "box must give its lower corner first, then its upper one"


class MeshMaterial(tables.AlternativeKeys):
    """Material of the cells of a set: isotropic, or orthotropic in axes given by two vectors.

    An orthotropic material gives three moduli along its axes 1, 2 and 3, Poisson's ratios 12, 13
    and 23 (ratio ij is the contraction along j under tension along i) and shear moduli 12, 13 and
    23.
    """

    name: tables.Name
    """Name of the material."""
    set: SetName | Annotated[tuple[SetName, ...], Field(min_length=1)] = "all"
    """Set of the cells, or a list of sets."""
    density: float = Field(ge=0.0, le=3e4)
    """Density [kg/m^3]."""
    young_modulus: tables.Modulus | None = None
    """Young's modulus, isotropic [Pa]."""
    poisson_ratio: Poisson | None = None
    """Poisson's ratio, isotropic [1]."""
    young_moduli: tuple[tables.Modulus, tables.Modulus, tables.Modulus] | None = None
    """Young's moduli along axes 1, 2 and 3 [Pa]."""
    poisson_ratios: tables.Vector | None = None
    """Poisson's ratios 12, 13 and 23 [1]."""
    shear_moduli: tuple[tables.Modulus, tables.Modulus, tables.Modulus] | None = None
    """Shear moduli 12, 13 and 23 [Pa]."""
    axes: Axes | None = None
    """Two vectors: axis 1, and another vector in the plane of axes 1 and 2 [1]."""
    scaled_by: tables.Name | None = None
    """Name of the parameter that scales the stiffness."""
    alternatives = (
        ("young_modulus", "poisson_ratio"),
        ("young_moduli", "poisson_ratios", "shear_moduli", "axes"),
    )

    def checks(self) -> Iterator[Check]:
        """Yield the checks against a material that is given in several ways, or is not stable."""
        yield from super().checks()
        is_orthotropic = self.axes is not None
        is_unstable = is_orthotropic and np.linalg.eigvalsh(self.compliance)[0] <= 0.0
        yield (
            is_unstable,
            "the moduli and Poisson's ratios belong to no stable material: its compliance is not "
            "positive definite",
        )

    @property
    def sets(self) -> tuple[str, ...]:
        """The sets of the cells."""
        return (self.set,) if isinstance(self.set, str) else self.set

    @property
    def compliance(self) -> FloatArray:
        """Compliance (6, 6) [1/Pa] in the axes of the material; strains 11, 22, 33, 23, 13, 12."""
        if self.young_modulus is not None and self.poisson_ratio is not None:
            return isotropic_compliance(self.young_modulus, self.poisson_ratio)
        return orthotropic_compliance(
            *map(np.asarray, (self.young_moduli, self.poisson_ratios, self.shear_moduli))
        )

    @property
    def elasticity(self) -> FloatArray:
        """Elasticity (6, 6) [Pa] in space."""
        local_elasticity = np.asarray(np.linalg.inv(self.compliance), dtype=np.float64)
        if self.axes is None:
            return local_elasticity
        first_vector, second_vector = self.axes
        axes = axes_of(first_vector, second_vector)
        (elasticity,) = rotate_elasticity(local_elasticity[None], axes[None])
        return np.asarray(elasticity)


class Support(tables.DesignSection):
    """Nodes of a set: directions that are held, or springs [N/m], shared equally among the nodes.

    With `rigid_about`, a point, the nodes move together as a rigid body, such as a stiff flange:
    `hold` may name rotations about the axes through the point, too, and `springs` act on the
    motions x, y, z [N/m] and rx, ry, rz [N m/rad] of the body that are not held.
    """

    set: SetName
    """Set of nodes or faces."""
    hold: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    """Motions that are held."""
    springs: Springs | None = None
    """Stiffness of springs against x, y and z, and of a rigid set also rx, ry and rz [N/m and N
    m/rad]."""
    rigid_about: tables.Vector | None = None
    """Point about which the set moves as a rigid body [unit of length]."""
    scaled_by: tables.Name | None = None
    """Name of the parameter that scales the springs."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks against a support that holds nothing, or holds a motion twice."""
        springs = self.springs or ()
        translations = tables.MOTIONS[:3]
        has_springs = any(springs)
        has_rotations = len(springs) > 3 or any(name not in translations for name in self.hold)
        has_either = bool(self.hold) != has_springs
        is_rigid = self.rigid_about is not None
        yield (
            not is_rigid and (has_rotations or not has_either),
            'either hold = ["x", "y", "z"] or springs = [x, y, z] in N/m is expected; what turns, '
            "too, is a rigid set, with the point `rigid_about`",
        )
        yield not self.hold and not has_springs, "a rigid set needs hold, springs or both"
        yield (
            self.scaled_by is not None and not has_springs,
            "`scaled_by` scales springs, and it has none",
        )
        for motion, spring in zip(tables.MOTIONS, springs, strict=False):
            is_held_twice = bool(spring) and motion in self.hold
            yield is_held_twice, f"the motion {motion} is held, so that no spring can act on it"


Stiff = Annotated[float, Field(gt=0.0, le=1e15)]
Pair = Stiff | tuple[Spring, Spring]


class Interface(tables.Named):
    """Interface of two parts that touch: a joint, a bonded or a bolted contact, which may yield.

    The second part moves against the first one as a rigid body there, by motions against springs.
    A motion without a spring is held, as in a mesh without the interface.
    """

    parts: tuple[SetName, SetName]
    """Two sets of cells that share nodes, or have nodes at the same places."""
    normal: Stiff | None = None
    """Spring against a shift along the normal of the interface [N/m]."""
    tangential: Pair | None = None
    """Spring against shifts in the interface, or two: along its longer and its shorter extent, zero
    where held [N/m]."""
    twist: Stiff | None = None
    """Spring against a turn about the normal [N m/rad]."""
    bending: Pair | None = None
    """Spring against turns about axes in the interface, or two: about its longer and its shorter
    extent, zero where held [N m/rad]."""
    scaled_by: tables.Name | None = None
    """Name of the parameter that scales the springs."""

    def checks(self) -> Iterator[Check]:
        """Yield the checks against equal parts, and a parameter that scales nothing."""
        yield from super().checks()
        first, second = self.parts
        yield first == second, "two different parts are expected"
        yield (
            self.scaled_by is not None and not any(self.springs),
            "`scaled_by` scales springs, and it has none",
        )

    @property
    def springs(self) -> tuple[float, ...]:
        """The springs against `tables.INTERFACE_MOTIONS` [N/m, N m/rad], zero where held."""
        in_plane, about_plane = [
            spring if isinstance(spring, tuple) else (spring or 0.0,) * 2
            for spring in (self.tangential, self.bending)
        ]
        return (self.normal or 0.0, *in_plane, self.twist or 0.0, *about_plane)


class MeshLoad(tables.AlternativeKeys, tables.ControlledLoad):
    """A load, constant or times the value of a control.

    Either a `force` [N] on a set (shared by area where it holds faces, else equally among its
    nodes) or at a point, a `pressure` [Pa] against the faces of a set, or an `acceleration` [m/s^2]
    of everything that has mass: (0, 0, -9.81) is gravity along -z.
    """

    set: SetName | None = None
    """Set of nodes or faces on which the load acts."""
    point: tables.Vector | None = None
    """Point at which the force acts [unit of length]."""
    force: tables.Direction | None = None
    """Force, as a vector [N]."""
    pressure: float | None = None
    """Pressure against the faces of the set [Pa]."""

    alternatives = (("force", "set"), ("force", "point"), ("pressure", "set"), ("acceleration",))


class Damage(tables.Region):
    """A region that may lose stiffness: the cells of a set."""

    set: SetName
    """Set of the cells."""

    @property
    def sets(self) -> tuple[str, ...]:
        """The set of the cells, as that of a material."""
        return (self.set,)


class StiffnessLoss(tables.DesignSection):
    """Cells that have lost stiffness for good, such as those about a crack that was found."""

    set: SetName
    """Set of the cells."""
    fraction: float = Field(gt=0.0, le=0.95)
    """Lost fraction of the stiffness that material and parameters give [1]."""
    extent: float = Field(default=1.0, ge=0.05, le=20.0)
    """Length over which the stiffness is lost over that of the set, which gauges on the set show
    [1]."""


class MeshMass(tables.ChosenMass):
    """A mass at a point of the structure."""

    point: tables.Vector
    """Place of the mass [unit of length]."""


class PointOutput(tables.Named):
    """An output of the structure: displacement or acceleration of a point along a direction."""

    point: tables.Vector
    """Place [unit of length]."""
    direction: tables.Direction
    """Direction, as a vector [1]."""


class MeshPort(tables.AlternativeKeys, tables.Named):
    """A port: a set or a point where a force that the model lacks may act.

    The force acts along `direction`, on the mean displacement of the set, or on that of the point.
    """

    direction: tables.Direction
    """Direction of the force, as a vector [1]."""
    set: SetName | None = None
    """Set of nodes or faces on which the force acts."""
    point: tables.Vector | None = None
    """Point at which the force acts [unit of length]."""

    alternatives = (("set",), ("point",))


class MeshDesign(tables.StructureDesign, Gauged):
    """A structure from a mesh."""

    mesh: str = Field(min_length=1)
    """Mesh file, relative to this file."""
    set: tuple[NamedSet, ...] = ()
    """Further sets of nodes or cells."""
    material: tuple[MeshMaterial, ...] = Field(min_length=1)
    """Materials, which cover every cell once."""
    support: tuple[Support, ...] = Field(min_length=1)
    """Supports."""
    interface: tuple[Interface, ...] = ()
    """Interfaces at which two parts may move against each other."""
    load: tuple[MeshLoad, ...] = ()
    damage: tuple[Damage, ...] = Field(default=(), max_length=MOST_REGIONS)
    stiffness_loss: tuple[StiffnessLoss, ...] = ()
    """Losses of stiffness that were found."""
    mass: tuple[MeshMass, ...] = ()
    gauge: tuple[Gauge, ...] = ()
    displacement: tuple[PointOutput, ...] = ()
    acceleration: tuple[PointOutput, ...] = ()
    port: tuple[MeshPort, ...] = ()

    what = "mesh"
    scaled_tables = ("material", "support", "interface")
    own_names = ("material", "set", "interface")

    @property
    def files(self) -> tuple[str, ...]:
        """The mesh."""
        return (self.mesh,)


def is_structure(content: Mapping[str, Any]) -> bool:
    """Return whether the content of a TOML file describes a structure by mesh or matrices."""
    return "mesh" in content or "stiffness_matrix" in content


def parse_structure(
    content: dict[str, Any], source: str = "the structure"
) -> MeshDesign | MatrixDesign:
    """Validate the content of a structure file, from a mesh or from matrices.

    `source` is the name of the file in error messages.

    Raises
    ------
    InvalidDesignError
        If the content is not a structure; one sentence names the key, what was given and what was
        expected.
    """
    if "stiffness_matrix" in content:
        return validate(
            MatrixDesign, content, source, InvalidDesignError, what="a structure from matrices"
        )
    return validate(MeshDesign, content, source, InvalidDesignError, what="a structure")


def load_structure(path: Path | str) -> MeshDesign | MatrixDesign:
    """Read and validate a structure file, without its mesh or matrices.

    Raises
    ------
    DesignFileError
        If the file cannot be read or is not TOML.
    InvalidDesignError
        If its content is not a structure.
    """
    file = Path(path)
    return parse_structure(
        read_toml(file, DesignFileError, what="structure file"), source=str(file)
    )


def _remove_later_keys(content: dict[str, Any]) -> None:
    """Remove keys without a value that files of earlier versions cannot have, from plain data."""
    for key in ("stiffness_loss", "interface"):
        if not content.get(key):
            content.pop(key, None)
    for table, key in (("support", "scaled_by"), ("set", "numbers")):
        for row in content.get(table, ()):
            if row.get(key) is None:
                row.pop(key, None)


def structure_hash(
    design: tables.StructureDesign, folder: Path, *, with_ports: bool = False
) -> str:
    """Return the SHA-256 of a design and its files, as 64 hexadecimal digits.

    The limits of the reduction and the name of the mesh file do not count.

    Parameters
    ----------
    folder : Path
        The names of the files are relative to it.
    with_ports : bool
        Whether ports count. They do not change the responses of the structure, but a missing effect
        may be located at one.

    Raises
    ------
    MeshError
        If a file cannot be read.
    """
    if not with_ports:
        design = design.model_copy(update={"port": ()})
    content = design.model_dump(mode="json")
    if not design.port:
        del content["port"]
    content.pop("mesh", None)  # its bytes count, not its name
    del content["reduction"]  # the structure is the same
    _remove_later_keys(content)
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())
    for name in design.files:
        try:
            digest.update((folder / name).read_bytes())
        except OSError as error:
            raise MeshError(
                f"The {design.what} file {folder / name} cannot be read: {error.strerror}."
            ) from None
    return digest.hexdigest()
