"""Several FMUs as the asset of a mission: joined in the scenario, or read from an SSP file."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import Field

from fe.wing.design import load_design
from fmu_asset.client.binding import Binding
from fmu_asset.client.bound_variables import expand
from fmu_asset.companions import COMPANION_NAMES
from fmu_asset.coupling.structure import (
    Component,
    ComponentSetting,
    Connector,
    SystemStructure,
    expand_connection,
)
from reporting.files import atomic_write_bytes, hash_file
from reporting.progress import Progress
from reporting.toml_file import Fault, Number, Positive
from twin_master.assets.asset_source import BINDING_COPY, SSP_COPY
from twin_master.assets.fmu_source import FmuSection, FmuSource, Session
from twin_master.errors import MissionInputError
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME, FileSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Count, Flag, Section, repeated_name_fault

if TYPE_CHECKING:
    from fmu_asset.coupling.wiring import Wiring

COMPONENT_FOLDER = "asset/components"


class ComponentSection(FileSection):
    """One FMU of a coupled asset: a file, a companion by its name, or packed from a wing design."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$")]
    fmu: str | None = None
    design: str | None = None
    substeps: Count = 1
    """Steps that it makes in one step of the system."""
    parameters: dict[str, Flag | Number | str] = Field(default_factory=dict)
    """By the FMU's names and in its units; `gain[{1..4}]` stands for four of them."""

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of FMU and design stand in a run folder."""
        stem = f"{COMPONENT_FOLDER}/{self.name}"
        return {"fmu": f"{stem}.fmu", "design": f"{stem}.toml"}

    @property
    def design_path(self) -> Path:
        """The design that the component is packed of."""
        return self.all_files()[self.copies()["design"]]

    def _is_shipped(self, key: str, name: str) -> bool:
        return name in COMPANION_NAMES if key == "fmu" else super()._is_shipped(key, name)

    def faults(self) -> Iterator[Fault]:
        """Yield other than one source."""
        both = (self.fmu is None) == (self.design is None)
        yield both, f"the component `{self.name}` needs one of `fmu` and `design`"


class ConnectionSection(Section):
    """What flows from one FMU of a coupled asset to another, or to and from the asset itself."""

    source: Annotated[str, Field(min_length=1)]
    target: Annotated[str, Field(min_length=1)]
    factor: Number = 1.0
    offset: Number = 0.0
    delayed: Flag = False


class SeveralSection(FmuSection):
    """What is said of several FMUs, wherever they come from."""

    algorithm: Literal["gauss_seidel", "jacobi"] = "gauss_seidel"
    iterations: Count = 1
    tolerance: Positive = 1e-9


class SspSection(SeveralSection):
    """Several FMUs, joined by an SSP file."""

    kind: Literal["ssp"] = "ssp"
    file: str

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "file": SSP_COPY}

    def source(self, scenario: Scenario) -> "SspSource":
        """Return the system of the file."""
        return SspSource(scenario, self)


class CoupledSection(SeveralSection):
    """Several FMUs, joined here."""

    kind: Literal["coupled"] = "coupled"
    component: Annotated[tuple[ComponentSection, ...], Field(min_length=1)]
    connection: tuple[ConnectionSection, ...] = ()

    def all_files(self) -> dict[str, Path]:
        """Return the files of the components too, but for shipped ones, which are packed anew."""
        found = super().all_files()
        for component in self.component:
            found |= {component.copies()[key]: Path(path) for key, path in component.user_files().items()}
        return found

    def with_paths_from(self, folder: Path) -> Self:
        """Return the table with its relative paths from a folder."""
        components = tuple(component.with_paths_from(folder) for component in self.component)
        return super().with_paths_from(folder).model_copy(update={"component": components})

    def portable(self) -> FileSection:
        """Return the table with the paths of the copies inside a run folder."""
        components = tuple(component.portable() for component in self.component)
        return super().portable().model_copy(update={"component": components})

    def source(self, scenario: Scenario) -> "CoupledSource":
        """Return the FMUs together."""
        return CoupledSource(scenario, self)

    def faults(self) -> Iterator[Fault]:
        """Yield what an FMU has, and names that come twice."""
        yield from super().faults()
        yield repeated_name_fault("component", [component.name for component in self.component])


class SeveralSource(FmuSource):
    """Several FMUs as one asset.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : SeveralSection
        Its table `asset`; variables of the binding are connectors of the system, or `component.variable`.
    """

    def wiring(self) -> "Wiring":
        """Return the system as it is flown, once prepared."""
        raise NotImplementedError

    def _packed(self, progress: Progress) -> dict[str, Path]:
        """Pack what is not an FMU yet; return what is flown, by the names of the hashes."""
        return {}

    def _make(self, progress: Progress) -> dict[str, str]:
        hashes = {name: hash_file(file) for name, file in self._packed(progress).items()}
        # What does not fit is said before anything is flown.
        self._session(self.binding(), self.parameters()).close()
        return hashes

    def _session(
        self, binding: Binding, parameters: Mapping[str, float], wiring: "Wiring | None" = None
    ) -> "Session":
        """Join the system as it is flown, or another one."""
        from fmu_asset.coupling.asset import CoupledAsset

        keys = ("algorithm", "iterations", "tolerance", "isolated", "step_timeout")
        said = {key: getattr(self.section, key) for key in keys}
        return CoupledAsset(wiring or self.wiring(), binding, parameters=parameters, **said)


class SspSource(SeveralSource):
    """The system of an SSP file."""

    label = "system of an SSP file"

    def wiring(self, folder: Path | None = None) -> "Wiring":
        """Return the system as it is flown, once prepared, or with its FMUs in a folder."""
        from fmu_asset.ssp.check import join_ssp
        from fmu_asset.ssp.reader import read_ssp

        return join_ssp(read_ssp(self.path(SSP_COPY), folder or self.path(COMPONENT_FOLDER)))

    def _fitted(self, binding: Binding, folder: Path) -> Binding:
        from fmu_asset.ssp.check import left_out_sentence

        wiring = self.wiring(folder)
        if sentence := left_out_sentence(wiring, self.path(SSP_COPY)):
            raise MissionInputError(sentence)
        self._session(binding, self.parameters(), wiring)
        return binding


class CoupledSource(SeveralSource):
    """The FMUs that the scenario joins."""

    section: CoupledSection

    @property
    def words(self) -> str:
        """How many there are."""
        return f"{len(self.section.component)} coupled FMUs"

    def _fitted(self, binding: Binding, folder: Path) -> Binding:
        from fmu_asset.coupling.wiring import Wiring

        components = self.section.component
        for component in components:
            if component.design not in (None, CALIBRATED_DESIGN_NAME):
                load_design(component.design_path)
        if all(component.design is None for component in components):
            files = {component.name: _given_fmu(component, folder) for component in components}
            self._session(binding, self.parameters(), Wiring(self._structure(files)))
        else:
            self._structure({component.name: folder for component in components})
        return binding

    def _packed(self, progress: Progress) -> dict[str, Path]:
        with progress.stage("Packing the FMUs"):
            return {f"fmu_{part.name}": self._fmu(part, progress) for part in self.section.component}

    def _fmu(self, component: ComponentSection, progress: Progress) -> Path:
        """Return the FMU of a component in the run folder; packed if it is not there."""
        from fmu_asset.packing.structure_fmu import pack_wing

        target = self.path(component.copies()["fmu"])
        if target.exists():
            return target
        if component.design is None:
            return _given_fmu(component, target.parent)
        options = {}
        if component.design == CALIBRATED_DESIGN_NAME:
            from calibration.result.file import load_calibration, tailoring

            wing = load_calibration(Path(self._scenario.calibration.file or ""))
            design, options = wing.wing_design, tailoring(wing)
        else:
            design = load_design(component.design_path)
        pack_wing(design, target, replace=True, progress=progress, **options)
        return target

    def wiring(self) -> "Wiring":
        """Return the system as it is flown, once prepared."""
        from fmu_asset.coupling.wiring import Wiring

        files = {component.name: component.copies()["fmu"] for component in self.section.component}
        return Wiring(self._structure({name: self.path(copy) for name, copy in files.items()}))

    def _structure(self, fmus: Mapping[str, Path]) -> SystemStructure:
        """Return the system of the scenario's components and connections."""
        asset = self.section
        names = [component.name for component in asset.component]
        connections = tuple(
            connection
            for entry in asset.connection
            for connection in expand_connection(**entry.model_dump(), components=names)
        )
        # A connector of the system is an output where something comes to it, and an input where it gives.
        connectors = dict.fromkeys(
            [Connector(c.target.variable, "output") for c in connections if not c.target.component]
            + [Connector(c.source.variable, "input") for c in connections if not c.source.component]
        )
        components = tuple(Component(c.name, fmus[c.name], _settings(c), c.substeps) for c in asset.component)
        return SystemStructure(self._scenario.mission.name, components, tuple(connectors), connections)


def _given_fmu(component: ComponentSection, folder: Path) -> Path:
    """Return the FMU of a component that is a file or a companion, packed in the folder."""
    from fmu_asset.companions.build import companion_bytes

    assert component.fmu is not None
    if component.fmu not in COMPANION_NAMES:
        return Path(component.fmu)
    return atomic_write_bytes(folder / f"{component.name}.fmu", companion_bytes(component.fmu))


def _settings(component: ComponentSection) -> dict[str, ComponentSetting]:
    settings: dict[str, ComponentSetting] = {}
    where = f"the component `{component.name}`"
    for pattern, value in component.parameters.items():
        before = f"the parameters of {where} cannot be read: "
        with MissionInputError.instead_of(ValueError, before=before, after="."):
            names = expand(pattern)
        for name in names:
            if name in settings:
                raise MissionInputError(f"{where} is given `{name}` twice: keep one of the two.")
            settings[name] = ComponentSetting(value)
    return settings
