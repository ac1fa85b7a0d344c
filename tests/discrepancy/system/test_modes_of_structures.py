"""How many modes a reduced model of a campaign has, and what is said where records show more."""

import re
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import TrialKind
from discrepancy.model_choice import choose_model
from discrepancy.verdict_remarks import left_out_modes_remark
from tests.discrepancy.core.kit import problem_of
from tests.discrepancy.rigs import simulated


def test_the_structure_file_states_how_many_modes_are_kept(write_beam, tmp_path) -> None:
    stated = {"damping = {": "reduction = { modes = 3 }\ndamping = {"}
    model = choose_model(write_beam(tmp_path, stated)).model
    assert model.model.mode_count == 3


def test_records_that_show_higher_modes_are_remarked_on(beam_model) -> None:
    campaign = simulated(beam_model, "ringdown", 3)
    (highest,) = re.findall(r"modes up to ([0-9.e+]+) Hz", said_with_interval(campaign, beam_model, 1e-7))
    # the highest mode may just be resolved
    interval = 0.5 / float(highest)
    assert said_with_interval(campaign, beam_model, 1.01 * interval) is None
    assert said_with_interval(campaign, beam_model, 0.99 * interval) is not None


def said_with_interval(campaign, model, interval):
    """Return the remark on a campaign whose trials in motion are sampled at an interval [s]."""
    trials = tuple(
        replace(trial, time=interval * np.arange(len(trial.time)))
        if trial.kind is TrialKind.RINGDOWN
        else trial
        for trial in campaign.trials
    )
    return left_out_modes_remark(problem_of(replace(campaign, trials=trials), model))
