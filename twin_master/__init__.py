"""The twin: graphical model, planner and mission loop over FMI assets.

The parts that infer and plan know states, controls, sensors and rewards, not wings:

- `graphical_model` states, transitions and policies as checked arrays;
- `inference` filter, smooth, predict;
- `sensor_model` and `quantity` what the sensors show, and what they would show without noise;
- `planner` what to do for the rewards, which `quantity` has, too;
- `strain_library_source` the authors' published library as an observation model.
"""
