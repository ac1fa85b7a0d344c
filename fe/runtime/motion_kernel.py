"""Motion of a few modes with internal forces at ports: loops over numbers, and nothing else.

q'' + D q' + W^2 (1 + r t) q = f(t) - sum_j p_j F_j(p_j . q, p_j . v, memory_j). The linear part is advanced
exactly, in steps of any lengths that come from `fe.runtime.stepwise`; internal forces are split off
symmetrically (Strang 1968): laws of speed, laws of position, linear motion, laws of position, laws of speed.
Laws of speed have a closed form. Where friction turns over inside a step, the impulse and its first moment
are corrected for the moment of the turn; where it holds, the port is held in place by the impulses that this
needs, as long as friction can give them. What a law is `fe.runtime.laws.interface` says; none is known here.
Laws on flexibility that the modes leave out are those of `fe.runtime.flexible_ports`.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file is copied
into the FMU. `discrepancy.models.compiled_motion` has the same compiled.
"""

import numpy as np

from .flexible_ports import begin_flexible, carry_flexible, pull_of
from .laws import (
    advance,
    crossing,
    dry,
    holding_limit,
    holds,
    kick,
    share,
    steady,
    strength,
)
from .motion_arrays import (
    FIRST_PARTS,
    FLEXIBLE,
    POSITION,
    SPEED,
    STILL,
    Acting,
    Before,
    FloatArray,
    Linear,
    Ports,
    Samples,
    State,
    Steps,
    Unnamed,
    add,
    at_port,
)


def integrate(
    steps: Unnamed, linear: Unnamed, known: bool, ports: Unnamed, state: Unnamed, out: Unnamed
) -> None:
    """Integrate over steps; the state is changed in place, `out` is filled.

    Given are the fields of `Steps`, `Linear`, `Ports`, `State` and `Samples` without their names: numba takes
    three times as long for a tuple with names as for one without. `known`: the memory is that of a state;
    otherwise each law is loaded from zero to its first position.
    """
    go, body, samples = Steps(*steps), Linear(*linear), Samples(*out)
    laws, moving = Ports(*ports), State(*state)
    modes, count = len(moving.q), len(laws.numbers)
    none, whole = np.zeros((7, count)), np.zeros((3, count), dtype=np.int64)
    acting = Acting(
        whole[0], whole[1], whole[2], none[0], none[1], none[2], np.zeros((count, modes)),
        np.zeros((count, 2 * modes)),
    )  # fmt: skip
    before = Before(np.zeros(modes), np.zeros(modes), np.zeros(2 * modes), none[3], none[4], none[5], none[6])
    h = go.length[go.which[0]]
    take(laws.feed, go.feed[0])
    take_matrix(body.transition, go.transition[go.which[0]])
    take(body.end, go.begin[0])
    find_routes(laws, acting)
    begin_on_modes(body, laws, acting, moving, known)
    begin_flexible(laws, acting, moving, h, known)
    record(body, laws, acting, moving, go.time[0], 0, samples)
    sample, last = 1, go.which[0]
    for k in range(len(go.which)):
        if go.which[k] != last:
            last = go.which[k]
            h = go.length[last]
            take_matrix(body.transition, go.transition[last])
            for j in range(count):
                if acting.route[j] == SPEED:
                    find_answer(body, laws, acting, j)
        take(body.begin, go.begin[k])
        take(body.end, go.end[k])
        take(body.push, go.push[k])
        take(laws.feed, go.feed[k + 1])
        first_half(body, laws, acting, moving, before, go.time[k], h)
        move(body, moving, before.room)
        hold(laws, acting, moving, before, h)
        carry_flexible(laws, acting, moving, h)
        second_half(body, laws, acting, moving, before, go.time[k], h)
        if k + 1 == go.sample[sample]:
            record(body, laws, acting, moving, go.time[k + 1], sample, samples)
            sample += 1


def take(into: FloatArray, given: FloatArray) -> None:
    """Copy numbers; numba takes two seconds to compile `into[:] = given`."""
    for i in range(len(into)):
        into[i] = given[i]


def take_matrix(into: FloatArray, given: FloatArray) -> None:
    """Copy a matrix, row by row."""
    for i in range(len(into)):
        take(into[i], given[i])


def find_routes(ports: Ports, acting: Acting) -> None:
    """Set how each law acts, and what its port and the modes do to each other."""
    modes = ports.rows.shape[1]
    for j in range(len(ports.numbers)):
        acting.leader[j] = -1
        acting.weight[j] = at_port(ports.rows, j, ports.acts[j])
        moves = False
        for m in range(modes):
            moves = moves or ports.rows[j, m] != 0.0
        if acting.weight[j] == 0.0:
            acting.route[j] = STILL
            continue
        for m in range(modes):
            acting.pull[j, m] = ports.acts[j, m] / acting.weight[j]
        if moves and ports.flexibility[j] > 0.0:
            acting.route[j] = FLEXIBLE
            for k in range(j, -1, -1):
                same = acting.route[k] == FLEXIBLE
                for m in range(modes):
                    same = same and ports.rows[j, m] == ports.rows[k, m]
                if same:
                    acting.leader[j] = k
        else:
            acting.route[j] = SPEED if ports.of_speed[j] == 1 else POSITION


def find_answer(linear: Linear, ports: Ports, acting: Acting, j: int) -> None:
    """Set what a unit kick at the port of a law of speed does in a step."""
    modes = ports.rows.shape[1]
    for m in range(2 * modes):
        acting.answer[j, m] = 0.0
        for k in range(modes):
            acting.answer[j, m] += linear.transition[m, modes + k] * ports.acts[j, k]
    acting.give[j] = at_port(ports.rows, j, acting.answer[j, :modes])


def begin_on_modes(linear: Linear, ports: Ports, acting: Acting, state: State, known: bool) -> None:
    """Take the laws that act on the modes, and those of speed on flexible ports, to the first sample."""
    for j in range(len(ports.numbers)):
        if acting.route[j] == STILL:
            continue
        x, speed = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        if acting.route[j] == FLEXIBLE:
            if ports.of_speed[j] == 1 and known:
                state.current[j] = state.memory[j, 4]
            elif ports.of_speed[j] == 1:  # moving steadily
                state.current[j] = steady(ports.numbers[j], ports.values[j], x, speed)
                state.memory[j, 2] = state.current[j]
        elif acting.route[j] == SPEED:
            acting.strength[j] = strength(ports.numbers[j], ports.values[j], acting.weight[j])
            find_answer(linear, ports, acting, j)
            if holds(ports.numbers[j], ports.values[j]) and speed == 0.0 and acting.strength[j] > 0.0:
                state.memory[j, 0] = 1.0
                state.memory[j, 1] = x
        else:
            advance(ports.numbers[j], ports.values[j], ports.elements[j], state.memory[j], x, FIRST_PARTS)
            state.current[j], _ = pull_of(ports, state, j, x, 1.0, 1)


def first_half(
    linear: Linear, ports: Ports, acting: Acting, state: State, before: Before, time: float, h: float
) -> None:
    """Give the modes the first half of the impulse of the internal forces."""
    half = 0.5 * h
    modes, count = len(state.q), len(ports.numbers)
    for j in range(count):
        before.forces[j] = state.current[j]
    for m in range(modes):
        before.q[m] = state.q[m]
        before.v[m] = state.v[m]
    for j in range(count):
        if acting.route[j] != SPEED:
            continue
        before.freed[j] = 0.0
        before.lost[j] = 0.0
        speed, x = at_port(ports.rows, j, state.v), at_port(ports.rows, j, state.q)
        before.speed[j] = speed
        if state.memory[j, 0] == 1.0:
            continue
        now = acting.strength[j] * share(ports.numbers[j], ports.values[j], x)
        # dry friction is not stopped at zero: the turn is looked for after the step
        before.lost[j] = speed - kick(ports.numbers[j], ports.values[j], speed, now, half, True)
        add(state.v, acting.pull[j], -before.lost[j], 1.0)
    for j in range(count):
        if state.current[j] != 0.0:
            add(state.v, ports.acts[j], -state.current[j], half)
    if linear.rate != 0.0:
        for m in range(modes):
            state.v[m] -= half * linear.rate * time * linear.stiffness[m] * state.q[m]


def move(linear: Linear, state: State, new: FloatArray) -> None:
    """Move the linear structure; exact."""
    modes = len(state.q)
    if linear.coupled:
        for m in range(modes):
            i = modes + m
            total_q, total_v = linear.push[m], linear.push[i]
            for k in range(modes):
                total_q += linear.transition[m, k] * state.q[k] + linear.transition[m, modes + k] * state.v[k]
                total_v += linear.transition[i, k] * state.q[k] + linear.transition[i, modes + k] * state.v[k]
            new[m] = total_q
            new[i] = total_v
        for m in range(modes):
            state.q[m] = new[m]
            state.v[m] = new[modes + m]
    else:
        for m in range(modes):
            i = modes + m
            total_q = linear.transition[m, m] * state.q[m] + linear.transition[m, i] * state.v[m]
            total_v = linear.transition[i, m] * state.q[m] + linear.transition[i, i] * state.v[m]
            state.q[m] = total_q + linear.push[m]
            state.v[m] = total_v + linear.push[i]


def hold(ports: Ports, acting: Acting, state: State, before: Before, h: float) -> None:
    """Keep the ports that friction holds in place, by an impulse at the begin of the step."""
    modes = len(state.q)
    for j in range(len(ports.numbers)):
        if acting.route[j] != SPEED or state.memory[j, 0] != 1.0:
            continue
        now = acting.strength[j] * share(ports.numbers[j], ports.values[j], state.memory[j, 1])
        limit = holding_limit(ports.numbers[j], ports.values[j], now, 0.5 * h)
        impulse = (state.memory[j, 1] - at_port(ports.rows, j, state.q)) / acting.give[j]
        if abs(impulse) * acting.weight[j] > limit:
            state.memory[j, 0] = 0.0
            before.freed[j] = 1.0
            impulse = (limit if impulse > 0.0 else -limit) / acting.weight[j]
        add(state.q, acting.answer[j], impulse, 1.0)
        add(state.v, acting.answer[j, modes:], impulse, 1.0)


def second_half(
    linear: Linear, ports: Ports, acting: Acting, state: State, before: Before, time: float, h: float
) -> None:  # fmt: skip
    """Give the modes the second half of the impulse; look for friction that turned over."""
    half = 0.5 * h
    modes, count = len(state.q), len(ports.numbers)
    for j in range(count):
        if acting.route[j] != POSITION:
            continue
        x = at_port(ports.rows, j, state.q)
        advance(ports.numbers[j], ports.values[j], ports.elements[j], state.memory[j], x, 1)
        state.current[j], _ = pull_of(ports, state, j, x, 1.0, 1)
        add(state.v, ports.acts[j], -state.current[j], half)
    if linear.rate != 0.0:
        for m in range(modes):
            state.v[m] -= half * linear.rate * (time + h) * linear.stiffness[m] * state.q[m]
    for j in range(count - 1, -1, -1):
        if acting.route[j] != SPEED:
            continue
        x, speed = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        if state.memory[j, 0] == 1.0:
            now = acting.strength[j] * share(ports.numbers[j], ports.values[j], state.memory[j, 1])
            limit = holding_limit(ports.numbers[j], ports.values[j], now, half)
            taken = speed
            if abs(speed) > limit:
                taken = limit if speed > 0.0 else -limit
                state.memory[j, 0] = 0.0
            add(state.v, acting.pull[j], -taken, 1.0)
            continue
        now = acting.strength[j] * share(ports.numbers[j], ports.values[j], x)
        end = speed - before.lost[j]
        can_hold = holds(ports.numbers[j], ports.values[j])
        if can_hold and before.freed[j] == 0.0 and before.speed[j] != 0.0 and before.speed[j] * end <= 0.0:
            turn_over(linear, ports, acting, state, before, j, now, time, h)
        else:
            after = kick(ports.numbers[j], ports.values[j], speed, now, half, False)
            if after == 0.0 and can_hold and now > 0.0:
                state.memory[j, 0] = 1.0
                state.memory[j, 1] = x
            add(state.v, acting.pull[j], after - speed, 1.0)


def acceleration(
    linear: Linear, ports: Ports, q: FloatArray, v: FloatArray, forces: FloatArray, push: float, time: float,
    m: int,
) -> float:  # fmt: skip
    """Return the acceleration of a mode under a push and the forces of laws; those of speed have none."""
    total = push - linear.stiffness[m] * (1.0 + linear.rate * time) * q[m]
    for k in range(len(q)):
        total -= linear.damping[m, k] * v[k]
    for k in range(len(forces)):
        total -= ports.acts[k, m] * forces[k]
    return float(total)


def turn_over(
    linear: Linear, ports: Ports, acting: Acting, state: State, before: Before, j: int, now: float,
    time: float, h: float,
) -> None:  # fmt: skip
    """Correct speed and position of a port whose friction turned over within a step."""
    at_begin = -2.0 * before.lost[j] / h  # acceleration at both ends, as friction of the first sign has it
    at_end = at_begin
    for m in range(len(state.q)):
        first = acceleration(linear, ports, before.q, before.v, before.forces, linear.begin[m], time, m)
        last = acceleration(linear, ports, state.q, state.v, state.current, linear.end[m], time + h, m)
        at_begin += ports.rows[j, m] * first
        at_end += ports.rows[j, m] * last
    speed = at_port(ports.rows, j, state.v)
    change, way, held = crossing(
        ports.numbers[j], ports.values[j], before.speed[j], speed - before.lost[j], (at_begin, at_end),
        before.lost[j], now, h,
    )  # fmt: skip
    if held == 1.0:
        change = -speed
        x = at_port(ports.rows, j, state.q)
        way += at_port(ports.rows, j, before.q) - x
        state.memory[j, 0] = 1.0
        state.memory[j, 1] = x + way
    add(state.q, acting.pull[j], way, 1.0)
    add(state.v, acting.pull[j], change, 1.0)


def record(
    linear: Linear, ports: Ports, acting: Acting, state: State, time: float, sample: int, out: Samples
) -> None:  # fmt: skip
    """Write state and forces at a sample."""
    modes, count = len(state.q), len(ports.numbers)
    for m in range(modes):
        out.q[sample, m] = state.q[m]
        out.v[sample, m] = state.v[m]
    for j in range(count):
        out.forces[sample, j] = state.current[j]
        out.lagged[sample, j] = state.memory[j, 2] if acting.route[j] == FLEXIBLE else state.current[j]
        if acting.route[j] != SPEED:
            continue
        x, speed = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        out.forces[sample, j] = steady(ports.numbers[j], ports.values[j], x, speed)
        if state.memory[j, 0] == 1.0:  # what it takes to hold the port
            need = 0.0
            for m in range(modes):
                push = acceleration(linear, ports, state.q, state.v, state.current, linear.end[m], time, m)
                need += ports.rows[j, m] * push / acting.weight[j]
            if dry(ports.numbers[j], ports.values[j]):
                most = acting.strength[j] * share(ports.numbers[j], ports.values[j], x) / acting.weight[j]
                need = min(max(need, -most), most)
            out.forces[sample, j] = need
        out.lagged[sample, j] = out.forces[sample, j]
