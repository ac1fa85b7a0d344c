"""Studies behind published figures; the first line of each names the page under docs/ that shows them."""
