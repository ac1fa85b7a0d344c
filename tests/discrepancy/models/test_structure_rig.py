"""A structure as a model of the search, and its FMU by the file that is written beside it."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from discrepancy.campaign.records import Quantity, Release, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.interface import Model
from discrepancy.models.structures import StructureModel
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.patch import PowerStiffness
from fe.runtime.reduced import ReducedModel
from fe.runtime.transient import ModalIntegrator
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures.rig import rig_text
from tests.discrepancy.asking import FloatArray, seen, trial

OUTPUTS = (("tip", Quantity.DISPLACEMENT), ("g1", Quantity.STRAIN), ("shake", Quantity.ACCELERATION))
TRIAL = trial(TrialKind.STATIC, 1e-4 * np.arange(40), force=np.linspace(-100.0, 200.0, 40), run="A")
RELEASED = replace(TRIAL, kind=TrialKind.RINGDOWN, force=np.zeros(40), release=Release(1e-4, mode_count=1))
SPRING = PowerStiffness("tip", 10.0, 3.0, 0, 1e-4)


class Kinds(NamedTuple):
    """The structure itself as a model, its FMU, and the reduced structure inside both."""

    structure: StructureModel
    fmu: FmuModel
    reduced: ReducedModel


def alike(one: FloatArray, other: FloatArray, tolerance: float) -> None:
    """Compare in shares of the largest value of each output."""
    largest = np.abs(other).max(axis=0)
    np.testing.assert_allclose(one / largest, other / largest, atol=tolerance)


def at(*parameters: float, **given: Any) -> dict[str, Any]:
    return {"parameters": np.array(parameters)} | given


@pytest.fixture(scope="module")
def kinds(write_beam, tmp_path_factory) -> Iterator[Kinds]:
    folder = tmp_path_factory.mktemp("rig")
    file = write_beam(folder, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    reduced = reduce_structure(load_and_assemble(file)).model
    fmu = build_fmu(reduced, folder / "beam.fmu").path
    path = folder / "rig.toml"
    path.write_text(rig_text(load_structure(file), os.path.relpath(fmu, folder)), encoding="utf-8")
    model = FmuModel.load(path)
    yield Kinds(StructureModel(reduced), model, reduced)
    model.close()


@pytest.fixture(params=["structure", "fmu"])
def model(request: pytest.FixtureRequest, kinds: Kinds) -> Model:
    found: Model = getattr(kinds, request.param)
    return found


def test_it_is_the_structure_at_rest(model: Model, kinds: Kinds) -> None:
    """Static trials at other parameters and masses; without a recorded load factor there is no weight."""
    assert [parameter.name for parameter in model.parameters] == ["e", "pump"]
    assert model.ports == ("tip",)
    values, wanted = seen(model, TRIAL, OUTPUTS[:2], **at(1.04, 0.06)), []
    for force in TRIAL.force:
        chosen = {"e": 1.04, "pump": 0.06, "load_factor": 0.0, "push": float(force)}
        found = kinds.reduced.static_response(chosen)
        wanted.append([found.displacement[0], found.strain[0]])
    np.testing.assert_allclose(values, wanted, rtol=1e-10, atol=1e-15)


def test_it_is_the_structure_in_motion(model: Model, kinds: Kinds) -> None:
    """A tip that is held aside and let go, with its acceleration."""
    reduced, released = kinds.reduced, replace(RELEASED, release=Release(1e-4))
    unit = reduced.static_response({"load_factor": 0.0, "push": 1.0}).displacement[0]
    held, free = (reduced.vector({"load_factor": 0.0, "push": force}) for force in (1e-4 / unit, 0.0))
    motion, load = ModalIntegrator(reduced, held, *reduced.damping), reduced.load_coefficients(free)
    start, shown = motion.at_rest(reduced.load_coefficients(held)), [len(reduced.gauges), 0, -1]
    wanted = [motion.outputs(motion.advance(start, float(time), load))[shown] for time in TRIAL.time[1:]]
    alike(seen(model, released, OUTPUTS, **at(1.0, 0.05))[1:], np.array(wanted), 1e-3)


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT, TrialKind.RINGDOWN, TrialKind.FORCED])
@pytest.mark.parametrize("laws", [(), (SPRING,)])
def test_it_is_its_fmu(kind: TrialKind, laws: tuple[PowerStiffness, ...], kinds: Kinds) -> None:
    """All kinds of trials, with and without a spring at the tip."""
    one, other = (
        [(p.name, p.mean, pytest.approx(p.deviation), p.low, p.high) for p in model.parameters]
        for model in kinds[:2]
    )
    assert one == other
    load = np.sin(np.arange(40) / 4.0 + 0.5 * (not laws))
    acts = {TrialKind.FLIGHT: {"load_factor": load}, TrialKind.RINGDOWN: {"release": RELEASED.release}}
    said = acts.get(kind, {"force": 50.0 * load})
    what = trial(kind, 2e-5 * np.arange(40), run="A", **said)
    own, fmu = (seen(model, what, OUTPUTS[:2], *laws, **at(1.02, 0.07)) for model in kinds[:2])
    alike(own, fmu, 1e-8 if kind in (TrialKind.STATIC, TrialKind.FLIGHT) else 5e-3)


def test_any_region_is_known_by_its_name(model: Model, kinds: Kinds) -> None:
    named, health = replace(TRIAL, regions=("other", "z2", "z1")), np.array([[0.0, 0.2, 0.3]])
    values = seen(model, named, OUTPUTS[:1], **at(1.0, 0.05, health=health))[-1]
    found = kinds.reduced.static_response({"load_factor": 0.0, "push": 200.0}, {"z1": 0.3, "z2": 0.2})
    np.testing.assert_allclose(values, found.displacement, rtol=1e-10)
    with pytest.raises(ModelError, match=r"a loss of the damage region 'other', but .*beam.* has z1, z2"):
        seen(model, named, OUTPUTS[:1], **at(1.0, 0.05, health=health[:, ::-1]))


def test_the_fmu_is_not_asked_again_for_another_law(kinds: Kinds, monkeypatch) -> None:
    """Nor are springs of next to no stiffness, which change nothing, whatever steps they take."""
    model, asked = kinds.fmu, []
    advanced = model.fmu.advanced
    monkeypatch.setattr(model.fmu, "advanced", lambda *given: (asked.append(given[-1]), advanced(*given))[1])
    for e in (1.0, 1.03):
        wanted = seen(model, RELEASED, OUTPUTS, **at(e, 0.05))
        for number, force in enumerate((1e-9, 1e-6, 100.0)):
            before = len(asked)
            values = seen(model, RELEASED, OUTPUTS, PowerStiffness("tip", force, 3.0, 0, 1e-4), **at(e, 0.05))
            if force < 1.0:
                alike(values, wanted, 1e-6)
            assert (len(asked) == before) == (number > 0)


def test_a_structure_without_a_force_is_refused(write_beam, tmp_path: Path) -> None:
    design = load_structure(write_beam(tmp_path, {'unit = "N", ': "", "load_factor": "gee"}, cells=1))
    with pytest.raises(FmuBuildError, match="no control in N and no load_factor"):
        rig_text(design, "beam.fmu")
