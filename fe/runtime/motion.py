"""Motion of a linear system with laws at its ports: the static solution, and steps to any time stamps.

Without laws it is exact between the stamps. Steps are those of `ModalSystem.exact_steps`; lengths that
differ by less than `ALIKE` of the usual one are one. The loops run as plain Python here; `fe.compilation`
has the same functions compiled, to be given as `kernel`. NumPy and relative imports only: this file is
copied into the FMU.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from .arrays import HEAD, PLACE, BoolArray, FloatArray, IntArray
from .errors import InvalidPatchError, SolutionError
from .laws import LAWS
from .laws.interface import PARAMETERS, PortForce
from .modal_system import ModalSystem
from .motion_arrays import SPEED, STILL, ModalMotion, Ports, State, Steps
from .motion_kernel import integrate
from .patch import ModelPatch, StiffnessDrift
from .primitive import Primitive
from .static_path import static_path


class Kernel(NamedTuple):
    """The loops `motion_kernel.integrate` and `static_path.static_path`, plain or compiled."""

    integrate: Callable[..., None]
    static_path: Callable[..., int]


PLAIN = Kernel(integrate, static_path)
PLANFORM = "planform"
"""The place of a force that is spread over a planform: at every place acts the law on the motion of that
place, with a force that is the place's share of the area times that of the law. Air resists where a wing
moves, not its mean. The integral over the area is taken at the stations of Gauss and Legendre along the
span."""
STATION_COUNT = 6
"""Stations of the integral: ring-downs under quadratic drag are within 1e-3 microstrain of those with 24."""
STATION_PORTS = tuple(f"{PLANFORM}[{number}]" for number in range(1, STATION_COUNT + 1))
"""Ports of the stations, from the root to the tip."""


def place_of(port: str) -> str:
    """Return the place that a patch names for a port: `PLANFORM` for those of its stations."""
    return PLANFORM if port in STATION_PORTS else port


def at_stations(patch: ModelPatch, share: FloatArray) -> ModelPatch:
    """Return a patch with each force at `PLANFORM` replaced by one at every port of `STATION_PORTS`.

    Parameters
    ----------
    patch : ModelPatch
        Any; what acts elsewhere stays, in its order.
    share : (S,) ndarray
        Of the stations.
    """
    spread: list[Primitive] = []
    for item in patch:
        if not isinstance(item, PortForce) or item.port != PLANFORM:
            spread.append(item)
            continue
        for port, part in zip(STATION_PORTS, share.tolist(), strict=True):
            changes: dict[str, Any] = {name: part * getattr(item, name) for name in item.proportional}
            spread.append(replace(item, **changes, port=port))
    return ModelPatch(tuple(spread))


@dataclass(frozen=True)
class Laws:
    """Internal forces as arrays for the kernel.

    Attributes
    ----------
    ports : tuple of str
        Port of each law, J of them.
    numbers : (J,) ndarray of int
        Which of `fe.runtime.laws.LAWS` each is.
    values : (J, 5 + E) ndarray
        Parameters, then those of hysteretic elements.
    rate : float
        Stiffness drift of the whole structure [1/s].
    spans : tuple of tuple of (float, float)
        Begins and ends of when each law acts [s], none for one that always acts; empty where all do.
    since : float
        From when on the stiffness drifts [s].
    """

    ports: tuple[str, ...]
    numbers: IntArray
    values: FloatArray
    rate: float = 0.0
    spans: tuple[tuple[tuple[float, float], ...], ...] = ()
    since: float = 0.0

    def __len__(self) -> int:
        return len(self.ports)

    @property
    def linear(self) -> bool:
        """Whether there is nothing to do."""
        return not self.ports and self.rate == 0.0

    def rows(self, ports: Mapping[str, FloatArray], width: int, time: float | None = None) -> FloatArray:
        """Return the port row of each law, (J, width); at a `time` [s], nothing of laws that do not act."""
        found = np.array([ports[name] for name in self.ports], dtype=np.float64).reshape(len(self), width)
        if time is not None:
            found[~self.act_at(time)] = 0.0
        return found

    @property
    def edges(self) -> tuple[float, ...]:
        """Moments at which a law begins or ends [s]."""
        return tuple(moment for spans in self.spans for span in spans for moment in span if isfinite(moment))

    def act_at(self, time: float) -> BoolArray:
        """Return which of the laws (J,) act at a time."""
        spans = self.spans or ((),) * len(self)
        return np.array(
            [not own or any(begin <= time < end for begin, end in own) for own in spans], dtype=bool
        )

    def alike(self, other: "Laws") -> bool:
        """Return whether these are the same laws at the same ports, whose memory then stays."""
        same = self.ports == other.ports and self.values.shape == other.values.shape
        return same and bool(np.array_equal(self.numbers, other.numbers))

    @cached_property
    def of_speed(self) -> IntArray:
        """1 for each law (J,) of speed."""
        return np.array([LAWS[number].of_speed for number in self.numbers], dtype=np.int64)

    def memory(self) -> FloatArray:
        """Return the memory (J, 5 + E) of laws that have never been loaded, E at least 1."""
        return np.zeros((len(self), HEAD + max(1, self.values.shape[1] - PARAMETERS)))

    def at(
        self, rows: FloatArray, acts: FloatArray, flexibility: FloatArray, relaxation: float,
        transition: FloatArray,
    ) -> Ports:  # fmt: skip
        """Return the laws at ports (J, M), for the loops, in steps of `transition` (S, 2M, 2M)."""
        weight, on_modes = np.sum(rows * acts, axis=1), (self.of_speed == 1) & (flexibility == 0.0)
        places = list(zip(self.ports, on_modes.tolist(), (weight == 0.0).tolist(), strict=True))
        first = np.array([places.index(place) for place in places], dtype=np.int64)
        return Ports(
            rows, acts, weight, np.where(weight == 0.0, STILL, np.where(on_modes, SPEED, first)),
            np.ascontiguousarray(acts @ transition[:, :, rows.shape[1] :].transpose(0, 2, 1)), self.numbers,
            self.of_speed, self.values, flexibility, relaxation, self.rate,
        )  # fmt: skip

    def at_rest(self) -> Ports:
        """Return the laws at ports which no modes move."""
        none = np.zeros((len(self), 0))
        return self.at(none, none, np.zeros(len(self)), 0.0, np.zeros((0, 0, 0)))


NO_LAWS = Laws((), np.zeros(0, dtype=np.int64), np.zeros((0, PARAMETERS)))
"""The linear structure."""


def laws_of(patch: ModelPatch, ports: Collection[str], *, in_windows: bool = False) -> Laws:
    """Return the internal forces of a patch; laws without magnitude and other primitives are left out.

    Parameters
    ----------
    patch : ModelPatch
        Changes.
    ports : collection of str
        Ports that the model has.
    in_windows : bool
        Whether the model can follow laws that act in windows only; these are those of its trial.

    Raises
    ------
    InvalidPatchError
        If a law acts on a port that the model does not have, or a value cannot be (a scale that is not
        positive), or in a window only where the model cannot follow it.
    """
    forces = []
    for item in patch.of(PortForce):
        assert isinstance(item, PortForce)
        if item.port not in ports:
            known = f"it has {', '.join(dict.fromkeys(map(place_of, ports)))}" if ports else "it has none"
            raise InvalidPatchError(
                f"The primitive {item.kind!r} acts on the port {item.port!r}, which this model does not "
                f"have; {known}."
            )
        if item.magnitude == 0.0:
            continue
        item.check()
        if item.windows and not in_windows:
            raise InvalidPatchError(
                f"The primitive {item.kind!r} acts in a window, which lumped models alone can follow."
            )
        forces.append(item)
    rate = sum((item.rate for item in patch if isinstance(item, StiffnessDrift)), 0.0)
    if not forces:
        return NO_LAWS if rate == 0.0 else replace(NO_LAWS, rate=rate)
    spans = tuple(tuple(window.span for window in item.windows) for item in forces)
    numbers = np.array([LAWS.index(type(item)) for item in forces], dtype=np.int64)
    rows = [item.row for item in forces]
    values = np.array([np.pad(row, (0, max(map(len, rows)) - len(row))) for row in rows])
    return Laws(tuple(item.port for item in forces), numbers, values, rate, spans if any(spans) else ())


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
    stiff = (laws.of_speed == 1) & (own < LEAST_FLEXIBLE * (own + held))
    return np.where(stiff | (own <= 0.0), 0.0, own)


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
        level = (kernel or PLAIN).static_path(
            linear,
            np.ascontiguousarray(compliance, dtype=np.float64),
            tuple(laws.at_rest()),
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


SLOWEST_PHASE, FASTEST_PHASE = 0.05, 0.4
"""Longest substep with laws: radians of the slowest and of the fastest mode that it may span."""
ALIKE = 1e-9
"""Lengths of steps that differ by less than this share of the usual one are taken as one."""
STEPS_AT_LEAST = 8
"""Substeps of an interval with laws where nothing in the structure has a pace of its own."""


@dataclass(frozen=True)
class Boundaries:
    """Stamps, and steps between them.

    Attributes
    ----------
    time : (K + 1,) ndarray
        Of the boundaries of the steps [s].
    sample : (N,) ndarray of int
        Boundary of each stamp.
    lengths : (K,) ndarray
        [s].
    """

    time: FloatArray
    sample: IntArray
    lengths: FloatArray

    @cached_property
    def alike(self) -> tuple[FloatArray, IntArray]:
        """Distinct lengths (S,) [s], and which (K,) each step has."""
        usual = float(np.median(self.lengths))
        if np.ptp(self.lengths) <= ALIKE * usual:
            return self.lengths[:1], np.zeros(len(self.lengths), dtype=np.int64)
        rounded = np.round(self.lengths / (ALIKE * usual))
        _, first, which = np.unique(rounded, return_index=True, return_inverse=True)
        return np.ascontiguousarray(self.lengths[first]), np.asarray(which, dtype=np.int64).ravel()


def substeps(
    system: ModalSystem,
    laws: Laws,
    time: FloatArray,
    refinement: int = 1,
    least: int = 1,
    edges: Sequence[float] = (),
) -> Boundaries:
    """Return the steps between stamps (N,) that the laws ask for, at least `least` in each interval.

    At `edges` something begins or ends, so that a step does.
    """
    inside = [moment for moment in edges if time[0] < moment < time[-1]]
    if inside:
        moments = np.union1d(time, inside)
        found = substeps(system, laws, moments, refinement, least)
        return replace(found, sample=found.sample[np.searchsorted(moments, time)])
    parts = np.ones(len(time) - 1)
    if not laws.linear:
        paces = system.paces
        parts *= STEPS_AT_LEAST
        if len(paces):
            rate = max(float(paces.min()) / SLOWEST_PHASE, float(paces.max()) / FASTEST_PHASE)
            parts = np.maximum(np.ceil(rate * np.diff(time) - 1e-9), 1.0)
    return _divided(time.tobytes(), (np.maximum(parts, least) * refinement).tobytes())


@lru_cache(maxsize=16)
def _divided(stamps: bytes, counts: bytes) -> Boundaries:
    """Return the steps by which each interval between stamps (N,) is divided into parts (N - 1,)."""
    time, parts = np.frombuffer(stamps), np.frombuffer(counts).astype(np.int64)
    sample = np.concatenate(([0], np.cumsum(parts))).astype(np.int64)
    lengths = np.repeat(np.diff(time) / parts, parts)
    interval = np.repeat(np.arange(len(parts)), parts)
    place = np.arange(1, len(interval) + 1) - sample[:-1][interval]
    moments = np.concatenate((time[:1], time[interval] + place * lengths))
    moments[sample] = time
    return Boundaries(moments, sample, lengths)


def steps_under(
    system: ModalSystem, boundaries: Boundaries, begin: FloatArray, end: FloatArray, feed: FloatArray
) -> Steps:
    """Return steps under modal forces (K, M) at both ends of each; `feed` is that of `Steps`."""
    lengths, which = boundaries.alike
    transition, *by = system.exact_steps(lengths)
    push = np.zeros((len(which), transition.shape[1]))
    for forces, part in zip((begin, end), by, strict=True):
        if forces.any():
            push += forces @ part[0].T if len(lengths) == 1 else np.einsum("knm,km->kn", part[which], forces)
    moments, sample = boundaries.time, boundaries.sample
    damping = np.ascontiguousarray(system.damping)
    return Steps(
        transition, lengths, which, push, begin, end, feed, moments, sample, system.stiffness, damping
    )


class Begin(NamedTuple):
    """Modal displacements and speeds (M + P,), and the laws' memory; None: loaded from zero at once."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray | None = None


def advance(
    system: ModalSystem, laws: Laws, steps: Steps, begin: Begin, kernel: Kernel = PLAIN
) -> ModalMotion:
    """Return the motion at the samples of known steps, by plain loops or compiled ones.

    Where laws begin or end, a new section does: modes and the laws that go on keep their state, a law that
    begins has been loaded from zero to where its port is. A stamp at an edge belongs to what begins there.
    """
    known, modes, count, size = begin.memory is not None, len(begin.q), len(laws), len(steps.sample)
    memory = laws.memory() if begin.memory is None else begin.memory.copy()
    state, before = State(begin.q.astype(float), begin.v.astype(float), memory), np.ones(count, dtype=bool)
    none, forces = np.empty((2, size, modes)), np.empty((2, size, count))
    found = ModalMotion(none[0], none[1], forces[0], forces[1], memory)
    flexibility, actions = port_flexibility(system, laws), system.actions or system.ports
    given = tuple(map(np.ascontiguousarray, steps._replace(time=steps.time - laws.since)))
    time = steps.time
    edges = [moment for moment in laws.edges if time[0] < moment < time[-1]]
    cuts = np.unique(np.concatenate(([0, len(time) - 1], np.searchsorted(time, edges)))).tolist()
    for first, last in pairwise(map(int, cuts)):
        moment = 0.5 * float(time[first] + time[first + 1])
        rows, acting = laws.rows(system.ports, modes, moment), laws.act_at(moment)
        for j in np.flatnonzero(acting & ~before):
            state.memory[j] = 0.0
            if laws.of_speed[j]:
                state.memory[j, PLACE] = rows[j] @ state.q
        acts, sample = laws.rows(actions, modes, moment), int(np.searchsorted(steps.sample, first))
        ports = laws.at(rows, acts, flexibility, float(system.relaxation), steps.transition)
        by, into = (given, first, last, sample, system.coupled, known), (tuple(state), tuple(found))
        kernel.integrate(*by, tuple(ports), *into)
        known, before = True, acting
    return found
