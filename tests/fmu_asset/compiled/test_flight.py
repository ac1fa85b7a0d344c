"""The compiled wing flies as the Python one does: equal outputs, equal refusals, a state that can be kept."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.variables import (
    STATUS_BAD_CALL,
    STATUS_BAD_STATE,
    STATUS_BAD_STEP,
    STATUS_INTERNAL,
    STATUS_NOT_FINITE,
    STATUS_OK,
    STATUS_OUTSIDE_RANGE,
)

OK, DISCARD, ERROR = 0, 2, 3
STRAIN, TIP, BOUND, LOAD_POINT, MODAL = slice(10, 34), 34, 35, 36, slice(37, 49)
"""Places in `everything()`, the real variables in order."""


def random_parameters(slave: Any, rng: np.random.Generator, *, overdamped: bool) -> dict[str, float]:
    variables = {v.name.replace(".", "__"): v for v in slave.description.variables}
    chosen = {
        name: float(rng.uniform(variables[name].minimum, variables[name].maximum))
        for name in ("young_modulus_factor", "mass__servo", "mass__pitot")
    }
    chosen["damping__alpha"] = float(rng.uniform(60.0, 900.0) if overdamped else rng.uniform(0.5, 3.0))
    chosen["damping__beta"] = float(rng.uniform(3e-4, 2e-2 if overdamped else 1e-3))
    return chosen | {"initial_tip_displacement": float(rng.uniform(-0.1, 0.1))}


def random_inputs(slave: Any, rng: np.random.Generator, former: list[float]) -> list[float]:
    """Change some of the inputs: health mostly stays, and a load is often none at all."""
    inputs = list(former)
    limits = [(v.minimum, v.maximum) for v in slave.description.variables[:4]]
    for index, chance in enumerate((0.5, 0.3, 0.3, 0.5)):
        if rng.random() < chance:
            inputs[index] = float(rng.uniform(*limits[index]))
    if rng.random() < 0.2:
        inputs[3 * int(rng.integers(2))] = 0.0
    return inputs


class Comparison:
    """Compares to 1e-12: strains and tip with the largest of the flight so far, modal outputs with each."""

    def __init__(self) -> None:
        self.strain, self.tip = 0.0, 0.0

    def __call__(self, ours: list[float], expected: list[float]) -> None:
        self.strain = max(self.strain, *map(abs, expected[STRAIN]))
        self.tip = max(self.tip, abs(expected[TIP]))
        # The bound is made of strains that cancel, so that its digits end where those of the strains do.
        scales = ((STRAIN, self.strain), (BOUND, self.strain), (TIP, self.tip), (LOAD_POINT, self.tip))
        for place, scale in scales:
            np.testing.assert_allclose(ours[place], expected[place], rtol=0.0, atol=1e-12 * scale)
        np.testing.assert_allclose(ours[MODAL], expected[MODAL], rtol=1e-12)


def fly_side_by_side(one: Any, two: Any, seed: int, *, response: int, overdamped: bool, steps: int) -> None:
    rng = np.random.default_rng(seed)
    parameters = random_parameters(one, rng, overdamped=overdamped)
    for slave in (one, two):
        slave.fmu.reset()
        assert slave.start(response=response, **parameters) == OK, slave.log
    inputs, time = [1.0, 0.0, 0.0, 0.0], 0.0
    compare = Comparison()
    compare(one.everything(), two.everything())
    for _ in range(steps):
        inputs = random_inputs(one, rng, inputs)
        size = float(rng.choice([1e-4, 1e-3, 0.01, 0.1, 1.0]))
        for slave in (one, two):
            assert slave.step(inputs, time, size) == OK, slave.log
        time += size
        compare(one.everything(), two.everything())


@pytest.mark.parametrize(
    ("response", "overdamped"), [(1, False), (2, False), (2, True)], ids=["steady", "transient", "overdamped"]
)
def test_outputs_equal_those_of_the_python_fmu(
    slave: Any, python_slave: Any, response: int, overdamped: bool
) -> None:
    for seed in range(12):
        fly_side_by_side(slave, python_slave, seed, response=response, overdamped=overdamped, steps=25)


def test_an_undamped_ringdown_equals_that_of_the_python_fmu(slave: Any, python_slave: Any) -> None:
    for one in (slave, python_slave):
        assert (
            one.start(response=2, damping__alpha=0.0, damping__beta=0.0, initial_tip_displacement=0.1) == OK
        )
    compare = Comparison()
    for index in range(100):
        for one in (slave, python_slave):
            assert one.step([1.0, 0.5 if index > 50 else 0.0, 0.0, 0.0], 0.002 * index, 0.002) == OK
        compare(slave.everything(), python_slave.everything())


# ---------------------------------------------------------------------------------- refusals


def test_refusals_have_the_status_of_the_python_fmu_and_change_nothing(slave: Any, python_slave: Any) -> None:
    good = [2.0, 0.1, 0.2, 1.0]
    for one in (slave, python_slave):
        one.start(response=2, initial_tip_displacement=0.01)
        assert one.step(good, 0.0, 0.01) == OK
    before = slave.everything()
    for index, value, size, status in (
        (0, 1e9, 0.01, STATUS_OUTSIDE_RANGE),
        (1, -1e-3, 0.01, STATUS_OUTSIDE_RANGE),
        (2, math.nan, 0.01, STATUS_NOT_FINITE),
        (3, -math.inf, 0.01, STATUS_NOT_FINITE),
        (0, 1.0, 0.0, STATUS_BAD_STEP),
        (0, 1.0, -1.0, STATUS_BAD_STEP),
        (0, 1.0, math.nan, STATUS_BAD_STEP),
        (0, 1.0, math.inf, STATUS_BAD_STEP),
    ):
        wrong = [value if k == index else given for k, given in enumerate(good)]
        for one in (slave, python_slave):
            assert one.step(wrong, 0.01, size) == DISCARD
            assert one.status == status
        name = slave.description.variables[index].name
        assert status == STATUS_BAD_STEP or slave.log[-1][1].startswith(name)
        assert slave.log[-1][0] == DISCARD
        assert slave.everything()[10:] == before[10:]
    for time in (0.0, 0.5, math.nan):
        for one in (slave, python_slave):
            assert one.step(good, time, 0.01) == DISCARD
            assert one.status == STATUS_BAD_STEP
    assert slave.status_of(slave.fmu.getRealStatus, 2) == OK
    for one in (slave, python_slave):
        assert one.step(good, 0.01, 0.01) == OK
        assert one.status == STATUS_OK
    Comparison()(slave.everything(), python_slave.everything())


def test_calls_in_the_wrong_phase_are_errors(slave: Any) -> None:
    fmu, reference = slave.fmu, slave.reference
    assert slave.step([1.0, 0.0, 0.0, 0.0], 0.0, 1.0) == ERROR
    assert slave.log[-1] == (ERROR, "a step was asked for before initialisation")
    assert slave.status_of(fmu.exitInitializationMode) == ERROR
    assert slave.status_of(fmu.setupExperiment, None, math.nan) == ERROR
    assert slave.start() == OK
    assert slave.status_of(fmu.enterInitializationMode) == DISCARD
    for call in (
        lambda: fmu.setReal([reference["mass.servo"]], [0.2]),
        lambda: fmu.setInteger([reference["response"]], [2]),
        lambda: fmu.setReal([reference["strain[1]"]], [1.0]),
        lambda: fmu.setReal([reference["response"]], [1.0]),
        lambda: fmu.setReal([999], [1.0]),
        lambda: fmu.setBoolean([0], [True]),
        lambda: fmu.setString([0], ["x"]),
    ):
        before = slave.everything()
        assert slave.status_of(call) == DISCARD
        assert slave.status == STATUS_BAD_CALL
        assert slave.everything() == before
    for call in (
        lambda: fmu.getReal([999]),
        lambda: fmu.getReal([reference["status"]]),
        lambda: fmu.getInteger([reference["strain[1]"]]),
    ):
        assert slave.status_of(call) == ERROR
    assert slave.step([1.0, 0.0, 0.0, 0.0], 0.0, 1.0) == OK
    fmu.terminate()
    assert slave.step([1.0, 0.0, 0.0, 0.0], 1.0, 1.0) == ERROR
    assert slave.everything()[10] != 0.0
    assert slave.status_of(fmu.reset) == OK
    assert slave.start() == OK


@pytest.mark.parametrize(
    ("name", "value", "right"),
    [("mass.servo", 9.0, 0.17), ("damping.alpha", math.nan, 0.0), ("response", 3, 1)],
)
def test_parameters_that_are_refused_stop_the_start(slave: Any, name: str, value: Any, right: Any) -> None:
    key = name.replace(".", "__")
    assert slave.start(**{key: value}) == ERROR
    assert slave.status in (STATUS_OUTSIDE_RANGE, STATUS_NOT_FINITE)
    assert slave.log[-1][1].startswith(name)
    assert slave.step([1.0, 0.0, 0.0, 0.0], 0.0, 1.0) == ERROR
    assert slave.start(**{key: right}) == OK
    assert slave.step([1.0, 0.0, 0.0, 0.0], 0.0, 1.0) == OK


def test_outputs_can_be_read_while_initialising(slave: Any, python_slave: Any) -> None:
    for one in (slave, python_slave):
        one.fmu.setupExperiment(startTime=3.0)
        one.fmu.enterInitializationMode()
        one.fmu.setReal([0], [2.5])
        one.everything()
        one.fmu.setReal([0, 1], [3.5, 0.4])
    Comparison()(slave.everything(), python_slave.everything())
    for one in (slave, python_slave):
        one.fmu.exitInitializationMode()
        assert one.step([3.5, 0.4, 0.0, 0.0], 3.0, 0.5) == OK


# ---------------------------------------------------------------------------------- state and instances


@pytest.mark.parametrize("response", [1, 2])
def test_a_restored_state_has_the_same_future_to_the_bit(slave: Any, other_slave: Any, response: int) -> None:
    rng = np.random.default_rng(3)
    assert slave.start(response=response, initial_tip_displacement=0.03, damping__alpha=1.5) == OK
    inputs, time = [1.0, 0.0, 0.0, 0.0], 0.0
    for step in range(30):
        inputs = random_inputs(slave, rng, inputs)
        assert slave.step(inputs, time, 0.05) == OK
        time += 0.05
        if step % 10 == 9:
            assert other_slave.restore(slave.saved()) == OK
            assert other_slave.everything() == slave.everything()
            assert other_slave.saved() == slave.saved()
        elif step >= 10:
            assert other_slave.step(inputs, time - 0.05, 0.05) == OK
            assert other_slave.everything() == slave.everything()


def test_the_past_of_an_instance_does_not_show(slave: Any, other_slave: Any) -> None:
    """What an instance has kept of other states of health never changes a bit of its outputs."""
    rng = np.random.default_rng(11)
    assert slave.start(response=2, young_modulus_factor=1.05, mass__pitot=0.11) == OK
    inputs = [1.0, 0.0, 0.0, 0.0]
    for index in range(20):
        inputs = random_inputs(slave, rng, inputs)
        assert slave.step(inputs, 0.1 * index, 0.1) == OK
        slave.everything()
    slave.fmu.reset()
    for one in (slave, other_slave):
        assert one.start(response=2, initial_tip_displacement=0.02, mass__pitot=0.13) == OK
        for index in range(10):
            assert one.step([2.0, 0.1 * (index // 3), 0.0, 0.0], 0.1 * index, 0.1) == OK
    assert slave.everything() == other_slave.everything()


def test_states_of_something_else_are_refused(slave: Any, python_slave: Any) -> None:
    assert slave.start(response=2) == OK
    assert python_slave.start() == OK
    state = slave.saved()
    before = slave.everything()
    foreign = state[:8] + bytes([state[8] ^ 1]) + state[9:]
    bad_count = state[:24] + b"\xff\xff\xff\xff" + state[28:]
    not_finite = state[:-8] + np.float64(math.nan).tobytes()
    too_short = state[:24] + (20).to_bytes(4, "little") + state[28 : 28 + 160]
    for wrong in (b"", b"x" * 500, state[:-8], state + b"12345678", foreign, bad_count, not_finite, too_short,
                  python_slave.saved()):  # fmt: skip
        assert slave.restore(wrong) == ERROR
        assert slave.status == STATUS_BAD_STATE
        assert "was not restored" in slave.log[-1][1]
    assert slave.everything()[:36] == before[:36]
    assert slave.step([1.0, 0.0, 0.0, 0.0], 0.0, 1.0) == OK


def test_two_instances_do_not_touch_each_other(
    slave: Any, compiled_fmu: Path, open_slave: Callable[..., Any]
) -> None:
    """Two instances of one loaded library, each in a thread of its own, give what each gives alone."""

    def fly(one: Any, seed: int, seen: list[list[float]]) -> None:
        rng = np.random.default_rng(seed)
        one.fmu.reset()
        one.start(response=2, initial_tip_displacement=0.05)
        inputs = [1.0, 0.0, 0.0, 0.0]
        for index in range(300):
            inputs = random_inputs(one, rng, inputs)
            one.step(inputs, 0.01 * index, 0.01)
            seen.append(one.everything())

    with closing(open_slave(compiled_fmu, like=slave)) as twin:
        alone: list[list[list[float]]] = [[], []]
        together: list[list[list[float]]] = [[], []]
        for index, one in enumerate((slave, twin)):
            fly(one, index, alone[index])
        with ThreadPoolExecutor(2) as threads:
            list(threads.map(fly, (slave, twin), (0, 1), together))
        assert together == alone
        assert alone[0] != alone[1]


def test_six_hundred_instances_leave_no_memory_behind(
    compiled_fmu: Path, slave: Any, open_slave: Callable[..., Any]
) -> None:
    resident = []
    for number in range(600):
        with closing(open_slave(compiled_fmu, like=slave)) as one:
            assert one.start(response=2) == OK
            assert one.step([2.0, 0.1, 0.0, 0.0], 0.0, 0.1) == OK
            one.saved()
        if number in (99, 599):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            resident.append(pages * os.sysconf("SC_PAGE_SIZE"))
    # One instance holds about half a megabyte.
    assert resident[1] - resident[0] < 4_000_000


def test_a_stiffness_that_cannot_be_is_an_internal_refusal(
    compiler: list[str], open_slave: Callable[..., Any], tmp_path: Path, model: Any
) -> None:
    """A model that is not positive definite within its own validity box: nothing changes, nothing crashes."""
    box = model.validity_box.copy()
    box[1] = (0.0, 5.0)
    broken = build_fmu(replace(model, validity_box=box), tmp_path / "broken.fmu", kind="compiled").path
    with closing(open_slave(broken)) as one:
        assert one.start() == OK
        assert one.step([1.0, 0.1, 0.0, 0.0], 0.0, 1.0) == OK
        before = one.everything()
        assert one.step([1.0, 4.0, 0.0, 0.0], 1.0, 1.0) == DISCARD
        assert one.status == STATUS_INTERNAL
        assert "not positive definite" in one.log[-1][1]
        assert one.everything()[10:] == before[10:]
        assert one.step([1.0, 0.2, 0.0, 0.0], 1.0, 1.0) == OK
