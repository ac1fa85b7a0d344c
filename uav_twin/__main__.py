"""The command `uav-twin`, also as `python -m uav_twin`."""

import gc
import sys

from uav_twin.shadowing import ShadowedPackageError, refuse_shadowing

NEW_OBJECTS_BETWEEN_COLLECTIONS = 50_000
"""Number of new objects after which Python looks for garbage, instead of 700.

A command makes hundreds of thousands of objects while it imports packages, and none is garbage.
"""


def main() -> None:
    """Check that no other file hides a package of this project, and run the command line."""
    gc.set_threshold(NEW_OBJECTS_BETWEEN_COLLECTIONS)
    try:
        refuse_shadowing()
    except ShadowedPackageError as error:
        sys.exit(str(error))  # the sentence on the error stream, and exit code 1
    from uav_twin.cli import main as run_commands

    try:
        run_commands()
    finally:
        # Python looks for garbage among all objects before it ends, which takes a fifth of a
        # second; frozen objects are left out.
        gc.freeze()


if __name__ == "__main__":
    main()
