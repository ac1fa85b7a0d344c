"""What flies and what the twin believes: two unions of tables, each told apart by its `kind`.

A kind is one class in one file: a subclass of `AssetSection` or `BeliefSection` in a file whose name ends in
`_source`, beside `asset_source`. Its fields are what a user writes, and its `source` makes of them what the
mission needs. Nothing else has to know of it.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, ClassVar, Self

from pydantic import ModelWrapValidatorHandler, model_validator

from reporting.toml_file import shown
from scenarios import asset_scripts, binding_files, recording_files, structure_files
from twin_master.scenario.section import Section, short

KIND_FOLDER = Path(__file__).parents[1] / "assets"
KIND_PACKAGE = f"{__package__.rpartition('.')[0]}.{KIND_FOLDER.name}"
"""Where the kinds are found by the names of their files: the tables know none of them."""
CALIBRATED_DESIGN_NAME = "calibration"
"""The tailored design inside the calibration file: with a file it takes the place of the scenario's."""


def _shipped_designs() -> dict[str, Path]:
    from fe.wing.design import SHIPPED_DESIGN

    return {path.stem: path for path in sorted(SHIPPED_DESIGN.parent.glob("*.toml"))}


class FileSection(Section):
    """A table that names files: its own, by their paths, or shipped ones, by their names."""

    shipped: ClassVar = {
        "binding": binding_files,
        "design": _shipped_designs,
        "observations": recording_files,
        "script": asset_scripts,
        "structure": structure_files,
    }

    kept: ClassVar[Mapping[str, str]] = {}
    """For each key that names a file the place of its copy in a run folder."""

    def copies(self) -> Mapping[str, str]:
        """Return for each key that names a file where its copy stands in a run folder."""
        return self.kept

    def own_files(self) -> dict[str, str]:
        """Return the paths of the files that are not shipped, by their keys."""
        given = {key: getattr(self, key) for key in self.copies()}
        return {key: path for key, path in given.items() if path and not self._is_shipped(key, path)}

    def all_files(self) -> dict[str, Path]:
        """Return all files, the shipped ones too, by the places of their copies in a run folder."""
        found = {}
        for key, copy in self.copies().items():
            name = getattr(self, key)
            if name and name != CALIBRATED_DESIGN_NAME:
                shipped = self.shipped[key]() if key in self.shipped else {}
                found[copy] = shipped.get(name, Path(name))
        return found

    def moved(self, folder: Path) -> Self:
        """Return the table with its relative paths from a folder."""
        return self.model_copy(update={key: str(folder / path) for key, path in self.own_files().items()})

    def portable(self) -> "FileSection":
        """Return the table with the paths of the copies inside a run folder."""
        return self.model_copy(update={key: self.copies()[key] for key in self.own_files()})

    def _is_shipped(self, key: str, name: str) -> bool:
        return name == CALIBRATED_DESIGN_NAME or (key in self.shipped and name in self.shipped[key]())


class KindSection(FileSection):
    """A table whose `kind` says which class it is of."""

    kind: str
    own_figures: ClassVar[bool] = False
    """Whether its observations are of no model that anything else flies or believes."""

    @property
    def departs(self) -> bool:
        """Whether this is known to be another model than all else, by its own figures or a patch."""
        return self.own_figures or getattr(self, "patch", None) is not None

    @classmethod
    def kinds(cls) -> dict[str, type[Self]]:
        """Return the kinds of this union and their classes."""
        for module in iter_modules([str(KIND_FOLDER)]):
            if module.name.endswith("_source"):
                import_module(f"{KIND_PACKAGE}.{module.name}")
        return {kind: found for found in _subclasses(cls) if (kind := found.own_kind()) is not None}

    @classmethod
    def own_kind(cls) -> str | None:
        """Return the kind of this class; None for the union itself."""
        kind = cls.model_fields["kind"].default
        return kind if isinstance(kind, str) else None

    @model_validator(mode="wrap")
    @classmethod
    def _of_its_kind(cls, table: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if cls.own_kind() is not None or not isinstance(table, Mapping):
            return handler(table)
        kinds, kind = cls.kinds(), table.get("kind")
        if not isinstance(kind, str) or kind not in kinds:
            came = f"{shown(kind)} came" if "kind" in table else "it is missing"
            raise ValueError(f"`kind` must be one of {short(sorted(kinds))}, and {came}")
        return kinds[kind].model_validate(table)


class BeliefSection(KindSection):
    """What the twin believes: where its predicted observations come from."""

    @abstractmethod
    def source(self, scenario: Any, flown: Any) -> Any:
        """Return what the twin of a `Scenario` believes of what is flown, both `asset_source.AssetSource`."""


class AssetSection(KindSection):
    """What flies."""

    is_fmu: ClassVar[bool] = False
    """Whether it is an FMU, or several, and so may carry damage and sensors of its own."""

    @property
    def true_parameters(self) -> Mapping[str, float]:
        """Parameters of the true asset, SI, as far as they are given."""
        return {}

    @property
    def constant_load(self) -> Mapping[str, float]:
        """Load inputs, the same in every step, SI."""
        return {}

    @abstractmethod
    def source(self, scenario: Any) -> Any:
        """Return what is flown in a `Scenario`, an `asset_source.AssetSource`."""


def _subclasses(cls: type[KindSection]) -> Iterator[type[Any]]:
    for found in cls.__subclasses__():
        yield found
        yield from _subclasses(found)
