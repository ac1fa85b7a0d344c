"""`python -m twin_master SCENARIO`: does what `uav-twin run SCENARIO` does."""

from twin_master.command import main

if __name__ == "__main__":
    main()
