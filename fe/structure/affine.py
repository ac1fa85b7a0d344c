"""A structure as affine operators with names: sums of a few matrices and vectors.

K = sum of p (1 - z) K_pz over the pairs of a parameter p (or none) and a damage region z (or none), M = M_0 +
sum of m M_m over the free point masses, and loads f = sum of u (f_l0 + sum of m f_lm) with the controls u,
where acceleration fields act on the free masses too.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidDesignError, InvalidStateError, SolutionError
from fe.runtime.state import losses_of
from fe.sentences import said

from .tables import StructureDesign

Values = Mapping[str, float]
PORT_PREFIX = "port."
"""Begins the names of the force and the displacement at a port, see `AffineStructure.pushed_at_ports`.

No name in a structure file has a dot.
"""


def affine_sum(coefficients: ArrayLike, terms: tuple[Any, ...]) -> Any:
    """Return the sparse matrix sum of `coefficients` times `terms`."""
    first, *others = (factor * term for factor, term in zip(np.asarray(coefficients), terms, strict=True))
    return sum(others, first).tocsr()


class StiffnessTerm(NamedTuple):
    """Stiffness (n, n) [N/m] that is proportional to a parameter and to what a region has kept."""

    matrix: sparse.csr_array
    parameter: str | None = None
    region: str | None = None


class LoadTerm(NamedTuple):
    """Part (n,) of a load [N], or of a load on 1 kg of a free mass [N/kg]."""

    load: str
    vector: FloatArray
    mass: str | None = None


@dataclass(frozen=True)
class AffineStructure:
    """Affine model of a structure on its n free unknowns.

    Attributes
    ----------
    design : StructureDesign
        What was asked for.
    parameters, masses, controls : dict of str to float
        Nominal values of the parameters [1], free masses [kg] and controls [each in its unit].
    control_units : dict of str to str
        Unit of each control.
    ranges : dict of str to (float, float)
        Least and largest value for which a reduced model is to hold, of these and of the losses, by name.
    regions : tuple of str
        Names of the damage regions.
    stiffness_terms : tuple of StiffnessTerm
        One for each pair of parameter and region that occurs; springs are with the pair of none.
    mass_terms : tuple of csr (n, n)
        Structure with its fixed point masses [kg]; then 1 kg at each free point mass [1].
    loads : dict of str to str or None
        The control that each load is times, None for a constant one.
    load_terms : tuple of LoadTerm
        What they are made of.
    gauges, displacements, accelerations : tuple of str
        Names of the outputs.
    ports : tuple of str
        Names of the ports where a force that the model lacks may act.
    gauge_output : csr (gauges, n) 1/m
        Strain of each gauge, positive in tension.
    displacement_output, acceleration_output : csr (m, n) 1
        Rows that give a displacement, or with second derivatives an acceleration.
    port_output : csr (ports, n) 1
        Rows that give the displacement of a port; transposed, a force of 1 N there.
    expansion : csr (full, n)
        Free unknowns to the displacements of all nodes (3 node + component).
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
    design_hash: str

    followed_load: ClassVar[int | None] = None
    """Number of the load by which two modes are followed: those that contribute most to its compliance."""

    @property
    def unknowns(self) -> int:
        """Number n of free unknowns."""
        return int(self.expansion.shape[1])

    def theta(
        self, parameters: Values | None = None, stiffness_loss: Values | Iterable[float] = ()
    ) -> FloatArray:
        """Coefficients of the stiffness terms.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters that differ from their nominal values.
        stiffness_loss : mapping of str to float, or iterable of float
            Stiffness losses of the regions, see `fe.runtime.state.losses_of`.
        """
        factor = _updated(self.parameters, parameters, "parameter")
        lost = {None: 0.0} | dict(zip(self.regions, losses_of(stiffness_loss, self.regions), strict=True))
        return np.array([factor[term.parameter] * (1.0 - lost[term.region]) for term in self.stiffness_terms])

    def stiffness(
        self, parameters: Values | None = None, stiffness_loss: Values | Iterable[float] = ()
    ) -> sparse.csr_array:
        """Stiffness (n, n) [N/m], see `theta`."""
        terms = tuple(term.matrix for term in self.stiffness_terms)
        return affine_sum(self.theta(parameters, stiffness_loss), terms)

    def mass(self, masses: Values | None = None) -> sparse.csr_array:
        """Mass (n, n) [kg]; `masses` [kg] are those free ones that differ from their nominal values."""
        return affine_sum([*_updated(self.masses, masses, "free mass").values()], self.mass_terms)

    def control_value_alone(self, load: str) -> float:
        """Return the value of its control at which a load is looked at alone.

        That is the nominal value, or one unit where the nominal value is zero, at which there is no load; one
        for a constant load.
        """
        control = self.loads[load]
        nominal = 1.0 if control is None else self.controls[control]
        return 1.0 if nominal == 0.0 else nominal

    def load(self, name: str, value: float | None = None, masses: Values | None = None) -> FloatArray:
        """Load (n,) [N].

        Parameters
        ----------
        name : str
            Name of the load.
        value : float, optional
            Value of its control; nominal by default, and one for a constant load.
        masses : mapping of str to float, optional
            As of `mass`.
        """
        control = self.loads[name]
        factor = (1.0 if control is None else self.controls[control]) if value is None else value
        kilograms = _updated(self.masses, masses, "free mass")
        parts = (factor * kilograms[term.mass] * term.vector for term in self.load_terms if term.load == name)
        return sum(parts, np.zeros(self.unknowns))

    def at(self, values: Values) -> tuple[sparse.csr_array, sparse.csr_array, FloatArray]:
        """Stiffness [N/m], mass [kg] and the sum of all loads [N] at values by name.

        Parameters
        ----------
        values : mapping of str to float
            Parameters, losses, free masses and controls; what is left out is nominal, and healthy.
        """
        parameters, losses, masses = self.parted(values)
        loads = (self.load(name, values.get(control or ""), masses) for name, control in self.loads.items())
        return self.stiffness(parameters, losses), self.mass(masses), sum(loads, np.zeros(self.unknowns))

    def parted(self, values: Values) -> tuple[dict[str, float], ...]:
        """Return the parameters, the losses and the free masses among values by name."""
        kinds = (self.parameters, self.regions, self.masses)
        return tuple({name: values[name] for name in names if name in values} for names in kinds)

    def pushed_at_ports(self) -> "AffineStructure":
        """Return the structure with a force [N] and a displacement [m] at each port, named `port.NAME`.

        The force is a control whose nominal value is zero, so that it acts only where something asks for it.
        """
        names = tuple(f"{PORT_PREFIX}{port}" for port in self.ports)
        forces = zip(names, self.port_output.toarray(), strict=True)
        return replace(
            self,
            controls=self.controls | dict.fromkeys(names, 0.0),
            control_units=self.control_units | dict.fromkeys(names, "N"),
            ranges=self.ranges | dict.fromkeys(names, (-1.0, 1.0)),
            loads=self.loads | dict(zip(names, names, strict=True)),
            load_terms=(*self.load_terms, *(LoadTerm(name, vector) for name, vector in forces)),
            displacements=(*self.displacements, *names),
            displacement_output=sparse.vstack((self.displacement_output, self.port_output), format="csr"),
        )

    def full_displacement(self, free: FloatArray) -> FloatArray:
        """Displacements (nodes, 3) [m] of all nodes from free unknowns (n,)."""
        return np.asarray(self.expansion @ free).reshape(-1, 3)


def designed(
    design: StructureDesign,
    expansion: sparse.csr_array,
    mass: sparse.csr_array,
    point_masses: Iterable[sparse.csr_array],
    loads: Iterable[FloatArray],
    outputs: Mapping[str, sparse.csr_array],
) -> dict[str, Any]:
    """Return fields of the affine model of a structure file, all but the stiffness terms and the hash.

    Parameters
    ----------
    design : StructureDesign
        What was asked for.
    expansion : csr (full, n)
        Free unknowns to all unknowns.
    mass : csr (full, full) kg
        Mass without point masses.
    point_masses : iterable of csr (full, full) 1
        Mass of 1 kg at each of the point masses of the design.
    loads : iterable of (full,)
        Of each of its loads the forces [N], or the field [m/s^2] of an acceleration, which acts on the free
        masses, too.
    outputs : mapping of str to csr (m, full)
        Rows of the tables `gauge`, `displacement`, `acceleration` and `port`.

    Raises
    ------
    InvalidDesignError
        If a port lies where nothing can move.
    """
    restriction = expansion.T.tocsr()
    masses: dict[str | None, sparse.csr_array] = {None: mass}
    for part, matrix in zip(design.mass, point_masses, strict=True):
        if part.free:
            masses[part.name] = matrix
        else:
            masses[None] = masses[None] + part.mass * matrix
    terms = []
    for load, vector in zip(design.load, loads, strict=True):
        if load.acceleration is None:
            terms.append(LoadTerm(load.name, restriction @ vector))
        else:
            terms += [LoadTerm(load.name, restriction @ (own @ vector), name) for name, own in masses.items()]
    rows_on_free = {key: (rows @ expansion).tocsr() for key, rows in outputs.items()}
    for (where, port), row in zip(design.numbered("port"), rows_on_free["port"].toarray(), strict=True):
        if not row.any():
            raise InvalidDesignError(said("structure.held_port", where=where, port=port))
    return {
        "design": design,
        "parameters": {part.name: part.nominal for part in design.parameter},
        "masses": {part.name: part.mass for part in design.mass if part.free},
        "controls": {part.name: part.nominal for part in design.control},
        "control_units": {part.name: part.unit for part in design.control},
        "ranges": design.ranges,
        "regions": tuple(part.name for part in design.damage),
        "mass_terms": tuple((restriction @ (own @ expansion)).tocsr() for own in masses.values()),
        "loads": {part.name: part.control for part in design.load},
        "load_terms": tuple(terms),
        "gauges": tuple(part.name for part in design.gauge),
        "displacements": tuple(part.name for part in design.displacement),
        "accelerations": tuple(part.name for part in design.acceleration),
        "ports": tuple(part.name for part in design.port),
        **{f"{key}_output": rows for key, rows in rows_on_free.items()},
        "expansion": expansion,
    }


def _updated(nominal: dict[str, float], changed: Values | None, what: str) -> dict[str | None, float]:
    """Return the factors of terms by what they are times: of nothing one, then values by name."""
    unknown = set(changed or {}) - set(nominal)
    if unknown:
        known = ", ".join(nominal) or "none"
        raise InvalidStateError(said("structure.unknown", what=what, name=min(unknown), known=known))
    factors: dict[str | None, float] = {None: 1.0}
    factors.update(nominal | dict(changed or {}))
    return factors


@dataclass(frozen=True)
class StaticResponse:
    """Static response of a structure.

    Attributes
    ----------
    displacement : (n,) m
        Free unknowns.
    largest : float
        Largest displacement of a node [m].
    strain : (gauges,)
        Strain at the gauges, positive in tension.
    output : (displacements,) m
        Displacement outputs.
    """

    displacement: FloatArray
    largest: float
    strain: FloatArray
    output: FloatArray


def static_responses(structure: AffineStructure) -> dict[str, StaticResponse]:
    """Solve for each load alone, the structure undamaged, its control as of `control_value_alone`.

    Raises
    ------
    SolutionError
        If the stiffness cannot be factorised, or a solution is not accurate.
    """
    if not structure.loads:
        return {}
    factors = Factorisation(structure.stiffness())
    values = {name: structure.control_value_alone(name) for name in structure.loads}
    loads = np.column_stack([structure.load(name, value) for name, value in values.items()])
    fields = factors.solve(loads)
    return {name: _response(structure, field) for name, field in zip(structure.loads, fields.T, strict=True)}


def static_response(structure: AffineStructure, values: Mapping[str, float]) -> StaticResponse:
    """Solve for all loads together at values by name; what is left out is nominal, and healthy.

    Raises
    ------
    SolutionError
        As of `static_responses`.
    """
    stiffness, _, load = structure.at(values)
    return _response(structure, Factorisation(stiffness).solve(load))


def _response(structure: AffineStructure, displacement: FloatArray) -> StaticResponse:
    return StaticResponse(
        displacement=displacement,
        largest=float(np.linalg.norm(structure.full_displacement(displacement), axis=1).max()),
        strain=np.asarray(structure.gauge_output @ displacement),
        output=np.asarray(structure.displacement_output @ displacement),
    )


def natural_frequencies(
    structure: AffineStructure,
    count: int,
    values: Mapping[str, float] | None = None,
    factors: Factorisation | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Lowest frequencies (m,) [Hz], rising, and mass-normalised shapes (n, m), undamped; see `at` for values.

    Who has the factorised stiffness at these values may give it.

    Raises
    ------
    SolutionError
        If there is no mass, there are not so many modes, or the iteration did not converge.
    """
    if count not in range(1, structure.unknowns):
        most = structure.unknowns - 1
        raise SolutionError(said("structure.modes", count=count, unknowns=structure.unknowns, most=most))
    stiffness, mass, _ = structure.at(values or {})
    if not mass.diagonal().any():
        raise SolutionError("The structure has no mass, hence no modes; give its materials a density.")
    squares, shapes = lowest_eigenpairs(factors or stiffness, mass, count)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, mass @ shapes))
    return np.sqrt(squares) / (2.0 * np.pi), shapes
