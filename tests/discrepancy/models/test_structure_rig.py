"""A structure as a model of the search, and its FMU by the file that is written beside it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.records import Quantity, Release, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.interface import Conditions, Model
from discrepancy.models.reduced_structure import StructureModel
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.patch import ModelPatch, PowerStiffness
from fe.runtime.reduced import ReducedModel
from fe.runtime.transient import ModalIntegrator
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures.rig import rig_text

OUTPUTS = (("tip", Quantity.DISPLACEMENT), ("g1", Quantity.STRAIN), ("shake", Quantity.ACCELERATION))
TRIAL = Trial.plain(
    "a trial", TrialKind.STATIC, (), 1e-4 * np.arange(40), force=np.linspace(-100.0, 200.0, 40), run="A"
)
RELEASED = replace(TRIAL, kind=TrialKind.RINGDOWN, force=np.zeros(40), release=Release(1e-4, mode_count=1))


@pytest.fixture(scope="module")
def pair(
    write_beam: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[FmuModel, ReducedModel]]:
    """The model of the search, and the reduced structure inside it."""
    folder = tmp_path_factory.mktemp("rig")
    file = write_beam(folder, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    reduced = reduce_structure(load_and_assemble(file), "beam").model
    fmu = build_fmu(reduced, folder / "beam.fmu").path
    path = folder / "rig.toml"
    path.write_text(rig_text(load_structure(file), os.path.relpath(fmu, folder)), encoding="utf-8")
    model = FmuModel.load(path)
    yield model, reduced
    model.close()


@pytest.fixture(params=["structure", "FMU"])
def either(request: pytest.FixtureRequest, pair: tuple[FmuModel, ReducedModel]) -> tuple[Model, ReducedModel]:
    """The structure itself, and its FMU."""
    model, reduced = pair
    return (StructureModel(reduced) if request.param == "structure" else model), reduced


def test_it_is_the_structure_at_rest(either: tuple[Model, ReducedModel]) -> None:
    """Static trials at other parameters and masses; without a recorded load factor there is no weight."""
    model, reduced = either
    assert [parameter.name for parameter in model.parameters] == ["e", "pump"]
    assert model.ports() == ("tip",)
    seen = model.respond(TRIAL, OUTPUTS[:2], ModelPatch(), Conditions(np.array([1.04, 0.06]))).values
    for force, values in zip(TRIAL.force, seen, strict=True):
        chosen = {"e": 1.04, "pump": 0.06, "load_factor": 0.0, "push": float(force)}
        found = reduced.static_response(chosen)
        np.testing.assert_allclose(values, [found.displacement[0], found.strain[0]], rtol=1e-10, atol=1e-15)


def test_it_is_the_structure_in_motion(either: tuple[Model, ReducedModel]) -> None:
    """A tip that is held aside and let go, with its acceleration."""
    model, reduced = either
    trial = replace(TRIAL, kind=TrialKind.RINGDOWN, force=np.zeros(40), release=Release(1e-4))
    seen = model.respond(trial, OUTPUTS, ModelPatch(), Conditions(np.array([1.0, 0.05]))).values
    unit = reduced.static_response({"load_factor": 0.0, "push": 1.0}).displacement[0]
    held, free = (reduced.vector({"load_factor": 0.0, "push": force}) for force in (1e-4 / unit, 0.0))
    motion = ModalIntegrator(reduced, held, *reduced.damping)
    start = motion.at_rest(reduced.load_coefficients(held))
    load = reduced.load_coefficients(free)
    wanted = np.array(
        [
            motion.outputs(motion.advance(start, float(time), load))[[len(reduced.gauges), 0, -1]]
            for time in trial.time[1:]
        ]
    )
    largest = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(seen[1:] / largest, wanted / largest, atol=1e-3)


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT, TrialKind.RINGDOWN, TrialKind.FORCED])
@pytest.mark.parametrize("law", [None, PowerStiffness("tip", 10.0, 3.0, 0, 1e-4)])
def test_it_is_its_fmu(
    kind: TrialKind, law: PowerStiffness | None, pair: tuple[FmuModel, ReducedModel]
) -> None:
    """All kinds of trials, with and without a spring at the tip."""
    fmu, reduced = pair
    zero, own = np.zeros(40), StructureModel(reduced)
    assert (own.ports(), [(p.name, p.mean, p.deviation, p.low, p.high) for p in own.parameters]) == (
        fmu.ports(), [(p.name, p.mean, pytest.approx(p.deviation), p.low, p.high) for p in fmu.parameters],
    )  # fmt: skip
    release = Release(1e-4, mode_count=1) if kind is TrialKind.RINGDOWN else None
    load = np.sin(np.arange(40) / 4.0 + 0.5 * (law is None)) * (kind is not TrialKind.RINGDOWN)
    flight = kind is TrialKind.FLIGHT
    trial = replace(
        TRIAL, kind=kind, release=release, force=zero if flight else 50.0 * load,
        load_factor=load if flight else zero, time=2e-5 * np.arange(40),
    )  # fmt: skip
    patch, conditions = ModelPatch(() if law is None else (law,)), Conditions(np.array([1.02, 0.07]))
    wanted, seen = (m.respond(trial, OUTPUTS[:2], patch, conditions).values for m in (fmu, own))
    exact = kind in (TrialKind.STATIC, TrialKind.FLIGHT)
    np.testing.assert_allclose(
        seen / np.abs(wanted).max(axis=0), wanted / np.abs(wanted).max(axis=0), atol=1e-8 if exact else 5e-3
    )


def test_any_region_is_known_by_its_name(either: tuple[Model, ReducedModel]) -> None:
    own, reduced = either
    health, conditions = np.array([[0.0, 0.2, 0.3]]), np.array([1.0, 0.05])
    named = replace(TRIAL, regions=("other", "z2", "z1"))
    seen = own.respond(named, OUTPUTS[:1], ModelPatch(), Conditions(conditions, health=health)).values[-1]
    found = reduced.static_response({"load_factor": 0.0, "push": 200.0}, {"z1": 0.3, "z2": 0.2})
    np.testing.assert_allclose(seen, found.displacement, rtol=1e-10)
    with pytest.raises(ModelError, match=r"a loss of the damage region 'other', but .*beam.* has z1, z2"):
        own.respond(named, OUTPUTS[:1], ModelPatch(), Conditions(conditions, health=health[:, ::-1]))


def test_small_steps_beside_a_law_are_not_asked_of_the_fmu(
    pair: tuple[FmuModel, ReducedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor are springs of next to no stiffness, which change nothing, whatever steps they take."""
    model, _ = pair
    asked: list[int] = []
    advanced = model.runs.advanced
    monkeypatch.setattr(model.runs, "advanced", lambda *given: (asked.append(given[-1]), advanced(*given))[1])
    for e in (1.0, 1.03):
        conditions = Conditions(np.array([e, 0.05]))
        wanted = model.respond(RELEASED, OUTPUTS, ModelPatch(), conditions).values
        for force in (1e-9, 1e-6, 100.0):
            before = len(asked)
            spring = ModelPatch((PowerStiffness("tip", force, 3.0, 0, 1e-4),))
            seen = model.respond(RELEASED, OUTPUTS, spring, conditions).values
            if force < 1.0:
                largest = np.abs(wanted).max(axis=0)
                np.testing.assert_allclose(seen / largest, wanted / largest, atol=1e-6)
        assert 0 < len(asked) == before
    assert max(parts for parts, _ in model._laws._refinements.values()) > 1


def test_an_accelerometer_that_nobody_reads_does_not_shorten_the_steps(
    pair: tuple[FmuModel, ReducedModel],
) -> None:
    model, _ = pair
    law = ModelPatch((PowerStiffness("tip", 10.0, 3.0, 0, 1e-4),))
    found, refinements = [], []
    for outputs in (OUTPUTS, OUTPUTS[:2]):
        model._laws._refinements.clear()
        moved = model.respond(RELEASED, outputs, law, Conditions(np.array([1.0, 0.05])))
        found.append(moved.values[:, :2])
        refinements += [parts for parts, _ in model._laws._refinements.values()]
    largest = np.abs(found[0]).max(axis=0)
    np.testing.assert_allclose(found[1] / largest, found[0] / largest, atol=5e-4)
    assert refinements[1] < refinements[0]


def test_a_structure_without_a_force_is_refused(write_beam: Callable[..., Path], tmp_path: Path) -> None:
    design = load_structure(write_beam(tmp_path, {'unit = "N", ': "", "load_factor": "gee"}, cells=1))
    with pytest.raises(FmuBuildError, match="no control in N and no load_factor"):
        rig_text(design, "beam.fmu")
