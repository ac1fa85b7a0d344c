"""Coupled linear systems against closed forms and against the recursion written out by hand."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from fmu_asset.coupling.asset import Algorithm, CoupledAsset
from fmu_asset.coupling.structure import Component
from fmu_asset.errors import AlgebraicLoopError, BindingError, CouplingError, FmuInputError, IterationError

from .conftest import linear, system, watch

M1, M2, K1, K2, KC, C1, CC = 1.0, 1.5, 4.0, 3.0, 2.0, 0.1, 0.2
START = np.array([1.0, 0.0, -0.5, 0.3])  # x1, v1, x2, v2
# The first mass is pushed by a force, the second one feels where the first one is and answers with the force.
A1, B1 = np.array([[0.0, 1.0], [-K1 / M1, -C1 / M1]]), np.array([[0.0, 0.0], [1.0 / M1, 0.0]])
A2 = np.array([[0.0, 1.0], [-(K2 + KC) / M2, -CC / M2]])
B2 = np.array([[0.0, 0.0], [KC / M2, CC / M2]])
C2, D2 = np.array([[KC, CC], [0.0, 0.0]]), np.array([[-KC, -CC], [0.0, 0.0]])


def oscillator(state_fmu: Path, linear_fmu: Path, substeps: int = 1):  # type: ignore[no-untyped-def]
    first = linear("first", state_fmu, substeps, a=A1, b=B1, c=np.eye(2), initial=START[:2])
    second = linear("second", linear_fmu, substeps, a=A2, b=B2, c=C2, d=D2, initial=START[2:])
    # Written in the wrong order on purpose: the order follows from the dependencies.
    return system(
        [second, first],
        [("first.y1", "second.u1"), ("first.y2", "second.u2"), ("second.y1", "first.u1")],
    )


def held(matrix: np.ndarray, inputs: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:] = matrix, inputs
    whole = expm(block * step)
    return whole[:2, :2], whole[:2, 2:]


def recursion(step: float, count: int, algorithm: Algorithm) -> np.ndarray:
    """Return positions and force of the oscillator, the coupling written out by hand."""
    (p1, q1), (p2, q2) = held(A1, B1, step), held(A2, B2, step)
    x, z = START[:2], START[2:]
    force = (C2 @ z + D2 @ x)[0]
    rows = []
    for _ in range(count):
        old = x
        x = p1 @ x + q1 @ [force, 0.0]
        seen = old if algorithm == "jacobi" else x
        z = p2 @ z + q2 @ seen
        force = (C2 @ z + D2 @ seen)[0]
        rows.append([*x, force])
    return np.array(rows)


@pytest.mark.parametrize("algorithm", ["gauss_seidel", "jacobi"])
def test_an_oscillator_of_two_fmus_is_the_recursion_written_by_hand(
    state_fmu: Path, linear_fmu: Path, algorithm: Algorithm
) -> None:
    binding = watch("first.y1", "first.y2", "second.y1", step_size=0.05)
    with CoupledAsset(
        oscillator(state_fmu, linear_fmu), binding, algorithm=algorithm, isolated=False
    ) as asset:
        assert asset.schedule.order == ("first", "second")
        assert asset.schedule.loops == ()
        seen = np.array([asset.step().values for _ in range(40)])
        assert asset.time == 40 * 0.05
    np.testing.assert_allclose(seen, recursion(0.05, 40, algorithm), rtol=1e-12, atol=1e-13)


def test_several_steps_in_one(state_fmu: Path, linear_fmu: Path) -> None:
    """With inputs held, an exact component comes to the same place in one step and in four."""
    results = []
    for substeps in (1, 4):
        with CoupledAsset(
            oscillator(state_fmu, linear_fmu, substeps), watch("first.y1", step_size=0.1), isolated=False
        ) as asset:
            results.append([asset.step().values[0] for _ in range(10)])
    np.testing.assert_allclose(results[0], results[1], rtol=1e-12)


def test_what_is_no_number_of_steps_or_no_role_is_refused(state_fmu: Path, linear_fmu: Path) -> None:
    pair, binding = oscillator(state_fmu, linear_fmu), watch("first.y1", step_size=0.1)
    with CoupledAsset(pair, binding, isolated=False) as asset:
        for steps in (0, -1):
            with pytest.raises(FmuInputError, match=f"steps must be at least 1, but is {steps}"):
                asset.simulate(steps=steps)
        assert len(asset.simulate(steps=1).time) == 1
        with pytest.raises(TypeError, match="Inputs are control, health, load, port, and 'contrl' came"):
            asset.reset(contrl={})  # type: ignore[call-arg]
        assert asset.step_index == 1


def test_a_chain_gives_in_one_step_what_one_system_would(linear_fmu: Path) -> None:
    """Direct feedthrough through three FMUs, written backwards, arrives in the same step."""
    gains = {"third": 5.0, "second": 3.0, "first": 2.0}
    parts = [linear(name, linear_fmu, d=np.diag([gain, 1.0])) for name, gain in gains.items()]
    chain = system(
        parts,
        [("push", "first.u1"), ("first.y1", "second.u1"), ("second.y1", "third.u1"), ("third.y1", "out")],
    )
    with CoupledAsset(chain, watch("out", inputs=["push"]), isolated=False) as asset:
        assert asset.schedule.order == ("first", "second", "third")
        assert asset.step({"push": 0.7}).values[0] == 2.0 * 0.7 * 3.0 * 5.0
    with CoupledAsset(chain, watch("out", inputs=["push"]), algorithm="jacobi", isolated=False) as asset:
        seen = [asset.step({"push": 0.7}).values[0] for _ in range(3)]
    np.testing.assert_allclose(seen, [0.0, 0.0, 21.0])  # one FMU further in each step


def loop_of(linear_fmu: Path, gain: float):  # type: ignore[no-untyped-def]
    """y = gain u' + 1 and u' = -0.3 y + 2: the constants are states that do not move."""
    first = np.diag([1.0, 0.0])
    left = linear("left", linear_fmu, c=first, d=gain * first, initial=(1.0, 0.0))
    right = linear("right", linear_fmu, c=first, d=-0.3 * first, initial=(2.0, 0.0))
    return system([left, right], [("left.y1", "right.u1"), ("right.y1", "left.u1")])


def test_an_algebraic_loop_is_reported(linear_fmu: Path) -> None:
    with pytest.raises(AlgebraicLoopError) as caught:
        CoupledAsset(loop_of(linear_fmu, 0.5), watch("left.y1"))
    sentence = str(caught.value)
    assert "left.y1 -> right.u1 -> right.y1 -> left.u1" in sentence
    assert "delay one of its connections, allow iterations, or take the algorithm jacobi" in sentence


def test_a_loop_is_broken_by_a_delay_and_by_jacobi(linear_fmu: Path) -> None:
    """y = 0.5 u + 1, u of the last step; u = 2 - 0.3 y, y of this step, but of the last one by Jacobi."""
    loop = loop_of(linear_fmu, 0.5)
    for structure, algorithm, lag in ((loop.delayed(["left.u1"]), "gauss_seidel", 0), (loop, "jacobi", 1)):
        with CoupledAsset(
            structure, watch("left.y1", "right.y1"), algorithm=algorithm, isolated=False
        ) as asset:
            seen = [asset.observe().values, *(asset.step().values for _ in range(5))]
        for (before_y, before_u), (y, u) in itertools.pairwise(seen):
            np.testing.assert_allclose([y, u], [1.0 + 0.5 * before_u, 2.0 - 0.3 * (before_y if lag else y)])
    with pytest.raises(CouplingError, match=r"ends at left\.u2.*connections end at right\.u1, left\.u1"):
        loop.delayed(["left.u2"])


@pytest.mark.parametrize("algorithm", ["gauss_seidel", "jacobi"])
def test_iterations_solve_an_algebraic_loop(linear_fmu: Path, algorithm: Algorithm) -> None:
    options = {"algorithm": algorithm, "iterations": 60, "tolerance": 1e-12, "isolated": False}
    with CoupledAsset(loop_of(linear_fmu, 0.5), watch("left.y1", "right.y1"), **options) as asset:
        seen = asset.step().values
    y = (1.0 + 0.5 * 2.0) / (1.0 + 0.5 * 0.3)
    np.testing.assert_allclose(seen, [y, 2.0 - 0.3 * y], rtol=1e-11)


def test_iterations_that_do_not_settle(linear_fmu: Path) -> None:
    with (
        CoupledAsset(loop_of(linear_fmu, -7.0), watch("left.y1"), iterations=8, isolated=False) as asset,
        pytest.raises(IterationError, match=r"left, right did not settle in 8 iterations.*still changes by"),
    ):
        asset.step()


def test_iterations_make_the_coupling_implicit(state_fmu: Path, linear_fmu: Path) -> None:
    """Settled, each FMU has the other's values of the end of the step, whichever algorithm led there."""
    results, binding = [], watch("first.y1", "first.y2", "second.y1", step_size=0.1)
    for algorithm in ("gauss_seidel", "jacobi"):
        options = {"algorithm": algorithm, "iterations": 80, "tolerance": 1e-13, "isolated": False}
        with CoupledAsset(oscillator(state_fmu, linear_fmu), binding, **options) as asset:
            results.append([asset.step().values for _ in range(5)])
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9, atol=1e-11)
    (p1, q1), (p2, q2) = held(A1, B1, 0.1), held(A2, B2, 0.1)
    x, z = START[:2], START[2:]
    for row in results[0]:
        # x' = P1 x + q F', z' = P2 z + Q2 x', F' = C z' + D x': a linear system for F'.
        free = C2[0] @ (p2 @ z + q2 @ p1 @ x) + D2[0] @ p1 @ x
        slope = (C2[0] @ q2 + D2[0]) @ q1[:, 0]
        force = free / (1.0 - slope)
        x = p1 @ x + q1[:, 0] * force
        z = p2 @ z + q2 @ x
        np.testing.assert_allclose(row, [*x, force], rtol=1e-9)


def test_components_in_a_circle_without_a_loop_of_variables(crossed_fmu: Path) -> None:
    """Two FMUs that feed each other through different variables: no loop, but one value is a step old."""
    parts = [linear("left", crossed_fmu, d=np.diag([2, 3])), linear("right", crossed_fmu, d=np.diag([5, 1]))]
    joined = system(parts, [("push", "left.u1"), ("left.y1", "right.u1"), ("right.y1", "left.u2")])
    with CoupledAsset(joined, watch("left.y2", inputs=["push"]), isolated=False) as asset:
        assert asset.schedule.loops == ()
        assert [str(link.source) for link in asset.schedule.held] == ["right.y1"]
        assert [asset.step({"push": 1.0}).values[0] for _ in range(2)] == [0.0, 30.0]
    with CoupledAsset(joined, watch("left.y2", inputs=["push"]), iterations=5, isolated=False) as asset:
        assert asset.step({"push": 1.0}).values[0] == 30.0


def test_iterations_need_a_state_that_can_be_restored(spring_mass: Path, linear_fmu: Path) -> None:
    parts = [Component("spring", spring_mass), linear("law", linear_fmu, d=np.eye(2))]
    joined = system(parts, [("spring.position", "law.u1"), ("law.y1", "spring.force")])
    with pytest.raises(CouplingError, match="component 'spring' cannot save and restore its state"):
        CoupledAsset(joined, watch("law.y1"), iterations=3)


def test_a_binding_of_several_fmus_keeps_its_ranges_and_has_no_decimation(
    state_fmu: Path, linear_fmu: Path
) -> None:
    ends = [("push", "first.u1"), ("first.y1", "second.u1"), ("first.y2", "second.u2")]
    structure = system(oscillator(state_fmu, linear_fmu).components, ends)
    binding = watch("first.y1", inputs=["push"])
    limited = binding.control["push"].model_copy(update={"minimum": -1.0, "maximum": 2.0})
    ranged = binding.model_copy(update={"control": {"push": limited}})
    with CoupledAsset(structure, ranged, isolated=False) as asset:
        asset.step({"push": 2.0})
        before = asset.observe()
        with pytest.raises(FmuInputError, match=r"push = 2\.5 lies outside .* 'push', -1 to 2"):
            asset.step({"push": 2.5})
        assert asset.step_index == 1
        np.testing.assert_array_equal(asset.observe().values, before.values)
    header = binding.binding.model_copy(update={"decimation": 2})
    with pytest.raises(BindingError, match="watch of several FMUs has a decimation"):
        CoupledAsset(structure, binding.model_copy(update={"binding": header}), isolated=False)
