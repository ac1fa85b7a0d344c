"""Motion of a structure in few modes with internal forces: laws from a patch, steps, static solution.

`fe.motion_kernel` has the equation and the method. NumPy and relative imports only: this file is copied into
the FMU. The loops run as plain Python here; `discrepancy.compiled_motion` has the same functions compiled,
to be given as `kernel`.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import motion_kernel
from .errors import InvalidPatchError, SolutionError
from .motion_kernel import BOUC_WEN, FREE_PLAY, HEAD, MICRO_SLIP, POWER_DAMPING, POWER_STIFFNESS
from .patch import BoucWen, FreePlay, MicroSlip, ModelPatch, PowerDamping, PowerStiffness, StiffnessDrift
from .planform_forces import place_of

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Kernel = Mapping[str, Callable[..., Any]]

SLOWEST_PHASE, FASTEST_PHASE = 0.05, 0.4
"""Longest substep with laws: radians of the slowest and of the fastest mode that it may span."""


@dataclass(frozen=True)
class Laws:
    """Internal forces as arrays for the kernel.

    Attributes
    ----------
    ports : tuple of str
        Port of each law, J of them.
    codes : (J,) ndarray of int
        Kind of each law.
    values : (J, 5) ndarray
        Parameters, see `fe.motion_kernel`.
    slips : (J, E) ndarray
        Slip displacements of micro-slip elements [m or rad].
    rate : float
        Stiffness drift of the whole structure [1/s].
    """

    ports: tuple[str, ...]
    codes: IntArray
    values: FloatArray
    slips: FloatArray
    rate: float = 0.0

    def __len__(self) -> int:
        return len(self.ports)

    @property
    def linear(self) -> bool:
        """Whether there is nothing to do."""
        return not self.ports and self.rate == 0.0

    def rows(self, ports: Mapping[str, FloatArray], width: int) -> FloatArray:
        """Return the port row of each law, (J, width)."""
        return np.array([ports[name] for name in self.ports], dtype=np.float64).reshape(len(self), width)

    def memory(self) -> FloatArray:
        """Return the memory (J, 5 + E) of laws that have never been loaded."""
        return np.zeros((len(self), HEAD + self.slips.shape[1]))


NO_LAWS = Laws((), np.zeros(0, dtype=np.int64), np.zeros((0, 5)), np.zeros((0, 1)))
"""The linear structure."""


def slip_displacements(law: MicroSlip) -> FloatArray:
    """Return the slip displacements (n,) of a joint's elements.

    Quantile midpoints of phi ~ d^chi (Segalman 2005, without the macro-slip impulse), scaled so that the
    joint as a whole slips at `slip_force` exactly.
    """
    share = (np.arange(law.element_count) + 0.5) / law.element_count
    slips = share ** (1.0 / (1.0 + law.chi))
    return np.asarray(slips * (law.slip_force / law.stiffness / slips.mean()))


def laws_of(patch: ModelPatch, ports: Collection[str]) -> Laws:
    """Return the internal forces of a patch; laws without magnitude and other primitives are left out.

    Parameters
    ----------
    patch : ModelPatch
        Changes.
    ports : collection of str
        Ports that the model has.

    Returns
    -------
    Laws
        For `simulate`.

    Raises
    ------
    InvalidPatchError
        If a law acts on a port that the model does not have, or a value cannot be (a scale that is not
        positive).
    """
    names, codes, values, slips = [], [], [], []
    rate = 0.0
    for item in patch:
        slip = np.zeros(0)
        if isinstance(item, StiffnessDrift):
            rate += item.rate
            continue
        if isinstance(item, PowerDamping):
            positive = {
                "reference_velocity": item.reference_velocity,
                "reference_displacement": item.reference_displacement,
            }
            least = {
                "coefficient": item.coefficient,
                "velocity_exponent": item.velocity_exponent,
                "displacement_exponent": item.displacement_exponent,
            }
            code, magnitude = POWER_DAMPING, item.coefficient
            row = (
                item.coefficient,
                item.velocity_exponent,
                item.displacement_exponent,
                item.reference_velocity,
                item.reference_displacement,
            )
        elif isinstance(item, PowerStiffness):
            positive = {"reference_displacement": item.reference_displacement, "exponent": item.exponent}
            least = {"1 - |side|": 1.0 - abs(item.side)}
            code, magnitude = POWER_STIFFNESS, item.coefficient
            row = (item.coefficient, item.exponent, float(item.side), item.reference_displacement, 0.0)
        elif isinstance(item, FreePlay):
            positive, least = {}, {"half_width": item.half_width}
            code, magnitude = FREE_PLAY, item.stiffness * item.half_width
            row = (item.stiffness, item.half_width, 0.0, 0.0, 0.0)
        elif isinstance(item, MicroSlip):
            positive = {
                "slip_force": item.slip_force,
                "element_count": item.element_count,
                "1 + chi": 1 + item.chi,
            }
            least = {"stiffness": item.stiffness, "-chi": -item.chi}
            code, magnitude = MICRO_SLIP, item.stiffness
            row = (item.stiffness, float(item.element_count), 0.0, 0.0, 0.0)
        elif isinstance(item, BoucWen):
            positive = {"yield_displacement": item.yield_displacement, "order": item.order}
            least = {}
            code, magnitude = BOUC_WEN, item.stiffness
            row = (item.stiffness, item.yield_displacement, item.order, 0.0, 0.0)
        else:
            continue
        if item.port not in ports:
            known = f"it has {', '.join(ports)}" if ports else "it has none"
            raise InvalidPatchError(
                f"The primitive {item.kind!r} acts on the port {item.port!r}, which this model "
                f"does not have; "
                f"{known}."
            )
        if magnitude == 0.0:
            continue
        for name, value in positive.items():
            if not value > 0.0:
                raise InvalidPatchError(f"{name} of {item.kind!r} must be positive, but is {value:g}.")
        for name, value in least.items():
            if value < 0.0:
                raise InvalidPatchError(f"{name} of {item.kind!r} must not be negative, but is {value:g}.")
        if isinstance(item, MicroSlip):
            slip = slip_displacements(item)
        names.append(item.port)
        codes.append(code)
        values.append(row)
        slips.append(slip)
    if not names:
        return NO_LAWS if rate == 0.0 else Laws((), NO_LAWS.codes, NO_LAWS.values, NO_LAWS.slips, rate)
    width = max(1, *(len(slip) for slip in slips))
    return Laws(
        tuple(names),
        np.array(codes, dtype=np.int64),
        np.array(values, dtype=np.float64),
        np.array([np.pad(slip, (0, width - len(slip))) for slip in slips]),
        rate,
    )


@dataclass(frozen=True)
class ModalSystem:
    """A linear structure in mass-normalised modal coordinates: q'' + D q' + W^2 q = forces.

    Attributes
    ----------
    angular_frequency : (M,) ndarray
        Undamped angular frequencies [rad/s]; zero is allowed.
    damping : (M, M) ndarray
        D [1/s]; diagonal 2 zeta w for modal damping.
    ports : mapping of str to (M,) ndarray
        Modal rows of the ports: the motion of a port is row . q, and what the flexibility adds.
    flexibility : (P,) ndarray, optional
        Position of each port, in their order, by a unit force there that these modes leave out; none if it is
        left out [m/N, rad/(N m) and so on].
    relaxation : float
        What is left out follows a force with this lag, the factor of damping in proportion to the stiffness
        [s].
    """

    angular_frequency: FloatArray
    damping: FloatArray
    ports: Mapping[str, FloatArray] = field(default_factory=dict)
    flexibility: FloatArray | None = None
    relaxation: float = 0.0

    @property
    def coupled(self) -> bool:
        """Whether damping couples the modes."""
        return bool(np.any(self.damping != np.diag(np.diag(self.damping))))


LEAST_FLEXIBLE = 0.1
"""Share of a port's flexibility that modes must leave out for damping there to act through it."""


def port_flexibility(system: ModalSystem, laws: Laws) -> FloatArray:
    """Return R (J,) of the laws' ports; what forces at other ports add is left out.

    Zero for damping at ports where the modes hold nearly all of the flexibility: friction there acts on the
    modes themselves, which takes no small steps.
    """
    result = np.zeros(len(laws))
    if system.flexibility is None or not len(laws):
        return result
    names = list(system.ports)
    index = [names.index(name) for name in laws.ports]
    own = system.flexibility[index]
    rows = laws.rows(system.ports, len(system.angular_frequency))
    with np.errstate(divide="ignore", invalid="ignore"):
        held = np.nansum(rows**2 / system.angular_frequency**2, axis=1)
    stiff = (laws.codes == POWER_DAMPING) & (own < LEAST_FLEXIBLE * (own + held))
    return np.where(stiff | (own <= 0.0), 0.0, own)


class LinearStep(NamedTuple):
    """Exact linear step: y(h) = `transition` y + `begin` f(0) + `end` f(h) + `constant`, y = (q, v)."""

    transition: FloatArray
    begin: FloatArray
    end: FloatArray
    constant: FloatArray


def linear_step(system: ModalSystem, shape: FloatArray, constant: FloatArray, h: float) -> LinearStep:
    """Return the exact step of the linear system under a force that is linear in time.

    The exponential of one matrix (Van Loan 1978) by scaling, a Taylor polynomial and squaring.

    Parameters
    ----------
    system : ModalSystem
        The structure.
    shape, constant : (M,) ndarray
        b of the force and the constant modal force.
    h : float
        Duration [s].

    Returns
    -------
    LinearStep
        Arrays over (q, v).
    """
    key = (
        system.angular_frequency.tobytes(),
        system.damping.tobytes(),
        shape.tobytes(),
        constant.tobytes(),
        h,
    )
    step = _STEPS.get(key)
    if step is None:
        step = _linear_step(system, shape, constant, h)
        if len(_STEPS) >= MOST_STEPS:
            _STEPS.pop(next(iter(_STEPS)))
        _STEPS[key] = step
    return step


_STEPS: dict[tuple[bytes, bytes, bytes, bytes, float], LinearStep] = {}
MOST_STEPS = 64
"""Linear steps that are kept, because the same structure is often moved again with other laws."""


def _linear_step(system: ModalSystem, shape: FloatArray, constant: FloatArray, h: float) -> LinearStep:
    count = len(system.angular_frequency)
    # Velocities are measured in units of the highest frequency, which balances the matrix.
    unit = max(
        float(np.max(system.angular_frequency)), float(np.max(np.abs(system.damping))), 1.0 / h if h else 1.0
    )
    matrix = np.zeros((2 * count + 3, 2 * count + 3))
    matrix[:count, count : 2 * count] = unit * np.eye(count)
    matrix[count : 2 * count, :count] = -np.diag(system.angular_frequency**2) / unit
    matrix[count : 2 * count, count : 2 * count] = -system.damping
    matrix[count : 2 * count, 2 * count] = shape / unit
    matrix[count : 2 * count, 2 * count + 2] = constant / unit
    matrix *= h
    matrix[2 * count, 2 * count + 1] = 1.0
    norm = float(np.max(np.sum(np.abs(matrix[: 2 * count, : 2 * count]), axis=1)))
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / 0.5))))
    scaled = matrix / 2.0**squarings
    result = np.eye(len(matrix))
    for order in range(14, 0, -1):
        result = np.eye(len(matrix)) + scaled @ result / order
    for _ in range(squarings):
        result = result @ result
    scale = np.repeat((1.0, unit), count)
    state = slice(0, 2 * count)
    slope = result[state, 2 * count + 1] * scale
    return LinearStep(
        np.ascontiguousarray(result[state, state] * scale[:, None] / scale),
        result[state, 2 * count] * scale - slope,
        slope,
        result[state, 2 * count + 2] * scale,
    )


def substeps_for(angular_frequency: FloatArray, laws: Laws, interval: float) -> int:
    """Return how many steps an interval [s] is divided into; one without laws, where the step is exact."""
    if laws.linear or interval <= 0.0:
        return 1
    moving = angular_frequency[angular_frequency > 0.0]
    if not len(moving):
        return 8
    phase = max(float(moving.min()) / SLOWEST_PHASE, float(moving.max()) / FASTEST_PHASE) * interval
    return max(1, int(np.ceil(phase)))


class ModalMotion(NamedTuple):
    """Motion at samples: `q`, `v` (N, M), `port_forces` (N, J) of the laws, their `memory` at the end.

    `lagged` (N, J) are the forces as what the modes leave out follows them.
    """

    q: FloatArray
    v: FloatArray
    port_forces: FloatArray
    memory: FloatArray
    lagged: FloatArray


def simulate(
    system: ModalSystem,
    laws: Laws,
    *,
    q: FloatArray,
    v: FloatArray,
    force: FloatArray,
    interval: float,
    shape: FloatArray | None = None,
    constant: FloatArray | None = None,
    memory: FloatArray | None = None,
    feed: FloatArray | None = None,
    start: float = 0.0,
    refinement: int = 1,
    substeps: int | None = None,
    kernel: Kernel | None = None,
) -> ModalMotion:
    """Return the motion from a given state.

    Parameters
    ----------
    system : ModalSystem
        The linear structure.
    laws : Laws
        Its internal forces.
    q, v : (M,) ndarray
        State at the first sample.
    force : (N,) ndarray
        Applied force at the samples [N]; linear between them.
    interval : float
        Between samples [s].
    shape, constant : (M,) ndarray, optional
        Modal shape of the force, and a constant modal force; zero if left out.
    memory : (J, 5 + E) ndarray, optional
        Of the laws, as `static_solution` or an earlier call returned it. Left out: each law has been loaded
        from zero to its first position without turning back.
    feed : (2, J) ndarray, optional
        What the modes leave out of the positions of the laws' ports by a force of 1 N, and by the constant
        force; zero if left out.
    start : float
        Time of the first sample since the beginning of the record, for stiffness drift [s].
    refinement : int
        Steps are this many times smaller than usual.
    substeps : int, optional
        For each interval; by default from `substeps_for`.
    kernel : mapping, optional
        Compiled functions, see `discrepancy.compiled_motion`.

    Returns
    -------
    ModalMotion
        At the samples, the first included.
    """
    modes = len(system.angular_frequency)
    shape = np.zeros(modes) if shape is None else np.ascontiguousarray(shape, dtype=np.float64)
    constant = np.zeros(modes) if constant is None else np.ascontiguousarray(constant, dtype=np.float64)
    if substeps is None:
        substeps = substeps_for(system.angular_frequency, laws, interval)
    substeps *= refinement
    h = interval / substeps
    step = linear_step(system, shape, constant, h)
    count = len(force)
    result = ModalMotion(
        np.empty((count, modes)),
        np.empty((count, modes)),
        np.empty((count, len(laws))),
        laws.memory() if memory is None else memory.copy(),
        np.empty((count, len(laws))),
    )
    (kernel or motion_kernel.kernel())["integrate"](
        step.transition,
        system.coupled,
        step.begin,
        step.end,
        step.constant,
        np.ascontiguousarray(system.angular_frequency**2),
        np.ascontiguousarray(system.damping),
        shape,
        constant,
        laws.rows(system.ports, modes),
        laws.codes,
        laws.values,
        laws.slips,
        port_flexibility(system, laws),
        float(system.relaxation),
        np.zeros((2, len(laws))) if feed is None else np.ascontiguousarray(feed, dtype=np.float64),
        memory is not None,
        laws.rate,
        start,
        h,
        substeps,
        np.ascontiguousarray(force, dtype=np.float64),
        np.array(q, dtype=np.float64),
        np.array(v, dtype=np.float64),
        result.memory,
        result.q,
        result.v,
        result.port_forces,
        result.lagged,
    )
    return result


class StaticSolution(NamedTuple):
    """Static states: `positions` and `forces` (L, J) of the laws' ports, their `memory` after the last."""

    positions: FloatArray
    forces: FloatArray
    memory: FloatArray


def static_solution(
    laws: Laws,
    linear: FloatArray,
    compliance: FloatArray,
    *,
    memory: FloatArray | None = None,
    start: FloatArray | None = None,
    kernel: Kernel | None = None,
) -> StaticSolution:
    """Return the forces of the laws at rest, for load levels that follow one another from zero.

    Parameters
    ----------
    laws : Laws
        Internal forces; damping is taken as zero at rest.
    linear : (L, J) ndarray
        Position of each law's port at each level without internal forces.
    compliance : (J, J) ndarray
        Position of the port of each law (row) under a unit force at that of another (column).
    memory, start : ndarray, optional
        Memory and linear positions (J,) from which the first level is reached; by default never loaded, and
        zero.
    kernel : mapping, optional
        Compiled functions.

    Returns
    -------
    StaticSolution
        The linear response less the response to these forces is the solution.

    Raises
    ------
    SolutionError
        If a level has no solution on the path (a softening law that the structure cannot hold).
    """
    linear = np.ascontiguousarray(linear, dtype=np.float64)
    memory = laws.memory() if memory is None else memory.copy()
    positions, forces = linear.copy(), np.zeros_like(linear)
    if len(laws) and len(linear):
        level = (kernel or motion_kernel.kernel())["static_path"](
            linear,
            np.ascontiguousarray(compliance, dtype=np.float64),
            laws.codes,
            laws.values,
            laws.slips,
            memory,
            np.zeros(len(laws)) if start is None else np.ascontiguousarray(start, dtype=np.float64),
            positions,
            forces,
        )
        if level >= 0:
            places = ", ".join(dict.fromkeys(map(place_of, laws.ports)))
            raise SolutionError(
                f"The static state at load level {level + 1} was not found: an internal force at "
                f"{places} takes more stiffness than the structure has there."
            )
    return StaticSolution(positions, forces, memory)
