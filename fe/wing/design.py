"""The wing as its designer describes it: a TOML file, checked, in SI units.

Lengths are in metres, moduli in pascals, densities in kg/m^3, masses in kg, forces in newtons,
spring constants in N/m and N m/rad. Stations of ribs and point masses along the span are fractions
of the semi-span. Positions along the chord are fractions of the local chord from the leading edge.
"""

import hashlib
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import Field

from fe.runtime.errors import DesignFileError, InvalidDesignError
from fe.runtime.state import MOST_REGIONS, Geometry, default_region_names, wing_input_names
from fe.structure.tables import DesignSection, StructureDesign
from reporting.formats.toml_file import Check, read_toml, validate
from reporting.words import brief

from . import parts

SHIPPED_DESIGN = Path(__file__).parents[1] / "designs" / "uav_wing.toml"
"""The design of the wing of Kapteyn et al. 2021."""
_NAMES = Path(__file__).with_name("names.toml")


def wing_structure(regions: tuple[str, ...], gauges: int) -> StructureDesign:
    """Return a wing as a structure design: names and ranges of inputs, names of outputs."""
    content = read_toml(_NAMES, DesignFileError) | {
        "damage": [{"name": name} for name in regions],
        "gauge": [{"name": f"gauge_{number}"} for number in range(1, gauges + 1)],
    }
    return validate(
        StructureDesign, content, str(_NAMES), InvalidDesignError, what="a wing's names"
    )


RESERVED_NAMES = frozenset((*wing_input_names(()), "skin", "webs", "ribs"))
"""Names that damage regions cannot have, because other inputs or regions have them."""


class WingDesign(DesignSection):
    """A wing: everything that decides its model. Construct it with `load_design` or `parse_design`.

    Raises
    ------
    InvalidDesignError
        From `parse_design` and `load_design`, with one sentence that names the key in the design.
    """

    name: str = Field(min_length=1)
    """Name of the wing."""
    planform: parts.Planform
    """Span and chords."""
    airfoil: parts.Airfoil
    """Section of the wing."""
    skin: parts.Skin
    """Shell of the wing."""
    webs: tuple[parts.Web, ...] = Field(min_length=2)
    """Spanwise webs of the box, from the front to the rear."""
    ribs: tuple[parts.Rib, ...] = ()
    """Ribs."""
    rods: tuple[parts.Rod, ...] = ()
    """Round rods in webs."""
    added_density: tuple[parts.AddedDensity, ...] = ()
    """Density of glue, paint or wiring."""
    root: parts.Root
    """Springs at the root."""
    masses: parts.Masses
    """Nominal masses of servos and pitot tube."""
    point_masses: tuple[parts.PointMassPlace, ...] = ()
    """Places of servos and pitot tube."""
    gauges: parts.Gauges
    """Strain gauges on the upper skin."""
    defects: tuple[parts.Defect, ...] = Field(min_length=1, max_length=MOST_REGIONS)
    """Damage regions."""
    lift: parts.Lift
    """Load of a level turn."""
    tip_load: parts.TipLoad
    """Place of the static test load."""
    mesh: parts.MeshSettings
    """Sizes of the finite elements."""

    def __repr__(self) -> str:
        return brief(
            self,
            name=self.name,
            regions=self.regions,
            gauges=len(self.gauges.positions),
            hash=self.hash,
        )

    def checks(self) -> Iterator[Check]:
        """Yield the checks against parts that do not fit together."""
        yield from _web_checks(self)
        yield from _skin_checks(self)
        yield from _rod_checks(self)
        yield from _rib_checks(self)
        yield from _region_checks(self)
        yield from _added_density_checks(self)
        yield from _gauge_checks(self)
        yield from _point_checks(self)

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the damage regions, those of `defects`, in their order."""
        numbered = default_region_names(len(self.defects))
        return tuple(
            defect.name or name for defect, name in zip(self.defects, numbered, strict=True)
        )

    @property
    def geometry(self) -> Geometry:
        """Planform as the `Geometry` of a digital state [m]."""
        planform = self.planform
        return Geometry(planform.semi_span, planform.root_chord, planform.tip_chord)

    @property
    def hash(self) -> str:
        """SHA-256 of the content in hexadecimal; comments and the order of keys do not count."""
        content = self.model_dump(mode="json")
        default_names = default_region_names(len(self.defects))
        for defect, default_name in zip(content["defects"], default_names, strict=True):
            if defect["name"] in (None, default_name):  # a default name does not count
                del defect["name"]
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def front_chord(self) -> float:
        """Chord fraction of the front of the box."""
        return self.webs[0].chord

    @property
    def rear_chord(self) -> float:
        """Chord fraction of the rear of the box."""
        return self.webs[-1].chord

    def changed(self, **sections: Any) -> "WingDesign":
        """Return a checked copy with changes: `design.changed(mesh={"refinement": 2.0})`.

        Parameters
        ----------
        **sections
            For each top-level key a mapping whose entries replace those of the section, or a new
            value.

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


def _smallest_chord(design: WingDesign) -> float:
    """Return the smaller of the chords at root and tip [m]."""
    return min(design.planform.root_chord, design.planform.tip_chord)


def _web_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that webs are in order and lie inside the chord."""
    smallest_chord = _smallest_chord(design)
    for index, (web, next_web) in enumerate(itertools.pairwise(design.webs)):
        distance = (next_web.chord - web.chord) * smallest_chord
        room = distance - web.thickness - next_web.thickness
        yield (
            room <= 0.0,
            f"webs[{index + 1}] at chord {next_web.chord:g} must lie behind webs[{index}] at chord "
            f"{web.chord:g} with room for the thickness of both",
        )
    is_outside = design.front_chord <= 0.0 or design.rear_chord >= 1.0
    yield is_outside, "webs[0] and the last web must lie inside the chord, between 0 and 1"


def _skin_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that the skin is thin enough for the section at each web."""
    smallest_chord = _smallest_chord(design)
    thickness = design.skin.thickness
    for web in design.webs:
        ratio = parts.four_digit_half_thickness(web.chord, design.airfoil.thickness_ratio)
        half_height = float(ratio) * smallest_chord
        yield (
            half_height <= 1.5 * thickness,
            f"the skin of {thickness:g} m does not fit into the section at chord {web.chord:g}, "
            f"whose half height is {half_height:.2g} m at the smallest chord",
        )


def _rod_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that rods lie in webs that exist."""
    last_web = len(design.webs) - 1
    for index, rod in enumerate(design.rods):
        yield (
            rod.web > last_web,
            f"rods[{index}] lies in web {rod.web}, but there are only webs 0 to {last_web}",
        )


def _rib_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that ribs do not overlap."""
    intervals = sorted((*rib_interval(design, index), index) for index in range(len(design.ribs)))
    for (_, end, first), (start, _, second) in itertools.pairwise(intervals):
        yield (
            start < end,
            f"ribs[{first}] and ribs[{second}] overlap at {start:.4g} m from the root",
        )


def _box_check(design: WingDesign, subject: str, front: float, rear: float) -> Check:
    """Check that a pair of chord fractions lies inside the box; `subject` begins the message."""
    is_inside = design.front_chord <= front <= rear <= design.rear_chord
    return not is_inside, (
        f"{subject} lies outside the skin of the box from chord {design.front_chord:g} to "
        f"{design.rear_chord:g}"
    )


def _region_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that damage regions lie on the box, do not overlap and have free names."""
    span = design.planform.semi_span
    for index, defect in enumerate(design.defects):
        label = f"defects[{index}]"
        is_reversed = defect.span_end <= defect.span_start or defect.chord_end <= defect.chord_start
        yield is_reversed, f"{label} must end behind its start, along the span and along the chord"
        yield (
            defect.span_end > span,
            f"{label} ends {defect.span_end:g} m from the root, off the wing of {span:g} m",
        )
        subject = f"{label}, from chord {defect.chord_start:g} to {defect.chord_end:g},"
        yield _box_check(design, subject, defect.chord_start, defect.chord_end)
    for first, second in itertools.combinations(range(len(design.defects)), 2):
        labels = f"defects[{first}] and defects[{second}]"
        yield _overlap(design.defects[first], design.defects[second]), f"{labels} overlap"
        name = design.regions[first]
        yield (
            name == design.regions[second],
            f"{labels} are both named {name!r}; give each a name of its own",
        )
    for index, name in enumerate(design.regions):
        yield (
            name in RESERVED_NAMES,
            f"defects[{index}] is named {name!r}, which is taken; give it another name",
        )


def _overlap(defect: parts.Defect, other_defect: parts.Defect) -> bool:
    """Return whether two damage regions overlap, along the span and along the chord."""
    along_span = min(defect.span_end, other_defect.span_end) > max(
        defect.span_start, other_defect.span_start
    )
    along_chord = min(defect.chord_end, other_defect.chord_end) > max(
        defect.chord_start, other_defect.chord_start
    )
    return along_span and along_chord


def _added_density_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that intervals of added density begin before they end."""
    for index, added in enumerate(design.added_density):
        yield added.end <= added.start, f"added_density[{index}] must end behind its start"


def _gauge_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that gauges lie on the wing and on the box."""
    planform = design.planform
    half_length = 0.5 * design.gauges.averaging_spanwise
    half_width = 0.5 * design.gauges.averaging_chordwise
    for index, (distance, chord_fraction) in enumerate(design.gauges.positions):
        label = f"gauges.positions[{index}]"
        is_on_wing = half_length <= distance <= planform.semi_span - half_length
        yield (
            not is_on_wing,
            f"{label} is {distance:g} m from the root, with its averaging length off the wing of "
            f"{planform.semi_span:g} m",
        )
        middle = chord_fraction * planform.chord(distance / planform.semi_span)
        for end in (distance - half_length, distance + half_length):
            chord = planform.chord(end / planform.semi_span)
            yield _box_check(
                design,
                f"{label} at chord {chord_fraction:g}, with its averaging length,",
                (middle - half_width) / chord,
                (middle + half_width) / chord,
            )


def _point_checks(design: WingDesign) -> Iterator[Check]:
    """Yield the checks that point masses and the test load lie on the box."""
    chords = [(f"point_masses[{i}]", mass.chord) for i, mass in enumerate(design.point_masses)]
    chords.append(("tip_load", design.tip_load.chord))
    for label, chord in chords:
        yield _box_check(design, f"{label} at chord {chord:g}", chord, chord)
    is_beyond_root = design.tip_load.distance_from_tip >= design.planform.semi_span
    yield is_beyond_root, "tip_load.distance_from_tip reaches beyond the root"


def rib_interval(design: WingDesign, index: int) -> tuple[float, float]:
    """Return the start and the end of a rib [m from the root], moved inside the span."""
    rib = design.ribs[index]
    span = design.planform.semi_span
    start = rib.station * span - 0.5 * rib.thickness
    start = min(max(start, 0.0), span - rib.thickness)
    return start, start + rib.thickness


def parse_design(content: dict[str, Any], source: str = "the design") -> WingDesign:
    """Validate the content of a design file; `source` is its name in error messages.

    Raises
    ------
    InvalidDesignError
        If the content is not a wing that can be built; the message names `source`, the key, what
        was given and what was expected.
    """
    return validate(
        WingDesign, content, source, InvalidDesignError, what="a wing design", first_index=0
    )


def load_design(path: Path | str | None = None) -> WingDesign:
    """Read and validate a design file, by default the shipped design of the UAV wing.

    Raises
    ------
    DesignFileError
        If the file cannot be read or is not TOML.
    InvalidDesignError
        If its content is not a wing that can be built.
    """
    file = SHIPPED_DESIGN if path is None else Path(path)
    return parse_design(read_toml(file, DesignFileError, what="wing design"), source=str(file))
