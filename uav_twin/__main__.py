"""The command `uav-twin`, also as `python -m uav_twin`."""

import sys

from uav_twin.shadowing import ShadowedPackageError, refuse_shadowing


def main() -> None:
    """Check that no other file hides a package of this project, and run the command line."""
    try:
        refuse_shadowing()
    except ShadowedPackageError as error:
        sys.exit(str(error))  # the sentence on the error stream, and exit code 1
    from uav_twin.cli import main as run_commands

    run_commands()


if __name__ == "__main__":
    main()
