"""A user's policy, sensor model or estimator in place of that of the scenario, or their names.

A name is that of an entry point of an installed package, ``MODULE:NAME`` for an object of a module,
or ``FILE.py:NAME`` for one of a file. A run folder never contains code that would be run later:
it only records the names, and whoever resumes the run gives the objects again.
"""

import importlib.util
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, cast

from numpy.typing import ArrayLike

from fe.runtime.errors import PlugInError
from fe.runtime.plug_ins import find_plug_in, plug_in_names
from reporting.arrays import Float
from reporting.words import listing
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.mission.planning import read_policy
from twin_master.network.estimator import Estimator
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import BeliefPolicy
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.twin import Planner
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import is_policy_name

ENTRY_POINT_GROUPS = {
    "policy": "uav_twin.policies",
    "sensor_model": "uav_twin.sensor_models",
    "estimator": "uav_twin.estimators",
}
"""The group of entry points of each part."""


class TwinBeforeFlight(Protocol):
    """The argument of a function that makes a part: a `Knowledge` without that part."""

    @property
    def scenario(self) -> Scenario:
        """The scenario."""

    @property
    def model(self) -> GraphicalModel:
        """The states, controls and transitions."""

    @property
    def sensor_model(self) -> GaussianSensorModel:
        """The sensor model that the scenario asks for, or the given one."""

    @property
    def estimator(self) -> Estimator:
        """The estimator that the scenario asks for."""


GivenPolicy = ArrayLike | BeliefPolicy | Planner | Path | str
"""A policy (S, U), one on the belief, a function of the graphical model, a file, or a name.

A name is that of a policy of scenarios, such as "risk 0.05, hold 3", or of an object.
"""
GivenSensorModel = GaussianSensorModel | Callable[[TwinBeforeFlight], GaussianSensorModel] | str
"""A sensor model, a function that makes one, or the name of either."""
GivenEstimator = Estimator | Callable[[TwinBeforeFlight], Estimator] | str
"""An estimator, a function that makes one, or the name of either."""


@dataclass(frozen=True)
class TwinParts:
    """Parts of a twin that a user gives to replace the scenario's.

    Attributes
    ----------
    policy : GivenPolicy or None
        The policy that is flown instead of a plan.
    sensor_model : GivenSensorModel or None
        The probability of observations in each state.
    estimator : GivenEstimator or None
        The estimator of the belief.
    """

    policy: GivenPolicy | None = None
    sensor_model: GivenSensorModel | None = None
    estimator: GivenEstimator | None = None

    @property
    def is_any_given(self) -> bool:
        """Whether the user gives any part."""
        return self.policy is not None or self.replace_filter

    @property
    def replace_filter(self) -> bool:
        """Whether the user gives a sensor model or an estimator."""
        return self.sensor_model is not None or self.estimator is not None

    def record(self) -> dict[str, str]:
        """Return the names of sensor model and estimator, for ``config.json``."""
        given_parts = {"sensor_model": self.sensor_model, "estimator": self.estimator}
        return {role: description(part) for role, part in given_parts.items() if part is not None}

    def in_scenario(self, scenario: Scenario) -> tuple[Scenario, "TwinParts"]:
        """Put a policy that is named by one of the scenario's words into the scenario.

        Return the scenario and the other parts.
        """
        if isinstance(self.policy, str) and is_policy_name(self.policy):
            return scenario.with_policy(self.policy), replace(self, policy=None)
        return scenario, self

    def with_objects(self) -> "TwinParts":
        """Return the parts with each name replaced by its object.

        Raises
        ------
        MissionInputError
            If a name is not that of an object.
        """
        parts = self
        if isinstance(self.policy, str):
            # Any other text is the path of a policy file.
            entry_points = plug_in_names(ENTRY_POINT_GROUPS["policy"])
            if ":" in self.policy or self.policy in entry_points:
                policy = cast(GivenPolicy, object_by_name("policy", self.policy))
                parts = replace(parts, policy=policy)
        if isinstance(self.sensor_model, str):
            sensor_model = cast(GivenSensorModel, object_by_name("sensor_model", self.sensor_model))
            parts = replace(parts, sensor_model=sensor_model)
        if isinstance(self.estimator, str):
            estimator = cast(GivenEstimator, object_by_name("estimator", self.estimator))
            parts = replace(parts, estimator=estimator)
        return parts

    def policy_for(self, model: GraphicalModel) -> Float | BeliefPolicy | None:
        """Return the given policy for the states and controls of a model; None if none is given.

        Raises
        ------
        PlanningError
            If the file is not a policy, or its policy is for other states or controls.
        InvalidModelError
            If an array is not a policy for the model.
        MissionInputError
            If a name is not that of an object.
        """
        policy = self.with_objects().policy
        if policy is None or isinstance(policy, BeliefPolicy):
            return policy
        if isinstance(policy, str | Path):
            return read_policy(Path(policy), model)
        return model.policy(policy(model) if callable(policy) else policy)

    def make_sensor_model(self, twin: TwinBeforeFlight) -> GaussianSensorModel:
        """Return the given sensor model.

        Parameters
        ----------
        twin : TwinBeforeFlight
            The knowledge of the twin; its sensor model is that of the scenario.

        Raises
        ------
        MissionInputError
            If it is not a `GaussianSensorModel`, does not fit states, controls and sensors, or if
            the scenario asks for a twin that learns.
        """
        if twin.scenario.learning is not None:
            raise MissionInputError(
                "the scenario has a table `learning`, whose estimator has a sensor model of its "
                "own and would ignore the given one: leave the table out, or fly without "
                "`sensor_model`."
            )
        part = self.with_objects().sensor_model
        if callable(part) and not isinstance(part, GaussianSensorModel):
            part = part(twin)
        if not isinstance(part, GaussianSensorModel):
            raise MissionInputError(
                "the sensor model of a mission must be a GaussianSensorModel or a class derived "
                f"from it, because planner and report use its predictions, but {description(part)} "
                "was given: derive the class, or step a `uav_twin.Twin` with it."
            )
        expected_shape = twin.sensor_model.mean.shape
        if part.mean.shape != expected_shape:
            raise MissionInputError(
                f"the sensor model {description(part)} is for (states, controls, sensors) = "
                f"{part.mean.shape}, but the scenario has {expected_shape}: make it of "
                "`sensor_model.value_per_draw` of `uav_twin.prepare_twin`."
            )
        return part

    def make_estimator(self, twin: TwinBeforeFlight) -> Estimator:
        """Return the given estimator.

        Parameters
        ----------
        twin : TwinBeforeFlight
            The knowledge of the twin; its estimator is that of the scenario.

        Raises
        ------
        MissionInputError
            If it is not an estimator, or if the scenario asks for one that learns.
        """
        if twin.scenario.learning is not None:
            raise MissionInputError(
                "the scenario has a table `learning`, whose estimator would be replaced by the "
                "given one: leave the table out, or fly without `estimator`."
            )
        part = self.with_objects().estimator
        if callable(part) and not _is_estimator(part):
            part = part(twin)
        if part is None or isinstance(part, str) or not _is_estimator(part):
            raise MissionInputError(
                "an estimator needs `model`, `step(before, observation, control_index, step)` and "
                f"`smoothed(carried)`, but {description(part)} was given: see "
                "`uav_twin.ExactFilter`."
            )
        states = part.model.states.size  # type: ignore[union-attr]
        if states != twin.model.states.size:
            raise MissionInputError(
                f"the estimator {description(part)} is for {states} states, but the scenario has "
                f"{twin.model.states.size}: make it of the model of `uav_twin.prepare_twin`."
            )
        return part  # type: ignore[return-value]

    def check_same(self, recorded_parts: Mapping[str, str], folder: Path) -> None:
        """Refuse to resume a run with other parts than it was begun with.

        Raises
        ------
        NotResumableError
            If the parts are not those of the record.
        """
        given_parts = self.record()
        for role in ("sensor_model", "estimator"):
            if recorded_parts.get(role) != given_parts.get(role):
                begun_with = recorded_parts.get(role, "that of the scenario")
                now = given_parts.get(role, "that of the scenario")
                words = role.replace("_", " ")
                advice = f"give `{role}` again" if role in recorded_parts else f"leave `{role}` out"
                raise NotResumableError(
                    f"the run in {folder} was begun with another {words} ({begun_with}) than it "
                    f"would be continued with ({now}): {advice}, or fly it again with --replace."
                )


NO_PARTS = TwinParts()
"""All parts are those of the scenario."""


def _is_estimator(part: object) -> bool:
    """Return whether an object, and not a class, has the methods of an `Estimator`."""
    has_methods = all(hasattr(part, name) for name in ("model", "step", "smoothed"))
    return has_methods and not isinstance(part, type)


def description(part: object) -> str:
    """Return the name of a part for records and sentences."""
    if isinstance(part, str):
        return part
    named_object = part if hasattr(part, "__qualname__") else type(part)
    article = "" if named_object is part else "object of "
    return f"{article}{named_object.__module__}.{named_object.__qualname__}"


def object_by_name(role: str, name: str) -> object:
    """Load a part of a twin that a user has given by name.

    Parameters
    ----------
    role : str
        The part: "policy", "sensor_model" or "estimator".
    name : str
        The name of an entry point, ``MODULE:NAME`` or ``FILE.py:NAME``.

    Raises
    ------
    MissionInputError
        If there is no such object, if its module cannot be imported, or if two installed packages
        have an entry point with this name.
    """
    words = role.replace("_", " ")
    group = ENTRY_POINT_GROUPS[role]
    with MissionInputError.instead_of(PlugInError):
        plug_in = find_plug_in(group, name)
    if plug_in is not None:
        return plug_in.value
    try:
        file, colon, attribute = name.rpartition(":")
        if colon and file.endswith(".py"):
            path = Path(file)
            specification = importlib.util.spec_from_file_location(path.stem, path)
            if specification is None or specification.loader is None:
                raise ImportError(f"{path} is not a Python file")
            module = importlib.util.module_from_spec(specification)
            specification.loader.exec_module(module)
            return getattr(module, attribute)
        if colon:
            return pkgutil.resolve_name(name)
    except Exception as error:  # the module may fail with any error while it is imported
        raise MissionInputError(
            f"the {words} {name!r} cannot be loaded ({type(error).__name__}: {error}): give "
            "MODULE:NAME of a module that Python finds, or FILE.py:NAME."
        ) from error
    installed = plug_in_names(group)
    raise MissionInputError(
        f"there is no {words} {name!r}: give MODULE:NAME, FILE.py:NAME, or the name of an entry "
        f"point of the group {group} (installed: {listing(installed) or 'none'})."
    )
