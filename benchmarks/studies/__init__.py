"""Studies behind published figures; the docstring of each names its page under docs/."""
