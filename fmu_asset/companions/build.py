"""Packing the companions of the wing as FMUs, by the machinery that packs it; equal input, equal bytes.

A companion is two files of this folder: its variables in TOML, and what it does with them in Python.
"""

import json
import tomllib
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
    \"\"\"Return the variables that were packed, and what is done with them.\"\"\"
    rows = json.loads((resources / "variables.json").read_text(encoding="utf-8"))
    return SlaveContents(tuple(FmuVariable(**row) for row in rows), Behaviour)

"""


def companion_bytes(name: str) -> bytes:
    """Return a companion, one of `COMPANION_NAMES`, as an FMU."""
    own = files("fmu_asset.companions")
    told = tomllib.loads((own / f"{name}.toml").read_text(encoding="utf-8"))
    declared = declared_companion(name, told)
    rows = json.dumps([asdict(row) for row in declared.table], indent=1) + "\n"
    members = python_members(
        declared,
        "Companion",
        imports=_IMPORTS.format(name=name, behaviour=told["behaviour"]),
        resources={"variables.json": rows.encode()},
        host="It runs in any Python host; the standard library is enough.",
    )
    folder = f"resources/{name}_{PLACEHOLDER}_runtime/companions"
    members[f"{folder}/__init__.py"] = b'"""What the FMU does."""\n'
    members[f"{folder}/{name}.py"] = (own / f"{name}.py").read_bytes()
    return sealed(members)[0]


def declared_companion(name: str, told: dict[str, Any]) -> Declaration:
    """Return what a companion declares, of the content of its TOML file.

    An output depends directly on the input that `of` names, if it does; losses are states.
    """
    table, dependencies = VariableTable({}), {"status": list[str]()}
    for group in told["group"]:
        for number in range(1, group.get("repeat", 1) + 1):
            for row in group["variables"]:
                given: dict[str, Any] = {
                    key: value.format(n=number) if isinstance(value, str) else value
                    for key, value in row.items()
                }
                source, box = given.pop("of", None), (given.pop("low", None), given.pop("high", None))
                table.add(**given, limits=box)
                if given["causality"] == "output":
                    dependencies[given["name"]] = [] if source is None else [source]
    table.add_status()
    return Declaration(name, told["description"], table.rows(), dependencies)
