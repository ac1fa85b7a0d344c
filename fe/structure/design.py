"""A structure as its engineer describes it: a TOML file beside a mesh file, checked.

Places and lengths are in the unit of length of the mesh, which the file names; all else is in SI units.
"""

import hashlib
import itertools
import json
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from fe.full.assembly import rotate_elasticity
from fe.runtime.errors import DesignFileError, InvalidDesignError, MeshError
from fe.runtime.state import MOST_REGIONS
from fe.wing.parts import Modulus, Part
from reporting.section import checked
from reporting.toml_file import read_toml

from .rosettes import LEAST_SINE, Gauge, Name, Vector, refuse_zero, with_rosettes

FloatArray = NDArray[np.float64]

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
"""Units of length and their size [m]."""
SetName = Annotated[str, Field(min_length=1, max_length=200)]
Poisson = Annotated[float, Field(gt=-1.0, lt=0.5)]
Spring = Annotated[float, Field(ge=0.0, le=1e15, description="N/m")]


def unit_vector(vector: Vector) -> FloatArray:
    """Vector (3,) of length one."""
    return np.asarray(np.asarray(vector) / np.linalg.norm(vector), dtype=np.float64)


class NamedSet(Part):
    """Set of the nodes, or of the cells whose centres, lie in a box: two corners [unit of length]."""

    name: SetName
    of: Literal["nodes", "cells"]
    box: tuple[Vector, Vector]

    @model_validator(mode="after")
    def _box_is_a_box(self) -> "NamedSet":
        if any(high < low for low, high in zip(*self.box, strict=True)):
            raise ValueError("box must give its lower corner first, then its upper one")
        return self


class Ranged(Part):
    """A quantity that can be chosen, and from where to where the reduced model is to hold."""

    name: Name
    minimum: float | None = None
    maximum: float | None = None

    usual: ClassVar[tuple[float, float]]
    """Ends of the range where none are given, as multiples of the nominal value."""

    @property
    def middle(self) -> float:
        """Nominal value."""
        raise NotImplementedError

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest value."""
        low, high = sorted(share * self.middle for share in self.usual)
        return (
            low if self.minimum is None else self.minimum,
            high if self.maximum is None else self.maximum,
        )

    @model_validator(mode="after")
    def _range_holds_the_nominal_value(self) -> "Ranged":
        low, high = self.range
        if not low <= self.middle <= high:
            raise ValueError(
                f"its nominal value {self.middle:g} must lie between minimum {low:g} and maximum {high:g}"
            )
        return self


class Parameter(Ranged):
    """Factor on the stiffness of materials, to be calibrated; 1 unless `nominal` says otherwise."""

    nominal: float = Field(default=1.0, gt=0.0, le=1e3)
    minimum: float | None = Field(default=None, gt=0.0)

    usual = (0.9, 1.1)

    @property
    def middle(self) -> float:
        """Nominal value."""
        return self.nominal


class Control(Ranged):
    """What commands loads; a load is its numbers times the value of its control."""

    unit: str = Field(default="1", pattern=r"^\S+$")
    nominal: float = 1.0

    usual = (-10.0, 10.0)

    @property
    def middle(self) -> float:
        """Nominal value."""
        return self.nominal

    @model_validator(mode="after")
    def _is_not_always_zero(self) -> "Control":
        if not any(self.range):
            raise ValueError(
                "with its nominal value 0 it would be 0 always; give the `minimum` and `maximum` it takes"
            )
        return self


class Material(Part):
    """Material of the cells of a set: isotropic, or orthotropic in axes given by two vectors.

    An orthotropic material gives three moduli along its axes 1, 2 and 3, Poisson's ratios 12, 13 and 23
    (ratio ij is the contraction along j under tension along i) and shear moduli 12, 13 and 23. Axis 1 is
    along the first vector; axis 2 lies in the plane of both vectors, at right angles to it.
    """

    name: Name
    set: SetName = "all"
    density: float = Field(ge=0.0, le=3e4, description="kg/m^3")
    young_modulus: Modulus | None = None
    poisson_ratio: Poisson | None = None
    young_moduli: tuple[Modulus, Modulus, Modulus] | None = None
    poisson_ratios: Vector | None = None
    shear_moduli: tuple[Modulus, Modulus, Modulus] | None = None
    axes: tuple[Vector, Vector] | None = None
    scaled_by: Name | None = None

    @model_validator(mode="after")
    def _one_kind_of_material(self) -> "Material":
        one = (self.young_modulus, self.poisson_ratio)
        three = (self.young_moduli, self.poisson_ratios, self.shear_moduli, self.axes)
        isotropic = all(value is not None for value in one) and all(value is None for value in three)
        orthotropic = all(value is None for value in one) and all(value is not None for value in three)
        if not isotropic and not orthotropic:
            raise ValueError(
                "either young_modulus and poisson_ratio are expected, or young_moduli, poisson_ratios, "
                "shear_moduli and axes"
            )
        if orthotropic:
            assert self.axes is not None
            for axis in self.axes:
                refuse_zero(axis, "an axis")
            if np.linalg.norm(np.cross(unit_vector(self.axes[0]), unit_vector(self.axes[1]))) < LEAST_SINE:
                raise ValueError("the two axes must not be parallel")
            if np.linalg.eigvalsh(self.compliance)[0] <= 0.0:
                raise ValueError(
                    "the moduli and Poisson's ratios belong to no stable material: its compliance is not "
                    "positive definite"
                )
        return self

    @property
    def compliance(self) -> FloatArray:
        """Compliance (6, 6) [1/Pa] in the axes of the material; strains 11, 22, 33, 23, 13, 12."""
        if self.young_modulus is not None and self.poisson_ratio is not None:
            moduli = (self.young_modulus,) * 3
            ratios = (self.poisson_ratio,) * 3
            shears = (self.young_modulus / (2.0 * (1.0 + self.poisson_ratio)),) * 3
        else:
            assert self.young_moduli is not None
            assert self.poisson_ratios is not None
            assert self.shear_moduli is not None
            moduli, ratios, shears = self.young_moduli, self.poisson_ratios, self.shear_moduli
        found = np.diag(1.0 / np.array([*moduli, *shears[::-1]]))
        for (i, j), ratio in zip(((0, 1), (0, 2), (1, 2)), ratios, strict=True):
            found[i, j] = found[j, i] = -ratio / moduli[i]
        return found

    @property
    def elasticity(self) -> FloatArray:
        """Elasticity (6, 6) [Pa] in space."""
        local = np.asarray(np.linalg.inv(self.compliance), dtype=np.float64)
        if self.axes is None:
            return local
        first = unit_vector(self.axes[0])
        third = np.cross(first, self.axes[1])
        third /= np.linalg.norm(third)
        axes = np.array([[first, np.cross(third, first), third]])
        return np.asarray(rotate_elasticity(local[None], axes)[0])


MOTIONS = ("x", "y", "z", "rx", "ry", "rz")
"""Of a rigid set: along the axes, then about them."""


class Support(Part):
    """Nodes of a set: directions that are held, or springs [N/m], shared equally among the nodes.

    With `rigid_about`, a point, the nodes move together as a rigid body, such as a stiff flange: `hold` may
    name rotations about the axes through the point, too, and `springs` act on the motions x, y, z [N/m] and
    rx, ry, rz [N m/rad] of the body that are not held.
    """

    set: SetName
    hold: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    springs: tuple[Spring, Spring, Spring] | tuple[Spring, Spring, Spring, Spring, Spring, Spring] | None = (
        None
    )
    rigid_about: Vector | None = None

    @model_validator(mode="after")
    def _holds_something(self) -> "Support":
        springs = self.springs or ()
        if self.rigid_about is None:
            turns = len(springs) > 3 or any(name not in MOTIONS[:3] for name in self.hold)
            if turns or bool(self.hold) == any(springs):
                raise ValueError(
                    'either hold = ["x", "y", "z"] or springs = [x, y, z] in N/m is expected; what turns, '
                    "too, is a rigid set, with the point `rigid_about`"
                )
            return self
        if not self.hold and not any(springs):
            raise ValueError("a rigid set needs hold, springs or both")
        for name, spring in zip(MOTIONS, springs, strict=False):
            if spring and name in self.hold:
                raise ValueError(f"the motion {name} is held, so that no spring can act on it")
        return self


class Load(Part):
    """A load, constant or times the value of a control.

    Either a `force` [N] on a set (shared by area where it holds faces, else equally among its nodes) or at a
    point, a `pressure` [Pa] against the faces of a set, or an `acceleration` [m/s^2] of everything that has
    mass: (0, 0, -9.81) is gravity along -z.
    """

    name: Name
    control: Name | None = None
    set: SetName | None = None
    point: Vector | None = None
    force: Vector | None = None
    pressure: float | None = None
    acceleration: Vector | None = None

    @model_validator(mode="after")
    def _one_kind_of_load(self) -> "Load":
        given = [key for key in ("force", "pressure", "acceleration") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError("one of force, pressure and acceleration is expected")
        refuse_zero(self.force, "force")
        refuse_zero(self.acceleration, "acceleration")
        places = [key for key in ("set", "point") if getattr(self, key) is not None]
        wanted = {"force": "either set or point", "pressure": "set", "acceleration": "no set and no point"}
        right = {
            "force": len(places) == 1,
            "pressure": places == ["set"],
            "acceleration": not places,
        }
        if not right[given[0]]:
            raise ValueError(f"{wanted[given[0]]} is expected beside {given[0]}")
        return self


class Damage(Part):
    """Region whose cells may lose stiffness, up to `largest_loss`; `name` is that of its loss."""

    name: Name
    set: SetName
    largest_loss: float = Field(default=0.8, gt=0.0, le=0.95)


class PointMass(Ranged):
    """Mass [kg] at a point of the structure; `free` where it is to be calibrated or chosen later."""

    point: Vector
    mass: float = Field(ge=0.0, lt=1e6)
    free: bool = False
    minimum: float | None = Field(default=None, ge=0.0)

    usual = (0.5, 1.5)

    @property
    def middle(self) -> float:
        """Nominal value."""
        return self.mass


class PointOutput(Part):
    """Displacement, or acceleration, of a point along a direction."""

    name: Name
    point: Vector
    direction: Vector

    @model_validator(mode="after")
    def _points_somewhere(self) -> "PointOutput":
        refuse_zero(self.direction, "direction")
        return self


class Damping(Part):
    """Rayleigh damping V = alpha M + beta K."""

    alpha: float = Field(default=0.0, ge=0.0, description="1/s")
    beta: float = Field(default=0.0, ge=0.0, description="s")


class ReductionLimits(Part):
    """How well the reduced model is to hold, and how many full solutions it may take."""

    tolerance: float = Field(default=6e-4, ge=1e-5, le=0.1, description="of the largest output")
    most_solutions: int = Field(default=401, ge=1, le=2000)


class StructureDesign(Part):
    """A structure: all that decides its model beside the mesh file. Make it with `load_structure`.

    Raises
    ------
    InvalidDesignError
        From `parse_structure` and `load_structure`, with one sentence that names the place.
    """

    name: str = Field(min_length=1)
    mesh: str = Field(min_length=1)
    length_unit: Literal["m", "cm", "mm", "um", "in", "ft"]
    set: tuple[NamedSet, ...] = ()
    parameter: tuple[Parameter, ...] = ()
    control: tuple[Control, ...] = ()
    material: tuple[Material, ...] = Field(min_length=1)
    support: tuple[Support, ...] = Field(min_length=1)
    load: tuple[Load, ...] = ()
    damage: tuple[Damage, ...] = Field(default=(), max_length=MOST_REGIONS)
    mass: tuple[PointMass, ...] = ()
    gauge: tuple[Gauge, ...] = ()
    displacement: tuple[PointOutput, ...] = ()
    acceleration: tuple[PointOutput, ...] = ()
    damping: Damping = Damping()
    reduction: ReductionLimits = ReductionLimits()

    @field_validator("name", "mesh")
    @classmethod
    def _one_line(cls, text: str) -> str:
        if not text.isprintable():
            raise ValueError("one line of text is expected, without line breaks or other control characters")
        return text

    @model_validator(mode="after")
    def _names_fit_together(self) -> "StructureDesign":
        # What a state, a control or an output is called by must be one thing.
        for keys in (
            ("parameter", "damage", "mass", "control"),
            ("gauge", "displacement", "acceleration"),
            ("load",),
            ("material",),
            ("set",),
        ):
            named = [
                (f"{key}[{number}]", part.name)
                for key in keys
                for number, part in enumerate(getattr(self, key), start=1)
            ]
            for (first, one), (second, two) in itertools.combinations(named, 2):
                if one == two:
                    raise ValueError(
                        f"{first} and {second} are both named {one!r}; give each a name of its own"
                    )
        parameters = [part.name for part in self.parameter]
        for number, part in enumerate(self.material, start=1):
            if part.scaled_by is not None and part.scaled_by not in parameters:
                raise ValueError(
                    f"material[{number}] is scaled by {part.scaled_by!r}, but no [[parameter]] has that name"
                )
        for name in parameters:
            if not any(part.scaled_by == name for part in self.material):
                raise ValueError(f"the parameter {name!r} scales no material")
        controls = [part.name for part in self.control]
        for number, load in enumerate(self.load, start=1):
            if load.control is not None and load.control not in controls:
                raise ValueError(
                    f"load[{number}] is tied to the control {load.control!r}, but no [[control]] has that "
                    "name"
                )
        for name in controls:
            if not any(load.control == name for load in self.load):
                raise ValueError(f"the control {name!r} commands no load")
        return self

    @property
    def unit(self) -> float:
        """Metres in the unit of length."""
        return UNITS[self.length_unit]


def parse_structure(content: dict[str, Any], source: str = "the structure") -> StructureDesign:
    """Check the content of a structure file.

    Raises
    ------
    InvalidDesignError
        One sentence that names `source`, the place, what came and what was expected.
    """
    content = with_rosettes(content, source, InvalidDesignError)
    return checked(StructureDesign, content, source, InvalidDesignError, what="a structure")


def load_structure(path: Path | str) -> StructureDesign:
    """Read a structure file; its mesh file is read by `fe.structure.mesh_file.read_mesh`.

    Raises
    ------
    DesignFileError
        If the file cannot be read or is not TOML.
    InvalidDesignError
        If its content is no structure.
    """
    file = Path(path)
    return parse_structure(read_toml(file, DesignFileError, what="structure file"), source=str(file))


def structure_hash(design: StructureDesign, mesh_file: Path) -> str:
    """SHA-256 of the design and of the bytes of its mesh file, 64 hexadecimal digits.

    Raises
    ------
    MeshError
        If the mesh file cannot be read.
    """
    content = design.model_dump(mode="json")
    del content["mesh"]  # its bytes count, not its name
    del content["reduction"]  # the structure is the same
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())
    try:
        digest.update(mesh_file.read_bytes())
    except OSError as error:
        raise MeshError(f"The mesh file {mesh_file} cannot be read: {error.strerror}.") from None
    return digest.hexdigest()
