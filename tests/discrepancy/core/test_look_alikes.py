"""The remark on what a name does not exclude."""

from __future__ import annotations

from dataclasses import replace

import pytest

from discrepancy.catalogue.entry import Setting
from discrepancy.judgement.when import look_alike_remark, with_untested
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch


def verdict_on(catalogue, *identifiers: str, kind: VerdictKind = VerdictKind.NAMED) -> Verdict:  # type: ignore[no-untyped-def]
    known = {effect.identifier: effect for effect in catalogue}
    effects = tuple(
        NamedEffect(i, known[i].name, "", known[i].family, (), (), ModelPatch()) for i in identifiers
    )
    return Verdict(kind, "-", 0.99, 20.0, effects=effects)


def test_declared_likenesses_are_told_from_those_left_out(catalogue) -> None:  # type: ignore[no-untyped-def]
    whole = look_alike_remark(verdict_on(catalogue, "inertia_relief"), catalogue)
    assert "washout" in whole
    assert "not compared" not in whole
    rest = [effect for effect in catalogue if effect.identifier != "washout"]
    less = look_alike_remark(verdict_on(catalogue, "inertia_relief"), rest)
    assert "washout was not compared" in less


def test_a_group_says_last_what_these_trials_cannot_test(kit, catalogue) -> None:  # type: ignore[no-untyped-def]
    bench = kit.chain_bench(amplitudes=())
    setting = Setting(bench.campaign, bench.model, bench.model.scales(bench.campaign))
    group = replace(verdict_on(catalogue, "load_cell", kind=VerdictKind.GROUP), sentence="Either is missing.")
    sentence = with_untested(group, setting, catalogue).sentence
    assert sentence.startswith("Either is missing. ")
    named = [effect.name for effect in catalogue if effect.name in sentence]
    assert named
    able = [effect for effect in catalogue if effect.unavailable(setting) is None]
    assert not {effect.name for effect in able} & set(named)
    single = verdict_on(catalogue, "load_cell")
    assert with_untested(single, setting, catalogue) is single


def test_likeness_counts_both_ways(catalogue) -> None:  # type: ignore[no-untyped-def]
    """The place of a load declares the load cell; so does what only others declare."""
    for effect in catalogue:
        for other in effect.confusable:
            text = look_alike_remark(verdict_on(catalogue, other), catalogue)
            assert effect.identifier in text


def test_members_of_a_set_are_no_likenesses_of_each_other(catalogue) -> None:  # type: ignore[no-untyped-def]
    text = look_alike_remark(verdict_on(catalogue, "inertia_relief", "washout"), catalogue)
    assert " do together, within the noise" in text
    compared = text.split("look alike,")[1]
    assert "washout" not in compared
    assert "inertia_relief" not in compared


@pytest.mark.parametrize("kind", [kind for kind in VerdictKind if kind is not VerdictKind.NAMED])
def test_only_names_are_remarked_on(catalogue, kind: VerdictKind) -> None:  # type: ignore[no-untyped-def]
    assert look_alike_remark(verdict_on(catalogue, "load_cell", kind=kind), catalogue) is None
