"""The wing as its designer describes it: a TOML file, checked, in SI units.

Lengths are in metres, moduli in pascals, densities in kg/m^3, masses in kg, forces in newtons, spring
constants in N/m and N m/rad. Stations along the span of ribs and point masses are fractions of the
semi-span, chordwise places are fractions of the local chord measured from the leading edge.
"""

import hashlib
import itertools
import json
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from .airfoil import four_digit_half_thickness
from .errors import DesignFileError, InvalidDesignError
from .state import STIFFNESS_LOSS_NAMES, Geometry

SHIPPED_DESIGN = Path(__file__).parent / "designs" / "uav_wing.toml"
"""The design of the wing of Kapteyn et al. 2021."""

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Thickness = Annotated[float, Field(gt=0.0, lt=0.1, description="m")]
Modulus = Annotated[float, Field(ge=1e6, le=1e13, description="Pa")]
PoissonRatio = Annotated[float, Field(ge=0.0, lt=0.5)]
ShearRatio = Annotated[float, Field(gt=0.0, le=1.0)]
Density = Annotated[float, Field(ge=0.0, le=3e4, description="kg/m^3")]
Spring = Annotated[float, Field(gt=0.0, le=1e15)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)


class Planform(_Part):
    """Straight-tapered half-wing; the chord line `straight_chord_line` is the spanwise axis."""

    semi_span: float = Field(gt=0.05, lt=60.0, description="m")
    root_chord: float = Field(gt=0.01, lt=15.0, description="m")
    tip_chord: float = Field(gt=0.01, lt=15.0, description="m")
    straight_chord_line: Fraction

    def chord(self, station: float) -> float:
        """Chord [m] at a fraction of the semi-span."""
        return self.root_chord + (self.tip_chord - self.root_chord) * station


class Airfoil(_Part):
    """Symmetric four-digit section."""

    thickness_ratio: float = Field(ge=0.02, le=0.4)


class SkinBand(_Part):
    """Young's modulus [Pa] of the skin from the previous band's end to `end`, a fraction of the span."""

    end: Fraction
    young_modulus: Modulus


class Skin(_Part):
    """Shell of the wing; orthotropic with equal moduli, the shear moduli as ratios to Young's modulus."""

    thickness: Thickness
    density: Density
    poisson_ratio: PoissonRatio
    in_plane_shear_ratio: ShearRatio
    transverse_shear_ratio: ShearRatio
    closed_leading_edge: bool = True
    bands: tuple[SkinBand, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _bands_cover_the_span(self) -> "Skin":
        ends = [band.end for band in self.bands]
        if any(after <= before for before, after in zip([0.0, *ends], ends, strict=False)) or ends[-1] != 1.0:
            raise ValueError(f"the ends of the bands must rise from above 0 to 1, but are {ends}")
        return self


class Web(_Part):
    """Spanwise web at a chordwise place; the first and the last close the box."""

    chord: Fraction
    thickness: Thickness
    young_modulus: Modulus
    shear_modulus: Modulus
    poisson_ratio: PoissonRatio
    density: Density


class Rib(_Part):
    """Rib at a fraction of the span, isotropic, over the whole height and width of the box."""

    station: Fraction
    thickness: Thickness
    young_modulus: Modulus
    poisson_ratio: PoissonRatio
    density: Density


class Rod(_Part):
    """Solid round rod at mid-height of a web, from the root to `reach`, a fraction of the span.

    Its flapwise bending stiffness and its mass are spread over the cells of that web.
    """

    web: int = Field(ge=0)
    reach: float = Field(gt=0.0, le=1.0)
    diameter: Thickness
    young_modulus: Modulus
    density: Density


class AddedDensity(_Part):
    """Density [kg/m^3] added to everything between two fractions of the span (glue, paint, wiring)."""

    start: Fraction
    end: Fraction
    density: Density


class Root(_Part):
    """Springs that carry the rigid root rib; its other motions are held."""

    transverse_spring: Spring = Field(description="N/m")
    flap_spring: Spring = Field(description="N m/rad")
    yaw_spring: Spring = Field(description="N m/rad")


class PointMassPlace(_Part):
    """Where a point mass of a kind sits; its mass is `masses.<kind>` until calibrated."""

    kind: Literal["servo", "pitot"]
    station: Fraction
    chord: Fraction


class Masses(_Part):
    """Nominal masses [kg] of one servo and of the pitot tube."""

    servo: float = Field(ge=0.0, lt=1e3)
    pitot: float = Field(ge=0.0, lt=1e3)


class Gauges(_Part):
    """Strain gauges on the upper skin, along the span.

    Positions are (distance from the root [m], chord fraction); a gauge reads the strain averaged over a
    patch of `averaging_chordwise` by `averaging_spanwise` [m].
    """

    averaging_chordwise: float = Field(ge=0.0, lt=1.0, description="m")
    averaging_spanwise: float = Field(default=0.0, ge=0.0, lt=1.0, description="m")
    positions: tuple[tuple[float, float], ...] = Field(min_length=1)


class Defect(_Part):
    """Region of the upper skin that may lose stiffness: distances from the root [m], chord fractions."""

    span_start: float = Field(ge=0.0)
    span_end: float = Field(gt=0.0)
    chord_start: Fraction
    chord_end: Fraction


class Lift(_Part):
    """Net load of a level turn, linear in the load factor.

    `force` [N] and `forward_force` [N] are the totals on the half-wing at `load_factor`. The lift per
    chord is weighted by 2 (1 - xi), xi the chord fraction.
    """

    distribution: Literal["schrenk", "lifting_line"]
    force: float = Field(gt=0.0, lt=1e6)
    forward_force: float = Field(ge=0.0, lt=1e6)
    load_factor: float = Field(gt=0.0, lt=20.0)


class TipLoad(_Part):
    """Place of the static test load: distance from the tip [m] and chord fraction."""

    distance_from_tip: float = Field(ge=0.0)
    chord: Fraction


class MeshSettings(_Part):
    """Largest cell: along the span [m] and along the chord (fraction); both are divided by `refinement`."""

    span_size: float = Field(gt=1e-3, lt=10.0)
    chord_size: float = Field(gt=0.005, le=1.0)
    refinement: float = Field(default=1.0, ge=0.25, le=8.0)


class WingDesign(_Part):
    """A wing: everything that decides its model. Construct it with `load_design` or `parse_design`.

    Raises
    ------
    InvalidDesignError
        From `parse_design` and `load_design`, with one sentence that names the place in the design.
    """

    name: str = Field(min_length=1)
    planform: Planform
    airfoil: Airfoil
    skin: Skin
    webs: tuple[Web, ...] = Field(min_length=2)
    ribs: tuple[Rib, ...] = ()
    rods: tuple[Rod, ...] = ()
    added_density: tuple[AddedDensity, ...] = ()
    root: Root
    masses: Masses
    point_masses: tuple[PointMassPlace, ...] = ()
    gauges: Gauges
    defects: tuple[Defect, ...]
    lift: Lift
    tip_load: TipLoad
    mesh: MeshSettings

    @field_validator("defects")
    @classmethod
    def _one_defect_per_loss(cls, defects: tuple[Defect, ...]) -> tuple[Defect, ...]:
        if len(defects) != len(STIFFNESS_LOSS_NAMES):
            raise ValueError(
                f"exactly {len(STIFFNESS_LOSS_NAMES)} defect regions are expected, for "
                f"{' and '.join(STIFFNESS_LOSS_NAMES)}, but {len(defects)} were given"
            )
        return defects

    @model_validator(mode="after")
    def _parts_fit_together(self) -> "WingDesign":
        for check in (_check_webs, _check_ribs, _check_regions, _check_gauges, _check_places):
            check(self)
        return self

    @property
    def geometry(self) -> Geometry:
        """Planform as the `Geometry` of a digital state [m]."""
        plan = self.planform
        return Geometry(plan.semi_span, plan.root_chord, plan.tip_chord)

    @property
    def hash(self) -> str:
        """SHA-256 of the content, 64 hexadecimal digits; comments and key order do not count."""
        content = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def front_chord(self) -> float:
        """Chord fraction of the front of the box."""
        return self.webs[0].chord

    @property
    def rear_chord(self) -> float:
        """Chord fraction of the rear of the box."""
        return self.webs[-1].chord

    def changed(self, **sections: Any) -> "WingDesign":
        """Copy with other contents, checked: `design.changed(mesh={"refinement": 2.0})`.

        Parameters
        ----------
        **sections
            For each top-level key a mapping whose items replace those of the section, or a new value.

        Raises
        ------
        InvalidDesignError
            If the changed design cannot be built.
        """
        content = self.model_dump(mode="python")
        for key, value in sections.items():
            if isinstance(value, dict) and isinstance(content.get(key), dict):
                content[key] = {**content[key], **value}
            else:
                content[key] = value
        return parse_design(content, source="the changed design")


def _check_webs(design: WingDesign) -> None:
    smallest = min(design.planform.root_chord, design.planform.tip_chord)
    for index, (before, after) in enumerate(itertools.pairwise(design.webs), start=1):
        room = (after.chord - before.chord) * smallest - before.thickness - after.thickness
        if room <= 0.0:
            raise ValueError(
                f"webs[{index}] at chord {after.chord:g} must lie behind webs[{index - 1}] at chord "
                f"{before.chord:g} with room for the thickness of both"
            )
    if design.front_chord <= 0.0 or design.rear_chord >= 1.0:
        raise ValueError("webs[0] and the last web must lie inside the chord, between 0 and 1")
    for web in design.webs:
        half = float(four_digit_half_thickness(web.chord, design.airfoil.thickness_ratio)) * smallest
        if half <= 1.5 * design.skin.thickness:
            raise ValueError(
                f"the skin of {design.skin.thickness:g} m does not fit into the section at chord "
                f"{web.chord:g}, whose half height is {half:.2g} m at the smallest chord"
            )
    for index, rod in enumerate(design.rods):
        if rod.web >= len(design.webs):
            raise ValueError(
                f"rods[{index}] lies in web {rod.web}, but there are only webs 0 to {len(design.webs) - 1}"
            )


def _check_ribs(design: WingDesign) -> None:
    intervals = sorted((*rib_interval(design, index), index) for index in range(len(design.ribs)))
    for (_, end, first), (start, _, second) in itertools.pairwise(intervals):
        if start < end:
            raise ValueError(f"ribs[{first}] and ribs[{second}] overlap at {start:.4g} m from the root")


def _check_regions(design: WingDesign) -> None:
    span = design.planform.semi_span
    for index, defect in enumerate(design.defects):
        where = f"defects[{index}]"
        if defect.span_end <= defect.span_start or defect.chord_end <= defect.chord_start:
            raise ValueError(f"{where} must end behind its start, along the span and along the chord")
        if defect.span_end > span:
            raise ValueError(f"{where} ends {defect.span_end:g} m from the root, off the wing of {span:g} m")
        if defect.chord_start < design.front_chord or defect.chord_end > design.rear_chord:
            raise ValueError(
                f"{where} covers chord {defect.chord_start:g} to {defect.chord_end:g}, outside the skin of "
                f"the box from {design.front_chord:g} to {design.rear_chord:g}"
            )
    one, two = design.defects
    if min(one.span_end, two.span_end) > max(one.span_start, two.span_start) and min(
        one.chord_end, two.chord_end
    ) > max(one.chord_start, two.chord_start):
        raise ValueError("defects[0] and defects[1] overlap")
    for index, added in enumerate(design.added_density):
        if added.end <= added.start:
            raise ValueError(f"added_density[{index}] must end behind its start")


def _check_gauges(design: WingDesign) -> None:
    span = design.planform.semi_span
    along, across = 0.5 * design.gauges.averaging_spanwise, 0.5 * design.gauges.averaging_chordwise
    for index, (distance, chord) in enumerate(design.gauges.positions):
        if not along <= distance <= span - along:
            raise ValueError(
                f"gauges.positions[{index}] is {distance:g} m from the root, with its averaging length off "
                f"the wing of {span:g} m"
            )
        for end in (distance - along, distance + along):
            local = design.planform.chord(end / span)
            middle = chord * design.planform.chord(distance / span)
            reach = [(middle - across) / local, (middle + across) / local]
            if reach[0] < design.front_chord or reach[1] > design.rear_chord:
                raise ValueError(
                    f"gauges.positions[{index}] at chord {chord:g} does not lie, with its averaging length, "
                    f"on the skin of the box from chord {design.front_chord:g} to {design.rear_chord:g}"
                )


def _check_places(design: WingDesign) -> None:
    places = [(f"point_masses[{i}]", place.chord) for i, place in enumerate(design.point_masses)]
    for where, chord in [*places, ("tip_load", design.tip_load.chord)]:
        if not design.front_chord <= chord <= design.rear_chord:
            raise ValueError(
                f"{where} at chord {chord:g} does not lie on the box from {design.front_chord:g} to "
                f"{design.rear_chord:g}"
            )
    if design.tip_load.distance_from_tip >= design.planform.semi_span:
        raise ValueError("tip_load.distance_from_tip reaches beyond the root")


def rib_interval(design: WingDesign, index: int) -> tuple[float, float]:
    """Start and end [m from the root] of a rib's thickness; ribs at the ends lie inside the span."""
    rib, span = design.ribs[index], design.planform.semi_span
    start = min(max(rib.station * span - 0.5 * rib.thickness, 0.0), span - rib.thickness)
    return start, start + rib.thickness


def parse_design(content: dict[str, Any], source: str = "the design") -> WingDesign:
    """Check the content of a design file.

    Raises
    ------
    InvalidDesignError
        One sentence that names `source`, the place, what came and what was expected.
    """
    try:
        return WingDesign.model_validate(content)
    except ValidationError as error:
        raise InvalidDesignError(_one_sentence(error, source)) from None


def _one_sentence(error: ValidationError, source: str) -> str:
    details = error.errors()
    first = details[0]
    place = ""
    for part in first["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else str(part)
    if first["type"] == "extra_forbidden":
        sentence = f"{source}: '{place}' is not a key of a wing design; remove it or correct its spelling"
    elif first["type"] == "missing":
        sentence = f"{source}: '{place}' is missing"
    else:
        message = first["msg"].removeprefix("Value error, ")
        came = first.get("input")
        shown = f" (given: {came!r})" if isinstance(came, str | int | float) else ""
        sentence = f"{source}: {place + ': ' if place else ''}{message[0].lower() + message[1:]}{shown}"
    more = f" ({len(details) - 1} more to mend)" if len(details) > 1 else ""
    return f"{sentence}{more}."


def load_design(path: Path | str | None = None) -> WingDesign:
    """Read a design file; without a path, the shipped design of the UAV wing.

    Raises
    ------
    DesignFileError
        If the file cannot be read or is not TOML.
    InvalidDesignError
        If its content is not a wing that can be built.
    """
    file = SHIPPED_DESIGN if path is None else Path(path)
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DesignFileError(f"The wing design {file} cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DesignFileError(f"The wing design {file} is not valid TOML: {error}.") from None
    return parse_design(content, source=str(file))


def rod_bending_stiffness(rod: Rod) -> float:
    """Bending stiffness E I [N m^2] of a solid round rod."""
    return rod.young_modulus * math.pi * rod.diameter**4 / 64.0
