"""The keys of a file format as tables of Markdown, from its JSON Schema."""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from reporting.formats.schema import JsonSchema
from reporting.words import listing

Notation = Literal["toml", "json"]
"""The language of the files of a format, in which locations are written."""

_TYPE_NAMES = {
    "string": "text",
    "number": "number",
    "integer": "integer",
    "boolean": "true or false",
    "null": "null",
    "object": "table",
    "array": "list",
}
_BOUND_SIGNS = {
    "minimum": "≥",
    "exclusiveMinimum": ">",
    "maximum": "≤",
    "exclusiveMaximum": "<",
}
_NULL = {"type": "null"}
_ALTERNATIVES = ("anyOf", "oneOf")
_OPTIONAL_COLUMNS = ("unit", "default", "range")
"""Columns that a table has only if one of its keys has an entry there."""


class KeyRow(NamedTuple):
    """A row of a table of keys; each entry is a text of Markdown."""

    key: str
    meaning: str
    type: str
    unit: str
    default: str
    range: str


@dataclass
class KeyTable:
    """A table of a format, with its keys.

    Attributes
    ----------
    locations : list of str
        Where the table can stand in a file; empty for the file as a whole.
    """

    schema: JsonSchema
    locations: list[str] = field(default_factory=list)

    @property
    def kind(self) -> str | None:
        """The kind that the table has in a file, if its keys depend on that."""
        kind: str | None = self.schema["properties"].get("kind", {}).get("const")
        return kind


@dataclass(frozen=True)
class PrintedTable:
    """A table of keys that is printed on a page.

    Attributes
    ----------
    address : str
        The page, relative to the pages of the formats, and the anchor of the table on it.
    """

    schema: JsonSchema
    address: str


def printed_tables(
    schema: JsonSchema, notation: Notation, page: str, printed: Sequence[PrintedTable] = ()
) -> list[PrintedTable]:
    """Return the tables that `markdown_of_format` prints, with their addresses on the page."""
    return _with_addresses(_own_tables(schema, notation, printed), page)


def _own_tables(
    schema: JsonSchema, notation: Notation, printed: Sequence[PrintedTable]
) -> list[KeyTable]:
    """Return the tables of a format that no other page prints."""
    printed_elsewhere = [table.schema for table in printed]
    tables = _TableFinder(schema, notation).tables
    return [table for table in tables if table.schema not in printed_elsewhere]


def _with_addresses(tables: Sequence[KeyTable], page: str) -> list[PrintedTable]:
    """Return tables with their addresses on a page that prints them in this order.

    GitHub and MyST number the anchors of equal headings, as of variants of a format.
    """
    counts: Counter[str] = Counter()
    printed = []
    for group in _groups(tables):
        anchor = _anchor(_heading(group[0]) if len(group) == 1 else _heading_of_locations(group[0]))
        number = f"-{counts[anchor]}" if counts[anchor] else ""
        counts[anchor] += 1
        printed += [PrintedTable(table.schema, f"{page}#{anchor}{number}") for table in group]
    return printed


def markdown_of_format(
    schema: JsonSchema, notation: Notation, printed: Sequence[PrintedTable] = ()
) -> str:
    """Return Markdown that documents the keys of a file format, one section for each table of it.

    A section looks like this::

        ## `[noise]`

        The noise of a channel.

        | key | meaning | type | unit | default |
        | --- | --- | --- | --- | --- |
        | `standard_deviation` | Standard deviation. | number | m | needed |

    Tables that differ only in their `kind` share a section.

    Parameters
    ----------
    schema : dict
        The JSON Schema of the format.
    printed : sequence of PrintedTable
        Tables of other pages. A table of the format that equals one of them is not printed again;
        keys link to the other page.
    """
    tables = _own_tables(schema, notation, printed)
    addresses = [*printed, *_with_addresses(tables, page="")]

    def link(table_schema: JsonSchema) -> str:
        address = next(entry.address for entry in addresses if entry.schema == table_schema)
        return f"[table]({address})"

    sections = []
    for group in _groups(tables):
        if len(group) > 1:
            sections.append(_section_of_variants(group, schema, link))
            continue
        table = group[0]
        paragraphs = [
            f"## {_heading(table)}",
            _markdown(table.schema.get("description", "")),
            _markdown_table(list(_rows(table.schema, schema, link))),
        ]
        sections.append("\n\n".join(text for text in paragraphs if text))
    return "\n\n".join(sections) + "\n"


def _groups(tables: Sequence[KeyTable]) -> list[list[KeyTable]]:
    """Return the tables in groups: one group for the variants of a table, else one for each table.

    Variants are tables that follow one another, each with a `kind`, at the same locations in a
    file.
    """
    groups: list[list[KeyTable]] = []
    for table in tables:
        previous = groups[-1][0] if groups else None
        is_further_kind = (
            previous is not None
            and previous.kind is not None
            and table.kind is not None
            and previous.locations == table.locations
        )
        if is_further_kind:
            groups[-1].append(table)
        else:
            groups.append([table])
    return groups


def _section_of_variants(
    variants: Sequence[KeyTable], root: JsonSchema, link: Callable[[JsonSchema], str]
) -> str:
    """Return the section on variants of one table: each value of the key `kind` has its own keys.

    The section holds two Markdown tables: the kinds with the names and units of their keys, and all
    keys with their meanings. A key that has the same meaning in several kinds stands there once.

    Parameters
    ----------
    variants : sequence of KeyTable
        The variants, one for each kind.
    root : dict
        The JSON Schema of the format, in which references are looked up.
    link : callable
        Returns the link to the table with a given schema.
    """
    kind_lines = []
    kinds_by_row: dict[KeyRow, list[str]] = {}
    for variant in variants:
        kind = f"`{variant.kind}`"
        rows = [row for row in _rows(variant.schema, root, link) if row.key != "`kind`"]
        keys_with_units = [f"{row.key} [{row.unit}]" if row.unit else row.key for row in rows]
        meaning = _markdown(variant.schema.get("description", ""))
        kind_lines.append([kind, meaning, ", ".join(keys_with_units)])
        for row in rows:
            # The unit stands in the table of kinds already. Without it, the rows of a key that
            # differs in its unit only, such as a stiffness in N/m or N m, are one.
            row_without_unit = row._replace(unit="")
            kinds_by_row.setdefault(row_without_unit, []).append(kind)
    # a key that remains in several rows says which kinds each of them is for
    rows_per_key = Counter(row.key for row in kinds_by_row)
    key_rows = []
    for row, kinds in kinds_by_row.items():
        if rows_per_key[row.key] > 1:
            key_rows.append(row._replace(key=f"{row.key} of {listing(kinds)}"))
        else:
            key_rows.append(row)
    return "\n\n".join(
        [
            f"## {_heading_of_locations(variants[0])}",
            "The key `kind` decides the other keys.",
            _lines_of_table([["kind", "meaning", "keys [unit]"], *kind_lines]),
            _markdown_table(sorted(key_rows, key=lambda row: row.key)),
        ]
    )


def _markdown_table(rows: Sequence[KeyRow]) -> str:
    """Return rows as a table of Markdown, without optional columns that have no entry."""
    columns = [
        name
        for name in KeyRow._fields
        if name not in _OPTIONAL_COLUMNS or any(getattr(row, name) for row in rows)
    ]
    return _lines_of_table([columns, *([getattr(row, name) for name in columns] for row in rows)])


def _lines_of_table(cells: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as a table of Markdown, whose first row is the head."""
    head, *rows = [[cell or " " for cell in row] for row in cells]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def undocumented_keys(schema: JsonSchema) -> list[str]:
    """Return the keys of a format without description, and the keys of numbers without unit."""
    keys = []
    for table in _TableFinder(schema, "json").tables:
        for key, key_schema in table.schema["properties"].items():
            location = f"{' '.join(table.locations)} {key}".strip()
            if not _description(key_schema, schema):
                keys.append(f"{location}: no description")
            elif "unit" not in key_schema and "number" in _basic_types(key_schema, schema):
                keys.append(f"{location}: no unit")
    return keys


class _TableFinder:
    """Finds all tables of a format, in the order in which a reader meets them.

    Tables with the same keys, such as the time windows of all laws, are one.
    """

    def __init__(self, schema: JsonSchema, notation: Notation) -> None:
        self.tables: list[KeyTable] = []
        self._root = schema
        self._notation = notation
        self._waiting: list[tuple[JsonSchema, str]] = [(schema, "")]
        while self._waiting:
            node, location = self._waiting.pop(0)
            self._visit(node, location)

    def _visit(self, node: JsonSchema, location: str) -> None:
        """Add the tables that a part of the schema describes, and queue the tables inside them."""
        node = _resolved(node, self._root)
        for key in _ALTERNATIVES:
            for alternative in node.get(key, ()):
                self._visit(alternative, location)
        if "items" in node:
            row = f"{location}[]" if self._notation == "json" else f"[{location}]"
            self._visit(node["items"], row)
        for entry in node.get("prefixItems", ()):
            self._visit(entry, location)
        if isinstance(node.get("additionalProperties"), dict):
            self._visit(node["additionalProperties"], self._location_in(location, "NAME"))
        if "properties" in node:
            self._add_table(node, location)

    def _add_table(self, node: JsonSchema, location: str) -> None:
        """Add a table, or a further location of a table that was found before."""
        for table in self.tables:
            if table.schema == node:
                if location not in table.locations:
                    table.locations.append(location)
                return
        self.tables.append(KeyTable(node, [location]))
        for key, key_schema in node["properties"].items():
            self._waiting.append((key_schema, self._location_in(location, key)))

    def _location_in(self, location: str, key: str) -> str:
        """Return the location of a table inside another table."""
        if self._notation == "json":
            return f"{location}.{key}".lstrip(".")
        inner_location = location.strip("[]")
        return f"[{inner_location}.{key}]".replace("[.", "[")


def _resolved(node: JsonSchema, root: JsonSchema) -> JsonSchema:
    """Return a part of a schema; if the part is a reference, the definition that it refers to."""
    reference = node.get("$ref")
    if reference is None:
        return node
    definition: JsonSchema = root["$defs"][reference.rpartition("/")[2]]
    return _resolved(definition, root)


def _heading(table: KeyTable) -> str:
    """Return the heading of a table: its locations, and its kind if it has one."""
    heading = _heading_of_locations(table)
    if table.kind is not None:
        return f'{heading}, kind "{table.kind}"'
    variant = table.schema.get("variant")
    return f"{heading}, {variant}" if variant else heading


def _heading_of_locations(table: KeyTable) -> str:
    """Return the locations of a table as a heading."""
    locations = [f"`{location}`" for location in table.locations if location]
    return listing(locations) if locations else "The file"


def _anchor(heading: str) -> str:
    """Return the anchor that GitHub and MyST give a heading."""
    text = re.sub(r"[^\w\- ]", "", heading.lower())
    return text.replace(" ", "-")


def _rows(
    table: JsonSchema, root: JsonSchema, link: Callable[[JsonSchema], str]
) -> Iterator[KeyRow]:
    """Yield a row for each key of a table, whose schema is a part of `root`."""
    required = table.get("required", ())
    for key, key_schema in table["properties"].items():
        unit = key_schema.get("unit", "")
        if "same_as" in key_schema:
            yield KeyRow(
                key=f"`{key}`",
                meaning=f"As `{key_schema['same_as']}`.",
                type="",
                unit=unit,
                default="",
                range="",
            )
            continue
        yield KeyRow(
            key=f"`{key}`",
            type=_type_text(key_schema, root, link),
            unit="" if unit == "1" else unit,
            default="needed" if key in required else _default_text(key_schema),
            range=_range_text(key_schema, root),
            meaning=_markdown(_description(key_schema, root)),
        )


def _description(key_schema: JsonSchema, root: JsonSchema) -> str:
    """Return the description of a key; pydantic leaves it to its table if both have the same."""
    text: str | None = key_schema.get("description")
    if text is not None:
        return text
    description: str = _resolved(key_schema, root).get("description", "")
    return description


def _markdown(text: str) -> str:
    """Return a text without characters that would end a cell of a table."""
    return text.replace("|", "\\|").replace("``", "`").replace("<", "\\<")


def _default_text(schema: JsonSchema) -> str:
    """Return the default of a key as text; empty if there is none, or none that can be written."""
    default = schema.get("default")
    if default is None or default in ("", [], {}) or isinstance(default, dict):
        return ""
    return f"`{json.dumps(default, ensure_ascii=False)}`"


def _type_text(node: JsonSchema, root: JsonSchema, link: Callable[[JsonSchema], str]) -> str:
    """Return the type of a value in words, such as "list of: number".

    References of `node` are looked up in `root`, the schema of the whole format. `link` returns the
    link to a table.
    """
    node = _resolved(node, root)
    if "const" in node:
        return f"`{json.dumps(node['const'])}`"
    if "enum" in node:
        return listing([f"`{json.dumps(word)}`" for word in node["enum"]], "or")
    for key in _ALTERNATIVES:
        if key in node:
            alternatives = [entry for entry in node[key] if entry != _NULL]
            texts = [_type_text(entry, root, link) for entry in alternatives]
            return " or ".join(dict.fromkeys(texts))
    if "properties" in node:
        return link(node)
    if isinstance(node.get("additionalProperties"), dict):
        return f"by name: {_entry_type(node['additionalProperties'], root, link)}"
    if "prefixItems" in node:
        entries = dict.fromkeys(_type_text(entry, root, link) for entry in node["prefixItems"])
        return f"list of {len(node['prefixItems'])}: {', '.join(entries)}"
    if "items" in node:
        return f"list of: {_entry_type(node['items'], root, link)}"
    types = node.get("type", [])
    names = [_TYPE_NAMES[name] for name in ([types] if isinstance(types, str) else types)]
    return " or ".join(names) or "any value"


def _entry_type(node: JsonSchema, root: JsonSchema, link: Callable[[JsonSchema], str]) -> str:
    """Return the type of the entries of a list or table; in brackets if there are alternatives."""
    text = _type_text(node, root, link)
    return f"({text})" if " or " in text else text


def _range_text(node: JsonSchema, root: JsonSchema) -> str:
    """Return the bounds of a value, or of the numbers in it, in words."""
    bounds = dict.fromkeys(_bounds(node, root))
    # A bound that is excluded by one part of a type is not repeated as an included one.
    return ", ".join(
        bound
        for bound in bounds
        if bound.replace("≥", ">").replace("≤", "<") not in {*bounds} - {bound}
    )


def _bounds(node: JsonSchema, root: JsonSchema) -> Iterator[str]:
    """Yield the bounds of a value and, if it is a list, of its entries."""
    node = _resolved(node, root)
    for key, sign in _BOUND_SIGNS.items():
        if key in node:
            yield f"{sign} {node[key]:.10g}"
    if node.get("minItems", 0) > 1 and "prefixItems" not in node:
        yield f"at least {node['minItems']} entries"
    if "maxItems" in node and "prefixItems" not in node:
        yield f"at most {node['maxItems']} entries"
    for entry in _inner_schemas(node):
        yield from _bounds(entry, root)


def _inner_schemas(node: JsonSchema) -> Iterator[JsonSchema]:
    """Yield the schemas of a value's alternatives, and of the entries of a list or table."""
    for key in (*_ALTERNATIVES, "prefixItems"):
        yield from node.get(key, ())
    for key in ("items", "additionalProperties"):
        if isinstance(node.get(key), dict):
            yield node[key]


def _basic_types(node: JsonSchema, root: JsonSchema) -> set[str]:
    """Return the types of JSON, other than tables, that a value or its entries can have."""
    node = _resolved(node, root)
    types: set[str] = set()
    if "properties" in node:
        return types
    if isinstance(node.get("type"), str):
        types.add(node["type"])
    for entry in _inner_schemas(node):
        types |= _basic_types(entry, root)
    return types
