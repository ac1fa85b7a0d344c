"""What holds of every asset: of our own FMUs, of others, and of systems of several."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.client.observations import Observation
from fmu_asset.client.saved_state import SavedState
from fmu_asset.client.session import FmiAsset
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.errors import FmuInputError, FmuStateError
from tests.fmu_asset.client.kinds import INPUTS, KINDS, STEPS, Kind
from tests.fmu_asset.coupling.reference import coupled, of_ours
from tests.fmu_asset.ours import NAMES, OurFmus

Open = Callable[..., FmiAsset]
Bits = list[tuple[bytes, bytes, float]]


@pytest.fixture
def open_asset(ours: OurFmus, foreign_fmu: Any, scratch: Path) -> Iterator[Open]:
    """Open an asset of a kind; of all of them nothing is left behind."""

    def opened(kind: Kind, **options: Any) -> FmiAsset:
        given = {"parameters": kind.parameters, **options}
        if kind.file == "three":
            return CoupledAsset(of_ours(ours), kind.binding, **given)
        if kind.file.startswith("oscillator"):
            algorithm = {"algorithm": "jacobi"} if kind.file.endswith("jacobi") else {}
            return CoupledAsset(
                coupled("oscillator", foreign_fmu), kind.binding, **algorithm, **given
            )
        file = ours(kind.file) if kind.file in NAMES else foreign_fmu(kind.file)
        return FmiAsset(file, kind.binding, **given)

    def there() -> tuple[list[str], int, set[str]]:
        modules = {name for name in sys.modules if name.startswith(("uav_wing_", "SpringMass"))}
        return list(sys.path), len(list(Path("/proc/self/fd").iterdir())), modules

    before = there()
    yield opened
    path, descriptors, modules = there()
    assert (path, modules) == (before[0], before[2])
    assert descriptors <= before[1]  # what came before may be closed only now
    assert not list(scratch.iterdir())


def bits(seen: Observation) -> tuple[bytes, bytes, float]:
    return seen.values.tobytes(), np.array(list(seen.extra.values())).tobytes(), seen.time


def flown(asset: FmiAsset, kind: Kind, steps: range) -> Bits:
    return [bits(asset.step(**kind.at(index))) for index in steps]


def onwards(asset: FmiAsset, kind: Kind) -> Bits:
    """Fly the second half, after a step that keeps the inputs of the last one."""
    return [bits(asset.step()), *flown(asset, kind, range(STEPS // 2, STEPS))]


IN_A_WORKER = (
    "wing in motion",
    "compiled wing in motion",
    "wing of FMI 3 in motion",
    "model exchange wing of FMI 3 in motion",
    "spring",
    "FMI 1",
    "FMI 2 of a Modelica tool",
    "whole arrays",
    "model exchange of FMI 3 with a time event",
    "lines in model exchange",
    "a system",
)
"""One of each sort: how packed, version, interface, way of states, arrays, lines."""


@pytest.mark.parametrize("name", KINDS)
def test_many_steps_in_one_go_are_single_ones_and_those_of_the_oracle(
    open_asset, ours, name
) -> None:
    kind, ways = KINDS[name], (False, True) if name in IN_A_WORKER else (False,)
    with open_asset(kind, isolated=False) as one:
        one.reset(**kind.start)
        single = flown(one, kind, range(STEPS))
        now, following = SavedState.from_bytes(one.save_state()), bits(one.step())
    for isolated in ways:
        with open_asset(kind, isolated=isolated) as whole:
            whole.reset(**kind.start)
            history = whole.simulate(**kind.course, steps=STEPS)
            extra = np.array(list(history.extra.values())).reshape(-1, STEPS).T
            rows = zip(history.values, extra, history.time, strict=True)
            assert [(row.tobytes(), more.tobytes(), time) for row, more, time in rows] == single
            # All are in the same state, and the inputs are held. An FMU may write addresses into
            # its own.
            saved = SavedState.from_bytes(whole.save_state())
            assert saved.model_copy(update={"body": b""}) == now.model_copy(update={"body": b""})
            assert kind.state == "serialised" or saved.body == now.body
            assert bits(whole.step()) == following
    moments = [
        kind.binding.binding.start_time + k * kind.binding.interval for k in range(1, STEPS + 1)
    ]
    assert history.time.tolist() == moments  # never accumulated
    if kind.oracle is None:
        return
    values, more = kind.oracle(kind, ours)
    within = {"rtol": kind.rtol, "atol": kind.atol + kind.largest * np.abs(values).max()}
    np.testing.assert_allclose(history.values, values, **within)
    for name, expected in more.items():
        np.testing.assert_allclose(history.extra[name], expected, **within)


@pytest.mark.parametrize("name", KINDS)
def test_a_state_goes_on_to_the_bit_and_copies_go_their_own_way(open_asset, name) -> None:
    kind, isolated = KINDS[name], name in IN_A_WORKER
    half = range(STEPS // 2)
    with (
        open_asset(kind, isolated=isolated) as asset,
        open_asset(kind, parameters={}, isolated=False) as other,
    ):
        assert asset.state_method == kind.state
        asset.reset(**kind.start)
        begin = flown(asset, kind, half)
        saved = asset.save_state()
        assert asset.save_state() == saved
        fork, sibling = asset.fork(), asset.sibling()
        there = onwards(fork, kind)
        sibling.reset(**kind.start)
        assert flown(sibling, kind, half) == begin
        sibling.close()
        assert onwards(asset, kind) == there
        fork.close()
        # Back in the same instance, and in another one here: the first may be in another process.
        other.step(**kind.at(1))
        for one in (asset, other):
            one.restore_state(saved)
            assert one.step_index == len(half)
            assert onwards(one, kind) == there
        for again in (asset.reset, asset.reset, asset.renew):
            again(**kind.start)
            assert flown(asset, kind, half) == begin
        assert (
            asset.reset_trial.works is not False or kind.file == "decay1"
        )  # FMI 1 has none for it
        asset.close()
        for refused, words in (
            (asset.step, "closed; reset"),
            (asset.save_state, "no state to save"),
        ):
            with pytest.raises(FmuStateError, match=words):
                refused()
        asset.reset()
        assert asset.observe().time == kind.binding.binding.start_time


@pytest.mark.parametrize(("name", "inputs", "sentence"), INPUTS["refused"])
def test_what_is_refused_is_not_sent(open_asset, name, inputs, sentence) -> None:
    kind = KINDS[name]
    with open_asset(kind, isolated=False) as asset, open_asset(kind, isolated=False) as other:
        for one in (asset, other):
            one.step(**kind.at(0))
        with pytest.raises(FmuInputError, match=sentence):
            asset.step(**inputs)
        assert asset.step_index == 1
        assert asset.log == ()
        assert bits(asset.step()) == bits(other.step())


@pytest.mark.parametrize("name", ["wing", "spring", "a system with a wing"])
def test_a_state_of_something_else_is_refused(open_asset, name) -> None:
    kind, foreign = KINDS[name], KINDS["spring" if name == "wing" else "wing"]
    with open_asset(foreign, isolated=False) as other:
        other.step(**foreign.at(0))
        foreign_state = other.save_state()
    with open_asset(kind, isolated=False) as asset:
        asset.reset(**kind.start)
        asset.step(**kind.at(0))
        saved = asset.save_state()
        with pytest.raises(FmuStateError, match="another FMU"):
            asset.restore_state(foreign_state)
        for wrong in (b"", b"x" * 40, b"x" + saved[1:], saved[:30]):
            with pytest.raises(
                FmuStateError, match=r"not a state of .*, or it is damaged|is damaged"
            ):
                asset.restore_state(wrong)
        after = bits(asset.step(**kind.at(1)))  # it is where it was
        with pytest.raises(FmuStateError):
            asset.restore_state(saved[:-1])
        asset.restore_state(saved)
        assert bits(asset.step(**kind.at(1))) == after
        if name == "wing":  # what the FMU itself refuses
            with pytest.raises(FmuStateError, match="refused the state"):
                asset.restore_state(saved[:-40] + b"\0" * 8)
            with pytest.raises(FmuStateError, match="reset the asset"):
                asset.step()
            asset.reset(**kind.start)
            assert asset.step(**kind.at(0)).time == kind.binding.interval
