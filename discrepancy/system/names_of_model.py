"""Trials in the names of a model: its load place and its damage regions.

A campaign that names neither has those of the shipped wing by default. Files and sentences about
another model use that model's own names.
"""

from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, Trial
from discrepancy.system.interface import Model
from discrepancy.system.load_change import DEFAULT_PLACE


def campaign_in_names_of(campaign: Campaign, model: Model) -> Campaign:
    """Return a campaign whose trials have the load place and the damage regions of a model."""
    trials = tuple(_trial_in_names_of(trial, model) for trial in campaign.trials)
    return replace(campaign, trials=trials)


def _trial_in_names_of(trial: Trial, model: Model) -> Trial:
    """Return a trial whose load place and damage regions are named as in a model.

    The default load place becomes the model's own, if the model has only one. Regions of the model
    that the trial does not have get no loss. A region that the model does not have is dropped,
    unless the campaign states a loss of it: it then stays, so that the model can refuse it.
    """
    places = model.load_places
    load_place = trial.load_place
    if load_place == DEFAULT_PLACE and places is not None and len(places) == 1:
        load_place = places[0]
    is_stated = np.any(trial.health != 0.0, axis=0) | np.any(trial.health_deviation != 0.0, axis=0)
    stated_regions = [
        region
        for region, region_is_stated in zip(trial.regions, is_stated, strict=True)
        if region_is_stated
    ]
    regions = tuple(dict.fromkeys((*model.regions, *stated_regions)))
    health = np.zeros((len(trial.health), len(regions)))
    health_deviation = np.zeros_like(health)
    for column, region in enumerate(regions):
        if region in trial.regions:
            column_of_trial = trial.regions.index(region)
            health[:, column] = trial.health[:, column_of_trial]
            health_deviation[:, column] = trial.health_deviation[:, column_of_trial]
    return replace(
        trial,
        load_place=load_place,
        regions=regions,
        health=health,
        health_deviation=health_deviation,
    )
