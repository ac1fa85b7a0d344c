"""Motion of a few modes with internal forces at ports: loops over numbers, and nothing else.

q'' + D q' + W^2 (1 + r t) q = f(t) - sum_j p_j F_j(p_j . q, p_j . v, memory_j). The linear part is advanced
exactly, in steps of any lengths that come from `fe.runtime.motion`; internal forces are split off
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
into the FMU. `fe.compilation` has the same compiled.
"""

import numpy as np

from . import laws
from .arrays import FADING, FORCE, HELD, LAGGED, PLACE, FloatArray
from .laws import speed
from .motion_arrays import SPEED, STILL, Kept, ModalMotion, Ports, State, Steps, Unnamed, add, at_port
from .static_path import settle_port


def integrate(
    steps: Unnamed, first: int, last: int, sample: int, coupled: bool, known: bool, at_ports: Unnamed,
    begin: Unnamed, out: Unnamed,
) -> None:  # fmt: skip
    """Integrate from boundary `first` to `last`, the state in place; `out` is filled from `sample` on.

    Given are the fields of `Steps`, `Ports`, `State` and `ModalMotion` without their names: numba takes three
    times as long for a tuple with names as for one without. `coupled`: steps couple modes. `known`: the
    memory is that of a state; otherwise each law is loaded from zero to its first position.
    """
    go, ports, state, samples = Steps(*steps), Ports(*at_ports), State(*begin), ModalMotion(*out)
    none, still = np.zeros((4, len(ports.numbers))), np.zeros((4, len(state.q)))
    kept = Kept(still[0], still[1], still[2:].ravel(), none[0], none[1], none[2], none[3])
    begin_laws(ports, state, known)
    # At the begin, a step of no duration: the lagged forces stay, or follow at once.
    h, keep, fade = 0.0, 1.0 if known and ports.relaxation > 0.0 else 0.0, 1.0
    for k in range(first, last + 1):
        if k > first:
            h = go.length[go.which[k - 1]]
            keep = ports.relaxation / (ports.relaxation + h)
            fade = keep
            first_half(go, k - 1, ports, kept, state, h)
            move(go, k - 1, state, kept.room, coupled)
            hold(go, k - 1, ports, kept, state, h)
        carry(go, k, ports, state, h, keep, fade, known)
        if k > first:
            second_half(go, k - 1, ports, kept, state, h)
        if k == go.sample[sample]:
            record(go, k, ports, state, go.end[k - 1] if k > first else go.begin[k], sample, samples)
            sample += 1


def begin_laws(ports: Ports, state: State, known: bool) -> None:
    """Set what the laws pull with at the begin; without a known memory those of speed move steadily."""
    for j in range(len(ports.numbers)):
        x, v = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        law, memory = ports.values[j], state.memory[j]
        if ports.leader[j] == SPEED:
            memory[FORCE] = 0.0
            if speed.holds(law) and v == 0.0 and speed.strength(law, x, ports.weight[j]) > 0.0:
                memory[HELD], memory[PLACE] = 1.0, x
        elif ports.leader[j] == STILL:
            memory[FORCE] = memory[LAGGED] = 0.0
        elif ports.of_speed[j] == 0:
            memory[FORCE], _ = laws.pull(ports.numbers[j], law, memory, memory[PLACE], 1.0)
        elif not known:
            memory[FORCE] = memory[LAGGED] = speed.steady(law, x, v)


def first_half(go: Steps, k: int, ports: Ports, kept: Kept, state: State, h: float) -> None:
    """Give the modes the first half of the impulse of the internal forces."""
    half = 0.5 * h
    modes, count = len(state.q), len(ports.numbers)
    for m in range(modes):
        kept.q[m], kept.v[m] = state.q[m], state.v[m]
    for j in range(count):
        kept.forces[j], kept.freed[j], kept.lost[j] = state.memory[j, FORCE], 0.0, 0.0
        if ports.leader[j] != SPEED:
            continue
        kept.speed[j] = at_port(ports.rows, j, state.v)
        if state.memory[j, HELD] == 1.0:
            continue
        now = speed.strength(ports.values[j], at_port(ports.rows, j, state.q), ports.weight[j])
        # dry friction is not stopped at zero: the turn is looked for after the step
        kept.lost[j] = kept.speed[j] - speed.kick(ports.values[j], kept.speed[j], now, half, True)
        add(state.v, ports.acts[j], -kept.lost[j] / ports.weight[j])
    for j in range(count):
        if kept.forces[j] != 0.0:
            add(state.v, ports.acts[j], -kept.forces[j] * half)
    if ports.rate != 0.0:
        for m in range(modes):
            state.v[m] -= half * ports.rate * go.time[k] * go.stiffness[m] * state.q[m]


def move(go: Steps, k: int, state: State, new: FloatArray, coupled: bool) -> None:
    """Move the linear structure, exactly; modes that are not coupled each by itself."""
    modes, step = len(state.q), go.which[k]
    for m in range(modes):
        i, low, high = modes + m, 0 if coupled else m, modes if coupled else m + 1
        q, v = go.push[k, m], go.push[k, i]
        for n in range(low, high):
            q += go.transition[step, m, n] * state.q[n] + go.transition[step, m, modes + n] * state.v[n]
            v += go.transition[step, i, n] * state.q[n] + go.transition[step, i, modes + n] * state.v[n]
        new[m], new[i] = q, v
    for m in range(modes):
        state.q[m], state.v[m] = new[m], new[modes + m]


def hold(go: Steps, k: int, ports: Ports, kept: Kept, state: State, h: float) -> None:
    """Keep the ports that friction holds in place, by an impulse at the begin of the step."""
    modes = len(state.q)
    for j in range(len(ports.numbers)):
        if ports.leader[j] != SPEED or state.memory[j, HELD] != 1.0:
            continue
        answer = ports.answer[go.which[k], j]
        place, weight = state.memory[j, PLACE], ports.weight[j]
        limit = speed.holding_limit(ports.values[j], speed.strength(ports.values[j], place, weight), 0.5 * h)
        impulse = (place - at_port(ports.rows, j, state.q)) / at_port(ports.rows, j, answer[:modes])
        if abs(impulse) * weight > limit:
            state.memory[j, HELD], kept.freed[j] = 0.0, 1.0
            impulse = (limit if impulse > 0.0 else -limit) / weight
        add(state.q, answer, impulse)
        add(state.v, answer[modes:], impulse)


def carry(
    go: Steps, k: int, ports: Ports, state: State, h: float, keep: float, fade: float, known: bool
) -> None:
    """Carry the laws at flexible positions to boundary `k`, and give the second half of their impulse.

    `keep` of the lagged forces stays, `fade` of what gone loads add; a rigid port has neither.
    """
    for port in range(len(ports.numbers)):
        if ports.leader[port] != port:
            continue
        r, x = ports.flexibility[port], at_port(ports.rows, port, state.q)
        if r > 0.0:
            x += go.feed[k, port] + fade * state.memory[port, FADING]
            for j in range(len(ports.numbers)):
                if ports.leader[j] == port:
                    x -= r * keep * state.memory[j, LAGGED]
            x = settle_port(port, ports, state.memory, x, (1.0 - keep) * r, h)
        for j in range(len(ports.numbers)):
            if ports.leader[j] != port:
                continue
            memory, stays = state.memory[j], keep if r > 0.0 else 0.0
            if ports.of_speed[j] == 0:
                laws.advance(ports.numbers[j], ports.values[j], memory, x)
            if ports.of_speed[j] == 0 or h > 0.0 or not known:
                memory[PLACE] = x
            if r == 0.0:
                memory[FORCE], _ = laws.pull(ports.numbers[j], ports.values[j], memory, x, 1.0)
            memory[LAGGED] = stays * memory[LAGGED] + (1.0 - stays) * memory[FORCE]
            memory[FADING] *= fade
            add(state.v, ports.acts[j], -0.5 * h * memory[FORCE])


def second_half(go: Steps, k: int, ports: Ports, kept: Kept, state: State, h: float) -> None:
    """Give the modes the second half of the impulse; look for friction that turned over."""
    half = 0.5 * h
    if ports.rate != 0.0:
        for m in range(len(state.q)):
            state.v[m] -= half * ports.rate * (go.time[k] + h) * go.stiffness[m] * state.q[m]
    for j in range(len(ports.numbers) - 1, -1, -1):
        if ports.leader[j] != SPEED:
            continue
        x, v = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
        law, memory = ports.values[j], state.memory[j]
        if memory[HELD] == 1.0:
            limit = speed.holding_limit(law, speed.strength(law, memory[PLACE], ports.weight[j]), half)
            if abs(v) > limit:
                v = limit if v > 0.0 else -limit
                memory[HELD] = 0.0
            add(state.v, ports.acts[j], -v / ports.weight[j])
            continue
        now, can_hold = speed.strength(law, x, ports.weight[j]), speed.holds(law)
        if (
            can_hold
            and kept.freed[j] == 0.0
            and kept.speed[j] != 0.0
            and kept.speed[j] * (v - kept.lost[j]) <= 0.0
        ):
            turn_over(go, k, ports, kept, state, j, now, h)
        else:
            after = speed.kick(law, v, now, half, False)
            if after == 0.0 and can_hold and now > 0.0:
                memory[HELD], memory[PLACE] = 1.0, x
            add(state.v, ports.acts[j], (after - v) / ports.weight[j])


def acceleration(
    go: Steps, ports: Ports, j: int, q: FloatArray, v: FloatArray, forces: FloatArray, push: FloatArray,
    t: float,
) -> float:  # fmt: skip
    """Return the acceleration of the port of law `j` under a push of the modes and the forces of laws.

    Laws of speed have none.
    """
    total = 0.0
    for m in range(len(q)):
        own = push[m] - go.stiffness[m] * (1.0 + ports.rate * t) * q[m]
        for k in range(len(q)):
            own -= go.damping[m, k] * v[k]
        for k in range(len(forces)):
            own -= ports.acts[k, m] * forces[k]
        total += ports.rows[j, m] * own
    return total


def turn_over(
    go: Steps, k: int, ports: Ports, kept: Kept, state: State, j: int, now: float, h: float
) -> None:
    """Correct speed and position of a port whose friction turned over within a step."""
    lost, forces, end = kept.lost[j], state.memory[:, FORCE], go.time[k] + h
    at_begin = acceleration(go, ports, j, kept.q, kept.v, kept.forces, go.begin[k], go.time[k])
    at_end = acceleration(go, ports, j, state.q, state.v, forces, go.end[k], end)
    friction = -2.0 * lost / h  # of the first sign, at both ends
    v, slopes = at_port(ports.rows, j, state.v), (at_begin + friction, at_end + friction)
    change, way, held = speed.crossing(ports.values[j], kept.speed[j], v - lost, slopes, lost, now, h)
    if held == 1.0:
        change = -v
        x = at_port(ports.rows, j, state.q)
        way += at_port(ports.rows, j, kept.q) - x
        state.memory[j, HELD], state.memory[j, PLACE] = 1.0, x + way
    add(state.q, ports.acts[j], way / ports.weight[j])
    add(state.v, ports.acts[j], change / ports.weight[j])


def record(
    go: Steps, k: int, ports: Ports, state: State, push: FloatArray, sample: int, out: ModalMotion
) -> None:
    """Write state and forces at a sample, where modal forces push."""
    for m in range(len(state.q)):
        out.q[sample, m], out.v[sample, m] = state.q[m], state.v[m]
    for j in range(len(ports.numbers)):
        law, memory, weight = ports.values[j], state.memory[j], ports.weight[j]
        force = memory[FORCE]
        if ports.leader[j] == SPEED:
            x, v = at_port(ports.rows, j, state.q), at_port(ports.rows, j, state.v)
            force = speed.steady(law, x, v)
            if memory[HELD] == 1.0:  # what it takes to hold the port
                others = state.memory[:, FORCE]
                force = acceleration(go, ports, j, state.q, state.v, others, push, go.time[k]) / weight
                if law[1] == 0.0:
                    most = speed.strength(law, x, weight) / weight
                    force = min(max(force, -most), most)
            memory[LAGGED] = force
        out.port_forces[sample, j], out.lagged[sample, j] = force, memory[LAGGED]
