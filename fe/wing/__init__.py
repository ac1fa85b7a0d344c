"""The design of a wing, and its mesh."""
