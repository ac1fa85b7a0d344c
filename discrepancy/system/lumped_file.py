"""A lumped model as a TOML file: its content, its matrices and the checks of both."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import chain, product
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import ModelError
from discrepancy.system.lumped_sections import (
    GAINS,
    ControllerSection,
    CouplingSection,
    Damping,
    InputSection,
    LawSection,
    LoadSection,
    Matrix,
    NamedVector,
    OutputSection,
    PartSection,
    PlaceSection,
    PortSection,
    RootSection,
    Rows,
    ScaledParameter,
    as_list,
)
from discrepancy.system.model_file import ModelDescription
from reporting.choices import did_you_mean
from reporting.formats.toml_file import Check, Positive
from reporting.words import counted, listing

SHIPPED_MODELS = Path(__file__).parents[1] / "lumped_models"
"""Models that come with the package, by file name without the ending."""
KINDS = ("mass", "stiffness", "damping", "capacity", "conductance")
"""Matrices of a lumped model; each can have parts."""
SYMMETRIC = ("mass", "stiffness", "damping", "capacity")
"""Matrices that must be symmetric."""


class Block(NamedTuple):
    """The position of a matrix in the equation of motion of all unknowns z.

    Attributes
    ----------
    derivative : int
        The time derivative of z that the matrix multiplies.
    rows_of_states, columns_of_states : bool
        Whether its rows, and its columns, belong to states; otherwise to displacements. A state
        is the speed of its coordinate in z.
    """

    derivative: int
    rows_of_states: bool
    columns_of_states: bool

    @property
    def is_coupling(self) -> bool:
        """Whether it couples displacements and states."""
        return self.rows_of_states is not self.columns_of_states


BLOCKS = {
    "mass": Block(2, rows_of_states=False, columns_of_states=False),
    "stiffness": Block(0, rows_of_states=False, columns_of_states=False),
    "damping": Block(1, rows_of_states=False, columns_of_states=False),
    "capacity": Block(2, rows_of_states=True, columns_of_states=True),
    "conductance": Block(1, rows_of_states=True, columns_of_states=True),
    "force_of_states": Block(1, rows_of_states=False, columns_of_states=True),
    "flow_of_speeds": Block(1, rows_of_states=True, columns_of_states=False),
    "flow_of_displacements": Block(0, rows_of_states=True, columns_of_states=False),
}
"""Matrices in the equation of all unknowns."""
SECTIONS_WITH_VECTORS = ("input", "output", "port", "place", "load", "controller")
"""Tables of the file with vectors of one entry for each displacement or state."""
ADVICE_FOR_FREE_STRUCTURE = (
    "; a structure that can float away has no static response: set `free = true` if it can"
)


def _is_definite(matrix: FloatArray) -> bool:
    """Return whether a symmetric matrix is positive definite."""
    return bool(np.linalg.eigvalsh(matrix)[0] > 0.0)


class LumpedDescription(ModelDescription):
    """Content of a lumped model's file, SI; vectors have n + m entries, displacements first.

    `mass` and `stiffness` are matrices (n, n), vectors of a diagonal, or for n = 1 numbers; left
    out if there are only states. `capacity` T and `conductance` R (m, m) are those of the states
    x, and `coupling` holds F, G, H: M u'' + C u' + K u = F x + ..., T x' + R x = G u' + H u + ...
    With `free` the stiffness may be singular. `characteristic_length` [m] is by default the largest
    station, or 1.
    """

    what: ClassVar[str] = "a lumped model"
    mass: Matrix = ()
    """Mass matrix (n, n), its diagonal, or one number; left out if there are only states [SI]."""
    stiffness: Matrix = ()
    """Stiffness matrix (n, n), its diagonal, or one number [SI]."""
    damping: Damping | None = None
    """Damping of the displacements."""
    capacity: Matrix = ()
    """Matrix T (m, m) of the states, its diagonal, or one number [SI]."""
    conductance: Matrix = ()
    """Matrix R (m, m) of the states, its diagonal, or one number [SI]."""
    coupling: CouplingSection = CouplingSection()
    """Coupling of displacements and states."""
    free: bool = False
    """Whether the stiffness may be singular, as of a body that can float away."""
    characteristic_length: Positive | None = None
    """Length that stands for the size of the structure; by default the largest station, or 1
    [m]."""
    mass_part: tuple[PartSection, ...] = ()
    """Parts of the mass that a parameter can scale."""
    stiffness_part: tuple[PartSection, ...] = ()
    """Parts of the stiffness that a parameter can scale."""
    damping_part: tuple[PartSection, ...] = ()
    """Parts of the damping that a parameter can scale."""
    capacity_part: tuple[PartSection, ...] = ()
    """Parts of the capacity that a parameter can scale."""
    conductance_part: tuple[PartSection, ...] = ()
    """Parts of the conductance that a parameter can scale."""
    load: tuple[LoadSection, ...] = ()
    """Constant loads."""
    input: tuple[InputSection, ...] = ()
    """Loads and prescribed motions that a trial records."""
    output: tuple[OutputSection, ...] = Field(min_length=1)
    """What channels can measure."""
    port: tuple[PortSection, ...] = ()
    place: tuple[PlaceSection, ...] = ()
    """Places where a mass can be added."""
    root: RootSection | None = None
    """Motion of the structure if its base turns."""
    law: tuple[LawSection, ...] = ()
    """Laws that the model has at ports."""
    controller: tuple[ControllerSection, ...] = ()
    """Controllers."""
    parameter: tuple[ScaledParameter, ...] = ()

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a TOML file, or a shipped one by name (`single_mass_rig`); raises `ModelError`."""
        file = Path(path)
        if not file.suffix and not file.exists():
            file = SHIPPED_MODELS / f"{path}.toml"
            if not file.exists():
                shipped = sorted(model.stem for model in SHIPPED_MODELS.glob("*.toml"))
                raise ModelError(
                    f"There is no lumped model {str(path)!r}; give a file or one of the shipped "
                    f"models {', '.join(shipped)}.{did_you_mean(str(path), shipped)}"
                )
        return super().read(file)

    @property
    def displacement_count(self) -> int:
        """Number n of displacements."""
        return len(self.mass)

    @property
    def state_count(self) -> int:
        """Number m of states of first order."""
        return len(self.capacity)

    @cached_property
    def unknown_count(self) -> int:
        """Number of displacements, states, and integrals of controllers."""
        integrals = [controller for controller in self.controller if controller.integral != 0.0]
        return self.displacement_count + self.state_count + len(integrals)

    def pad_to_all_unknowns(self, row: Sequence[float] | FloatArray) -> FloatArray:
        """Return a vector (n + m,) of the file as (N,), with zeros for integrals of controllers."""
        padded_row = np.zeros(self.unknown_count)
        padded_row[: len(row)] = row
        return padded_row

    @cached_property
    def is_structure_on_springs(self) -> bool:
        """Whether the file describes only a structure on springs with forces as inputs.

        Such a file has no states, constant loads, prescribed motions, damping parts or controllers.
        The inputs act along vectors of their own, and the outputs are vectors without a constant.
        """
        is_held_and_forced = bool(self.input) and not self.free
        has_other_parts = bool(
            self.state_count or self.load or self.damping_part or self.controller
        )
        if not is_held_and_forced or has_other_parts:
            return False
        for section in self.input:
            if section.is_prescribed or section.through:
                return False
        for output in self.output:
            if output.reaction or output.constant:
                return False
        return not any(port.acts for port in self.port)

    def matrices_of(self, kind: str) -> dict[str, Rows]:
        """Return the base matrix of a kind, by the name of the kind, and its parts, by their names.

        Without a base matrix, or with damping that is not stated as a matrix, there are parts only.
        """
        base = getattr(self if kind in KINDS else self.coupling, kind)
        if isinstance(base, Damping):
            base = base.matrix
        parts: tuple[PartSection, ...] = getattr(self, f"{kind}_part", ())
        matrices = {kind: base} if base else {}
        return matrices | {part.name: part.matrix for part in parts}

    def scaled_matrices(self, factors: Mapping[str, float]) -> dict[str, FloatArray]:
        """Return the matrices of the equation of motion at given factors, padded to all unknowns.

        Damping that is given by modal ratios has no matrix and is left out.

        Parameters
        ----------
        factors : mapping of str to float
            The factor of each kind of matrix ("stiffness", "mass", ...) and of each named part; a
            name that is missing has the factor one.

        Returns
        -------
        dict of str to (N, N) array
            Under the name of a kind: the whole matrix, that is the factor of the kind times the sum
            of its base matrix and its parts. Under the name of a part: that part times its own
            factor alone.
        """
        matrices: dict[str, FloatArray] = {}
        displacement_count = self.displacement_count
        displacement_rows = slice(displacement_count)
        state_rows = slice(displacement_count, displacement_count + self.state_count)
        for kind, block in BLOCKS.items():
            rows = state_rows if block.rows_of_states else displacement_rows
            columns = state_rows if block.columns_of_states else displacement_rows
            sum_of_parts = np.zeros((self.unknown_count, self.unknown_count))
            for name, matrix in self.matrices_of(kind).items():
                padded_matrix = np.zeros_like(sum_of_parts)
                padded_matrix[rows, columns] = matrix
                padded_matrix *= 1.0 if name == kind else factors.get(name, 1.0)
                matrices[name] = padded_matrix
                sum_of_parts += padded_matrix
            # In the file, couplings stand on the right-hand side of the equation. All matrices are
            # returned for the left-hand side, so that couplings change their sign. This assignment
            # also replaces the base matrix, which was stored under the same name.
            sign = -1.0 if block.is_coupling else 1.0
            matrices[kind] = sign * factors.get(kind, 1.0) * sum_of_parts
        return matrices

    # ------------------------------------------------------------ checks of a file

    def checks(self) -> Iterator[Check]:
        """Yield the checks that concern several tables of the file.

        A check is a pair: whether the file fails it, and the message of the error.
        """
        yield from self._missing_matrix_checks()
        yield from self._name_checks()
        yield from self._vanishing_matrix_checks()
        for kind in BLOCKS:
            yield from self._matrix_checks(kind)
        for kind in SECTIONS_WITH_VECTORS:
            for section in getattr(self, kind):
                yield from self._vector_checks(kind, section)
        displacement_count = self.displacement_count
        if self.root is not None:
            is_wrong = len(self.root.lever) != displacement_count or not any(self.root.lever)
            needed_entries = counted(displacement_count, "entry", "entries")
            yield is_wrong, f"lever of root needs {needed_entries}, not all zero"
        if self.damping is not None and self.damping.ratios is not None:
            count = len(self.damping.ratios)
            yield (
                count != displacement_count,
                f"damping.ratios needs one value for each mode, {displacement_count} in all, but "
                f"has {counted(count, 'value')}",
            )

    def _missing_matrix_checks(self) -> Iterator[Check]:
        """Yield the checks on which matrices must be given."""
        displacement_count = self.displacement_count
        state_count = self.state_count
        yield (
            not displacement_count + state_count,
            "mass is missing (or capacity, of states of first order)",
        )
        lacks_stiffness = displacement_count and not self.free and not self.matrices_of("stiffness")
        yield (
            lacks_stiffness,
            "stiffness is missing: give it, or [[stiffness_part]], or set `free = true`",
        )
        lacks_conductance = state_count and not self.matrices_of("conductance")
        yield lacks_conductance, "conductance is missing: give it, or [[conductance_part]]"
        yield displacement_count and not (self.damping or self.free), "'damping' is missing"

    def _matrix_checks(self, kind: str) -> Iterator[Check]:
        """Yield the checks on the size, symmetry and definiteness of the matrices of a kind.

        Size and symmetry concern each matrix, definiteness the sum of a base matrix and its parts.
        The caller stops at the first check that fails, so that checks after that of the size may
        rely on it.
        """
        matrices = self.matrices_of(kind)
        for name, matrix in matrices.items():
            label = self._label_of_matrix(kind, name)
            yield self._size_check(kind, label, matrix)
            values = np.array(matrix)
            tolerance = 1e-9 * np.abs(values).max()
            if kind in SYMMETRIC:
                is_asymmetric = np.abs(values - values.T).max() > tolerance
                yield is_asymmetric, f"{label} must be symmetric"
            if kind == "damping":
                feeds_energy = np.linalg.eigvalsh(values)[0] < -tolerance
                yield feeds_energy, f"{label} must not feed energy: it has a negative eigenvalue"
        if matrices and kind in ("mass", "stiffness", "capacity"):
            yield self._definiteness_check(kind, np.sum([*matrices.values()], axis=0))

    def _size_check(self, kind: str, label: str, matrix: Sequence[Sequence[float]]) -> Check:
        """Return the check that a matrix has the rows and columns of its kind."""
        block = BLOCKS[kind]
        rows = self.state_count if block.rows_of_states else self.displacement_count
        columns = self.state_count if block.columns_of_states else self.displacement_count
        other_form = f" (or {counted(rows, 'diagonal value')})" if kind in KINDS else " by rows"
        has_wrong_size = [len(row) for row in matrix] != [columns] * rows
        return has_wrong_size, f"{label} must be a {rows} x {columns} matrix{other_form}"

    def _definiteness_check(self, kind: str, sum_of_parts: FloatArray) -> Check:
        """Return the check that a mass, stiffness or capacity is positive definite.

        A structure that is free may have a singular stiffness.
        """
        eigenvalues = np.linalg.eigvalsh(sum_of_parts)
        may_be_singular = kind == "stiffness" and self.free
        is_semidefinite = eigenvalues[0] >= -1e-9 * eigenvalues[-1]
        is_definite = eigenvalues[0] > 0.0 or (may_be_singular and is_semidefinite)
        advice = ADVICE_FOR_FREE_STRUCTURE if kind == "stiffness" else ""
        return not is_definite, f"{kind} (with its parts) must be positive definite{advice}"

    @staticmethod
    def _label_of_matrix(kind: str, name: str) -> str:
        """Return the key of a matrix in the file for a message, such as "mass_part 'rotor'"."""
        if name != kind:
            return f"{kind}_part {name!r}"
        if kind == "damping":
            return "damping.matrix"
        return kind if kind in KINDS else f"coupling.{kind}"

    def _vanishing_matrix_checks(self) -> Iterator[Check]:
        """Yield the parameters whose lower bound of zero would make a required matrix singular.

        The mass and the capacity must stay positive definite, and the stiffness too unless the file
        states a free structure. If a parameter that may be zero scales parts of such a matrix, the
        sum of the other parts must be positive definite alone.
        """
        needed_kinds = ["mass", "capacity"] if self.free else ["mass", "capacity", "stiffness"]
        for parameter in self.parameter:
            if parameter.low > 0.0:
                continue
            for kind in needed_kinds:
                matrices = self.matrices_of(kind)
                scales_all = kind in parameter.terms  # the whole matrix of this kind
                unscaled = [
                    matrix for name, matrix in matrices.items() if name not in parameter.terms
                ]
                scales_some = scales_all or len(unscaled) < len(matrices)
                remains_nonzero = (
                    bool(unscaled) and not scales_all and _is_definite(np.sum(unscaled, axis=0))
                )
                yield (
                    scales_some and not remains_nonzero,
                    f"the parameter {parameter.name!r} has low = 0, which would leave no {kind} at "
                    "some unknown: give a low above 0",
                )

    def _vector_checks(
        self, kind: str, section: NamedVector | OutputSection | ControllerSection
    ) -> Iterator[Check]:
        """Yield the checks on the vectors of a section.

        A vector must have an entry for each displacement and state, and must not be zero (but a
        `station_derivative` may be). That of a port or a controller must not read displacements and
        states at once. A controller must not need the derivative of a speed or of a state.
        """
        displacement_count = self.displacement_count
        unknown_count = displacement_count + self.state_count
        for key in ("vector", "acts", "station_derivative"):
            vector = getattr(section, key, None)
            if vector is None:
                continue
            place = f"{key} of {kind} {section.name!r}"
            yield (
                len(vector) != unknown_count,
                f"{place} has {counted(len(vector), 'entry', 'entries')}, but the model has "
                f"{counted(unknown_count, 'unknown')}",
            )
            yield key != "station_derivative" and not any(vector), f"{place} is zero"
        row = np.array(section.vector or ())
        sees_both = any(row[:displacement_count]) and any(row[displacement_count:])
        yield (
            kind in ("port", "controller") and sees_both,
            f"the {kind} {section.name!r} sees displacements or states, not both",
        )
        if isinstance(section, PortSection) and section.acts is not None:
            yield self._flow_check(section, row, np.array(section.acts))
        if isinstance(section, InputSection) and section.prescribes_state:
            yield self._prescribed_state_check(section, row)
        if isinstance(section, ControllerSection):
            order = section.quantity.order
            sees_speed = order > 0 or any(row[displacement_count:])
            yield (
                order > 1 or (sees_speed and section.derivative),
                f"the controller {section.name!r} cannot follow an acceleration, nor the "
                "derivative of a speed or of a state: leave `derivative` out",
            )

    def _prescribed_state_check(self, section: InputSection, row: FloatArray) -> Check:
        """Return the check that an input with `prescribes_state` prescribes states, and no load."""
        n = self.displacement_count
        is_of_states = not any(row[:n])
        is_load = section.through is not None or section.station_derivative is not None
        return (
            not is_of_states or is_load or bool(section.quantity.motion_chain),
            f"the input {section.name!r} prescribes a state: give it a vector of states alone, a "
            "quantity that is not a motion, and neither `through` nor `station_derivative`",
        )

    def _flow_check(self, port: PortSection, row: FloatArray, acts: FloatArray) -> Check:
        """Return the check that a flow at a port of states lowers the reading of the port.

        A unit flow out of the port changes the states at the rate -capacity^-1 acts, and hence the
        reading row . states of the port at the rate -row . capacity^-1 acts, which must be
        negative.
        """
        n = self.displacement_count
        is_of_states = not any(row[:n]) and not any(acts[:n])
        capacity = np.sum([*self.matrices_of("capacity").values()], axis=0)
        lowers_reading = is_of_states and row[n:] @ np.linalg.solve(capacity, acts[n:]) > 0.0
        return (
            not lowers_reading,
            f"`acts` of the port {port.name!r} is for states, and must take from what its vector "
            "sees",
        )

    def _name_checks(self) -> Iterator[Check]:
        """Yield the checks on names that occur twice, and on references to unknown names."""
        kinds = ("output", "port", "place", "load", "controller", "law", "parameter", "input")
        names = {kind: [section.name for section in getattr(self, kind)] for kind in kinds}
        part_names: list[str] = []
        for kind in KINDS:
            part_names += [part.name for part in getattr(self, f"{kind}_part")]
        references = [table.reference for table in self.controller if table.reference]
        unique_names = names | {
            "part": [*KINDS, *part_names],
            "input or reference": [*names["input"], *references],
            "place station": [f"{place.station:g}" for place in self.place],
        }
        for kind, kind_names in unique_names.items():
            yield from self.repeated_name_checks(kind, kind_names)
        # the matrices of the file, and all that its parameters can scale
        matrices = [*filter(self._has_unknowns_of, KINDS), *part_names]
        gains = [".".join(pair) for pair in product(names["controller"], GAINS)]
        scalable = {
            "a matrix": matrices,
            "an input": names["input"],
            "a load": names["load"],
            "a law": names["law"],
            "a controller": [*names["controller"], *gains],
        }
        yield from self._ambiguous_term_checks(scalable)
        prescribed = [section.name for section in self.input if section.quantity.motion_chain]
        for kind, key, verb, allowed_names in (
            ("input", "through", "acts through", matrices),
            ("load", "through", "acts through", matrices),
            ("law", "port", "acts on the port", names["port"]),
            ("output", "reaction", "is the reaction of the prescribed motion", prescribed),
            ("output", "controller", "is what a controller gives,", names["controller"]),
            ("parameter", "terms", "scales", [*chain.from_iterable(scalable.values())]),
        ):
            yield from self._reference_checks(kind, key, verb, allowed_names)

    def _ambiguous_term_checks(self, scalable: Mapping[str, Sequence[str]]) -> Iterator[Check]:
        """Yield the terms of parameters that name two things, both of which would be scaled.

        `scalable` holds the names of what a parameter can scale, by what it is ("an input").
        """
        for parameter in self.parameter:
            for term in parameter.terms:
                meanings = [kind for kind, names in scalable.items() if term in names]
                yield (
                    len(meanings) > 1,
                    f"the parameter {parameter.name!r} scales {term!r}, which is the name of "
                    f"{listing(meanings)}: give all but one of them another name (that of an "
                    "input stands in campaigns, too: as load_place or under [[input]])",
                )

    def _reference_checks(
        self, kind: str, key: str, verb: str, known_names: Sequence[str]
    ) -> Iterator[Check]:
        """Yield the names that sections of a kind state under a key and that do not exist.

        `verb` says in the message what the section does with the name, such as "scales".
        """
        listed = ", ".join(known_names) or "none"
        for section in getattr(self, kind):
            for name in as_list(getattr(section, key)):
                yield (
                    name is not None and name not in known_names,
                    f"{kind} {section.name!r} {verb} {name!r}, but there are {listed}",
                )

    def _has_unknowns_of(self, kind: str) -> bool:
        """Return whether the file has the unknowns (displacements or states) of a kind's rows."""
        count = self.state_count if BLOCKS[kind].rows_of_states else self.displacement_count
        return count > 0
