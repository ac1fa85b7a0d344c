"""A bar under tension as what flies and as what the twin believes."""

from typing import Literal

import numpy as np

from twin_master.assets.asset_source import (
    AssetReading,
    AssetSource,
    StatelessAsset,
    table_of_observations,
)
from twin_master.scenario.kinds import AssetSection, BeliefSection


def strain_of_bar(strain_per_g, control, health):
    """Return the strain (1,) of a bar that has lost a fraction of its stiffness."""
    return np.array([strain_per_g * control["load_factor"] / (1.0 - health["loss"])])


class BarSection(AssetSection):
    """A bar under tension flies."""

    kind: Literal["bar"] = "bar"
    strain_per_g: float
    """Strain of the undamaged bar at a load factor of one."""

    def source(self, scenario):
        """Return the source of the bar."""
        return BarSource(scenario, self)


class BarBelief(BeliefSection):
    """The twin believes a bar under tension."""

    kind: Literal["bar"] = "bar"
    strain_per_g: float
    """Strain of the undamaged bar at a load factor of one."""

    def source(self, scenario, flown_source):
        """Return the source of the predictions."""
        return BarSource(scenario, self)


class BarSource(AssetSource):
    """A bar, whose calibrated parameter scales its flexibility."""

    label = "bar"

    def open(self):
        """Return the bar that flies."""
        strain_per_g = self.section.strain_per_g
        return StatelessAsset(
            lambda control, health: AssetReading(strain_of_bar(strain_per_g, control, health))
        )

    def observation_table(self, draws, model):
        """Return the predicted strains by draw, state, control and sensor."""
        table = table_of_observations(
            self._scenario,
            model.states.coordinates,
            lambda control, health: strain_of_bar(self.section.strain_per_g, control, health),
        )
        return draws.values[:, None, None, None] * table
