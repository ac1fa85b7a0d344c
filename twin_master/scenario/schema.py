"""The schema of a scenario file: states, controls, sensors, rewards, truth and asset.

A key of the file may carry its unit (`levels_percent`, `gain_percent`,
`standard_deviation_microstrain`); the records, and `config.json` of a run, are in SI. The schema
does not depend on the asset: another asset is another scenario file.
"""

import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import numpy as np

from reporting.arrays import Float
from reporting.formats.toml_file import Check
from twin_master.scenario.consistency import ScenarioTables
from twin_master.scenario.kinds import FileSection
from twin_master.scenario.section import Section, Table, unknown_name_check
from twin_master.scenario.tables import SummaryKeys

_GAIN_DECIMALS = 12
"""Decimals to which sums of scripted gains are rounded, so that ten times 2 % and 40 % are 60 %;
if a state is small in its unit, to as many significant digits."""
REWARD_NAMES = ("health", "control", "error")
"""The rewards of eqs. (9)-(11)."""
SUMMARY_TITLES: dict[str, dict[str, tuple[str, str]]] = tomllib.loads(
    Path(__file__).with_name("figures.toml").read_text(encoding="utf-8")
)
"""Title and unit of each entry of the summary, by group and key."""


class Scenario(ScenarioTables):
    """A whole scenario, in SI."""

    @property
    def searchable(self) -> bool:
        """Whether `discrepancy run --from-run` reads its runs.

        It reads strains of a wing with two damage regions.
        """
        has_two_regions = set(self.state_names) == {"z1", "z2"}
        return self.observation.role == "strain" and has_two_regions

    @property
    def row_width(self) -> int:
        """The length of the row of observations of a step."""
        return self.observation.width + len(self.inspection_readings)

    def ends(self, control_index: int) -> bool:
        """Return whether a step under a control ends the mission."""
        name = self.control_names[control_index]
        return any(action.ends for action in self.action if action.name == name)

    @property
    def summary_keys(self) -> tuple[str, ...]:
        """All keys that the summary can contain, and that a reference can name."""
        names = []
        for group in self._summary_groups():
            for name in SUMMARY_TITLES[group.name]:
                names.append(name.format(**group.fields))
        return tuple(names)

    def _summary_groups(self) -> list[SummaryKeys]:
        """Return the groups of keys that the summary of this scenario can contain."""
        groups = [SummaryKeys("fallback", {})]
        groups += [SummaryKeys("error", {"state": name}) for name in self.state_names]
        groups += [SummaryKeys("reward", {"reward": name}) for name in REWARD_NAMES]
        groups.append(SummaryKeys("earned", {}))
        groups += self._parameter_groups()
        groups.append(SummaryKeys("evidence", {}))
        if self.learning is not None:
            groups += self.learning.summary_groups()
        has_dropout = any(fault.kind == "dropout" for fault in self.truth.sensor_faults)
        if has_dropout or self.truth.received:
            groups += [SummaryKeys("lost", {}), SummaryKeys("blind", {})]
        if self.models_differ:
            groups.append(SummaryKeys("misfit", {}))
        if set(self.observation.sensor_units) == {"1"}:
            groups.append(SummaryKeys("bound", {}))
        if self.notice is not None:
            groups.append(SummaryKeys("notice", {}))
        return groups

    def _parameter_groups(self) -> list[SummaryKeys]:
        """Return the keys of the summary about the calibrated parameter."""
        fields = {"parameter": self.calibration.parameter}
        if self.learning is None or not self.learning.parameter:
            return [SummaryKeys("parameter", fields)]
        groups = [SummaryKeys("parameter_learnt", fields)]
        if self.calibration.parameter in self.asset.true_parameters:
            groups.append(SummaryKeys("parameter_true", fields))
        return groups

    def scripted_history(self) -> Float:
        """Return the scripted true state in each step of the mission.

        The state of a step already includes the gains of that step.

        Returns
        -------
        (T, F) array
            One row for each of T steps, one column for each of F state factors, SI.
        """
        gain = np.zeros((self.mission.steps, len(self.state)))
        gain[0] = [factor.initial_level for factor in self.state]
        for entry in self.truth.gains:
            last_step = entry.first_step if entry.last_step is None else entry.last_step
            column = self.state_names.index(entry.state)
            gain[entry.first_step : last_step + 1, column] += entry.gain
        history = np.cumsum(gain, axis=0)
        # Round off the errors of the sums, so that ten gains of 2 % and 40 % are exactly 60 %.
        for factor_history in history.T:
            largest = np.abs(factor_history).max()
            # Below 1, as many more decimals as the largest value has zeros after the point.
            exponent = math.ceil(math.log10(largest)) if 0.0 < largest < 1.0 else 0
            factor_history[:] = np.round(factor_history, _GAIN_DECIMALS - exponent)
        return history

    @property
    def models_differ(self) -> bool:
        """Whether the asset's model is known to differ from the one that the twin believes."""
        believes_asset = self.belief.kind == "asset"
        has_known_difference = self.asset.is_known_to_differ or self.belief.is_known_to_differ
        return has_known_difference and not believes_asset

    def with_paths_from(self, folder: Path) -> Self:
        """Return the scenario with its relative paths joined to a folder."""
        tables: dict[str, Section] = {
            name: table.with_paths_from(folder) for name, table in self._file_tables().items()
        }
        tables["watch"] = self.watch.with_paths_from(folder)
        return self.model_copy(update=tables)

    def portable(self) -> Self:
        """Return the scenario with the paths of user files replaced by those of their copies."""
        tables = {name: table.portable() for name, table in self._file_tables().items()}
        return self.model_copy(update=tables)

    def with_seed(self, seed: int) -> Self:
        """Return the scenario with another seed of the run."""
        return self.with_changes("mission", seed=seed)

    def with_changes(self, table: str, **changes: object) -> Self:
        """Return the scenario with other values in one of its tables, which are not checked.

        Parameters
        ----------
        table : str
            The name of the table: "mission".
        **changes : object
            The new values by key.
        """
        changed_table = getattr(self, table).model_copy(update=changes)
        return self.model_copy(update={table: changed_table})

    def with_policy(self, name: str) -> Self:
        """Return the scenario with a policy by its name, such as "risk 0.05, hold 3"."""
        return self.model_copy(update={"planner": self.planner.with_policy(name)})

    def _file_tables(self) -> dict[str, FileSection]:
        """Return the tables of whose files a run folder has copies, by name."""
        return {"asset": self.asset, "belief": self.belief, "calibration": self.calibration}

    def to_dict(self) -> Table:
        """Return the scenario as plain data in SI; `Scenario.model_validate` reads it back."""
        return self.model_dump(mode="json")

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on tables that must fit together."""
        yield from self._control_checks()
        yield from self._action_checks()
        yield from self._growth_checks()
        yield from self._reference_checks()
        yield from self._truth_checks()
        yield from self._reward_checks()
        yield from self._sensor_checks()
        yield from self._mode_checks()

    def _reference_checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on names of references."""
        names = [entry.figure for entry in self.reference]
        for name in names:
            yield unknown_name_check(
                name, self.summary_keys, "reference.figure", "figure of the summary"
            )
            yield (
                names.count(name) > 1,
                f"`reference` gives `{name}` more than once: keep one of them",
            )
