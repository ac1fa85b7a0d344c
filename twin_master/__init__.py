"""The twin: graphical model, planner and mission loop over FMI assets."""
