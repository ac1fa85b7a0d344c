"""The graphical model: states, inference, sensors, rewards, planning, the twin."""
