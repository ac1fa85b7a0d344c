"""Motion of a few modes with internal forces at ports: loops over numbers, and nothing else.

q'' + D q' + W^2 (1 + r t) q = b f(t) + c - sum_j p_j F_j(p_j . q, p_j . v, memory_j). The linear part is
advanced exactly (matrix exponential, force linear between samples); internal forces are split off
symmetrically (Strang 1968): damping, displacement forces, linear motion, displacement forces, damping.
Damping kicks have a closed form. Where friction turns over inside a step, the impulse and its first moment
are corrected for the moment of the turn; where it holds, the port is held in place by the impulses that this
needs, as long as friction can give them.

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
HEAD = 2
"""Columns of a memory before its hysteretic elements: 1 if friction holds the port; its last position."""

FIRST_PARTS = 400
"""Parts in which the way from a law's last position to the first one of a motion is followed."""

COMPILED = (
    "power", "displacement_force", "displacement_slope", "advance_memory", "damping_kick", "holding_limit",
    "crossing", "integrate", "static_forces", "static_path",
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
        width, order = law[1], law[2]
        z, rest = memory[HEAD] / width, change / width
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
        memory[HEAD] = z * width


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
    q_out, v_out, force_out : (N, M), (N, M), (N, J) ndarray
        Results at the samples; forces of the laws F_j.
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
        if codes[j] == POWER_DAMPING:
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
                if codes[j] != POWER_DAMPING or weight[j] == 0.0:
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
                if codes[j] != POWER_DAMPING or memory[j, 0] != 1.0 or weight[j] == 0.0:
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
            # ---- second half
            for j in range(laws_count):
                if codes[j] == POWER_DAMPING or weight[j] == 0.0:
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
                if codes[j] != POWER_DAMPING or weight[j] == 0.0:
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
            if codes[j] != POWER_DAMPING or weight[j] == 0.0:
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
                        if codes[k] != POWER_DAMPING:
                            push -= ports[k, m] * current[k]
                    need += ports[j, m] * push / weight[j]
                force_out[sample, j] = min(max(need, -most), most) if laws[j, 1] == 0.0 else need
            elif speed != 0.0:
                size = most * power(abs(speed), laws[j, 1])
                force_out[sample, j] = size if speed > 0.0 else -size


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
