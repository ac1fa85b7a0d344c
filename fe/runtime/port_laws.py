"""The laws of a patch at the ports of a model, as arrays for the loops of motion.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite

import numpy as np

from .arrays import FIRST_ELEMENT, BoolArray, FloatArray, IntArray
from .errors import InvalidPatchError
from .laws import LAWS
from .laws.interface import PARAMETERS, PortForce
from .modal_system import ModalSystem
from .motion_arrays import IMMOVABLE, SPEED_LAW, PortArrays
from .patch import ModelPatch, StiffnessDrift
from .primitive import Primitive

# ---------------------------------------------------------------- forces spread over a planform

PLANFORM = "planform"
"""The port of a force that is distributed over a planform, such as aerodynamic damping, which
depends on the local motion and not on the mean motion of the wing. The law acts at every station on
the motion of that station, with a force in proportion to the station's fraction of the area. The
stations are the points of Gauss-Legendre integration along the span."""
STATION_COUNT = 6
"""Stations of the integral: ring-downs under quadratic drag are within 1e-3 microstrain of those
with 24 stations."""
STATION_PORTS = tuple(f"{PLANFORM}[{number}]" for number in range(1, STATION_COUNT + 1))
"""Ports of the stations, from the root to the tip."""


def port_in_patch(port: str) -> str:
    """Return the port's name in a patch: `PLANFORM` for the ports of its stations."""
    return PLANFORM if port in STATION_PORTS else port


def spread_over_stations(patch: ModelPatch, area_fractions: FloatArray) -> ModelPatch:
    """Replace each law of a patch at `PLANFORM` by one law at every station.

    `area_fractions` (S,) are the stations' fractions of the planform's area. Other primitives are
    kept, in their order.
    """
    primitives: list[Primitive] = []
    for primitive in patch:
        if not isinstance(primitive, PortForce) or primitive.port != PLANFORM:
            primitives.append(primitive)
            continue
        for port, fraction in zip(STATION_PORTS, area_fractions.tolist(), strict=True):
            primitives.append(replace(primitive.scaled(fraction), port=port))
    return ModelPatch(tuple(primitives))


# ---------------------------------------------------------------- laws of a patch

Span = tuple[float, float]
"""Beginning and end of a time interval [s]."""


@dataclass(frozen=True)
class PortLaws:
    """The internal forces of a patch as arrays for the loops.

    Attributes
    ----------
    ports : tuple of str
        Port of each of the J laws.
    law_numbers : (J,) array of int
        Number of each law in `fe.runtime.laws.LAWS`.
    parameters : (J, 5 + E) array
        Parameters of each law, then those of its hysteretic elements.
    stiffness_rate : float
        Drift of the whole structure's stiffness [1/s].
    active_spans : tuple of tuple of (float, float)
        Time intervals in which each law acts [s]; an empty tuple for a law that always acts. The
        whole is empty if all laws always act.
    drift_start : float
        Time at which the stiffness begins to drift [s].
    """

    ports: tuple[str, ...]
    law_numbers: IntArray
    parameters: FloatArray
    stiffness_rate: float = 0.0
    active_spans: tuple[tuple[Span, ...], ...] = ()
    drift_start: float = 0.0

    def __len__(self) -> int:
        return len(self.ports)

    @property
    def linear(self) -> bool:
        """Whether the structure stays linear: no laws, and no drift of the stiffness."""
        return not self.ports and self.stiffness_rate == 0.0

    def port_rows(
        self, rows: Mapping[str, FloatArray], width: int, time: float | None = None
    ) -> FloatArray:
        """Return the row of each law's port as an array (J, width).

        Parameters
        ----------
        rows : mapping of str to (width,) array
            Row of each port by name.
        width : int
            Number of coordinates.
        time : float, optional
            A time [s]; rows of laws that do not act then are zero.
        """
        law_rows = np.array([rows[name] for name in self.ports], dtype=np.float64)
        law_rows = law_rows.reshape(len(self), width)
        if time is not None:
            law_rows[~self.active_at(time)] = 0.0
        return law_rows

    @property
    def switching_times(self) -> tuple[float, ...]:
        """Times at which a law begins or ends to act [s]."""
        times = [time for spans in self.active_spans for span in spans for time in span]
        return tuple(filter(isfinite, times))

    def active_at(self, time: float) -> BoolArray:
        """Return whether each of the J laws acts at a time [s]."""
        active = np.ones(len(self), dtype=bool)
        for j, spans in enumerate(self.active_spans):
            if spans:
                active[j] = any(begin <= time < end for begin, end in spans)
        return active

    def has_same_laws(self, other: "PortLaws") -> bool:
        """Return whether kinds, ports and parameter count are equal, so that memory can be kept."""
        return (
            self.ports == other.ports
            and self.parameters.shape == other.parameters.shape
            and bool(np.array_equal(self.law_numbers, other.law_numbers))
        )

    @cached_property
    def depends_on_speed(self) -> IntArray:
        """1 for each law (J,) of speed, 0 for a law of position."""
        return np.array(
            [LAWS[number].depends_on_speed for number in self.law_numbers], dtype=np.int64
        )

    def unloaded_memory(self) -> FloatArray:
        """Return the memory (J, 5 + E) of laws that were never loaded, with E >= 1 elements."""
        elements = self.parameters.shape[1] - PARAMETERS
        return np.zeros((len(self), FIRST_ELEMENT + max(1, elements)))

    def port_arrays(
        self,
        motion_rows: FloatArray,
        force_rows: FloatArray,
        flexibility: FloatArray,
        relaxation: float,
        transition: FloatArray,
    ) -> PortArrays:
        """Return the arrays of the laws for the loops of motion.

        Parameters
        ----------
        motion_rows, force_rows : (J, M) array
            Modal rows of the motion of each law's port, and along which the law acts.
        flexibility : (J,) array
            Residual flexibility of each law's port.
        relaxation : float
            Time constant of the residual position [s].
        transition : (S, 2M, 2M) array
            Transition matrices of the S step lengths.
        """
        modes = motion_rows.shape[1]
        inverse_mass = np.sum(motion_rows * force_rows, axis=1)
        impulse_response = force_rows @ transition[:, :, modes:].transpose(0, 2, 1)
        return PortArrays(
            motion_rows=motion_rows,
            force_rows=force_rows,
            inverse_mass=inverse_mass,
            leader=self._leaders(inverse_mass, flexibility),
            impulse_response=np.ascontiguousarray(impulse_response),
            law_number=self.law_numbers,
            depends_on_speed=self.depends_on_speed,
            parameters=self.parameters,
            flexibility=flexibility,
            relaxation=relaxation,
            stiffness_rate=self.stiffness_rate,
        )

    def _leaders(self, inverse_mass: FloatArray, flexibility: FloatArray) -> IntArray:
        """Return the leader (J,) of each law, see `PortArrays`."""
        on_modes = (self.depends_on_speed == 1) & (flexibility == 0.0)
        immovable = inverse_mass == 0.0
        # laws at one port that act in the same way share a position, and the first of them leads
        locations = list(zip(self.ports, on_modes.tolist(), immovable.tolist(), strict=True))
        first_laws = [locations.index(location) for location in locations]
        leader = np.array(first_laws, dtype=np.int64)
        leader[on_modes] = SPEED_LAW
        leader[immovable] = IMMOVABLE
        return leader

    def port_arrays_at_rest(self) -> PortArrays:
        """Return the arrays of the laws for static solutions, without modes."""
        no_modes = np.zeros((len(self), 0))
        return self.port_arrays(
            motion_rows=no_modes,
            force_rows=no_modes,
            flexibility=np.zeros(len(self)),
            relaxation=0.0,
            transition=np.zeros((0, 0, 0)),
        )


NO_LAWS = PortLaws((), np.zeros(0, dtype=np.int64), np.zeros((0, PARAMETERS)))
"""The linear structure."""


def port_laws(patch: ModelPatch, ports: Collection[str], *, in_windows: bool = False) -> PortLaws:
    """Collect the internal forces of a patch; laws of zero magnitude are left out.

    Parameters
    ----------
    patch : ModelPatch
        Primitives of other kinds are ignored.
    ports : collection of str
        Ports that the model has.
    in_windows : bool
        Whether the model supports laws that act in windows only.

    Raises
    ------
    InvalidPatchError
        If a law acts on a port that the model does not have, has an impossible number, or acts in a
        window but the model does not support windows.
    """
    forces = []
    for law in patch.of(PortForce):
        assert isinstance(law, PortForce)
        _check_port(law, ports)
        if law.magnitude == 0.0:
            continue
        law.check()
        if law.windows and not in_windows:
            raise InvalidPatchError(
                f"The primitive {law.kind!r} acts in a window, which only lumped models can follow."
            )
        forces.append(law)
    drifts = [primitive for primitive in patch if isinstance(primitive, StiffnessDrift)]
    stiffness_rate = sum((drift.rate for drift in drifts), 0.0)
    if not forces:
        return replace(NO_LAWS, stiffness_rate=stiffness_rate) if stiffness_rate else NO_LAWS
    # pad the parameters of all laws to one length
    rows = [law.parameter_row for law in forces]
    longest_length = max(map(len, rows))
    spans = tuple(tuple(window.span for window in law.windows) for law in forces)
    return PortLaws(
        ports=tuple(law.port for law in forces),
        law_numbers=np.array([LAWS.index(type(law)) for law in forces], dtype=np.int64),
        parameters=np.array([np.pad(row, (0, longest_length - len(row))) for row in rows]),
        stiffness_rate=stiffness_rate,
        active_spans=spans if any(spans) else (),
    )


def _check_port(law: PortForce, ports: Collection[str]) -> None:
    """Raise `InvalidPatchError` if a law acts on a port that the model does not have."""
    if law.port in ports:
        return
    names = dict.fromkeys(map(port_in_patch, ports))
    available = f"it has {', '.join(names)}" if ports else "it has none"
    raise InvalidPatchError(
        f"The primitive {law.kind!r} acts on the port {law.port!r}, which this model does not "
        f"have; {available}."
    )


LEAST_RESIDUAL = 0.1
"""If the modes leave out less than this fraction of a port's flexibility, laws of speed there act
on the modes, else on the residual flexibility."""


def port_flexibility(system: ModalSystem, laws: PortLaws) -> FloatArray:
    """Return the residual flexibility (J,) of the port of each law: that of modes without inertia.

    It is set to zero for a law of speed at a port whose flexibility is nearly all in the modes. The
    law then acts on the modes themselves, which needs no small time steps.
    """
    flexibility = np.zeros(len(laws))
    if system.flexibility is None or not len(laws):
        return flexibility
    port_names = list(system.ports)
    port_numbers = [port_names.index(name) for name in laws.ports]
    residual = system.flexibility[port_numbers]
    rows = laws.port_rows(system.ports, len(system.angular_frequency))
    with np.errstate(divide="ignore", invalid="ignore"):
        # a unit force at the port moves it by the sum of row^2 / omega^2 in the modes
        modal_compliance = np.nansum(rows**2 / system.angular_frequency**2, axis=1)
    whole_compliance = residual + modal_compliance
    nearly_rigid = residual < LEAST_RESIDUAL * whole_compliance
    acts_on_modes = (laws.depends_on_speed == 1) & nearly_rigid
    is_rigid = residual <= 0.0
    return np.where(acts_on_modes | is_rigid, 0.0, residual)
