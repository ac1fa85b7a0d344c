"""A structure from a mesh: its file, reduced and packed as the asset, or believed as a model."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, ClassVar, Literal

from reporting.files import atomic_write_text
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import BINDING_COPY, FLOWN_DESIGN_HASH, AssetBelief, AssetSource
from twin_master.assets.fmu_source import FmuSection, FmuSource
from twin_master.assets.interface import Asset
from twin_master.assets.parameter import calibrated_means
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.assets.structure_checks import (
    check_history,
    check_observed,
    check_parameter,
    check_ranges,
    frequencies_observed,
)
from twin_master.assets.structure_modes import RecordedStructure
from twin_master.errors import MissingObservationModelError, MissionInputError, check_names
from twin_master.scenario.asset import BeliefSection, FileSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.structure.tables import StructureDesign
    from fmu_asset.door.binding import Binding

FLOWN_COPY = "asset/flown/structure.toml"
MODEL_COPY = "asset/model/structure.toml"
FIELD_NAME = "structure.vtu"


class StructureFiles(FileSection):
    """A table that names a structure file, and with it the mesh or the matrices beside that."""

    def all_files(self) -> dict[str, Path]:
        """Return all files by the places of their copies, those that the structure names among them.

        Raises
        ------
        InvalidDesignError
            The structure file cannot be read or is wrong.
        MissionInputError
            One of its files does not lie beside it.
        """
        from fe.structure.design import load_structure

        found = super().all_files()
        copy = self.copies()["structure"]
        file = found[copy]
        design = load_structure(file)
        for inner in map(PurePosixPath, design.files):
            if inner.is_absolute() or ".." in inner.parts:
                raise MissionInputError(
                    f"the {design.what} {inner} of {file} does not lie beside it, and a run keeps copies of "
                    f"both: move the {design.what} into the folder of the structure file, and name it without"
                    " its folder."
                )
            found[f"{PurePosixPath(copy).parent}/{inner}"] = file.parent / inner
        return found


class StructureSection(StructureFiles, FmuSection):
    """The FMU that is packed of a structure."""

    kind: Literal["structure"] = "structure"
    structure: str
    binding: str = ""
    """A binding of one's own; without one it follows from the structure file."""
    packed: Literal["python", "compiled"] = "python"
    """What evaluates the FMU: Python, or C compiled here."""

    kept: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "structure": FLOWN_COPY}

    @property
    def binding_path(self) -> Path:
        """The binding, where there is one.

        Raises
        ------
        MissionInputError
            There is none.
        """
        if not self.binding:
            raise MissionInputError(
                "the binding of the structure is needed as a file here: write it by `uav-twin structure fmu "
                "FILE --binding NAME`, and name it as `asset.binding`."
            )
        return super().binding_path

    def source(self, scenario: Scenario) -> "StructureFmuSource":
        """Return the FMU of the structure."""
        return StructureFmuSource(scenario, self)


class StructureBelief(StructureFiles, BeliefSection):
    """The reduced model of a structure."""

    kind: Literal["structure"] = "structure"
    structure: str

    kept: ClassVar[Mapping[str, str]] = {"structure": MODEL_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "StructureSource":
        """Return the model of the structure."""
        return StructureSource(scenario, self)


class StructureFmuSource(FmuSource):
    """The FMU that is packed of a structure."""

    _section: StructureSection

    @property
    def words(self) -> str:
        """The FMU with its name."""
        return f"FMU of the structure {self._design().name}"

    def _design(self) -> "StructureDesign":
        from fe.structure.design import load_structure

        return load_structure(self.path(FLOWN_COPY))

    def binding(self) -> "Binding":
        """Return the binding: one of its own, or that which follows from the structure."""
        from fmu_asset.structures.binding import structure_binding

        if self._folder is not None or self._section.binding:
            return super().binding()
        return structure_binding(self._design(), frequencies_observed(self._scenario))

    def _check_calibration(self, binding: "Binding", effects: tuple[str, ...]) -> None:
        from fmu_asset.packing.structure_fmu import check_form

        check_form(self._section.packed)
        believes_it = isinstance(self._scenario.belief, AssetBelief)
        check_parameter(self._scenario, self._design(), self.path(FLOWN_COPY) if believes_it else None)

    def _check_sensors(self, binding: "Binding") -> None:
        if self._scenario.observation.modes is None:
            super()._check_sensors(binding)
        else:
            check_observed(self._scenario, self._design())

    def _fitted(self, binding: "Binding", folder: Path) -> "Binding":
        from fe.reduction.model_cache import check_structure

        if not self._section.binding:  # under a binding of one's own the names may be others
            design = self._design()
            check_ranges(self._scenario, design, self._section.parameters)
            check_history(self._scenario, design)
        check_structure(self.path(FLOWN_COPY))
        return binding

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure and pack the FMU."""
        from fe.reduction.model_cache import reduced_structure
        from fmu_asset.packing.structure_fmu import build_fmu
        from fmu_asset.structures.binding import structure_binding_text

        self.model = reduced_structure(self.path(FLOWN_COPY), progress=progress)
        if not self.path(BINDING_COPY).exists():
            text = structure_binding_text(self._design(), frequencies_observed(self._scenario))
            atomic_write_text(self.path(BINDING_COPY), text)
        with progress.stage("Packing the FMU"):
            build_fmu(self.model, self.fmu_path(), kind=self._section.packed, replace=True)
        return {FLOWN_DESIGN_HASH: self.model.design_hash, "fmu": hash_file(self.fmu_path())}

    def open(self) -> Asset:
        """Return the FMU at its start; where modes are observed, in motion with an identification behind."""
        if self._scenario.observation.modes is None:
            return super().open()
        assert self.model is not None
        return RecordedStructure(self._scenario, self.model, self._opened, self.binding(), self.parameters())

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the structure as VTU."""
        return _write_field(path, self.path(FLOWN_COPY), {**self.parameters(), **state, **control})


class StructureSource(ReducedModelSource):
    """The reduced model of a structure as what is believed.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : StructureBelief
        What is believed.
    """

    def __init__(self, scenario: Scenario, section: StructureBelief) -> None:
        super().__init__(scenario, section=section)

    @property
    def words(self) -> str:
        """The reduced model with its name."""
        return f"reduced model of the structure {self._design().name}"

    def _design(self) -> "StructureDesign":
        from fe.structure.design import load_structure

        return load_structure(self.path(MODEL_COPY))

    def check(self) -> None:
        """Read the structure file without building anything.

        Raises
        ------
        MissionInputError, FiniteElementError
            A file cannot be read or is wrong, or the mesh does not hold what the structure names.
        MissingObservationModelError
            The scenario's states, controls or sensors are not those of the structure.
        """
        from fe.reduction.model_cache import check_structure

        self.files()
        design, scenario = self._design(), self._scenario
        check_parameter(scenario, design, self.path(MODEL_COPY))
        rows = (
            ("state", scenario.state_names, [part.name for part in design.damage]),
            ("control input", scenario.control[0].values, [part.name for part in design.control]),
        )
        where = f"the model of the structure {design.name}"
        check_names("the scenario has the", where, rows, MissingObservationModelError)
        check_observed(scenario, design)
        check_ranges(scenario, design, {})
        check_structure(self.path(MODEL_COPY))

    def _make(self, progress: Progress) -> dict[str, str]:
        from fe.reduction.model_cache import reduced_structure

        self.model = reduced_structure(self.path(MODEL_COPY), progress=progress)
        return super()._make(progress)

    @property
    def _true_values(self) -> dict[str, float]:
        means = calibrated_means(self._scenario.calibration)
        return {
            name: value for name, value in means.items() if name in self.wing.chosen
        } | super()._true_values

    @property
    def _outputs(self) -> slice:
        gauges = self.wing.gauge_count
        return slice(0, gauges) if self._scenario.observation.role == "strain" else slice(gauges, None)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the structure as VTU."""
        means = calibrated_means(self._scenario.calibration) | self._means
        return _write_field(path, self.path(MODEL_COPY), {**means, **state, **control})


def _write_field(path: Path, file: Path, values: Mapping[str, float]) -> bool:
    """Solve the full structure under values by name and write its field beside `path`, if it has a mesh.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    from fe.structure.design import MatrixDesign, load_structure
    from fe.structure.operators import load_and_assemble, write_structure_vtu

    if isinstance(load_structure(file), MatrixDesign):
        return False
    write_structure_vtu(path.with_name(FIELD_NAME), load_and_assemble(file), values)
    return True
