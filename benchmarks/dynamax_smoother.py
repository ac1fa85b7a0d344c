"""Smoothed beliefs of many sequences by dynamax: `python dynamax_smoother.py PROBLEM POSTERIOR`.

`benchmarks.peer_networks` starts it in an environment that has dynamax and need not have uav-twin,
so that it imports nothing of this project.
"""

import os
import sys
import time
from importlib import metadata

import numpy as np

REPEATS = 7


def main(problem_file: str, posterior_file: str) -> None:
    """Read a problem, smooth all its sequences on one core, and write the posterior."""
    # imported here, so that the module can be imported where dynamax is not installed
    import jax
    from dynamax.hidden_markov_model import hmm_two_filter_smoother

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    with np.load(problem_file) as problem:
        prior, transitions = (
            jax.numpy.array(problem["prior"]),
            jax.numpy.array(problem["transitions"]),
        )
        log_likelihoods = jax.numpy.array(problem["log_likelihoods"])

    @jax.jit
    def smooth_all(sequences):  # type: ignore[no-untyped-def]
        def smooth(log_likelihood):  # type: ignore[no-untyped-def]
            # `hmm_smoother` takes forecasts below 1e-8 for zero, which changes beliefs.
            posterior = hmm_two_filter_smoother(prior, transitions, log_likelihood)
            return posterior.smoothed_probs

        return jax.vmap(smooth)(sequences)

    smoothed = smooth_all(log_likelihoods).block_until_ready()  # compiles
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        smooth_all(log_likelihoods).block_until_ready()
        times.append(time.process_time() - begin)
    np.savez(
        posterior_file,
        peer=f"dynamax {metadata.version('dynamax')}",
        seconds=min(times),
        smoothed=np.asarray(smoothed),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
