"""Checks of a fleet before its first twin flies, and the sources of its assets."""

from collections.abc import Mapping
from pathlib import Path

from twin_master.assets.asset_source import AssetSource
from twin_master.assets.resolution import asset_source, believed_source
from twin_master.errors import FleetError
from twin_master.feeds.feed_choice import file_feed
from twin_master.fleet.plan import Fleet, Group
from twin_master.fleet.storage.store_layout import dimension_sizes
from twin_master.mission.plant import FLIGHT_ERRORS
from twin_master.scenario.schema import Scenario

_WING_PARAMETER = "young_modulus_factor"
"""The only parameter that the model of a wing knows."""
_ROUNDING = 1e-12
"""Distance of a value beyond a bound that is attributed to rounding."""


def flies_model(scenario: Scenario) -> bool:
    """Return whether the asset is simulated by the twin's reduced model, without an FMU.

    This is possible if the asset and the twin's model are of the same wing design.
    """
    asset = scenario.asset
    belief = scenario.belief
    if (asset.kind, belief.kind) != ("design", "design") or scenario.models_differ:
        return False
    return getattr(asset, "design", None) == getattr(belief, "design", None)


def source_of(scenario: Scenario, *, is_real: bool = False) -> AssetSource:
    """Return the source of a fleet's assets and of the model that the twins use.

    Parameters
    ----------
    is_real : bool
        Whether the assets are real, so that only the twins' model is needed.
    """
    if is_real or flies_model(scenario):
        return believed_source(scenario)
    return asset_source(scenario)


def with_parameters(scenario: Scenario, parameters: Mapping[str, float]) -> Scenario:
    """Return a scenario with true parameters of the asset [SI] added, or replaced by name."""
    if not parameters:
        return scenario
    return scenario.with_changes(
        "asset", parameters={**scenario.asset.true_parameters, **parameters}
    )


def check_fleet(fleet: Fleet) -> None:
    """Check that every asset of a fleet can fly.

    Raises
    ------
    FleetError
        If any asset cannot fly; the message lists all such assets and the reasons.
    """
    faults = []
    for group in fleet.groups:
        is_real = bool(group.observations)
        mean_parameters = {name: spread.mean for name, spread in group.parameter_spreads.items()}
        for number, scenario in enumerate(group.scenarios):
            try:
                _check_scenario(group, scenario)
                source_of(with_parameters(scenario, mean_parameters), is_real=is_real).check()
            except FLIGHT_ERRORS as error:
                has_many = len(group.scenarios) > 1
                asset = f"{group.name} {group.members[number].name}" if has_many else group.name
                faults.append(f"{asset}: {error}")

        # The recordings of real assets
        for member in group.members if is_real else ():
            try:
                file_feed(member.file or Path(), group.scenarios[0])
            except FLIGHT_ERRORS as error:
                faults.append(f"{group.name}: {error}")
    if faults:
        heading = f"{len(faults)} of the assets cannot fly, so none did:"
        raise FleetError("\n".join([heading, *faults]))


def _check_scenario(group: Group, scenario: Scenario) -> None:
    """Raise an error if a group cannot fly one of its scenarios."""
    if scenario.observation.role == "modes":
        raise FleetError(
            'a fleet stores values without covariances, but with `role = "modes"` each step has a '
            "covariance of its own: fly the scenario with `uav-twin run`."
        )
    if group.observations:
        _check_recordings(group)
        return
    has_one_life = scenario.truth.kind == "asset" and not getattr(scenario.asset, "seeds", ())
    if has_one_life and len(group.scenarios) < len(group.members):
        raise FleetError(
            "the damage and noise of this asset are its own, so that every seed would fly the same "
            "mission: name its seeds in `asset.seeds`, or fly the scenario with --seed."
        )
    if flies_model(scenario):
        unknown_parameters = sorted({*group.parameter_spreads} - {_WING_PARAMETER})
        if unknown_parameters:
            raise FleetError(
                f"`parameters` names {', '.join(unknown_parameters)}, and the model of a wing "
                f"knows only {_WING_PARAMETER}."
            )
        _check_true_parameters(group, scenario)
    if dimension_sizes(scenario) != dimension_sizes(group.scenarios[0]):
        raise FleetError("it has other states or sensors than the first asset of its group.")


def _check_recordings(group: Group) -> None:
    """Raise an error if a group of real assets has no recordings, or two of one name."""
    names = {member.name for member in group.members}
    if not names:
        raise FleetError(
            f"no recording matches {group.observations}; use `fleet watch` for recordings that are "
            "still to come."
        )
    if len(names) < len(group.members):
        raise FleetError(
            "two recordings have the same name, but assets are named after their recordings: "
            "rename one."
        )


def _check_true_parameters(group: Group, scenario: Scenario) -> None:
    """Raise an error if a true factor on Young's modulus lies outside the model's range."""
    from fe.wing.design import wing_structure

    usual_value = scenario.asset.true_parameters.get(_WING_PARAMETER, 1.0)
    values = [usual_value]
    if _WING_PARAMETER in group.parameter_spreads:
        values = [member.parameters[_WING_PARAMETER] for member in group.members]
    low, high = wing_structure(scenario.state_names, 0).ranges[_WING_PARAMETER]
    outside = [value for value in values if not low - _ROUNDING <= value <= high + _ROUNDING]
    if outside:
        raise FleetError(
            f"the true {_WING_PARAMETER} of {len(outside)} of {len(values)} assets lies outside "
            f"{low:g} to {high:g}, the range of the model; the first of them is {outside[0]:.4g}: "
            "let it vary less, or fly FMUs."
        )
