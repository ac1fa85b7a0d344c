"""The pictures of README and docs: what draws each, and what the pages say of them."""
