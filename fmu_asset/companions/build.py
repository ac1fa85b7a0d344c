"""Packing the companions of the wing as FMUs; equal input gives equal bytes.

A companion is two files of this folder: its variables in TOML, and its behaviour in Python. The FMU
is packed like that of a wing, with the same slave.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from importlib.resources import files
from typing import Any

from fmu_asset.description import PLACEHOLDER, Declaration
from fmu_asset.packing.contents import python_members, sealed
from fmu_asset.slaves.variables import VariableTable

_IMPORTS = """import json

from .companions.{name} import {behaviour} as Behaviour
from .slaves.contents import SlaveContents
from .slaves.variables import FmuVariable


def load_contents(resources):
    \"\"\"Return the variables that were packed, and their behaviour.\"\"\"
    rows = json.loads((resources / "variables.json").read_text(encoding="utf-8"))
    return SlaveContents(tuple(FmuVariable(**row) for row in rows), Behaviour)

"""


def companion_bytes(name: str) -> bytes:
    """Return a companion of the wing as the content of an FMU file.

    Parameters
    ----------
    name : str
        One of `COMPANION_NAMES`.
    """
    folder = files("fmu_asset.companions")
    description = tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))
    declaration = companion_declaration(name, description)
    rows = [asdict(variable) for variable in declaration.table]
    variables = json.dumps(rows, indent=1) + "\n"
    members = python_members(
        declaration,
        "Companion",
        imports=_IMPORTS.format(name=name, behaviour=description["behaviour"]),
        resources={"variables.json": variables.encode()},
        host="It runs in any Python host; the standard library is enough.",
    )
    packed_folder = f"resources/{name}_{PLACEHOLDER}_runtime/companions"
    members[f"{packed_folder}/__init__.py"] = b'"""The behaviour of the FMU."""\n'
    members[f"{packed_folder}/{name}.py"] = (folder / f"{name}.py").read_bytes()
    return sealed(members).content


def companion_declaration(name: str, description: Mapping[str, Any]) -> Declaration:
    """Return the declaration of a companion, from the content of its TOML file.

    Parameters
    ----------
    name : str
        The model name.
    description : mapping
        The TOML file: `description`, and `group`, a list of tables with `variables` and `repeat`. A
        variable has the keys of `VariableTable.add`, with `low` and `high` for its range; an output
        may name the input that it depends on directly as `of`.
    """
    table = VariableTable({})
    dependencies: dict[str, list[str]] = {"status": []}
    for group in description["group"]:
        for number in range(1, group.get("repeat", 1) + 1):
            for row in group["variables"]:
                _add_variable(table, dependencies, row, number)
    table.add_status()
    return Declaration(name, description["description"], table.rows(), dependencies)


def _add_variable(
    table: VariableTable, dependencies: dict[str, list[str]], row: Mapping[str, Any], number: int
) -> None:
    """Add a variable to the table, and its direct dependency if it is an output.

    Parameters
    ----------
    table : VariableTable
        The variables so far.
    dependencies : dict of str to list of str
        The inputs that each output depends on directly.
    row : mapping
        The variable in the TOML file.
    number : int
        The number that stands for `{n}` in its texts.
    """
    keys: dict[str, Any] = {}
    for key, value in row.items():
        keys[key] = value.format(n=number) if isinstance(value, str) else value
    source = keys.pop("of", None)
    value_range = (keys.pop("low", None), keys.pop("high", None))
    table.add(**keys, limits=value_range)
    if keys["causality"] == "output":
        dependencies[keys["name"]] = [] if source is None else [source]
