"""What commands take from the rooms and other packages, imported when it is used; `--help` needs none."""

from reporting.lazy import handed_on

__getattr__ = handed_on(__name__, __file__)
