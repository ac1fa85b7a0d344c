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
    Connection,
    Connector,
    SystemStructure,
    expand_connection,
)
from reporting.files import atomic_write_bytes, hash_file
from reporting.formats.toml_file import Check, Number, Positive
from reporting.progress import Progress
from twin_master.assets.asset_source import BINDING_COPY, SSP_COPY
from twin_master.assets.fmu_source import FmuSection, FmuSource, Session
from twin_master.errors import MissionInputError
from twin_master.scenario.kinds import CALIBRATED_DESIGN_NAME, FileSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Count, Flag, Section, repeated_name_check

if TYPE_CHECKING:
    from fmu_asset.coupling.wiring import Wiring

COMPONENT_FOLDER = "asset/components"
"""Folder of the FMUs of the components inside a run folder."""


class ComponentSection(FileSection):
    """One FMU of a coupled asset: a file, a companion by its name, or packed from a wing design."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$")]
    """Name of the component in connections."""
    fmu: str | None = None
    """An FMU, or the name of a companion that is shipped: `damage_growth` or `strain_gauges`."""
    design: str | None = None
    """A wing design from which the component is packed, or the name of a shipped one."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates an FMU that is packed from a design: Python, or C that is compiled on this
    machine."""
    substeps: Count = 1
    """Steps that it makes in one step of the system."""
    parameters: dict[str, Flag | Number | str] = Field(default_factory=dict)
    """Values of parameters by the FMU's names and in its units; `gain[{1..4}]` stands for four of
    them [unit of the FMU]."""

    def copies(self) -> Mapping[str, str]:
        """Return the paths of the copies of FMU and design inside a run folder."""
        stem = f"{COMPONENT_FOLDER}/{self.name}"
        return {"fmu": f"{stem}.fmu", "design": f"{stem}.toml"}

    @property
    def design_path(self) -> Path:
        """The file of the design from which the component is packed."""
        return self.all_files()[self.copies()["design"]]

    def _is_shipped(self, key: str, name: str) -> bool:
        """Return whether a key holds the name of a companion, or of a shipped design."""
        if key == "fmu":
            return name in COMPANION_NAMES
        return super()._is_shipped(key, name)

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on the FMU, of which exactly one is needed."""
        has_fmu = self.fmu is not None
        has_design = self.design is not None
        yield (
            has_fmu == has_design,
            f"the component `{self.name}` needs one of `fmu` and `design`",
        )


class ConnectionSection(Section):
    """A connection between two FMUs of a coupled asset, or between one and the asset itself."""

    source: Annotated[str, Field(min_length=1)]
    """Output of a component, `component.variable`, or an input of the asset."""
    target: Annotated[str, Field(min_length=1)]
    """Input of a component, `component.variable`, or an output of the asset."""
    factor: Number = 1.0
    """Factor on the value of the source [1]."""
    offset: Number = 0.0
    """Number that is added to the product [unit of the target]."""
    delayed: Flag = False
    """Whether the target gets the value of the step before."""


class SeveralSection(FmuSection):
    """The keys of an asset of several FMUs."""

    algorithm: Literal["gauss_seidel", "jacobi"] = "gauss_seidel"
    """Whether the components step one after another with the newest values, or all with those of
    the step before."""
    iterations: Count = 1
    """Largest number of iterations of a step; 1 makes each step once."""
    tolerance: Positive = 1e-9
    """Relative change of connected values at which iterations end [1]."""


class SspSection(SeveralSection):
    """Several FMUs that an SSP file joins."""

    kind: Literal["ssp"] = "ssp"
    file: str
    """The SSP file."""

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "file": SSP_COPY}

    def source(self, scenario: Scenario) -> "SspSource":
        """Return the source of the system in the file."""
        return SspSource(scenario, self)


class CoupledSection(SeveralSection):
    """Several FMUs that the scenario joins."""

    kind: Literal["coupled"] = "coupled"
    component: Annotated[tuple[ComponentSection, ...], Field(min_length=1)]
    """The FMUs."""
    connection: tuple[ConnectionSection, ...] = ()
    """Their connections."""

    def all_files(self) -> dict[str, Path]:
        """Return the files to copy into a run folder, by the paths of their copies.

        Of a component only a user's own file is copied. A companion or a shipped design is not:
        its FMU is packed inside the run folder.
        """
        files = super().all_files()
        for component in self.component:
            for key, path in component.user_files().items():
                files[component.copies()[key]] = Path(path)
        return files

    def with_paths_from(self, folder: Path) -> Self:
        """Return the table with its relative paths joined to a folder."""
        components = tuple(component.with_paths_from(folder) for component in self.component)
        return super().with_paths_from(folder).model_copy(update={"component": components})

    def portable(self) -> FileSection:
        """Return the table with the paths of the copies inside a run folder."""
        components = tuple(component.portable() for component in self.component)
        return super().portable().model_copy(update={"component": components})

    def source(self, scenario: Scenario) -> "CoupledSource":
        """Return the source of the coupled FMUs."""
        return CoupledSource(scenario, self)

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on names of components."""
        yield from super().checks()
        names = [component.name for component in self.component]
        yield repeated_name_check("component", names)


class SeveralSource(FmuSource):
    """The source of an asset that consists of several FMUs.

    Parameters
    ----------
    section : SeveralSection
        The table `asset` of the scenario. A variable of the binding is a connector of the system,
        or an FMU's own variable, which is written `component.variable`.
    """

    section: SeveralSection

    def wiring(self) -> "Wiring":
        """Return the system of the FMUs, once they are prepared."""
        raise NotImplementedError

    def _pack_fmus(self, progress: Progress) -> dict[str, Path]:
        """Pack the FMUs that do not exist yet; return all FMU files by `fmu_<component>`.

        The FMUs of an SSP file exist already, and are covered by the hash of that file.
        """
        return {}

    def _build(self, progress: Progress) -> dict[str, str]:
        """Pack the FMUs, check that they fit together, and return their hashes."""
        fmus = self._pack_fmus(progress)
        hashes = {name: hash_file(fmu) for name, fmu in fmus.items()}
        # Opening the system raises an error if the FMUs, connections and binding do not fit.
        self._open_session(self.binding(), self.parameters()).close()
        return hashes

    def _open_session(
        self, binding: Binding, parameters: Mapping[str, float], wiring: "Wiring | None" = None
    ) -> "Session":
        """Return the coupled FMUs as one asset, ready to be started.

        The FMUs and their connections are those of the argument `wiring`; without it, those that
        the method `wiring` returns.
        """
        from fmu_asset.coupling.asset import CoupledAsset

        section = self.section
        return CoupledAsset(
            wiring or self.wiring(),
            binding,
            algorithm=section.algorithm,
            iterations=section.iterations,
            tolerance=section.tolerance,
            isolated=section.isolated,
            step_timeout=section.step_timeout,
            parameters=parameters,
        )


class SspSource(SeveralSource):
    """The system of an SSP file."""

    label = "system of an SSP file"

    def wiring(self, folder: Path | None = None) -> "Wiring":
        """Return the system of the file.

        Parameters
        ----------
        folder : Path, optional
            The folder into which the FMUs are extracted; by default that of the run.
        """
        from fmu_asset.ssp.check import join_ssp
        from fmu_asset.ssp.reader import read_ssp

        return join_ssp(read_ssp(self.path(SSP_COPY), folder or self.path(COMPONENT_FOLDER)))

    def _fit_to_fmu(self, binding: Binding, scratch: Path) -> Binding:
        """Check the binding against the system of the file, and return it unchanged."""
        from fmu_asset.ssp.check import left_out_sentence

        wiring = self.wiring(scratch)
        left_out_message = left_out_sentence(wiring, self.path(SSP_COPY))
        if left_out_message:
            raise MissionInputError(left_out_message)
        self._open_session(binding, self.parameters(), wiring)
        return binding


class CoupledSource(SeveralSource):
    """The FMUs that the scenario joins."""

    section: CoupledSection

    @property
    def description(self) -> str:
        """The number of FMUs, in words."""
        return f"{len(self.section.component)} coupled FMUs"

    def _fit_to_fmu(self, binding: Binding, scratch: Path) -> Binding:
        """Check the components and connections, and return the binding unchanged.

        If no component is packed from a design, the binding is also checked against the FMUs.
        """
        from fmu_asset.coupling.wiring import Wiring

        components = self.section.component
        for component in components:
            if component.design not in (None, CALIBRATED_DESIGN_NAME):
                load_design(component.design_path)
        needs_packing = any(component.design is not None for component in components)
        if needs_packing:
            # Packing takes too long for a check. Components and connections are checked without
            # the FMUs: the scratch folder stands for the file of each, which is not read.
            self._system_structure({component.name: scratch for component in components})
        else:
            fmus = {
                component.name: _fmu_of_file_or_companion(component, scratch)
                for component in components
            }
            self._open_session(binding, self.parameters(), Wiring(self._system_structure(fmus)))
        return binding

    def _pack_fmus(self, progress: Progress) -> dict[str, Path]:
        """Pack the FMUs that do not exist yet; return all FMU files, by `fmu_<component>`."""
        fmus = {}
        with progress.stage("Packing the FMUs"):
            for component in self.section.component:
                fmus[f"fmu_{component.name}"] = self._pack_fmu(component, progress)
        return fmus

    def _pack_fmu(self, component: ComponentSection, progress: Progress) -> Path:
        """Return the file of a component's FMU in the run folder; pack it if it is missing.

        `prepare` has copied an FMU file of the user there. A companion, or a wing from a design or
        from the calibration, is packed here.
        """
        from fmu_asset.packing.structure_fmu import pack_wing

        fmu = self.path(component.copies()["fmu"])
        if fmu.exists():
            return fmu
        if component.design is None:
            return _fmu_of_file_or_companion(component, fmu.parent)
        if component.design == CALIBRATED_DESIGN_NAME:
            from calibration.result.file import load_calibration, tailoring

            # A scenario with this design has a calibration file: `resolve_scenario` checks it.
            calibration = load_calibration(Path(self._scenario.calibration.file or ""))
            design = calibration.wing_design
            calibrated_values = tailoring(calibration)
        else:
            design = load_design(component.design_path)
            calibrated_values = {}
        pack_wing(
            design,
            fmu,
            replace=True,
            progress=progress,
            kind=component.packed,
            **calibrated_values,
        )
        return fmu

    def wiring(self) -> "Wiring":
        """Return the system of the FMUs, once they are prepared."""
        from fmu_asset.coupling.wiring import Wiring

        fmus = {}
        for component in self.section.component:
            fmus[component.name] = self.path(component.copies()["fmu"])
        return Wiring(self._system_structure(fmus))

    def _system_structure(self, fmus: Mapping[str, Path]) -> SystemStructure:
        """Return the components, connections and connectors of the system of the scenario."""
        names = [component.name for component in self.section.component]
        # A pattern such as `wing.strain[{1..24}]` stands for several connections.
        connections: list[Connection] = []
        for entry in self.section.connection:
            connections += expand_connection(**entry.model_dump(), components=names)
        components = []
        for section in self.section.component:
            settings = _component_settings(section)
            component = Component(section.name, fmus[section.name], settings, section.substeps)
            components.append(component)
        # The connectors of the system: a connection whose target names no component leads to an
        # output, and one whose source names none comes from an input.
        outputs = []
        inputs = []
        for connection in connections:
            if not connection.target.component:
                outputs.append(Connector(connection.target.variable, "output"))
            if not connection.source.component:
                inputs.append(Connector(connection.source.variable, "input"))
        return SystemStructure(
            self._scenario.mission.name,
            tuple(components),
            tuple(dict.fromkeys([*outputs, *inputs])),
            tuple(connections),
        )


def _fmu_of_file_or_companion(component: ComponentSection, folder: Path) -> Path:
    """Return the file of a component's FMU; a companion is first packed into the folder."""
    from fmu_asset.companions.build import companion_bytes

    assert component.fmu is not None
    if component.fmu not in COMPANION_NAMES:
        return Path(component.fmu)
    return atomic_write_bytes(folder / f"{component.name}.fmu", companion_bytes(component.fmu))


def _component_settings(component: ComponentSection) -> dict[str, ComponentSetting]:
    """Return the parameters of a component by name.

    A pattern such as `gain[{1..4}]` gives its value to all parameters that it matches.
    """
    settings: dict[str, ComponentSetting] = {}
    component_label = f"the component `{component.name}`"
    for pattern, value in component.parameters.items():
        message_start = f"the parameters of {component_label} cannot be read: "
        with MissionInputError.instead_of(ValueError, before=message_start, after="."):
            names = expand(pattern)
        for name in names:
            if name in settings:
                raise MissionInputError(
                    f"{component_label} is given `{name}` twice: keep one of the two."
                )
            settings[name] = ComponentSetting(value)
    return settings
