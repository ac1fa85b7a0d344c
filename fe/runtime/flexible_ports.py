"""Laws at ports that lie on flexibility R which the modes of a motion leave out.

x = p . q - R D + e, where D is the force of the laws there after a lag, beta D' + D = F (the lag of damping
in proportion to the stiffness; backward Euler), and e what loads add. The force of a law is that at the
step's end, where it obeys the law at its own position: a monotone equation in one unknown. Dry friction is
then an elasto-plastic element of stiffness 1/R.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file is copied
into the FMU.
"""

from .laws import advance, dry, pull
from .motion_arrays import FIRST_PARTS, Acting, IntArray, Ports, State, add, at_port


def begin_flexible(ports: Ports, acting: Acting, state: State, h: float, known: bool) -> None:
    """Take the laws on flexible ports to the first sample; without a known memory they follow at once."""
    count = len(ports.numbers)
    at_once = 1.0 if ports.relaxation == 0.0 or not known else 0.0
    for port in range(count):
        if acting.leader[port] != port:  # one law for each flexible port
            continue
        y = ports.feed[port] + state.memory[port, 3]
        y += at_port(ports.rows, port, state.q)
        springs = -1
        for j in range(count):
            acting.springs[j] = -1
            if acting.leader[j] != port:
                continue
            damped = ports.of_speed[j] == 1
            y -= ports.flexibility[port] * state.memory[j, 2] * (1.0 if damped else 1.0 - at_once)
            if not damped:
                springs = j if springs < 0 else springs
                acting.springs[j] = springs
                last = state.memory[j, 1]
                state.current[j], _ = pull_of(ports, state, j, last, h, FIRST_PARTS)
        x = y
        if springs >= 0:
            r = at_once * ports.flexibility[port]
            x = settle_port(springs, acting.springs, ports, state, y, r, h, FIRST_PARTS)
        for j in range(count):
            if acting.leader[j] != port:
                continue
            if ports.of_speed[j] == 0:
                arrive(ports, state, j, x, FIRST_PARTS)
                if at_once == 1.0:
                    state.memory[j, 2] = state.current[j]
            elif not known:
                state.memory[j, 1] = x


def arrive(ports: Ports, state: State, j: int, x: float, least: int) -> None:
    """Carry the memory of a law of position to `x`, where its force is known."""
    advance(ports.numbers[j], ports.values[j], ports.elements[j], state.memory[j], x, least)
    state.memory[j, 1] = x


def carry_flexible(ports: Ports, acting: Acting, state: State, h: float) -> None:
    """Carry the laws on flexible ports to the step's end, and give the second half of their impulse."""
    count = len(ports.numbers)
    keep = ports.relaxation / (ports.relaxation + h)
    ease = 1.0 - keep
    for port in range(count):
        if acting.leader[port] != port:
            continue
        y = ports.feed[port] + keep * state.memory[port, 3]
        y += at_port(ports.rows, port, state.q)
        for j in range(count):
            if acting.leader[j] == port:
                y -= ports.flexibility[port] * keep * state.memory[j, 2]
        x = settle_port(port, acting.leader, ports, state, y, ease * ports.flexibility[port], h, 1)
        for j in range(count):
            if acting.leader[j] != port:
                continue
            if ports.of_speed[j] == 1:
                state.memory[j, 1] = x
                state.memory[j, 4] = state.current[j]
            else:
                arrive(ports, state, j, x, 1)
            state.memory[j, 2] = keep * state.memory[j, 2] + ease * state.current[j]
            state.memory[j, 3] *= keep
            add(state.v, ports.rows[j], -state.current[j], 0.5 * h)


def pull_of(ports: Ports, state: State, j: int, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope of a law at `x`, its memory left as it is."""
    return pull(ports.numbers[j], ports.values[j], ports.elements[j], state.memory[j], x, h, least)  # type: ignore[no-any-return]


def settle_port(
    port: int, leader: IntArray, ports: Ports, state: State, y: float, r: float, h: float, least: int
) -> float:
    """Return the position x of a port with laws, x + r sum F(x) = y; their forces go to `state.current`.

    The laws are those whose `leader` is `port`; of those of position, `state.current` has the forces at the
    last position. Dry friction first: where it can hold the port, it does. The memories are left as they are.
    """
    count = len(ports.numbers)
    last = state.memory[port, 1]
    start, level, tolerance = 0.0, 0.0, 1e-12
    for j in range(count):
        if leader[j] != port:
            continue
        if ports.of_speed[j] == 0:
            start += state.current[j]
            continue
        tolerance = 1e-15  # a speed is a small difference of positions
        state.current[j] = 0.0
        if dry(ports.numbers[j], ports.values[j]):
            own, _ = pull_of(ports, state, j, last, h, least)
            level += own
    push = y - last - r * start
    if level > 0.0 and abs(push) <= r * level:
        for j in range(count):
            if leader[j] == port and dry(ports.numbers[j], ports.values[j]):
                own, _ = pull_of(ports, state, j, last, h, least)
                state.current[j] = push / r * own / level
        return float(last)
    sign = 1.0 if push > 0.0 else -1.0
    # the root lies that way from the last position, if the structure is stable
    low, high = last, last + sign * 1e300
    x, rest, steep = last + sign * max(abs(push) - r * level, 0.0), 0.0, port
    at = x
    for _ in range(80):
        total, slope, steepest = 0.0, 1.0, -1.0
        for j in range(count):
            if leader[j] != port:
                continue
            own, change = pull_of(ports, state, j, x, h, least)
            if dry(ports.numbers[j], ports.values[j]):
                own, change = sign * own, sign * change
            state.current[j] = own
            total += own
            slope += r * change
            if change > steepest:
                steep, steepest = j, change
        rest, at = x + r * total - y, x
        if abs(rest) <= 1e-13 * abs(push) + tolerance * (abs(x) + abs(y)):
            return float(x)
        low, high = (low, x) if sign * rest > 0.0 else (x, high)
        if abs(high - low) <= 1e-15 * abs(x):
            break
        step = x - rest / slope if slope > 1e-6 else high
        if sign * (step - low) > 0.0 and sign * (high - step) > 0.0:
            x = step
        elif abs(high) < 1e299:  # nearer to where the way begins: a force of speed may rise steeply there
            x = low + 0.1 * (high - low)
        else:
            x += sign * abs(rest)
    if r > 0.0:  # a force that rises within rounding gives what is missing
        state.current[steep] -= rest / r
    return float(at)
