"""When a force of free shape is the answer, and what counts for it."""

from types import SimpleNamespace

import pytest

from discrepancy.catalogue.force_curve import curve_families_of
from discrepancy.judgement.comparison import Comparison
from fe.runtime.patch import ModelPatch, TableDamping, TableStiffness


def hypothesis_of(identifier, *, table=None, family=""):
    term = SimpleNamespace(
        effect=SimpleNamespace(identifier=identifier, table=table, family=family), place="air"
    )
    candidate = SimpleNamespace(terms=(term,), key=identifier)
    return SimpleNamespace(candidate=candidate)


CURVE = hypothesis_of("curve", table="points", family="force over the velocity")
DRAG = hypothesis_of("drag", family="damping")
FILTER = hypothesis_of("filter", family="filter")


def comparison(*, low=0.95, closed=0.98, trials="held-out", refuted=()):
    """Return what the rules read of a comparison of a filter, a drag and a curve."""
    return SimpleNamespace(
        has_held_out=True,
        ranked_hypotheses=[FILTER, DRAG, CURVE],
        gap_share=lambda hypothesis, held_out: SimpleNamespace(is_tested=True, interval=(low, 0.99)),
        errors=lambda hypothesis: SimpleNamespace(closed=SimpleNamespace(trials=trials, value=closed)),
        _is_refuted_by_trials=lambda hypothesis: hypothesis in refuted,
    )


def test_held_out_trials_prove_a_force_of_free_shape_that_predicts_them():
    assert Comparison.is_proved_curve(comparison(), CURVE)
    assert not Comparison.is_proved_curve(comparison(), DRAG)


@pytest.mark.parametrize("reading", [{"low": 0.6}, {"closed": 0.5}, {"trials": "fitted"}])
def test_a_force_of_free_shape_that_predicts_too_little_is_not_proved(reading):
    assert not Comparison.is_proved_curve(comparison(**reading), CURVE)


@pytest.mark.parametrize(
    ("reading", "has_reason"),
    [({"closed": 0.02}, True), ({"closed": 0.6}, False), ({"closed": 0.02, "trials": "fitted"}, False)],
)
def test_a_name_must_remove_half_of_the_error_of_held_out_trials(reading, has_reason):
    reason = Comparison.reason_of_remaining_error(comparison(**reading), CURVE)
    assert bool(reason) == has_reason
    assert reason == "" or reason.startswith("a name must remove at least 50 %")


def test_the_more_probable_rival_is_one_that_trials_do_not_refute():
    assert Comparison.more_probable_rival(comparison(), CURVE) is FILTER
    assert Comparison.more_probable_rival(comparison(refuted=(FILTER,)), CURVE) is DRAG
    assert Comparison.more_probable_rival(comparison(), FILTER) is None


def test_laws_belong_to_the_free_shape_over_what_they_follow():
    ports = {"wall": SimpleNamespace(of_state=True), "air": SimpleNamespace(of_state=False)}
    setting = SimpleNamespace(scales=SimpleNamespace(ports=ports))
    drag = TableDamping("air", (0.0, 1.0), (0.0, 1.0))
    leak = TableDamping("wall", (0.0, 1.0), (0.0, 1.0))
    stop = TableStiffness("stop", (0.0, 1.0), (0.0, 1.0))
    assert curve_families_of(setting, ModelPatch((drag, leak, stop))) == {
        ("force over the velocity", "air"),
        ("flow over the state", "wall"),
        ("force over the displacement", "stop"),
    }
