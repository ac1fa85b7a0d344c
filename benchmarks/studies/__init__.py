"""Studies behind published figures; each names the page under docs/ in its first line."""
