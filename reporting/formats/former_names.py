"""Files of earlier versions, whose keys had other names: they are read under the present names.

A reader of files has a table of the names that its keys had before, and calls
`with_present_names` with what it read. The user is told once for each file. Remove a former name
from its table once its files are no longer to be read.
"""

import warnings
from collections.abc import Mapping

from reporting.words import listing

EVERY_KEY = "*"
"""In a location: every key of a table whose keys are names, such as those of assets."""

_sources_told: set[str] = set()


class FormerNameWarning(FutureWarning):
    """A file, a message or a command uses a name that was changed; it is read as before."""


def with_present_names(
    record: Mapping[str, object],
    present_names: Mapping[str, str],
    source: str,
    error: type[Exception],
) -> dict[str, object]:
    """Return the content of a file in which each key has its present name.

    The record itself is not changed.

    Parameters
    ----------
    record : dict of str to object
        The content, as it was read.
    present_names : dict of str to str
        The present name of a key, by its former location, such as "planner.inspections". A
        location does not number the tables of a list, and `*` stands for every key.
    source : str
        The name of the file, or what else was read; begins the message.

    Returns
    -------
    dict of str to object
        The content. A table without a former name is the same object as in the record.

    Raises
    ------
    error
        If a table has a key under its former and under its present name.

    Warns
    -----
    FormerNameWarning
        If there is a former name; once for each source in a process.
    """
    content: object = record
    present_name_of_found: dict[str, str] = {}
    for location, present_name in present_names.items():
        *tables, former_name = location.split(".")
        try:
            changed_content = _with_renamed_key(content, tables, former_name, present_name)
        except ValueError as cause:
            raise error(f"{source}: {cause}.") from None
        if changed_content is not content:
            present_name_of_found[former_name] = present_name
            content = changed_content
    if present_name_of_found:
        warn_of_former_names(source, present_name_of_found)
    return content if isinstance(content, dict) else dict(record)


def _with_renamed_key(
    node: object, tables: list[str], former_name: str, present_name: str
) -> object:
    """Return a table, or a list of tables, in which a key has its present name.

    Parameters
    ----------
    node : object
        The table or the list; anything else is returned as it is.
    tables : list of str
        The keys that lead from the node to the table of the key.
    former_name, present_name : str
        The names of the key.

    Returns
    -------
    object
        The table or list with the present name; the node itself if it does not have the key.

    Raises
    ------
    ValueError
        If a table has both names.
    """
    if isinstance(node, list | tuple):
        entries = [_with_renamed_key(entry, tables, former_name, present_name) for entry in node]
        pairs = zip(entries, node, strict=True)
        is_changed = any(entry is not former_entry for entry, former_entry in pairs)
        return entries if is_changed else node
    if not isinstance(node, Mapping):
        return node
    if not tables:
        if former_name not in node:
            return node
        if present_name in node:
            raise ValueError(f"`{former_name}` is now called `{present_name}`, and both are given")
        return {present_name if key == former_name else key: node[key] for key in node}
    outermost_key, *inner_keys = tables
    if outermost_key == EVERY_KEY:
        keys = list(node)
    else:
        keys = [outermost_key] if outermost_key in node else []
    for key in keys:
        changed_entry = _with_renamed_key(node[key], inner_keys, former_name, present_name)
        if changed_entry is not node[key]:
            node = {**node, key: changed_entry}
    return node


def warn_of_former_names(source: str, present_names: Mapping[str, str]) -> None:
    """Warn the user, once for each source in a process, that names have changed.

    Parameters
    ----------
    source : str
        The name of the file, or what else has the former names; begins the message.
    present_names : dict of str to str
        The present name of each former name that was found.
    """
    if source in _sources_told:
        return
    _sources_told.add(source)
    changes = listing(
        f"`{former_name}` is now called `{present_name}`"
        for former_name, present_name in present_names.items()
    )
    names = "The former name is" if len(present_names) == 1 else "The former names are"
    warnings.warn(f"{source}: {changes}. {names} still read.", FormerNameWarning, stacklevel=3)
