"""Laws of the internal forces that are hidden in a structure, and the motion under them.

A port is a place where a force -F acts against the port's own motion x. The structure is given by its lowest
modes and, for each port, by the flexibility of all higher modes, which move without inertia but with the
Rayleigh damping of the stiffness: beta d' + d = -F, x = b . q + R d. The motion is integrated by the
classical Runge-Kutta method with a small fixed step; hysteresis is the exact play operator within a step.
Dry friction sticks: through the flexibility behind the port where it has one (the force that holds the port
still follows from the equation above), and by a constraint, entered and left at events, where it has none.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

NO_FORCE, FRICTION, DRAG, POWER, GAP, JENKINS, BOUC_WEN, VISCOUS = range(8)
"""Kinds of law, and their numbers:

friction (F0, a): F0 |x|^a sgn v; drag (c): c |v| v; power (k, n, side): k |x|^n sgn x on one or both sides;
gap (k, half width): -k clip(x, -h, h); Jenkins elements (stiffness K): hysteresis less K x; Bouc-Wen
(k, yield displacement, order): k (z - x); viscous (c): c v.
"""


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
        """Whether the flexibility of the higher modes behind the port counts (drag: of no account)."""
        return self.kind not in (DRAG, VISCOUS)


def law_arrays(laws: tuple[Law, ...]) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """Kinds (P,), numbers (P, 3), slip displacements (P, E) and stiffnesses (P, E) of laws."""
    count = max([len(law.slip) for law in laws] + [1])
    kinds = np.array([law.kind for law in laws], dtype=np.int64)
    numbers, slip, stiffness = (
        np.zeros((len(laws), 3)),
        np.zeros((len(laws), count)),
        np.zeros((len(laws), count)),
    )
    for row, law in enumerate(laws):
        numbers[row, : len(law.numbers)] = law.numbers
        slip[row, : len(law.slip)] = law.slip
        stiffness[row, : len(law.stiffness)] = law.stiffness
    return kinds, numbers, slip, stiffness


@njit(cache=True)
def bouc_wen_rate(z: float, direction: float, yield_displacement: float, order: float) -> float:
    """Return dz/dx of Bouc and Wen's variable for a motion of the given sign."""
    if direction * z <= 0.0:
        return 1.0
    return 1.0 - (abs(z) / yield_displacement) ** order


@njit(cache=True)
def elastic_force(kind, numbers, slip, stiffness, x, x0, z0, bouc):
    """Force of a law that depends on x and its history: play elements had the deflections z0 (E,) at x0."""
    if kind == POWER:
        if numbers[2] * x < 0.0:
            return 0.0
        return numbers[0] * abs(x) ** numbers[1] * np.sign(x)
    if kind == GAP:
        return -numbers[0] * min(max(x, -numbers[1]), numbers[1])
    if kind == JENKINS:
        total = 0.0
        for e in range(len(slip)):
            if stiffness[e] > 0.0:
                total += stiffness[e] * (min(max(z0[e] + x - x0, -slip[e]), slip[e]) - x)
        return total
    if kind == BOUC_WEN:
        return numbers[0] * (bouc - x)
    return 0.0


@njit(cache=True)
def _rates(state, time, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z0, mode, rate, force):
    """Rates of q, q', d and Bouc-Wen's z, all in `state`; `force` (P,) is filled on the way."""
    m, p = len(w2), len(kinds)
    d = state[2 * m : 2 * m + p]
    for j in range(p):
        x, v = 0.0, 0.0
        for i in range(m):
            x += b[j, i] * state[i]
            v += b[j, i] * state[m + i]
        for k in range(p):
            x += r[j, k] * d[k]
        kind = kinds[j]
        if kind == DRAG:
            force[j] = numbers[j, 0] * abs(v) * v
        elif kind == VISCOUS:
            force[j] = numbers[j, 0] * v
        elif kind == FRICTION:
            force[j] = 0.0
        else:
            force[j] = elastic_force(
                kind, numbers[j], slip[j], stiffness[j], x, x0[j], z0[j], state[2 * m + p + j]
            )
        rate[2 * m + j] = (-force[j] - d[j]) / beta if beta > 0.0 else 0.0
    for i in range(m):
        rate[i] = state[m + i]
        a = -w2[i] * (1.0 + rho * time) * state[i] - c[i] * state[m + i]
        for j in range(p):
            a -= b[j, i] * force[j]
        rate[m + i] = a
    for j in range(p):
        if kinds[j] != FRICTION:
            continue
        x, v, a, own = 0.0, 0.0, 0.0, 0.0
        for i in range(m):
            x += b[j, i] * state[i]
            v += b[j, i] * state[m + i]
            a += b[j, i] * rate[m + i]
            own += b[j, i] * b[j, i]
        for k in range(p):
            x += r[j, k] * d[k]
            v += r[j, k] * rate[2 * m + k]
        level = numbers[j, 0] * abs(x) ** numbers[j, 1]
        if r[j, j] > 0.0:
            force[j] = min(max(beta * v / r[j, j], -level), level)
        elif mode[j] == 0:
            force[j] = a / own
        else:
            force[j] = mode[j] * level
        rate[2 * m + j] = (-force[j] - d[j]) / beta if beta > 0.0 else 0.0
        for i in range(m):
            rate[m + i] -= b[j, i] * force[j]
    for j in range(p):
        z = state[2 * m + p + j]
        rate[2 * m + p + j] = 0.0
        if kinds[j] == BOUC_WEN:
            v = 0.0
            for i in range(m):
                v += b[j, i] * state[m + i]
            for k in range(p):
                v += r[j, k] * rate[2 * m + k]
            rate[2 * m + p + j] = v * bouc_wen_rate(z, v, numbers[j, 1], numbers[j, 2])


@njit(cache=True)
def _step(state, time, h, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z0, mode, force):
    n = len(state)
    k1, k2, k3, k4 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    a = (w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z0, mode)
    _rates(state, time, *a, k1, force)
    _rates(state + 0.5 * h * k1, time + 0.5 * h, *a, k2, force)
    _rates(state + 0.5 * h * k2, time + 0.5 * h, *a, k3, force)
    _rates(state + h * k3, time + h, *a, k4, force)
    return state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@njit(cache=True)
def _velocity(state, b, j):
    m = b.shape[1]
    v = 0.0
    for i in range(m):
        v += b[j, i] * state[m + i]
    return v


@njit(cache=True)
def _settle(state, time, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z0, mode, force, j):
    """At rest: decide whether a port with friction and no flexibility sticks, or which way it goes."""
    scratch = np.empty(len(state))
    mode[j] = 0
    _rates(state, time, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z0, mode, scratch, force)
    x = 0.0
    for i in range(b.shape[1]):
        x += b[j, i] * state[i]
    level = numbers[j, 0] * abs(x) ** numbers[j, 1]
    if abs(force[j]) > level:
        mode[j] = np.sign(force[j])


@njit(cache=True)
def _port_motion(state, b, r, x):
    p, m = b.shape
    for j in range(p):
        x[j] = 0.0
        for i in range(m):
            x[j] += b[j, i] * state[i]
        for k in range(p):
            x[j] += r[j, k] * state[2 * m + k]


@njit(cache=True)
def integrate(state, z, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, time, h, lead, count, keep):
    """Integrate the motion and keep every `keep`-th state.

    Parameters
    ----------
    state : (2 M + 2 P,)
        q, q', d, Bouc-Wen's z at the start.
    z : (P, E)
        Deflections of the Jenkins elements at the start.
    w2, c : (M,)
        Squared angular frequencies, and modal damping 2 zeta w.
    rho : float
        The stiffness is 1 + rho t times what it was.
    b, r : (P, M), (P, P)
        Ports in modal coordinates, flexibility of the higher modes between ports.
    beta : float
        Stiffness-proportional damping of the higher modes [s].
    kinds, numbers, slip, stiffness
        `law_arrays`.
    time, h : float
        Time of the start, step.
    lead : float
        Time to let pass before the first state is kept.
    count, keep : int
        Kept states, and steps between them.

    Returns
    -------
    (count, 2 M + 2 P) ndarray
        States.
    """
    m, p = len(w2), len(kinds)
    kept = np.empty((count, len(state)))
    force, x0, x1 = np.zeros(p), np.zeros(p), np.zeros(p)
    mode = np.zeros(p)
    rigid = -1
    for j in range(p):
        if kinds[j] == FRICTION and r[j, j] <= 0.0:
            rigid = j
    _port_motion(state, b, r, x0)
    if rigid >= 0:
        _settle(
            state, time, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z, mode, force, rigid
        )
    lead_steps = int(np.ceil(lead / h))
    total = lead_steps + (count - 1) * keep
    row = 0
    for step in range(total + 1):
        if step >= lead_steps and (step - lead_steps) % keep == 0:
            kept[row] = state
            row += 1
        if step == total:
            break
        length = lead / lead_steps if step < lead_steps else h
        left = length
        events = 0
        while left > 0.0:
            _port_motion(state, b, r, x0)
            a = (w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z, mode, force)
            new = _step(state, time, left, *a)
            taken, event = left, False
            if rigid >= 0 and mode[rigid] != 0.0 and events < 8:
                v1 = _velocity(new, b, rigid) * mode[rigid]
                if v1 < 0.0:
                    low, high = 0.0, left
                    for _ in range(45):
                        middle = 0.5 * (low + high)
                        trial = _step(state, time, middle, *a)
                        if _velocity(trial, b, rigid) * mode[rigid] < 0.0:
                            high = middle
                        else:
                            low = middle
                    taken = high
                    new = _step(state, time, taken, *a)
                    events += 1
                    event = True
            for j in range(p):
                if kinds[j] == JENKINS:
                    _port_motion(new, b, r, x1)
                    for e in range(z.shape[1]):
                        z[j, e] = min(max(z[j, e] + x1[j] - x0[j], -slip[j, e]), slip[j, e])
            state = new
            time += taken
            left = left - taken if event else 0.0
            if rigid >= 0:
                if event:
                    # At the event the port is at rest: the rest of its velocity is taken out.
                    v, own = _velocity(state, b, rigid), 0.0
                    for i in range(m):
                        own += b[rigid, i] * b[rigid, i]
                    for i in range(m):
                        state[m + i] -= b[rigid, i] * v / own
                _port_motion(state, b, r, x0)
                if mode[rigid] == 0.0 or event:
                    _settle(
                        state, time, w2, c, rho, b, r, beta, kinds, numbers, slip, stiffness, x0, z, mode,
                        force, rigid,
                    )  # fmt: skip
    return kept
