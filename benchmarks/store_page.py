"""The page of the variables that runs and fleets store, from the schema of the stores.

``python -m benchmarks.store_page`` writes it anew.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from reporting.files import atomic_write_text
from twin_master.store.schema import FIELDS_OF_BELIEFS, SCHEMA, fleet_rows, rows_of_group

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "stores.md"
_GROUPS = (
    "observed",
    "filtered",
    "smoothed",
    "predicted",
    "earned",
    "policy",
    "calibration",
    "learnt",
    "notice",
    "truth",
)
"""The groups of `run.nc` in their order."""
_MEANING_OF_FIELD = {
    "decided_on": "the belief on which the next control is decided",
    "how": "that the twin assumes or has learnt",
}
"""What stands on the page for fields that are texts of the program, not names of the run."""
_INTRODUCTION = """\
<!-- Written by `python -m benchmarks.store_page` from `twin_master/store/run.toml`. -->
# Stores of runs and fleets

This page lists the contents of `run.nc` of a run or a watch, and of `fleet.zarr` of a fleet. Where
both have the same contents, they have the same groups, variables, axes, labels and units. In a
store of a fleet every variable has the axis `twin` before its others.

```python
import uav_twin

run = uav_twin.open_run("runs/level_turns")            # an xarray.DataTree
run["filtered"].sel(region="z1")["mean"]               # (step)
run["predicted"]["control_probability"].sel(control="2g")   # (step, horizon)

fleet = uav_twin.open_fleet("runs/winter")             # an xarray.DataTree, a node for each group
fleet.sel(region="z1")["north"]["filtered"]["mean"]    # (twin, step)
fleet["north"].sel(twin="north-3")["observed"]["strain"]    # (step, sensor)
```

A word in upper case stands for a name of the run: ROLE is the observed quantity, such as `strain`,
and FACTOR a factor of the state, such as `z1`. A unit in upper case is that of the scenario or
binding. Where sensors have different units, the unit is `see sensor_unit`. Every variable has its
unit and meaning in `.attrs["units"]` and `.attrs["long_name"]`. In the steps that a twin of a fleet
did not fly its numbers are NaN and its control is -1.

The names of the twins are in the group of the fleet, and the groups inside it inherit them.

Stores of fleets of earlier versions are read in this layout, with one sentence for each file.
"""
_HEADER = "| variable | axes | unit | meaning |\n| --- | --- | --- | --- |\n"


def page() -> str:
    """Return the text of the page."""
    sections = [_INTRODUCTION]
    coordinates = SCHEMA["coordinates"] | SCHEMA["fleet_coordinates"]
    sections.append(_section("Labels of the axes", coordinates, {}))
    for group in _GROUPS:
        fields = FIELDS_OF_BELIEFS.get(group, {})
        sections.append(_section(f"Group `{group}` of a run", rows_of_group(group), fields))
    sections.append(_section("A group of a fleet", fleet_rows(), {}))
    return "\n".join(sections)


def _section(heading: str, rows: Mapping[str, list[str]], fields: Mapping[str, str]) -> str:
    """Return a section of the page with a table of variables."""
    return f"## {heading}\n\n{_HEADER}{''.join(_table_rows(rows, fields))}"


def _table_rows(rows: Mapping[str, list[str]], fields: Mapping[str, str]) -> Iterator[str]:
    """Yield the rows of a table of variables.

    Parameters
    ----------
    rows : mapping of str to list of str
        Axes, unit and meaning of each variable, by its name.
    fields : mapping of str to str
        The values of fields in braces. Another field is a name of the run, in upper case.
    """

    def filled(text: str) -> str:
        values = {**_MEANING_OF_FIELD, **fields}
        return re.sub(r"\{(\w+)\}", lambda match: _text_of(match.group(1), values), text)

    for name, (axes, unit, meaning, *_) in rows.items():
        axes_text = ", ".join(filled(axes).split())
        unit_text = "" if unit == "1" else filled(unit).replace("_", " ")
        meaning_text = filled(meaning).replace("|", "\\|")
        yield f"| `{filled(name)}` | {axes_text} | {unit_text} | {meaning_text} |\n"


def _text_of(field: str, values: Mapping[str, str]) -> str:
    """Return the text for a field in braces: its value, or its name in upper case."""
    return values.get(field, field.upper())


if __name__ == "__main__":
    atomic_write_text(PAGE, page())
