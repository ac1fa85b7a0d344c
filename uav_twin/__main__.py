"""`python -m uav_twin`: the same as `uav-twin`."""

from uav_twin.cli import main

if __name__ == "__main__":
    main()
