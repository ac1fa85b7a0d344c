"""The linear model in a deck: the blocks before its first step, at rest and without time.

A deck of CalculiX may hold contact, plasticity, preload, heat and curves over time. A structure for
a twin has constant matrices. This module takes the blocks that determine these matrices, and states
what is linearised and what is left out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from fe.runtime.errors import MeshError
from fe.structure.abaqus import DataLine, KeywordBlock, read_blocks
from fe.structure.deck_text import fail, real, whole
from reporting.words import comma_list

from .mesh_of_deck import DeckMesh, read_deck_mesh

ContactChoice = Literal["tied", "open"]
"""How contact pairs are modelled: surfaces that stick to each other, or that do not touch."""

PreloadChoice = Literal["tangent", "none"]
"""How a preload is modelled: the stiffness at its end, or that of the unloaded structure."""

_LONGEST_NUMBER = 20
"""Number of characters of a number that CalculiX reads; it silently cuts off the others."""
_MEMBERS_IN_LINE = 10

TRANSLATIONS = (1, 2, 3)
ROTATIONS = (4, 5, 6)

_REFUSED = {
    "CYCLIC SYMMETRY MODEL": "is one sector of a wheel, whose modes are waves around the wheel; "
    "model the whole wheel",
    "SUBMODEL": "takes its boundary from the results of another deck; give the whole model",
    "RESTART": "goes on from the results of another run; give the whole model",
    "CFD": "computes a flow",
    "FLUID SECTION": "computes a flow in a network of pipes",
    "FLUID CONSTANTS": "computes a flow",
    "ELECTROMAGNETICS": "computes an electromagnetic field",
    "MAGNETIC PERMEABILITY": "computes an electromagnetic field",
    "USER ELEMENT": "has elements that are compiled into a CalculiX of its author",
}
"""Keywords without which the deck is another model, with the reason."""

_NONLINEAR_MPCS = {
    "PLANE": "keeps nodes in one plane, whose direction changes with their motion",
    "STRAIGHT": "keeps nodes on one line, whose direction changes with their motion",
    "DIST": "keeps two nodes at a distance, which is quadratic in their motion",
}
"""Constraints of *MPC of which CalculiX stores no finite matrix, with the reason."""

_PLASTICITY = (
    "plasticity and creep are left out: the material is elastic, with the modulus of *ELASTIC"
)
_LINEARISED = {
    "PLASTIC": _PLASTICITY,
    "CYCLIC HARDENING": _PLASTICITY,
    "CREEP": _PLASTICITY,
    "TIE": "surfaces that are tied stay together, also in tension and shear",
    "PRE-TENSION SECTION": "bolts are modelled without their preload, as if welded at their cut",
    "GAP": "gaps are taken as CalculiX takes them before any load",
    "VISCO": _PLASTICITY,
}
"""Keywords that are linearised, with the sentence that says how."""

_TEMPERATURE = "temperatures in steps, and the strains that they cause, are left out"
_TIME = "time curves are left out: loads have the values of their lines"
_LEFT_OUT = {
    "AMPLITUDE": _TIME,
    "TEMPERATURE": _TEMPERATURE,
    "HEAT TRANSFER": _TEMPERATURE,
    "COUPLED TEMPERATURE-DISPLACEMENT": _TEMPERATURE,
    "UNCOUPLED TEMPERATURE-DISPLACEMENT": _TEMPERATURE,
    "DYNAMIC": _TIME,
    "MODAL DYNAMIC": _TIME,
    "STEADY STATE DYNAMICS": _TIME,
    "MODAL DAMPING": "damping is left out; write it into the table [damping]",
    "DAMPING": "damping is left out; write it into the table [damping]",
    "DASHPOT": "dashpots are left out; write damping into the table [damping]",
    "MODEL CHANGE": "changes of the model during the analysis are left out",
}
"""Keywords that are left out, with the sentence that says so."""

_NOT_IN_MODEL = {
    "AMPLITUDE",
    "BOUNDARY",
    "CONTACT PAIR",
    "CONTROLS",
    "CREEP",
    "CYCLIC HARDENING",
    "FRICTION",
    "HEADING",
    "NODE FILE",
    "NODE PRINT",
    "PLASTIC",
    "SURFACE BEHAVIOR",
    "SURFACE INTERACTION",
    "TIME POINTS",
}
"""Blocks before the first step that are no part of the linear model, or are written anew."""

_WRITTEN_ANEW = {"BOUNDARY", "HEADING", "NODE FILE", "NODE PRINT"}
"""Blocks before the first step of a preloaded model that are not part of it."""

_OUTPUT = {
    "CONTACT FILE",
    "CONTACT PRINT",
    "EL FILE",
    "EL PRINT",
    "ELEMENT OUTPUT",
    "NODE FILE",
    "NODE OUTPUT",
    "NODE PRINT",
    "SECTION PRINT",
}
"""Blocks of a step that print results."""


@dataclass(frozen=True)
class HeldMotion:
    """A direction in which a node is held: 1, 2, 3 along the axes, 4, 5, 6 about them."""

    node: int
    direction: int


@dataclass(frozen=True)
class LinearModel:
    """The linear model of a deck.

    Attributes
    ----------
    blocks : list of KeywordBlock
        The blocks of the model, without supports and steps.
    steps : list of list of KeywordBlock
        The blocks of each step.
    held : list of HeldMotion
        The motions that *BOUNDARY holds.
    remarks : list of str
        Sentences on what is linearised and left out.
    has_mass : bool
        Whether a material has a density.
    preload : list of list of KeywordBlock
        The blocks of the steps that preload the structure; empty if it is not preloaded.
    preload_supports : list of KeywordBlock
        The *BOUNDARY before these steps.
    """

    path: Path
    blocks: list[KeywordBlock]
    steps: list[list[KeywordBlock]]
    mesh: DeckMesh
    held: list[HeldMotion]
    remarks: list[str]
    has_mass: bool
    preload: list[list[KeywordBlock]] = field(default_factory=list)
    preload_supports: list[KeywordBlock] = field(default_factory=list)

    def text(
        self,
        *steps: Iterable[str],
        blocks: Sequence[KeywordBlock] | None = None,
        free: bool = False,
        preloaded: bool = False,
    ) -> str:
        """Return the text of the deck of this model with the given steps.

        The deck has one of three kinds of supports:

        - with `preloaded`, those of the preload, whose steps come first (if the model has one);
        - otherwise, with `free`, none but the held rotations;
        - otherwise all held motions.

        Parameters
        ----------
        *steps : iterable of str
            The lines of each step, between *STEP and *END STEP.
        blocks : sequence of KeywordBlock, optional
            Blocks of the model in place of its own.
        free : bool
            Whether the supports release all translations. It has no effect after a preload.
        preloaded : bool
            Whether the given steps are small changes from the end of the preload.
        """
        lines = []
        for block in self.blocks if blocks is None else blocks:
            lines += block_lines(block)
        if preloaded and self.preload:
            return "\n".join([*lines, *self._preloaded_lines(steps)]) + "\n"
        held_directions = ROTATIONS if free else (*TRANSLATIONS, *ROTATIONS)
        supports = [
            f"{motion.node},{motion.direction}"
            for motion in self.held
            if motion.direction in held_directions
        ]
        if supports:
            lines += ["*BOUNDARY", *supports]
        for step in steps:
            lines += ["*STEP", *step, "*END STEP"]
        return "\n".join(lines) + "\n"

    def _preloaded_lines(self, steps: Iterable[Iterable[str]]) -> list[str]:
        """Return the lines of supports, preload, and steps of small changes from its end."""
        lines = []
        for block in self.preload_supports:
            lines += block_lines(block)
        for preload_step in self.preload:
            for block in preload_step:
                lines += block_lines(block)
        for step in steps:
            step_lines = list(step)
            if not any(line.startswith("*DLOAD") for line in step_lines):
                # A pressure that stays would add the stiffness of loads that follow the surface to
                # a *FREQUENCY, but not to a *STATIC.
                step_lines.append("*DLOAD, OP=NEW")
            lines += ["*STEP, PERTURBATION", *step_lines, "*END STEP"]
        return lines


def real_text(value: float) -> str:
    """Format a number with at most the 20 characters that CalculiX reads."""
    text = repr(value)
    return text if len(text) <= _LONGEST_NUMBER else f"{value:.13e}"


def block_lines(block: KeywordBlock) -> list[str]:
    """Return the lines of a block in a deck."""
    head = f"*{block.keyword}"
    for name, value in block.parameters.items():
        head += f", {name}={value}" if value else f", {name}"
    return [head, *(",".join(values) for _, values in block.data)]


def set_block(keyword: str, name: str, members: Sequence[int], where: str = "") -> KeywordBlock:
    """Return an *NSET or *ELSET with these members; `where` is its place in the deck."""
    lines = []
    for start in range(0, len(members), _MEMBERS_IN_LINE):
        texts = [str(number) for number in members[start : start + _MEMBERS_IN_LINE]]
        lines.append(DataLine(where, texts))
    return KeywordBlock(where, keyword, {keyword: name}, lines)


def read_linear_model(
    path: Path, contact: ContactChoice = "tied", preload: PreloadChoice = "tangent"
) -> LinearModel:
    """Read the linear model of a deck.

    Parameters
    ----------
    preload : "tangent" or "none"
        How static steps before a first step of small changes (PERTURBATION) are modelled.

    Raises
    ------
    MeshError
        If the deck cannot be read, does not describe an elastic structure, or has no element.
    """
    all_blocks = list(read_blocks(path))
    if not all_blocks:
        raise MeshError(
            f"{path}: a deck with *NODE, *ELEMENT and *MATERIAL is expected, but it has no keyword."
        )
    _refuse_other_models(path, all_blocks)
    before_steps, steps = _split_steps(all_blocks)
    preload_steps = _preload_steps(steps) if preload == "tangent" else []
    if preload_steps:
        blocks = [block for block in before_steps if block.keyword not in _WRITTEN_ANEW]
    else:
        blocks = _unloaded_blocks(before_steps, contact)
    mesh = read_deck_mesh(blocks)
    if not mesh.elements:
        raise MeshError(f"{path}: a deck with elements is expected, but it has none.")
    supports = _supports(before_steps, steps)
    held, moved = _held_motions(supports, mesh)
    if preload_steps:
        remarks = _preload_remarks(all_blocks, preload_steps)
    else:
        remarks = _remarks(all_blocks, contact)
    if moved and not preload_steps:
        remarks.append("prescribed displacements are left out: what they move is held at zero")
    has_mass = any(block.keyword in ("DENSITY", "MASS") for block in blocks)
    return LinearModel(
        path=path,
        blocks=blocks,
        steps=_steps_after(steps, preload_steps),
        mesh=mesh,
        held=held,
        remarks=remarks,
        has_mass=has_mass,
        preload=preload_steps,
        preload_supports=[block for block in before_steps if block.keyword == "BOUNDARY"],
    )


def _unloaded_blocks(
    before_steps: list[KeywordBlock], contact: ContactChoice
) -> list[KeywordBlock]:
    """Return the blocks of a deck that describe the linear model without loads.

    `before_steps` are the blocks before the first step; `contact` says whether contact pairs are
    tied or left out.
    """
    blocks: list[KeywordBlock] = []
    for block in before_steps:
        if block.keyword == "CONTACT PAIR" and contact == "tied":
            blocks.append(_tie(block, len(blocks)))
        elif block.keyword == "INITIAL CONDITIONS":
            # At its first temperature a body is free of thermal strains; moduli depend on it.
            if block.parameters.get("TYPE", "").upper() == "TEMPERATURE":
                blocks.append(block)
        elif block.keyword not in _NOT_IN_MODEL:
            blocks.append(block)
    return blocks


def _preload_steps(steps: list[list[KeywordBlock]]) -> list[list[KeywordBlock]]:
    """Return the static steps before the first with PERTURBATION, without their output."""
    for step_index, step in enumerate(steps):
        if "PERTURBATION" in step[0].parameters:
            earlier = steps[:step_index]
            static = [step for step in earlier if any(b.keyword == "STATIC" for b in step)]
            return [[block for block in step if block.keyword not in _OUTPUT] for step in static]
    return []


def _steps_after(
    steps: list[list[KeywordBlock]], preload_steps: list[list[KeywordBlock]]
) -> list[list[KeywordBlock]]:
    """Return the steps from the first with PERTURBATION on; all if there is no preload."""
    if not preload_steps:
        return steps
    first = next(n for n, step in enumerate(steps) if "PERTURBATION" in step[0].parameters)
    return steps[first:]


def _refuse_other_models(path: Path, blocks: list[KeywordBlock]) -> None:
    """Raise `MeshError` if a deck does not describe an elastic structure in one piece."""
    for block in blocks:
        if block.keyword in _REFUSED:
            raise MeshError(
                f"{block.where}: a deck of an elastic structure is expected, but "
                f"*{block.keyword} {_REFUSED[block.keyword]}."
            )
        if block.keyword == "MPC":
            for where, values in block.data:
                kind = values[0].upper()
                if kind in _NONLINEAR_MPCS:
                    fail(
                        where,
                        f"*MPC {kind} {_NONLINEAR_MPCS[kind]}, and cannot be linearised; "
                        "write it as *EQUATION for small motions, or as "
                        "*RIGID BODY.",
                    )
    keywords = {block.keyword for block in blocks}
    if "ELASTIC" not in keywords:
        materials = [
            f"*{block.keyword}"
            for block in blocks
            if block.keyword in ("HYPERELASTIC", "HYPERFOAM", "USER MATERIAL", "CONDUCTIVITY")
        ]
        material_text = comma_list(list(dict.fromkeys(materials))) if materials else "none"
        raise MeshError(
            f"{path}: a material with *ELASTIC is expected, but the deck has {material_text}; give "
            "its materials an elastic modulus."
        )


def _split_steps(
    blocks: list[KeywordBlock],
) -> tuple[list[KeywordBlock], list[list[KeywordBlock]]]:
    """Return the blocks before the first step, and those of each step."""
    before_steps: list[KeywordBlock] = []
    steps: list[list[KeywordBlock]] = []
    for block in blocks:
        if block.keyword == "STEP":
            steps.append([])
        (steps[-1] if steps else before_steps).append(block)
    return before_steps, steps


def _tie(contact_pair: KeywordBlock, tie_number: int) -> KeywordBlock:
    """Return the *TIE that replaces a *CONTACT PAIR; `tie_number` makes its name unique."""
    parameters = {"NAME": f"UAVPAIR{tie_number}"}
    if "ADJUST" in contact_pair.parameters:
        parameters["ADJUST"] = "NO"
    slave_and_master = [DataLine(where, values[:2]) for where, values in contact_pair.data]
    return KeywordBlock(contact_pair.where, "TIE", parameters, slave_and_master)


def _supports(
    before_steps: list[KeywordBlock], steps: list[list[KeywordBlock]]
) -> list[KeywordBlock]:
    """Return the *BOUNDARY blocks before all steps, and those of the first step that has any."""
    supports = [block for block in before_steps if block.keyword == "BOUNDARY"]
    for step in steps:
        in_step = [block for block in step if block.keyword == "BOUNDARY"]
        if in_step:
            return supports + in_step
    return supports


def _held_motions(supports: list[KeywordBlock], mesh: DeckMesh) -> tuple[list[HeldMotion], bool]:
    """Return the motions that *BOUNDARY holds, and whether it prescribes any to be non-zero."""
    held: dict[HeldMotion, None] = {}
    moved = False
    for block in supports:
        for where, values in block.data:
            name, first_text, last_text, value_text, *_ = [*values, "", "", "", ""]
            first = whole(where, first_text)
            last = whole(where, last_text) if last_text else first
            directions = [direction for direction in range(first, last + 1) if 1 <= direction <= 6]
            moved = moved or bool(directions and real(where, value_text))
            for node in mesh.nodes_named(name, where):
                held |= dict.fromkeys(HeldMotion(node, direction) for direction in directions)
    return list(held), moved


def _remarks(blocks: list[KeywordBlock], contact: ContactChoice) -> list[str]:
    """Return the sentences on what is linearised and left out, each once."""
    sentences = []
    for block in blocks:
        for table in (_LINEARISED, _LEFT_OUT):
            if block.keyword in table:
                sentences.append(table[block.keyword])
        if block.keyword == "CONTACT PAIR" and contact == "tied":
            sentences.append("contact pairs are tied: they neither open nor slide")
        elif block.keyword == "CONTACT PAIR":
            sentences.append("contact pairs are left out: their surfaces do not touch")
        if block.keyword == "STEP" and "NLGEOM" in block.parameters:
            sentences.append("displacements are small: NLGEOM is left out")
        if block.keyword == "STEP" and "PERTURBATION" in block.parameters:
            sentences.append("preload is left out: the stiffness is that of the unloaded structure")
        if block.keyword == "INITIAL CONDITIONS" and block.parameters.get("TYPE") == "STRESS":
            sentences.append("initial stresses are left out")
    return list(dict.fromkeys(sentences))


def _preload_remarks(
    blocks: list[KeywordBlock], preload_steps: list[list[KeywordBlock]]
) -> list[str]:
    """Return the sentences on the preload, and on what is left out of later steps."""
    sentences = [
        f"the stiffness is that at the end of the preload of {len(preload_steps)} "
        f"{'step' if len(preload_steps) == 1 else 'steps'}, and stays as it is there",
        "the loads of the preload keep size and direction: they are no loads of the structure",
        "a region loses the stiffness that it has without preload",
    ]
    if any(block.keyword == "CONTACT PAIR" for block in blocks):
        sentences.append("contact stays as the preload leaves it")
    sentences += [_LEFT_OUT[block.keyword] for block in blocks if block.keyword in _LEFT_OUT]
    return list(dict.fromkeys(sentences))
