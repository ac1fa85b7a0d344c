"""Draws of the uncertain parameter of the model, and the calibration file of a scenario."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from reporting.arrays import Float
from twin_master.errors import MissionInputError, check_names
from twin_master.scenario.mission import Calibration
from twin_master.seeds import generator, seed_sequence

if TYPE_CHECKING:
    from calibration.result.record import Calibration as CalibrationRecord
    from calibration.static.posterior import ScalarPosterior
    from fe.runtime.reduced import ReducedModel


SAME_NAMES = "give parameters the same names in the model file of the calibration"
WING_CALIBRATION = "give a calibration of the wing's own, which `uav-twin calibrate` makes"


@dataclass(frozen=True)
class ParameterDraws:
    """Equally weighted draws of one parameter of the asset's model.

    Attributes
    ----------
    name : str
        The parameter.
    values : (E,) array
        The draws, SI.
    mean, standard_deviation : float
        Those of the distribution that was drawn from.
    source : str
        Where the distribution comes from.
    record : mapping or None
        The whole calibration as plain data.
    others : mapping of str to (E,) array
        The expectation of each other calibrated parameter at each draw, SI.
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

    Parameters
    ----------
    calibration : Calibration
        The table of the scenario.
    seed : int
        The seed of the run.
    model : ReducedModel, optional
        The structural model, whose stiffness curve is used if the scenario asks for it.

    Raises
    ------
    MissionInputError
        If the scenario asks for the stiffness curve of a design, and there is none.
    CalibrationError
        If the measurements do not fit the model, or the calibration file cannot be read.
    """
    record = read_calibration(calibration)
    if calibration.source == "file":
        assert record is not None  # the schema requires the file
        return _draws_of_record(calibration, seed, record)
    if calibration.source == "fixed":
        assert calibration.mean is not None  # the schema requires it
        name = calibration.parameter
        mean = calibration.mean
        return ParameterDraws(name, np.array([mean]), mean, 0.0, "fixed in the scenario")
    if calibration.source == "normal":
        return _draws_of_normal(calibration, seed, record)
    if calibration.curve == "published":
        return _draws_of_load_test(calibration, seed, None)
    if model is None:
        raise MissionInputError(
            "`calibration.curve` asks for the stiffness curve of a design, and the asset has none: "
            "let the twin believe a `design`, or set `calibration.curve` to `published`."
        )
    return _draws_of_load_test(calibration, seed, model)


def _draws_of_record(
    calibration: Calibration, seed: int, record: "CalibrationRecord"
) -> ParameterDraws:
    """Return draws from the samples of a calibration file, one from each of as many strata."""
    from calibration.result.file import run_record

    name = calibration.parameter
    seeds = seed_sequence(seed, "calibration")
    values = record.stratified_draws(name, calibration.draws, seeds)
    return ParameterDraws(
        name=name,
        values=values,
        mean=record.mean(name),
        standard_deviation=record.standard_deviation(name),
        source=f"calibration of {record.asset}, {record.procedure}, {len(record.samples)} samples",
        record=run_record(record, name),
        others=record.given(name, values),
    )


def _draws_of_normal(
    calibration: Calibration, seed: int, record: "CalibrationRecord | None"
) -> ParameterDraws:
    """Return stratified draws from the normal distribution that the scenario states.

    If there is a calibration file, the other parameters follow from it.
    """
    from calibration.static.posterior import GaussianPrior, stratified

    assert calibration.mean is not None  # the schema requires it
    deviation = calibration.standard_deviation or 0.0
    probabilities = stratified(generator(seed, "calibration"), calibration.draws)
    values = GaussianPrior(calibration.mean, deviation).quantile(probabilities)
    return ParameterDraws(
        name=calibration.parameter,
        values=values,
        mean=calibration.mean,
        standard_deviation=deviation,
        source="normal distribution of the scenario",
        others={} if record is None else record.given(calibration.parameter, values),
    )


def _draws_of_load_test(
    calibration: Calibration, seed: int, model: "ReducedModel | None"
) -> ParameterDraws:
    """Return draws of the Young's modulus factor from the published load test.

    The stiffness curve is that of a model, or the published line without one.
    """
    # These modules take a while to load, and a scenario can be read without them.
    from calibration.paper.load_test import particle_filter, push_forward
    from calibration.static.errors_in_variables import exact_posterior
    from calibration.static.experiments import published_measurements
    from calibration.static.posterior import PUBLISHED_LINE, GaussianPrior, stiffness_curve_of
    from reporting.json_file import plain

    seeds = seed_sequence(seed, "calibration")
    measurements = published_measurements()
    curve = PUBLISHED_LINE
    if model is not None:
        validity = model.validity["young_modulus_factor"]
        curve = stiffness_curve_of(model.tip_stiffness, validity)
    if calibration.method == "exact":
        posterior = exact_posterior(measurements, curve=curve)
    else:
        filter_seed = int(seeds.generate_state(1)[0])
        posterior = particle_filter(measurements, seed=filter_seed, curve=curve)
    stiffness = push_forward(posterior, curve)
    return ParameterDraws(
        name=calibration.parameter,
        values=posterior.samples(seeds, calibration.draws),
        mean=posterior.mean,
        standard_deviation=posterior.standard_deviation,
        source=f"static test of the wing, {calibration.method.replace('_', ' ')}, {curve.name}",
        record={
            "parameter": calibration.parameter,
            "prior": plain(GaussianPrior()),
            "posterior": _plain_density(posterior),
            "tip_stiffness": {
                "unit": "N/m",
                "mean": stiffness.mean,
                "standard_deviation": stiffness.standard_deviation,
            },
            "data": {
                "source": measurements.source,
                "load": measurements.load.tolist(),
                "displacement": measurements.displacement.tolist(),
            },
        },
    )


def _plain_density(posterior: "ScalarPosterior") -> dict[str, Any]:
    """Return the arguments of a posterior as plain data, without what follows from them."""
    from calibration.static.posterior import ScalarPosterior
    from reporting.json_file import plain

    names = [attribute.name for attribute in fields(ScalarPosterior) if attribute.init]
    return {name: plain(getattr(posterior, name)) for name in names}


def read_calibration(calibration: Calibration) -> "CalibrationRecord | None":
    """Return the calibration whose file a scenario names; None if it names none.

    Raises
    ------
    CalibrationRecordError
        If the file is damaged or of another kind, or has no samples of the parameter.
    """
    if calibration.file is None:
        return None
    from calibration.result.file import load_calibration

    record = load_calibration(Path(calibration.file))
    record.draws_of(calibration.parameter)  # raises an error if there are none
    return record


def check_calibration(
    calibration: Calibration,
    known: Collection[str],
    where: str,
    *,
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    design_hash: str = "",
    advice: str = SAME_NAMES,
) -> None:
    """Check that a campaign's calibration fits the model that flies or is believed.

    Nothing is checked if the scenario names no calibration file, or one of a wing.

    Parameters
    ----------
    calibration : Calibration
        The table of the scenario.
    known : collection of str
        The parameters of the model, which must contain all parameters of the calibration.
    where : str
        What has these parameters, for the sentence.
    ranges : mapping of str to (float, float)
        Where the model is valid, by parameter, SI; a parameter without an entry has no range.
    design_hash : str
        The hash of the believed design; empty if it is not known, or the model only flies.
    advice : str
        What to do about an unknown parameter, for the sentence.

    Raises
    ------
    CalibrationRecordError
        If the file is damaged or of another kind, or has no samples of the parameter.
    MissionInputError
        If it has an unknown parameter, a parameter whose posterior mean is outside its range, or
        another design.
    """
    record = read_calibration(calibration)
    if record is None or record.design is not None:
        return
    names = {prior.name for prior in record.priors}
    names_by_sort = [("parameter", names, known)]
    check_names(f"the calibration of {record.asset} has the", where, names_by_sort, advice=advice)
    if design_hash and record.design_hash not in ("", design_hash):
        raise MissionInputError(
            f"the calibration of {record.asset} is of the model {record.model} with the design "
            f"{record.design_hash:.12}, and {where}, which the twin believes, has the design "
            f"{design_hash[:12]}: calibrate what is believed, or let the twin believe what was "
            "calibrated."
        )
    for name, (low, high) in ranges.items():
        if name in names and not low <= record.mean(name) <= high:
            raise MissionInputError(
                f"the calibration of {record.asset} has {name} = {record.mean(name):.6g}, but "
                f"{where} holds from {low:g} to {high:g} of it: give one of that, or widen the "
                "range if its file has one."
            )


def is_of_parameters(file: Path | str) -> bool:
    """Return whether a file is a campaign's calibration of parameters, and not that of a wing."""
    from calibration.errors import CalibrationRecordError
    from calibration.result.file import load_calibration

    try:
        return load_calibration(file).design is None
    except CalibrationRecordError:  # the use of the file raises it again
        return False


def calibrated_means(calibration: Calibration) -> dict[str, float]:
    """Return the posterior means of the parameters that were calibrated from a campaign, SI."""
    record = read_calibration(calibration)
    if record is None or record.design is not None:
        return {}
    return {prior.name: record.mean(prior.name) for prior in record.priors}
