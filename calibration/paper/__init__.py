"""The procedure and the figures of the paper: particle filter, masses step after step, Fig. 5 and Table 1."""
