"""The tables of a scenario by which a twin acts: inspections, repairs and the end beside the controls.

An action is a control with a price: in its turn the loads are those of a control that it names. It becomes
one more entry of `control`, `transition`, `rewards.control` and `truth.probability`, those of its control
unless the file gives its own, so that nothing that knows controls has to know actions.
"""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from twin_master.scenario.section import (
    Count,
    Flag,
    Name,
    NotNegative,
    PerSensor,
    Probability,
    Section,
    check_one_or_each,
)

__all__ = ["Action", "Planner", "with_actions"]


class Action(Section):
    """One choice of a turn beside the controls."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "percent"}
    name: Name
    title: str = ""
    control: Name
    """The control whose loads are on the asset in that turn."""
    cost: NotNegative
    """What the reward of the turn is less than under the control."""
    inspects: tuple[Name, ...] = ()
    """States that are read in that turn, and only then."""
    standard_deviation: PerSensor | None = None
    """Of these readings, one for all or one for each."""
    repairs: tuple[Name, ...] = ()
    """States that are at their lowest level in the turn after."""
    success: Probability = 1.0
    """Probability with which a repair succeeds, for each state."""
    ends: Flag = False
    """Whether the mission ends with that turn."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if bool(self.inspects) != (self.standard_deviation is not None):
            raise ValueError(
                f"action `{self.name}`: `inspects` and `standard_deviation` go together: the states that are "
                "read, and how well"
            )
        check_one_or_each("action.standard_deviation", self.standard_deviation, len(self.inspects))
        if not (self.inspects or self.repairs or self.ends):
            raise ValueError(
                f"action `{self.name}` does nothing that its control does not: give `inspects`, `repairs` or "
                "`ends`"
            )
        return self

    @property
    def readings(self) -> tuple[tuple[str, str, float], ...]:
        """Name of each reading, the state that is read, and the standard deviation."""
        given = self.standard_deviation
        each = given if isinstance(given, tuple) else (given or 0.0,) * len(self.inspects)
        return tuple(
            (f"{self.name}_{state}", state, deviation)
            for state, deviation in zip(self.inspects, each, strict=True)
        )


class Planner(Section):
    """How the twin decides: value iteration, eq. (36), or planning on the belief."""

    gamma: Annotated[float, Field(strict=True, ge=0.0, lt=1.0)]
    decide_on: Literal["filtered", "predicted"] = "filtered"
    """Which belief the next control is the most probable one of: D_t, or D_{t+1} as predicted."""
    safest: Name | None = None
    """Control where no state explains the sensors; by default the one with the least load."""
    policy: Literal["mode", "qmdp", "belief"] = "mode"
    """The mode of the control of each state; the best control in the mean over the states, taken as if they
    were known from the next turn on; or what is planned on the belief."""
    limit_probability: Annotated[Probability, Field(gt=0.0)] | None = None
    """`belief`: share of the turns, discounted, in which a health limit may be exceeded."""

    inspections_a_turn: Count | None = None
    """`belief` and `qmdp`: turns with an inspection that assets which fly side by side have among them."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.limit_probability is not None and self.policy != "belief":
            raise ValueError("`planner.limit_probability` needs `planner.policy` `belief`")
        if self.inspections_a_turn is not None and self.policy == "mode":
            raise ValueError("`planner.inspections_a_turn` needs `planner.policy` `belief` or `qmdp`")
        return self


def with_actions(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the table of a scenario with an entry for each action wherever there is one for each control.

    What is malformed stays as it is: the schema says what is wrong with it.
    """
    try:
        made = {**table, "control": list(table["control"])}
        names = [dict(entry)["name"] for entry in made["control"]]
        rewards = {**table["rewards"], "control": dict(table["rewards"]["control"])}
        entries: list[dict[str, Any]] = [rewards["control"]]
        for key, kinds in (("transition", ("probability", "tables")), ("truth", ("probability",))):
            if key not in table:
                continue
            made[key] = dict(table[key]) | {k: dict(table[key][k]) for k in kinds if k in table[key]}
            entries += [made[key][kind] for kind in kinds if made[key].get(kind)]
        made["rewards"], weight = rewards, rewards.get("control_weight", 1.0)
        for action in table["action"]:
            name, base = action["name"], action["control"]
            if name not in names:
                values = dict(made["control"][names.index(base)])["values"]
                made["control"].append({"name": name, "title": action.get("title", ""), "values": values})
            rewards["control"].setdefault(name, rewards["control"][base] - action["cost"] / weight)
            for entry in entries:
                entry.setdefault(name, entry[base])
    except (KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError):
        return table
    return made
