"""From fits to a verdict: name, consistency, proof, next experiment, what the data can decide."""
