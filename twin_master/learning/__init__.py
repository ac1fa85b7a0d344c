"""What does not change in time is learnt during operation, and what no state explains is noticed."""
