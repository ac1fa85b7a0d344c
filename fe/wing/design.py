"""The wing as its designer describes it: a TOML file, checked, in SI units.

Lengths are in metres, moduli in pascals, densities in kg/m^3, masses in kg, forces in newtons, spring
constants in N/m and N m/rad. Stations along the span of ribs and point masses are fractions of the
semi-span, chordwise places are fractions of the local chord measured from the leading edge.
"""

import hashlib
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import Field

from fe.runtime.errors import DesignFileError, InvalidDesignError
from fe.runtime.state import MOST_REGIONS, Geometry, region_names, wing_names
from fe.sentences import said
from fe.structure.tables import Part, StructureDesign
from reporting.toml_file import Fault, read_toml, validate
from reporting.words import brief

from . import parts

SHIPPED_DESIGN = Path(__file__).parents[1] / "designs" / "uav_wing.toml"
"""The design of the wing of Kapteyn et al. 2021."""
_NAMES = Path(__file__).with_name("names.toml")


def wing_structure(regions: tuple[str, ...], gauges: int) -> StructureDesign:
    """Return a wing as a structure: by name what can be chosen, from where to where, and what can be read."""
    content = read_toml(_NAMES, DesignFileError) | {
        "damage": [{"name": name} for name in regions],
        "gauge": [{"name": f"gauge_{number}"} for number in range(1, gauges + 1)],
    }
    return validate(StructureDesign, content, str(_NAMES), InvalidDesignError, what="a wing's names")


TAKEN_NAMES = frozenset((*wing_names(()), "skin", "webs", "ribs"))
"""Names that mean something else where the names of damage regions stand."""


class WingDesign(Part):
    """A wing: everything that decides its model. Construct it with `load_design` or `parse_design`.

    Raises
    ------
    InvalidDesignError
        From `parse_design` and `load_design`, with one sentence that names the place in the design.
    """

    name: str = Field(min_length=1)
    planform: parts.Planform
    airfoil: parts.Airfoil
    skin: parts.Skin
    webs: tuple[parts.Web, ...] = Field(min_length=2)
    ribs: tuple[parts.Rib, ...] = ()
    rods: tuple[parts.Rod, ...] = ()
    added_density: tuple[parts.AddedDensity, ...] = ()
    root: parts.Root
    masses: parts.Masses
    point_masses: tuple[parts.PointMassPlace, ...] = ()
    gauges: parts.Gauges
    defects: tuple[parts.Defect, ...] = Field(min_length=1, max_length=MOST_REGIONS)
    lift: parts.Lift
    tip_load: parts.TipLoad
    mesh: parts.MeshSettings

    def __repr__(self) -> str:
        return brief(
            self, name=self.name, regions=self.regions, gauges=len(self.gauges.positions), hash=self.hash
        )

    def faults(self) -> Iterator[Fault]:
        """Yield parts that do not fit together."""
        for wrong in (_wrong_webs, _wrong_ribs, _wrong_regions, _wrong_gauges, _wrong_places):
            yield from wrong(self)

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the damage regions, those of `defects`, in their order."""
        numbered = region_names(len(self.defects))
        return tuple(defect.name or name for defect, name in zip(self.defects, numbered, strict=True))

    @property
    def geometry(self) -> Geometry:
        """Planform as the `Geometry` of a digital state [m]."""
        plan = self.planform
        return Geometry(plan.semi_span, plan.root_chord, plan.tip_chord)

    @property
    def hash(self) -> str:
        """SHA-256 of the content, 64 hexadecimal digits; comments and key order do not count."""
        whole = self.model_dump(mode="json")
        for defect, name in zip(whole["defects"], region_names(len(self.defects)), strict=True):
            if defect["name"] in (None, name):  # a name that says nothing does not count
                del defect["name"]
        content = json.dumps(whole, sort_keys=True, separators=(",", ":"))
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


def _wrong_webs(design: WingDesign) -> Iterator[Fault]:
    smallest = min(design.planform.root_chord, design.planform.tip_chord)
    for index, (before, after) in enumerate(itertools.pairwise(design.webs), start=1):
        room = (after.chord - before.chord) * smallest - before.thickness - after.thickness
        told = said("wing.webs", index=index, web=after, other=index - 1, before=before)
        yield room <= 0.0, told
    outside = design.front_chord <= 0.0 or design.rear_chord >= 1.0
    yield outside, "webs[0] and the last web must lie inside the chord, between 0 and 1"
    for web in design.webs:
        half = float(parts.four_digit_half_thickness(web.chord, design.airfoil.thickness_ratio)) * smallest
        thick = half <= 1.5 * design.skin.thickness
        yield thick, said("wing.skin", skin=design.skin, web=web, half=half)
    last = len(design.webs) - 1
    for index, rod in enumerate(design.rods):
        yield rod.web > last, said("wing.rods", index=index, rod=rod, last=last)


def _wrong_ribs(design: WingDesign) -> Iterator[Fault]:
    intervals = sorted((*rib_interval(design, index), index) for index in range(len(design.ribs)))
    for (_, end, first), (start, _, second) in itertools.pairwise(intervals):
        yield start < end, f"ribs[{first}] and ribs[{second}] overlap at {start:.4g} m from the root"


def _off_box(design: WingDesign, what: str, front: float, rear: float) -> Fault:
    inside = design.front_chord <= front <= rear <= design.rear_chord
    return not inside, said("wing.box", what=what, design=design)


def _wrong_regions(design: WingDesign) -> Iterator[Fault]:
    span = design.planform.semi_span
    for index, defect in enumerate(design.defects):
        where, ends = f"defects[{index}]", (defect.chord_start, defect.chord_end)
        turned = defect.span_end <= defect.span_start or ends[1] <= ends[0]
        yield turned, f"{where} must end behind its start, along the span and along the chord"
        far = f"{where} ends {defect.span_end:g} m from the root, off the wing of {span:g} m"
        yield defect.span_end > span, far
        yield _off_box(design, f"{where}, from chord {ends[0]:g} to {ends[1]:g},", *ends)
    for (first, one), (second, two) in itertools.combinations(enumerate(design.defects), 2):
        along = min(one.span_end, two.span_end) > max(one.span_start, two.span_start)
        across = min(one.chord_end, two.chord_end) > max(one.chord_start, two.chord_start)
        yield along and across, f"defects[{first}] and defects[{second}] overlap"
        name, other = design.regions[first], design.regions[second]
        both = {"first": f"defects[{first}]", "second": f"defects[{second}]"}
        yield name == other, said("design.names", name=name, **both)
    for index, name in enumerate(design.regions):
        taken = f"defects[{index}] is named {name!r}, which is taken; give it another name"
        yield name in TAKEN_NAMES, taken
    for index, added in enumerate(design.added_density):
        yield added.end <= added.start, f"added_density[{index}] must end behind its start"


def _wrong_gauges(design: WingDesign) -> Iterator[Fault]:
    span = design.planform.semi_span
    along, across = 0.5 * design.gauges.averaging_spanwise, 0.5 * design.gauges.averaging_chordwise
    for index, (distance, chord) in enumerate(design.gauges.positions):
        inside = along <= distance <= span - along
        yield not inside, said("wing.gauge", index=index, distance=distance, span=span)
        for end in (distance - along, distance + along):
            local = design.planform.chord(end / span)
            middle = chord * design.planform.chord(distance / span)
            where = f"gauges.positions[{index}] at chord {chord:g}, with its averaging length,"
            yield _off_box(design, where, (middle - across) / local, (middle + across) / local)


def _wrong_places(design: WingDesign) -> Iterator[Fault]:
    places = [(f"point_masses[{i}]", place.chord) for i, place in enumerate(design.point_masses)]
    for where, chord in [*places, ("tip_load", design.tip_load.chord)]:
        yield _off_box(design, f"{where} at chord {chord:g}", chord, chord)
    beyond = design.tip_load.distance_from_tip >= design.planform.semi_span
    yield beyond, "tip_load.distance_from_tip reaches beyond the root"


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
    return validate(WingDesign, content, source, InvalidDesignError, what="a wing design", first_index=0)


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
    return parse_design(read_toml(file, DesignFileError, what="wing design"), source=str(file))
