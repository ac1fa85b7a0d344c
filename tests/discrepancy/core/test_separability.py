"""What campaigns cannot decide, before any data: the known confusion groups."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Release, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.judgement.separability import CONFUSED, Separability, _groups, as_predicted, separability
from discrepancy.models.lumped import LumpedModel
from discrepancy.report.check_tables import group_lines
from tests.refusals import Inputs

ONE_MODE = Inputs(__file__).text("one_mode.toml")


def group_of(found: Separability, identifier: str) -> tuple[str, ...]:
    """Return the confusion group of an effect, itself alone if it has none."""
    return next((group for group in found.groups if identifier in group), (identifier,))


def chosen(catalogue, identifiers: Iterable[str]):  # type: ignore[no-untyped-def]
    return [effect for effect in catalogue if effect.identifier in set(identifiers)]


def decided(model, given: Campaign, effects) -> Separability:  # type: ignore[no-untyped-def]
    return separability(given, model, Setting(given, model, model.scales(given)), effects)


def test_ringdown_of_one_mode_cannot_tell_mass_root_and_clock(kit, catalogue, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """And none of them from the stiffness, where that is not known from calibration."""
    path = tmp_path / "one.toml"
    path.write_text(ONE_MODE, encoding="utf-8")
    model = LumpedModel.load(path)
    channel = Channel("x", Quantity.DISPLACEMENT, "displacement", NoiseRecord(2e-5, inf))
    trial = kit.blank_trial(
        "release", TrialKind.RINGDOWN, ("x",), 0.02 * np.arange(200), load_place="mass",
        release=Release(0.01, 0.02, mode_count=1),
    )  # fmt: skip
    effects = chosen(catalogue, ("point_mass", "root_compliance", "clock_error", "quadratic_damping"))
    exact = Campaign("", {"x": channel}, (trial,), None, {"stiffness_factor": (1.0, 1e-4)}, "")
    found = decided(model, exact, [e for e in effects if e.identifier != "quadratic_damping"])
    assert set(group_of(found, "point_mass")) == {"point_mass", "root_compliance", "clock_error"}
    assert all(item.distance > 100.0 for item in found.detectability)  # seen they are
    loose = replace(exact, parameters={"stiffness_factor": (1.0, 0.1)})
    hidden = decided(model, loose, [e for e in effects if e.identifier != "quadratic_damping"])
    for seen, item in zip(found.detectability, hidden.detectability, strict=True):
        if item.effect.identifier != "clock_error":  # its time zero shows
            assert item.distance < 1e-3 * seen.distance


def test_a_release_of_unknown_state_shows_effects_as_one_from_rest_does(kit, catalogue) -> None:  # type: ignore[no-untyped-def]
    """Its data say how it begins; from rest nothing would move, and every effect would be seen "never"."""
    bench = kit.chain_bench(static=False, amplitudes=(0.02, 0.012))
    effects = chosen(catalogue, ("quadratic_damping", "coulomb_friction"))
    measured = bench.measured(3)
    free = tuple(replace(trial, release=replace(trial.release, at_rest=False)) for trial in measured.trials)
    known, found = (
        decided(bench.model, item, effects) for item in (measured, replace(measured, trials=free))
    )
    for one, other in zip(known.detectability, found.detectability, strict=True):
        assert 0.5 < other.detectable / one.detectable < 5.0
    nothing = replace(found, identifiers=(), distance=np.zeros((0, 0)), groups=())
    assert "none of the effects" in group_lines(nothing)[0]


def test_static_displacement_cannot_tell_root_load_place_and_load_cell(kit, bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    """Static strain takes the root out of that group: it turns without straining."""
    parameters = {"stiffness_factor": (1.0, 1e-4), "joint_factor": (1.0, 1e-4), "damping_factor": (1.0, 0.1)}
    effects = chosen(catalogue, ("root_compliance", "load_place", "load_cell"))
    groups = []
    for channels in (("x3",), ("x3", "g1", "g2")):
        test = kit.chain_bench(amplitudes=(), static_channels=channels, gain_deviation=0.0)
        found = decided(test.model, replace(test.campaign, parameters=parameters), effects)
        assert all(item.distance > 100.0 for item in found.detectability)
        groups.append(found)
    assert set(group_of(groups[0], "root_compliance")) == {"root_compliance", "load_place", "load_cell"}
    assert group_of(groups[1], "root_compliance") == ("root_compliance",)
    loose = {**parameters, "stiffness_factor": (1.0, 5.0)}
    test = kit.chain_bench(amplitudes=(), static_channels=("x3",), gain_deviation=0.0)
    hidden = decided(test.model, replace(test.campaign, parameters=loose), effects[:2])
    assert all(item.distance < CONFUSED for item in hidden.detectability)


@pytest.mark.parametrize(
    ("kind", "group"),
    [
        (TrialKind.STATIC, {"gauge_gain", "gauge_misalignment", "local_stiffness_loss"}),
        (TrialKind.FLIGHT, {"washout", "inertia_relief"}),
    ],
)
def test_one_gauge_at_one_load_factor_cannot_tell(catalogue, kind: TrialKind, group: set[str]) -> None:  # type: ignore[no-untyped-def]
    """One gauge of the cantilever, whose modulus is known: damage beside it, or relief beside lift."""
    given, model = campaign(), Cantilever()
    name = next(key for key, item in given.channels.items() if item.quantity is Quantity.STRAIN)
    trials = []
    for trial in given.trials:
        if trial.kind is kind:
            column = [trial.channels.index(name)]
            level = np.full_like(trial.load_factor, 2.0 if kind is TrialKind.FLIGHT else 0.0)
            part = {"channels": (name,), "values": trial.values[:, column], "used": trial.used[:, column]}
            trials.append(replace(trial, **part, load_factor=level))
    channels = {name: replace(given.channels[name], gain_deviation=0.0)}
    known = {item.name: (item.mean, 1e-4 * item.mean) for item in model.parameters}
    one = replace(given, channels=channels, trials=tuple(trials), parameters=known)
    found = decided(model, one, chosen(catalogue, group))
    assert set(group_of(found, min(group))) == group


def test_a_whole_laboratory_test_separates(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    identifiers = ("point_mass", "root_compliance", "quadratic_damping", "coulomb_friction", "load_cell")
    effects = chosen(catalogue, identifiers)
    found = decided(bench.model, bench.campaign, effects)
    assert found.groups == ()
    assert set(found.identifiers) == set(identifiers)
    np.testing.assert_array_equal(np.diag(found.distance), 0.0)
    for item in found.detectability:
        assert item.detectable < item.typical


def test_an_effect_that_nobody_sees_is_not_confused_with_all_others(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    """A gain of a millionth is within the noise of anything; at a size that is seen, of none."""
    effects = []
    for effect in chosen(catalogue, ("root_compliance", "quadratic_damping", "gauge_gain")):
        if effect.identifier == "gauge_gain":
            (gain,) = effect.parameters
            small = replace(gain.prior, low=1e-4 * gain.prior.low, high=1e-4 * gain.prior.high)
            effect = replace(effect, parameters=(replace(gain, prior=small),))
        effects.append(effect)
    found = decided(bench.model, bench.campaign, effects)
    sizes = {item.effect.identifier: item.distance for item in found.detectability}
    assert 1e-6 < sizes["gauge_gain"] < 0.1 * CONFUSED
    assert "gauge_gain" in found.identifiers
    assert found.groups == ()


def test_measured_values_do_not_count(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    effects = chosen(catalogue, ("gauge_gain", "load_cell", "root_compliance"))
    first = decided(bench.model, bench.measured(1), effects)
    second = decided(bench.model, bench.measured(2), effects)
    np.testing.assert_allclose(first.distance, second.distance, rtol=1e-6)


def test_what_cannot_be_tested_says_why(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    found = decided(bench.model, bench.campaign, chosen(catalogue, ("washout", "gauge_gain")))
    reasons = {item.effect.identifier: item.reason for item in found.detectability}
    assert reasons["washout"]
    assert reasons["gauge_gain"] == ""
    assert found.identifiers == ("gauge_gain",)
    assert group_of(found, "gauge_gain") == ("gauge_gain",)


@pytest.mark.parametrize(
    ("near", "groups"),
    [
        ((), ()),
        (((0, 1),), (("a", "b"),)),
        (((0, 1), (1, 3)), (("a", "b", "d"),)),
        (((0, 2), (1, 3)), (("a", "c"), ("b", "d"))),
    ],
)
def test_groups_are_connected_sets(near, groups) -> None:  # type: ignore[no-untyped-def]
    distance = np.full((4, 4), 100.0)
    for i, j in near:
        distance[i, j] = CONFUSED - 1.0  # one direction suffices
    assert _groups(("a", "b", "c", "d"), distance) == groups


def test_an_unknown_noise_is_taken_as_a_thousandth_of_the_range(bench, effects_of_gauges) -> None:  # type: ignore[no-untyped-def]
    """Detectable sizes are finite, and those of a stated deviation of that size."""
    given = bench.measured(1)
    blank = replace(
        given, channels={name: replace(item, noise=None) for name, item in given.channels.items()}
    )
    found = decided(bench.model, blank, effects_of_gauges)
    assert all(0.0 < item.detectable < inf for item in found.detectability)
    ideal = as_predicted(blank, bench.model, Setting(blank, bench.model, bench.model.scales(blank)))
    stated = replace(blank, channels=ideal.channels)
    again = decided(bench.model, stated, effects_of_gauges)
    for one, other in zip(found.detectability, again.detectability, strict=True):
        assert one.detectable == pytest.approx(other.detectable, rel=0.05)


@pytest.fixture
def effects_of_gauges(catalogue):  # type: ignore[no-untyped-def]
    return chosen(catalogue, ("gauge_gain", "quadratic_damping"))
