"""An FMU as the asset of a mission: any FMU with a binding, given or packed of a model script."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, Union

import numpy as np
from pydantic import Field

from fmu_asset.archive.fmu_file import packed_design_hash
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuInputError
from fmu_asset.folders import scratch_folder
from reporting.arrays import Float
from reporting.files import hash_file
from reporting.progress import Progress
from reporting.toml_file import Fault, Number, Positive
from reporting.units import meaning_of
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    Asset,
    AssetBelief,
    AssetReading,
    AssetSource,
    asked_table,
    read_files,
)
from twin_master.assets.parameter import (
    ParameterDraws,
    calibrated_means,
    check_calibration,
    read_calibration,
)
from twin_master.errors import MissionInputError, check_names, said
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import AssetSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Flag, Name
from twin_master.seeds import generator

if TYPE_CHECKING:
    from fmu_asset.coupling.asset import CoupledAsset


Session = Union[FmiAsset, "CoupledAsset"]
"""One FMU, or several as one, with the same face."""
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

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY}

    def faults(self) -> Iterator[Fault]:
        """Yield parameters that are seeds, too."""
        for name in self.seeds:
            yield (
                name in self.parameters,
                f"`{name}` is both in `parameters` and in `seeds`: keep one of them",
            )


class FmuFileSection(FmuSection):
    """An FMU, made by whatever tool."""

    kind: Literal["fmu"] = "fmu"
    file: str

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "file": FMU_COPY}

    def source(self, scenario: Scenario) -> "FmuSource":
        """Return the FMU."""
        return FmuSource(scenario, self)


class ScriptSection(FmuSection):
    """A pythonfmu script that is packed as the FMU: a shipped one, or a file."""

    kind: Literal["script"] = "script"
    script: str

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "script": FMU_COPY}

    def portable(self) -> FmuFileSection:
        """Return the FMU that was packed: from then on it is what is flown."""
        common = {name: getattr(self, name) for name in FmuSection.model_fields if name != "kind"}
        binding = super().portable().model_dump()["binding"]
        return FmuFileSection.model_validate(common | {"binding": binding, "file": FMU_COPY})

    def source(self, scenario: Scenario) -> "ScriptSource":
        """Return the FMU of the script."""
        return ScriptSource(scenario, self)


InnerRoles = tuple[Mapping[str, str], slice, slice | None]
"""Where an asset with damage and sensors of its own tells the truth; see `[truth]` of a scenario.

The monitor of each state factor; among the observations of the binding the noise-free one, and where it tells
whether each sensor is received.
"""
_TAKEN = ("state", "sensor_status", "step", "region", "sensor")
"""What the truth of a run holds already."""


class FmuAsset(Asset):
    """An FMU, or several coupled ones, as the mission flies them.

    Parameters
    ----------
    session : FmiAsset or CoupledAsset
        The asset, at its start.
    observation : slice
        Where the observed quantity stands among the observations of the binding.
    load : mapping of str to float
        Load inputs, the same in every step.
    inner : InnerRoles, optional
        Given where damage and sensors are the asset's own.
    """

    def __init__(
        self,
        session: "Session",
        observation: slice,
        load: Mapping[str, float],
        inner: InnerRoles | None = None,
    ) -> None:
        self._session, self._observation, self._load, self._inner = (
            session,
            observation,
            dict(load),
            inner,
        )
        binding, self._names = session.binding, dict[str, str]()
        taken = {*binding.control, *binding.observation, *_TAKEN}
        for name in session.recorded_units:  # stored under a name without `/` that is not taken
            plain = "".join("_" if c == "/" or not c.isprintable() else c for c in name).strip()
            while plain in taken or not plain:
                plain += "_"
            taken.add(plain)
            self._names[name] = plain
        inputs = (*binding.parameter.items(), *binding.control.items())
        recorded = {self._names[name]: unit for name, unit in session.recorded_units.items()}
        self.units = {name: scalar.unit for name, scalar in inputs} | recorded

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make one communication step."""
        observation = self._session.step(control, health, self._load)
        sensed = observation.values[self._observation]
        extra = {self._names[name]: value for name, value in observation.extra.items()}
        if self._inner is None:
            return AssetReading(sensed, extra)
        monitors, free, received = self._inner
        state = {name: observation.extra[monitor] for name, monitor in monitors.items()}
        if received is not None:
            sensed = np.where(observation.values[received] == 0.0, np.nan, sensed)
        return AssetReading(observation.values[free], extra, state, sensed)

    def save_state(self) -> bytes:
        """Return the state of the FMU."""
        return self._session.save_state()

    def restore_state(self, state: bytes) -> None:
        """Bring the FMU to a saved state."""
        self._session.restore_state(state)

    def close(self) -> None:
        """End the worker."""
        self._session.close()


class FmuSource(AssetSource):
    """An FMU from a file.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : FmuSection
        Its table `asset`.
    """

    label = "FMU"  # it may hold any model, also that of a design: whether they differ is not known
    section: FmuSection

    def binding(self) -> Binding:
        """Return the binding: where it is given, or its copy once prepared."""
        return load_binding(self.path(BINDING_COPY))

    def check(self) -> None:
        """Read what is given where it is, without copying or starting anything.

        Raises
        ------
        MissionInputError
            A file cannot be read, or the binding observes another number of values than the scenario.
        CalibrationRecordError
            The calibration file is damaged or of another kind, or has no samples of the parameter.
        FmuError, FiniteElementError
            Binding, FMU, script, design or structure is wrong, or the binding does not fit the FMU.
        """
        scenario, section = self._scenario, self.section
        found = read_calibration(scenario.calibration)
        self.files()
        binding = self.binding()
        parameters = [*binding.parameter, *self._check_calibration(binding)]
        rows = (
            ("control input", scenario.control[0].values, binding.control),
            (
                "state",
                () if scenario.truth.kind == "asset" else scenario.state_names,
                binding.health,
            ),
            ("load", section.load, binding.load),
            ("parameter", (*section.parameters, *section.seeds), parameters),
        )
        check_names("the scenario has the", f"the binding {binding.name}", rows)
        try:
            with scratch_folder() as folder:
                binding = self._fitted(binding, folder)
        except FmuInputError as error:
            means = calibrated_means(scenario.calibration)
            own = [f"{name} = {mean:.6g}" for name, mean in means.items() if name not in section.parameters]
            if not own:
                raise
            raise MissionInputError(said("assets.calibrated", error=error, own=", ".join(own))) from error
        self._observed(binding)
        self._inner_roles(binding)
        told = scenario.truth.state
        for factor in scenario.state:
            of = binding.monitor[told[factor.name]] if told else binding.health[factor.name]
            _check_unit(binding, f"the state {factor.name}", of.unit, "state.unit", factor.unit)
        for prior in found.priors if found is not None and found.design is None else ():
            if prior.name in binding.parameter:
                unit = binding.parameter[prior.name].unit
                _check_unit(binding, f"the parameter {prior.name}", unit, "calibration.file", prior.unit)

    def _check_calibration(self, binding: Binding) -> tuple[str, ...]:
        """Check the calibration; return what parameters there are beside those of the binding."""
        believed = isinstance(self._scenario.belief, AssetBelief)
        design_hash = packed_design_hash(self.path(FMU_COPY)) if believed and FMU_COPY in self.places else ""
        where = f"the binding {binding.name}"
        check_calibration(self._scenario.calibration, binding.parameter, where, design_hash=design_hash)
        return ()

    def _fitted(self, binding: Binding, folder: Path) -> Binding:
        """Return the binding as the FMU fits it: only with that it is known how many values an array has."""
        return FmiAsset(self.path(FMU_COPY), binding, parameters=self.parameters()).binding

    def _make(self, progress: Progress) -> dict[str, str]:
        packed = packed_design_hash(self.path(FMU_COPY))
        return ({FLOWN_DESIGN_HASH: packed} if packed else {}) | {"fmu": hash_file(self.path(FMU_COPY))}

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Ask the FMU for its observation (E, S, U, G) at every draw, state and control.

        That holds for assets without memory.
        """
        scenario, load, rows = self._scenario, self.section.load, []
        with self._session(self.binding(), self.parameters()) as session:
            chosen = self._observed(session.binding)

            def ask(control: Mapping[str, float], health: Mapping[str, float]) -> Float:
                return session.step(control, health, load).values[chosen]

            for row, value in enumerate(draws.values):
                others = {
                    name: float(values[row])
                    for name, values in draws.others.items()
                    if name in session.binding.parameter
                }
                session.reset({**self.parameters(), **others, draws.name: float(value)})
                rows.append(asked_table(scenario, model.states.coordinates, ask))
        return np.array(rows)

    def _observed(self, binding: Binding, role: str = "") -> slice:
        """Return where a role stands among the observations of the binding, in the units of the scenario."""
        role = role or self._scenario.observation.role
        chosen = self._slice(binding, role)
        bound, given = binding.observation[role].units, self._scenario.observation.sensor_units
        for number, (there, here) in enumerate(zip(bound, given, strict=True), 1):
            _check_unit(binding, f"value {number} of `{role}`", there, "observation.unit", here)
        return chosen

    def _slice(self, binding: Binding, role: str) -> slice:
        expected = self._scenario.observation.count
        chosen = binding.observation_slice(role)
        if chosen.stop - chosen.start != expected:
            came = binding.name, chosen.stop - chosen.start
            raise MissionInputError(said("assets.width", came=came, role=role, expected=expected))
        return chosen

    def _inner_roles(self, binding: Binding) -> InnerRoles | None:
        """Return where the asset tells of its own damage and sensors; None where the truth is the scenario's.

        Raises
        ------
        MissionInputError
            The binding has no such monitor or observation.
        """
        truth = self._scenario.truth
        if truth.kind != "asset":
            return None
        if isinstance(self._scenario.belief, AssetBelief):
            raise MissionInputError(said("assets.own_damage"))
        rows = [("monitor", truth.state.values(), binding.monitor)]
        check_names("`truth.state` names the", f"the binding {binding.name}", rows)
        received = None if truth.received is None else self._slice(binding, truth.received)
        return truth.state, self._observed(binding, truth.observation or ""), received

    def parameters(self) -> dict[str, float]:
        """Return the parameters of the scenario, and the numbers drawn for its seeds.

        What was calibrated from a campaign and the scenario does not name is at its posterior mean.
        """
        section, seed = self.section, self._scenario.mission.seed
        drawn = generator(seed, "asset").integers(LARGEST_SEED, size=len(section.seeds))
        seeds = {name: float(value) for name, value in zip(section.seeds, drawn, strict=True)}
        return calibrated_means(self._scenario.calibration) | section.parameters | seeds

    def _session(self, binding: Binding, parameters: Mapping[str, float]) -> "Session":
        section = self.section
        return FmiAsset(
            self.path(FMU_COPY), binding, isolated=section.isolated, step_timeout=section.step_timeout,
            parameters=parameters,
        )  # fmt: skip

    def open(self) -> Asset:
        """Return the FMU at its start, with the parameters of the scenario.

        Raises
        ------
        FmuError
            The FMU cannot be flown, or the binding does not fit it.
        MissionInputError
            The FMU observes another number of values than the scenario.
        """
        session = self._session(self.binding(), self.parameters())
        chosen, inner = self._observed(session.binding), self._inner_roles(session.binding)
        try:
            session.reset()
        except BaseException:
            session.close()
            raise
        return FmuAsset(session, chosen, self.section.load, inner)


def _check_unit(binding: Binding, which: str, there: str, key: str, here: str) -> None:
    """Refuse another unit in a scenario than in a binding; "1" is of any dimension, but not a percentage."""
    if there == here:
        return  # pint takes a third of a second to load
    meant = meaning_of(there)
    share = meant is not None and not any(meant.exponents) and meant.factor != 1.0
    if here != "1" or share:
        units = there, here
        raise MissionInputError(said("assets.unit", binding=binding, which=which, units=units, key=key))


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

        given = dict(self.places)
        script = given.pop(FMU_COPY)
        return {**read_files(given), FMU_COPY: script_fmu(script)[0]}

    def _fitted(self, binding: Binding, folder: Path) -> Binding:
        packed = folder / "asset.fmu"
        packed.write_bytes(self.files()[FMU_COPY])
        return FmiAsset(packed, binding, parameters=self.parameters()).binding
