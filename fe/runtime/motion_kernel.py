"""Motion of a few modes with internal forces at ports: loops over numbers, and nothing else.

q'' + D q' + W^2 (1 + r t) q = f(t) - sum_j p_j F_j(p_j . q, p_j . v, memory_j). The linear part is advanced
exactly, in steps of any lengths that come from `fe.runtime.stepwise`; internal forces are split off
symmetrically (Strang 1968): laws of speed, laws of position, linear motion, laws of position, laws of speed.
Laws of speed have a closed form. Where friction turns over inside a step, the impulse and its first moment
are corrected for the moment of the turn; where it holds, the port is held in place by the impulses that this
needs, as long as friction can give them. What a law is `fe.runtime.laws.interface` says; none is known here.

Last laws at ports that lie on flexibility R which the modes leave out: x = p . q - R D + e, where D is the
force of the laws there after a lag, beta D' + D = F (the lag of damping in proportion to the stiffness;
backward Euler), and e what loads add. The force of a law is that at the step's end, where it obeys the law at
its own position: a monotone equation in one unknown. Dry friction is then an elasto-plastic element of
stiffness 1/R.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file is copied
into the FMU. `discrepancy.models.compiled_motion` has the same compiled.
"""

import numpy as np

from . import laws
from .arrays import FloatArray
from .motion_arrays import FIRST_PARTS, Acting, Ports, Samples, State, Steps, Unnamed, add, at_port
from .static_path import pull_of, settle_port

STILL, SPEED, POSITION, FLEXIBLE = 0, 1, 2, 3
"""How a law acts: not, its port being still; on the modes, by speed or position; on what they leave out."""


def integrate(
    steps: Unnamed, coupled: bool, known: bool, at_ports: Unnamed, begin: Unnamed, out: Unnamed
) -> None:
    """Integrate over steps; the state is changed in place, `out` is filled.

    Given are the fields of `Steps`, `Ports`, `State` and `Samples` without their names: numba takes three
    times as long for a tuple with names as for one without. `coupled`: steps couple modes. `known`: the
    memory is that of a state; otherwise each law is loaded from zero to its first position.
    """
    go, ports, state, samples = Steps(*steps), Ports(*at_ports), State(*begin), Samples(*out)
    modes, count = len(state.q), len(ports.numbers)
    none, whole, still = np.zeros((7, count)), np.zeros((3, count), dtype=np.int64), np.zeros((2, modes))
    acting = Acting(
        whole[0], whole[1], whole[2], none[0], none[1], none[2], np.zeros((count, modes)),
        np.zeros((count, 2 * modes)), still[0], still[1], np.zeros(2 * modes), none[3], none[4], none[5],
        none[6],
    )  # fmt: skip
    last = go.which[0]
    take(ports.feed, go.feed[0])
    find_routes(ports, acting)
    begin_on_modes(go, ports, acting, state, known)
    begin_flexible(ports, acting, state, go.length[last], known)
    record(go, ports, acting, state, go.begin[0], 0, samples)
    sample = 1
    for k in range(len(go.which)):
        if go.which[k] != last:
            last = go.which[k]
            for j in range(count):
                if acting.route[j] == SPEED:
                    find_answer(go, last, ports, acting, j)
        h = go.length[last]
        take(ports.feed, go.feed[k + 1])
        first_half(go, k, ports, acting, state, h)
        if coupled:
            move(go, k, state, acting.room)
        else:
            move_alone(go, k, state)
        hold(ports, acting, state, h)
        carry_flexible(ports, acting, state, h)
        second_half(go, k, ports, acting, state, h)
        if k + 1 == go.sample[sample]:
            record(go, ports, acting, state, go.end[k], sample, samples)
            sample += 1


def take(into: FloatArray, given: FloatArray) -> None:
    """Copy numbers; numba takes two seconds to compile `into[:] = given`."""
    for i in range(len(into)):
        into[i] = given[i]


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


def find_answer(go: Steps, which: int, ports: Ports, acting: Acting, j: int) -> None:
    """Set what a unit kick at the port of a law of speed does in a step of a length."""
    modes = ports.rows.shape[1]
    for m in range(2 * modes):
        acting.answer[j, m] = 0.0
        for k in range(modes):
            acting.answer[j, m] += go.transition[which, m, modes + k] * ports.acts[j, k]
    acting.give[j] = at_port(ports.rows, j, acting.answer[j, :modes])


def begin_on_modes(go: Steps, ports: Ports, acting: Acting, state: State, known: bool) -> None:
    """Take the laws that act on the modes, and those of speed on flexible ports, to the first sample."""
    for j in range(len(ports.numbers)):
        if acting.route[j] == STILL:
            continue
        x, speed = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        if acting.route[j] == FLEXIBLE:
            if ports.of_speed[j] == 1 and known:
                state.current[j] = state.memory[j, 4]
            elif ports.of_speed[j] == 1:  # moving steadily
                state.current[j] = laws.steady(ports.numbers[j], ports.values[j], x, speed)
                state.memory[j, 2] = state.current[j]
        elif acting.route[j] == SPEED:
            acting.strength[j] = laws.strength(ports.numbers[j], ports.values[j], acting.weight[j])
            find_answer(go, go.which[0], ports, acting, j)
            if laws.holds(ports.numbers[j], ports.values[j]) and speed == 0.0 and acting.strength[j] > 0.0:
                state.memory[j, 0] = 1.0
                state.memory[j, 1] = x
        else:
            laws.advance(ports.numbers[j], ports.values[j], state.memory[j], x, FIRST_PARTS)
            state.current[j], _ = pull_of(ports, state, j, x, 1.0, 1)


def first_half(go: Steps, k: int, ports: Ports, acting: Acting, state: State, h: float) -> None:
    """Give the modes the first half of the impulse of the internal forces."""
    half = 0.5 * h
    modes, count = len(state.q), len(ports.numbers)
    for j in range(count):
        acting.forces[j] = state.current[j]
    for m in range(modes):
        acting.q[m] = state.q[m]
        acting.v[m] = state.v[m]
    for j in range(count):
        if acting.route[j] != SPEED:
            continue
        acting.freed[j] = 0.0
        acting.lost[j] = 0.0
        speed, x = at_port(ports.rows, j, state.v), at_port(ports.rows, j, state.q)
        acting.speed[j] = speed
        if state.memory[j, 0] == 1.0:
            continue
        now = acting.strength[j] * laws.share(ports.numbers[j], ports.values[j], x)
        # dry friction is not stopped at zero: the turn is looked for after the step
        acting.lost[j] = speed - laws.kick(ports.numbers[j], ports.values[j], speed, now, half, True)
        add(state.v, acting.pull[j], -acting.lost[j], 1.0)
    for j in range(count):
        if state.current[j] != 0.0:
            add(state.v, ports.acts[j], -state.current[j], half)
    if ports.rate != 0.0:
        for m in range(modes):
            state.v[m] -= half * ports.rate * go.time[k] * go.stiffness[m] * state.q[m]


def move(go: Steps, k: int, state: State, new: FloatArray) -> None:
    """Move the linear structure; exact."""
    modes, step = len(state.q), go.which[k]
    for i in range(2 * modes):
        total = go.push[k, i]
        for m in range(modes):
            total += go.transition[step, i, m] * state.q[m] + go.transition[step, i, modes + m] * state.v[m]
        new[i] = total
    for m in range(modes):
        state.q[m] = new[m]
        state.v[m] = new[modes + m]


def move_alone(go: Steps, k: int, state: State) -> None:
    """Move the linear structure whose modes move each by itself; exact."""
    modes, step = len(state.q), go.which[k]
    for m in range(modes):
        i, q, v = modes + m, state.q[m], state.v[m]
        state.q[m] = go.transition[step, m, m] * q + go.transition[step, m, i] * v + go.push[k, m]
        state.v[m] = go.transition[step, i, m] * q + go.transition[step, i, i] * v + go.push[k, i]


def hold(ports: Ports, acting: Acting, state: State, h: float) -> None:
    """Keep the ports that friction holds in place, by an impulse at the begin of the step."""
    modes = len(state.q)
    for j in range(len(ports.numbers)):
        if acting.route[j] != SPEED or state.memory[j, 0] != 1.0:
            continue
        now = acting.strength[j] * laws.share(ports.numbers[j], ports.values[j], state.memory[j, 1])
        limit = laws.holding_limit(ports.numbers[j], ports.values[j], now, 0.5 * h)
        impulse = (state.memory[j, 1] - at_port(ports.rows, j, state.q)) / acting.give[j]
        if abs(impulse) * acting.weight[j] > limit:
            state.memory[j, 0] = 0.0
            acting.freed[j] = 1.0
            impulse = (limit if impulse > 0.0 else -limit) / acting.weight[j]
        add(state.q, acting.answer[j], impulse, 1.0)
        add(state.v, acting.answer[j, modes:], impulse, 1.0)


def second_half(go: Steps, k: int, ports: Ports, acting: Acting, state: State, h: float) -> None:
    """Give the modes the second half of the impulse; look for friction that turned over."""
    half = 0.5 * h
    modes, count = len(state.q), len(ports.numbers)
    for j in range(count):
        if acting.route[j] != POSITION:
            continue
        x = at_port(ports.rows, j, state.q)
        laws.advance(ports.numbers[j], ports.values[j], state.memory[j], x, 1)
        state.current[j], _ = pull_of(ports, state, j, x, 1.0, 1)
        add(state.v, ports.acts[j], -state.current[j], half)
    if ports.rate != 0.0:
        for m in range(modes):
            state.v[m] -= half * ports.rate * (go.time[k] + h) * go.stiffness[m] * state.q[m]
    for j in range(count - 1, -1, -1):
        if acting.route[j] != SPEED:
            continue
        x, speed = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        if state.memory[j, 0] == 1.0:
            now = acting.strength[j] * laws.share(ports.numbers[j], ports.values[j], state.memory[j, 1])
            limit = laws.holding_limit(ports.numbers[j], ports.values[j], now, half)
            taken = speed
            if abs(speed) > limit:
                taken = limit if speed > 0.0 else -limit
                state.memory[j, 0] = 0.0
            add(state.v, acting.pull[j], -taken, 1.0)
            continue
        now = acting.strength[j] * laws.share(ports.numbers[j], ports.values[j], x)
        end = speed - acting.lost[j]
        can_hold = laws.holds(ports.numbers[j], ports.values[j])
        if can_hold and acting.freed[j] == 0.0 and acting.speed[j] != 0.0 and acting.speed[j] * end <= 0.0:
            turn_over(go, k, ports, acting, state, j, now, h)
        else:
            after = laws.kick(ports.numbers[j], ports.values[j], speed, now, half, False)
            if after == 0.0 and can_hold and now > 0.0:
                state.memory[j, 0] = 1.0
                state.memory[j, 1] = x
            add(state.v, acting.pull[j], after - speed, 1.0)


def acceleration(
    go: Steps, ports: Ports, q: FloatArray, v: FloatArray, forces: FloatArray, push: float, t: float, m: int
) -> float:
    """Return the acceleration of a mode under a push and the forces of laws; those of speed have none."""
    total = push - go.stiffness[m] * (1.0 + ports.rate * t) * q[m]
    for k in range(len(q)):
        total -= go.damping[m, k] * v[k]
    for k in range(len(forces)):
        total -= ports.acts[k, m] * forces[k]
    return float(total)


def turn_over(
    go: Steps, k: int, ports: Ports, acting: Acting, state: State, j: int, now: float, h: float
) -> None:
    """Correct speed and position of a port whose friction turned over within a step."""
    at_begin = -2.0 * acting.lost[j] / h  # acceleration at both ends, as friction of the first sign has it
    at_end = at_begin
    for m in range(len(state.q)):
        first = acceleration(go, ports, acting.q, acting.v, acting.forces, go.begin[k, m], go.time[k], m)
        last = acceleration(go, ports, state.q, state.v, state.current, go.end[k, m], go.time[k] + h, m)
        at_begin += ports.rows[j, m] * first
        at_end += ports.rows[j, m] * last
    speed = at_port(ports.rows, j, state.v)
    change, way, held = laws.crossing(
        ports.numbers[j], ports.values[j], acting.speed[j], speed - acting.lost[j], (at_begin, at_end),
        acting.lost[j], now, h,
    )  # fmt: skip
    if held == 1.0:
        change = -speed
        x = at_port(ports.rows, j, state.q)
        way += at_port(ports.rows, j, acting.q) - x
        state.memory[j, 0] = 1.0
        state.memory[j, 1] = x + way
    add(state.q, acting.pull[j], way, 1.0)
    add(state.v, acting.pull[j], change, 1.0)


def record(
    go: Steps, ports: Ports, acting: Acting, state: State, push: FloatArray, sample: int, out: Samples
) -> None:
    """Write state and forces at a sample, where modal forces push."""
    modes, count, time = len(state.q), len(ports.numbers), go.time[go.sample[sample]]
    for m in range(modes):
        out.q[sample, m] = state.q[m]
        out.v[sample, m] = state.v[m]
    for j in range(count):
        out.forces[sample, j] = state.current[j]
        out.lagged[sample, j] = state.memory[j, 2] if acting.route[j] == FLEXIBLE else state.current[j]
        if acting.route[j] != SPEED:
            continue
        x, speed = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        out.forces[sample, j] = laws.steady(ports.numbers[j], ports.values[j], x, speed)
        if state.memory[j, 0] == 1.0:  # what it takes to hold the port
            need = 0.0
            for m in range(modes):
                own = acceleration(go, ports, state.q, state.v, state.current, push[m], time, m)
                need += ports.rows[j, m] * own / acting.weight[j]
            if laws.dry(ports.numbers[j], ports.values[j]):
                most = acting.strength[j] * laws.share(ports.numbers[j], ports.values[j], x)
                need = min(max(need, -most / acting.weight[j]), most / acting.weight[j])
            out.forces[sample, j] = need
        out.lagged[sample, j] = out.forces[sample, j]


# ---------------------------------------------------------------- on what the modes leave out


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
    laws.advance(ports.numbers[j], ports.values[j], state.memory[j], x, least)
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
            add(state.v, ports.acts[j], -state.current[j], 0.5 * h)
