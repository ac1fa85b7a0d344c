"""Studies on which shipped numbers and meshes rest; they are not distributed."""
