"""Where, when and how the gap shows."""
