"""Arguments and options that several commands on missions share, as annotations for Typer."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting.system.operating_system import usable_processors
from scenarios import scenario_files

if TYPE_CHECKING:
    from twin_master.fleet.engine import Engine


def complete_scenario(incomplete: str) -> list[str]:
    """Return the shipped scenarios that begin with the typed text, for completion in the shell."""
    return [name for name in scenario_files() if name.startswith(incomplete)]


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        show_default=False,
        metavar="SCENARIO",
        autocompletion=complete_scenario,
        help="A shipped scenario, or a TOML file.",
    ),
]

CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="Fly with this calibration, a calibration.nc of `uav-twin calibrate`.",
    ),
]
CertificateOption = Annotated[
    Path | None,
    typer.Option("--ca-file", help="Certificate of the authority of an mqtts:// broker."),
]
MetricsOption = Annotated[
    str | None,
    typer.Option(
        "--metrics",
        metavar="[HOST:]PORT",
        help="Serve belief, decision and counts for Prometheus at this port; "
        "without HOST to this machine only.",
    ),
]
LineProtocolOption = Annotated[
    Path | None,
    typer.Option(
        "--line-protocol",
        help="Append each decision to this file in the line protocol of InfluxDB.",
    ),
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="Fly on the Dask cluster of this scheduler, such as tcp://host:8786.",
    ),
]
LearningClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="Compute on the Dask cluster of this scheduler, such as tcp://host:8786.",
    ),
]
LearningWorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        show_default="one for each processor, 0 for a small fleet",
        help="Worker processes; 0 computes in this process.",
    ),
]
FleetFolderOption = Annotated[
    Path | None, typer.Option("--out", show_default="runs/NAME", help="The folder to make.")
]
StoreOption = Annotated[
    str,
    typer.Option(
        "--store",
        metavar="ADDRESS",
        show_default="in the folder",
        help="Keep the arrays of the fleet at this address of fsspec, such as s3://BUCKET/NAME.zarr.",
    ),
]
LibraryOption = Annotated[
    Path | None,
    typer.Option(
        "--library",
        help="Believe this observation library, made by `uav-twin library sample`.",
    ),
]
PolicyOption = Annotated[
    str | None,
    typer.Option(
        "--policy",
        metavar="FILE or NAME",
        help="Fly this policy: mode, qmdp, belief or 'risk 0.05', each also with ', hold 3'; a "
        "file of `uav-twin plan --out`; or MODULE:NAME or FILE.py:NAME of an array or a function.",
    ),
]
SensorModelOption = Annotated[
    str | None,
    typer.Option(
        "--sensor-model",
        metavar="NAME",
        help="Believe this sensor model, MODULE:NAME or FILE.py:NAME.",
    ),
]
EstimatorOption = Annotated[
    str | None,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help="Believe by this estimator, MODULE:NAME or FILE.py:NAME.",
    ),
]
SeedOption = Annotated[
    int | None,
    typer.Option("--seed", min=0, help="Seed of the run; by default that of the scenario."),
]
FleetSeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed, instead of the seed of the file.")
]
ViewOption = Annotated[
    bool,
    typer.Option("--view", help="Show the flight in a browser of this machine while it goes on."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        show_default="one for each processor",
        help="Worker processes; 0 flies in this process.",
    ),
]


def choose_engine(workers: int | None, cluster: str | None) -> "Engine":
    """Return the engine that runs the missions of a fleet, in local processes or on a cluster.

    Parameters
    ----------
    workers : int or None
        The number of processes on this machine. None means one for each processor that this process
        may use.
    cluster : str or None
        The address of the scheduler of a Dask cluster; None runs the fleet on this machine.

    Raises
    ------
    typer.BadParameter
        If both are given.
    """
    from twin_master.fleet.engine import Engine

    if cluster is not None:
        if workers is not None:
            raise typer.BadParameter("a cluster has its own workers.", param_hint="--workers")
        return Engine(cluster=cluster)
    if workers is None:
        workers = usable_processors()
    return Engine(workers)
