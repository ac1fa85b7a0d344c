"""An FMU as the asset of a mission: any FMU with a binding, given or packed of a model script."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from fmu_asset.archive.fmu_file import packed_design_hash
from fmu_asset.errors import FmuInputError
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.assets.asset_source import (
    FLOWN_DESIGN_HASH,
    AssetBelief,
    FlownAndBelieved,
    keep_files,
    named_files,
    read_files,
)
from twin_master.assets.interface import Asset
from twin_master.assets.parameter import (
    ParameterDraws,
    calibrated_means,
    check_calibration,
    draw_parameter,
)
from twin_master.errors import MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import AssetSection
from twin_master.scenario.schema import CALIBRATION_COPY, Scenario
from twin_master.scenario.section import Flag, Name, Number, Positive
from twin_master.seeds import generator

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from fmu_asset.door.binding import Binding
    from twin_master.assets.flown_fmu import InnerRoles, Session

Float = NDArray[np.float64]

BINDING_COPY = "asset/binding.toml"
FMU_COPY = "asset/asset.fmu"
LARGEST_SEED = 2**31 - 1
"""Of an FMU's integer parameter."""


class FmuSection(AssetSection):
    """What is said of any asset that is an FMU, or several."""

    is_fmu: ClassVar[bool] = True
    binding: str
    isolated: Flag = True
    step_timeout: Positive | None = None
    """Wall-clock limit of a step [s]; otherwise that of the binding."""
    parameters: dict[str, Number] = Field(default_factory=dict)
    load: dict[str, Number] = Field(default_factory=dict)
    seeds: tuple[Name, ...] = ()
    """Parameters of the binding that are given a number drawn from the seed of the run."""

    def copies(self) -> Mapping[str, str]:
        """Return where the copy of the binding stands in a run folder."""
        return {"binding": BINDING_COPY}

    @property
    def true_parameters(self) -> Mapping[str, float]:
        """Parameters of the true asset by the binding's names, SI."""
        return self.parameters

    @property
    def constant_load(self) -> Mapping[str, float]:
        """Load inputs, the same in every step, SI."""
        return self.load

    @property
    def binding_path(self) -> Path:
        """The binding, shipped or not."""
        return self.all_files()[BINDING_COPY]

    @model_validator(mode="after")
    def _check_seeds(self) -> Self:
        for name in self.seeds:
            if name in self.parameters:
                raise ValueError(f"`{name}` is both in `parameters` and in `seeds`: keep one of them")
        return self


class FmuFileSection(FmuSection):
    """An FMU, made by whatever tool."""

    kind: Literal["fmu"] = "fmu"
    file: str

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of binding and FMU stand in a run folder."""
        return {"binding": BINDING_COPY, "file": FMU_COPY}

    def source(self, scenario: Scenario) -> "FmuSource":
        """Return the FMU."""
        return FmuSource(scenario, self)


class ScriptSection(FmuSection):
    """A pythonfmu script that is packed as the FMU: a shipped one, or a file."""

    kind: Literal["script"] = "script"
    script: str

    def copies(self) -> Mapping[str, str]:
        """Return where the copies of binding and script stand; the script's is the FMU made of it."""
        return {"binding": BINDING_COPY, "script": FMU_COPY}

    def portable(self) -> FmuFileSection:
        """Return the FMU that was packed: from then on it is what is flown."""
        common = {name: getattr(self, name) for name in FmuSection.model_fields if name != "kind"}
        binding = super().portable().model_dump()["binding"]
        return FmuFileSection.model_validate(common | {"binding": binding, "file": FMU_COPY})

    def source(self, scenario: Scenario) -> "ScriptSource":
        """Return the FMU of the script."""
        return ScriptSource(scenario, self)


class FmuSource:
    """An FMU from a file.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : FmuSection
        Its table `asset`.
    """

    def __init__(self, scenario: Scenario, section: FmuSection) -> None:
        self._scenario = scenario
        self._section = section
        self._folder: Path | None = None

    @property
    def origin(self) -> FlownAndBelieved:
        """The FMU, twice. It may hold any model, also that of a design: whether they differ is not known."""
        return FlownAndBelieved("FMU", "FMU")

    @property
    def wing(self) -> "ReducedModel | None":
        """The reduced model of the wing that was packed, once prepared; None for any other FMU."""
        return None

    @property
    def step_timeout(self) -> float | None:
        """Wall-clock limit of a step [s], where the scenario sets one."""
        return self._section.step_timeout

    def binding(self) -> "Binding":
        """Return the binding, once prepared."""
        from fmu_asset.door.binding import load_binding

        return load_binding(self._path(BINDING_COPY))

    def fmu_path(self) -> Path:
        """Return the FMU, once prepared."""
        return self._path(FMU_COPY)

    def _path(self, name: str) -> Path:
        if self._folder is None:
            raise MissionInputError("the asset was not prepared: call `prepare` first.")
        return self._folder / name

    def check(self) -> None:
        """Read what is given where it is, without copying or starting anything.

        Raises
        ------
        MissionInputError
            A file cannot be read, or the binding observes another number of values than the scenario.
        CalibrationRecordError
            The calibration file is damaged or of another kind, or has no samples of the parameter.
        FmuError
            Binding, FMU or script is wrong, or the binding does not fit the FMU.
        """
        from fmu_asset.door.binding import load_binding

        self.files()
        binding = load_binding(self._section.binding_path)
        believed = isinstance(self._scenario.belief, AssetBelief)
        check_calibration(
            self._scenario.calibration, binding.parameter, f"the binding {binding.name}",
            design_hash=packed_design_hash(self._section.all_files()[FMU_COPY]) if believed else "",
        )  # fmt: skip
        self._check_names(binding)
        with TemporaryDirectory(prefix="uav_twin_") as folder, self._told_of_means():
            binding = self._fitted(binding, Path(folder))
        self._observed(binding)
        self._inner_roles(binding)

    @contextmanager
    def _told_of_means(self) -> Iterator[None]:
        """Tell of a parameter that the FMU refuses that it may be one of the calibration."""
        try:
            yield
        except FmuInputError as error:
            means = calibrated_means(self._scenario.calibration)
            own = [
                f"{name} = {value:.6g}"
                for name, value in means.items()
                if name not in self._section.parameters
            ]
            if not own:
                raise
            raise MissionInputError(
                f"{error} The calibration has {', '.join(own)}: give one of what is flown, or name the "
                "parameter in `asset.parameters`."
            ) from error

    def _fitted(self, binding: "Binding", folder: Path) -> "Binding":
        """Return the binding as the FMU fits it: only with that it is known how many values an array has."""
        from fmu_asset.door.session import FmiAsset

        fmu = self._section.all_files()[FMU_COPY]
        return FmiAsset(fmu, binding, parameters=self.parameters()).binding

    def files(self) -> dict[str, bytes]:
        """Return binding, FMU and whatever else is given, by the places of the copies.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        """
        return read_files(named_files(self._scenario, self._section))

    def _check_names(self, binding: "Binding", effects: tuple[str, ...] = ()) -> None:
        """Check the scenario's names against the binding; `effects` are parameters by the FMU's own names."""
        scenario, section = self._scenario, self._section
        for what, names, known in (
            ("control input", scenario.control[0].values, binding.control),
            ("state", () if scenario.truth.kind == "asset" else scenario.state_names, binding.health),
            ("load", section.load, binding.load),
            ("parameter", (*section.parameters, *section.seeds), [*binding.parameter, *effects]),
        ):
            unknown = sorted({*names} - {*known})
            if unknown:
                raise MissionInputError(
                    f"the scenario has the {what} {', '.join(unknown)}, which the binding {binding.name} "
                    f"does not know; it knows {', '.join(known) or 'none'}."
                )

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder and make the FMU; return the hashes.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        FmuError
            Binding or FMU is wrong.
        """
        self._folder = folder
        contents = self.files()
        keep_files(folder, contents)
        hashed = {"binding": BINDING_COPY, "calibration": CALIBRATION_COPY}
        hashes = {name: hash_file(self._path(copy)) for name, copy in hashed.items() if copy in contents}
        return hashes | self._make(progress)

    def use(self, folder: Path) -> None:
        """Fly what an earlier `prepare` left in a folder, without making it again."""
        self._folder = folder

    def _make(self, progress: Progress) -> dict[str, str]:
        """Make what is flown of the copies; return the hashes."""
        packed = packed_design_hash(self.fmu_path())
        return ({FLOWN_DESIGN_HASH: packed} if packed else {}) | {"fmu": hash_file(self.fmu_path())}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter."""
        return draw_parameter(self._scenario.calibration, seed, self.wing)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Ask the FMU for its observation (E, S, U, G) at every draw, state and control.

        That holds for assets without memory.
        """
        scenario = self._scenario
        states, controls = model.states.coordinates, scenario.control
        table = np.empty((len(draws.values), len(states), len(controls), scenario.observation.count))
        with self._session() as session:
            chosen = self._observed(session.binding)
            for row, value in enumerate(draws.values):
                others = {name: float(values[row]) for name, values in draws.others.items()}
                session.reset({**self.parameters(), **others, draws.name: float(value)})
                for state, levels in enumerate(states):
                    health = dict(zip(scenario.state_names, levels.tolist(), strict=True))
                    for index, control in enumerate(controls):
                        reading = session.step(control.values, health, self._section.load)
                        table[row, state, index] = reading.values[chosen]
        return table

    def _observed(self, binding: "Binding") -> slice:
        """Return where the observed quantity stands among the observations of the binding."""
        return self._measured(binding, self._scenario.observation.role)

    def _measured(self, binding: "Binding", role: str) -> slice:
        """Return where a role stands whose units are those that the scenario says, if it says any."""
        chosen = self._slice(binding, role)
        bound, said = binding.observation[role].units, self._scenario.observation.sensor_units
        for number, (there, here) in enumerate(zip(bound, said, strict=True), 1):
            if there != here != "1":
                raise MissionInputError(
                    f"the binding {binding.name} gives value {number} of `{role}` in {there}, and "
                    f"`observation.unit` of the scenario says {here}: write the same unit in both."
                )
        return chosen

    def _slice(self, binding: "Binding", role: str) -> slice:
        expected = self._scenario.observation.count
        chosen = binding.observation_slice(role)
        if chosen.stop - chosen.start != expected:
            raise MissionInputError(
                f"the binding {binding.name} observes {chosen.stop - chosen.start} values of `{role}`, and "
                f"the scenario expects {expected}."
            )
        return chosen

    def _inner_roles(self, binding: "Binding") -> "InnerRoles | None":
        """Return where the asset tells of its own damage and sensors; None where the truth is the scenario's.

        Raises
        ------
        MissionInputError
            The binding has no such monitor or observation.
        """
        from twin_master.assets.flown_fmu import InnerRoles

        truth = self._scenario.truth
        if truth.kind != "asset":
            return None
        if isinstance(self._scenario.belief, AssetBelief):
            raise MissionInputError(
                "an asset that carries its own damage cannot be asked what the twin should expect of each "
                "state: name a model for the twin in the table `belief`."
            )
        unknown = sorted({*truth.state.values()} - {*binding.monitor})
        if unknown:
            raise MissionInputError(
                f"`truth.state` names the monitor {', '.join(unknown)}, which the binding {binding.name} "
                f"does not know; it knows {', '.join(binding.monitor) or 'none'}."
            )
        return InnerRoles(
            state=truth.state,
            observation=self._measured(binding, truth.observation or self._scenario.observation.role),
            received=None if truth.received is None else self._slice(binding, truth.received),
        )

    def parameters(self) -> dict[str, float]:
        """Return the parameters of the scenario, and the numbers drawn for its seeds.

        What was calibrated from a campaign and the scenario does not name is at its posterior mean.
        """
        section, seed = self._section, self._scenario.mission.seed
        drawn = generator(seed, "asset").integers(LARGEST_SEED, size=len(section.seeds))
        seeds = {name: float(value) for name, value in zip(section.seeds, drawn, strict=True)}
        return calibrated_means(self._scenario.calibration) | section.parameters | seeds

    def _session(self) -> "Session":
        from fmu_asset.door.session import FmiAsset

        return FmiAsset(
            self._path(FMU_COPY),
            self.binding(),
            isolated=self._section.isolated,
            step_timeout=self._section.step_timeout,
            parameters=self.parameters(),
        )

    def open(self) -> Asset:
        """Return the FMU at its start, with the parameters of the scenario.

        Raises
        ------
        FmuError
            The FMU cannot be flown, or the binding does not fit it.
        MissionInputError
            The FMU observes another number of values than the scenario.
        """
        from twin_master.assets.flown_fmu import FmuAsset

        session = self._session()
        chosen, inner = self._observed(session.binding), self._inner_roles(session.binding)
        try:
            session.reset()
        except BaseException:
            session.close()
            raise
        return FmuAsset(session, chosen, self._section.load, inner)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write nothing: an FMU shows no field."""
        return False


class ScriptSource(FmuSource):
    """An FMU that is packed of a model script."""

    def files(self) -> dict[str, bytes]:
        """Return the binding, and the FMU made of the script.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        FmuBuildError
            The script cannot be packed.
        """
        from fmu_asset.packing.script import script_fmu

        given = named_files(self._scenario, self._section)
        script = given.pop(FMU_COPY)
        return {**read_files(given), FMU_COPY: script_fmu(script)[0]}

    def _fitted(self, binding: "Binding", folder: Path) -> "Binding":
        from fmu_asset.door.session import FmiAsset

        packed = folder / "asset.fmu"
        packed.write_bytes(self.files()[FMU_COPY])
        return FmiAsset(packed, binding, parameters=self.parameters()).binding
