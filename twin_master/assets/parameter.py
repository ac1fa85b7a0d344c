"""Draws of the uncertain parameter of the model, from a calibration."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from reporting.arrays import Float
from twin_master.errors import MissionInputError, check_names, said
from twin_master.scenario.mission import Calibration
from twin_master.seeds import generator, seed_sequence

if TYPE_CHECKING:
    from calibration.result.record import Calibration as Calibrated
    from fe.runtime.reduced import ReducedModel


SAME_NAMES = "give parameters the same names in the model file of the calibration"
OWN_OF_WING = "give a calibration of the wing's own, which `uav-twin calibrate` makes"


@dataclass(frozen=True)
class ParameterDraws:
    """Equally weighted draws of one parameter of the asset's model.

    Attributes
    ----------
    name : str
        Parameter.
    values : (E,)
        Draws, SI.
    mean, standard_deviation : float
        Of the distribution that was drawn from.
    source : str
        Where the distribution comes from.
    record : mapping or None
        The whole calibration, ready for JSON.
    others : mapping of str to (E,)
        What the other calibrated parameters are expected to be at each draw, SI.
    """

    name: str
    values: Float
    mean: float
    standard_deviation: float
    source: str
    record: Mapping[str, Any] | None = None
    others: Mapping[str, Float] = field(default_factory=dict)


def draw_parameter(
    calibration: Calibration, seed: int, model: "ReducedModel | None" = None
) -> ParameterDraws:
    """Return draws of the calibrated parameter: Kapteyn et al. 2021, calibration step 2.

    From the file of a whole calibration they are drawn from its samples, one from each of as many strata.

    Parameters
    ----------
    calibration : Calibration
        Section of the scenario.
    seed : int
        Seed of the run.
    model : ReducedModel, optional
        The structural model, where its own stiffness curve is to be used.

    Raises
    ------
    MissionInputError
        The scenario asks for the stiffness curve of a design and there is none.
    CalibrationError
        The measurements do not fit the model, or the calibration file cannot be read.
    """
    name, count, found = calibration.parameter, calibration.draws, read_calibration(calibration)
    if calibration.source == "file":
        assert found is not None  # the schema asks for it
        values = found.stratified_draws(name, count, seed_sequence(seed, "calibration"))
        from calibration.result.file import run_record

        return ParameterDraws(
            name, values, found.mean(name), found.standard_deviation(name),
            f"calibration of {found.asset}, {found.procedure}, {len(found.samples)} samples",
            run_record(found, name), found.given(name, values),
        )  # fmt: skip
    if calibration.source in ("fixed", "normal"):
        mean, deviation = calibration.mean, calibration.standard_deviation or 0.0
        assert mean is not None  # the schema asks for it
        if calibration.source == "fixed":
            return ParameterDraws(name, np.array([mean]), mean, 0.0, "fixed in the scenario")
        from calibration.static.posterior import GaussianPrior, stratified

        random = generator(seed, "calibration")
        values = GaussianPrior(mean, deviation).quantile(stratified(random, count))
        others = {} if found is None else found.given(name, values)
        source = "normal distribution of the scenario"
        return ParameterDraws(name, values, mean, deviation, source, others=others)
    if calibration.curve == "design" and model is None:
        raise MissionInputError(said("assets.curve"))
    return _draws_of_load_test(calibration, seed, model if calibration.curve == "design" else None)


def _draws_of_load_test(calibration: Calibration, seed: int, model: "ReducedModel | None") -> ParameterDraws:
    """Return draws of e from the published load test, on the stiffness of a model or the published line."""
    # A scenario can be read without any of this, and it takes a while to load.
    from calibration.paper.load_test import particle_filter, push_forward
    from calibration.static.errors_in_variables import exact_posterior
    from calibration.static.experiments import published_measurements
    from calibration.static.posterior import (
        PUBLISHED_LINE,
        GaussianPrior,
        ScalarPosterior,
        stiffness_curve_of,
    )
    from reporting.json_file import plain

    sequence, pairs = seed_sequence(seed, "calibration"), published_measurements()
    curve = (
        PUBLISHED_LINE
        if model is None
        else stiffness_curve_of(model.tip_stiffness, model.validity["young_modulus_factor"])
    )
    if calibration.method == "exact":
        posterior = exact_posterior(pairs, curve=curve)
    else:
        posterior = particle_filter(pairs, seed=int(sequence.generate_state(1)[0]), curve=curve)
    stiffness = push_forward(posterior, curve)
    density = [item for item in fields(ScalarPosterior) if item.init]
    return ParameterDraws(
        name=calibration.parameter,
        values=posterior.samples(sequence, calibration.draws),
        mean=posterior.mean,
        standard_deviation=posterior.standard_deviation,
        source=f"static test of the wing, {calibration.method.replace('_', ' ')}, {curve.name}",
        record={
            "parameter": calibration.parameter,
            "prior": plain(GaussianPrior()),
            "posterior": {item.name: plain(getattr(posterior, item.name)) for item in density},
            "tip_stiffness": {
                "unit": "N/m",
                "mean": stiffness.mean,
                "standard_deviation": stiffness.standard_deviation,
            },
            "data": {
                "source": pairs.source,
                "load": pairs.load.tolist(),
                "displacement": pairs.displacement.tolist(),
            },
        },
    )


def read_calibration(calibration: Calibration) -> "Calibrated | None":
    """Return the calibration that a scenario names; None if it names none.

    Raises
    ------
    CalibrationRecordError
        It is damaged or of another kind, or has no samples of the parameter.
    """
    if calibration.file is None:
        return None
    from calibration.result.file import load_calibration

    found = load_calibration(Path(calibration.file))
    found.draws_of(calibration.parameter)
    return found


def check_calibration(
    calibration: Calibration,
    known: Collection[str],
    where: str,
    *,
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    design_hash: str = "",
    advice: str = SAME_NAMES,
) -> None:
    """Read the calibration file, if there is one, and see whether one from a campaign fits what is there.

    Parameters
    ----------
    calibration : Calibration
        Section of the scenario.
    known : collection of str
        Parameters of what is believed or flown; one of these each parameter of a calibration from a campaign
        must be.
    where : str
        What has these, in the sentence.
    ranges : mapping of str to (float, float)
        Where what has these parameters holds, SI; a name that is not there has no range.
    design_hash : str
        Of the design of what is believed; empty where it is not known, or of what is only flown.
    advice : str
        What to do where it is not, in the sentence.

    Raises
    ------
    CalibrationRecordError
        It is damaged or of another kind, or has no samples of the parameter.
    MissionInputError
        It has a parameter that is not known, or one whose posterior mean lies outside its range; or it is of
        another design.
    """
    found = read_calibration(calibration)
    if found is None or found.design is not None:
        return
    names = {prior.name for prior in found.priors}
    rows = [("parameter", names, known)]
    check_names(f"the calibration of {found.asset} has the", where, rows, advice=advice)
    if design_hash and found.design_hash not in ("", design_hash):
        asked = where, design_hash[:12]
        raise MissionInputError(said("assets.another_design", found=found, asked=asked))
    for name, (low, high) in ranges.items():
        if name in names and not low <= found.mean(name) <= high:
            value, of = f"{name} = {found.mean(name):.6g}", found.asset
            raise MissionInputError(said("assets.range", of=of, value=value, where=where, low=low, high=high))


def is_of_parameters(file: Path | str) -> bool:
    """Return whether a file is the calibration of a model's parameters from a campaign; a wing's is not."""
    from calibration.errors import CalibrationRecordError
    from calibration.result.file import load_calibration

    try:
        return load_calibration(file).design is None
    except CalibrationRecordError:  # said where the file is used
        return False


def calibrated_means(calibration: Calibration) -> dict[str, float]:
    """Return the posterior means of the parameters of a model that were calibrated from a campaign, SI."""
    found = read_calibration(calibration)
    if found is None or found.design is not None:
        return {}
    return {prior.name: found.mean(prior.name) for prior in found.priors}
