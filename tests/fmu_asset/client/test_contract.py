"""What holds of every asset: of our own FMUs, of others, and of systems of several."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Flight:
    """All steps of a course, and where they lead.

    Attributes
    ----------
    steps : list
        What each step showed.
    end : SavedState
        The state after the last one.
    following : tuple
        What one more step shows, with the inputs of the last one.
    history : Observation
        All steps of one call; None if each had its own.
    """

    steps: Bits
    end: SavedState
    following: tuple[bytes, bytes, float]
    history: Observation | None = None


@pytest.fixture(scope="module")
def flights() -> dict[object, Any]:
    """What was flown for several tests, by kind and way."""
    return {}


@pytest.fixture
def single_steps(open_asset: Open, flights: dict[object, Any], name: str) -> Flight:
    """The course of a kind, flown step by step in this process."""
    kind, key = KINDS[name], (name, "single steps")
    if key not in flights:
        with open_asset(kind, isolated=False) as asset:
            asset.reset(**kind.start)
            steps = flown(asset, kind, range(STEPS))
            end = SavedState.from_bytes(asset.save_state())
            flights[key] = Flight(steps, end, bits(asset.step()))
    return flights[key]


@pytest.fixture
def one_call(open_asset: Open, flights: dict[object, Any], name: str, isolated: bool) -> Flight:
    """The same course, flown by one call, in this process or in a worker."""
    kind, key = KINDS[name], (name, "one call", isolated)
    if key not in flights:
        with open_asset(kind, isolated=isolated) as asset:
            asset.reset(**kind.start)
            history = asset.simulate(**kind.course, steps=STEPS)
            extra = np.array(list(history.extra.values())).reshape(-1, STEPS).T
            rows = zip(history.values, extra, history.time, strict=True)
            steps = [(row.tobytes(), more.tobytes(), time) for row, more, time in rows]
            end = SavedState.from_bytes(asset.save_state())
            flights[key] = Flight(steps, end, bits(asset.step()), history)
    return flights[key]


ONE_CALLS = [
    (name, isolated) for name in KINDS for isolated in (False, True)[: 1 + (name in IN_A_WORKER)]
]
each_call = pytest.mark.parametrize(("name", "isolated"), ONE_CALLS)


@each_call
def test_many_steps_in_one_go_are_single_ones(one_call, single_steps) -> None:
    assert one_call.steps == single_steps.steps


@each_call
def test_many_steps_in_one_go_lead_to_the_state_of_single_ones(
    name, one_call, single_steps
) -> None:
    """The inputs are held. An FMU may write addresses into a state of its own."""
    end, expected = one_call.end, single_steps.end
    assert end.model_copy(update={"body": b""}) == expected.model_copy(update={"body": b""})
    assert KINDS[name].state == "serialised" or end.body == expected.body
    assert one_call.following == single_steps.following


@each_call
def test_moments_of_many_steps_are_never_accumulated(name, one_call) -> None:
    binding = KINDS[name].binding
    start = binding.binding.start_time
    moments = [start + number * binding.interval for number in range(1, STEPS + 1)]
    assert one_call.history.time.tolist() == moments


@pytest.mark.parametrize(("name", "isolated"), [row for row in ONE_CALLS if KINDS[row[0]].oracle])
def test_a_course_is_that_of_its_oracle(name, one_call, ours) -> None:
    kind, history = KINDS[name], one_call.history
    values, more = kind.oracle(kind, ours)
    within = {"rtol": kind.rtol, "atol": kind.atol + kind.largest * np.abs(values).max()}
    np.testing.assert_allclose(history.values, values, **within)
    for output, expected in more.items():
        np.testing.assert_allclose(history.extra[output], expected, **within)


@dataclass(frozen=True)
class Continuations:
    """How an asset and its copies went on from the middle of a course.

    Attributes
    ----------
    state_method : str
        How the asset keeps its state.
    first_half : list
        What the asset showed until then.
    saved, saved_again : bytes
        Its state there, of two calls.
    asset, fork : list
        The second half, by the asset and by a fork of it.
    sibling : list
        The first half, by a sibling that was reset.
    restored : list
        The number of steps at the state, and the second half, by the asset and by another one that
        took the state over.
    begun_again : list
        The first half after two resets and a renewal of the asset.
    reset_works : bool or None
        Whether the FMU was found to reset.
    """

    state_method: str
    first_half: Bits
    saved: bytes
    saved_again: bytes
    asset: Bits
    fork: Bits
    sibling: Bits
    restored: list[tuple[int, Bits]]
    begun_again: list[Bits]
    reset_works: bool | None


def continuations(asset: FmiAsset, other: FmiAsset, kind: Kind) -> Continuations:
    """Fly half of a course, then go on by all ways; the other asset may be in another process."""
    half = range(STEPS // 2)
    asset.reset(**kind.start)
    first_half = flown(asset, kind, half)
    saved, saved_again = asset.save_state(), asset.save_state()
    with asset.fork() as fork, asset.sibling() as sibling:
        by_fork = onwards(fork, kind)
        sibling.reset(**kind.start)
        by_sibling = flown(sibling, kind, half)
        sibling.close()
        by_asset = onwards(asset, kind)
    other.step(**kind.at(1))
    restored = []
    for one in (asset, other):
        one.restore_state(saved)
        restored.append((one.step_index, onwards(one, kind)))
    begun_again = []
    for begin in (asset.reset, asset.reset, asset.renew):
        begin(**kind.start)
        begun_again.append(flown(asset, kind, half))
    return Continuations(
        state_method=asset.state_method,
        first_half=first_half,
        saved=saved,
        saved_again=saved_again,
        asset=by_asset,
        fork=by_fork,
        sibling=by_sibling,
        restored=restored,
        begun_again=begun_again,
        reset_works=asset.reset_trial.works,
    )


@pytest.fixture
def continued(open_asset: Open, flights: dict[object, Any], name: str) -> Continuations:
    """How an asset of a kind goes on from the middle of its course."""
    kind, key = KINDS[name], (name, "continuations")
    if key not in flights:
        with (
            open_asset(kind, isolated=name in IN_A_WORKER) as asset,
            open_asset(kind, parameters={}, isolated=False) as other,
        ):
            flights[key] = continuations(asset, other, kind)
    return flights[key]


each_kind = pytest.mark.parametrize("name", KINDS)


@each_kind
def test_a_state_is_kept_as_its_kind_says_and_saving_changes_nothing(name, continued) -> None:
    assert continued.state_method == KINDS[name].state
    assert continued.saved_again == continued.saved


@each_kind
def test_a_fork_goes_on_to_the_bit_and_a_sibling_begins_anew(continued) -> None:
    assert continued.fork == continued.asset
    assert continued.sibling == continued.first_half


@each_kind
def test_a_state_goes_on_to_the_bit_in_its_instance_and_in_another(continued) -> None:
    assert continued.restored == [(STEPS // 2, continued.asset)] * 2


@each_kind
def test_an_asset_that_is_reset_or_renewed_flies_the_same_again(name, continued) -> None:
    assert continued.begun_again == [continued.first_half] * 3
    assert (
        continued.reset_works is not False or KINDS[name].file == "decay1"
    )  # FMI 1 has none for it


@each_kind
def test_a_closed_asset_refuses_until_it_is_reset(open_asset, name) -> None:
    kind = KINDS[name]
    with open_asset(kind, isolated=name in IN_A_WORKER) as asset:
        asset.close()
        with pytest.raises(FmuStateError, match="closed; reset"):
            asset.step()
        with pytest.raises(FmuStateError, match="no state to save"):
            asset.save_state()
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
