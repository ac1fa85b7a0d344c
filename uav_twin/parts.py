"""What commands take from the other packages, imported when it is used; `--help` needs none."""

from uav_twin.lazy import handed_on

_, __getattr__ = handed_on(__file__)
