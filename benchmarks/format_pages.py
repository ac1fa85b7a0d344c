"""The JSON Schemas of all file formats, and the pages that list their keys.

``python -m benchmarks.format_pages`` writes them anew from the classes that read and write the
formats.
"""

from collections.abc import Iterator
from pathlib import Path

from reporting.files import atomic_write_text
from reporting.format_tables import PrintedTable, format_page, printed_tables
from uav_twin.formats import FORMATS, FileFormat

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
        page = FOLDER / f"{file_format.name}.md"
        printed = printed_of_topic.setdefault(file_format.page, [])
        yield page, _page_of(file_format, printed)
        printed += printed_tables(file_format.schema(), file_format.notation, page.name, printed)
        yield file_format.schema_file, file_format.schema_text()
        name = Path(file_format.page).stem.replace("_", " ")
        rows.append(
            f"| {file_format.title} | {file_format.notation.upper()} | "
            f"[{file_format.name}]({page.name}) | [{name}](../../{file_format.page}) |\n"
        )
    yield FOLDER / "index.md", _INTRODUCTION + "".join(rows)


def _page_of(file_format: FileFormat, printed: list[PrintedTable]) -> str:
    """Return the page of a format, without tables that are printed on pages before it."""
    title = file_format.title[:1].upper() + file_format.title[1:]
    name = Path(file_format.page).stem.replace("_", " ")
    head = (
        f"{_NOTE}\n# {title}\n\nThis page lists the keys of the format. The page "
        f"[{name}](../../{file_format.page}) explains how they are used. `uav-twin schema "
        f"{file_format.name}` prints the JSON Schema. There is a [list of all "
        "formats](index.md).\n\n"
    )
    return head + format_page(file_format.schema(), file_format.notation, printed)


if __name__ == "__main__":
    for path, text in pages():
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_text(path, text)
