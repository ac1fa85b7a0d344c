"""Shell completion of arguments and options: names of what is shipped.

Where no name fits, the shell itself completes the paths of files.
"""

from collections.abc import Iterable
from pathlib import Path

import discrepancy
from scenarios import structure_files


def complete_structure(incomplete: str) -> list[str]:
    """Return the shipped structures whose names begin with the typed text."""
    return _names_beginning_with(incomplete, structure_files())


def complete_model(incomplete: str) -> list[str]:
    """Return the shipped lumped models and structures whose names begin with the typed text."""
    return _names_beginning_with(incomplete, [*_lumped_model_names(), *structure_files()])


def complete_effect(incomplete: str) -> list[str]:
    """Return the effects of the catalogue whose identifiers begin with the typed text."""
    from discrepancy.catalogue.library import load_catalogue

    return _names_beginning_with(incomplete, [effect.identifier for effect in load_catalogue()])


def _lumped_model_names() -> list[str]:
    """Return the names of the shipped lumped models, without importing their package."""
    folder = Path(discrepancy.__file__).parent / "lumped_models"
    return sorted(file.stem for file in folder.glob("*.toml"))


def _names_beginning_with(incomplete: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with the typed text."""
    return [name for name in names if name.startswith(incomplete)]
