"""Finds the step at which an FMU crashes, and what the sandbox refused it until then."""

from collections.abc import Callable
from contextlib import closing

from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuError, FmuWorkerError
from fmu_asset.worker.refusals import watch_for_refusals
from fmu_asset.worker.sandbox import landlock_version


def located_crash(
    open_asset: Callable[[], FmiAsset],
    run: Callable[[FmiAsset], object],
    crash: FmuWorkerError,
) -> FmuWorkerError:
    """Return an error that names the exact step of a crash, and what the sandbox refused.

    Many steps are made in one call, so the error of a crash may name an earlier step. The
    simulation is therefore run once more, with a report of each step and of refused calls.

    Parameters
    ----------
    open_asset : callable
        Returns a new asset of the FMU.
    run : callable
        Simulates an asset.
    crash : FmuWorkerError
        The error of the first run, which is returned with a note if the second run does not crash.
    """
    with watch_for_refusals() as report:
        has_sandbox = 0
        try:
            with closing(open_asset()) as asset:
                has_sandbox = asset.binding.limits.sandbox and landlock_version()
                run(asset)
        except FmuWorkerError as error:
            crash = error
        except FmuError as error:
            crash.add_note(f"A second run failed otherwise: {error}")
        else:
            crash.add_note(
                "A second run did not crash: the step of the crash may be later than the one named."
            )
        if has_sandbox:
            crash.add_note(report.sentence())
    return crash
