"""The JSON Schemas of all file formats, and the pages that list their keys.

``python -m benchmarks.format_pages`` writes them anew from the classes that read and write the
formats. With ``--check`` it writes nothing, but lists the files that are not up to date.
"""

import json
import sys
from collections.abc import Iterator
from functools import reduce
from importlib import import_module
from inspect import isfunction
from operator import or_
from pathlib import Path

from reporting.files import atomic_write_text
from reporting.formats import known_keys
from reporting.formats.schema import JsonSchema, format_schema
from reporting.formats.tables import PrintedTable, markdown_of_format, printed_tables
from uav_twin.formats import FORMATS, SCHEMA_FOLDER, FileFormat

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "reference" / "formats"
_NOTE = "<!-- Written by `python -m benchmarks.format_pages`; edit the classes, not this page. -->"
_INTRODUCTION = f"""\
{_NOTE}
# File formats

Every key of every file that you write or read, with its type, unit, default and range. The tables
and the JSON Schemas come from the classes that read and write the files, so that a file that breaks
a table is refused.

`uav-twin schema` lists the formats, and `uav-twin schema campaign` prints the JSON Schema of one.
An editor that knows JSON Schema (Even Better TOML, taplo) then completes keys and marks mistakes:

```
uav-twin schema campaign --out campaign.schema.json
```

writes the schema beside your file, whose first line names it:

```toml
#:schema ./campaign.schema.json
```

The shipped files, and the files that `uav-twin fmu bind` and `uav-twin structure fmu` draft, have
such a line already. Further formats are the [stores of runs and fleets](../stores.md) and the
[tables of a campaign](../campaign.md#tables).

In the tables *needed* means that a key has no default. A unit is empty if a number has none. A key
of a scenario may end with its unit: `levels_percent` in place of `levels`.

| format | language | keys | explained in |
| --- | --- | --- | --- |
"""


def pages() -> Iterator[tuple[Path, str]]:
    """Yield the files that follow from the formats, each with its text."""
    rows = []
    # formats that are explained together, such as a verdict and its patch, share tables
    printed_of_topic: dict[str, list[PrintedTable]] = {}
    for file_format in FORMATS.values():
        schema = schema_of_classes(file_format)
        page = FOLDER / f"{file_format.name}.md"
        printed = printed_of_topic.setdefault(file_format.page, [])
        yield page, _page_of(file_format, schema, printed)
        printed += printed_tables(schema, file_format.notation, page.name, printed)
        yield file_format.schema_file, json.dumps(schema, indent=1, ensure_ascii=False) + "\n"
        name = Path(file_format.page).stem.replace("_", " ")
        rows.append(
            f"| {file_format.title} | {file_format.notation.upper()} | "
            f"[{file_format.name}]({page.name}) | [{name}](../../{file_format.page}) |\n"
        )
    yield FOLDER / "index.md", _INTRODUCTION + "".join(rows)


def schema_of_classes(file_format: FileFormat) -> JsonSchema:
    """Return the JSON Schema of a format, from the classes that read or write its files."""
    objects = []
    for source in file_format.sources:
        module, _, name = source.partition(":")
        objects.append(getattr(import_module(module), name))
    if isfunction(objects[0]):
        schema: JsonSchema = objects[0]()
        return schema
    return format_schema(reduce(or_, objects), file_format.title)


def _page_of(file_format: FileFormat, schema: JsonSchema, printed: list[PrintedTable]) -> str:
    """Return the page of a format, without tables that are printed on pages before it."""
    title = file_format.title[:1].upper() + file_format.title[1:]
    name = Path(file_format.page).stem.replace("_", " ")
    head = (
        f"{_NOTE}\n# {title}\n\nThis page lists the keys of the format. The page "
        f"[{name}](../../{file_format.page}) explains how they are used. `uav-twin schema "
        f"{file_format.name}` prints the JSON Schema. There is a [list of all "
        "formats](index.md).\n\n"
    )
    return head + markdown_of_format(schema, file_format.notation, printed)


def outdated_files(files: dict[Path, str]) -> list[Path]:
    """Return the files of both folders whose text is not the given one, or that are superfluous."""
    present = {path for folder in (FOLDER, SCHEMA_FOLDER) for path in folder.iterdir()}
    outdated = present - files.keys()
    for path, text in files.items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            outdated.add(path)
    return sorted(outdated)


if __name__ == "__main__":
    known_keys.TEXTS_ARE_READ = True
    files = dict(pages())
    if sys.argv[1:] == ["--check"]:
        sys.exit("\n".join(str(path.relative_to(ROOT)) for path in outdated_files(files)) or None)
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_text(path, text)
