"""Several FMUs as one asset: connections, order of evaluation, and the stepping that joins them."""
