"""Give regions of a deck materials of their own, and scale their moduli."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from fe.runtime.errors import MeshError
from fe.runtime.state import MOST_REGIONS
from fe.structure.abaqus import DataLine, KeywordBlock
from fe.structure.deck_text import real
from reporting.words import comma_list

from .linear_model import LinearModel, real_text, set_block

_PROPERTIES = {
    "CONDUCTIVITY",
    "CREEP",
    "CYCLIC HARDENING",
    "DAMPING",
    "DENSITY",
    "DEPVAR",
    "ELASTIC",
    "EXPANSION",
    "HYPERELASTIC",
    "HYPERFOAM",
    "PLASTIC",
    "SPECIFIC HEAT",
    "USER MATERIAL",
}
"""Keywords that belong to the *MATERIAL above them."""

_MODULI = {
    "ISO": (0,),
    "ORTHO": tuple(range(9)),
    "ANISO": tuple(range(21)),
    "ENGINEERING CONSTANTS": (0, 1, 2, 6, 7, 8),
}
"""Indices of the constants that are moduli, by the TYPE of *ELASTIC; the others are ratios."""

_CONSTANTS = {
    "ISO": 2,
    "ORTHO": 9,
    "ANISO": 21,
    "ENGINEERING CONSTANTS": 9,
}
"""Number of constants for one temperature, by the TYPE of *ELASTIC."""

COMPARED_DENSITY = "1e-9"
"""Density of a deck without any, with which its frequencies are compared with those of CalculiX.

CalculiX looks for eigenvalues near 1 (rad/s)^2 and misses smaller ones. A small density makes all
eigenvalues large.
"""
_NUMBERS_IN_LINE = 8


class Region(NamedTuple):
    """A region: its name in the structure file, the element set, and its elements."""

    name: str
    set_name: str
    elements: frozenset[int]


def choose_regions(model: LinearModel, set_names: Sequence[str]) -> list[Region]:
    """Return the regions that may lose stiffness.

    Parameters
    ----------
    set_names : sequence of str
        Names of sets of elements; if empty, the sets of all sections with an elastic material are
        taken.

    Raises
    ------
    MeshError
        If a set is missing or has no elastic material, if two sets overlap, or if there are more
        regions than a structure can have.
    """
    elastic_sets = _elastic_sets(model)
    names = [name.upper() for name in set_names] or list(elastic_sets)
    if len(names) > MOST_REGIONS:
        raise MeshError(
            f"{model.path}: one to {MOST_REGIONS} regions are expected, but there are "
            f"{len(names)} sets of elements with a section; name those that may lose stiffness by "
            "--region."
        )
    elastic = frozenset().union(*elastic_sets.values())
    regions: list[Region] = []
    for name in names:
        if name not in model.mesh.element_sets:
            known = comma_list(sorted(model.mesh.element_sets))
            raise MeshError(
                f"{model.path}: a set of elements is expected as --region, but there is no "
                f"{name}; there are {known}."
            )
        elements = frozenset(model.mesh.element_sets[name])
        if not elements & elastic:
            raise MeshError(
                f"{model.path}: no element of {name} has a section with an elastic material."
            )
        for other in regions:
            if elements & other.elements:
                raise MeshError(
                    f"{model.path}: regions must not overlap, but {other.set_name} and {name} "
                    "share elements."
                )
        regions.append(Region(f"z_{name_in_file(name)}"[:32], name, elements))
    return regions


def name_in_file(name: str) -> str:
    """Convert the name of a set to a name in a structure file: small letters, digits and `_`."""
    letters = [letter if letter.isascii() and letter.isalnum() else "_" for letter in name.lower()]
    return "".join(letters)


def with_own_materials(model: LinearModel, regions: Sequence[Region]) -> list[KeywordBlock]:
    """Return the blocks of a model in which each region has materials of its own.

    The materials are copies, so that the model is the same. A section whose elements lie only
    partly in a region becomes two sections.
    """
    blocks = list(model.blocks)
    for number, region in enumerate(regions, start=1):
        blocks = _with_material_of_region(model, blocks, region, f"_UAVR{number}")
    return blocks


def with_scaled_modulus(
    blocks: Sequence[KeywordBlock], region_number: int, factor: float
) -> list[KeywordBlock]:
    """Scale the moduli of one region in the blocks of a deck, which `with_own_materials` returns.

    `region_number` counts from 1.
    """
    scaled_blocks = []
    material = ""
    for block in blocks:
        if block.keyword == "MATERIAL":
            material = block.required("NAME")
        if block.keyword == "ELASTIC" and material.endswith(f"_UAVR{region_number}"):
            scaled_blocks.append(_with_scaled_constants(block, factor))
        else:
            scaled_blocks.append(block)
    return scaled_blocks


def with_densities(model: LinearModel, blocks: Sequence[KeywordBlock]) -> list[KeywordBlock]:
    """Return blocks in which each material has a density, which CalculiX needs.

    If the deck has no density at all, it is `COMPARED_DENSITY`; else it is negligible.
    """
    density = "1e-30" if model.has_mass else COMPARED_DENSITY
    with_density = {name for name, keyword in _properties(blocks) if keyword == "DENSITY"}
    completed = []
    for block in blocks:
        completed.append(block)
        if block.keyword == "MATERIAL" and block.required("NAME").upper() not in with_density:
            line = DataLine(block.where, [density])
            completed.append(KeywordBlock(block.where, "DENSITY", {}, [line]))
    return completed


def section_materials(section: KeywordBlock) -> list[str]:
    """Return the materials of a section in capital letters; a composite shell has several."""
    if "MATERIAL" in section.parameters:
        return [section.parameters["MATERIAL"].upper()]
    if "COMPOSITE" in section.parameters:
        return [values[2].upper() for _, values in section.data if len(values) > 2]
    return []


def is_section(block: KeywordBlock) -> bool:
    """Return whether a block gives a set of elements its material."""
    return block.keyword.endswith(" SECTION") and "ELSET" in block.parameters


def _properties(blocks: Sequence[KeywordBlock]) -> Iterator[tuple[str, str]]:
    """Yield the name of each material, in capital letters, with each keyword below it."""
    material = ""
    for block in blocks:
        if block.keyword == "MATERIAL":
            material = block.required("NAME").upper()
        elif block.keyword in _PROPERTIES:
            yield material, block.keyword


def _elastic_sets(model: LinearModel) -> dict[str, frozenset[int]]:
    """Return the elements of each set that has a section with an elastic material."""
    elastic_materials = {
        name for name, keyword in _properties(model.blocks) if keyword == "ELASTIC"
    }
    sets = {}
    for block in model.blocks:
        if is_section(block) and elastic_materials.intersection(section_materials(block)):
            name = block.parameters["ELSET"].upper()
            sets[name] = frozenset(model.mesh.element_sets.get(name, ()))
    return sets


def _with_material_of_region(
    model: LinearModel, blocks: list[KeywordBlock], region: Region, suffix: str
) -> list[KeywordBlock]:
    """Give the elements of a region copies of their materials, whose names end with a suffix.

    A section that lies partly in the region is split: its elements outside keep the material.
    """
    sets = dict(model.mesh.element_sets)
    sets |= {
        block.parameters["ELSET"]: [int(text) for _, values in block.data for text in values]
        for block in blocks
        if block.keyword == "ELSET" and "_UAVR" in block.parameters.get("ELSET", "")
    }
    result: list[KeywordBlock] = []
    copied: set[str] = set()
    for block in blocks:
        members = sets.get(block.parameters.get("ELSET", "").upper(), [])
        members_inside = [number for number in members if number in region.elements]
        if not is_section(block) or not members_inside:
            result.append(block)
            continue
        copied.update(section_materials(block))
        inside_block = _with_materials(block, suffix)
        members_outside = [number for number in members if number not in region.elements]
        if members_outside:
            set_name = block.parameters["ELSET"].upper()
            result += [set_block("ELSET", f"{set_name}_IN{suffix}", members_inside, block.where)]
            result += [set_block("ELSET", f"{set_name}_EX{suffix}", members_outside, block.where)]
            inside_block = _with_set(inside_block, f"{set_name}_IN{suffix}")
            result.append(_with_set(block, f"{set_name}_EX{suffix}"))
        result.append(inside_block)
    return [*_copied_materials(result, copied, suffix), *result]


def _copied_materials(
    blocks: Sequence[KeywordBlock], names: set[str], suffix: str
) -> Iterator[KeywordBlock]:
    """Yield the blocks of some materials under names with a suffix."""
    is_copied = False
    for block in blocks:
        if block.keyword == "MATERIAL":
            name = block.required("NAME").upper()
            is_copied = name in names
            if is_copied:
                yield block._replace(parameters=block.parameters | {"NAME": name + suffix})
        elif block.keyword in _PROPERTIES:
            if is_copied:
                yield block
        else:
            is_copied = False


def _with_materials(section: KeywordBlock, suffix: str) -> KeywordBlock:
    """Return a section with the materials of the same names with a suffix."""
    if "MATERIAL" in section.parameters:
        material = section.parameters["MATERIAL"].upper() + suffix
        return section._replace(parameters=section.parameters | {"MATERIAL": material})
    layers = []
    for where, values in section.data:
        layers.append(DataLine(where, [*values[:2], values[2].upper() + suffix, *values[3:]]))
    return section._replace(data=layers)


def _with_set(section: KeywordBlock, set_name: str) -> KeywordBlock:
    """Return a section with another set of elements."""
    return section._replace(parameters=section.parameters | {"ELSET": set_name})


def _with_scaled_constants(block: KeywordBlock, factor: float) -> KeywordBlock:
    """Return an *ELASTIC with its moduli scaled, at every temperature."""
    type_name = block.parameters.get("TYPE", "ISO").upper()
    # CalculiX reads the beginning of the word alone, so that ISOTROPIC is ISO.
    kind = next((name for name in _MODULI if type_name.startswith(name[:5])), None)
    if kind is None:
        raise MeshError(
            f"{block.where}: *ELASTIC of TYPE {comma_list(list(_MODULI))} is expected, but "
            f"{type_name} was given."
        )
    constants = _scaled_records(block, _record_widths(kind), _MODULI[kind], factor)
    return block._replace(data=constants)


def _record_widths(kind: str) -> list[int]:
    """Return how many numbers each line of a record has: the constants and a temperature."""
    remaining = _CONSTANTS[kind] + 1
    widths = []
    while remaining > 0:
        widths.append(min(remaining, _NUMBERS_IN_LINE))
        remaining -= _NUMBERS_IN_LINE
    return widths


def _scaled_records(
    block: KeywordBlock, widths: Sequence[int], moduli: Sequence[int], factor: float
) -> list[DataLine]:
    """Return the lines of constants with the moduli scaled."""
    starts: Mapping[int, int] = {line: sum(widths[:line]) for line in range(len(widths))}
    lines = []
    for number, (where, values) in enumerate(block.data):
        start = starts[number % len(widths)]
        texts = []
        for position, text in enumerate(values, start=start):
            is_modulus = position in moduli and text
            texts.append(real_text(factor * real(where, text)) if is_modulus else text)
        lines.append(DataLine(where, texts))
    return lines
