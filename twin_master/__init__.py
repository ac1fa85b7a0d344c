"""The twin: graphical model, planner and mission loop over FMI assets.

The parts that infer and plan know states, controls, sensors and rewards, not wings:

- `graphical_model` states, transitions and policies as checked arrays;
- `inference` filter, smooth, predict;
- `sensor_model` and `quantity` what the sensors show, and what they would show without noise;
- `rewards` and `planner` what is wanted, and what to do;
- `strain_library` the authors' published library as an observation model.
"""
