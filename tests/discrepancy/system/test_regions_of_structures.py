"""A loss of stiffness in a damage region that a structure file declares is a cause that is tried."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.catalogue.library import library
from discrepancy.errors import ModelError
from discrepancy.files.residuals import read_residuals, write_residuals
from discrepancy.fmu_models.model import FmuModel
from discrepancy.model_choice import choose_model
from discrepancy.sources.examples import example_campaign, usual_plan
from discrepancy.system.load_change import DEFAULT_PLACE
from discrepancy.system.names_of_model import campaign_in_names_of
from discrepancy.system.wing_model import WingModel
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.reduction.model_cache import reduced_model
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import ModelPatch, RegionStiffnessLoss
from fe.structure.design import load_structure
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures import rig_text
from tests.discrepancy.bench import Bench
from tests.discrepancy.rigs import asked, chosen, hiding, measured, seen, setting_of, simulated
from tests.refusals import refused

OUTPUTS = {"tip": Quantity.DISPLACEMENT, "g1": Quantity.STRAIN, "g2": Quantity.STRAIN}
LOSS = 0.2
RIVALS = chosen("region_stiffness_loss", "gauge_gain", "load_cell", "breathing_crack")


@pytest.fixture
def fmu_model(beam_file, tmp_path):
    """The FMU of the beam, described by the file that is written beside it."""
    build_fmu(reduced_model(beam_file), tmp_path / "beam.fmu")
    rig = tmp_path / "rig.toml"
    rig.write_text(rig_text(load_structure(beam_file), "beam.fmu"), encoding="utf-8")
    fmu = FmuModel.load(rig)
    yield fmu
    fmu.close()


def verdict_on(campaign, model, effects):
    """Return the verdict, without the map of residuals and the next experiment, which no test here reads."""
    return investigate(campaign, model, effects, seed=3, thorough=False).verdict


def check_that_the_loss_is_named(verdict) -> None:
    """Check that the hidden loss is named at its region, with an interval that is narrow and right.

    Errors of the mesh in readings, not their noise, give its width.
    """
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [
        ("region_stiffness_loss", "z2")
    ]
    (loss,) = verdict.effects[0].parameters
    assert loss.low - 0.01 < LOSS < loss.high + 0.01
    assert loss.high - loss.low < 0.1


@pytest.mark.parametrize("kind", ["static", "ringdown"])
def test_a_loss_in_a_region_is_named_with_its_size(kind, beam_model) -> None:
    """In static trials the whole catalogue is compared, in ring-downs what is most alike."""
    effects = library() if kind == "static" else RIVALS
    campaign = simulated(beam_model, kind, 3, ("region_stiffness_loss", {"loss": LOSS}, "z2"))
    check_that_the_loss_is_named(verdict_on(campaign, beam_model, effects))


TWO_LOSSES = {"z1": 0.3, "z2": 0.2}


@pytest.fixture(scope="module")
def verdict_on_two_losses(beam_model):
    plan = usual_plan(beam_model)
    campaign = example_campaign(beam_model, "static", 3, plan)
    primitives = []
    for region, loss in TWO_LOSSES.items():
        primitives += hiding(campaign, beam_model, "region_stiffness_loss", {"loss": loss}, region)
    damaged = example_campaign(beam_model, "static", 3, plan, ModelPatch(tuple(primitives)))
    return verdict_on(damaged, beam_model, library())


def test_losses_in_two_regions_at_once_are_named(verdict_on_two_losses) -> None:
    named = {(effect.identifier, effect.place) for effect in verdict_on_two_losses.effects}
    assert verdict_on_two_losses.kind is VerdictKind.NAMED, verdict_on_two_losses.sentence
    assert named == {("region_stiffness_loss", region) for region in TWO_LOSSES}


@pytest.mark.parametrize("region", TWO_LOSSES)
def test_losses_in_two_regions_at_once_have_their_sizes(region, verdict_on_two_losses) -> None:
    (effect,) = (effect for effect in verdict_on_two_losses.effects if effect.place == region)
    assert effect.parameters[0].low - 0.01 < TWO_LOSSES[region] < effect.parameters[0].high + 0.01


def test_without_a_loss_nothing_is_named(beam_model) -> None:
    verdict = verdict_on(simulated(beam_model, "static", 3), beam_model, library())
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


def test_a_loss_is_named_beside_the_fmu_of_the_structure(fmu_model) -> None:
    campaign = simulated(fmu_model, "static", 3, ("region_stiffness_loss", {"loss": LOSS}, "z2"))
    rivals = chosen("region_stiffness_loss", "gauge_gain")  # an FMU is run for each value of each
    check_that_the_loss_is_named(verdict_on(campaign, fmu_model, rivals))


@pytest.mark.parametrize("kind_of_model", ["structure", "fmu"])
def test_a_patch_takes_the_stiffness_that_the_stated_loss_leaves(kind_of_model, request) -> None:
    model = request.getfixturevalue("beam_model" if kind_of_model == "structure" else "fmu_model")
    trial = asked(TrialKind.STATIC, np.arange(2.0), force=np.array([0.0, 30.0]), run="A")
    at_mean = {"parameters": model.prior_mean()}
    stated = {"health": np.array([[0.1, 0.3], [0.1, 0.3]])}
    patched = seen(model, trial, OUTPUTS, RegionStiffnessLoss("z2", LOSS), **at_mean, **stated)
    lost = {"health": np.array([[0.1, 0.44], [0.1, 0.44]])}  # 1 - 0.7 * 0.8
    np.testing.assert_allclose(patched, seen(model, trial, OUTPUTS, **at_mean, **lost), rtol=1e-9)


def test_a_large_loss_ends_where_the_model_does(write_beam, tmp_path) -> None:
    """A structure may hold up to a small loss only; the campaign's stated losses count, too."""
    limited = 'set = "outer", largest_loss = 0.3'
    model = choose_model(write_beam(tmp_path, {'set = "outer"': limited}, cells=2)).model
    campaign = simulated(model, "static", 3)
    (primitive,) = hiding(campaign, model, "region_stiffness_loss", {"loss": 0.9}, "z2")
    assert primitive.loss == pytest.approx(0.3)
    for trial in campaign.trials:
        trial.health[:, trial.regions.index("z2")] = 0.2
    (primitive,) = hiding(campaign, model, "region_stiffness_loss", {"loss": 0.9}, "z2")
    assert 1.0 - 0.8 * (1.0 - primitive.loss) == pytest.approx(0.3)
    patched = model.with_patch(ModelPatch((RegionStiffnessLoss("z2", 0.1),)))
    (primitive,) = hiding(campaign, patched, "region_stiffness_loss", {"loss": 0.9}, "z2")
    assert 1.0 - 0.8 * 0.9 * (1.0 - primitive.loss) == pytest.approx(0.3)


def test_the_wing_loses_stiffness_anywhere_along_its_span_instead() -> None:
    """Its regions are part of the skin that `local_stiffness_loss` weakens; a patch can still have them."""
    wing = WingModel.of_design()
    (effect,) = chosen("region_stiffness_loss")
    setting = setting_of(simulated(wing, "static", 3), wing)
    assert effect.places(setting) == ()
    assert "local_stiffness_loss is compared instead" in effect.unavailable(setting)
    healthy = (0.0,) * len(wing.regions)
    patch = ModelPatch((RegionStiffnessLoss(wing.regions[0], LOSS),))
    patched = wing.wing.stiffness(1.0, healthy, patch)
    np.testing.assert_array_equal(patched, wing.wing.stiffness(1.0, (LOSS, *healthy[1:])))


def test_an_unknown_region_is_refused(beam_model) -> None:
    trial = asked(TrialKind.STATIC, np.arange(2.0), force=np.array([0.0, 30.0]), run="A")
    with refused(ModelError, "damage region 'z7', but the model 'beam' has z1, z2"):
        seen(beam_model, trial, OUTPUTS, RegionStiffnessLoss("z7", LOSS), parameters=beam_model.prior_mean())
    wing = WingModel.of_design().wing
    with refused(InvalidPatchError, "damage region 'z7', but the wing has z1, z2"):
        wing.stiffness(1.0, (), ModelPatch((RegionStiffnessLoss("z7", LOSS),)))


# ---------------------------------------------------------------- names of the structure's own

OWN_NAMES = {'"z1"': '"heel"', '"z2"': '"web"'}


@pytest.fixture(scope="module")
def residuals_of_own_names(write_beam, tmp_path_factory):
    """Residuals beside a structure with names of its own, and the file in which they are stored.

    The campaign names no load place.
    """
    folder = tmp_path_factory.mktemp("own_names")
    own = choose_model(write_beam(folder, OWN_NAMES, cells=2)).model
    campaign = simulated(own, "static", 3)
    trials = tuple(replace(trial, load_place=DEFAULT_PLACE) for trial in campaign.trials)
    found = investigate(replace(campaign, trials=trials), own, chosen("load_cell"), seed=3)
    return found.after, write_residuals(folder / "residuals.nc", found.after)


def test_the_residuals_have_the_names_of_the_structure(residuals_of_own_names) -> None:
    """And none of the wing."""
    _, path = residuals_of_own_names
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        for group in tree.children.values():
            assert group["region"].values.tolist() == ["heel", "web"]
            assert json.loads(group.attrs["load_place"]) == "push"
            assert not any(word in str(group.attrs) for word in ("z1", "z2", "tip_load"))


def test_the_residuals_are_read_back_with_the_regions_of_the_structure(residuals_of_own_names) -> None:
    residuals, path = residuals_of_own_names
    for fitted, stored in zip(residuals.trials, read_residuals(path).trials, strict=True):
        assert stored.trial.regions == fitted.trial.regions == ("heel", "web")
        np.testing.assert_array_equal(stored.trial.health, fitted.trial.health)


def test_the_residuals_of_a_model_without_regions_have_none(tmp_path) -> None:
    campaign, rig = measured()
    named = campaign_in_names_of(campaign, rig)
    assert {trial.regions for trial in named.trials} == {()}
    fitted = Bench().fit(np.random.default_rng(1))
    trials = tuple(
        replace(item, trial=replace(item.trial, regions=(), health=item.trial.health[:, :0]))
        for item in fitted.trials
    )
    trials = tuple(
        replace(item, trial=replace(item.trial, health_deviation=item.trial.health)) for item in trials
    )
    path = write_residuals(tmp_path / "residuals.nc", replace(fitted, trials=trials))
    for stored in read_residuals(path).trials:
        assert stored.trial.regions == ()
        assert stored.trial.health.shape == (len(stored.trial.time), 0)


def test_a_stated_loss_of_a_region_that_is_not_there_is_refused(beam_model) -> None:
    campaign = simulated(beam_model, "static", 3)
    first, *others = campaign.trials
    lost = replace(first, regions=("z1", "rib"), health=first.health + np.array([0.0, 0.1]))
    with refused(ModelError, "loss of the damage region 'rib', but the model 'beam' has z1, z2"):
        investigate(replace(campaign, trials=(lost, *others)), beam_model, RIVALS)
