"""Errors of instruments that are too small to be names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.records import NoiseRecord
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.judgement.naming import name
from discrepancy.verdict import VerdictKind


@pytest.mark.parametrize(("gain", "kind"), [(4e-4, VerdictKind.NOTHING_MISSING), (4e-2, VerdictKind.NAMED)])
def test_a_gain_of_half_a_thousandth_is_no_name(kit, gain: float, kind: VerdictKind) -> None:  # type: ignore[no-untyped-def]
    """Read so finely that it is certain; a gain of four per cent, as certain, is one."""
    bench = kit.chain_bench(amplitudes=(), gain_deviation=0.0)
    channels = {
        key: replace(
            item, noise=NoiseRecord(0.002 * item.noise.standard_deviation, 200.0), offset_deviation=0.0
        )
        for key, item in bench.campaign.channels.items()
        if item.noise is not None
    }
    draw = np.random.default_rng(np.random.SeedSequence(2))  # as `measured` draws the parameters
    known = {
        item.name: (item.mean + item.deviation * float(draw.standard_normal()), 1e-7)
        for item in bench.model.parameters
    }
    fine = replace(bench, campaign=replace(bench.campaign, channels=channels, parameters=known))
    cell = effect_by_identifier("load_cell", library())
    measured = fine.measured(2, fine.patch("load_cell", {"gain_error": gain, "tare_ratio": 0.0}, ""))
    verdict, found, fit = name(fine.problem(measured), (cell,))
    assert verdict.kind is kind, verdict.sentence
    if kind is VerdictKind.NOTHING_MISSING:
        assert "below 0.1 % of what it acts on" in verdict.sentence
        assert verdict.effects == ()
        assert fit is found.none
        assert found.best().candidate.identifiers == ("load_cell",)
