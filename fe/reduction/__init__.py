"""From the full model to the reduced one: certified, kept on disk."""
