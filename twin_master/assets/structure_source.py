"""A structure from a mesh: its file, reduced and packed as the asset, or believed as a model."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from reporting.files import atomic_write_text
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import (
    FLOWN_DESIGN_HASH,
    AssetBelief,
    AssetSource,
    FlownAndBelieved,
    keep_files,
    named_files,
    read_files,
)
from twin_master.assets.fmu_source import BINDING_COPY, FmuSection, FmuSource
from twin_master.assets.interface import Asset, AssetReading, StatelessAsset
from twin_master.assets.parameter import (
    ParameterDraws,
    calibrated_means,
    draw_parameter,
)
from twin_master.assets.structure_checks import (
    check_history,
    check_observed,
    check_parameter,
    check_ranges,
    frequencies_observed,
)
from twin_master.assets.structure_modes import RecordedStructure, modal_values
from twin_master.errors import MissingObservationModelError, MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import BeliefSection, FileSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from fe.structure.tables import StructureDesign
    from fmu_asset.door.binding import Binding
    from fmu_asset.door.session import FmiAsset

Float = NDArray[np.float64]

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

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of binding and structure stand in a run folder."""
        return {"binding": BINDING_COPY, "structure": FLOWN_COPY}

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

    def copies(self) -> Mapping[str, str]:
        """Return where the copy of the structure stands in a run folder."""
        return {"structure": MODEL_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> "StructureSource":
        """Return the model of the structure."""
        return StructureSource(scenario, self)


class StructureFmuSource(FmuSource):
    """The FMU that is packed of a structure."""

    _section: StructureSection
    _model: "ReducedModel | None" = None

    @property
    def origin(self) -> FlownAndBelieved:
        """The FMU, twice."""
        words = f"FMU of the structure {self._design().name}"
        return FlownAndBelieved(words, words)

    def _design(self) -> "StructureDesign":
        from fe.structure.design import load_structure

        return load_structure(self._section.all_files()[FLOWN_COPY])

    def check(self) -> None:
        """Read what is given where it is, without building anything.

        Raises
        ------
        MissionInputError, FiniteElementError, FmuError
            A file cannot be read or is wrong, the mesh does not hold what the structure names, or the
            scenario speaks of what the structure does not have.
        """
        from fe.reduction.model_cache import check_structure
        from fmu_asset.compiled.compiler import find_compiler
        from fmu_asset.door.binding import load_binding
        from fmu_asset.structures.binding import structure_binding

        self.files()
        design = self._design()
        if self._section.packed == "compiled":
            find_compiler()  # before the structure is reduced, which can take minutes
        believes_it = isinstance(self._scenario.belief, AssetBelief)
        file = self._section.all_files()[FLOWN_COPY]
        check_parameter(self._scenario, design, file if believes_it else None)
        own = self._section.binding
        binding = (
            load_binding(self._section.binding_path)
            if own
            else structure_binding(design, frequencies_observed(self._scenario))
        )
        self._check_names(binding)
        if self._scenario.observation.modes is None:
            self._observed(binding)
        else:
            check_observed(self._scenario, design)
        self._inner_roles(binding)
        if not own:  # under a binding of one's own the names may be others
            check_ranges(self._scenario, design, self._section.parameters)
            check_history(self._scenario, design)
        check_structure(file)

    def _make(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure and pack the FMU."""
        from fe.reduction.model_cache import reduced_structure
        from fe.structure.design import load_structure
        from fmu_asset.packing.structure_fmu import build_fmu
        from fmu_asset.structures.binding import structure_binding_text

        model = reduced_structure(self._path(FLOWN_COPY), progress=progress)
        if not self._path(BINDING_COPY).exists():
            design = load_structure(self._path(FLOWN_COPY))
            text = structure_binding_text(design, frequencies_observed(self._scenario))
            atomic_write_text(self._path(BINDING_COPY), text)
        with progress.stage("Packing the FMU"):
            build_fmu(model, self.fmu_path(), kind=self._section.packed, replace=True)
        self._model = model
        return {FLOWN_DESIGN_HASH: model.design_hash, "fmu": hash_file(self.fmu_path())}

    def open(self) -> Asset:
        """Return the FMU at its start; where modes are observed, in motion with an identification behind."""
        section = self._scenario.observation.modes
        if section is None:
            return super().open()
        assert self._model is not None
        return RecordedStructure(
            self._scenario, self._model, self._recorder, self.binding(), self.parameters()
        )

    def _recorder(self, binding: "Binding", parameters: Mapping[str, float]) -> "FmiAsset":
        from fmu_asset.door.session import FmiAsset

        section = self._section
        return FmiAsset(
            self.fmu_path(),
            binding,
            isolated=section.isolated,
            step_timeout=section.step_timeout,
            parameters=parameters,
        )

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter."""
        return draw_parameter(self._scenario.calibration, seed)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the structure as VTU."""
        return _write_field(path, self._path(FLOWN_COPY), {**self.parameters(), **state, **control})


class StructureSource:
    """The reduced model of a structure as what is believed.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : StructureBelief
        What is believed.
    """

    def __init__(self, scenario: Scenario, section: StructureBelief) -> None:
        self._scenario = scenario
        self._places = named_files(scenario, section)
        self._model: ReducedModel | None = None
        self._mean: dict[str, float] = {}

    @property
    def origin(self) -> FlownAndBelieved:
        """The reduced model, twice."""
        words = f"reduced model of the structure {self._design().name}"
        return FlownAndBelieved(words, words)

    def _design(self) -> "StructureDesign":
        from fe.structure.design import load_structure

        return load_structure(self._places[MODEL_COPY])

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
        check_parameter(scenario, design, self._places[MODEL_COPY])
        for what, came, known in (
            ("state", scenario.state_names, [part.name for part in design.damage]),
            ("control input", scenario.control[0].values, [part.name for part in design.control]),
        ):
            unknown = sorted({*came} - {*known})
            if unknown:
                raise MissingObservationModelError(
                    f"the scenario has the {what} {', '.join(unknown)}, which the model of the structure "
                    f"{design.name} does not know; it knows {', '.join(known) or 'none'}."
                )
        check_observed(scenario, design)
        check_ranges(scenario, design, {})
        check_structure(self._places[MODEL_COPY])

    def files(self) -> dict[str, bytes]:
        """Return structure file and mesh as they are given.

        Raises
        ------
        MissionInputError
            One cannot be read.
        """
        return read_files(self._places)

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder and reduce the structure; return the hash of its design."""
        from fe.reduction.model_cache import reduced_structure

        keep_files(folder, self.files())
        self._places = {copy: folder / copy for copy in self._places}
        self._model = reduced_structure(self._places[MODEL_COPY], progress=progress)
        return {"design": self._model.design_hash}

    @property
    def _prepared(self) -> "ReducedModel":
        if self._model is None:
            raise MissionInputError("the model was not prepared: call `prepare` first.")
        return self._model

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter."""
        found = draw_parameter(self._scenario.calibration, seed)
        self._mean = calibrated_means(self._scenario.calibration) | {found.name: found.mean}
        return found

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return strains, displacements, natural frequencies or features of modes (E, S, U, G).

        Frequencies are in rising order; they and modes do not depend on the control.

        Raises
        ------
        OutsideModelError
            A state, control or draw lies outside the ranges of the structure file.
        """
        reduced, scenario = self._prepared, self._scenario
        states, controls = model.states.coordinates, scenario.control
        shape = (len(draws.values), len(states), len(controls))
        draw, state, control = (index.ravel() for index in np.indices(shape))
        vectors = np.tile(reduced.nominal, (draw.size, 1))
        place = reduced.chosen.index
        count = scenario.observation.count
        for name, values in {**draws.others, draws.name: draws.values}.items():
            vectors[:, place(name)] = values[draw]
        for column, name in enumerate(scenario.state_names):
            vectors[:, place(name)] = states[state, column]
        for name in controls[0].values:
            vectors[:, place(name)] = np.array([item.values[name] for item in controls])[control]
        modes = scenario.observation.modes
        if modes is not None or scenario.observation.role == "frequency":
            first = vectors.reshape(*shape, -1)[:, :, 0].reshape(-1, vectors.shape[1])
            if modes is None:
                found = np.array([reduced.modes(vector).frequency[:count] for vector in first])
            else:
                found = np.array([modes.observed(modal_values(reduced, vector, modes)) for vector in first])
            return np.repeat(found.reshape(*shape[:2], 1, count), shape[2], axis=2)
        return reduced.static_outputs(vectors)[:, self._observed].reshape(*shape, count)

    @property
    def _observed(self) -> slice:
        gauges = len(self._prepared.gauges)
        return slice(0, gauges) if self._scenario.observation.role == "strain" else slice(gauges, None)

    def open(self) -> Asset:
        """Return the model as an asset, with the parameters of the scenario's true structure."""
        model, observed = self._prepared, self._observed
        true = {**calibrated_means(self._scenario.calibration), **self._scenario.asset.true_parameters}
        role, count, modes = (getattr(self._scenario.observation, key) for key in ("role", "count", "modes"))
        known = {name: value for name, value in true.items() if name in model.chosen}

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            values = {**known, **health, **control}
            if modes is not None:
                return AssetReading(modes.observed(modal_values(model, model.vector(values), modes)))
            if role == "frequency":
                return AssetReading(model.modes(values).frequency[:count])
            found = model.static_response(values)
            outputs = np.concatenate((found.strain, found.displacement))
            return AssetReading(outputs[observed], {"strain_error_bound": found.strain_error_bound})

        return StatelessAsset(observe)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the structure as VTU."""
        return _write_field(path, self._places[MODEL_COPY], {**self._mean, **state, **control})


def _write_field(path: Path, file: Path, values: Mapping[str, float]) -> bool:
    """Solve the full structure under values by name and write its field beside `path`, if it has a mesh.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    from fe.structure.design import load_structure
    from fe.structure.field import write_structure_vtu
    from fe.structure.matrix_design import MatrixDesign
    from fe.structure.operators import load_and_assemble
    from reporting.files import write_error

    if isinstance(load_structure(file), MatrixDesign):
        return False
    target = path.with_name(FIELD_NAME)
    try:
        write_structure_vtu(target, load_and_assemble(file), values)
    except OSError as error:
        raise write_error(error, target) from error
    return True
