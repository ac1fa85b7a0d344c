"""Packs the companions of the wing as FMUs; equal input gives equal bytes.

A companion consists of two files of this folder: its variables in TOML, and its behaviour in
Python. The FMU is packed like that of a wing, with the same slave.
"""

import json
import tomllib
from dataclasses import asdict
from importlib.resources import files

from fmu_asset.description import PLACEHOLDER, Declaration
from fmu_asset.packing.contents import python_members, seal_fmu
from fmu_asset.slaves.variables import VariableTable
from reporting.formats.toml_file import TomlTable

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
    """Return the bytes of a companion's FMU file.

    Parameters
    ----------
    name : str
        The name of the companion, one of `COMPANION_NAMES`.
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
    # the Python file with the behaviour
    packed_folder = f"resources/{name}_{PLACEHOLDER}_runtime/companions"
    members[f"{packed_folder}/__init__.py"] = b'"""The behaviour of the FMU."""\n'
    members[f"{packed_folder}/{name}.py"] = (folder / f"{name}.py").read_bytes()
    return seal_fmu(members).content


def companion_declaration(name: str, description: TomlTable) -> Declaration:
    """Return the declarations of a companion FMU, made from its TOML file.

    Parameters
    ----------
    description : mapping
        The content of the TOML file: a text `description`, and a list of tables `group`. The
        variables of a group are declared `repeat` times (by default once), with the number of the
        repetition instead of `{n}` in their texts. A variable has the keys of `VariableTable.add`,
        with `low` and `high` for its range. An output may name by the key `of` the input on which
        it depends directly.
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
    table: VariableTable, dependencies: dict[str, list[str]], row: TomlTable, number: int
) -> None:
    """Add a variable to the table, and the direct dependency of an output.

    `number` replaces `{n}` in the texts of the variable.
    """
    attributes: TomlTable = {}
    for key, value in row.items():
        attributes[key] = value.format(n=number) if isinstance(value, str) else value
    input_name = attributes.pop("of", None)
    value_range = (attributes.pop("low", None), attributes.pop("high", None))
    table.add(**attributes, limits=value_range)
    if attributes["causality"] == "output":
        dependencies[attributes["name"]] = [] if input_name is None else [input_name]
