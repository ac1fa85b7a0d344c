"""A structure from a mesh or matrices: packed as the FMU that flies, or believed as a model."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

from fmu_asset.client.binding import Binding
from reporting.files import atomic_write_text, hash_file
from reporting.progress import Progress
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    Asset,
    AssetBelief,
    AssetSource,
)
from twin_master.assets.fmu_source import FMU_COPY, FmuSection, FmuSource
from twin_master.assets.recorded_structure import RecordedStructure
from twin_master.assets.reduced_model import ReducedModelSource, StructureOfFile
from twin_master.errors import MissionInputError
from twin_master.scenario.kinds import BeliefSection, FileSection
from twin_master.scenario.schema import Scenario

FLOWN_COPY = "asset/flown/structure.toml"
"""The file of the structure that flies, inside a run folder."""
MODEL_COPY = "asset/model/structure.toml"
"""The file of the structure that the twin believes, inside a run folder."""


def structure_file_in(run_folder: Path) -> Path | None:
    """Return the structure file in a run folder, that of the twin's model before that of the asset.

    It is None if neither is a structure.
    """
    files = (run_folder / name for name in (MODEL_COPY, FLOWN_COPY))
    return next((file for file in files if file.is_file()), None)


class StructureFiles(FileSection):
    """A table that names a structure file, and through it a mesh or matrices."""

    def all_files(self) -> dict[str, Path]:
        """Return the structure file and the mesh or matrices that it names, by paths of copies.

        Raises
        ------
        InvalidDesignError
            If the structure file cannot be read or is wrong.
        MissionInputError
            If a file that it names is not in its folder or in one below that.
        """
        from fe.structure.design import load_structure

        files = super().all_files()
        copy = self.copies()["structure"]
        structure_file = files[copy]
        design = load_structure(structure_file)
        for name in design.files:
            relative_path = PurePosixPath(name)
            if relative_path.is_absolute() or ".." in relative_path.parts:
                raise MissionInputError(
                    f"the {design.what} {relative_path} of {structure_file} does not lie beside "
                    f"it, and a run keeps copies of both: move the {design.what} into the folder "
                    "of the structure file, and name it without its folder."
                )
            copy_of_file = PurePosixPath(copy).parent / relative_path
            files[str(copy_of_file)] = structure_file.parent / relative_path
        return files


class StructureSection(StructureFiles, FmuSection):
    """The FMU that is packed from a structure."""

    kind: Literal["structure"] = "structure"
    structure: str
    """A structure file, or the name of a shipped one."""
    binding: str = ""
    """A binding of the user; by default it follows from the structure file."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C that is compiled on this machine."""

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "structure": FLOWN_COPY}

    def source(self, scenario: Scenario) -> "StructureFmuSource":
        """Return the source of the FMU."""
        return StructureFmuSource(scenario, self)


class StructureBelief(StructureFiles, BeliefSection):
    """The reduced model of a structure."""

    kind: Literal["structure"] = "structure"
    structure: str
    """A structure file, or the name of a shipped one."""

    copy_paths: ClassVar[Mapping[str, str]] = {"structure": MODEL_COPY}

    def source(self, scenario: Scenario, flown_source: AssetSource) -> "ReducedModelSource":
        """Return the source of the model."""
        return ReducedModelSource(scenario, section=self)


class StructureFmuSource(StructureOfFile, FmuSource):
    """The FMU that is packed from a structure."""

    # Both base classes define it: an FMU flies with the parameters of the true asset.
    parameters = FmuSource.parameters

    def binding(self) -> Binding:
        """Return the binding of the user, or one made from the structure's inputs and outputs."""
        if self._folder is not None or self.section.binding:
            return super().binding()
        from fmu_asset.structures import structure_binding

        return structure_binding(self.design, self._frequency_count())

    def _check_calibration(self, binding: Binding) -> None:
        """Refuse a kind of FMU that cannot be built here, and a calibration that does not fit."""
        from fmu_asset.packing.structure_fmu import check_form

        check_form(self.section.packed)
        self._check_parameter(believed=isinstance(self._scenario.belief, AssetBelief))

    def _observation_slice(self, binding: Binding, role: str = "") -> slice:
        """Return the positions of a role in the binding; none if features of modes are observed.

        These are identified from the accelerations of the FMU, and are not outputs of it.
        """
        if self._scenario.observation.modes is None:
            return super()._observation_slice(binding, role)
        self._check_observed()
        return slice(0)

    def _fit_to_fmu(self, binding: Binding, scratch: Path) -> Binding:
        """Check the structure without packing it, and return the binding unchanged."""
        has_user_binding = "binding" in self.section.user_files()
        if not has_user_binding:  # the parameters of the scenario are then those of the structure
            self._check_ranges(self.section.parameters)
        self.check_model()
        return binding

    def _build(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure and pack the FMU; return the hashes of both."""
        self.model = self.load_reduced_model(progress)
        if not self.path(BINDING_COPY).exists():
            from fmu_asset.structures import structure_binding_text

            text = structure_binding_text(self.design, self._frequency_count())
            atomic_write_text(self.path(BINDING_COPY), text)
        with progress.stage("Packing the FMU"):
            self._pack(progress)
        fmu_hash = hash_file(self.path(FMU_COPY))
        return {FLOWN_DESIGN_HASH: self.model.design_hash, "fmu": fmu_hash}

    def _pack(self, progress: Progress) -> None:
        """Pack the reduced model as the FMU in the run folder."""
        from fmu_asset.packing.structure_fmu import build_fmu

        assert self.model is not None
        build_fmu(self.model, self.path(FMU_COPY), kind=self.section.packed, replace=True)

    def open(self) -> Asset:
        """Return the FMU in its initial state.

        If modes are observed, each step of the asset records a motion and identifies its modes.
        """
        if self._scenario.observation.modes is None:
            return super().open()
        assert self.model is not None
        return RecordedStructure(
            self._scenario, self.model, self._open_session, self.binding(), self.parameters()
        )
