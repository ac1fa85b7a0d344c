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
    """Return the content of a file with the present name of each key that had another one.

    Parameters
    ----------
    record : dict of str to object
        The content, as it was read.
    present_names : dict of str to str
        The present name of a key, by the location that it had before: "planner.inspections". The
        location of a key in a table of a list has no number, and `*` stands for every key.
    source : str
        The name of the file, or what else was read; begins the message.
    error : type of Exception
        The exception to raise.

    Returns
    -------
    dict of str to object
        The content. What has no former name is the same object as before.

    Raises
    ------
    error
        If a table has a key under its former and under its present name.

    Warns
    -----
    FormerNameWarning
        If there is a former name; once for each source in a process.
    """
    renamed: object = record
    used: dict[str, str] = {}
    for location, present_name in present_names.items():
        *tables, former_name = location.split(".")
        try:
            changed = _with_renamed_key(renamed, tables, former_name, present_name)
        except ValueError as cause:
            raise error(f"{source}: {cause}.") from None
        if changed is not renamed:
            used[former_name] = present_name
            renamed = changed
    if used:
        warn_of_former_names(source, used)
    return renamed if isinstance(renamed, dict) else dict(record)


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
        The node itself where it does not have the key.

    Raises
    ------
    ValueError
        If a table has both names.
    """
    if isinstance(node, list | tuple):
        entries = [_with_renamed_key(entry, tables, former_name, present_name) for entry in node]
        is_changed = any(new is not old for new, old in zip(entries, node, strict=True))
        return entries if is_changed else node
    if not isinstance(node, Mapping):
        return node
    if not tables:
        if former_name not in node:
            return node
        if present_name in node:
            raise ValueError(f"`{former_name}` is now called `{present_name}`, and both are given")
        return {present_name if key == former_name else key: node[key] for key in node}
    inner, *further = tables
    keys = list(node) if inner == EVERY_KEY else [inner] if inner in node else []
    for key in keys:
        changed = _with_renamed_key(node[key], further, former_name, present_name)
        if changed is not node[key]:
            node = {**node, key: changed}
    return node


def warn_of_former_names(source: str, used: Mapping[str, str]) -> None:
    """Warn the user, once for each source in a process, that names have changed.

    Parameters
    ----------
    source : str
        The name of the file, or what else has the former names; begins the message.
    used : dict of str to str
        The present name of each former name that was found.
    """
    if source in _sources_told:
        return
    _sources_told.add(source)
    changes = listing(f"`{former}` is now called `{present}`" for former, present in used.items())
    names = "The former name is" if len(used) == 1 else "The former names are"
    warnings.warn(f"{source}: {changes}. {names} still read.", FormerNameWarning, stacklevel=3)
