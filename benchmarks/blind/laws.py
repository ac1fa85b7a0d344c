"""Laws of the internal forces that are hidden in a structure, and the motion under them.

A port is a place where a force -F acts against the port's own motion x. The structure is given by
its lowest modes and, for each port, by the flexibility of all higher modes, which move without
inertia but with the Rayleigh damping of the stiffness: beta d' + d = -F, x = b . q + R d. The
motion is integrated by the classical Runge-Kutta method with a small fixed step; hysteresis is the
exact play operator within a step. Dry friction sticks: through the flexibility behind the port
where it has one (the force that holds the port still follows from the equation above), and by a
constraint, entered and left at events, where it has none.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.compilation import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NO_FORCE, FRICTION, DRAG, POWER, GAP, JENKINS, BOUC_WEN, VISCOUS = range(8)
"""Kinds of law, and their numbers:

friction (F0, a): F0 |x|^a sgn v; drag (c): c |v| v; power (k, n, side): k |x|^n sgn x on one or
both sides; gap (k, half width): -k clip(x, -h, h); Jenkins elements (stiffness K): hysteresis less
K x; Bouc-Wen (k, yield displacement, order): k (z - x); viscous (c): c v.
"""


SIZE = 0
"""Column of the coefficient of a law: F0, c, k."""
EXPONENT = 1
HALF_WIDTH = 1
YIELD = 1
"""Column of the second number of friction and power, of a gap, and of Bouc-Wen."""
SIDE = 2
ORDER = 2
"""Column of the third number of power, and of Bouc-Wen."""


@dataclass(frozen=True)
class Law:
    """A law at a port.

    Attributes
    ----------
    port : str
        Name of the port of the structure.
    kind : int
        See the constants above.
    numbers : tuple of float
        Up to three, SI.
    slip, stiffness : (E,)
        Jenkins elements: displacement at which each slips [m or rad], stiffness of each.
    """

    port: str
    kind: int
    numbers: tuple[float, ...]
    slip: FloatArray = field(default_factory=lambda: np.zeros(0))
    stiffness: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def is_elastic(self) -> bool:
        """Whether the law gives a force at rest."""
        return self.kind in (POWER, GAP, JENKINS, BOUC_WEN)

    @property
    def needs_flexibility(self) -> bool:
        """Whether the law acts through the flexibility of the higher modes at the port."""
        return self.kind not in (DRAG, VISCOUS)


class LawArrays(NamedTuple):
    """The laws of P ports as arrays, for compiled loops.

    Attributes
    ----------
    kinds : (P,) array
        Kind of each law.
    numbers : (P, 3) array
        Numbers of each law, filled up with zeros.
    slip : (P, E) array
        Displacements at which Jenkins elements slip, filled up with zeros.
    stiffness : (P, E) array
        Stiffnesses of Jenkins elements, filled up with zeros.
    """

    kinds: IntArray
    numbers: FloatArray
    slip: FloatArray
    stiffness: FloatArray


class ModalStructure(NamedTuple):
    """A structure with P ports by its M lowest modes and the flexibility of all higher ones.

    Attributes
    ----------
    squared_frequency : (M,) array
        Squared angular frequencies [rad^2/s^2].
    damping : (M,) array
        Modal damping 2 zeta omega [1/s].
    stiffness_rate : float
        The stiffness is 1 + `stiffness_rate` t times its initial value [1/s].
    ports : (P, M) array
        Motion of each port per modal coordinate.
    flexibility : (P, P) array
        Flexibility of the higher modes between ports.
    higher_damping : float
        Stiffness-proportional damping beta of the higher modes [s]; 0 without higher modes.
    """

    squared_frequency: FloatArray
    damping: FloatArray
    stiffness_rate: float
    ports: FloatArray
    flexibility: FloatArray
    higher_damping: float


class History(NamedTuple):
    """What the forces of P ports depend on besides the state, kept from the start of a step.

    Attributes
    ----------
    displacement : (P,) array
        Port displacements at the start of the step.
    play : (P, E) array
        Deflections of the Jenkins elements at the start of the step.
    sliding : (P,) array
        For friction without flexibility: 0 where the port sticks, else the sign of its velocity.
    """

    displacement: FloatArray
    play: FloatArray
    sliding: FloatArray


class Sampling(NamedTuple):
    """When states are computed and which of them are kept.

    Attributes
    ----------
    step : float
        Time step [s].
    lead : float
        Time before the first kept state [s].
    states : int
        Number of kept states.
    steps_between : int
        Time steps from one kept state to the next.
    """

    step: float
    lead: float
    states: int
    steps_between: int


MOST_STOPS = 8
"""Most stops of a sliding port that are located within one time step."""
BISECTIONS = 45
"""Halvings of the time in which a sliding port stops."""


def law_arrays(laws: tuple[Law, ...]) -> LawArrays:
    """Return laws as arrays, one row a law."""
    elements = max([len(law.slip) for law in laws] + [1])
    arrays = LawArrays(
        kinds=np.array([law.kind for law in laws], dtype=np.int64),
        numbers=np.zeros((len(laws), 3)),
        slip=np.zeros((len(laws), elements)),
        stiffness=np.zeros((len(laws), elements)),
    )
    for row, law in enumerate(laws):
        arrays.numbers[row, : len(law.numbers)] = law.numbers
        arrays.slip[row, : len(law.slip)] = law.slip
        arrays.stiffness[row, : len(law.stiffness)] = law.stiffness
    return arrays


@compiled
def bouc_wen_rate(z: float, direction: float, yield_displacement: float, order: float) -> float:
    """Return dz/dx of the Bouc-Wen variable z for a motion x in the given direction (+1 or -1)."""
    if direction * z <= 0.0:
        return 1.0
    return 1.0 - (abs(z) / yield_displacement) ** order


@compiled
def elastic_force(
    laws: LawArrays,
    port: int,
    displacement: float,
    start: float,
    play: FloatArray,
    bouc_wen: float,
) -> float:
    """Return the force of a law that depends on its displacement and history.

    Parameters
    ----------
    laws : LawArrays
        All laws.
    port : int
        Row of the law.
    displacement : float
        Displacement of the port.
    start : float
        Displacement at which the Jenkins elements had the deflections `play`.
    play : (P, E) array
        Deflections of the Jenkins elements of all ports.
    bouc_wen : float
        Value of the Bouc-Wen variable.
    """
    kind = laws.kinds[port]
    size = laws.numbers[port, SIZE]
    if kind == POWER:
        if laws.numbers[port, SIDE] * displacement < 0.0:
            return 0.0
        return size * abs(displacement) ** laws.numbers[port, EXPONENT] * np.sign(displacement)
    if kind == GAP:
        half_width = laws.numbers[port, HALF_WIDTH]
        return -size * min(max(displacement, -half_width), half_width)
    if kind == JENKINS:
        total = 0.0
        for e in range(laws.slip.shape[1]):
            stiffness = laws.stiffness[port, e]
            if stiffness > 0.0:
                slip = laws.slip[port, e]
                deflection = min(max(play[port, e] + displacement - start, -slip), slip)
                total += stiffness * (deflection - displacement)
        return total
    if kind == BOUC_WEN:
        return size * (bouc_wen - displacement)
    return 0.0


@compiled
def _port_displacement(state: FloatArray, structure: ModalStructure, port: int) -> float:
    """Return the displacement b . q + R d of a port."""
    ports, modes = structure.ports.shape
    x = 0.0
    for i in range(modes):
        x += structure.ports[port, i] * state[i]
    for k in range(ports):
        x += structure.flexibility[port, k] * state[2 * modes + k]
    return x


@compiled
def _modal_velocity(state: FloatArray, structure: ModalStructure, port: int) -> float:
    """Return the velocity b . q' of a port in the modes alone."""
    modes = structure.ports.shape[1]
    v = 0.0
    for i in range(modes):
        v += structure.ports[port, i] * state[modes + i]
    return v


@compiled
def _port_velocity(
    state: FloatArray, rate: FloatArray, structure: ModalStructure, port: int
) -> float:
    """Return the velocity b . q' + R d' of a port, with the d' that stands in `rate`."""
    ports, modes = structure.ports.shape
    v = _modal_velocity(state, structure, port)
    for k in range(ports):
        v += structure.flexibility[port, k] * rate[2 * modes + k]
    return v


@compiled
def _flexible_rate(state: FloatArray, structure: ModalStructure, port: int, force: float) -> float:
    """Return d' = (-F - d) / beta of the higher modes at a port; 0 without higher modes."""
    beta = structure.higher_damping
    if beta > 0.0:
        return (-force - state[2 * structure.ports.shape[1] + port]) / beta
    return 0.0


@compiled
def _force_without_friction(
    state: FloatArray, structure: ModalStructure, laws: LawArrays, history: History, port: int
) -> float:
    """Return the force of the law of a port; 0 for dry friction, which follows later."""
    kind = laws.kinds[port]
    if kind == DRAG:
        v = _modal_velocity(state, structure, port)
        return laws.numbers[port, SIZE] * abs(v) * v
    if kind == VISCOUS:
        return laws.numbers[port, SIZE] * _modal_velocity(state, structure, port)
    if kind == FRICTION:
        return 0.0
    ports, modes = structure.ports.shape
    return elastic_force(
        laws,
        port,
        _port_displacement(state, structure, port),
        history.displacement[port],
        history.play,
        state[2 * modes + ports + port],
    )


@compiled
def _friction_limit(
    state: FloatArray, structure: ModalStructure, laws: LawArrays, port: int
) -> float:
    """Return the largest friction force F0 |x|^a of a port."""
    x = _port_displacement(state, structure, port)
    return laws.numbers[port, SIZE] * abs(x) ** laws.numbers[port, EXPONENT]


@compiled
def _friction_force(
    state: FloatArray,
    rate: FloatArray,
    structure: ModalStructure,
    laws: LawArrays,
    history: History,
    port: int,
) -> float:
    """Return the friction force of a port, given the rates under all other forces."""
    modes = structure.ports.shape[1]
    limit = _friction_limit(state, structure, laws, port)
    flexibility = structure.flexibility[port, port]
    if flexibility > 0.0:
        # The force that stops the flexible port, as far as friction can hold it
        v = _port_velocity(state, rate, structure, port)
        holding = structure.higher_damping * v / flexibility
        return min(max(holding, -limit), limit)
    if history.sliding[port] == 0:
        # The force that keeps the port at rest: its acceleration over its mobility
        acceleration = 0.0
        mobility = 0.0
        for i in range(modes):
            acceleration += structure.ports[port, i] * rate[modes + i]
            mobility += structure.ports[port, i] * structure.ports[port, i]
        return acceleration / mobility
    return history.sliding[port] * limit


@compiled
def _fill_rates(
    state: FloatArray,
    time: float,
    structure: ModalStructure,
    laws: LawArrays,
    history: History,
    rate: FloatArray,
    force: FloatArray,
) -> None:
    """Write the time derivative of a state (q, q', d, z) to `rate`, the port forces to `force`."""
    ports, modes = structure.ports.shape

    # Forces that follow from the state
    for j in range(ports):
        force[j] = _force_without_friction(state, structure, laws, history, j)
        rate[2 * modes + j] = _flexible_rate(state, structure, j, force[j])

    # Motion of the modes under these forces
    for i in range(modes):
        rate[i] = state[modes + i]
        stiffness = structure.squared_frequency[i] * (1.0 + structure.stiffness_rate * time)
        acceleration = -stiffness * state[i] - structure.damping[i] * state[modes + i]
        for j in range(ports):
            acceleration -= structure.ports[j, i] * force[j]
        rate[modes + i] = acceleration

    # Friction, one port after the other
    for j in range(ports):
        if laws.kinds[j] != FRICTION:
            continue
        force[j] = _friction_force(state, rate, structure, laws, history, j)
        rate[2 * modes + j] = _flexible_rate(state, structure, j, force[j])
        for i in range(modes):
            rate[modes + i] -= structure.ports[j, i] * force[j]

    # Bouc-Wen variables
    for j in range(ports):
        row = 2 * modes + ports + j
        rate[row] = 0.0
        if laws.kinds[j] == BOUC_WEN:
            v = _port_velocity(state, rate, structure, j)
            rate[row] = v * bouc_wen_rate(
                state[row], v, laws.numbers[j, YIELD], laws.numbers[j, ORDER]
            )


@compiled
def _runge_kutta_step(
    state: FloatArray,
    time: float,
    step: float,
    structure: ModalStructure,
    laws: LawArrays,
    history: History,
    force: FloatArray,
) -> FloatArray:
    """Return the state after one step of the classical Runge-Kutta method."""
    n = len(state)
    k1 = np.empty(n)
    k2 = np.empty(n)
    k3 = np.empty(n)
    k4 = np.empty(n)
    half = 0.5 * step
    _fill_rates(state, time, structure, laws, history, k1, force)
    _fill_rates(state + half * k1, time + half, structure, laws, history, k2, force)
    _fill_rates(state + half * k2, time + half, structure, laws, history, k3, force)
    _fill_rates(state + step * k3, time + step, structure, laws, history, k4, force)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@compiled
def _decide_sliding(
    state: FloatArray,
    time: float,
    structure: ModalStructure,
    laws: LawArrays,
    history: History,
    force: FloatArray,
    port: int,
) -> None:
    """Decide whether a port at rest with rigid friction sticks, or in which direction it slides."""
    scratch = np.empty(len(state))
    history.sliding[port] = 0
    _fill_rates(state, time, structure, laws, history, scratch, force)
    if abs(force[port]) > _friction_limit(state, structure, laws, port):
        history.sliding[port] = np.sign(force[port])


@compiled
def _fill_port_displacements(
    state: FloatArray, structure: ModalStructure, displacement: FloatArray
) -> None:
    """Write the displacement of each port (P,) to `displacement`."""
    for port in range(structure.ports.shape[0]):
        displacement[port] = _port_displacement(state, structure, port)


@compiled
def _port_with_rigid_friction(structure: ModalStructure, laws: LawArrays) -> int:
    """Return the last port with friction and no flexibility, or -1."""
    rigid = -1
    for j in range(len(laws.kinds)):
        if laws.kinds[j] == FRICTION and structure.flexibility[j, j] <= 0.0:
            rigid = j
    return rigid


@compiled
def _time_until_stop(
    state: FloatArray,
    time: float,
    longest: float,
    structure: ModalStructure,
    laws: LawArrays,
    history: History,
    force: FloatArray,
    port: int,
) -> float:
    """Return by bisection the time until a sliding port comes to rest, at most `longest`."""
    low = 0.0
    high = longest
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        trial = _runge_kutta_step(state, time, middle, structure, laws, history, force)
        if _modal_velocity(trial, structure, port) * history.sliding[port] < 0.0:
            high = middle
        else:
            low = middle
    return high


@compiled
def _stop_port(state: FloatArray, structure: ModalStructure, port: int) -> None:
    """Remove the remaining velocity of a port that has come to rest, by an impulse on the port."""
    modes = structure.ports.shape[1]
    v = _modal_velocity(state, structure, port)
    mobility = 0.0
    for i in range(modes):
        mobility += structure.ports[port, i] * structure.ports[port, i]
    for i in range(modes):
        state[modes + i] -= structure.ports[port, i] * v / mobility


@compiled
def _advance_play(
    state: FloatArray, structure: ModalStructure, laws: LawArrays, history: History
) -> None:
    """Advance the deflections of the Jenkins elements to a new state; each slips at its limit."""
    for j in range(len(laws.kinds)):
        if laws.kinds[j] == JENKINS:
            x = _port_displacement(state, structure, j)
            for e in range(history.play.shape[1]):
                slip = laws.slip[j, e]
                moved = history.play[j, e] + x - history.displacement[j]
                history.play[j, e] = min(max(moved, -slip), slip)


@compiled
def _advance(
    state: FloatArray,
    time: float,
    length: float,
    structure: ModalStructure,
    laws: LawArrays,
    history: History,
    force: FloatArray,
    rigid: int,
) -> tuple[FloatArray, float]:
    """Return state and time after a time step, parted where a port with rigid friction stops."""
    remaining = length
    stops = 0
    while remaining > 0.0:
        _fill_port_displacements(state, structure, history.displacement)
        new = _runge_kutta_step(state, time, remaining, structure, laws, history, force)
        step = remaining
        has_stopped = False

        # Does the sliding port stop within the step?
        may_stop = rigid >= 0 and history.sliding[rigid] != 0.0 and stops < MOST_STOPS
        if may_stop and _modal_velocity(new, structure, rigid) * history.sliding[rigid] < 0.0:
            step = _time_until_stop(state, time, remaining, structure, laws, history, force, rigid)
            new = _runge_kutta_step(state, time, step, structure, laws, history, force)
            stops += 1
            has_stopped = True

        _advance_play(new, structure, laws, history)
        state = new
        time += step
        remaining = remaining - step if has_stopped else 0.0

        # From rest the port sticks or slides anew
        if rigid >= 0:
            if has_stopped:
                _stop_port(state, structure, rigid)
            _fill_port_displacements(state, structure, history.displacement)
            if history.sliding[rigid] == 0.0 or has_stopped:
                _decide_sliding(state, time, structure, laws, history, force, rigid)
    return state, time


@compiled
def integrate(
    state: FloatArray,
    play: FloatArray,
    structure: ModalStructure,
    laws: LawArrays,
    sampling: Sampling,
) -> FloatArray:
    """Integrate the motion of a structure from time zero and return the states that are kept.

    Parameters
    ----------
    state : (2 M + 2 P,) array
        Initial state: q, q', d, and the Bouc-Wen variable of each port.
    play : (P, E) array
        Initial deflections of the Jenkins elements; they are advanced in place.
    structure : ModalStructure
        The linear structure with its ports.
    laws : LawArrays
        The law of each port.
    sampling : Sampling
        Time step, and which states are kept.

    Returns
    -------
    (states, 2 M + 2 P) array
        Kept states.
    """
    ports = len(laws.kinds)
    states = np.empty((sampling.states, len(state)))
    force = np.zeros(ports)
    history = History(np.zeros(ports), play, np.zeros(ports))
    rigid = _port_with_rigid_friction(structure, laws)
    time = 0.0
    _fill_port_displacements(state, structure, history.displacement)
    if rigid >= 0:
        _decide_sliding(state, time, structure, laws, history, force, rigid)

    lead_steps = int(np.ceil(sampling.lead / sampling.step))
    total = lead_steps + (sampling.states - 1) * sampling.steps_between
    row = 0
    for step in range(total + 1):
        if step >= lead_steps and (step - lead_steps) % sampling.steps_between == 0:
            states[row] = state
            row += 1
        if step == total:
            break
        length = sampling.lead / lead_steps if step < lead_steps else sampling.step
        state, time = _advance(state, time, length, structure, laws, history, force, rigid)
    return states
