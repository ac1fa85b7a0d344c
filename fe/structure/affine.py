"""A structure as affine operators with names: sums of a few matrices and vectors.

K = sum of p (1 - z) K_pz over the pairs of a parameter p (or none) and a damage region z (or none),
M = M_0 + sum of m M_m over the free point masses, and loads f = sum of u (f_l0 + sum of m f_lm)
with the controls u, where acceleration fields act on the free masses, too.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidStateError, SolutionError
from fe.runtime.state import losses_of
from reporting.words import comma_list

from .tables import StructureDesign

Values = Mapping[str, float]
PORT_PREFIX = "port."
"""Begin of the names of force and displacement at a port; see `AffineStructure.with_port_forces`.

No name in a structure file has a dot.
"""


def affine_sum(coefficients: ArrayLike, terms: Sequence[sparse.csr_array]) -> sparse.csr_array:
    """Return the sum of sparse matrices times coefficients (T,)."""
    first_product, *products = [
        coefficient * term
        for coefficient, term in zip(np.asarray(coefficients), terms, strict=True)
    ]
    return sum(products, first_product).tocsr()


class StiffnessTerm(NamedTuple):
    """Stiffness (n, n) [N/m], proportional to a parameter and to one minus a region's loss."""

    matrix: sparse.csr_array
    parameter: str | None = None
    region: str | None = None


class LoadTerm(NamedTuple):
    """A component (n,) of a load [N], or of a load per kilogram of a free mass [N/kg]."""

    load: str
    vector: FloatArray
    mass: str | None = None


class SupportMotion(NamedTuple):
    """A motion of a support or an interface that is an unknown of the structure.

    Attributes
    ----------
    support : str
        The support's set of nodes, its nodes, or the name of the interface.
    motion : str
        One of `tables.MOTIONS`, or of `tables.INTERFACE_MOTIONS`.
    unknown : int
        Index of the unknown [m or rad].
    spring : float
        Stiffness of its spring [N/m or N m/rad]; zero for a motion that is held unless the support
        yields.
    scaled_by : str or None
        Parameter that scales the spring.
    """

    support: str
    motion: str
    unknown: int
    spring: float
    scaled_by: str | None = None


class SystemMatrices(NamedTuple):
    """The matrices of a structure for one set of parameter values.

    Attributes
    ----------
    stiffness : csr (n, n)
        Stiffness [N/m].
    mass : csr (n, n)
        Mass [kg].
    load : (n,) array
        The sum of all loads [N].
    """

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    load: FloatArray


class SplitValues(NamedTuple):
    """Values by name, sorted into parameters, stiffness losses and masses."""

    parameters: dict[str, float]
    losses: dict[str, float]
    masses: dict[str, float]


@dataclass(frozen=True)
class AffineStructure:
    """Affine model of a structure on its n free unknowns.

    Attributes
    ----------
    parameters, masses, controls : dict of str to float
        Nominal values of the parameters [1], free masses [kg] and controls [each in its unit].
    control_units : dict of str to str
        Unit of each control.
    ranges : dict of str to (float, float)
        Least and largest value for which a reduced model is valid, of parameters, losses, free
        masses and controls, by name.
    regions : tuple of str
        Names of the damage regions.
    stiffness_terms : tuple of StiffnessTerm
        One for each pair of parameter and region that occurs; springs are with the pair of none.
    mass_terms : tuple of csr (n, n)
        The structure with its fixed point masses [kg]; then 1 kg at each free point mass [1].
    loads : dict of str to str or None
        The control that each load is proportional to, None for a constant load.
    load_terms : tuple of LoadTerm
        The parts of the loads.
    gauges, displacements, accelerations : tuple of str
        Names of the outputs.
    ports : tuple of str
        Names of the ports where a force that the model lacks may act.
    gauge_output : csr (gauges, n)
        Strain of each gauge, positive in tension [1/m].
    displacement_output, acceleration_output : csr (m, n)
        Rows that give a displacement, or with second derivatives an acceleration [1].
    port_output : csr (ports, n)
        Rows that give the displacement of a port [1]; transposed, a force of 1 N there.
    expansion : csr (full, n)
        Free unknowns to the displacements of all nodes (3 node + component).
    support_motions : tuple of SupportMotion
        Unknowns that are motions of supports: those against springs and, of a structure whose
        supports yield, those that are held otherwise. The latter come last.
    design_hash : str
        Hash of the design with its mesh.
    """

    design: StructureDesign
    parameters: dict[str, float]
    masses: dict[str, float]
    controls: dict[str, float]
    control_units: dict[str, str]
    ranges: dict[str, tuple[float, float]]
    regions: tuple[str, ...]
    stiffness_terms: tuple[StiffnessTerm, ...]
    mass_terms: tuple[sparse.csr_array, ...]
    loads: dict[str, str | None]
    load_terms: tuple[LoadTerm, ...]
    gauges: tuple[str, ...]
    displacements: tuple[str, ...]
    accelerations: tuple[str, ...]
    ports: tuple[str, ...]
    gauge_output: sparse.csr_array
    displacement_output: sparse.csr_array
    acceleration_output: sparse.csr_array
    port_output: sparse.csr_array
    expansion: sparse.csr_array
    support_motions: tuple[SupportMotion, ...]
    design_hash: str

    followed_load: ClassVar[int | None] = None
    """Number of the load whose compliance chooses the two tracked modes, which add most to it."""

    @property
    def unknowns(self) -> int:
        """Number n of free unknowns."""
        return int(self.expansion.shape[1])

    def theta(
        self, parameters: Values | None = None, stiffness_loss: Values | Iterable[float] = ()
    ) -> FloatArray:
        """Return the coefficients (T,) of the T stiffness terms, theta = p (1 - z).

        The stiffness is the sum of the terms' matrices, each times its theta.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters p that differ from their nominal values.
        stiffness_loss : mapping of str to float, or iterable of float
            Stiffness losses z of the regions [1], by name or in the order of `regions`; see
            `fe.runtime.state.losses_of`.
        """
        parameter_values = _values_with_changes(self.parameters, parameters, "parameter")
        losses = losses_of(stiffness_loss, self.regions)
        loss_of_region: dict[str | None, float] = dict(zip(self.regions, losses, strict=True))
        loss_of_region[None] = 0.0  # terms outside the damage regions lose no stiffness
        return np.array(
            [
                parameter_values[term.parameter] * (1.0 - loss_of_region[term.region])
                for term in self.stiffness_terms
            ]
        )

    def stiffness(
        self, parameters: Values | None = None, stiffness_loss: Values | Iterable[float] = ()
    ) -> sparse.csr_array:
        """Return the stiffness (n, n) [N/m]; the parameters are as in `theta`."""
        terms = tuple(term.matrix for term in self.stiffness_terms)
        return affine_sum(self.theta(parameters, stiffness_loss), terms)

    def mass(self, masses: Values | None = None) -> sparse.csr_array:
        """Return the mass (n, n) [kg].

        Parameters
        ----------
        masses : mapping of str to float, optional
            Free masses that differ from their nominal values [kg].
        """
        mass_values = _values_with_changes(self.masses, masses, "free mass")
        return affine_sum([*mass_values.values()], self.mass_terms)

    def control_value_alone(self, load: str) -> float:
        """Return the value of a load's control with which the load is examined alone.

        This is the nominal value. It is one where the nominal value is zero, since there would be
        no load, and for a constant load.
        """
        nominal_value = self._nominal_control(load)
        return 1.0 if nominal_value == 0.0 else nominal_value

    def _nominal_control(self, load: str) -> float:
        """Return the nominal value of a load's control, or one for a constant load."""
        control = self.loads[load]
        return 1.0 if control is None else self.controls[control]

    def load(
        self, name: str, value: float | None = None, masses: Values | None = None
    ) -> FloatArray:
        """Return the load vector (n,) [N] of a load, at a value of its control.

        Parameters
        ----------
        value : float, optional
            Value of its control; nominal by default, and one for a constant load.
        masses : mapping of str to float, optional
            Free masses that differ from their nominal values [kg].
        """
        control_value = self._nominal_control(name) if value is None else value
        kilograms = _values_with_changes(self.masses, masses, "free mass")
        total_load: FloatArray = np.zeros(self.unknowns)
        for term in self.load_terms:
            if term.load == name:
                total_load = total_load + control_value * kilograms[term.mass] * term.vector
        return total_load

    def system_at(self, values: Values) -> SystemMatrices:
        """Return the stiffness, the mass and the sum of all loads for given values.

        Parameters
        ----------
        values : mapping of str to float
            Parameters, losses, free masses and controls by name. All others have their nominal
            values, and the losses are zero.
        """
        values_by_kind = self.split_values(values)
        total_load: FloatArray = np.zeros(self.unknowns)
        for name, control in self.loads.items():
            control_value = None if control is None else values.get(control)
            total_load = total_load + self.load(name, control_value, values_by_kind.masses)
        return SystemMatrices(
            stiffness=self.stiffness(values_by_kind.parameters, values_by_kind.losses),
            mass=self.mass(values_by_kind.masses),
            load=total_load,
        )

    def split_values(self, values: Values) -> SplitValues:
        """Sort values by name into parameters, stiffness losses and free masses.

        Controls are left out.
        """

        def among(names: Iterable[str]) -> dict[str, float]:
            return {name: values[name] for name in names if name in values}

        return SplitValues(among(self.parameters), among(self.regions), among(self.masses))

    def with_port_forces(self) -> "AffineStructure":
        """Return the structure with a load and an output `port.NAME` at each port.

        The load is a force [N] whose control is zero by default, the output is the displacement
        [m].
        """
        names = tuple(f"{PORT_PREFIX}{port}" for port in self.ports)
        unit_forces = self.port_output.toarray()
        port_loads = [LoadTerm(name, force) for name, force in zip(names, unit_forces, strict=True)]
        return replace(
            self,
            controls=self.controls | dict.fromkeys(names, 0.0),
            control_units=self.control_units | dict.fromkeys(names, "N"),
            ranges=self.ranges | dict.fromkeys(names, (-1.0, 1.0)),
            loads=self.loads | dict(zip(names, names, strict=True)),
            load_terms=(*self.load_terms, *port_loads),
            displacements=(*self.displacements, *names),
            displacement_output=sparse.vstack(
                (self.displacement_output, self.port_output), format="csr"
            ),
        )

    def with_held_supports(self) -> "AffineStructure":
        """Return the structure with all supports held rigidly; itself if none is released.

        The motions of released supports are the last unknowns, which are left out.
        """
        released = [motion for motion in self.support_motions if motion.spring == 0.0]
        if not released:
            return self
        free = slice(0, self.unknowns - len(released))
        return replace(
            self,
            stiffness_terms=tuple(
                term._replace(matrix=term.matrix[free, free]) for term in self.stiffness_terms
            ),
            mass_terms=tuple(term[free, free] for term in self.mass_terms),
            load_terms=tuple(term._replace(vector=term.vector[free]) for term in self.load_terms),
            gauge_output=self.gauge_output[:, free],
            displacement_output=self.displacement_output[:, free],
            acceleration_output=self.acceleration_output[:, free],
            port_output=self.port_output[:, free],
            expansion=self.expansion[:, free],
            support_motions=tuple(
                motion for motion in self.support_motions if motion.spring != 0.0
            ),
        )

    def full_displacement(self, free_unknowns: FloatArray) -> FloatArray:
        """Return the displacements (nodes, 3) [m] of all nodes from free unknowns (n,)."""
        return np.asarray(self.expansion @ free_unknowns).reshape(-1, 3)


def _values_with_changes(
    nominal_values: dict[str, float], changed_values: Values | None, kind: str
) -> dict[str | None, float]:
    """Return the value of each parameter or free mass: the changed value, or else the nominal one.

    Each term of the stiffness or mass matrix is multiplied by one of these values. The value under
    the name None is 1, for terms that no parameter multiplies. Raises `InvalidStateError` for a
    changed value that has no nominal one; the message calls it by `kind`, "parameter" or "free
    mass".
    """
    changes = dict(changed_values or {})
    unknown_names = set(changes) - set(nominal_values)
    if unknown_names:
        raise InvalidStateError(
            f"The structure has no {kind} named {min(unknown_names)!r}; there are "
            f"{comma_list(nominal_values)}."
        )
    values: dict[str | None, float] = {None: 1.0}
    values.update(nominal_values | changes)
    return values


@dataclass(frozen=True)
class AffineResponse:
    """The static response of a structure.

    Attributes
    ----------
    displacement : (n,) array
        Free unknowns [m].
    largest : float
        Largest displacement of a node [m].
    strain : (gauges,) array
        Strain at the gauges, positive in tension.
    output : (displacements,) array
        Displacement outputs [m].
    """

    displacement: FloatArray
    largest: float
    strain: FloatArray
    output: FloatArray


def static_responses(structure: AffineStructure) -> dict[str, AffineResponse]:
    """Solve the undamaged structure for each load alone.

    A load is proportional to its control. The control has its nominal value, or one if the load is
    constant or would vanish at the nominal value (`control_value_alone`).

    Returns
    -------
    dict of str to AffineResponse
        The response to each load, by the load's name.

    Raises
    ------
    SolutionError
        If the stiffness cannot be factorised, or a solution is not accurate.
    """
    if not structure.loads:
        return {}
    factors = Factorisation(structure.stiffness())
    loads = np.column_stack(
        [structure.load(name, structure.control_value_alone(name)) for name in structure.loads]
    )
    solutions = factors.solve(loads)
    return {
        name: _static_response(structure, solution)
        for name, solution in zip(structure.loads, solutions.T, strict=True)
    }


def static_response(structure: AffineStructure, values: Mapping[str, float]) -> AffineResponse:
    """Solve the structure for all loads together.

    Parameters
    ----------
    values : mapping of str to float
        Parameters, losses, free masses and controls by name. All others have their nominal values,
        and the losses are zero.

    Raises
    ------
    SolutionError
        If the stiffness cannot be factorised, or the solution is not accurate.
    """
    system = structure.system_at(values)
    return _static_response(structure, Factorisation(system.stiffness).solve(system.load))


def _static_response(structure: AffineStructure, displacement: FloatArray) -> AffineResponse:
    """Return the outputs of a structure whose free unknowns (n,) are known."""
    nodal_displacement = structure.full_displacement(displacement)
    return AffineResponse(
        displacement=displacement,
        largest=float(np.linalg.norm(nodal_displacement, axis=1).max()),
        strain=np.asarray(structure.gauge_output @ displacement),
        output=np.asarray(structure.displacement_output @ displacement),
    )


class NaturalModes(NamedTuple):
    """The lowest undamped modes of a structure.

    Attributes
    ----------
    frequency : (count,) array
        Natural frequencies [Hz], ascending.
    shape : (n, count) array
        Mass-normalised shapes of the free unknowns.
    """

    frequency: FloatArray
    shape: FloatArray


def natural_frequencies(
    structure: AffineStructure,
    count: int,
    values: Mapping[str, float] | None = None,
    factors: Factorisation | None = None,
) -> NaturalModes:
    """Compute the lowest undamped natural frequencies and mode shapes.

    Parameters
    ----------
    count : int
        From 1 to the number of free unknowns minus one.
    values : mapping of str to float, optional
        Parameters, losses and free masses by name. All others have their nominal values, and the
        losses are zero.
    factors : Factorisation, optional
        The factorised stiffness at these values, if it is at hand.

    Raises
    ------
    SolutionError
        If the structure has no mass, has fewer modes, or the iteration did not converge.
    """
    most_modes = structure.unknowns - 1
    if not 1 <= count <= most_modes:
        raise SolutionError(
            f"{count} modes were asked for, but a structure of {structure.unknowns} free unknowns "
            f"gives 1 to {most_modes}."
        )
    system = structure.system_at(values or {})
    if not system.mass.diagonal().any():
        raise SolutionError(
            "The structure has no mass, hence no modes; give its materials a density."
        )
    eigenvalues, shapes = lowest_eigenpairs(factors or system.stiffness, system.mass, count)
    modal_masses = np.einsum("im,im->m", shapes, system.mass @ shapes)
    return NaturalModes(
        frequency=np.sqrt(eigenvalues) / (2.0 * np.pi), shape=shapes / np.sqrt(modal_masses)
    )
