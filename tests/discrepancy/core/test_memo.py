"""Remembered responses belong to the trial that was asked for, even after it is gone."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np

from discrepancy.models.interface import Conditions
from fe.runtime.patch import ModelPatch


def test_trials_that_came_and_went_are_not_mistaken_for_each_other(kit) -> None:  # type: ignore[no-untyped-def]
    """Trials of proposals live briefly; their addresses are used again."""
    problem = kit.closed_problem()
    template = problem.campaign.trials[0]
    channels = problem.campaign.channels
    outputs = tuple((channels[name].output, channels[name].quantity) for name in template.channels)
    memo = problem.model
    plain = memo.patched(ModelPatch())
    conditions = Conditions(np.array([1.0, 0.5]), health=np.zeros((9, 2)))
    for number in range(200):
        trial = replace(template, force=float(number) * template.force)
        got = memo.respond(trial, outputs, ModelPatch(), conditions).values
        np.testing.assert_array_equal(got, plain.respond(trial, outputs, ModelPatch(), conditions).values)
        del trial
        gc.collect(0)
