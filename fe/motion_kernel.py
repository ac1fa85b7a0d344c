"""Motion of a few modes with internal forces at ports: loops over numbers, and nothing else.

q'' + D q' + W^2 (1 + r t) q = b f(t) + c - sum_j p_j F_j(p_j . q, p_j . v, memory_j). The linear part is
advanced exactly (matrix exponential, force linear between samples); internal forces are split off
symmetrically (Strang 1968): damping, displacement forces, linear motion, displacement forces, damping.
Damping kicks have a closed form. Where friction turns over inside a step, the impulse and its first moment
are corrected for the moment of the turn; where it holds, the port is held in place by the impulses that this
needs, as long as friction can give them.

A port may lie on flexibility R that the modes leave out: x = p . q - R D + e, where D is the force of the
laws there after a lag, beta D' + D = F (the lag of damping in proportion to the stiffness; backward Euler),
and e what loads add. The force of a law on such a port is that at the step's end, where it obeys the law at
its own position: a monotone equation in one unknown. Dry friction is then an elasto-plastic element of
stiffness 1/R.

Written in the subset of Python that numba compiles too. NumPy only: this file is copied into the FMU. Other
code may take this file's functions by the names in `COMPILED`, in their order, and compile them.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

POWER_DAMPING, POWER_STIFFNESS, FREE_PLAY, MICRO_SLIP, BOUC_WEN = 0, 1, 2, 3, 4
"""Codes of the laws. Their parameters (5,):

power damping: coefficient, velocity exponent, displacement exponent, reference velocity, reference
displacement; power stiffness: coefficient, exponent, side, reference displacement; free play: stiffness,
half width; micro-slip: stiffness, element count; Bouc-Wen: stiffness, yield displacement, order.
"""
HEAD = 5
"""Columns of a memory before its hysteretic elements: 1 if friction holds the port; its last position; D;
what loads that are gone still add to the position, which fades with beta; the last force of damping on a
flexible port."""

FIRST_PARTS = 400
"""Parts in which the way from a law's last position to the first one of a motion is followed."""

COMPILED = (
    "power", "displacement_force", "displacement_slope", "bouc_wen_path", "advance_memory", "damping_kick",
    "holding_limit", "crossing", "damped_position", "sprung_position", "slipped_position", "yielded_position",
    "law_position", "law_pull", "settle", "integrate", "static_forces", "static_path",
)  # fmt: skip
"""Functions to compile, each after those that it calls."""


def power(base: float, exponent: float) -> float:
    """Return base^exponent of a base that is not negative; 0^0 is 1."""
    if exponent == 0.0:
        return 1.0
    if exponent == 1.0:
        return base
    if exponent == 2.0:
        return base * base
    if exponent == 3.0:
        return base * base * base
    return float(base**exponent)


def displacement_force(code: int, law: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the force of a law at the position `x`, whose memory has been advanced to it."""
    if code == POWER_STIFFNESS:
        if law[2] * x < 0.0 or x == 0.0:
            return 0.0
        force = law[0] * power(abs(x / law[3]), law[1])
        return float(force if x > 0.0 else -force)
    if code == FREE_PLAY:
        return float(-law[0] * min(max(x, -law[1]), law[1]))
    if code == MICRO_SLIP:
        count = int(law[1])
        total = 0.0
        for i in range(count):
            total += memory[HEAD + i]
        return float(law[0] * (total / count - x))
    if code == BOUC_WEN:
        return float(law[0] * (memory[HEAD] - x))
    return 0.0


def displacement_slope(code: int, law: FloatArray, slip: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the derivative of `displacement_force` by x, on the path that led to x."""
    if code == POWER_STIFFNESS:
        if law[2] * x < 0.0 or x == 0.0:
            return float(law[0] / law[3]) if law[1] == 1.0 and law[2] == 0.0 else 0.0
        return float(law[0] * law[1] / law[3] * power(abs(x / law[3]), law[1] - 1.0))
    if code == FREE_PLAY:
        return float(-law[0]) if abs(x) < law[1] else 0.0
    if code == MICRO_SLIP:
        count = int(law[1])
        free = 0
        for i in range(count):
            if abs(memory[HEAD + i]) >= slip[i]:
                free += 1
        return float(-law[0] * free / count)
    if code == BOUC_WEN:
        z = memory[HEAD] / law[1]
        loading = z * (x - memory[1]) >= 0.0
        return float(-law[0] * power(min(abs(z), 1.0), law[2])) if loading else 0.0
    return 0.0


def bouc_wen_path(law: FloatArray, begin: float, change: float, least: int) -> float:
    """Return the variable of Bouc and Wen after a way from its value at the begin, `least` parts or more."""
    width, order = law[1], law[2]
    z, rest = begin / width, change / width
    if z * rest < 0.0:  # unloading: dz = dx until z is zero
        part = rest if abs(rest) <= abs(z) else -z
        z += part
        rest -= part
    if rest != 0.0:  # loading: dz/dx = 1 - |z|^order, by the midpoint rule
        way = min(abs(rest), 2.0 + 40.0 / order)  # by then it yields to the last bit
        count = max(int(way * order / 0.2) + 1, least)
        h = way / count
        size = abs(z)
        for _ in range(count):
            middle = min(size + 0.5 * h * (1.0 - power(size, order)), 1.0)
            size = min(size + h * (1.0 - power(middle, order)), 1.0)
        z = size if rest > 0.0 else -size
    return float(z * width)


def advance_memory(
    code: int, law: FloatArray, slip: FloatArray, memory: FloatArray, x: float, least: int
) -> None:
    """Carry the memory of a hysteretic law from its last position to `x`, in at least `least` parts."""
    change = x - memory[1]
    memory[1] = x
    if code == MICRO_SLIP:
        for i in range(int(law[1])):
            stretch = memory[HEAD + i] + change
            memory[HEAD + i] = min(max(stretch, -slip[i]), slip[i])
    elif code == BOUC_WEN:
        memory[HEAD] = bouc_wen_path(law, memory[HEAD], change, least)


def damping_kick(speed: float, strength: float, exponent: float, duration: float) -> float:
    """Return the speed after s' = -`strength` |s|^`exponent` sgn s alone has acted for `duration`."""
    size = abs(speed)
    if size == 0.0 or (exponent > 1.0 and size < 1e-60):
        return speed
    if exponent == 1.0:
        return float(speed * np.exp(-strength * duration))
    if exponent == 2.0:
        return speed / (1.0 + strength * duration * size)
    if exponent == 0.0:
        size -= strength * duration
        return 0.0 if size <= 0.0 else (size if speed > 0.0 else -size)
    root = size ** (1.0 - exponent) - (1.0 - exponent) * strength * duration
    if root <= 0.0:
        return 0.0
    size = float(root ** (1.0 / (1.0 - exponent)))
    return size if speed > 0.0 else -size


def holding_limit(strength: float, exponent: float, duration: float) -> float:
    """Return the largest speed that `damping_kick` brings to rest within `duration` (exponent below one)."""
    if exponent == 0.0:
        return strength * duration
    return float(((1.0 - exponent) * strength * duration) ** (1.0 / (1.0 - exponent)))


def crossing(
    begin: float,
    end: float,
    slope_begin: float,
    slope_end: float,
    lost: float,
    strength: float,
    exponent: float,
    h: float,
) -> tuple[float, float, float]:
    """Return what must be added where the speed of a port changes sign within a step.

    Parameters
    ----------
    begin, end : float
        Speed at both ends as friction of the first sign would have it.
    slope_begin, slope_end : float
        Its derivatives.
    lost : float
        What the first half kick took from the speed.
    strength, exponent, h : float
        Of `damping_kick`; duration of the step.

    Returns
    -------
    speed : float
        To be added to the speed at the end.
    position : float
        To be added to the position at the end; or, if friction holds, the way from the step's begin to the
        turn.
    held : float
        1 if friction holds from the turn on.
    """
    sign = 1.0 if begin > 0.0 else -1.0
    a, b, m, n = begin, end, h * slope_begin, h * slope_end
    low, high = 0.0, 1.0
    for _ in range(40):  # bisection of the cubic through values and slopes
        u = 0.5 * (low + high)
        value = (
            a * (1.0 + u * u * (2.0 * u - 3.0))
            + m * u * (1.0 - u) * (1.0 - u)
            + b * u * u * (3.0 - 2.0 * u)
            + n * u * u * (u - 1.0)
        )
        if sign * value > 0.0:
            low = u
        else:
            high = u
    u = 0.5 * (low + high)
    slope = (6.0 * (b - a) * u * (1.0 - u) + m * (1.0 - u) * (1.0 - 3.0 * u) + n * u * (3.0 * u - 2.0)) / h
    before = max(-sign * slope, 0.0)
    free = -sign * (slope + 2.0 * lost / h)  # backwards acceleration without this friction
    if free <= 0.0 or 0.5 * h * free <= holding_limit(strength, exponent, 0.5 * h):
        u2 = u * u
        way = h * (
            a * (u - u2 * u + 0.5 * u2 * u2)
            + m * (0.5 * u2 - 2.0 / 3.0 * u2 * u + 0.25 * u2 * u2)
            + b * (u2 * u - 0.5 * u2 * u2)
            + n * (0.25 * u2 * u2 - u2 * u / 3.0)
        )
        if exponent == 0.0:
            way -= sign * (strength + max(free, 0.0)) * h * h / 12.0
        return 0.0, way, 1.0
    one = exponent + 1.0
    first, rest = u * h, (1.0 - u) * h
    drag, push = power(before, exponent), power(free, exponent)
    impulse = -sign * strength * (drag * first**one - push * rest**one) / one
    moment = (
        -sign
        * strength
        * (
            drag * (rest * first**one / one + first ** (one + 1.0) / (one + 1.0))
            - push * rest ** (one + 1.0) * (1.0 / one - 1.0 / (one + 1.0))
        )
    )
    if exponent == 0.0:
        # Half kicks at both ends of a step shift the position by force h^2 / 12. The shift is undone when
        # the force ends, but here the next force begins, of the other sign.
        moment -= sign * strength * h * h / 6.0
    return impulse + lost, moment + lost * h, 0.0


def damped_position(law: FloatArray, last: float, y: float, r: float, h: float) -> float:
    """Return x of x + r F(x, (x - `last`) / h) = y for damping: the root nearest to the last position."""
    way = abs(y - last)
    if way == 0.0:
        return last
    sign = 1.0 if y > last else -1.0
    p, a = law[1], law[2]
    if p == 0.0:
        level = r * law[0] * power(abs(last / law[4]), a)
        if way <= level:
            return last  # it sticks
        if a == 0.0:
            return float(y - sign * level)
    # how far it moves, u; for 0 < p < 1 by w = u^p, in which the force has a slope everywhere
    root = p if 0.0 < p < 1.0 else 1.0
    low, high = 0.0, power(way, root)
    w = high
    for _ in range(60):
        u = w if root == 1.0 else power(w, 1.0 / root)
        x = last + sign * u
        force = r * law[0] * power(u / (h * law[3]), p) * power(abs(x / law[4]), a)
        rest = u + force - way
        if abs(rest) <= 1e-13 * way or high - low <= 1e-15 * high:
            break
        if rest > 0.0:
            high = w
        else:
            low = w
        slope = 1.0
        if x != 0.0:
            slope += force * a * sign / x
        if root == 1.0:
            slope += force * p / u if u > 0.0 else 0.0
        else:
            slope = slope * u / (root * w) + force / w if w > 0.0 else 0.0
        step = w - rest / slope if slope > 0.0 else low
        w = step if low < step < high else 0.5 * (low + high)
    return float(last + sign * (w if root == 1.0 else power(w, 1.0 / root)))


def sprung_position(law: FloatArray, y: float, r: float) -> float:
    """Return x of x + r F(x) = y for a power stiffness: the root of the same sign as y next to zero load."""
    if y == 0.0 or law[2] * y < 0.0:
        return y
    n = law[1]
    size, stiff = abs(y), r * law[0] / law[3]
    sign = 1.0 if y > 0.0 else -1.0
    if n == 1.0:
        return y / (1.0 + stiff) if stiff > -1.0 else y
    x = size
    low, high = 0.0, size
    if stiff < 0.0:
        low, high = size, 1e300
        if n < 1.0:  # beyond the root, from where Newton's steps come down to it
            x = 2.0 * size + law[3] * (-2.0 * stiff) ** (1.0 / (1.0 - n))
    for _ in range(60):
        force = stiff * law[3] * power(x / law[3], n)
        rest = x + force - size
        if abs(rest) <= 1e-14 * (x + size):
            break
        if rest > 0.0:
            high = x
        else:
            low = x
        slope = 1.0 + n * force / x
        if slope <= 0.0:
            break  # softer than the flexibility beside it can hold
        step = x - rest / slope
        x = step if low < step < high else 0.5 * (low + min(high, 2.0 * x + size))
    return sign * x


def slipped_position(
    law: FloatArray, slip: FloatArray, memory: FloatArray, y: float, r: float, force: float
) -> float:
    """Return x of x + r F(x) = y for micro-slip; F is linear between the positions where elements slip."""
    count = int(law[1])
    last, share = memory[1], r * law[0] / law[1]
    slope = 1.0
    x = y - r * force
    for turn in range(24):
        total = 0.0
        moving = 0
        change = x - last
        for i in range(count):
            stretch = memory[HEAD + i] + change
            total += min(max(stretch, -slip[i]), slip[i])
            if abs(stretch) >= slip[i]:
                moving += 1
        rest = x + share * (total - count * x) - y
        if abs(rest) <= 1e-12 * (abs(x) + slip[0]):
            break
        slope = 1.0 - share * moving
        # the largest slope never goes too far
        x -= rest / (slope if slope > 1e-6 and turn < 12 else 1.0)
    return x


def yielded_position(
    law: FloatArray, memory: FloatArray, y: float, r: float, force: float, least: int
) -> float:
    """Return x of x + r F(x) = y for the law of Bouc and Wen."""
    last, share = memory[1], r * law[0]
    x = y - r * force
    for turn in range(24):
        z = bouc_wen_path(law, memory[HEAD], x - last, least)
        rest = x + share * (z - x) - y
        if abs(rest) <= 1e-11 * (abs(x) + law[1]):
            break
        slope = 1.0
        if z * (x - last) > 0.0:
            slope -= share * power(min(abs(z) / law[1], 1.0), law[2])
        x -= rest / (slope if slope > 1e-6 and turn < 12 else 1.0)
    return x


def law_position(
    code: int,
    law: FloatArray,
    slip: FloatArray,
    memory: FloatArray,
    y: float,
    r: float,
    h: float,
    force: float,
    least: int,
) -> float:
    """Return the position x of a law's port, x + r F(x) = y, reached from the state of its memory.

    Parameters
    ----------
    code, law, slip, memory
        The law; its memory is left as it is.
    y : float
        Position without the force.
    r : float
        Flexibility, zero or positive.
    h : float
        Duration of the way, for damping [s].
    force : float
        About the force.
    least : int
        Parts of the way, see `advance_memory`.
    """
    if code == POWER_DAMPING:
        return damped_position(law, memory[1], y, r, h)
    if r == 0.0:
        return y
    if code == POWER_STIFFNESS:
        return sprung_position(law, y, r)
    if code == FREE_PLAY:
        within = 1.0 - r * law[0]
        if abs(y) < within * law[1]:
            return float(y / within)
        return float(y + r * law[0] * (law[1] if y > 0.0 else -law[1]))
    if code == MICRO_SLIP:
        return slipped_position(law, slip, memory, y, r, force)
    return yielded_position(law, memory, y, r, force, least)


def law_pull(
    code: int, law: FloatArray, slip: FloatArray, memory: FloatArray, x: float, h: float, least: int
) -> tuple[float, float]:
    """Return force and slope of a law at `x`, reached within `h` from the state of its memory.

    Of dry friction the largest force, as if it moved forwards.
    """
    if code == POWER_DAMPING:
        way = abs(x - memory[1])
        size = law[0] * power(abs(x / law[4]), law[2])
        if law[1] == 0.0:
            return size, (size * law[2] / x if x != 0.0 else 0.0)
        if way == 0.0:
            return 0.0, (size / (h * law[3]) if law[1] == 1.0 else 0.0)
        size *= power(way / (h * law[3]), law[1])
        slope = size * law[1] / way
        if x < memory[1]:
            size = -size
        return size, (slope + size * law[2] / x if x != 0.0 else slope)
    if code == MICRO_SLIP:
        count = int(law[1])
        total = 0.0
        moving = 0
        for i in range(count):
            stretch = memory[HEAD + i] + x - memory[1]
            total += min(max(stretch, -slip[i]), slip[i])
            if abs(stretch) >= slip[i]:
                moving += 1
        return law[0] * (total / count - x), -law[0] * moving / count
    if code == BOUC_WEN:
        z = bouc_wen_path(law, memory[HEAD], x - memory[1], least)
        loading = z * (x - memory[1]) > 0.0
        slope = -law[0] * power(min(abs(z) / law[1], 1.0), law[2]) if loading else 0.0
        return law[0] * (z - x), slope
    return displacement_force(code, law, memory, x), displacement_slope(code, law, slip, memory, x)


def settle(
    port: int,
    leader: IntArray,
    codes: IntArray,
    laws: FloatArray,
    slips: FloatArray,
    memory: FloatArray,
    y: float,
    r: float,
    h: float,
    least: int,
    current: FloatArray,
) -> float:
    """Return the position x of a port with laws, x + r sum F(x) = y; their forces go to `current`.

    The laws are those whose `leader` is `port`.

    Dry friction first: where it can hold the port, it does. The memories are left as they are.
    """
    count = len(codes)
    last = memory[port, 1]
    start, level = 0.0, 0.0
    for j in range(count):
        if leader[j] != port:
            continue
        force, _ = law_pull(codes[j], laws[j], slips[j], memory[j], last, h, least)
        if codes[j] == POWER_DAMPING and laws[j, 1] == 0.0:
            level += force
        else:
            current[j] = force
            start += force
    push = y - last - r * start
    if level > 0.0 and abs(push) <= r * level:
        for j in range(count):
            if leader[j] == port and codes[j] == POWER_DAMPING and laws[j, 1] == 0.0:
                own, _ = law_pull(codes[j], laws[j], slips[j], memory[j], last, h, least)
                current[j] = push / r * own / level
        return float(last)
    sign = 1.0 if push > 0.0 else -1.0
    # the root lies that way from the last position, if the structure is stable
    low, high = last, last + sign * 1e300
    x = last + sign * max(abs(push) - r * level, 0.0)
    for _ in range(80):
        total, slope = 0.0, 1.0
        for j in range(count):
            if leader[j] != port:
                continue
            force, change = law_pull(codes[j], laws[j], slips[j], memory[j], x, h, least)
            if codes[j] == POWER_DAMPING and laws[j, 1] == 0.0:
                force, change = sign * force, sign * change
            current[j] = force
            total += force
            slope += r * change
        rest = x + r * total - y
        if abs(rest) <= 1e-12 * (abs(x) + abs(y)) or abs(high - low) <= 1e-15 * abs(x):
            break
        if sign * rest > 0.0:
            high = x
        else:
            low = x
        step = x - rest / slope if slope > 1e-6 else high
        if sign * (step - low) > 0.0 and sign * (high - step) > 0.0:
            x = step
        elif abs(high) < 1e299:
            x = 0.5 * (low + high)
        else:
            x += sign * abs(rest)
    return float(x)


def integrate(
    transition: FloatArray,
    coupled: bool,
    drive_begin: FloatArray,
    drive_end: FloatArray,
    drive_constant: FloatArray,
    stiffness: FloatArray,
    damping: FloatArray,
    shape: FloatArray,
    constant: FloatArray,
    ports: FloatArray,
    codes: IntArray,
    laws: FloatArray,
    slips: FloatArray,
    flexibility: FloatArray,
    relaxation: float,
    feed: FloatArray,
    known: bool,
    rate: float,
    start: float,
    h: float,
    substeps: int,
    force: FloatArray,
    q: FloatArray,
    v: FloatArray,
    memory: FloatArray,
    q_out: FloatArray,
    v_out: FloatArray,
    force_out: FloatArray,
    lagged_out: FloatArray,
) -> None:
    """Integrate over the samples of `force`; `q`, `v` and `memory` are changed in place.

    Parameters
    ----------
    transition, drive_begin, drive_end, drive_constant : (2M, 2M), (2M,), (2M,), (2M,) ndarray
        Exact linear step of (q, v) over `h`: from the state, from the force at its begin and at its end
        [1/N], and from the constant (`fe.motion.linear_step`).
    coupled : bool
        Whether `transition` couples modes.
    stiffness : (M,) ndarray
        Squared angular frequencies [1/s^2].
    damping : (M, M) ndarray
        D [1/s].
    shape, constant : (M,) ndarray
        b and c.
    ports : (J, M) ndarray
        Row of the port that each law acts on.
    codes : (J,) ndarray of int
        Laws.
    laws : (J, 5) ndarray
        Their parameters.
    slips : (J, E) ndarray
        Slip displacements of the elements.
    flexibility : (J,) ndarray
        R: position of each law's port by a unit force there that the modes do not hold; laws with the same
        `ports` have the same, or zero, which leaves a law to the modes.
    relaxation : float
        beta of that flexibility [s].
    feed : (2, J) ndarray
        What the modes do not hold of the ports' positions by the force f = 1, and by the constant force.
    known : bool
        Whether `memory` is that of a state; otherwise each law is loaded from zero to its first position.
    rate : float
        Stiffness drift [1/s].
    start : float
        Time of the first sample [s].
    h : float
        Length of a substep [s].
    substeps : int
        For each sample.
    force : (N,) ndarray
        f at the samples [N].
    q, v : (M,) ndarray
        State at the first sample; at the last one on return.
    memory : (J, 2 + E) ndarray
        Of the laws.
    q_out, v_out, force_out, lagged_out : (N, M), (N, M), (N, J), (N, J) ndarray
        Results at the samples; forces of the laws F_j, and D_j (F_j for a port without R).
    """
    count, modes, laws_count = len(force), len(q), len(codes)
    half = 0.5 * h
    weight = np.zeros(laws_count)  # p.p
    pull = np.zeros((laws_count, modes))  # change of the modes for one unit of change at the port
    strength = np.zeros(laws_count)  # of damping, for the port's speed
    answer = np.zeros((laws_count, 2 * modes))  # state after the step to a unit kick at its begin
    give = np.zeros(laws_count)  # its position at the port
    current = np.zeros(laws_count)
    before = np.zeros(laws_count)
    begin = np.zeros(laws_count)
    lost = np.zeros(laws_count)
    fresh = np.zeros(laws_count)
    q_new, v_new = np.zeros(modes), np.zeros(modes)
    q_old, v_old = np.zeros(modes), np.zeros(modes)
    flexible = np.zeros(laws_count, dtype=np.int64)
    leader = np.full(laws_count, -1)  # the first law at the same flexible port
    for j in range(laws_count):
        moves = False
        for m in range(modes):
            moves = moves or ports[j, m] != 0.0
        if moves and flexibility[j] > 0.0:
            flexible[j] = 1
            for k in range(j, -1, -1):
                same = flexible[k] == 1
                for m in range(modes):
                    same = same and ports[j, m] == ports[k, m]
                if same:
                    leader[j] = k
    lone = laws_count == 1 and flexible[0] == 1
    keep = relaxation / (relaxation + h)
    ease = 1.0 - keep
    at_once = 1.0 if relaxation == 0.0 or not known else 0.0
    for j in range(laws_count):
        x = 0.0
        speed = 0.0
        for m in range(modes):
            weight[j] += ports[j, m] * ports[j, m]
            x += ports[j, m] * q[m]
            speed += ports[j, m] * v[m]
        if weight[j] == 0.0:
            continue  # the port does not move
        for m in range(modes):
            pull[j, m] = ports[j, m] / weight[j]
        if flexible[j] == 1:
            if codes[j] == POWER_DAMPING and known:
                current[j] = memory[j, 4]
            elif codes[j] == POWER_DAMPING:  # moving steadily
                current[j] = laws[j, 0] * power(abs(x / laws[j, 4]), laws[j, 2])
                current[j] *= power(abs(speed) / laws[j, 3], laws[j, 1]) * np.sign(speed)
                memory[j, 2] = current[j]
        elif codes[j] == POWER_DAMPING:
            strength[j] = weight[j] * laws[j, 0] / power(laws[j, 3], laws[j, 1])
            for m in range(2 * modes):
                for k in range(modes):
                    answer[j, m] += transition[m, modes + k] * ports[j, k]
            for m in range(modes):
                give[j] += ports[j, m] * answer[j, m]
            if laws[j, 1] < 1.0 and speed == 0.0 and laws[j, 0] > 0.0:
                memory[j, 0] = 1.0
                memory[j, 1] = x
        else:
            if codes[j] == MICRO_SLIP or codes[j] == BOUC_WEN:
                advance_memory(codes[j], laws[j], slips[j], memory[j], x, FIRST_PARTS)
            current[j] = displacement_force(codes[j], laws[j], memory[j], x)
    for port in range(laws_count):
        if leader[port] != port:  # one law for each flexible port
            continue
        y = feed[0, port] * force[0] + feed[1, port] + memory[port, 3]
        for m in range(modes):
            y += ports[port, m] * q[m]
        springs = -1
        springy = np.full(laws_count, -1)
        for j in range(laws_count):
            if leader[j] != port:
                continue
            damped = codes[j] == POWER_DAMPING
            y -= flexibility[port] * memory[j, 2] * (1.0 if damped else 1.0 - at_once)
            if not damped:
                springs = j if springs < 0 else springs
                springy[j] = springs
        x = y
        if springs >= 0:
            r = at_once * flexibility[port]
            x = settle(springs, springy, codes, laws, slips, memory, y, r, h, FIRST_PARTS, current)
        for j in range(laws_count):
            if leader[j] != port:
                continue
            if codes[j] != POWER_DAMPING:
                advance_memory(codes[j], laws[j], slips[j], memory[j], x, FIRST_PARTS)
                current[j] = displacement_force(codes[j], laws[j], memory[j], x)
                if at_once == 1.0:
                    memory[j, 2] = current[j]
            elif not known:
                memory[j, 1] = x
    lone_law, lone_slip, lone_memory = laws[0:1].ravel(), slips[0:1].ravel(), memory[0:1].reshape(-1)
    driven = False
    for sample in range(count):
        driven = driven or force[sample] != 0.0
    for sample in range(count):
        for part in range(substeps if sample > 0 else 0):
            time = start + ((sample - 1) * substeps + part) * h
            share = part / substeps
            force_begin = force[sample - 1] + (force[sample] - force[sample - 1]) * share
            force_end = force[sample - 1] + (force[sample] - force[sample - 1]) * (part + 1) / substeps
            # ---- first half of the internal forces
            for j in range(laws_count):
                before[j] = current[j]
            for m in range(modes):
                q_old[m] = q[m]
                v_old[m] = v[m]
            for j in range(laws_count):
                if codes[j] != POWER_DAMPING or weight[j] == 0.0 or flexible[j] == 1:
                    continue
                fresh[j] = 0.0
                lost[j] = 0.0
                speed = 0.0
                x = 0.0
                for m in range(modes):
                    speed += ports[j, m] * v[m]
                    x += ports[j, m] * q[m]
                begin[j] = speed
                if memory[j, 0] == 1.0:
                    continue
                now = strength[j] * power(abs(x / laws[j, 4]), laws[j, 2])
                if laws[j, 1] == 0.0:  # not stopped at zero: the turn is looked for after the step
                    after = speed - half * now if speed > 0.0 else speed + half * now
                    if speed == 0.0:
                        after = 0.0
                else:
                    after = damping_kick(speed, now, laws[j, 1], half)
                lost[j] = speed - after
                for m in range(modes):
                    v[m] -= pull[j, m] * lost[j]
            for j in range(laws_count):
                if current[j] != 0.0:
                    for m in range(modes):
                        v[m] -= ports[j, m] * current[j] * half
            if rate != 0.0:
                for m in range(modes):
                    v[m] -= half * rate * time * stiffness[m] * q[m]
            # ---- linear motion, exact
            if coupled:
                for m in range(modes):
                    total_q = drive_constant[m] + drive_begin[m] * force_begin + drive_end[m] * force_end
                    i = modes + m
                    total_v = drive_constant[i] + drive_begin[i] * force_begin + drive_end[i] * force_end
                    for k in range(modes):
                        total_q += transition[m, k] * q[k] + transition[m, modes + k] * v[k]
                        total_v += transition[i, k] * q[k] + transition[i, modes + k] * v[k]
                    q_new[m] = total_q
                    v_new[m] = total_v
                for m in range(modes):
                    q[m] = q_new[m]
                    v[m] = v_new[m]
            else:
                for m in range(modes):
                    i = modes + m
                    total_q = transition[m, m] * q[m] + transition[m, i] * v[m] + drive_constant[m]
                    total_v = transition[i, m] * q[m] + transition[i, i] * v[m] + drive_constant[i]
                    if driven:
                        total_q += drive_begin[m] * force_begin + drive_end[m] * force_end
                        total_v += drive_begin[i] * force_begin + drive_end[i] * force_end
                    q[m] = total_q
                    v[m] = total_v
            # ---- ports that friction holds: the impulse at the begin that keeps them in place
            for j in range(laws_count):
                if codes[j] != POWER_DAMPING or memory[j, 0] != 1.0 or weight[j] == 0.0 or flexible[j] == 1:
                    continue
                x = 0.0
                for m in range(modes):
                    x += ports[j, m] * q[m]
                now = strength[j] * power(abs(memory[j, 1] / laws[j, 4]), laws[j, 2])
                limit = holding_limit(now, laws[j, 1], half)
                kick = (memory[j, 1] - x) / give[j]
                if abs(kick) * weight[j] > limit:
                    memory[j, 0] = 0.0
                    fresh[j] = 1.0
                    kick = (limit if kick > 0.0 else -limit) / weight[j]
                for m in range(modes):
                    q[m] += answer[j, m] * kick
                    v[m] += answer[j, modes + m] * kick
            # ---- laws on flexible ports: forces at the step's end
            if lone:  # without slices, which cost as much as the law itself
                lone_memory[3] *= keep
                y = feed[0, 0] * force_end + feed[1, 0] + lone_memory[3]
                y -= flexibility[0] * keep * lone_memory[2]
                for m in range(modes):
                    y += ports[0, m] * q[m]
                r = ease * flexibility[0]
                code = codes[0]
                x = law_position(code, lone_law, lone_slip, lone_memory, y, r, h, current[0], 1)
                if code == POWER_DAMPING:
                    if lone_law[1] == 0.0 and x != lone_memory[1]:
                        level = lone_law[0] * power(abs(x / lone_law[4]), lone_law[2])
                        current[0] = level if x > lone_memory[1] else -level
                    else:
                        current[0] = (y - x) / r
                    lone_memory[1] = x
                    lone_memory[4] = current[0]
                elif code == BOUC_WEN and r * lone_law[0] > 0.01:  # the solution holds force and memory
                    current[0] = (y - x) / r
                    lone_memory[HEAD] = x + current[0] / lone_law[0]
                    lone_memory[1] = x
                else:
                    if code in (MICRO_SLIP, BOUC_WEN):
                        advance_memory(code, lone_law, lone_slip, lone_memory, x, 1)
                    if code == MICRO_SLIP and r * lone_law[0] > 0.01:
                        current[0] = (y - x) / r
                    else:
                        current[0] = displacement_force(code, lone_law, lone_memory, x)
                    lone_memory[1] = x
                lone_memory[2] = keep * lone_memory[2] + ease * current[0]
                for m in range(modes):
                    v[m] -= ports[0, m] * current[0] * half
            else:
                for port in range(laws_count):
                    if leader[port] != port:
                        continue
                    y = feed[0, port] * force_end + feed[1, port] + keep * memory[port, 3]
                    for m in range(modes):
                        y += ports[port, m] * q[m]
                    for j in range(laws_count):
                        if leader[j] == port:
                            y -= flexibility[port] * keep * memory[j, 2]
                    r = ease * flexibility[port]
                    x = settle(port, leader, codes, laws, slips, memory, y, r, h, 1, current)
                    for j in range(laws_count):
                        if leader[j] != port:
                            continue
                        if codes[j] == POWER_DAMPING:
                            memory[j, 1] = x
                            memory[j, 4] = current[j]
                        else:
                            advance_memory(codes[j], laws[j], slips[j], memory[j], x, 1)
                            current[j] = displacement_force(codes[j], laws[j], memory[j], x)
                        memory[j, 2] = keep * memory[j, 2] + ease * current[j]
                        memory[j, 3] *= keep
                        for m in range(modes):
                            v[m] -= ports[j, m] * current[j] * half
            # ---- second half
            for j in range(laws_count):
                if codes[j] == POWER_DAMPING or weight[j] == 0.0 or flexible[j] == 1:
                    continue
                x = 0.0
                for m in range(modes):
                    x += ports[j, m] * q[m]
                if codes[j] == MICRO_SLIP or codes[j] == BOUC_WEN:
                    advance_memory(codes[j], laws[j], slips[j], memory[j], x, 1)
                current[j] = displacement_force(codes[j], laws[j], memory[j], x)
                for m in range(modes):
                    v[m] -= ports[j, m] * current[j] * half
            if rate != 0.0:
                for m in range(modes):
                    v[m] -= half * rate * (time + h) * stiffness[m] * q[m]
            for j in range(laws_count - 1, -1, -1):
                if codes[j] != POWER_DAMPING or weight[j] == 0.0 or flexible[j] == 1:
                    continue
                x = 0.0
                speed = 0.0
                for m in range(modes):
                    x += ports[j, m] * q[m]
                    speed += ports[j, m] * v[m]
                exponent = laws[j, 1]
                if memory[j, 0] == 1.0:
                    now = strength[j] * power(abs(memory[j, 1] / laws[j, 4]), laws[j, 2])
                    limit = holding_limit(now, exponent, half)
                    taken = speed
                    if abs(speed) > limit:
                        taken = limit if speed > 0.0 else -limit
                        memory[j, 0] = 0.0
                    for m in range(modes):
                        v[m] -= pull[j, m] * taken
                    continue
                now = strength[j] * power(abs(x / laws[j, 4]), laws[j, 2])
                end = speed - lost[j]
                if exponent < 1.0 and fresh[j] == 0.0 and begin[j] != 0.0 and begin[j] * end <= 0.0:
                    slope_begin = -2.0 * lost[j] / h
                    slope_end = -2.0 * lost[j] / h
                    for m in range(modes):
                        first = shape[m] * force_begin + constant[m]
                        last = shape[m] * force_end + constant[m]
                        first -= stiffness[m] * (1.0 + rate * time) * q_old[m]
                        last -= stiffness[m] * (1.0 + rate * (time + h)) * q[m]
                        for k in range(modes):
                            first -= damping[m, k] * v_old[k]
                            last -= damping[m, k] * v[k]
                        for k in range(laws_count):
                            first -= ports[k, m] * before[k]
                            last -= ports[k, m] * current[k]
                        slope_begin += ports[j, m] * first
                        slope_end += ports[j, m] * last
                    d_speed, d_position, held = crossing(
                        begin[j], end, slope_begin, slope_end, lost[j], now, exponent, h
                    )
                    if held == 1.0:
                        d_speed = -speed
                        position = d_position - x
                        for m in range(modes):
                            position += ports[j, m] * q_old[m]
                        d_position = position
                        memory[j, 0] = 1.0
                        memory[j, 1] = x + position
                    for m in range(modes):
                        q[m] += pull[j, m] * d_position
                        v[m] += pull[j, m] * d_speed
                else:
                    after = damping_kick(speed, now, exponent, half)
                    if after == 0.0 and exponent < 1.0 and now > 0.0:
                        memory[j, 0] = 1.0
                        memory[j, 1] = x
                    for m in range(modes):
                        v[m] -= pull[j, m] * (speed - after)
        for m in range(modes):
            q_out[sample, m] = q[m]
            v_out[sample, m] = v[m]
        time = start + sample * substeps * h
        for j in range(laws_count):
            force_out[sample, j] = current[j]
            lagged_out[sample, j] = memory[j, 2] if flexible[j] == 1 else current[j]
            if codes[j] != POWER_DAMPING or weight[j] == 0.0 or flexible[j] == 1:
                continue
            x = 0.0
            speed = 0.0
            for m in range(modes):
                x += ports[j, m] * q[m]
                speed += ports[j, m] * v[m]
            most = strength[j] * power(abs(x / laws[j, 4]), laws[j, 2]) / weight[j]
            if memory[j, 0] == 1.0:  # what it takes to hold the port
                need = 0.0
                for m in range(modes):
                    push = shape[m] * force[sample] + constant[m] - stiffness[m] * (1.0 + rate * time) * q[m]
                    for k in range(modes):
                        push -= damping[m, k] * v[k]
                    for k in range(laws_count):
                        if codes[k] != POWER_DAMPING or flexible[k] == 1:
                            push -= ports[k, m] * current[k]
                    need += ports[j, m] * push / weight[j]
                force_out[sample, j] = min(max(need, -most), most) if laws[j, 1] == 0.0 else need
            elif speed != 0.0:
                size = most * power(abs(speed), laws[j, 1])
                force_out[sample, j] = size if speed > 0.0 else -size
            lagged_out[sample, j] = force_out[sample, j]


def static_forces(
    x: FloatArray,
    codes: IntArray,
    laws: FloatArray,
    slips: FloatArray,
    memory: FloatArray,
    parts: IntArray,
    force: FloatArray,
    slope: FloatArray,
) -> FloatArray:
    """Return the memory at positions `x` (J,) reached from `memory`; `force` and `slope` (J,) are filled.

    `parts` (J,) is the least number of parts in which a hysteretic law follows the way; damping is zero at
    rest.
    """  # fmt: skip
    reached = memory.copy()
    for j in range(len(codes)):
        force[j] = 0.0
        slope[j] = 0.0
        if codes[j] != POWER_DAMPING:
            advance_memory(codes[j], laws[j], slips[j], reached[j], x[j], parts[j])
            force[j] = displacement_force(codes[j], laws[j], reached[j], x[j])
            if codes[j] == BOUC_WEN:  # loading or unloading is seen from where the way began
                reached[j, 1] = memory[j, 1]
            slope[j] = displacement_slope(codes[j], laws[j], slips[j], reached[j], x[j])
        reached[j, 1] = x[j]
        reached[j, 2] = force[j]
        reached[j, 3] = 0.0
        reached[j, 4] = 0.0
    return reached


def static_path(
    linear: FloatArray,
    compliance: FloatArray,
    codes: IntArray,
    laws: FloatArray,
    slips: FloatArray,
    memory: FloatArray,
    start: FloatArray,
    positions: FloatArray,
    forces: FloatArray,
) -> int:
    """Solve x + C F(x) = x_linear for load levels one after the other; `memory` is advanced in place.

    Newton's method with halved steps; a level that it does not reach is approached in up to 256 parts.

    Parameters
    ----------
    linear : (L, J) ndarray
        Positions of the ports without internal forces.
    compliance : (J, J) ndarray
        C, positions of the ports under unit forces at them.
    codes, laws, slips : ndarray
        As in `integrate`.
    memory : (J, 2 + E) ndarray
        State at the start.
    start : (J,) ndarray
        Linear positions at the start; zero at rest without load.
    positions, forces : (L, J) ndarray
        Results.

    Returns
    -------
    int
        -1, or the number of the level that has no solution.
    """
    levels, count = linear.shape
    old = start.copy()
    x = memory[:, 1].copy()
    force, slope = np.zeros(count), np.zeros(count)
    trial_force, trial_slope = np.zeros(count), np.zeros(count)
    parts = np.zeros(count, dtype=np.int64)
    for level in range(levels):
        done, step = 0.0, 1.0
        while done < 1.0:
            goal = old + (linear[level] - old) * min(done + step, 1.0)
            scale = np.max(np.abs(goal)) + np.max(np.abs(x)) + 1e-300
            for j in range(count):  # fixed during the iteration, so that the force is a smooth function
                parts[j] = 1
                if codes[j] == BOUC_WEN:
                    way = abs(goal[j] - x[j]) / laws[j, 1]
                    parts[j] = int(min(way * laws[j, 2] * 20.0, 2000.0)) + 4
            guess = x.copy()
            reached = static_forces(guess, codes, laws, slips, memory, parts, force, slope)
            residual = guess + compliance @ force - goal
            size = np.max(np.abs(residual))
            found = size <= 1e-12 * scale
            for _ in range(60):
                if found:
                    break
                matrix = np.eye(count) + compliance * slope
                for j in range(count):  # a singular matrix is moved off its zero
                    matrix[j, j] += 1e-14
                move = np.linalg.solve(matrix, residual)
                fraction = 1.0
                better = False
                for _ in range(12):
                    candidate = guess - fraction * move
                    trial = static_forces(
                        candidate, codes, laws, slips, memory, parts, trial_force, trial_slope
                    )
                    trial_residual = candidate + compliance @ trial_force - goal
                    trial_size = np.max(np.abs(trial_residual))
                    if trial_size < size:
                        better = True
                        break
                    fraction *= 0.5
                if not better:
                    break
                guess, reached, residual, size = candidate, trial, trial_residual, trial_size
                force[:] = trial_force
                slope[:] = trial_slope
                found = size <= 1e-12 * scale
            if not found and size <= 1e-9 * scale:
                found = True  # rounding, or a kink met exactly
            # A solution that is not stable lies on another branch, beyond a snap.
            if found and np.linalg.det(np.eye(count) + compliance * slope) <= -1e-9:
                found = False
            if found:
                x[:] = guess
                memory[:] = reached
                done = min(done + step, 1.0)
                step *= 2.0
            else:
                step *= 0.5
                if step < 1.0 / 256.0:
                    return level
        old[:] = linear[level]
        positions[level] = x
        forces[level] = force
    return -1


def kernel() -> dict[str, Any]:
    """Return the uncompiled functions that callers use, by name."""
    return {"integrate": integrate, "static_path": static_path}
