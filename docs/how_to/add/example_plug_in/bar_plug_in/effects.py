"""Effects for the search."""

from pathlib import Path

from discrepancy.catalogue.effect_file import effects_of_file


def effects():
    """Return the effects of the file beside this one."""
    return effects_of_file(Path(__file__).with_name("effects.toml"))
