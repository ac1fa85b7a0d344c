"""The part of an affine model that follows from the design and from matrices on all unknowns."""

from collections.abc import Iterable
from typing import NamedTuple, TypedDict

from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidDesignError

from .affine import LoadTerm, SupportMotion
from .tables import StructureDesign


class OutputRows(NamedTuple):
    """Outputs as rows on all unknowns.

    Attributes
    ----------
    gauge : csr (gauges, full)
        Strains [1/m].
    displacement, acceleration : csr (m, full)
        Displacements, or with second derivatives accelerations [1].
    port : csr (ports, full)
        Displacements of the ports [1]; transposed, a force of 1 N at each.
    """

    gauge: sparse.csr_array
    displacement: sparse.csr_array
    acceleration: sparse.csr_array
    port: sparse.csr_array


class AffineFields(TypedDict):
    """All fields of `AffineStructure` but the design, its hash and the stiffness terms."""

    parameters: dict[str, float]
    masses: dict[str, float]
    controls: dict[str, float]
    control_units: dict[str, str]
    ranges: dict[str, tuple[float, float]]
    regions: tuple[str, ...]
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


def affine_fields(
    design: StructureDesign,
    expansion: sparse.csr_array,
    mass: sparse.csr_array,
    point_masses: Iterable[sparse.csr_array],
    loads: Iterable[FloatArray],
    outputs: OutputRows,
    support_motions: tuple[SupportMotion, ...] = (),
) -> AffineFields:
    """Return the fields of `AffineStructure` but the design, its hash and the stiffness terms.

    Mass, loads and outputs are projected on the free unknowns.

    Parameters
    ----------
    expansion : csr (full, n)
        Free unknowns to all unknowns.
    mass : csr (full, full)
        Mass without point masses [kg].
    point_masses : iterable of csr (full, full)
        Mass of 1 kg at each of the point masses of the design [1].
    loads : iterable of (full,) array
        For each load of the design the forces [N], or the field [m/s^2] of an acceleration, which
        acts on the free masses, too.

    Raises
    ------
    InvalidDesignError
        If a port lies where nothing can move.
    """
    # an acceleration loads each mass by itself, so that its load has one term for each of them
    restriction = expansion.T.tocsr()
    masses = _masses_by_name(design, mass, point_masses)
    load_terms = []
    for load, vector in zip(design.load, loads, strict=True):
        if load.acceleration is None:
            load_terms.append(LoadTerm(load.name, restriction @ vector))
            continue
        for mass_name, matrix in masses.items():
            load_terms.append(LoadTerm(load.name, restriction @ (matrix @ vector), mass_name))
    # the unknowns of released support motions come last; they do not count for the ports' motion
    port_output = (outputs.port @ expansion).tocsr()
    released = [motion for motion in support_motions if motion.spring == 0.0]
    held_count = port_output.shape[1] - len(released)
    _check_ports_can_move(design, port_output[:, :held_count])
    return {
        "parameters": {parameter.name: parameter.nominal for parameter in design.parameter},
        "masses": {part.name: part.mass for part in design.mass if part.free},
        "controls": {control.name: control.nominal for control in design.control},
        "control_units": {control.name: control.unit for control in design.control},
        "ranges": design.ranges,
        "regions": tuple(region.name for region in design.damage),
        "mass_terms": tuple(
            (restriction @ (matrix @ expansion)).tocsr() for matrix in masses.values()
        ),
        "loads": {load.name: load.control for load in design.load},
        "load_terms": tuple(load_terms),
        "gauges": tuple(gauge.name for gauge in design.gauge),
        "displacements": tuple(output.name for output in design.displacement),
        "accelerations": tuple(output.name for output in design.acceleration),
        "ports": tuple(port.name for port in design.port),
        "gauge_output": (outputs.gauge @ expansion).tocsr(),
        "displacement_output": (outputs.displacement @ expansion).tocsr(),
        "acceleration_output": (outputs.acceleration @ expansion).tocsr(),
        "port_output": port_output,
        "expansion": expansion,
        "support_motions": support_motions,
    }


def _check_ports_can_move(design: StructureDesign, port_output: sparse.csr_array) -> None:
    """Raise `InvalidDesignError` if the supports hold a port: its row (n,) is zero."""
    for (label, port), row in zip(design.numbered("port"), port_output.toarray(), strict=True):
        if not row.any():
            raise InvalidDesignError(
                f"{label} ({port.name}): the supports hold all that a force there would move; put "
                "the port where the structure can move."
            )


def _masses_by_name(
    design: StructureDesign, mass: sparse.csr_array, point_masses: Iterable[sparse.csr_array]
) -> dict[str | None, sparse.csr_array]:
    """Return 1 kg of each free mass by name, and all other mass under the name None."""
    fixed_mass = mass
    free_masses: dict[str | None, sparse.csr_array] = {}
    for part, matrix in zip(design.mass, point_masses, strict=True):
        if part.free:
            free_masses[part.name] = matrix
        else:
            fixed_mass = fixed_mass + part.mass * matrix
    return {None: fixed_mass} | free_masses
