"""Tables of a scenario that name files, and the two tables whose `kind` decides their other keys.

The asset that flies (`asset`) and the model that the twin believes (`belief`) are of several kinds.
The value of `kind` in such a table selects the class that reads the table: a subclass of
`AssetSection` or `BeliefSection` in a file of the folder `assets` whose name ends in `_source`. Its
fields are the keys that a user writes, and its method `source` returns an `AssetSource`. No other
code names the kinds. An installed package adds a kind by an entry point for such a class.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, ClassVar, Self, TypeVar

from pydantic import GetJsonSchemaHandler, ModelWrapValidatorHandler, model_validator
from pydantic_core import CoreSchema

from fe.runtime.errors import PlugInError
from fe.runtime.plug_ins import load_plug_ins
from reporting.formats.toml_file import missing_keys, short_repr
from scenarios import asset_scripts, binding_files, recording_files, structure_files
from twin_master.scenario.section import Section, Table

KIND_FOLDER = Path(__file__).parents[1] / "assets"
"""The folder of the modules that define the kinds."""
WATCHED_KIND = "watched"
"""Kind of the asset of a scenario without `[asset]`."""
KIND_PACKAGE = f"{__package__.rpartition('.')[0]}.{KIND_FOLDER.name}"
CALIBRATED_DESIGN_NAME = "calibration"
"""The name, in a scenario, of the wing design in a calibration file."""


def _shipped_designs() -> dict[str, Path]:
    """Return the files of the shipped wing designs by their names."""
    from fe.wing.design import SHIPPED_DESIGN

    return {path.stem: path for path in sorted(SHIPPED_DESIGN.parent.glob("*.toml"))}


class FileSection(Section):
    """A table that names files: a user's own by their paths, or shipped ones by their names."""

    shipped: ClassVar = {
        "binding": binding_files,
        "design": _shipped_designs,
        "observations": recording_files,
        "script": asset_scripts,
        "structure": structure_files,
    }
    """For each key, the function that returns the shipped files by name."""

    copy_paths: ClassVar[Mapping[str, str]] = {}
    """For each key that names a file, the path of its copy inside a run folder."""

    def copies(self) -> Mapping[str, str]:
        """Return for each key that names a file the path of its copy inside a run folder."""
        return self.copy_paths

    def user_files(self) -> dict[str, str]:
        """Return the paths of the user's own files, by the keys that name them."""
        user_files = {}
        for key in self.copies():
            name = getattr(self, key)
            if name and not self._is_shipped(key, name):
                user_files[key] = name
        return user_files

    def all_files(self) -> dict[str, Path]:
        """Return all files, shipped ones too, by the paths of their copies inside a run folder.

        The design inside a calibration file has no file of its own.
        """
        files = {}
        for key, copy in self.copies().items():
            name = getattr(self, key)
            if name and name != CALIBRATED_DESIGN_NAME:
                shipped_files = self.shipped[key]() if key in self.shipped else {}
                files[copy] = shipped_files.get(name, Path(name))
        return files

    def with_paths_from(self, folder: Path) -> Self:
        """Return the table with its relative paths joined to a folder."""
        paths = {key: str(folder / path) for key, path in self.user_files().items()}
        return self.model_copy(update=paths)

    def portable(self) -> "FileSection":
        """Return the table with the paths of user files replaced by those of their copies."""
        copies = self.copies()
        return self.model_copy(update={key: copies[key] for key in self.user_files()})

    def _is_shipped(self, key: str, name: str) -> bool:
        """Return whether a key holds the name of a shipped file, or of a calibration's design."""
        if name == CALIBRATED_DESIGN_NAME:
            return True
        return key in self.shipped and name in self.shipped[key]()


class KindSection(FileSection):
    """A table whose `kind` decides which subclass it belongs to."""

    kind: str
    """The kind of the table, which decides its other keys."""
    entry_point_group: ClassVar[str]
    """Group of the entry points of kinds: the name is the kind, the object is its class."""
    has_unique_model: ClassVar[bool] = False
    """Whether no other kind has the model of its observations."""

    @property
    def is_known_to_differ(self) -> bool:
        """Whether its model certainly differs from every other kind's."""
        has_patch = getattr(self, "patch", None) is not None
        return self.has_unique_model or has_patch

    @classmethod
    def kinds(cls) -> dict[str, type[Self]]:
        """Import the modules that define kinds; return the subclasses by their kinds.

        Raises
        ------
        PlugInError
            If a section class of an installed package cannot be imported, or is refused by
            `import_installed_kinds`.
        """
        for module in iter_modules([str(KIND_FOLDER)]):
            if module.name.endswith("_source"):
                import_module(f"{KIND_PACKAGE}.{module.name}")
        import_installed_kinds(cls)
        kinds = {}
        for subclass in _all_subclasses(cls):
            kind = subclass.kind_of_class()
            if kind is not None:
                kinds[kind] = subclass
        return kinds

    @classmethod
    def kind_of_class(cls) -> str | None:
        """Return the kind of this class; None for a base class, which has no kind of its own."""
        kind = cls.model_fields["kind"].default
        return kind if isinstance(kind, str) else None

    @classmethod
    def is_shipped_kind(cls) -> bool:
        """Return whether uav-twin itself defines this class, and no other package."""
        return cls.__module__.startswith(KIND_PACKAGE)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> Table:
        """Return the JSON Schema of a kind, or that of all kinds for a base class."""
        kind = cls.kind_of_class()
        if kind is None:
            schemas = []
            for name, subclass in sorted(cls.kinds().items()):
                if subclass.is_shipped_kind() and name != WATCHED_KIND:  # users write no such table
                    core = subclass.__pydantic_core_schema__
                    schemas.append(subclass.__get_pydantic_json_schema__(core, handler))
            return {"oneOf": schemas}
        schema = super().__get_pydantic_json_schema__(core_schema, handler)
        table = handler.resolve_ref_schema(schema)
        if "properties" in table:
            description = table["properties"]["kind"]["description"]
            table["properties"]["kind"] = {"const": kind, "description": description}
            other_required = [key for key in table.get("required", []) if key != "kind"]
            table["required"] = ["kind", *other_required]
        return schema

    @model_validator(mode="wrap")
    @classmethod
    def _validate_as_kind(cls, table: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Return the table as a record of the subclass that its `kind` names.

        A subclass with a kind of its own, and an existing record, are validated as usual.
        """
        if cls.kind_of_class() is not None or not isinstance(table, Mapping):
            return handler(table)
        kinds = cls.kinds()
        kind = table.get("kind")
        if isinstance(kind, str) and kind in kinds:
            return kinds[kind].model_validate(table)
        expectation = f"`kind` must be one of {', '.join(sorted(kinds))}"
        if "kind" not in table:
            raise missing_keys(["kind"], f"{expectation}, and it is missing")
        raise ValueError(f"{expectation}, but {short_repr(kind)} was given")


_Section = TypeVar("_Section", bound=KindSection)


class BeliefSection(KindSection):
    """The model that predicts the observations of the twin."""

    entry_point_group = "uav_twin.beliefs"

    @abstractmethod
    def source(self, scenario: Any, flown_source: Any) -> Any:
        """Return the source of the twin's predictions.

        Parameters
        ----------
        scenario : Scenario
            The scenario. Its class is defined in a module that imports this one.
        flown_source : AssetSource
            The source of the asset that flies.

        Returns
        -------
        AssetSource
            The source; `flown_source` itself if the twin believes the asset.
        """


class AssetSection(KindSection):
    """The asset that flies."""

    entry_point_group = "uav_twin.assets"
    is_fmu: ClassVar[bool] = False
    """Whether one or several FMUs fly; an FMU may carry damage and sensors of its own."""

    @property
    def true_parameters(self) -> Mapping[str, float]:
        """The parameters of the true asset that the scenario states, SI."""
        return dict(getattr(self, "parameters", {}))

    @property
    def constant_load(self) -> Mapping[str, float]:
        """The load inputs, which are the same in every step, SI."""
        return dict(getattr(self, "load", {}))

    @abstractmethod
    def source(self, scenario: Any) -> Any:
        """Return the source of the asset that flies.

        Parameters
        ----------
        scenario : Scenario
            The scenario. Its class is defined in a module that imports this one.

        Returns
        -------
        AssetSource
            The source, which prepares and opens the asset.
        """


@cache
def import_installed_kinds(base: type[KindSection]) -> None:
    """Import the section classes that installed packages add, and check them.

    An imported class is a subclass of `base` from then on, so that `KindSection.kinds` finds it.
    The result is cached: the entry points are read once in a process for each base class.

    Parameters
    ----------
    base : type
        `AssetSection` or `BeliefSection`.

    Raises
    ------
    PlugInError
        If two entry points have the same name, if one cannot be imported, if it is not a subclass
        of `base`, if its kind is one that uav-twin itself defines, or if the name of the entry
        point is not its kind.
    """
    shipped_kinds = []
    for subclass in _all_subclasses(base):
        if subclass.is_shipped_kind():
            shipped_kinds.append(subclass.kind_of_class())
    for plug_in in load_plug_ins(base.entry_point_group):  # refuses equal names, and imports
        section_class = plug_in.value
        if not (isinstance(section_class, type) and issubclass(section_class, base)):
            raise PlugInError(
                f"{plug_in.subject} must be a subclass of {base.__name__}, but is "
                f"{section_class!r}."
            )
        kind = section_class.kind_of_class()
        if kind in shipped_kinds:
            raise PlugInError(
                f"{plug_in.subject} has the kind {kind!r}, which uav-twin itself defines: choose "
                "another `kind`."
            )
        if kind != plug_in.name:
            raise PlugInError(
                f"{plug_in.subject} is registered as {plug_in.name!r}, but its kind is {kind!r}: "
                "make the two equal."
            )


def _all_subclasses(cls: type[_Section]) -> Iterator[type[_Section]]:
    """Yield the subclasses of a class, and theirs."""
    for subclass in cls.__subclasses__():
        yield subclass
        yield from _all_subclasses(subclass)
