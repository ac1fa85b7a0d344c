"""The procedure of the paper step after step, its Fig. 5 and its Table 1."""
