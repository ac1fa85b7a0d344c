"""The table of a scenario that says how the state moves."""

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from twin_master.scenario.section import Probability, Section, check_same

ROW_SUM_TOLERANCE = 1e-12
"""Largest departure of the sum of probabilities from one, as the graphical model has it."""


class Transition(Section):
    """How the state moves in one step under each control; factors move independently given the control."""

    kind: Literal["independent_worsening", "independent_tables"]
    probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """`independent_worsening`: probability of one level up, for each control (or control and state)."""
    tables: dict[str, dict[str, tuple[tuple[Probability, ...], ...]]] = Field(default_factory=dict)
    """`independent_tables`: for each control and state a square table, rows from, columns to."""

    def check(self, controls: tuple[str, ...], levels: Mapping[str, int]) -> None:
        """Check that there is what it takes for each control and state with its number of levels."""
        states = tuple(levels)
        if self.kind == "independent_worsening":
            if self.tables:
                raise ValueError("`transition.tables` belongs to the kind `independent_tables`")
            check_same(self.probability, controls, "transition.probability", "control")
            for name, entry in self.probability.items():
                if isinstance(entry, dict):
                    check_same(entry, states, f"transition.probability.{name}", "state")
            return
        if self.probability:
            raise ValueError("`transition.probability` belongs to the kind `independent_worsening`")
        check_same(self.tables, controls, "transition.tables", "control")
        for name, tables in self.tables.items():
            check_same(tables, states, f"transition.tables.{name}", "state")
            for state, size in levels.items():
                table = tables[state]
                if len(table) != size or any(len(row) != size for row in table):
                    raise ValueError(
                        f"`transition.tables.{name}.{state}` must be {size} rows of {size} probabilities"
                    )
                worst = max(abs(sum(row) - 1.0) for row in table)
                if worst > ROW_SUM_TOLERANCE:
                    raise ValueError(
                        f"each row of `transition.tables.{name}.{state}` must sum to 1, one misses it by "
                        f"{worst:.3g}"
                    )
