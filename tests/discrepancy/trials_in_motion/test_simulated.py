"""A mass on a spring that dry friction brings to rest, simulated in the substeps of the estimator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from discrepancy.campaign.records import FloatArray
from discrepancy.system.response import PortedSystem
from discrepancy.trials_in_motion import simulated as module
from discrepancy.trials_in_motion.simulated import motion_under_laws
from discrepancy.trials_in_motion.trajectory import Trajectory
from discrepancy.trials_in_motion.trial import PortedTrial
from fe.runtime.patch import PowerDamping, PowerStiffness

FRICTION = 0.11
TURNING_POINTS = 1.0, -0.78, 0.56, -0.34, 0.12, 0.10
"""Positions of the mass each time that it turns: friction takes 2 F / k in each half cycle, and from
0.12 the spring no longer pulls it through zero. At 0.10 it stays."""
HELD = slice(-200, None)


def released(system: PortedSystem, interval: float) -> PortedTrial:
    """Return a trial over ten half cycles of 1 rad/s, whose ports all swing with 1 m without laws."""
    time = np.arange(0.0, 10.0 * np.pi, interval)
    fine_time = np.linspace(0.0, time[-1], 4 * (len(time) - 1) + 1)
    ports = np.ones(len(system.ports))
    return PortedTrial(
        name="release",
        time=time,
        residual=np.zeros((len(time), 1)),
        used=np.ones((len(time), 1), dtype=bool),
        deviation=np.ones(1),
        coloured_noises=(),
        shared_derivatives=np.zeros((0, len(time), 1)),
        local_derivatives=np.zeros((0, len(time), 1)),
        local_precision=np.zeros(0),
        system=system,
        system_derivatives=(),
        substeps=4,
        port_positions=np.outer(np.cos(fine_time), ports),
        port_speeds=np.outer(-np.sin(fine_time), ports),
        begins_at_rest=False,
    )


def released_mass(interval: float) -> PortedTrial:
    """Return a mass and a spring of 1 kg and 1 N/m, released at 1 m."""
    system = PortedSystem(
        generator=np.array([[0.0, 1.0], [-1.0, 0.0]]),
        ports=("slide",),
        actions=np.array([[0.0, 1.0]]),
        positions=np.array([[1.0, 0.0]]),
        speeds=np.array([[0.0, 1.0]]),
        outputs=np.array([[1.0, 0.0]]),
        through=np.zeros((1, 1)),
    )
    return released(system, interval)


def simulated(interval: float, friction: float = FRICTION) -> Trajectory:
    """Return the motion of the mass with dry friction [N]."""
    trial = released_mass(interval)
    law = PowerDamping(
        port="slide",
        coefficient=friction,
        velocity_exponent=0.0,
        displacement_exponent=0.0,
        reference_velocity=1.0,
        reference_displacement=1.0,
    )
    no_unknowns = np.zeros(0)
    least_half_widths = np.array([1e-7])
    return motion_under_laws(trial, [law], no_unknowns, no_unknowns, np.zeros(2), least_half_widths)


def at_half_cycles(trajectory: Trajectory) -> FloatArray:
    """Return the position at the end of each half cycle."""
    count = len(trajectory.positions) - 1
    stamps = [round(number * count / 10.0) for number in range(len(TURNING_POINTS))]
    return trajectory.positions[stamps, 0]


def test_friction_takes_the_same_length_in_each_half_cycle():
    np.testing.assert_allclose(at_half_cycles(simulated(0.05)), TURNING_POINTS, atol=2e-4)


def test_friction_holds_the_mass_where_it_comes_to_rest():
    trajectory = simulated(0.05)
    assert np.ptp(trajectory.positions[HELD]) < 1e-5
    np.testing.assert_allclose(trajectory.speeds[HELD], 0.0, atol=1e-6)


def test_the_force_of_friction_at_rest_is_that_of_the_spring():
    trajectory = simulated(0.05)
    np.testing.assert_allclose(trajectory.forces[0][HELD], -trajectory.positions[HELD, 0], atol=1e-5)


def test_a_shorter_step_gives_a_more_accurate_motion():
    errors = [
        np.abs(at_half_cycles(simulated(interval)) - TURNING_POINTS).max() for interval in (0.2, 0.1, 0.05)
    ]
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]


def test_the_added_state_moves_the_port_as_the_motion_says():
    trajectory = simulated(0.1)
    positions, speeds = released_mass(0.1).port_motion(np.zeros(0), trajectory.added_state)
    np.testing.assert_allclose(trajectory.positions, positions, atol=1e-12)
    np.testing.assert_allclose(trajectory.speeds, speeds, atol=1e-12)


def test_friction_that_is_larger_than_the_spring_holds_the_mass_from_the_start():
    assert simulated(0.1, friction=1.5).positions == pytest.approx(1.0, abs=1e-4)


def test_plain_python_gives_the_motion_of_the_compiled_loop(monkeypatch):
    compiled_motion = simulated(0.1)
    monkeypatch.setattr(module, "_compiled_simulation", lambda: module.simulate_laws)
    plain_motion = simulated(0.1)
    np.testing.assert_allclose(plain_motion.added_state, compiled_motion.added_state, atol=1e-9)
    np.testing.assert_allclose(plain_motion.forces[0], compiled_motion.forces[0], atol=1e-9)


STIFFNESS = np.array([[3.0, -2.0], [-2.0, 3.0]])
"""Two masses of 1 kg on springs to the ground of 1 N/m, with a spring of 2 N/m between them: both
swing in phase with 1 rad/s."""


def test_laws_at_two_ports_move_both_as_an_integrator_says():
    """A hardening spring at the first mass and drag at the second one, beside scipy's solve_ivp."""
    no_block, unit_block = np.zeros((2, 2)), np.eye(2)
    system = PortedSystem(
        generator=np.block([[no_block, unit_block], [-STIFFNESS, no_block]]),
        ports=("first", "second"),
        actions=np.hstack([no_block, unit_block]),
        positions=np.hstack([unit_block, no_block]),
        speeds=np.hstack([no_block, unit_block]),
        outputs=np.array([[1.0, 0.0, 0.0, 0.0]]),
        through=np.zeros((2, 1)),
    )
    spring = PowerStiffness(port="first", coefficient=0.3, exponent=3.0, side=0, reference_displacement=1.0)
    drag = PowerDamping(
        port="second",
        coefficient=0.2,
        velocity_exponent=2.0,
        displacement_exponent=0.0,
        reference_velocity=1.0,
        reference_displacement=1.0,
    )
    trial = released(system, 0.05)
    no_unknowns = np.zeros(0)
    trajectory = motion_under_laws(
        trial, [spring, drag], no_unknowns, no_unknowns, np.zeros(4), np.full(2, 1e-7)
    )

    def rate(_: float, state: FloatArray) -> FloatArray:
        positions, speeds = state[:2], state[2:]
        laws = np.array([0.3 * positions[0] ** 3, 0.2 * abs(speeds[1]) * speeds[1]])
        return np.concatenate((speeds, -STIFFNESS @ positions - laws))

    reference = solve_ivp(
        rate,
        (0.0, trial.fine_time[-1]),
        [1.0, 1.0, 0.0, 0.0],
        t_eval=trial.fine_time,
        rtol=1e-10,
        atol=1e-12,
        method="DOP853",
    )
    np.testing.assert_allclose(trajectory.positions, reference.y[:2].T, atol=2e-4)
    np.testing.assert_allclose(trajectory.speeds, reference.y[2:].T, atol=5e-4)
